"""Heads by their numbers: the thesis's among them, closed forms of the bounds, the search."""

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from scipy.special import erf  # type: ignore[import-untyped]

from raytransfer import TCD1304, OpticalSystem, heads, prototype_head
from raytransfer.designs import DESIGNS, load_design
from raytransfer.heads import (
    BETTER,
    Candidate,
    Head,
    Layout,
    Scene,
    Spikes,
    layouts,
    led_bounds,
    position_bounds,
    search,
    spikes,
    worst_bounds,
)
from raytransfer.irradiance import RAYS, irradiance
from raytransfer.lenses import Aperture
from raytransfer.localisation import Noise, pose_bound, spike_bound
from raytransfer.sensors import SENSORS
from raytransfer.sources import Emitter
from raytransfer.systems import Placement
from raytransfer.tolerances import Tolerances, perturb

if TYPE_CHECKING:
    from numpy.typing import NDArray

SCENE = Scene()
DARK = Scene(ambient=0.0)
THESIS = prototype_head()
SLIT = Head("LJ1430L1", "LJ1430L1", slit=6.0, gap=4.0, pair_to_window=24.0)

# the head ---------------------------------------------------------------------------------------


def test_the_thesis_head_is_one_of_them() -> None:
    assert Head().system() == prototype_head()


@pytest.mark.parametrize(
    ("place", "collimator", "number"),
    [
        ("before", True, 0),
        ("before", False, 0),
        ("between", True, 2),
        ("between", False, 1),
        ("behind", True, 3),
        ("behind", False, 2),
    ],
)
def test_a_slit_moves_nothing_else(place: Any, collimator: bool, number: int) -> None:
    head = Head(gap=4.0, slit_place=place, slit_distance=3.0, collimator=collimator)
    if place == "before":
        head = replace(head, slit_distance=12.0)
    without, with_slit = head.system(), replace(head, slit=5.0).system()
    assert with_slit.elements[number] == Aperture("slit", x=5.0)
    rest = (*with_slit.elements[:number], *with_slit.elements[number + 1 :])
    assert rest == without.elements
    front, chip = (0, with_slit.length) if number else (1, with_slit.length - with_slit.gaps[0])
    assert with_slit.layout()[front].element == without.elements[0]
    assert chip == pytest.approx(without.length, abs=1e-9)
    first = with_slit.elements.index(head.lenses()[0])
    slit_z = with_slit.layout()[number].front
    distance = {
        "before": with_slit.layout()[first].front - slit_z,
        "between": slit_z - with_slit.layout()[first].back,
        "behind": slit_z - with_slit.layout()[first + 1].back,
    }[place]
    assert distance == pytest.approx(head.slit_distance, abs=1e-9)


@pytest.mark.parametrize("distance", [0.0, 4.0])
def test_a_slit_may_touch_both_lenses_of_the_pair(distance: float) -> None:
    head = Head(gap=4.0, slit=5.0, slit_place="between", slit_distance=distance)
    head = replace(head, front_reversed=False, back_reversed=True)  # plane sides inside
    assert head.system().elements[2] == Aperture("slit", x=5.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"front": "PCX"}, "front = 'PCX': known are LJ1695L1"),
        ({"gap": -0.1}, "gap = -0.1: allowed is >= 0"),
        ({"slit": 0.0}, "slit = 0: allowed is > 0"),
        ({"slit_place": "inside"}, "slit_place = 'inside': allowed are before, between, behind"),
        ({"sensor": SENSORS["TCD1703"]}, "TCD1703: a head needs its window"),
    ],
)
def test_impossible_heads_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Head(**changes)


@pytest.mark.parametrize(
    "changes",
    [
        {"slit": 5.0, "slit_distance": 7.0},  # in the concave lens's edges
        {"slit": 5.0, "slit_place": "between", "slit_distance": 1.0},
        {"slit": 5.0, "slit_place": "behind", "slit_distance": 19.0},
        {"pair_to_window": 8.0},
    ],
)
def test_parts_do_not_overlap(changes: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"overlap|allowed is >= 0"):
        replace(Head(), **changes).system()


# profiles ---------------------------------------------------------------------------------------

SOURCES = np.array(
    [[0.0, 1300.0], [-480.0, 1300.0], [606.0, 1300.0], [0.0, 4150.0], [1900.0, 4150.0]]
)


