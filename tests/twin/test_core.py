"""Small programs on the machine: what the hardware would do, to the cycle."""

from __future__ import annotations

import shutil
import struct
import subprocess
import sys
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from twin.machine import TICKS_PER_CYCLE, Machine, MachineError, TimingViolation

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    Build = Callable[..., Machine]

PRELUDE = r"""
typedef unsigned u32; typedef unsigned char u8;
#define R(a) (*(volatile u32 *)(a))
#define RCC(o) R(0x40023800 + (o))
#define TIM(n, o) R(0x40000000 + 0x400 * ((n) - 2) + (o))
#define GPIO(p, o) R(0x40020000 + 0x400 * ((p) - 'A') + (o))
#define SPI(n, o) R(0x40003800 + 0x400 * ((n) - 2) + (o))
#define DMA(n, o) R(0x40026000 + 0x400 * ((n) - 1) + (o))
#define ADC(o) R(0x40012000 + (o))
enum {CR1 = 0, CR2 = 4, SMCR = 8, DIER = 12, SR = 16, EGR = 20, CCMR1 = 24, CCMR2 = 28, CCER = 32,
      CNT = 36, PSC = 40, ARR = 44, CCR1 = 52, CCR2 = 56, CCR3 = 60, CCR4 = 64};
volatile u32 out[64];
static volatile u8 bytes[64];
static inline void clock84(void) {
    R(0x40023C00) = 0x702;
    RCC(0x04) = 16 | 336 << 6 | 1 << 16;
    RCC(0x00) |= 1 << 24;
    while (!(RCC(0x00) & 1 << 25)) {}
    RCC(0x08) = 4 << 10 | 2;
    while ((RCC(0x08) & 12) != 8) {}
    RCC(0x30) = 7 | 1 << 12 | 1 << 21 | 1 << 22;
    RCC(0x40) = 15 | 1 << 14 | 1 << 15;
    RCC(0x44) = 1 << 8 | 1 << 14;
}
static inline void alternate(u32 port, u32 pin, u32 af) {
    GPIO(port, pin < 8 ? 0x20 : 0x24) |= af << 4 * (pin % 8);
    GPIO(port, 0) = (GPIO(port, 0) & ~(3u << 2 * pin)) | 2u << 2 * pin;
}
static inline void enable(u32 irq, u32 priority) {
    ((volatile u8 *)0xE000E400)[irq] = priority << 4;
    R(0xE000E100 + irq / 32 * 4) = 1u << irq % 32;
}
static inline void wfi(void) { __asm__ volatile("wfi" ::: "memory"); }
static inline void rest(void) { for (;;) wfi(); }
"""
LINKER = """
SECTIONS {
  . = 0x08000000; .text : { KEEP(*(.vectors)) *(.text*) *(.rodata*) } :code
  /DISCARD/ : { *(.ARM.exidx*) *(.ARM.attributes) *(.comment) }
  . = 0x20000000; .bss : { *(.bss*) *(COMMON) } :ram
}
PHDRS { code PT_LOAD; ram PT_LOAD; }
"""


