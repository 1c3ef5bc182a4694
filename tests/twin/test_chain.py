"""The whole chain: command line, link, firmware's machine code, sensor, light, and back."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from acquisition.capture import Capture, Refused, capture
from acquisition.dat import read_dat
from acquisition.links import LinkUnavailable
from acquisition.protocol import Command, CommandError, Mode
from acquisition.session import open_session
from raytransfer import Aperture
from raytransfer.designs import save_design
from raytransfer.irradiance import pixel_response
from twin.link import TwinLink, firmware_image, open_twin
from twin.machine import CLOCK
from twin.sensor import Electronics
from twin.world import Led, Pose, World

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from acquisition.frames import Frame

LINETRACK = Path(sys.executable).with_name("linetrack")
CALL = Command(100, 30000, 2)


def measured(depth: NDArray[np.float64]) -> tuple[float, float]:
    """Centre of gravity, and root mean square distance from it, of what is above 5 % of the peak."""
    light = np.where(depth < 0.05 * depth.max(), 0, depth)
    pixels = np.arange(depth.size)
    middle = np.average(pixels, weights=light)
    return float(middle), float(np.sqrt(np.average((pixels - middle) ** 2, weights=light)))


def depth_of(frame: Frame) -> NDArray[np.float64]:
    return np.asarray(np.median(frame.dark) - frame.pixels.astype(float))


def centre(frame: Frame) -> float:
    return measured(depth_of(frame))[0]


def predicted(world: World, channel: int) -> tuple[float, float]:
    """The same of an LED's exact light on the pixels, without sensor, firmware or link."""
    led = next(led for led in world.leds if led.channel == channel)
    place = world.seen_from(led, world.pose())
    return measured(pixel_response(world.head, place, wavelength=led.wavelength))


def assert_spike(frame: Frame, world: World, channel: int) -> None:
    """One spike, where it should be; the error is printed."""
    pixel, width = predicted(world, channel)
    found, found_width = measured(depth_of(frame))
    error = found - pixel
    print(f"LED {channel}: spike at {found:.2f}, predicted {pixel:.2f}: {error:+.3f} px")
    assert abs(error) < 0.5  # far better than asked for; five pixels late would be a lost element
    assert found_width == pytest.approx(width, rel=0.02)  # one, not two


def run(*arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [LINETRACK, *arguments], cwd=folder, capture_output=True, text=True, check=True
    )


def test_command_line_writes_two_files_with_a_spike_each(tmp_path: Path) -> None:
    run("capture", "--link", "twin", *"-i 30000 -s 100 -n 2 -o output".split(), folder=tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "output00001.dat",
        "output00002.dat",
    ]
    for channel in (0, 1):
        assert_spike(read_dat(tmp_path / f"output0000{channel + 1}.dat"), World(), channel)


def test_command_line_streams_the_same_spikes(tmp_path: Path) -> None:
    options = "-i 30000 -s 100 -n 4 -o session.h5 --stream".split()
    run("capture", "--link", "twin", *options, folder=tmp_path)
    with open_session(tmp_path / "session.h5") as session:
        frames = list(session)
    assert [frame.leds for frame in frames] == [1, 2, 1, 2]
    for frame in frames:
        assert_spike(frame, World(), frame.leds.bit_length() - 1)


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_original_mode_sends_exactly_as_many_frames_as_asked_for(count: int) -> None:
    with TwinLink() as link:
        frames = list(capture(link, Command(100, 30000, count)))
        assert not link.wait_ready(0.05)
    assert [frame.leds for frame in frames] == ([0] * count + [1, 2])[-count:] if count > 1 else [2]
    for frame in frames:
        assert not frame.invalid()
        if frame.leds:
            assert_spike(frame, World(), frame.leds.bit_length() - 1)
        else:
            assert np.ptp(frame.pixels) < 30


@pytest.mark.parametrize("latency", [0.0, 1e-6, 1e-4, 2e-3])
@pytest.mark.parametrize("icg", [15000, 20000, 31000, 40000, 100000])
def test_every_frame_is_read_once(icg: int, latency: float) -> None:
    """However much later, or sooner than the next ICG edge, the host reads."""
    if latency > 1e-3 and icg < 31000:
        icg = 31000  # such a host cannot keep up with less
    with TwinLink(host_latency=latency) as link:
        frames = list(capture(link, Command(100, icg, 4)))
        assert not link.wait_ready(0.1)
    assert [frame.leds for frame in frames] == [0, 0, 1, 2]
    assert not any(frame.flags for frame in frames)
    for frame in frames[2:]:
        assert_spike(frame, World(), frame.leds.bit_length() - 1)