@pytest.mark.parametrize(
    ("system", "agreement"), [(THESIS, 0.05), (SLIT.system(), 0.02)], ids=["thesis", "slit"]
)
def test_the_quick_model_agrees_with_rays(system: OpticalSystem, agreement: float) -> None:
    """In the wide-open head 96 columns are few for a caustic's edge."""
    quick = spikes(system, DARK, *SOURCES.T)
    exact = spikes(system, DARK, *SOURCES.T, rays=(384, 128))
    for a, b in zip(quick.electrons, exact.electrons, strict=True):
        assert a.sum() == pytest.approx(b.sum(), rel=0.012)
        assert np.abs(np.cumsum(a - b)).max() < 0.012 * b.sum()
    bounds = led_bounds(system, DARK, *SOURCES.T)
    exact_bounds = led_bounds(system, DARK, *SOURCES.T, rays=(384, 128))
    assert bounds == pytest.approx(exact_bounds, rel=agreement)


@pytest.mark.parametrize(
    "place",
    [
        Placement((0.0, 0.05)),
        Placement(tilt=(0.01, 0.0, 0.0)),
        Placement(tilt=(0.0, 0.0, 0.02)),
    ],
)
@pytest.mark.parametrize("part", ["sensor", "lens"])
def test_a_head_off_the_plane_of_the_axis_is_traced_in_full(place: Placement, part: str) -> None:
    system = SLIT.system()
    if part == "sensor":
        off = replace(system, sensor_placement=place)
    else:
        off = replace(system, placements=(Placement(), Placement(), place, *[Placement()] * 3))
    quick = spikes(off, DARK, *SOURCES[:2].T)
    exact = spikes(off, DARK, *SOURCES[:2].T, rays=RAYS)
    np.testing.assert_array_equal(quick.electrons, exact.electrons)
    np.testing.assert_array_equal(quick.slope, exact.slope)
    # along the line nothing of the symmetry is lost
    along = replace(system, sensor_placement=Placement((0.1, 0.0), (0.0, 0.01, 0.0)))
    assert spikes(along, DARK, *SOURCES[1:2].T).electrons.sum() == pytest.approx(
        spikes(along, DARK, *SOURCES[1:2].T, rays=RAYS).electrons.sum(), rel=0.01
    )


def test_electrons_are_those_of_the_irradiance() -> None:
    x, y = 480.0, 1300.0
    emitter = Emitter(power=0.25, extent=0.0)
    seen = spikes(SLIT.system(), replace(DARK, emitter=emitter), [x], [y], rays=(384, 128))
    light = irradiance(
        SLIT.system(), emitter, (x, 0.0, y), integration_time=25e-6, facing=(0.0, 0.0, 1.0)
    )
    assert seen.electrons.sum() == pytest.approx(light.electrons.sum(), rel=1e-3)


def test_the_slope_is_what_a_moved_led_changes() -> None:
    system, step = SLIT.system(), 0.05
    x = np.array([-480.0, 0.0, 480.0])
    distance = np.full(3, 1300.0)
    here = spikes(system, DARK, x, distance)
    after, before = (spikes(system, DARK, x + d, distance).electrons for d in (step, -step))
    difference = (after - before) / (2 * step)
    assert np.abs(here.slope - difference).max() < 0.1 * np.abs(difference).max()


def test_a_larger_led_blurs_and_keeps_its_light() -> None:
    small, large = (
        spikes(SLIT.system(), replace(DARK, emitter=Emitter(extent=extent)), [0.0], [1300.0])
        for extent in (0.5, 6.0)
    )
    assert large.electrons.sum() == pytest.approx(small.electrons.sum(), rel=1e-4)
    assert large.electrons.max() < 0.9 * small.electrons.max()


def test_a_narrow_slit_diffracts() -> None:
    """A slit of 0.2 mm: first zeros of sinc² at λ/a on both sides."""
    head = replace(SLIT, slit=0.2, collimator=False, slit_distance=1.0)
    system = head.system()
    scene = replace(DARK, emitter=Emitter(extent=0.0))
    profile = spikes(system, scene, [0.0], [4150.0]).electrons[0]
    focal_length = system.effective_focal_length("x", wavelength=0.63)
    zero = 0.63e-3 / 0.2 * focal_length / TCD1304.pitch
    middle = (TCD1304.pixels - 1) / 2
    pixel = np.arange(TCD1304.pixels) - middle
    assert profile[np.abs(pixel) < zero].sum() / profile.sum() == pytest.approx(0.903, abs=0.02)


# bounds -----------------------------------------------------------------------------------------


