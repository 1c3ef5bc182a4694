"""What the compilers make of the firmware, without running it."""

from __future__ import annotations

import re
import struct
from typing import TYPE_CHECKING, Any

import pytest
from elftools.elf.elffile import ELFFile

from tests.firmware.builds import (
    COMPILERS,
    FIRMWARE,
    NAME,
    build,
    calls_and_frames,
    depth,
    make,
    need,
    sections,
    symbols,
)

if TYPE_CHECKING:
    from pathlib import Path

FLASH, FLASH_SIZE = 0x0800_0000, 512 * 1024
RAM, RAM_SIZE = 0x2000_0000, 96 * 1024
EXCEPTION_FRAME = 32 + 4  # eight registers, and the alignment to 8 bytes
# each can interrupt those below, none its own kind
PRIORITIES = (
    ("TIM5_IRQHandler", "EXTI1_IRQHandler"),
    ("DMA2_Stream0_IRQHandler", "DMA2_Stream1_IRQHandler"),
    ("DMA1_Stream3_IRQHandler", "EXTI15_10_IRQHandler"),
    ("TIM2_IRQHandler",),
    ("SysTick_Handler",),
)
HANDLERS = {
    15: "SysTick_Handler",
    16 + 7: "EXTI1_IRQHandler",
    16 + 14: "DMA1_Stream3_IRQHandler",
    16 + 28: "TIM2_IRQHandler",
    16 + 40: "EXTI15_10_IRQHandler",
    16 + 50: "TIM5_IRQHandler",
    16 + 56: "DMA2_Stream0_IRQHandler",
    16 + 57: "DMA2_Stream1_IRQHandler",
}
each_compiler = pytest.mark.parametrize("compiler", COMPILERS)


@each_compiler
def test_products(compiler: str) -> None:
    folder = build(compiler)
    assert all((folder / f"{NAME}.{kind}").stat().st_size for kind in ("elf", "bin", "map"))
    assert "TIM5_IRQHandler" in (folder / f"{NAME}.map").read_text()


@each_compiler
def test_no_warnings(compiler: str, tmp_path: Path) -> None:
    need(compiler)
    made = make(*COMPILERS[compiler], f"BUILD={tmp_path}")
    assert made.returncode == 0, made.stderr
    assert not made.stderr


def test_analyzer(tmp_path: Path) -> None:
    need("gcc")
    made = make("check", f"BUILD={tmp_path}")
    assert made.returncode == 0, made.stderr
    assert not made.stderr
    assert "static" in made.stdout


@each_compiler
def test_reproducible(compiler: str, tmp_path: Path) -> None:
    need(compiler)
    for name in ("one", "two"):
        made = make(*COMPILERS[compiler], f"BUILD={tmp_path / name}")
        assert made.returncode == 0, made.stderr
    for kind in ("elf", "bin"):
        one, two = ((tmp_path / name / f"{NAME}.{kind}").read_bytes() for name in ("one", "two"))
        assert one == two
        assert str(FIRMWARE.parent).encode() not in one


@each_compiler
def test_build_id(compiler: str) -> None:
    image = (build(compiler) / f"{NAME}.bin").read_bytes()
    address, size, _ = symbols(compiler)["build_id"]
    found = re.fullmatch(
        rb"linetrack (\S+) (gcc|clang)\d+ [0-9a-f]{6}\0+", image[address - FLASH :][:size]
    )
    assert found, "no build id"
    version = re.search(
        r'^version = "(.*)"', (FIRMWARE.parent / "pyproject.toml").read_text(), re.MULTILINE
    )
    assert version is not None
    assert found[1] == version[1].encode()
    assert size == 32


@each_compiler
def test_memory(compiler: str) -> None:
    found = sections(compiler)
    flash = sum(size for address, size in found.values() if address < RAM)
    initial = found.get(".data", (0, 0))[1]
    assert 0 < flash + initial <= FLASH_SIZE
    for name, (address, size) in found.items():
        start, length = (FLASH, FLASH_SIZE) if address < RAM else (RAM, RAM_SIZE)
        assert start <= address, name
        assert address + size <= start + length, name
    assert found[".vectors"][0] == FLASH
    assert found[".stack"][0] == RAM, "an overflow of the stack must fault"