@pytest.fixture
def build(tmp_path: Path) -> Build:
    """Compile ``void reset(void)`` and handlers by exception number; a machine with it."""

    def make(code: str, handlers: dict[int, str] | None = None, **options: Any) -> Machine:
        names = {1: "reset", **(handlers or {})}
        entries = ", ".join(f"[{n}] = (void *){name}" for n, name in names.items())
        table = f"""__attribute__((section(".vectors"), used))
            static void *const vectors[101] = {{(void *)0x20018000, {entries}}};"""
        (tmp_path / "a.c").write_text(PRELUDE + code + table)
        (tmp_path / "a.ld").write_text(LINKER)
        if compiler := shutil.which("arm-none-eabi-gcc"):  # starts faster
            command = [compiler, "-mcpu=cortex-m4", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16"]
        else:
            command = [sys.executable, "-m", "ziglang", "cc", "-fno-sanitize=all"]
            command += ["-target", "thumb-freestanding-eabihf", "-mcpu=cortex_m4+vfp4d16sp"]
        command += ["-O1", "-w", "-nostdlib", "-ffreestanding", "-Wl,-T,a.ld", "-Wl,-e,reset"]
        subprocess.run([*command, "a.c", "-o", "a.elf"], cwd=tmp_path, check=True)
        return Machine(tmp_path / "a.elf", **options)

    return make


def out(machine: Machine, count: int = 64) -> list[int]:
    return list(struct.unpack(f"<{count}I", machine.read(machine.symbol("out"), 4 * count)))


# --- core ----------------------------------------------------------------------------------------
def test_cycles_and_clock(build: Build) -> None:
    m = build("""
    void reset(void) {
        clock84();
        R(0xE000EDFC) = 1 << 24; R(0xE0001000) = 1;
        u32 before = R(0xE0001004);
        __asm__ volatile("nop\\n nop\\n nop\\n nop\\n nop\\n nop\\n nop\\n nop\\n nop\\n nop");
        out[0] = R(0xE0001004) - before;
        before = R(0xE0001004);
        for (u32 i = 0; i < 1000; i++) __asm__ volatile("");
        out[1] = R(0xE0001004) - before;
        rest();
    }""")
    m.run(1e-3)
    assert out(m)[0] == 12  # and the load
    assert 3000 <= out(m)[1] <= 4100
    assert m.time == 84_000


ORDER = """
static volatile u32 n;
static void low(void) { out[n++] = 1; R(0xE000E200) = 2 << 6; out[n++] = 2; }
static void high(void) {
    static volatile u32 again;
    out[n++] = 3; R(0xE000E200) = (again++ ? 0 : 1 << 6) | 4 << 6; out[n++] = 4;
}
static void other(void) { out[n++] = 5; }
static void svc(void) { out[n++] = 6; }
static void pendsv(void) { out[n++] = 7; }
void reset(void) {
    enable(6, 8); enable(7, 4); enable(8, 4);
    R(0xE000ED20) = 0xF0 << 16;
    R(0xE000E200) = 1 << 6;
    __asm__ volatile("nop\\n nop");
    __asm__ volatile("svc 0");
    R(0xE000ED04) = 1 << 28;
    __asm__ volatile("nop\\n nop\\n cpsid i");
    R(0xE000E200) = 4 << 6;
    out[n++] = 8;
    wfi();
    out[n++] = 9;
    __asm__ volatile("cpsie i\\n nop");
    out[n++] = 10;
    rest();
}"""


def test_exceptions_nest_and_chain(build: Build) -> None:
    handlers = {22: "low", 23: "high", 24: "other", 11: "svc", 14: "pendsv"}
    m = build(ORDER, handlers, log_exceptions=True)
    m.run(1e-3)
    # the low one is pended again within the high one: it follows by tail-chain
    assert out(m)[:16] == [1, 3, 4, 5, 2, 1, 3, 4, 5, 2, 6, 7, 8, 9, 5, 10]
    log = m.exception_log
    kinds = [(int(e["number"]), int(e["kind"])) for e in log[:8]]
    first = [(22, 0), (23, 0), (23, 2), (24, 1), (24, 2), (22, 2)]
    assert kinds == [*first, (22, 1), (23, 0)]
    tail = log[3]["time"] - log[2]["time"]
    assert tail in (31, 32)  # 6 cycles of 16 MHz in cycles of 84 MHz


def test_masked_interrupt_wakes_but_waits(build: Build) -> None:
    m = build(
        """
    static void handler(void) { out[2] = out[1]; }
    void reset(void) {
        enable(6, 8);
        __asm__ volatile("cpsid i");
        R(0xE000E200) = 1 << 6;
        wfi();
        out[1] = 5;
        __asm__ volatile("cpsie i");
        out[3] = out[2];
        rest();
    }""",
        {22: "handler"},
    )
    m.run(1e-4)
    assert out(m)[1:4] == [5, 5, 5]


def test_floating_point_is_stacked(build: Build) -> None:
    code = """
    static void handler(void) {
        u32 lr; __asm__ volatile("mov %0, lr" : "=r"(lr)); out[0] = lr;
        __asm__ volatile("vmov.f32 s0, #2.0\\n vmov.f32 s15, #2.0" ::: "s0", "s15");
    }
    void reset(void) {
        CPACR
        enable(6, 8);
        u32 a, b;
        __asm__ volatile("vmov.f32 s0, #1.0\\n vmov.f32 s15, #3.0" ::: "s0", "s15");
        R(0xE000E200) = 1 << 6;
        __asm__ volatile("nop\\n nop\\n vmov %0, s0\\n vmov %1, s15" : "=r"(a), "=r"(b));
        out[1] = a; out[2] = b;
        rest();
    }"""
    m = build(code.replace("CPACR", "R(0xE000ED88) = 15 << 20;"), {22: "handler"})
    m.run(1e-4)
    assert out(m)[:3] == [0xFFFFFFE9, 0x3F800000, 0x40400000]
    with pytest.raises(MachineError, match="FPU off"):
        build(code.replace("CPACR", ""), {22: "handler"}).run(1e-4)


def test_systick(build: Build) -> None:
    m = build(
        """
    static void tick(void) { out[0]++; }
    void reset(void) {
        clock84();
        R(0xE000E014) = 42000 - 1; R(0xE000E018) = 0; R(0xE000E010) = 7;
        rest();
    }""",
        {15: "tick"},
        log_exceptions=True,
    )
    m.run(0.0101)
    entries = m.exception_log[m.exception_log["kind"] == 0]["time"]
    assert set(np.diff(entries.astype(int))) == {42_000}
    assert out(m)[0] == len(entries) == 19


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("TIM(2, CR1) = 1;", r"TIM2_CR1: its clock is not enabled"),
        ("out[0] = R(0);", "0x00000000, 4 bytes: a null pointer"),
        ("R(8) = 1;", "null pointer"),
        ("R(0x08000100) = 1;", "write to flash at 0x08000100"),
        ("((void (*)(void))0x10000001)();", "execution outside"),
        ("((void (*)(void))1)();", "null pointer"),
        ("out[0] = R(0x20018000);", "read from unmapped 0x20018000"),
        ("clock84(); TIM(2, CR1) = 1 << 4;", r"TIM2_CR1: bits 0x00000010"),
        ("clock84(); TIM(2, 0x48) = 0;", r"TIM2_DCR is not modelled"),
        ("clock84(); RCC(0x20) = 1; TIM(2, CR1) = 1;", "TIM2_CR1: RCC holds it in reset"),
        ("R(0x40023C00) = 0; clock84(); R(0x40023C00) = 1;", "wait states are too few"),
        ("clock84(); DMA(1, 0x58) = 1 << 6;DMA(1, 0x58) |= 1;", "NDTR = 0"),
        ("R(0xE000E100) = 0; R(0xE000ED94) = 1;", "0xE000ED94 is not modelled"),
        ("__asm__ volatile(\"udf #0\");", "PC 0x0800"),
        ("__asm__ volatile(\"bkpt #0\");", "BKPT"),
        ("__asm__ volatile(\"wfe\");", "WFE"),
        ("__asm__ volatile(\"cpsid i\\nsvc 0\");", "HardFault"),
        ("u32 f = 0; for (;;) { f++; __asm__ volatile(\"push {r0-r7}\"); }", "unmapped"),
    ],
)  # fmt: skip
def test_what_hardware_would_not_forgive(build: Build, code: str, message: str) -> None:
    m = build(f"void reset(void) {{ {code} rest(); }}")
    with pytest.raises(MachineError, match=message):
        m.run(1e-2)
    with pytest.raises(MachineError, match=message):
        m.run(1e-3)


