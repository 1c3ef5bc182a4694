"""Builds of the firmware, one per compiler, and what is in them."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections import defaultdict
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from elftools.elf.elffile import ELFFile

FIRMWARE = Path(__file__).parents[2] / "firmware"
NAME = "F401_FW_TCD1304"
COMPILERS = {
    "zig": (f"ZIG={sys.executable} -m ziglang",),
    "gcc": ("CROSS=arm-none-eabi-",),
}


def need(compiler: str) -> None:
    """Skip without this compiler, but not in CI."""
    if compiler == "gcc" and not shutil.which("arm-none-eabi-gcc"):
        if os.environ.get("CI"):
            pytest.fail("CI without arm-none-eabi-gcc: install gcc-arm-none-eabi")
        pytest.skip("no arm-none-eabi-gcc: install gcc-arm-none-eabi")


def make(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ("make", "-C", str(FIRMWARE), *arguments), capture_output=True, text=True, check=False
    )


@cache
def build(compiler: str) -> Path:
    """Folder of an up-to-date build."""
    need(compiler)
    folder = FIRMWARE / f"build-{compiler}"
    made = make(*COMPILERS[compiler], f"BUILD={folder.name}")
    assert made.returncode == 0, made.stdout + made.stderr
    assert "warning" not in made.stderr, made.stderr
    return folder


@cache
def symbols(compiler: str) -> dict[str, tuple[int, int, bool]]:
    """Address (of functions: without the Thumb bit), size, global, by name."""
    with (build(compiler) / f"{NAME}.elf").open("rb") as file:
        table: Any = ELFFile(file).get_section_by_name(".symtab")
        return {
            s.name: (
                s["st_value"] & ~(s["st_info"]["type"] == "STT_FUNC"),
                s["st_size"],
                s["st_info"]["bind"] == "STB_GLOBAL",
            )
            for s in table.iter_symbols()
            if s.name and not s.name.startswith("$")
        }


@cache
def sections(compiler: str) -> dict[str, tuple[int, int]]:
    """Address and size of what is in the microcontroller's memory."""
    with (build(compiler) / f"{NAME}.elf").open("rb") as file:
        return {
            s.name: (s["sh_addr"], s["sh_size"])
            for s in ELFFile(file).iter_sections()
            if s["sh_flags"] & 2 and s["sh_size"]
        }


@cache
def calls_and_frames(compiler: str) -> tuple[dict[str, set[str]], dict[str, int]]:
    """Who calls whom, and bytes of stack of each function; static ones as ``file.c:name``."""
    calls: dict[str, set[str]] = defaultdict(set)
    frames: dict[str, int] = {}
    folder = build(compiler)
    for path in sorted(folder.glob("*.o")):
        with path.open("rb") as file:
            elf: Any = ELFFile(file)
            local = {
                _unnumbered(s.name)
                for s in elf.get_section_by_name(".symtab").iter_symbols()
                if s["st_info"]["type"] == "STT_FUNC" and s["st_info"]["bind"] == "STB_LOCAL"
            }

            def named(name: str, local: set[str] = local, unit: str = path.stem) -> str:
                name = _unnumbered(name.removeprefix(".text.").removeprefix("startup."))
                return f"{unit}.c:{name}" if name in local else name

            for section in elf.iter_sections():
                if section["sh_type"] != "SHT_REL":
                    continue
                target = elf.get_section(section["sh_info"])
                for entry in section.iter_relocations():
                    symbol = elf.get_section(section["sh_link"]).get_symbol(entry["r_info_sym"])
                    name = symbol.name or elf.get_section(symbol["st_shndx"]).name
                    if target.name == ".stack_sizes":
                        frames[named(name)] = _uleb(target.data()[entry["r_offset"] + 4 :])
                    elif target.name.startswith(".text.") and entry["r_info_type"] in {10, 30}:
                        calls[named(target.name)].add(named(name))
        listing = path.with_suffix(".su")
        if listing.exists():
            for line in listing.read_text().splitlines():
                where, size, kind = line.split("\t")
                assert kind == "static", f"{where}: {kind} stack use cannot be bounded"
                frames[named(where.split(":")[-1])] = int(size)
    return dict(calls), frames


def _unnumbered(name: str) -> str:
    """Name without the number of a clone, which gcc's listings do not have."""
    return re.sub(r"\.\d+$", "", name)


def _uleb(data: bytes) -> int:
    value = 0
    for n, byte in enumerate(data):
        value |= (byte & 0x7F) << 7 * n
        if byte < 0x80:
            break
    return value


def depth(compiler: str, function: str, path: tuple[str, ...] = ()) -> int:
    """Bytes of stack that a function takes with all it calls."""
    calls, frames = calls_and_frames(compiler)
    assert function not in path, f"recursion: {path}"
    deepest = max(
        (depth(compiler, called, (*path, function)) for called in calls.get(function, ())),
        default=0,
    )
    return frames[function] + deepest


def defined(text: str) -> dict[str, Any]:
    """Values of a header's object-like macros that are plain numbers or shifts of such."""
    result = {}
    for name, value in re.findall(r"^#define (\w+) (.+?)(?:\s*/\*.*)?$", text, re.MULTILINE):
        bare = re.sub(r"\b(0x[0-9A-Fa-f]+|\d+)u\b", r"\1", value)
        if re.fullmatch(r"[0-9A-Fa-fx()< |]+", bare):
            result[name] = eval(bare)  # noqa: S307 - digits and shifts only
    return result