@each_compiler
def test_vectors(compiler: str) -> None:
    image = (build(compiler) / f"{NAME}.bin").read_bytes()
    known = symbols(compiler)
    count = 16 + 85
    words = struct.unpack_from(f"<{count}I", image)
    stack = sections(compiler)[".stack"]
    assert words[0] == known["stack_top"][0] == stack[0] + stack[1]
    assert words[0] % 8 == 0
    assert words[1] == known["Reset_Handler"][0] | 1
    for number in range(2, count):
        if number in {7, 8, 9, 10, 13}:
            assert words[number] == 0
            continue
        name = HANDLERS.get(number, "Default_Handler")
        assert words[number] == known[name][0] | 1, f"vector {number}"
    assert sections(compiler)[".vectors"][1] == 4 * count


@each_compiler
def test_neither_libc_nor_heap_nor_floats(compiler: str) -> None:
    for name in symbols(compiler):
        assert not re.match(
            r"__aeabi_|_?malloc|_?sbrk|calloc|free$|printf|__udiv|__div|__.*df", name
        )
    for path in build(compiler).glob("*.o"):
        with path.open("rb") as file:
            table: Any = ELFFile(file).get_section_by_name(".symtab")
            outside = {s.name for s in table.iter_symbols() if s["st_shndx"] == "SHN_UNDEF"} - {""}
        unwinding = {name for name in outside if name.startswith("__aeabi_unwind")}
        assert outside - unwinding <= set(symbols(compiler)), path.name


@each_compiler
def test_floating_point_unit_is_unused(compiler: str) -> None:
    """It is off. Its instructions are those of coprocessors 10 and 11: 0xEnnn or 0xFnnn 0xnAnn."""
    image = (build(compiler) / f"{NAME}.bin").read_bytes()
    start = sections(compiler)[".text"][0] - FLASH
    known = symbols(compiler)
    for name, (address, size, _) in known.items():
        if not (FLASH + start <= address < FLASH + len(image)) or not size:
            continue
        if "table" in name or "." in name or name in {"build_id", "checksums"}:
            continue  # constants
        halves = struct.unpack_from(f"<{size // 2}H", image, address - FLASH)
        mapped = iter(range(len(halves)))
        for n in mapped:
            if halves[n] >> 11 in {0b11101, 0b11110, 0b11111}:
                code = halves[n] >> 8
                wide = halves[n + 1] if n + 1 < len(halves) else 0
                assert not (code in {0xEC, 0xED, 0xEE, 0xFE} and wide >> 9 & 7 == 5), name
                next(mapped, None)


@each_compiler
def test_stack(compiler: str) -> None:
    """Each priority's deepest handler interrupts the deepest place of the one below."""
    calls, frames = calls_and_frames(compiler)
    assert set().union(*calls.values()) <= set(frames), "a call whose stack use is unknown"
    need_of_main = depth(compiler, "Reset_Handler")
    levels = [max(depth(compiler, name) for name in level) for level in PRIORITIES]
    total = need_of_main + sum(levels) + EXCEPTION_FRAME * len(levels)
    reserved = sections(compiler)[".stack"][1]
    assert total <= reserved, f"{compiler}: {need_of_main} + {levels} + frames = {total}"
    assert total * 2 > reserved / 4, "reserved far more than is ever used"


def test_same_interface() -> None:
    """Both compilers keep what debuggers and tests look for."""
    need("gcc")
    for compiler in COMPILERS:
        kept = {name for name, (_, size, shared) in symbols(compiler).items() if shared and size}
        assert set(HANDLERS.values()) | {"status_frame", "build_id", "main"} <= kept
    for name in ("frames", "plans", "received", "status_frame"):
        assert symbols("gcc")[name][1] == symbols("zig")[name][1], name


def test_flash_needs_a_drive(tmp_path: Path) -> None:
    made = make("flash", *COMPILERS["zig"], "BUILD=build-zig", f"DRIVE={tmp_path / 'none'}")
    assert made.returncode
    assert "is the Nucleo mounted" in made.stderr
    made = make("flash", *COMPILERS["zig"], "BUILD=build-zig", f"DRIVE={tmp_path}")
    assert made.returncode == 0, made.stderr
    copied = (tmp_path / f"{NAME}.bin").read_bytes()
    assert copied == (build("zig") / f"{NAME}.bin").read_bytes()
