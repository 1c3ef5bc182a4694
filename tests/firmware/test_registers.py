"""The register header against the description of the part's family that pyocd ships."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
import zipfile
from functools import cache
from importlib.resources import files

import pytest

from tests.firmware.builds import FIRMWARE, defined

TEXT = (FIRMWARE / "stm32f401.h").read_text()
CONSTANTS = defined(TEXT)
# the header's name of a peripheral: the description's
PERIPHERALS = {"ADC_COMMON": "C_ADC"}
# by beginning of a constant's name: a peripheral of that kind
KINDS = {"DMA": "DMA2", "SPI": "SPI2", "TIM": "TIM2", "ADC": "ADC1"}
# the core's registers are in no description of the part: PM0214, tables 50, 53 and 55
CORE = {
    "SYSTICK": 0xE000E010,
    "NVIC_ISER": 0xE000E100,
    "NVIC_IPR": 0xE000E400,
    "SCB_SHPR3": 0xE000ED20,
}


@cache
def described() -> dict[str, tuple[int, dict[str, tuple[int, dict[str, tuple[int, int]]]]]]:
    """Base address, registers' offsets, fields' positions and widths, by name."""
    archive = files("pyocd.debug.svd").joinpath("svd_data.zip")
    with archive.open("rb") as file, zipfile.ZipFile(file) as unzipped:
        root = ET.fromstring(unzipped.read("STM32F41x.svd"))  # noqa: S314 - of a locked package
    result: dict[str, tuple[int, dict[str, tuple[int, dict[str, tuple[int, int]]]]]] = {}
    derived = {}
    for peripheral in root.iter("peripheral"):
        name = peripheral.findtext("name") or ""
        registers = {
            r.findtext("name") or "": (
                int(r.findtext("addressOffset") or "", 0),
                {
                    f.findtext("name") or "": (
                        int(f.findtext("bitOffset") or ""),
                        int(f.findtext("bitWidth") or ""),
                    )
                    for f in r.iter("field")
                },
            )
            for r in peripheral.iter("register")
        }
        if name == "DMA2":
            registers = {
                re.sub(r"S(\d)(CR|NDTR|PAR|M0AR|M1AR|FCR)$", r"stream[\1].\2", register): value
                for register, value in registers.items()
            }
        result[name] = (int(peripheral.findtext("baseAddress") or "", 0), registers)
        if "derivedFrom" in peripheral.attrib:
            derived[name] = peripheral.attrib["derivedFrom"]
    for name, origin in derived.items():
        result[name] = (result[name][0], result[origin][1])
    return result


def structures() -> dict[str, dict[str, int]]:
    """Offsets of members, by structure."""
    result: dict[str, dict[str, int]] = {}
    for name, body in re.findall(r"^struct (\w+) \{\n(.*?)^\};", TEXT, re.MULTILINE | re.DOTALL):
        members: dict[str, int] = {}
        at = 0
        for kind, declared in re.findall(r"^\s+(reg|struct \w+) (.*?);", body, re.MULTILINE):
            inner = {"": 0} if kind == "reg" else result[kind.removeprefix("struct ")]
            size = 4 * len(inner)
            for item in declared.split(","):
                found = re.fullmatch(r"\s*(\w+)(?:\[(\d+)\])?", item)
                assert found, item
                for n in range(int(found[2] or 1)):
                    base = found[1] + (f"[{n}]" if found[2] else "")
                    for member, offset in inner.items():
                        members[base + ("." + member if member else "")] = at + offset
                    at += size
        result[name] = members
    return result


INSTANCES = re.findall(r"^#define (\w+) \(\(struct (\w+) \*\)(0x\w+?)u\)", TEXT, re.MULTILINE)


@pytest.mark.parametrize(("name", "structure", "address"), INSTANCES)
def test_addresses(name: str, structure: str, address: str) -> None:
    if name in CORE:
        assert int(address, 16) == CORE[name]
        return
    base, registers = described()[PERIPHERALS.get(name, name)]
    assert int(address, 16) == base
    members = {m: at for m, at in structures()[structure].items() if "reserved" not in m}
    assert members
    for member, offset in members.items():
        known = registers.get(member) or registers.get(f"{member}_Output")
        if name == "TIM3" and member in {"CCR1", "CCR2", "CCR3", "CCR4", "CNT", "ARR"}:
            assert known is not None
        if known is None and name == "GPIOA":
            known = described()["GPIOB"][1][member]
        assert known is not None, f"{name} has no {member}"
        assert offset == known[0], f"{name}.{member}"


def test_core() -> None:
    for name, address in CORE.items():
        assert f"0x{address:08X}u" in re.search(rf"#define {name}\b.*", TEXT)[0]  # type: ignore[index]
    assert list(structures()["systick"].values()) == [0, 4, 8, 12]


BITS = [n for n in CONSTANTS if not n.startswith(("SYSTICK", "SCB", "PRIORITY", "NVIC"))]


@pytest.mark.parametrize("name", BITS)
def test_bits(name: str) -> None:
    """Each constant lies in the field that its name begins with, at its place."""
    kind, register, rest = name.split("_", 2)
    base = "stream[0]." + register if kind == "DMA" and register != "ISR" else register
    if kind == "DMA" and register == "ISR":
        base = "LISR"
    if (kind, register) == ("ADC", "CCR"):
        kind = "C_ADC"
    registers = described()[KINDS.get(kind, kind)][1]
    fields = (registers.get(base) or registers[f"{base}_Output"])[1]
    value = CONSTANTS[name]
    if name == "DMA_ISR_ALL":
        ends = {at for f, (at, _) in fields.items() if f.endswith("0")}
        assert value == sum(1 << at for at in ends)
        return
    if kind == "CRC":
        rest = "CR"  # the bit has its register's name there
    # PLLN is described bit by bit, PLLN0 first; DMA's flags have the stream's number
    candidates = {
        f.rstrip("0123456789") if kind in {"RCC"} and f[-1].isdigit() else f for f in fields
    } | set(fields)
    words = {**ALIASES}.get(name, rest)
    matching = [
        f for f in candidates if words.startswith(f) or (kind == "DMA" and f == words + "0")
    ]
    assert matching, f"no field of {register} begins {rest}"
    field = max(matching, key=len)
    parts = [
        place
        for f, place in fields.items()
        if f == field or (field not in fields and f.rstrip("0123456789") == field)
    ]
    low, high = min(at for at, _ in parts), max(at + width for at, width in parts)
    if re.search(rf"#define {name} \d+u /\* position", TEXT):
        assert value == low
    else:
        assert value >> high == 0
        assert value & ((1 << low) - 1) == 0


# where the name of a constant says more, or less, than the field's
ALIASES = {
    "SPI_CR1_BR_DIV4": "BR",
    "RCC_CFGR_SWS": "SWS",
    "DMA_FCR_FTH_FULL": "FTH",
}


def test_interrupt_numbers() -> None:
    archive = files("pyocd.debug.svd").joinpath("svd_data.zip")
    with archive.open("rb") as file, zipfile.ZipFile(file) as unzipped:
        root = ET.fromstring(unzipped.read("STM32F41x.svd"))  # noqa: S314
    known = {
        (i.findtext("name") or "").upper().removesuffix("_IRQ"): int(i.findtext("value") or "")
        for i in root.iter("interrupt")
    }
    numbers = dict(re.findall(r"IRQ_(\w+) = (\d+)", TEXT))
    assert int(numbers.pop("COUNT")) == 85
    for name, number in numbers.items():
        assert known[name] == int(number)
