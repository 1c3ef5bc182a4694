"""The twin takes exceptions in the order QEMU does: nesting, masks, WFI, FPU, random sequences.

`nvic.c` runs once on QEMU (an STM32F405) and once on the twin; each scenario's log must be the
same, entry by entry. Where QEMU itself is not what the architecture says, DEVIATIONS has both.
References: ARMv7-M Architecture Reference Manual (DDI 0403E), Cortex-M4 Devices Generic User Guide
(DUI 0553A), STM32F4 programming manual (PM0214).
"""

from __future__ import annotations

import difflib
import functools
import importlib.util
import itertools
import json
import os
import re
import shutil
import struct
import subprocess
import sys
import time
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, NamedTuple, Self

import pytest

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from twin.machine import Machine

HERE = Path(__file__).parent
SOURCES = [HERE / "nvic.c", HERE / "stubs.S"]
SOURCE = SOURCES[0].read_text(encoding="utf-8")
SCENARIOS = re.findall(r"\bCOMMON\((?!name\))(\w+)\)", SOURCE)
BEYOND = re.findall(r"\bBEYOND\((?!name\))(\w+)\)", SOURCE)
ONLY, NONE = b"only", 4 * b"\xff"  # in the image

FLASH, FLASH_SIZE = 0x08000000, 0x10000
RESULTS = 0x20000000  # u32 done, u32 count, entries of 8 bytes
SEPARATOR = 0xFFFF
LIMIT = 20.0  # s; a run takes a tenth of a second
VIRTUAL_LIMIT = 1.0  # s, of the twin's time; a run takes a tenth of that

COMMON = [
    *("-O2", "-std=gnu11", "-ffreestanding", "-fno-builtin", "-nostdlib"),
    *("-Wall", "-Wextra", "-Werror", f"-Wl,-T,{HERE / 'nvic.ld'}", "-Wl,-e,reset"),
]
# soft: C must leave the FPU to the scenarios, the assembler is told of it in stubs.S
COMPILERS: dict[str, list[str]] = {
    "gcc": ["arm-none-eabi-gcc", "-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=soft"],
    "zig": [
        *(sys.executable, "-m", "ziglang", "cc", "-target", "thumb-freestanding-eabi"),
        *("-mcpu=cortex_m4", "-fno-sanitize=undefined", "-fno-unwind-tables", "-g0"),
    ],
}
# sleep=off: in WFI, QEMU's time goes on to the next timer; else it would wait for real time
QEMU = [
    *("qemu-system-arm", "-M", "netduinoplus2", "-icount", "shift=4,sleep=off", "-display", "none"),
    *("-serial", "none", "-monitor", "none", "-qmp", "stdio", "-kernel"),
]


class Entry(NamedTuple):
    """What the image noted: in which exception (0: thread), what, which value."""

    exception: int
    label: str
    value: int

    def __str__(self) -> str:
        return f"{name(self.exception)}: {self.label} {self.value:#x}"


Log = dict[str, list[Entry]]


def name(exception: int) -> str:
    names = {0: "thread", 2: "NMI", 3: "HardFault", 11: "SVC", 14: "PendSV", 15: "SysTick"}
    return names.get(exception) or f"{exception - 16}"


def decode(entries: bytes, flash: bytes) -> Log:
    """Entries by scenario, from what is in RAM and the strings in flash."""
    log: Log = {}
    current: list[Entry] = []
    for offset, exception, value in struct.iter_unpack("<HHI", entries):
        label = flash[offset : flash.index(b"\0", offset)].decode("ascii")
        if exception == SEPARATOR:
            current = log.setdefault(label, [])
        else:
            current.append(Entry(exception, label, value))
    return log


def log_so_far(read: Callable[[int, int], bytes]) -> Log:
    count: int = struct.unpack("<I", read(RESULTS + 4, 4))[0]
    return decode(read(RESULTS + 8, 8 * count), read(FLASH, FLASH_SIZE))


def read_log(read: Callable[[int, int], bytes]) -> Log:
    """The log of an image that is done."""
    log = log_so_far(read)
    done: int = struct.unpack("<I", read(RESULTS, 4))[0]
    last = "\n".join(map(str, [*itertools.chain.from_iterable(log.values())][-20:]))
    assert done == 1, f"stopped in {[*log][-1:]} with {done}, after\n{last}"
    return log