@pytest.mark.parametrize(("icg", "sealed"), [(14800, 188e-6), (20000, 3882.7e-6)])
def test_a_transfer_may_begin_at_any_moment(icg: int, sealed: float) -> None:
    """Also while the next frame becomes ready, so long after ICG's edge."""
    command = Command(200, icg, 0, mode=Mode.STREAM)
    with TwinLink(host_latency=0) as link, Capture(link, command) as frames:
        next(frames)
        transfer = link.transfer
        for n in range(100):
            # the frame that is offered meanwhile is not read before the next one is ready
            assert link.machine.wait_pin("PB2", level=True, timeout=0.1)
            assert link.machine.wait_pin("PA0", level=False, timeout=0.1)
            assert link.machine.wait_pin("PA0", level=True, timeout=0.1)
            moment = sealed + (n - 75) * 0.1e-6

            def late(tx: bytes, moment: float = moment) -> bytes:
                link.sleep(moment)
                return transfer(tx)

            link.transfer = late  # type: ignore[method-assign]
            next(frames)
            link.transfer = transfer  # type: ignore[method-assign]
            next(frames)
        assert frames.statistics.corrupt == 0


def test_pixel_1_is_pixel_1() -> None:
    """A sensor whose elements say their own number is read in order, none late, none twice."""
    with TwinLink() as link:
        numbered = np.arange(3695, dtype=np.uint16)
        link.machine._digitise_python = lambda _charge, _time: numbered
        for command in (CALL, Command(200, 14800, 3, mode=Mode.STREAM)):
            for frame in capture(link, command):
                assert np.array_equal(frame.elements, numbered[:3694])


def test_same_seed_same_bytes() -> None:
    def take(seed: int) -> list[bytes]:
        with TwinLink(seed=seed) as link:
            return [frame.elements.tobytes() for frame in capture(link, CALL)]

    assert take(7) == take(7)
    assert take(7) != take(8)


def test_exposure_sets_the_depth_of_the_spike() -> None:
    command = Command(200, 20000, 9, mode=Mode.STREAM, sequence=[{0: 40}, {0: 80}, {0: 160}])
    with TwinLink() as link:
        frames = list(capture(link, command))
    depth = [np.median(f.pixels) - np.median(np.sort(f.pixels)[:150]) for f in frames[3:6]]
    assert depth[1] / depth[0] == pytest.approx(2, rel=0.05)
    assert depth[2] / depth[0] == pytest.approx(4, rel=0.05)


def test_leds_of_one_frame_have_their_own_exposures() -> None:
    command = Command(200, 20000, 4, mode=Mode.STREAM, sequence=[{0: 150, 1: 50}])
    with TwinLink(record=True) as link:
        frame = list(capture(link, command))[-1]
        readouts = link.machine.readouts
        lit = readouts[readouts["sampled"] > 0][-1]["lit"] / CLOCK * 4e6
    assert frame.leds == 3
    assert lit[1] == pytest.approx(150, abs=2)
    assert lit[2] == pytest.approx(50, abs=2)


def test_chain_leds_light_through_the_shift_registers() -> None:
    """Channels 6 to 63 are switched by 74HC595s; the twin shifts every bit."""
    leds = [Led(channel, (60.0 * (channel - 35), 0, 0), power=0.2) for channel in (6, 20, 45, 63)]
    sequence = [{led.channel: 150} for led in leds] + [{6: 150, 63: 60, 0: 100}]
    command = Command(200, 20000, 10, mode=Mode.STREAM, sequence=sequence)
    with TwinLink(World(leds=leds, tracker=Pose(0, 4000))) as link:
        world = link.world
        frames = list(capture(link, command))[5:]
    for led, frame in zip(leds, frames, strict=False):
        pixel, width = predicted(world, led.channel)
        assert abs(centre(frame) - pixel) < width / 2
    both = frames[4].pixels.astype(float)
    for led in (leds[0], leds[3]):
        at = round(predicted(world, led.channel)[0])
        assert np.median(both) - both[at] > 30


