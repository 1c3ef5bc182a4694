"""`linetrack calibrate`: recordings from measured places become a calibration file."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pytest

from acquisition import cli
from acquisition.capture import capture
from acquisition.frames import ELEMENTS, LEADING, PIXELS, Frame, FrameFlags
from acquisition.protocol import Command, Mode
from acquisition.session import Metadata, SessionWriter
from raytransfer.designs import DESIGNS
from tracking.calibration import load_calibration
from tracking.spikes import SpikeFinder
from tracking.survey import look, read_survey
from twin.link import TwinLink
from twin.world import Led, Pose, World

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

PLAN = [(-1000.0, 0.0), (-500.0, 300.0), (0.0, 0.0), (500.0, 300.0), (1000.0, 0.0)]
PLACE, TURN = 0.5, 0.1  # mm, degrees: how well the survey knows them
SEED = 5


class Survey(NamedTuple):
    folder: Path
    leds: np.ndarray
    """Where they are."""


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> Survey:
    """Twenty places of a tracker before LEDs that are 3 mm off their plan, through the firmware."""
    folder = tmp_path_factory.mktemp("survey")
    rng = np.random.default_rng(SEED)
    places = np.array(PLAN) + rng.normal(0.0, 3.0, (5, 2))
    leds = [Led(n, (x, y, 0.0), power=0.25) for n, (x, y) in enumerate(places.tolist())]
    frames = [{}, *({n: clocks} for n in range(5) for clocks in (100, 30, 10))]
    command = Command(200, 16_000, 48, mode=Mode.STREAM, sequence=frames)
    lines = ["# recording, x, y, heading"]
    for number in range(20):
        x, y = -450.0 + 225.0 * (number % 5), (1500.0, 2000.0, 2800.0, 4000.0)[number // 5]
        turn = rng.uniform(-14.0, 14.0)
        pose = Pose(
            x + rng.normal(0.0, PLACE),
            y + rng.normal(0.0, PLACE),
            math.radians(turn + rng.normal(0.0, TURN)),
        )
        world = World(leds=leds, tracker=pose, head=DESIGNS["slit-4mm"].system)
        name = f"spot {number}.h5"
        with (
            TwinLink(world, seed=SEED) as link,
            SessionWriter(folder / name, Metadata(lens_system=link.lens_system)) as file,
        ):
            file.append(list(capture(link, command)))
        lines.append(f'"{name}", {x}, {y}, {turn:.2f}')
    (folder / "survey.txt").write_text("\n".join(lines))
    (folder / "leds.txt").write_text("".join(f"{n} {x} {y}\n" for n, (x, y) in enumerate(PLAN)))
    return Survey(folder, places)


@pytest.fixture
def run(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., tuple[int, str]]:
    """Run a command line, return its exit code and what it said."""
    monkeypatch.setenv("COLUMNS", "110")

    def function(*words: str | Path) -> tuple[int, str]:
        with pytest.raises(SystemExit) as ended:
            cli.main(["calibrate", *map(str, words)])
        code = ended.value.code
        return code if isinstance(code, int) else 0, " ".join(capfd.readouterr().err.split())

    return function


def test_from_recordings_to_a_calibration(
    survey: Survey, run: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    target = tmp_path / "room.json"
    known = ("--place-error", str(PLACE), "--heading-error", str(TURN))
    leds = survey.folder / "leds.txt"
    code, said = run(survey.folder / "survey.txt", "--leds", leds, "-o", target, *known)
    assert code == 0, said
    assert "1. spot 0.h5: used: 1, 2; saturated: 0; not seen: 3, 4" in said
    found = load_calibration(target)
    off = found.leds.positions[:, :2] - survey.leds
    sigma = np.array([[found.sigma(f"LED {n} {axis}") for axis in "xy"] for n in range(5)])
    assert sigma.max() < 2.0
    assert np.abs(off / sigma).max() < 3.0
    assert np.sqrt(np.mean(off**2)) < 0.4 * np.sqrt(np.mean((np.array(PLAN) - survey.leds) ** 2))
    assert found.camera.model_error < 0.2
    assert f"± {found.sigma('scale'):.2g} (drawing: " in said
    code, said = run(survey.folder / "survey.txt", "--leds", leds, "-o", target)
    assert code == cli.USAGE
    assert "room.json: exists; take another name, or --overwrite" in said


@pytest.mark.parametrize("headings", [False, True])
@pytest.mark.parametrize("places", [1, 2, 3])
def test_what_is_not_determined_is_not_written(
    survey: Survey,
    run: Callable[..., tuple[int, str]],
    tmp_path: Path,
    places: int,
    headings: bool,
) -> None:
    lines = (survey.folder / "survey.txt").read_text().splitlines()[1 : 1 + places]
    short = survey.folder / "short.txt"
    short.write_text("\n".join(n if headings else n.rpartition(",")[0] for n in lines))
    target = tmp_path / "room.json"
    code, said = run(short, "--leds", survey.folder / "leds.txt", "-o", target)
    assert code == cli.FAILED
    assert "nothing is written: " in said
    assert "--heading-error" in said
    assert not list(tmp_path.iterdir())


def test_without_options_it_does_for_the_documented_survey(
    survey: Survey, run: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    target = tmp_path / "room.json"
    leds = survey.folder / "more.txt"
    leds.write_text((survey.folder / "leds.txt").read_text() + "7 2000 0\n")
    code, said = run(survey.folder / "survey.txt", "--leds", leds, "-o", target, "-q")
    assert code == 0, said
    assert said == "LED 7 was never seen: its place is the map's"


# --- what a recording shows -----------------------------------------------------------------------


def frame(
    channel: int | None, at: float, height: float = 600.0, lit: int = 100, seed: int = 1
) -> Frame:
    """One LED's spike, of so many codes."""
    elements = 3900 + np.random.default_rng(seed).normal(0.0, 1.3, ELEMENTS)
    light = height * np.exp(-(((np.arange(PIXELS) - at) / 5) ** 2) / 2)
    elements[LEADING : LEADING + PIXELS] -= light
    return Frame(
        np.rint(elements).clip(0).astype(np.uint16),
        leds=0 if channel is None else 1 << channel,
        exposures={} if channel is None else {channel: lit},
        sh_period=200,
    )