def test_reset_keeps_ram_and_time(build: Build) -> None:
    m = build("void reset(void) { out[0]++; clock84(); TIM(2, CR1) = 1; rest(); }")
    m.run(1e-3)
    m.reset()
    m.run(1e-3)
    assert out(m)[0] == 2
    assert m.time == 168_000


def test_two_machines_do_not_know_each_other(build: Build) -> None:
    code = "void reset(void) { for (;;) out[0]++; }"
    a = build(code)
    b = build(code)
    a.run(1e-3)
    assert out(b)[0] == 0
    b.run(1e-3)
    assert out(a) == out(b)


# --- timers --------------------------------------------------------------------------------------
def test_pwm_edges(build: Build) -> None:
    m = build(
        """
    void reset(void) {
        clock84();
        alternate('A', 1, 1); alternate('A', 0, 2);
        TIM(2, PSC) = 20; TIM(2, ARR) = 99; TIM(2, CCR2) = 8;
        TIM(2, CCMR1) = 0x6800; TIM(2, CCER) = 0x10; TIM(2, CR1) = 0x80; TIM(2, EGR) = 1;
        TIM(5, PSC) = 20; TIM(5, ARR) = 999; TIM(5, CCR1) = 20;
        TIM(5, CCMR1) = 0x78; TIM(5, CCER) = 0x3; TIM(5, EGR) = 1;
        TIM(2, CR1) |= 1; TIM(5, CR1) = 1;
        while (TIM(2, CNT) < 50) {}
        TIM(2, CCR2) = 16; /* preloaded: from the next period on */
        out[0] = TIM(2, SR);
        rest();
    }""",
        record=True,
    )
    m.run(2e-3)
    sh = m.edges("PA1")
    times, levels = sh["time"].astype(int), sh["level"]
    assert levels.tolist()[:4] == [1, 0, 1, 0]
    assert set(np.diff(times[levels == 1][1:])) == {2100}
    assert set(times[levels == 0][1:] - times[levels == 1][1 : (levels == 0).sum()]) == {16 * 21}
    icg = m.edges("PA0")["time"].astype(int)
    assert set(np.diff(icg[1:])) == {20 * 21, 980 * 21}
    assert out(m)[0] & 1
    assert out(m)[0] & 4


