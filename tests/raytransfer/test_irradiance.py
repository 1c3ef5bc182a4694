"""Light on the pixels: by counting rays, by closed forms, to the last joule; and the table."""

from __future__ import annotations

import pickle
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest

from raytransfer import (
    MATERIALS,
    TCD1304,
    Aperture,
    Lens,
    OpticalSystem,
    Placement,
    SphericalLens,
    prototype_head,
    reference,
    telecentric_pair,
    tracing,
)
from raytransfer.illumination import pixel_solid_angles
from raytransfer.irradiance import (
    EnergyBudget,
    LightTable,
    disc,
    disc_image,
    irradiance,
    photon_energy,
    pixel_budget,
    pixel_response,
)
from raytransfer.sources import Emitter, Lobe, Spectrum

if TYPE_CHECKING:
    from numpy.typing import NDArray

HEAD = prototype_head()
SLIT = replace(HEAD, elements=(Aperture("slit", x=5.0), *HEAD.elements), gaps=(8.0, *HEAD.gaps))
RED = 0.63
Place = tuple[float, float, float]


@cache
def fine(system: OpticalSystem, position: Place) -> NDArray[np.float64]:
    """What 20 times as many rays as usual give."""
    return pixel_response(system, position, wavelength=RED, rays=(1700, 580))