def test_streaming_reaches_250_frames_a_second_with_a_latency_of_100_us() -> None:
    command = Command(200, 14800, 200, mode=Mode.STREAM)
    for latency, at_least in ((0.0, 270), (1e-4, 250), (3e-4, 245)):
        with TwinLink(spi_clock=16e6, host_latency=latency) as link:
            stamps = [frame.timestamp or 0 for frame in capture(link, command)]
        rate = (len(stamps) - 1) / (stamps[-1] - stamps[0]) * 1e9
        print(f"host latency {latency * 1e3:.1f} ms: {rate:.1f} frames/s")
        assert rate >= at_least


@pytest.mark.parametrize("icg", [14776, 14777, 14778, 14780, 14790, 14800, 14910, 14960, 15002])
def test_any_icg_period_reads_every_element_of_every_frame(icg: int) -> None:
    """Also those that are no multiple of an element's four clocks.

    ICG rises 20 clocks after its period begins: at the shortest periods the next pulse comes before
    the last trailing dummies.
    """
    complete = min(3694, (icg - 20) // 4)
    assert complete >= 32 + 3648
    sh = next(sh for sh in range(icg, 39, -1) if icg % sh == 0 and (sh < icg or icg == 14777))
    with TwinLink(host_latency=0, spi_clock=20e6) as link:
        numbered = np.arange(3695, dtype=np.uint16)
        link.machine._digitise_python = lambda _charge, _time: numbered
        for frame in islice(Capture(link, Command(sh, icg, 8, mode=Mode.STREAM)), 8):
            assert np.array_equal(frame.elements[:complete], numbered[:complete])


def test_bad_periods_are_answered_with_the_last_good_ones() -> None:
    with TwinLink() as link:
        list(capture(link, Command(200, 20000, 1)))
        bad = bytearray(Command(200, 20000, 1).encode())
        bad[2:10] = (0).to_bytes(4, "big") + (14000).to_bytes(4, "big")
        link.transfer(bytes(bad))
        assert link.wait_ready(0.2)
        start = link.machine.seconds
        elements = np.frombuffer(link.transfer(bytes(7388)), "<u2")
        assert elements.max() <= 4095
        assert elements[32:3680].min() < 3500  # lit by the last frame's LED
        assert link.machine.readouts[-1]["integration"] == pytest.approx(200 * 21, abs=1)
        assert link.machine.seconds > start


def test_a_read_during_the_flush_hangs_nothing() -> None:
    """The published firmware takes the zeros for periods, and never answers again."""
    with TwinLink() as link:
        link.transfer(CALL.encode())
        link.sleep(0.002)
        link.transfer(bytes(7388))
        for channel in (0, 1):
            assert link.wait_ready(0.2)
            elements = np.frombuffer(link.transfer(bytes(7388)), "<u2")
            pixel, _ = predicted(link.world, channel)
            depth = np.median(elements) - elements[32:-14].astype(float)
            assert measured(depth)[0] == pytest.approx(pixel, abs=0.5)


def test_the_device_refuses_what_the_host_would_not_send() -> None:
    class Careless(Command):
        """A command whose table is changed after its checksum was made."""

        def encode(self, size: int | None = None) -> bytes:
            data = bytearray(super().encode(size))
            data[20] ^= 1
            return bytes(data)

    with TwinLink() as link, pytest.raises(Refused, match="checksum"):
        list(capture(link, Careless(200, 20000, 2, mode=Mode.STREAM)))
    with pytest.raises(CommandError, match="swapped"):
        Command(30000, 100, 2)


def test_a_stream_is_steered_without_interruption() -> None:
    with TwinLink() as link, Capture(link, Command(200, 20000, 0, mode=Mode.STREAM)) as frames:
        before = list(islice(frames, 4))
        frames.send([{5: 20}])
        after = list(islice(frames, 6))
        assert [f.sequence for f in before + after] == list(range(10))
        assert after[-1].leds == 1 << 5
        assert frames.statistics.dropped == 0


def test_saturation_and_ambient_light() -> None:
    bright = World(leds=[Led(0, (0, 0, 0), power=50)], ambient=5.0)
    figures = Electronics()
    with TwinLink(bright, electronics=figures) as link:
        frame = list(capture(link, Command(200, 20000, 2, mode=Mode.STREAM, sequence=[{0: 200}])))[
            1
        ]
    pixel, _ = predicted(bright, 0)
    floor = figures.code(np.array(figures.dark_voltage - figures.swing))
    assert abs(int(frame.pixels[round(pixel)]) - int(floor)) <= 6
    assert np.median(frame.pixels) < np.median(frame.dark) - 1


def test_a_moving_tracker_sees_its_spikes_move() -> None:
    world = World(tracker=lambda seconds: Pose(2000 * (seconds - 0.03), 1300))
    with TwinLink(world) as link:
        frames = list(capture(link, Command(200, 20000, 6, mode=Mode.STREAM, sequence=[{0: 100}])))
        readouts = link.machine.readouts
    read = readouts[readouts["sampled"] > 0]
    for frame, cycles in zip(frames, read["transfer"], strict=True):
        still = World(tracker=world.pose(cycles / CLOCK))
        assert centre(frame) == pytest.approx(predicted(still, 0)[0], abs=1.0)
    # device time is that of the SH edges, but for the time that booting took
    stamps = np.array([frame.timestamp or 0 for frame in frames]) * 1e-9
    apart = read["transfer"] / CLOCK - stamps
    assert np.ptp(apart) < 1e-9
    assert 0 < apart[0] < 1e-3


def test_both_compilers_give_the_same_frames(tmp_path: Path) -> None:
    """What the sensor saw does not depend on who compiled the firmware."""
    gcc = tmp_path / "gcc"
    if subprocess.run(["which", "arm-none-eabi-gcc"], capture_output=True, check=False).returncode:
        assert "CI" not in os.environ, "CI must have gcc-arm-none-eabi"
        pytest.skip("arm-none-eabi-gcc is not installed")
    firmware = Path(__file__).parents[2] / "firmware"
    make = ["make", "-C", str(firmware), "CROSS=arm-none-eabi-", f"BUILD={gcc}"]
    subprocess.run(make, check=True, capture_output=True)

    def take(image: Path, command: Command) -> list[np.ndarray[tuple[int], np.dtype[np.uint16]]]:
        with TwinLink(image=image) as link:
            return [frame.elements for frame in capture(link, command)]

    for command in (CALL, Command(200, 16000, 6, mode=Mode.STREAM)):
        zig, other = take(firmware_image(), command), take(gcc / firmware_image().name, command)
        assert len(zig) == len(other) == command.count
        for one, two in zip(zig, other, strict=True):
            dark = one > np.median(one) - 100
            # neither draws the same noise, once one pixel has a little more light
            assert abs(one[dark].mean() - two[dark].mean()) < 0.3
            # interrupts take some cycles more or less: of 25 us or more of light, not 4 %
            depth = np.median(one) - np.array([one[~dark].mean(), two[~dark].mean()])
            assert depth[1] / depth[0] == pytest.approx(1, abs=0.04)


def test_a_design_file_is_the_twins_head(tmp_path: Path) -> None:
    """Its spikes are seen, and the session keeps all of it."""
    thesis = World().head
    slit = Aperture("slit", x=5.0)
    head = replace(thesis, elements=(slit, *thesis.elements), gaps=(8.0, *thesis.gaps))
    save_design(head, tmp_path / "slit.toml", notes="a narrow one")
    options = "-i 20000 -s 100 -n 4 -o slit.h5 --stream".split()
    run("capture", "--link", "twin", "slit.toml", *options, folder=tmp_path)
    world = World(head=head)
    with open_session(tmp_path / "slit.h5") as session:
        for frame in session:
            assert_spike(frame, world, frame.leds.bit_length() - 1)
        kept = session.metadata.lens_system
    assert kept["name"] == head.name
    entries = [entry["part"] for entry in kept["description"]["element"] if "part" in entry]
    assert entries[:2] == ["slit", "PCV_15_30_20"]


def test_heads_by_name_and_heads_that_are_none(tmp_path: Path) -> None:
    with open_twin("thesis") as link:
        assert link.world.head == World().head
    with pytest.raises(LinkUnavailable, match=r"no_such.toml: neither .* thesis"):
        open_twin("no_such.toml")
    (tmp_path / "bad.toml").write_text("version = 1")
    failed = subprocess.run(
        [LINETRACK, "capture", "--link", "twin", "bad.toml"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert failed.returncode in (1, 2)
    assert "bad.toml" in failed.stderr
    assert "Traceback" not in failed.stderr