def test_trigger_mode_and_compare_as_trigger(build: Build) -> None:
    m = build(
        """
    void reset(void) {
        clock84();
        alternate('A', 1, 1); alternate('A', 0, 2); alternate('B', 0, 2); alternate('B', 9, 2);
        TIM(3, ARR) = 20; TIM(3, CCR3) = 10; TIM(3, CCMR2) = 0x70; TIM(3, CCER) = 0x100;
        TIM(3, EGR) = 1; TIM(3, CR1) = 1;
        TIM(2, PSC) = 20; TIM(2, ARR) = 99; TIM(2, CCR1) = 16; TIM(2, CCR2) = 8;
        TIM(2, CCMR1) = 0x6070; TIM(2, CCER) = 0x10; TIM(2, EGR) = 1;
        TIM(5, PSC) = 20; TIM(5, ARR) = 999; TIM(5, CCR1) = 20; TIM(5, CCMR1) = 0x60;
        TIM(5, CCER) = 1; TIM(5, EGR) = 1;
        TIM(2, CR2) = 4 << 4;
        TIM(2, SMCR) = 2 << 4 | 6;
        TIM(5, SMCR) = 1 << 4 | 6;
        TIM(4, ARR) = 83; TIM(4, CCR4) = 42; TIM(4, CCMR2) = 0x7000; TIM(4, CCER) = 0x1000;
        TIM(4, SMCR) = 1 << 4 | 6;
        TIM(3, CR2) = 2 << 4;
        rest();
    }""",
        record=True,
        record_clocks=True,
    )
    m.run(1e-3)
    fm, sh, icg, adc = (m.edges(pin) for pin in ("PB0", "PA1", "PA0", "PB9"))
    start = int(sh[sh["level"] == 0]["time"][0]) - 8 * 21
    assert int(icg[icg["level"] == 0]["time"][0]) - 20 * 21 == start
    # both start two cycles after an update of the 4 MHz timer, where its output is low
    assert (start - 2) in fm[fm["level"] == 0]["time"]
    assert set(np.diff(fm[fm["level"] == 1]["time"].astype(int))) == {21}
    first = int(adc[adc["level"] == 1]["time"][0])
    assert first == start + 16 * 21 + 2 + 42
    assert set(np.diff(adc[adc["level"] == 1]["time"].astype(int))) == {84}


