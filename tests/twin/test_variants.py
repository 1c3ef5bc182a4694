"""Only what the firmware really does counts: firmware with wrong timing gives wrong pictures, or none."""

from __future__ import annotations

import shutil
import subprocess
import sys
from contextlib import nullcontext
from itertools import islice, pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from acquisition.capture import Capture, SpikeCapture, capture
from acquisition.frames import FrameFlags
from acquisition.protocol import Command, Mode
from twin.link import IMAGE, TwinLink
from twin.machine import MachineError, TimingViolation

if TYPE_CHECKING:
    from collections.abc import Callable

FIRMWARE = Path(__file__).parents[2] / "firmware"
NUMBERED = np.arange(3695, dtype=np.uint16)
CALL = Command(200, 30000, 1)
SLOWLY = (
    "    for (volatile uint32_t n = 0; n < 70000u; n++) {\n    }\n    spikes_find(frame->elements"
)


@pytest.fixture
def variant(tmp_path: Path) -> Callable[[str, str, str], Path]:
    """Compile the firmware with one text replaced in one file, and what was replaced before."""

    def build(file: str, text: str, replacement: str) -> Path:
        folder = tmp_path / "firmware"
        if not folder.exists():
            shutil.copytree(FIRMWARE, folder, ignore=shutil.ignore_patterns("build*"))
        shutil.copy(FIRMWARE.parent / "pyproject.toml", tmp_path)
        source = (folder / file).read_text()
        assert source.count(text) == 1, text
        (folder / file).write_text(source.replace(text, replacement))
        make = ["make", "-s", "-C", str(folder), f"ZIG={sys.executable} -m ziglang"]
        subprocess.run(make, check=True, capture_output=True)
        return folder / "build" / IMAGE

    return build


def elements(image: Path, command: Command = CALL) -> np.ndarray[tuple[int], np.dtype[np.uint16]]:
    with TwinLink(image=image) as link:
        link.machine._digitise_python = lambda _charge, _time: NUMBERED
        return next(Capture(link, command)).elements