def test_many_bounds_at_once_are_spike_bounds() -> None:
    seen = spikes(SLIT.system(), DARK, *SOURCES.T)
    dim = Spikes(seen.electrons * 0.01, seen.slope * 0.01)
    expected = [
        spike_bound(light, background=77.0, derivative=slope)
        for light, slope in zip(*dim, strict=True)
    ]
    found = heads._spike_bounds(dim.electrons, dim.slope, Noise(), 77.0)
    assert found == pytest.approx(expected, rel=1e-9)


def test_positions_are_pose_bounds() -> None:
    rng = np.random.default_rng(2)
    for leds in (2, 3, 5):
        tangent, sigma = rng.uniform(-0.5, 0.5, leds), rng.uniform(0.01, 0.1, leds)
        rows = np.stack([-np.ones(leds), tangent, np.zeros(leds)], axis=1)
        pose = pose_bound(rows, sigma, sigma_heading=0.0)
        found = heads._known_heading(tangent[:, None], 1 / sigma[:, None] ** 2)
        assert np.ravel(found) == pytest.approx([pose.sigma_x, pose.sigma_y], rel=1e-9)


FWHM, FOCAL_LENGTH, PEAK = 12.0, 28.0, 20_000.0


def ideal(_: OpticalSystem, __: Scene, offset: Any, distance: Any, **___: Any) -> Spikes:
    """Gaussian spikes of a pinhole camera, and their exact slopes."""
    offset, distance = np.asarray(offset)[:, None], np.asarray(distance)[:, None]
    scale = FOCAL_LENGTH / distance / TCD1304.pitch
    sigma = FWHM / math.sqrt(8 * math.log(2))
    edges = np.arange(TCD1304.pixels + 1) - 0.5 - (TCD1304.pixels - 1) / 2 + scale * offset
    bell = PEAK * np.exp(-((edges / sigma) ** 2) / 2)
    charge: NDArray[np.float64] = np.diff(
        PEAK * sigma * math.sqrt(math.pi / 2) * erf(edges / sigma / math.sqrt(2))
    )
    return Spikes(charge, scale * np.diff(bell))


def test_an_ideal_camera_has_the_closed_form(monkeypatch: pytest.MonkeyPatch) -> None:
    """σ_x = y σ_u/(√2 f), σ_y = √2 y² σ_u/(f B) on the axis; without read noise σ_u = σ/√N."""
    monkeypatch.setattr(heads, "spikes", ideal)
    quiet = Noise(read_noise=0.0, electrons_per_code=1e-3, codes=10**9, full_well=35_000.0)
    scene = replace(DARK, noise=quiet)
    sigma = FWHM / math.sqrt(8 * math.log(2))
    sigma_u = sigma / math.sqrt(PEAK * sigma * math.sqrt(2 * math.pi)) * TCD1304.pitch
    for y in (1300.0, 4150.0):
        bounds = position_bounds(THESIS, scene, y, angles=41)
        middle = len(bounds.x) // 2
        assert bounds.x[middle] == pytest.approx(0.0, abs=1e-9)
        assert bounds.sigma_x[middle] == pytest.approx(
            y * sigma_u / (math.sqrt(2) * FOCAL_LENGTH), rel=0.02
        )
        assert bounds.sigma_y[middle] == pytest.approx(
            math.sqrt(2) * y**2 * sigma_u / (FOCAL_LENGTH * 500.0), rel=0.02
        )


def test_more_light_is_better_and_blur_and_daylight_are_worse() -> None:
    system = SLIT.system()
    worst = worst_bounds(system, SCENE, angles=9)
    for better in (
        replace(SCENE, emitter=Emitter(power=0.5, extent=2.0)),
        replace(SCENE, integration_time=50e-6, ambient=250.0),
        replace(SCENE, ambient=0.0),
        replace(SCENE, emitter=Emitter(power=0.25, extent=1.0)),
        replace(SCENE, noise=Noise(read_noise=10.0)),
        replace(SCENE, fill=0.9),
    ):
        found = worst_bounds(system, better, angles=9)
        assert all(a <= b * (1 + 1e-12) for a, b in zip(found, worst, strict=True)), better
        assert any(a < 0.98 * b for a, b in zip(found, worst, strict=True)), better


def test_a_scene_that_fills_the_pixels_leaves_nothing() -> None:
    assert worst_bounds(THESIS, replace(SCENE, ambient=1e5), angles=5) == (math.inf, math.inf)