def many(channel: int, at: float, **options: float) -> list[Frame]:
    return [frame(channel, at, seed=n, **options) for n in range(16)]  # type: ignore[arg-type]


def test_a_sight_is_the_median_of_an_leds_spikes() -> None:
    finder = SpikeFinder()
    sights = look([*many(0, 1200.3), *many(3, 2400.7)], finder)
    assert list(sights) == [0, 3]
    single = finder(frame(0, 1200.3))[0].sigma
    for sight, at in zip(sights.values(), (1200.3, 2400.7), strict=True):
        assert not sight.why
        assert sight.sigma == pytest.approx(single * math.sqrt(math.pi / 2 / 16), rel=0.2)
        assert abs(sight.pixel - at) < 4 * sight.sigma


def test_someone_who_passes_does_not_move_it() -> None:
    frames = many(0, 1200.3)
    frames[3:7] = [frame(0, 3000.0, seed=n) for n in range(4)]
    assert abs(look(frames, SpikeFinder())[0].pixel - 1200.3) < 0.05


def test_of_several_exposures_the_longest_that_saturates_nothing_is_taken() -> None:
    lit = {10: 150.0, 30: 600.0, 100: 9000.0}
    frames = [
        f for clocks, height in lit.items() for f in many(0, 1200.3, height=height, lit=clocks)
    ]
    finder = SpikeFinder()
    best = look(frames, finder)[0]
    assert not best.why
    assert best == look(many(0, 1200.3, height=600.0, lit=30), finder)[0]
    assert look(many(0, 1200.3, height=9000.0), finder)[0].why == "saturated"


def test_a_drift_makes_it_less_sure() -> None:
    finder = SpikeFinder()
    still = look(many(0, 1200.3), finder)[0]
    drifting = look([frame(0, 1200.0 + 0.2 * n, seed=n) for n in range(16)], finder)[0]
    assert not drifting.why
    assert drifting.sigma > 0.2 > 10 * still.sigma


def test_what_is_of_no_use_is_named() -> None:
    finder = SpikeFinder()
    moved = [frame(0, 1200.0 + 5 * n, seed=n) for n in range(16)]
    assert look(moved, finder)[0].why == "wandering by 20.0 px"
    assert look(many(0, 1200.0, height=0.0), finder)[0].why == "not seen"
    assert look(many(0, 30.0), finder)[0].why == "at the end of the line"
    both = [replace(f, leds=3, exposures={0: 100, 1: 100}) for f in many(0, 1200.0)]
    invalid = [replace(f, flags=FrameFlags.INVALID) for f in many(0, 1200.0)]
    assert look([*both, *invalid], finder) == {}