def counted(system: OpticalSystem, position: Place, rays: int) -> NDArray[np.float64]:
    """By throwing random rays of the reference tracer into the pixels on which they fall."""
    source = np.array([position[0], position[1], -position[2]])[:, None]
    rough = tracing.bundle(system, position, 60, 400)
    landed = reference.trace(system, rough.position, rough.direction, wavelength=RED)
    near = rough.pupil[1][landed.arrived & (np.abs(landed.y) < 0.3)]
    left, right, *_ = tracing.front_opening(system, position)
    low, high = near.min() - 0.05, near.max() + 0.05  # no other rows reach the line
    rng = np.random.default_rng(7)
    pixels = np.zeros(TCD1304.pixels)
    for _ in range(10):
        pupil = np.stack(
            [
                rng.uniform(left, right, rays // 10),
                rng.uniform(low, high, rays // 10),
                np.zeros(rays // 10),
            ]
        )
        to = pupil - source
        cell = (right - left) * (high - low) / rays
        solid_angle = cell * position[2] / (to**2).sum(axis=0) ** 1.5
        landed = reference.trace(system, np.repeat(source, rays // 10, 1), to, wavelength=RED)
        on_line = landed.arrived & (np.abs(landed.y) <= TCD1304.pixel_height / 2)
        at = np.floor(landed.x[on_line] / TCD1304.pitch + TCD1304.pixels / 2).astype(int)
        inside = (at >= 0) & (at < TCD1304.pixels)
        power = (solid_angle * landed.transmission)[on_line][inside]
        pixels += np.bincount(at[inside], power, TCD1304.pixels)
    return pixels


@pytest.mark.parametrize(
    ("system", "position"),
    [
        (HEAD, (0.0, 0.0, 1300.0)),
        (HEAD, (700.0, 900.0, 2000.0)),
        (SLIT, (1500.0, 0.0, 4150.0)),
    ],
)
def test_it_is_what_counting_rays_gives(system: OpticalSystem, position: Place) -> None:
    """Summed over 16 pixels and over 1,000: counting has noise, the wider the sum the less."""
    expected = counted(system, position, 1_000_000)
    light = pixel_response(system, position, wavelength=RED)
    assert light.sum() == pytest.approx(expected.sum(), rel=4e-3)
    coarse = light.reshape(-1, 16).sum(axis=1), expected.reshape(-1, 16).sum(axis=1)
    assert np.sqrt(np.mean((coarse[0] - coarse[1]) ** 2)) < 0.01 * coarse[1].max()
    pixels = np.arange(TCD1304.pixels)
    middle = [np.average(pixels, weights=w) for w in (light, expected)]
    width = np.sqrt(np.average((pixels - middle[0]) ** 2, weights=light))
    assert abs(middle[0] - middle[1]) < 4 * width / np.sqrt(200_000)  # rays on the line, about


def test_a_pinhole_camera_is_geometry() -> None:
    """One small hole and no glass: its projection, evenly lit, with cos⁴ of the field."""
    camera = OpticalSystem("pinhole", (Aperture("hole", 0.4, 2.0),), (), 20.0)
    for x in (0.0, 500.0):
        light = pixel_response(camera, (x, 30.0, 1000.0), wavelength=RED, rays=(64, 64))
        lit = np.flatnonzero(light)
        # the shadow grows by 1 + 20/1000; its middle is inverted
        assert (lit[-1] - lit[0]) * 0.008 == pytest.approx(0.4 * 1.02, abs=0.008)
        assert np.average(TCD1304.position(np.arange(3648)), weights=light) == pytest.approx(
            -x / 50, abs=1e-3
        )
        # 0.2 mm of 2.04 mm are pixels; the shadow covers them, being 2.04 mm and −0.6 mm off
        seen = 0.4 * 2.0 * 1000 / (1000**2 + x**2 + 30**2) ** 1.5
        assert light.sum() == pytest.approx(seen * 0.2 / 2.04, rel=2e-3)


def test_at_small_apertures_it_becomes_the_paraxial_light() -> None:
    """But for what the surfaces reflect."""
    stop = Aperture("stop", 1.0, 1.0)
    system = OpticalSystem("stopped", (stop, *HEAD.elements), (8.0, *HEAD.gaps), 0.5)
    exact = pixel_response(system, (20.0, 10.0, 1500.0), wavelength=RED)
    paraxial = pixel_solid_angles(system, (20.0, 10.0, 1500.0))
    ratio = exact.sum() / paraxial.sum()
    surfaces = [(1.52, 8), (1.5, 2)]
    expected = np.prod([(1 - ((n - 1) / (n + 1)) ** 2) ** count for n, count in surfaces])
    assert ratio == pytest.approx(expected, rel=2e-3)
    middles = [np.average(np.arange(3648), weights=light) for light in (exact, paraxial)]
    assert middles[0] == pytest.approx(middles[1], abs=0.05)


SYSTEMS = {
    "head": HEAD,
    "slit": SLIT,
    "pair": replace(telecentric_pair(gap=0.17), sensor_distance=26.1),
    "off its place": replace(
        HEAD,
        placements=(Placement((0.3, -0.2), (0.001, 0.002, 0.003)), *[Placement()] * 4),
        sensor_placement=Placement((0.1, 0.02), (0.01, 0.02, 0.03)),
    ),
    "sphere": OpticalSystem(
        "sphere", (SphericalLens("ball", 20.0, 20.0, -20.0, 8.0, MATERIALS["N-SF11"]),), (), 14.0
    ),
}


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("position", [(0.0, 0.0, 900.0), (1500.0, 400.0, 3000.0)])
def test_no_joule_is_lost(name: str, position: Place) -> None:
    """Emitted equals the sum of the parts, each added up on its own."""
    budget = pixel_budget(SYSTEMS[name], position, wavelength=RED, rays=(90, 70))
    assert budget.emitted > 0
    assert budget.accounted == pytest.approx(budget.emitted, rel=1e-12, abs=0)
    assert all(amount >= 0 for _, amount in budget.parts())


def test_each_loss_is_where_it_belongs() -> None:
    """Against the reference's rays: by surface and by kind."""
    position, nx, ny = (1900.0, 500.0, 4150.0), 120, 90
    rays = tracing.bundle(HEAD, position, nx, ny)
    landed = reference.trace(HEAD, rays.position, rays.direction, wavelength=RED)
    budget = pixel_budget(HEAD, position, wavelength=RED, rays=(nx, ny))
    assert budget.emitted == pytest.approx(rays.solid_angle.sum(), rel=1e-12)
    assert sum(budget.totally_reflected) > 0
    assert len(budget.surfaces) == 11
    for kind, amounts in (
        (tracing.Status.MISSED, budget.missed),
        (tracing.Status.BLOCKED, budget.blocked),
        (tracing.Status.REFLECTED, budget.totally_reflected),
    ):
        for surface, amount in enumerate(amounts):
            lost = (landed.status == kind) & (landed.surface == surface)
            # less by what was reflected on the way: near grazing more than half
            full = rays.solid_angle[lost].sum()
            assert amount <= full * (1 + 1e-12)
            assert amount >= 0.25 * full
            assert (amount > 0) == bool(lost.any())
    arrived = (rays.solid_angle * landed.transmission).sum()
    on_sensor = budget.on_pixels + budget.beside_line + budget.beyond_ends
    assert on_sensor == pytest.approx(arrived, rel=1e-12)


def test_the_first_surface_reflects_what_fresnel_says() -> None:
    plate = Lens("flat", 10, 10, 1e9, 1.0, MATERIALS["thesis glass"])
    system = OpticalSystem("plate", (plate,), (), 10.0)
    budget = pixel_budget(system, (0.0, 0.0, 1e5), wavelength=RED, rays=(40, 40))
    once = (0.52 / 2.52) ** 2
    assert budget.reflected == pytest.approx(
        (budget.emitted * once, budget.emitted * (1 - once) * once, 0.0), rel=1e-6
    )


def test_electrons_by_hand() -> None:
    """W/sr times sr and seconds, over the photon's energy, times quantum efficiency."""
    position = (300.0, 0.0, 1300.0)
    red = Emitter(power=0.5, spectrum=Spectrum.line(0.6))
    light = irradiance(HEAD, red, position, integration_time=2e-5, rays=(96, 64))
    response = pixel_response(HEAD, position, wavelength=0.6, rays=(96, 64))
    assert TCD1304.response is not None
    efficiency = float(TCD1304.response.quantum_efficiency(0.6))
    cosine = 1300 / np.hypot(300, 1300)  # it faces along the axis
    by_hand = 0.5 / np.pi * cosine * 2e-5 * efficiency / photon_energy(0.6) * response
    assert light.electrons.sum() == pytest.approx(by_hand.sum(), rel=2e-3)
    # across the front the angle changes by a degree, and cosines with it
    assert light.electrons == pytest.approx(by_hand, rel=8e-3, abs=1e-3 * by_hand.max())
    assert light.budget.accounted == pytest.approx(light.budget.emitted, rel=1e-12)
    joule = light.budget.on_pixels * efficiency / float(photon_energy(0.6))
    assert light.electrons.sum() == pytest.approx(joule, rel=1e-12)


def test_where_the_emitter_faces_counts() -> None:
    """A narrow lobe turned at the head, past it and away from it."""
    narrow = Emitter(lobe=Lobe.measured([0, 0.1, 0.2], [1, 1, 0]))
    position = (400.0, 0.0, 1300.0)

    def total(*facing: float) -> float:
        light = irradiance(
            HEAD,
            narrow,
            position,
            integration_time=1e-5,
            rays=(64, 64),
            facing=(facing[0], facing[1], facing[2]),
        )
        return float(light.electrons.sum())

    at_it = total(-400, 0, 1300)
    assert at_it > 0
    assert total(-800, 0, 2600) == pytest.approx(at_it, rel=1e-12)
    assert total(0, 0, 1) == 0  # 17° past it
    assert total(400, 0, -1300) == 0
    bare = irradiance(HEAD, Emitter(), position, integration_time=1e-5, rays=(64, 64))
    # the same power in a cone of ± 0.1 to 0.2 rad is some dozens of times as bright
    assert 20 < at_it / bare.electrons.sum() < 60


@pytest.mark.parametrize("degrees", [1, 3, 30])
def test_narrow_lobes_are_resolved(degrees: float) -> None:
    """Turned aside by half of where it ends, a lobe that falls linearly gives half its light."""
    lobe = Lobe.measured(np.radians([0, degrees]), [1, 0])
    angle = np.radians(degrees / 2)
    place = (0.0, 0.0, 30_000.0)  # so far away that all rays are at one angle
    light = irradiance(
        SLIT,
        Emitter(lobe=lobe),
        place,
        integration_time=1e-3,
        rays=(64, 64),
        facing=(np.sin(angle), 0.0, np.cos(angle)),
    )
    response = pixel_response(SLIT, place, wavelength=RED, rays=(64, 64))
    joule = 0.25e-3 * response.sum() * float(lobe.intensity(1.0)) / 2
    assert light.budget.on_pixels == pytest.approx(joule, rel=2e-3)


def test_a_spectrum_is_the_sum_of_its_lines() -> None:
    position = (200.0, 0.0, 1300.0)
    white = Spectrum((0.45, 0.55, 0.65), (1.0, 2.0, 1.0))
    whole = irradiance(
        HEAD, Emitter(1.0, white), position, integration_time=1e-5, rays=(64, 64), wavelengths=3
    )
    lines = [
        irradiance(
            HEAD,
            Emitter(share, Spectrum.line(wavelength)),
            position,
            integration_time=1e-5,
            rays=(64, 64),
        ).electrons
        for wavelength, share in zip(*white.samples(3), strict=True)
    ]
    assert whole.electrons == pytest.approx(np.sum(lines, axis=0), rel=1e-12)


def test_a_large_emitter_is_blurred_by_its_image() -> None:
    """A disc of diameter D has a standard deviation of D/4; the lens makes it f/distance as large."""
    position, extent = (0.0, 0.0, 1300.0), 40.0
    sharp, wide = (
        irradiance(
            SLIT, Emitter(extent=size), position, integration_time=1e-5, rays=(96, 96)
        ).electrons
        for size in (0.0, extent)
    )
    pixels = np.arange(TCD1304.pixels)
    spread = [
        np.average((pixels - np.average(pixels, weights=w)) ** 2, weights=w) for w in (sharp, wide)
    ]
    moved = [
        np.average(pixels, weights=pixel_response(SLIT, (x, 0.0, 1300.0), wavelength=RED))
        for x in (-5.0, 5.0)
    ]
    scale = abs(moved[1] - moved[0]) / 10
    assert spread[1] - spread[0] == pytest.approx((extent / 4 * scale) ** 2, rel=0.01)
    assert wide.sum() == pytest.approx(sharp.sum(), rel=1e-3)
    # one shape, not a row of spikes: no dip on the way up and down
    level = wide / wide.max()
    top = int(level.argmax())
    rise, fall = np.maximum.accumulate(level[:top]), np.maximum.accumulate(level[:top:-1])
    assert (rise - level[:top]).max() < 0.02
    assert (fall - level[:top:-1]).max() < 0.02


@pytest.mark.parametrize("diameter", [0.0, 0.7, 1.0, 2.6, 8.0, 20.3, 183.0])
def test_the_image_of_a_disc_is_what_many_points_make(diameter: float) -> None:
    """Shares of its points by part of the line; by chords, the same where parts are fine."""
    image = disc_image(diameter)
    half = len(image) // 2
    places, shares = zip(*disc((0.0, 0.0, 1.0), diameter, 100_001), strict=True)
    edges = np.arange(-half - 0.5, half + 1)
    points, _ = np.histogram([x for x, _, _ in places], edges, weights=shares)
    assert image == pytest.approx(points, abs=3e-5)
    assert image.sum() == pytest.approx(1.0, abs=1e-12)
    chords = disc_image(diameter, chords=True)
    assert chords.sum() == pytest.approx(1.0, abs=1e-12)
    chords = np.pad(chords, (len(image) - len(chords)) // 2)
    assert np.abs(chords - image).sum() < (0.01 if diameter > 20 else 0.5)


def test_a_disc_without_a_size_is_refused() -> None:
    for diameter in (-1.0, np.nan):
        with pytest.raises(ValueError, match="diameter"):
            disc_image(diameter)


def test_threads_change_nothing() -> None:
    one, two = (
        pixel_response(HEAD, (300.0, 50.0, 1300.0), wavelength=RED, threads=threads)
        for threads in (1, 2)
    )
    assert np.array_equal(one, two)


@pytest.mark.parametrize("position", [(0.0, 0.0, 1300.0), (300.0, 0.0, 4150.0)])
def test_few_rays_are_enough(position: Place) -> None:
    """RMS error over the pixels that get light, against 100 times the rays: 1 % of the peak."""
    usual = pixel_response(HEAD, position, wavelength=RED)
    most = pixel_response(HEAD, position, wavelength=RED, rays=(3840, 1280))
    lit = most > 0
    assert np.sqrt(np.mean((usual - most)[lit] ** 2)) < 0.01 * most.max()


TABLES = {"head": LightTable(HEAD, wavelength=RED), "slit": LightTable(SLIT, wavelength=RED)}


@pytest.mark.parametrize("name", TABLES)
def test_the_table_is_the_trace(name: str) -> None:
    """At random places that are no nodes: 1 % of the peak, RMS over the pixels that get light."""
    rng = np.random.default_rng(20)
    table = TABLES[name]
    worst = []
    for _ in range(6):
        distance = 1 / rng.uniform(1 / 5000, 1 / 900)
        position = (
            float(rng.uniform(-0.4, 0.4) * distance),
            float(rng.uniform(-0.3, 0.3) * distance),
            float(distance),
        )
        exact, quick = fine(table.system, position), table.solid_angles(position)
        lit = exact > 0
        worst.append(np.sqrt(np.mean((quick - exact)[lit] ** 2)) / exact.max())
        assert quick.sum() == pytest.approx(exact.sum(), rel=3e-3)
    assert max(worst) < 0.01


def test_the_table_places_a_sharp_spike_to_a_hundredth_of_a_pixel() -> None:
    pixels = np.arange(TCD1304.pixels)
    for position in ((123.0, 0.0, 1300.0), (-1234.0, 45.0, 4150.0)):
        quick, exact = TABLES["slit"].solid_angles(position), fine(SLIT, position)
        found = [np.average(pixels, weights=light) for light in (quick, exact)]
        assert found[0] == pytest.approx(found[1], abs=0.01)


def test_the_table_is_dark_where_no_light_comes_and_traces_where_it_cannot_interpolate() -> None:
    table = TABLES["head"]
    assert not table.solid_angles((0.0, 0.0, -10.0)).any()
    assert not table.solid_angles((50_000.0, 0.0, 1000.0)).any()
    near = (10.0, 0.0, 150.0)
    assert np.array_equal(table.solid_angles(near), pixel_response(HEAD, near, wavelength=RED))
    # at the rim of the field some nodes are lit and some are not
    slopes = np.arange(0.6, 1.4, 0.01)
    rim = [(float(slope * 1000), 0.0, 1000.0) for slope in slopes]
    totals = np.array([table.solid_angles(place).sum() for place in rim])
    exact = np.array([pixel_budget(HEAD, p, wavelength=RED).on_pixels for p in rim])
    assert totals == pytest.approx(
        exact, abs=2e-3 * pixel_response(HEAD, (0, 0, 1000), wavelength=RED).sum()
    )


def test_the_table_can_be_sent_to_another_process() -> None:
    table, place = TABLES["slit"], (123.0, 0.0, 1300.0)
    copy = pickle.loads(pickle.dumps(table))  # noqa: S301
    assert np.array_equal(copy.solid_angles(place), table.solid_angles(place))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_the_table_refuses_what_is_nowhere(bad: float) -> None:
    for at in range(3):
        place = [0.0, 0.0, 1000.0]
        place[at] = bad
        with pytest.raises(ValueError, match=rf"^position\[{at}\] = {bad}: allowed are finite"):
            TABLES["head"].solid_angles((place[0], place[1], place[2]))


BEHIND = replace(  # an edge that light meets after the lenses moves through the pupil
    telecentric_pair(gap=0.17),
    elements=(*telecentric_pair().elements, Aperture("slit behind", x=2.0)),
    gaps=(0.17, 3.0),
    sensor_distance=23.1,
)
ASKEW = replace(
    SLIT,
    elements=(Aperture("hole", x=5.0, y=8.0), *HEAD.elements),
    placements=(Placement((1.0, 2.0)), *[Placement()] * 5),
)


@pytest.mark.parametrize("system", [BEHIND, ASKEW], ids=lambda system: system.elements[-1].part)
def test_the_table_traces_where_it_would_be_wrong(system: OpticalSystem) -> None:
    rng = np.random.default_rng(21)
    table = LightTable(system, wavelength=RED)
    for _ in range(8):
        distance = float(rng.uniform(600, 4000))
        position = (*(rng.uniform(-0.4, 0.4, 2) * distance).tolist(), distance)
        exact = pixel_response(system, position, wavelength=RED)
        quick = table.solid_angles(position)
        lit = (exact > 0) | (quick > 0)
        if lit.any():
            error = np.sqrt(np.mean((quick - exact)[lit] ** 2))
            assert error < 0.03 * exact.max()


def test_the_table_forgets_and_gives_the_same_again() -> None:
    table = LightTable(SLIT, wavelength=RED)
    table.CELLS = 2
    places = [(slope * 1000.0, 0.0, 1000.0) for slope in (0.0, 0.11, 0.22, 0.0)]
    first, *_, last = (table.solid_angles(place) for place in places)
    assert np.array_equal(first, last)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"position": (0.0, 0.0, 0.0)}, "before the first vertex"),
        ({"position": (0.0, 0.0, 1.0)}, "sources are before the lenses"),
        ({"position": (0.0, np.nan, 1000.0)}, "finite"),
        ({"rays": (0, 16)}, "rays"),
        ({"rays": (100, 2)}, "16 rows or more"),
        ({"integration_time": -1.0}, "integration_time"),
        ({"integration_time": np.inf}, "finite"),
        ({"facing": (0.0, 0.0, 0.0)}, "direction"),
        ({"wavelengths": 0}, "n = 0"),
        ({"system": telecentric_pair()}, "sensor_distance"),
        ({"sensor": replace(TCD1304, response=None)}, "spectral response"),
        (
            {"system": OpticalSystem("open", (Aperture("slit", x=5.0),), (), 10.0)},
            "no edge limits the light",
        ),
    ],
)
def test_what_makes_no_sense_is_refused(wrong: dict[str, object], message: str) -> None:
    arguments: dict[str, object] = {
        "system": HEAD,
        "emitter": Emitter(),
        "position": (0.0, 0.0, 1000.0),
        "integration_time": 1e-5,
        "rays": (16, 16),
    } | wrong
    with pytest.raises(ValueError, match=message):
        irradiance(**arguments)  # type: ignore[arg-type]


def test_a_budget_can_be_read() -> None:
    budget = pixel_budget(HEAD, (0.0, 0.0, 1300.0), wavelength=RED, rays=(40, 40))
    assert isinstance(budget, EnergyBudget)
    names = [name for name, _ in budget.parts()]
    assert "blocked at PCX_15_30_20" in names
    assert "reflected at TCD1304 window, back" in names