def test_a_slow_adc_skips_elements(variant: Callable[[str, str, str], Path]) -> None:
    image = variant("sensor.c", "TIM4->ARR = ELEMENT_CYCLES - 1u", "TIM4->ARR = ELEMENT_CYCLES")
    # 85 cycles a sample, 84 an element
    found = elements(image)
    assert found[0] == 0
    at = np.arange(3000)
    assert np.abs(found[at].astype(int) - at * 85 // 84).max() <= 1


def test_an_adc_that_starts_early_reads_everything_late(
    variant: Callable[[str, str, str], Path],
) -> None:
    """The published firmware starts it with the ICG pulse: its spikes are five pixels late."""
    image = variant("sensor.c", "TIM2->CCR1 = ADC_START;", "TIM2->CCR1 = 9u;")
    # 9 clocks too early, 2.25 elements
    found = elements(image)
    assert found[:2].min() >= 3694  # idle: there is nothing on the output yet
    assert found[2:5].tolist() == [0, 1, 2]


def test_a_short_sh_pulse_is_refused(variant: Callable[[str, str, str], Path]) -> None:
    image = variant("sensor.c", "pulses ? SH_PULSE : 0;", "pulses ? 3u : 0;")
    with pytest.raises(TimingViolation, match="t3"):
        elements(image)


def test_icg_out_of_phase_with_fm_is_refused(variant: Callable[[str, str, str], Path]) -> None:
    image = variant(
        "sensor.c", "TIM3->CCMR2 = TIM_CCMR2_OC3M_PWM2;", "TIM3->CCMR2 = 6u << 4; /* PWM mode 1 */"
    )
    with pytest.raises(TimingViolation, match="t4"):
        elements(image)


def test_sh_that_does_not_divide_icg_is_refused(
    variant: Callable[[str, str, str], Path],
) -> None:
    image = variant(
        "sensor.c", "timer_prepare(TIM2, sh, SH_DELAY);", "timer_prepare(TIM2, sh + 1u, SH_DELAY);"
    )
    with pytest.raises(TimingViolation, match="SH"):
        elements(image)


@pytest.mark.parametrize("icg", [14800, 20000])  # the ADC runs on, or is stopped in between
def test_a_missed_conversion_costs_one_frame(
    variant: Callable[[str, str, str], Path], icg: int
) -> None:
    """After an overrun the ADC asks DMA for nothing more, until it is begun anew."""
    arm = "adc_arm(); /* the one thing that cannot wait */"
    # once, DMA is switched off on the ADC's side, with overrun detection on
    fault = "adc_arm(); if (begun == 3u) ADC1->CR2 = (ADC1->CR2 & ~ADC_CR2_DMA) | (1u << 10);"
    image = variant("sensor.c", arm, fault)
    command = Command(200, icg, 9, mode=Mode.STREAM)
    with TwinLink(image=image, spi_clock=20e6, host_latency=0) as link:
        link.machine._digitise_python = lambda _charge, _time: NUMBERED
        frames = list(capture(link, command))
    numbers = [frame.sequence for frame in frames]
    assert len(numbers) >= 7
    assert numbers[-1] == 8
    assert all(np.array_equal(frame.elements, NUMBERED[:3694]) for frame in frames)


@pytest.mark.parametrize("icg", [14800, 20000])
def test_a_slow_search_for_spikes_costs_frames_and_nothing_else(
    variant: Callable[[str, str, str], Path], icg: int
) -> None:
    """What is read out meanwhile waits, the newest one; buffers suffice all the same."""
    image = variant("frames.c", "    spikes_find(frame->elements", SLOWLY)
    command = Command(200, icg, 0, Mode.SPIKES, [{0: 200}, {1: 200}])
    with TwinLink(image=image) as link, SpikeCapture(link, command) as frames:
        found = list(islice(frames, 40))
        stamps = [frame.timestamp or 0 for frame in found]
        assert 8 < frames.statistics.dropped < 80
        assert frames.statistics.corrupt == frames.statistics.restarts == 0
        link.sleep(0.05)  # a host that does not read either
        found += islice(frames, 10)
        frames.send([{5: 20}])
        assert list(islice(frames, 10))[-1].leds == 1 << 5
    assert np.diff(stamps).max() < 0.02e9
    for frame, after in pairwise(found):
        assert bool(after.flags & FrameFlags.DROPPED) == (after.sequence > frame.sequence + 1)
        assert frame.leds == 1 + frame.sequence % 2
        at = 1117.8 if frame.leds == 1 else 2529.2
        assert [round(spike.position - at) for spike in frame.spikes] == [0]
    # the search that was under way when another capture begins is not that one's
    with TwinLink(image=image) as link:
        for mode in (Mode.SPIKES, Mode.STREAM, Mode.SPIKES, Mode.ORIGINAL, Mode.SPIKES):
            count = 2 if mode is Mode.ORIGINAL else 0
            with Capture(link, Command(200, icg, count, mode)) as mixed:
                assert len(list(islice(mixed, 2))) == 2
                assert mixed.statistics.corrupt == mixed.statistics.invalid == 0


@pytest.mark.parametrize("enough", [True, False])
def test_as_many_buffers_as_can_be_in_use_at_once(
    variant: Callable[[str, str, str], Path], enough: bool
) -> None:
    """One frame gets its checksum while the next is searched, and another is read out meanwhile."""
    variant("frames.c", "    spikes_find(frame->elements", SLOWLY)
    # the end of a checksum is noticed late, but everything else goes on
    image = variant(
        "frames.c", "irq_enable(IRQ_DMA2_STREAM1, PRIORITY_ADC);",
        "irq_enable(IRQ_DMA2_STREAM1, PRIORITY_TICK);",
    )  # fmt: skip
    noticed = "    DMA2->LIFCR = CRC_FLAGS(DMA_ISR_ALL);\n    struct frame *frame = sealing"
    wait = "    for (volatile uint32_t n = 0; n < 30000u; n++) {\n    }\n"
    image = variant("frames.c", noticed, wait + noticed)
    if not enough:
        image = variant("frames.c", "#define FRAMES 7u", "#define FRAMES 6u")
    with (
        nullcontext() if enough else pytest.raises(MachineError, match="HardFault"),
        TwinLink(image=image) as link,
    ):
        frames = SpikeCapture(link, Command(200, 14800, 0, Mode.SPIKES))
        for _ in range(6):
            assert len(list(islice(frames, 3))) == 3
            link.sleep(0.15)  # a host that does not read: one frame offered, one queued
        assert frames.statistics.corrupt == 0


def test_an_edge_of_before_does_not_end_the_wait(variant: Callable[[str, str, str], Path]) -> None:
    """An interrupt may be pending though its cause has been cleared."""
    waits = "    phase = AWAIT;\n"
    pending = "    *(volatile uint32_t *)0xE000E200 = 1u << IRQ_EXTI1;\n"
    image = variant("sensor.c", waits, waits + pending)
    with TwinLink(image=image) as link:
        link.sleep(1e-3)
        link.transfer(Command(200, 20000, 3, Mode.SPIKES, await_sync=True).encode())
        assert link.wait_ready(0.1)
        link.transfer(bytes(256))
        assert not link.wait_ready(0.2)
        link.machine.drive("PB1", True)
        assert link.wait_ready(0.2)


def test_an_led_that_is_never_lit_is_not_seen(variant: Callable[[str, str, str], Path]) -> None:
    image = variant("lights.c", "    lights_on(step->leds);\n", "")
    with TwinLink(image=image) as link:
        frame = next(capture(link, Command(200, 20000, 2, mode=Mode.STREAM)))
    assert np.ptp(frame.pixels) < 40