def test_timer_flags_catch_up(build: Build) -> None:
    m = build("""
    void reset(void) {
        clock84();
        TIM(3, ARR) = 999; TIM(3, CCR1) = 500; TIM(3, CCR2) = 2000; TIM(3, EGR) = 1;
        TIM(3, SR) = 0; TIM(3, CR1) = 1;
        while (TIM(3, CNT) < 300) {}
        out[0] = TIM(3, SR);
        while (TIM(3, CNT) < 600) {}
        out[1] = TIM(3, SR);
        for (int i = 0; i < 10000; i++) __asm__ volatile("");
        out[2] = TIM(3, SR);
        TIM(3, SR) = 0; TIM(3, CR1) = 0;
        out[3] = TIM(3, CNT); for (int i = 0; i < 100; i++) __asm__ volatile("");
        out[4] = TIM(3, CNT); out[5] = TIM(3, SR);
        rest();
    }""")
    m.run(2e-3)
    assert out(m)[:3] == [0, 2, 0b11011]
    assert out(m)[3] == out(m)[4]
    assert out(m)[5] == 0


# --- DMA, CRC ------------------------------------------------------------------------------------
def test_crc_by_cpu_and_by_dma(build: Build) -> None:
    m = build(
        """
    static void done(void) { out[3] = DMA(2, 0) >> 6 & 0x3D; DMA(2, 8) = 0x3D << 6; }
    static volatile u32 data[100];
    void reset(void) {
        clock84();
        R(0x40023008) = 1; R(0x40023000) = 0x12345678; out[0] = R(0x40023000);
        R(0x40023008) = 1; out[1] = R(0x40023000);
        for (u32 i = 0; i < 100; i++) { data[i] = i * 0x01010101; R(0x40023000) = data[i]; }
        out[1] = R(0x40023000);
        R(0x40023008) = 1;
        enable(57, 1);
        DMA(2, 0x28) = 0; DMA(2, 0x2C) = 100; DMA(2, 0x30) = (u32)data;
        DMA(2, 0x34) = 0x40023000; DMA(2, 0x3C) = 7;
        DMA(2, 0x28) = 2 << 6 | 1 << 9 | 2 << 11 | 2 << 13 | 0x10 | 1;
        wfi();
        out[2] = R(0x40023000);
        rest();
    }""",
        {73: "done"},
    )
    m.run(1e-3)
    first, cpu, dma, flags = out(m)[:4]
    assert first == 0xDF8A8A2B
    assert cpu == dma != 0xFFFFFFFF
    assert flags == 0x30


SPI = """
static volatile u8 sent[8], got[8];
static void dma(u32 tx) {
    DMA(1, 0x58) = 0; DMA(1, 0x70) = 0;
    DMA(1, 8) = 0x3D << 22; DMA(1, 12) = 0x3D;
    DMA(1, 0x5C) = 4; DMA(1, 0x60) = 0x4000380C; DMA(1, 0x64) = (u32)got;
    DMA(1, 0x58) = 1 << 8 | 1 << 10 | 1;
    DMA(1, 0x74) = 4; DMA(1, 0x78) = 0x4000380C; DMA(1, 0x7C) = (u32)sent;
    DMA(1, 0x70) = 1 << 8 | 1 << 10 | 1 << 6 | 1;
}
static void setup(void) {
    clock84();
    alternate('B', 13, 5); alternate('B', 14, 5); alternate('B', 15, 5);
    for (u32 i = 0; i < 4; i++) sent[i] = 0x10 + i;
}
"""


def test_spi_slave_fetches_ahead(build: Build) -> None:
    m = build(
        SPI
        + """
    void reset(void) {
        setup(); dma(0);
        SPI(2, CR2) = 3; SPI(2, CR1) = 0x240;
        for (;;) {
            while (!(DMA(1, 0) & 1 << 27)) {}
            DMA(1, 8) = 0x3D << 22;
            for (u32 i = 0; i < 4; i++) { sent[i] += 0x10; out[i] = got[i]; }
        }
    }"""
    )
    m.run(1e-3)
    assert m.transfer(b"\x01\x02\x03\x04", 1e6).hex() == "10111213"
    m.run(1e-4)
    assert out(m)[:4] == [1, 2, 3, 4]
    # one stale byte is in the transmit buffer, one the DMA stream has read in advance
    assert m.transfer(bytes(4), 1e6).hex() == "10112223"
    m.run(1e-4)
    assert m.transfer(bytes(2), 1e6).hex() == "2021"
    assert m.transfer(bytes(2), 15.6e6).hex() == "3233"