def test_an_led_that_is_not_seen_leaves_nothing() -> None:
    wide = replace(SCENE, field=math.radians(40))
    bounds = position_bounds(THESIS, wide, 1300.0, angles=9)
    assert math.isinf(bounds.worst)
    assert np.isfinite(bounds.total[len(bounds.x) // 2])
    # just off the line's end, where rounding leaves some 1e-10 electrons
    aside = replace(BETTER.system(), sensor_placement=Placement((0.3, 0.0)))
    assert worst_bounds(aside, DARK, angles=13)[1] == math.inf


def test_a_head_off_its_place_is_computed_on_both_sides() -> None:
    system = SLIT.system()
    straight = position_bounds(system, DARK, 1300.0, angles=9)
    assert straight.total == pytest.approx(straight.total[::-1], rel=1e-9)
    shifted = replace(system, sensor_placement=Placement((0.05, 0.0)))
    both = position_bounds(shifted, DARK, 1300.0, angles=9)
    assert both.total != pytest.approx(both.total[::-1], rel=1e-9)
    assert both.total == pytest.approx(straight.total, rel=0.1)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"leds": (0.0,)}, "two or more places"),
        ({"distances": ()}, "distances: at least one"),
        ({"distances": (-1.0,)}, "a distance = -1: allowed is > 0"),
        ({"distances": (500.0,)}, "mm are lacking until all LEDs are within 25°"),
        ({"field": 25.0}, "field = 25: .* degrees"),
        ({"ambient": -1.0}, "ambient = -1"),
        ({"fill": 1.5}, "fill = 1.5: allowed is > 0 to 1"),
    ],
)
def test_impossible_scenes_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Scene(**changes)


def test_a_scene_has_an_emitter_and_noise() -> None:
    with pytest.raises(TypeError, match=r"emitter = 0.25: of kind Emitter"):
        Scene(emitter=0.25)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"noise = 60: of kind Noise"):
        Scene(noise=60)  # type: ignore[arg-type]


# the search -------------------------------------------------------------------------------------


def test_layouts_are_every_pair_that_sees_the_field() -> None:
    every = layouts(SCENE)
    assert len(set(every)) == len(every)
    pairs = {(layout.front, layout.back) for layout in every}
    assert ("LJ1430L1", "LJ1430L1") in pairs
    assert ("LJ1567L1", "LJ1567L1") not in pairs  # f 50 together: 16° on this sensor
    assert len(every) == len(pairs) * 4 * 3 * 2
    assert len(layouts(replace(SCENE, field=math.radians(10), distances=(4150.0,)))) > len(every)


def test_the_shipped_design_is_the_head_that_was_found() -> None:
    assert BETTER.system() == DESIGNS["slit-f50-f100"].system


def test_the_shipped_design_beats_the_thesis_with_exact_rays() -> None:
    thesis, better = (
        np.array(worst_bounds(system, SCENE, rays=RAYS, angles=31))
        for system in (THESIS, BETTER.system())
    )
    assert (thesis / better > 1.55).all()
    assert better == pytest.approx(worst_bounds(BETTER.system(), SCENE), rel=0.03)
    overcast = replace(SCENE, ambient=2000.0)
    assert worst_bounds(THESIS, overcast)[1] > 2 * worst_bounds(BETTER.system(), overcast)[1]


@pytest.mark.parametrize("name", ["gap", "slit", "slit_distance", "pair_to_window"])
def test_the_shipped_design_is_a_local_optimum(name: str) -> None:
    """Of the larger of both ratios to the thesis's bounds, to the noise of pixel and profile."""
    reference = np.array(worst_bounds(THESIS, SCENE, rays=RAYS))

    def cost(step: float) -> float:
        head = replace(BETTER, **{name: getattr(BETTER, name) + step})
        return float((worst_bounds(head.system(), SCENE) / reference).max())

    here = cost(0.0)
    assert min(cost(-0.5), cost(0.5)) > 0.98 * here
    assert max(cost(-1.0), cost(1.0)) > 1.02 * here


def test_the_search_is_the_same_with_an_executor() -> None:
    choices = [
        Layout("LJ1430L1", "LJ1430L1", True, False, place, True) for place in ("before", "behind")
    ]
    budget: dict[str, Any] = {"choices": choices, "samples": 8, "refine": 1, "rounds": 1}
    alone = search(DARK, **budget)
    with ThreadPoolExecutor(2) as executor:
        assert search(DARK, executor=executor, **budget) == alone
    assert len(alone) == 1
    assert alone[0].worst == worst_bounds(alone[0].head.system(), DARK)


BEFORE = Layout("LJ1430L1", "LJ1430L1", True, False, "before", True)
TOO_SHORT = Layout("PCX_15_30_20", "PCX_15_30_20", True, False, "before", True)
"""Focuses within its own glass."""