def test_what_shines_without_leds_is_subtracted() -> None:
    lamp = frame(None, 2000.0, height=900.0)
    both = []
    for light in many(0, 1200.3):
        elements = light.elements.astype(int) + lamp.elements.astype(int) - 3900
        both.append(replace(light, elements=elements.astype(np.uint16)))
    assert look(both, SpikeFinder())[0].pixel == pytest.approx(2000.0, abs=0.1)
    assert look([lamp, *both], SpikeFinder())[0].pixel == pytest.approx(1200.3, abs=0.1)


# --- what cannot be -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "there is no recording in it"),
        ("a.h5 1 2\nb.h5 1", "line 2: 'b.h5 1' is not recording, x, y in mm and heading"),
        ("a.h5 1 2 3 4", "line 1: 'a.h5 1 2 3 4' is not"),
        ("a.h5 1 nan", "line 1: 'a.h5 1 nan' is not"),
        ("a.h5 1 2 nan", "line 1: 'a.h5 1 2 nan' is not"),
        ("'a.h5 1 2", 'line 1: "\'a.h5 1 2" is not'),
        ("a.h5 1 2 inf", "line 1: 'a.h5 1 2 inf' is not"),
        ("a.h5 1 2 1500", "line 1: 'a.h5 1 2 1500' is not"),
        ("# none\nb.h5 1 2", "line 2: there is no file .*b.h5"),
        ("a.h5 1 2\n'b, #1.h5' 1 2\na.h5 3 4", "line 3: a.h5 stands in line 1 too"),
    ],
)
def test_surveys_that_are_refused(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "survey.txt"
    path.write_text(text, encoding="utf-8-sig")
    for name in ("a.h5", "b, #1.h5"):
        (tmp_path / name).touch()
    with pytest.raises(cli.UsageError, match=message):
        read_survey(path)


def test_errors_say_what_to_do(run: Callable[..., tuple[int, str]], tmp_path: Path) -> None:
    (tmp_path / "leds.txt").write_text("0 -250 0\n1 250 0\n")
    for name, frames, head in (
        ("good", [*many(0, 1200.0), *many(1, 2400.0)], "a"),
        ("other", [*many(0, 1200.0), *many(1, 2400.0)], "b"),
        ("third", many(2, 1200.0), "a"),
        ("none", [frame(None, 1.0)], "a"),
    ):
        about = Metadata(lens_system={"name": head, "description": {}})
        with SessionWriter(tmp_path / f"{name}.h5", about) as file:
            file.append(frames)
    target = tmp_path / "room.json"

    def said(line: str, *options: str | Path, output: Path = target) -> tuple[int, str]:
        path = tmp_path / "survey.txt"
        path.write_text(line)
        return run(path, "--leds", tmp_path / "leds.txt", "-o", output, *options)

    for line, options, code, message in (
        ("third.h5 0 1500", (), cli.USAGE, "third.h5: LED 2 was lit, and"),
        ("none.h5 0 1500", (), cli.USAGE, "none.h5: no frame of one LED alone"),
        ("nothing.h5 0 1500", (), cli.USAGE, "line 1: there is no file"),
        ("leds.txt 0 1500", (), cli.FAILED, "leds.txt"),
        ("good.h5 0 1500\nother.h5 0 1600", (), cli.USAGE, "different heads, a and b"),
        ("good.h5 0 1500", (), cli.USAGE, "'a', is no design"),
        ("good.h5 0 1500", ("--head", "no"), cli.USAGE, "--head no: neither a design file"),
        ("good.h5 0 1500", ("--place-error", "-1"), cli.USAGE, "--place-error -1.0: allowed is"),
        ("good.h5 0 1500", ("--led-error", "nan"), cli.USAGE, "--led-error nan: allowed is"),
        ("good.h5 0 1500", ("--heading-error", "400"), cli.USAGE, "degrees are needed, up to"),
        ("good.h5 0 1500", ("--height", "inf"), cli.USAGE, "--height inf: a number of mm"),
    ):
        assert said(line, *options)[0] == code, line
        assert message in said(line, *options)[1]
    for output, message in (
        (tmp_path / "room.txt", "a calibration is a file that ends in .json"),
        (tmp_path / "no" / "room.json", "there is no folder"),
    ):
        code, text = said("good.h5 0 1500", output=output)
        assert code == cli.USAGE
        assert message in text
    assert not target.exists()