def test_spi_slave_overrun_and_underrun(build: Build) -> None:
    m = build(
        SPI
        + """
    void reset(void) {
        setup();
        SPI(2, 12) = 0x55; SPI(2, CR1) = 0x240;
        while (!(SPI(2, 8) & 0x40)) {}
        out[0] = SPI(2, 8); out[1] = SPI(2, 12); out[2] = SPI(2, 8); out[3] = SPI(2, 8);
        rest();
    }"""
    )
    m.run(1e-3)
    assert m.transfer(b"\xaa\xbb\xcc", 1e6).hex() == "555555"
    m.run(1e-4)
    assert out(m)[0] & 0x41 == 0x41
    assert out(m)[1] == 0xAA
    assert out(m)[2] & 0x40
    assert not out(m)[3] & 0x40


def test_spi_slave_enabled_within_a_byte_stays_shifted(build: Build) -> None:
    m = build(
        SPI
        + """
    void reset(void) {
        setup(); dma(0);
        SPI(2, CR2) = 3;
        TIM(5, PSC) = 83; TIM(5, EGR) = 1; TIM(5, CR1) = 1;
        while (TIM(5, CNT) < 1003) {}
        SPI(2, CR1) = 0x240;
        while (DMA(1, 0x5C) != 2) {}
        out[0] = got[0]; out[1] = got[1];
        rest();
    }"""
    )
    m.run(1e-3)
    begin = m.seconds  # the program sleeps in none of this
    assert begin == pytest.approx(1e-3, abs=1e-6)
    rx = m.transfer(b"\x12\x34\x56\x78" * 40, 1e6)
    m.run(1e-4)
    stream = int.from_bytes(b"\x12\x34\x56\x78" * 40, "big")
    bits = f"{stream:0{1280}b}"
    said = f"{int.from_bytes(rx, 'big'):0{1280}b}"
    at = said.index("0001000000010001")
    assert at % 8 != 0
    assert out(m)[:2] == [int(bits[at : at + 8], 2), int(bits[at + 8 : at + 16], 2)]


def test_exti(build: Build) -> None:
    m = build(
        """
    static void edge(void) { out[0]++; R(0x40013C14) = 1 << 13; }
    void reset(void) {
        clock84();
        R(0x40013814) = 1 << 4; R(0x40013C08) = 1 << 13; R(0x40013C00) = 1 << 13;
        enable(40, 1);
        rest();
    }""",
        {56: "edge"},
    )
    m.run(1e-3)
    for level in (True, False, True, True, False):
        m.drive("PB13", level)
        m.run(1e-5)
    assert out(m)[0] == 2
    m.transfer(b"\0", 1e5)  # the link's clock is on the same pin
    assert out(m)[0] == 3


def test_chain_of_shift_registers(build: Build) -> None:
    rates = np.zeros((65, 3648))
    rates[1 + 6, 0] = rates[1 + 63, 1] = 1e6
    m = build(
        """
    void reset(void) {
        clock84();
        alternate('C', 10, 6); alternate('C', 12, 6);
        GPIO('C', 0x18) = 1 << 2;
        GPIO('C', 0) |= 1 << 4 | 1 << 6;
        SPI(3, CR1) = 0x344 | 1 << 3;
        u8 pattern[8] = {0x02, 0, 0, 0, 0, 0, 0, 0x01};
        for (u32 i = 0; i < 8; i++) { while (!(SPI(3, 8) & 2)) {} SPI(3, 12) = pattern[i]; }
        while (SPI(3, 8) & 0x80) {}
        GPIO('C', 0x18) = 1 << 3;
        GPIO('C', 0x18) = 1 << 18;
        TIM(5, ARR) = 8399; TIM(5, EGR) = 1; TIM(5, SR) = 0; TIM(5, CR1) = 1;
        while (!(TIM(5, SR) & 1)) {}
        GPIO('C', 0x18) = 1 << 2;
        rest();
    }""",
        rates=rates,
    )
    m.run(1e-3)
    # channel 6 is the last bit in, channel 63 came 57 bits before it
    assert m.charge[0] == pytest.approx(100, rel=0.02)
    assert m.charge[1] == m.charge[0]
    assert not m.charge[2:].any()