def test_what_cannot_be_searched_is_refused() -> None:
    with pytest.raises(ValueError, match=r"samples = 4: allowed is >= 5"):
        search(DARK, choices=[BEFORE], samples=4)
    with pytest.raises(ValueError, match=r"bounds of \(inf, inf\) mm.*ambient = 5000 lx"):
        search(replace(SCENE, ambient=5000.0), choices=[BEFORE], samples=5)
    with pytest.raises(ValueError, match="none of 1 layouts with 5 samples"):
        search(DARK, choices=[TOO_SHORT], samples=5, refine=1, rounds=1)
    with pytest.raises(ValueError, match="back = 'LJ143': known are"):
        replace(BEFORE, back="LJ143")
    with pytest.raises(ValueError, match="slit_place = 'inside': allowed are"):
        replace(BEFORE, slit_place="inside")  # type: ignore[arg-type]


def test_a_layout_that_cannot_be_built_ends_no_search() -> None:
    found = search(DARK, choices=[TOO_SHORT, BEFORE], samples=6, refine=2, rounds=1)
    assert [candidate.head.front for candidate in found] == ["LJ1430L1"]


def test_lengths_are_rounded_unless_parts_then_overlap(monkeypatch: pytest.MonkeyPatch) -> None:
    budget: dict[str, Any] = {"choices": [BEFORE], "samples": 8, "refine": 1, "rounds": 1}
    (rounded,) = search(DARK, **budget)
    gap = rounded.head.gap / 0.05
    assert gap == pytest.approx(round(gap), abs=1e-6)
    assert heads._rounded(rounded.head) == rounded.head
    monkeypatch.setattr(heads, "_rounded", lambda head: replace(head, slit_distance=7.0))
    (kept,) = search(DARK, **budget)
    assert kept.head.system().length > 0
    assert kept.head.slit_distance != 7.0
    assert kept.head.gap == pytest.approx(rounded.head.gap, abs=0.026)


def test_the_command_saves_the_best(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: dict[str, Any] = {}

    def found(_: Scene, **options: Any) -> list[Candidate]:
        asked.update(options)
        return [Candidate(BETTER, (0.01, 0.08), 1.6), Candidate(SLIT, (0.02, 0.09), 1.2)]

    monkeypatch.setattr(heads, "search", found)
    path = tmp_path / "best.toml"
    assert heads.main(["--save", str(path), "--samples", "7", "--seed", "3"]) == 0
    assert (asked["samples"], asked["seed"], asked["refine"], asked["rounds"]) == (7, 3, 8, 20)
    assert "1.60  0.0100, 0.0800  front=LJ1695L1, back=LJ1567L1" in capsys.readouterr().out
    design = load_design(path)
    assert design.system == BETTER.system()
    assert "0.0100 at 1300 mm, 0.0800 at 4150 mm" in design.notes
    asked.clear()
    for wrong in (tmp_path / "best.txt", tmp_path / "nowhere" / "best.toml"):
        with pytest.raises(SystemExit):
            heads.main(["--save", str(wrong)])
        assert "a .toml file in a folder that exists" in capsys.readouterr().err
    assert not asked  # not after minutes


def test_the_narrow_head_has_one_narrow_spike() -> None:
    """16 px or less at half the peak, without a dip below four fifths, near and far."""
    narrow = replace(BETTER, slit=4.0, pair_to_window=27.3)
    assert DESIGNS["slit-4mm"].system == narrow.system()
    for y in (1300.0, 2500.0, 4150.0):
        x = y * np.tan(np.radians([0, 11, 22]))
        for light in spikes(narrow.system(), Scene(), x, [y] * 3).electrons:
            wide = np.flatnonzero(light > light.max() / 2)
            within = light[wide[0] : wide[-1] + 1]
            assert len(within) <= 16
            hull = np.minimum(
                np.maximum.accumulate(within), np.maximum.accumulate(within[::-1])[::-1]
            )
            assert (within / hull).min() > 0.8


def test_a_head_that_is_not_made_exactly_has_a_bound() -> None:
    """In ambient light, too, so that it can be the metric of a tolerance study."""
    exact = BETTER.system()
    rng = np.random.default_rng(3)
    tight = Tolerances(sensor_shift=0.05)
    made = perturb(exact, tight, rng)
    assert made.placements
    near, far = worst_bounds(made, Scene())
    assert near == pytest.approx(worst_bounds(exact, Scene())[0], rel=0.5)
    assert np.isfinite(far)