def shape(entries: list[Entry]) -> str:
    """Handlers in order; in parentheses, those that preempted one: "3(5 NMI) 7"."""
    words = [
        f" {name(entry.exception)}(" if entry.label == "enter" else ")"
        for entry in entries
        if entry.label in {"enter", "exit"}
    ]
    return "".join(words).replace("()", "").replace("( ", "(").strip()


def difference(qemu: list[Entry], twin: list[Entry]) -> str:
    """Lines as of diff; empty if the logs are equal."""
    return "\n".join(
        difflib.unified_diff([*map(str, qemu)], [*map(str, twin)], "QEMU", "twin", n=6, lineterm="")
    )


def require(present: bool, what: str) -> None:
    """Skip without a tool; in CI, where all must be, fail."""
    if not present:
        if os.environ.get("CI"):
            pytest.fail(f"{what} is missing, and this is CI")
        pytest.skip(f"{what} is missing")


# ---- the two machines ----


class Qemu:
    """QEMU with an image, spoken to by QMP on its standard input and output."""

    def __init__(self, elf: Path, folder: Path) -> None:
        self.file = folder / "memory"
        self.process = subprocess.Popen(
            [*QEMU, str(elf)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        assert self.process.stdin
        assert self.process.stdout
        self.stdin: IO[str] = self.process.stdin
        self.stdout: IO[str] = self.process.stdout
        assert "QMP" in self.stdout.readline(), "QEMU did not start"
        self.execute("qmp_capabilities")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()
        self.stdin.close()
        self.stdout.close()

    def execute(self, command: str, **arguments: Any) -> Any:
        self.stdin.write(json.dumps({"execute": command, "arguments": arguments}) + "\n")
        self.stdin.flush()
        for line in self.stdout:
            reply = json.loads(line)  # or an event, to be ignored
            if "return" in reply or "error" in reply:
                assert "return" in reply, reply
                return reply["return"]
        pytest.fail(f"QEMU ended with {self.process.wait()}")

    def read(self, address: int, size: int) -> bytes:
        self.execute("pmemsave", val=address, size=size, filename=str(self.file))
        return self.file.read_bytes()


def run_on_qemu(elf: Path, folder: Path) -> Log:
    require(shutil.which(QEMU[0]) is not None, QEMU[0])
    with Qemu(elf, folder) as qemu:
        end = time.monotonic() + LIMIT
        while not any(qemu.read(RESULTS, 4)) and time.monotonic() < end:
            time.sleep(0.01)
        return read_log(qemu.read)


def run_on_twin(elf: Path) -> Machine:
    try:
        from twin.machine import Machine

        machine = Machine(elf, log_exceptions=True)
    except ImportError as error:  # unicorn, or the compiled core
        require(False, str(error))
        raise
    try:
        while not any(machine.read(RESULTS, 4)) and machine.seconds < VIRTUAL_LIMIT:
            machine.run(0.001)
    except RuntimeError as error:
        error.add_note(f"in scenario {[*log_so_far(machine.read)][-1:]}")
        raise
    return machine


# ---- images and logs, made once for each compiler ----


def build(compiler: str, elf: Path) -> Path:
    command = COMPILERS[compiler]
    if compiler == "zig":
        require(importlib.util.find_spec("ziglang") is not None, "ziglang")
    else:
        require(shutil.which(command[0]) is not None, command[0])
    result = subprocess.run(
        [*command, *COMMON, *map(str, SOURCES), "-o", str(elf)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    return elf


@pytest.fixture(scope="module")
def image_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    return functools.cache(
        lambda compiler: build(compiler, tmp_path_factory.mktemp(compiler) / "nvic.elf")
    )


@pytest.fixture(scope="module")
def qemu_log_of(image_of: Callable[[str], Path]) -> Callable[[str], Log]:
    return functools.cache(
        lambda compiler: run_on_qemu(image_of(compiler), image_of(compiler).parent)
    )


@pytest.fixture(scope="module", params=COMPILERS)
def compiler(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def qemu(compiler: str, qemu_log_of: Callable[[str], Log]) -> Log:
    return qemu_log_of(compiler)


@pytest.fixture(scope="module")
def machine(compiler: str, image_of: Callable[[str], Path]) -> Iterator[Machine]:
    with run_on_twin(image_of(compiler)) as machine:
        yield machine


@pytest.fixture(scope="module")
def twin(machine: Machine) -> Log:
    return read_log(machine.read)


# ---- what must hold ----

# By hand, from the architecture's rules (DDI 0403E B1.5.4 priorities and preemption, B1.5.7 stack
# alignment, B1.5.8 exception return and tail-chaining): nested ones in parentheses.
SHAPES = {
    "nesting": "3(5(31(32)))",
    "nesting_of_system_exceptions": "PendSV(SysTick(3(5)))",
    "equal_priorities": "5 3 31 32 50 84",
    "equal_priorities_in_one_write": "8 7 9 30",
    "equal_priorities_system_before_irq": "PendSV SysTick 0",
    "late_arrival": "32 31",
    "tail_chaining": "3 31 5 32",
    "tail_chaining_inside_a_handler": "3(5 31)",
    "pend_itself_in_handler": "3 3 3 3",
    "pended_twice_is_taken_once": "3 5",
    # PRIGROUP 3 (16 groups), 4, 5, 6, 7 (no groups)
    "subpriorities": "3(32 31 5) 3(32 31) 5 3(32 31) 5 3(32) 31 5 3 32 31 5",
    "subpriority_orders_pending": "3 32 31 5",
    "prigroup_changed_while_active": "3(5)",
    "priority_changed_while_active": "3(5) 5",
    "preempted_priority_counts": "3(5) 31",
    "priority_changed_while_pending": "5 31 3",
    "disabled_stays_pending": "3",
    "disabled_in_its_handler": "3 3",
    "disabled_while_pending": "5 3",
    "pending_cleared": "5 SysTick PendSV",
    "cleared_in_its_handler": "3",
    "software_trigger_register": "84 0 50",
    "svc_between_irqs": "SVC(3) 5",
    "svc_from_a_handler": "3(SVC 5)",
    "svc_with_pendsv_pending": "SVC PendSV",
    "pendsv_after_svc": "SVC PendSV SysTick",
    "pendsv_and_systick": "SysTick PendSV PendSV SysTick PendSV SysTick",
    "active_system_exceptions": "PendSV(SysTick(SVC))",
    "basepri_masks_equal_and_lower": "31 5 3",
    "basepri_and_groups": "3 3 5",
    "basepri_in_a_handler": "3(31 5)",
    "basepri_survives_return": "3 5",
    "basepri_below_the_active_priority": "3 5",
    "primask": "3 5",
    "primask_survives_return": "3 5",
    "faultmask": "3",
    "faultmask_ends_with_the_handler": "3 5 31",
    "wfi_under_primask": "3",
    "wfi_until_systick": "SysTick SysTick SysTick",
    "wfi_in_a_handler": "3(SysTick)",
    "core_registers_through_nesting": "3(5(31)) 5(31) 3(5(31))",
    "if_then_blocks": "3 3 3 3 3",
    "process_stack": "3(5) 31",
    "process_stack_and_fpu": "3(5) 31",
    "interrupt_control_and_state": "50(84) 3 PendSV",
    "fpu_nested": "3(5) 3(5) 3(5)",
    "fpu_tail_chained": "3 5 3 5",
    "fpu_context_is_each_handlers_own": "3 5(31) 3",
    "wfi_not_woken_by_basepri": "SysTick 3",
    "exclusive_access": "3",
}

# What the twin does not model, it must refuse at once rather than go on and be wrong: the order
# that it would have to take, and what it says.
REFUSED = {
    "nmi": ("NMI NMI 3", "0xE000ED04: bits 0x80000000 "),  # ICSR
    "nmi_under_faultmask": ("NMI 3", "0xE000ED04: bits 0x80000000 "),
    "unprivileged_thread": ("SVC", "unprivileged"),
    "svc_set_pending": ("3 SVC", "0xE000ED24: bits 0x00008000 "),  # SHCSR
    "fpu_no_stacking": ("3", "ASPEN = 0 is not modelled"),
    "fpu_default_status": ("3", "0xE000EF3C is not modelled"),  # FPDSCR
    "fpu_lazy_state": ("3", "0xE000EF38 is not modelled"),  # FPCAR
    "svc_escalates": ("3(HardFault) HardFault SVC", "HardFault"),
    "undefined_instruction": ("HardFault", "HardFault"),
}


class Deviation(NamedTuple):
    """Where Debian 12's QEMU 7.2 is not an STM32F4: what each of them logs, and why."""

    reason: str
    stm32: list[str]
    qemu: list[str]


DEVIATIONS = {
    "sleep_on_exit": Deviation(
        "SCR.SLEEPONEXIT: a return to thread mode sleeps (DDI 0403E B1.5.17, B3.2.7; DUI 0553A "
        "2.5.1). QEMU ignores the bit, so the thread goes on after the first handler.",
        [
            *("3: enter 0xf9", "3: exit 0x1"),
            *("SysTick: enter 0xf9", "SysTick: exit 0x1"),
            *("SysTick: enter 0xf9", "SysTick: exit 0x2"),
            "thread: thread 0x2",
        ],
        [
            *("3: enter 0xf9", "3: exit 0x1"),
            "thread: thread 0x0",
            *("SysTick: enter 0xf9", "SysTick: exit 0x1"),
            *("SysTick: enter 0xf9", "SysTick: exit 0x2"),
        ],
    ),
    "wfi_not_woken_by_basepri": Deviation(
        "What BASEPRI masks does not end WFI, only PRIMASK is left aside (DDI 0403E B1.5.19, DUI "
        "0553A 2.5.2). WFI is a hint and may end early: QEMU's does.",
        [
            *("SysTick: enter 0xf9", "SysTick: exit 0x1"),
            "thread: awake 0x1",
            *("3: enter 0xf9", "3: exit 0x1"),
        ],
        [
            "thread: awake 0x0",
            *("SysTick: enter 0xf9", "SysTick: exit 0x1"),
            *("3: enter 0xf9", "3: exit 0x1"),
        ],
    ),
    "vectpending_under_basepri": Deviation(
        "ICSR.VECTPENDING includes the effect of BASEPRI (DDI 0403E B3.2.4, DUI 0553A 4.3.3). "
        "QEMU's does not.",
        [
            *("thread: vectpending 0x0", "thread: isrpending 0x1"),
            *("3: enter 0xf9", "3: exit 0x1"),
        ],
        [
            *("thread: vectpending 0x13", "thread: isrpending 0x1"),
            *("3: enter 0xf9", "3: exit 0x1"),
        ],
    ),
    "priority_bits": Deviation(
        "How many bits a priority has is up to the implementation (DDI 0403E B1.5.4): the upper "
        "four in an STM32F4 (PM0214), all eight in QEMU 7.2.",
        ["thread: ipr 0xf0", "thread: shpr 0x90"],
        ["thread: ipr 0xff", "thread: shpr 0x9f"],
    ),
    "basepri_of_other_bits": Deviation(
        "The same for BASEPRI: in an STM32F4 its lower four bits do not exist, so 0x0F is 0 and "
        "masks nothing. QEMU 7.2 masks all but the highest priority.",
        ["3: enter 0xf9", "3: exit 0x1", "thread: pending 0x0"],
        ["thread: pending 0x8", "3: enter 0xf9", "3: exit 0x1"],
    ),
}


def test_every_scenario_is_in_the_log(qemu: Log, twin: Log) -> None:
    assert len(SCENARIOS) > 60
    assert [*qemu] == SCENARIOS
    assert [*twin] == SCENARIOS
    assert {*SHAPES, *DEVIATIONS} <= {*SCENARIOS}
    assert {*REFUSED} == {*BEYOND}


@pytest.mark.parametrize("scenario", [one for one in SCENARIOS if one not in DEVIATIONS])
def test_twin_agrees_with_qemu(scenario: str, qemu: Log, twin: Log) -> None:
    assert qemu[scenario]
    found = difference(qemu[scenario], twin[scenario])
    assert not found, f"\n{found}"


@pytest.mark.parametrize("scenario", SHAPES)
def test_order_is_the_architectures(scenario: str, qemu: Log, twin: Log) -> None:
    assert shape(qemu[scenario]) == SHAPES[scenario]
    assert shape(twin[scenario]) == SHAPES[scenario]


@pytest.mark.parametrize("scenario", DEVIATIONS)
def test_known_deviation_of_qemu(scenario: str, qemu: Log, twin: Log) -> None:
    deviation = DEVIATIONS[scenario]
    assert [*map(str, twin[scenario])] == deviation.stm32, deviation.reason
    # a later QEMU may have got it right
    assert [*map(str, qemu[scenario])] in (deviation.qemu, deviation.stm32), deviation.reason


@pytest.mark.parametrize("scenario", REFUSED)
def test_what_is_not_modelled_is_refused(
    scenario: str, image_of: Callable[[str], Path], tmp_path: Path
) -> None:
    everything = image_of("zig").read_bytes()
    assert everything.count(ONLY + NONE) == 1
    index = struct.pack("<I", BEYOND.index(scenario))
    image = tmp_path / "one.elf"
    image.write_bytes(everything.replace(ONLY + NONE, ONLY + index))
    order, refusal = REFUSED[scenario]
    log = run_on_qemu(image, tmp_path)
    assert [*log] == [scenario]
    assert shape(log[scenario]) == order
    with pytest.raises(RuntimeError, match=refusal):
        run_on_twin(image)


def test_exception_log_is_what_the_handlers_saw(machine: Machine, twin: Log) -> None:
    before = itertools.takewhile(lambda scenario: scenario != "asynchronous", SCENARIOS)
    entries = itertools.chain.from_iterable(twin[scenario] for scenario in before)
    seen = [(e.exception, e.label == "exit") for e in entries if e.label in {"enter", "exit"}]
    log = machine.exception_log
    logged = [(int(one["number"]), int(one["kind"]) == 2) for one in log[: len(seen)]]
    assert len(seen) > 200
    assert logged == seen
    assert (log["time"][1:] >= log["time"][:-1]).all()


def test_nothing_is_lost_to_an_interrupt_at_any_instruction(twin: Log) -> None:
    for scenario in ("asynchronous", "asynchronous_with_fpu"):
        noted = {entry.label: entry.value for entry in twin[scenario]}
        assert noted["wrong"] == 0
        assert noted["lost"] == 0
        assert noted["taken"] == 50


def test_random_sequences_meet_much(qemu: Log) -> None:
    sequences = [entries for scenario, entries in qemu.items() if scenario.startswith("random_")]
    assert len(sequences) == 8
    shapes = [shape(entries) for entries in sequences]
    assert len(set(shapes)) == len(shapes)
    entries = [entry for sequence in sequences for entry in sequence]
    entered = {entry.exception for entry in entries if entry.label == "enter"}
    assert {11, 14, 15} < entered
    assert len(entered) == 15  # and twelve interrupts
    returns = {entry.value for entry in entries if entry.label == "enter"}
    assert returns == {0xE1, 0xE9, 0xF1, 0xF9}  # thread and nested, with and without FPU
    steps = (1 if entry.label == "enter" else -(entry.label == "exit") for entry in entries)
    depths = [*itertools.accumulate(steps)]
    assert max(depths) >= 4
    assert depths[-1] == 0


def test_a_wrong_order_is_a_difference(qemu: Log) -> None:
    entries = qemu["equal_priorities"]
    assert not difference(entries, [*entries])
    # two handlers in the other order
    swapped = [*entries[:2], *entries[4:6], *entries[2:4], *entries[6:]]
    found = difference(entries, swapped)
    assert "\n-31: enter 0xf9" in found
    assert "\n+31: enter 0xf9" in found
    assert shape(swapped) == "5 31 3 32 50 84"
    # nested instead of one after the other; only a value; too short
    nested = [entries[0], *entries[2:4], entries[1], *entries[4:]]
    assert difference(entries, nested)
    assert shape(nested).startswith("5(3) 31")
    assert difference(entries, [entries[0]._replace(value=0xE9), *entries[1:]])
    assert difference(entries, entries[:-1])
    assert difference(entries, [])


def test_both_compilers_images_log_the_same(qemu_log_of: Callable[[str], Log]) -> None:
    """What is logged is up to the processor alone, not to how C was compiled."""
    gcc, zig = map(qemu_log_of, COMPILERS)
    assert gcc == zig


def test_what_is_missing_is_skipped_but_fails_in_ci(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CI", raising=False)
    require(True, "a tool")
    with pytest.raises(pytest.skip.Exception, match="a tool is missing"):
        require(False, "a tool")
    monkeypatch.setenv("CI", "true")
    require(True, "a tool")
    with pytest.raises(pytest.fail.Exception, match="and this is CI"):
        require(False, "a tool")