# --- sensor --------------------------------------------------------------------------------------
def brute_force(
    rates: np.ndarray[Any, Any], events: list[tuple[int, str, bool]], fraction: float, well: float
) -> np.ndarray[Any, Any]:
    charge, lit, last = np.zeros(rates.shape[1]), np.zeros(65, bool), 0
    lit[0] = True
    for time, what, level in events:
        charge += rates[lit].sum(0) * ((time - last) / 84e6)
        last = time
        if what == "SH":
            if level:  # the pin is inverted: it rises where SH falls
                charge = np.minimum(charge, well)
                charge *= 1 - fraction
        else:
            lit[1 + int(what)] = level
    clipped: np.ndarray[Any, Any] = np.minimum(charge, well)
    return clipped


@pytest.mark.parametrize("bright", [1e6, 4e8, 3e9])
def test_charge_is_that_of_every_pixel_on_its_own(build: Build, bright: float) -> None:
    random = np.random.default_rng(1)
    rates = random.uniform(0, bright, (65, 3648))
    rates[0] *= 1e-3
    fraction, well = 0.46, 50_000.0
    m = build("void reset(void) { rest(); }", rates=rates, transfer_fraction=fraction,
              full_well=well)  # fmt: skip
    pins = {"SH": 1, **{str(k): 32 + 4 + k for k in range(6)}}
    # the pins are low at first: SH is high at the sensor
    events: list[tuple[int, str, bool]] = []
    time, levels = 0, dict.fromkeys(pins, False)
    for _ in range(400):
        time += int(random.integers(1, 3000))
        what = str(random.choice(list(pins), p=[0.4, *[0.1] * 6]))
        levels[what] = not levels[what]
        events.append((time, what, levels[what]))
    saturated = 0
    for i, (when, what, level) in enumerate(events):
        m._core.twin_pin_at(m._machine, when * TICKS_PER_CYCLE, pins[what], level)
        if i % 20 == 0:
            expected = brute_force(rates, events[: i + 1], fraction, well)
            np.testing.assert_allclose(m.charge, expected, rtol=1e-9, atol=1e-6)
            saturated += int((expected >= well).sum())
    assert (saturated > 0) == (bright > 1e6)


READOUT = """
void reset(void) {
    clock84();
    alternate('A', 1, 1); alternate('A', 0, 2); alternate('B', 0, 2); alternate('B', 9, 2);
    GPIO('C', 0) |= 3;
    R(0x40012304) = 1 << 16; ADC(0x34) = 10; ADC(8) = 1;
    TIM(3, ARR) = FM - 1; TIM(3, CCR3) = FM / 2; TIM(3, CCMR2) = FM_MODE; TIM(3, CCER) = 0x100;
    TIM(3, EGR) = 1;
    TIM(2, PSC) = 20; TIM(2, ARR) = SH - 1; TIM(2, CCR2) = WIDTH; TIM(2, CCMR1) = 0x6800;
    TIM(2, CCER) = 0x30; TIM(2, EGR) = 1; TIM(2, CNT) = SH - DELAY;
    TIM(5, PSC) = 20; TIM(5, ARR) = ICG - 1; TIM(5, CCR1) = PULSE; TIM(5, CCMR1) = 0x60;
    TIM(5, CCER) = 1; TIM(5, EGR) = 1;
    TIM(4, ARR) = 83; TIM(4, CCR4) = 42; TIM(4, CCMR2) = 0x7000; TIM(4, CCER) = 0x1000;
    TIM(4, EGR) = 1;
    TIM(2, SMCR) = 2 << 4 | 6; TIM(5, SMCR) = 1 << 4 | 6;
    TIM(3, CR1) = 1; TIM(3, CR2) = 2 << 4;
    for (u32 i = 0; i < 3; i++) { TIM(5, SR) = 0; while (!(TIM(5, SR) & 2)) {} }
    ADC(8) = 1 | 9 << 24 | 1 << 28;
    TIM(4, CR1) = 1;
    u32 previous = 0;
    for (u32 i = 0; i < 60; i++) {
        while (!(ADC(0) & 2)) {}
        out[i] = ADC(0x4C);
    }
    TIM(4, CR1) = 0;
    rest();
}
"""
GOOD: dict[str, object] = {
    "FM": 21, "FM_MODE": "0x70", "SH": 100, "WIDTH": 8, "DELAY": 2, "ICG": 20000, "PULSE": 20
}  # fmt: skip


def readout(build: Build, changes: dict[str, object], **options: Any) -> Machine:
    defines = "".join(f"#define {k} {v}\n" for k, v in {**GOOD, **changes}.items())
    # what the sensor sees is inverted: PWM polarity as in the 74HC04's absence is done by CCER
    return build(defines + READOUT, **options)


def test_readout(build: Build) -> None:
    charges = []
    rates = np.zeros((65, 3648))
    rates[0] = np.arange(3648) * 1e3

    def digitise(charge: np.ndarray[Any, Any], time: int) -> np.ndarray[Any, Any]:
        charges.append((charge.copy(), time))
        return np.append(np.arange(3694), 4000)

    m = readout(build, {}, rates=rates, digitise=digitise, transfer_fraction=0.5, record=True)
    m.run(0.021)
    assert len(charges) == 1
    charge, time = charges[0]
    assert time in m.edges("PA1")["time"]
    # shuttered for long: what an SH pulse takes is what one period brings
    np.testing.assert_allclose(charge, rates[0] * 25e-6, rtol=1e-9)
    values = out(m)[:60]
    first = values[0]
    assert values == list(range(first, first + 60))
    start = m.readouts[m.readouts["sampled"] == 1]["start"][0]
    hold = m.edges("ADC")["time"][1]
    assert first == (int(hold) - int(start)) // 84
    # before the first ICG's period is complete, nothing is as it should be; then all is
    assert {v.time for v in m.violations} <= set(range(int(m.readouts["start"][1]) + 1))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"FM": 20}, "fM outside"),
        ({"FM": 110, "FM_MODE": "0x70"}, "fM outside"),
        ({"WIDTH": 3}, "t3"),
        ({"DELAY": 11, "PULSE": 30}, "t2"),
        ({"PULSE": 11}, "t1"),
        ({"SH": 30, "ICG": 19980}, "integration"),
        ({"SH": 130}, "divide"),
        ({"FM_MODE": "0x60"}, "t4"),
    ],
)
def test_limits_of_the_datasheet(build: Build, changes: dict[str, object], message: str) -> None:
    m = readout(build, changes)
    with pytest.raises(TimingViolation, match=message):
        m.run(0.03)
    assert m.violations


def test_exceptions_of_callbacks_come_through(build: Build) -> None:
    def digitise(_charge: np.ndarray[Any, Any], _time: int) -> np.ndarray[Any, Any]:
        raise KeyError("so")

    m = readout(build, {}, digitise=digitise)
    with pytest.raises(KeyError, match="so"):
        m.run(0.03)


def test_moving_world_is_asked(build: Build) -> None:
    times = []
    rates = np.zeros((65, 3648))

    def light(time: int, _lit: int) -> bool:
        times.append(time)
        rates[0] = 1e6 * len(times)
        return True

    charges = []

    def digitise(charge: np.ndarray[Any, Any], _time: int) -> np.ndarray[Any, Any]:
        charges.append(charge.copy())
        return np.zeros(3695)

    m = readout(build, {}, rates=rates, light=light, digitise=digitise)
    m.run(0.021)
    assert times == m.readouts["start"].tolist()
    sampled = int(m.readouts["sampled"].argmax())
    np.testing.assert_allclose(charges[0], 1e6 * sampled * 25e-6, rtol=1e-6)
