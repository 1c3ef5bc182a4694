from __future__ import annotations

import math
import multiprocessing
import pickle
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import fields, replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from raytransfer import (
    MATERIALS,
    TCD1304,
    Lens,
    OpticalSystem,
    Plate,
    collimating_pair,
    prototype_head,
    telecentric_pair,
)
from raytransfer.analysis import line_profile
from raytransfer.irradiance import pixel_response
from raytransfer.lenses import Aperture, SphericalLens
from raytransfer.materials import D_LINE
from raytransfer.studies import image_position
from raytransfer.systems import Placement
from raytransfer.tolerances import (
    EXACT,
    ExecutorError,
    Interrupted,
    Tolerances,
    TrackingMetrics,
    draw,
    monte_carlo,
    parameters,
    perturb,
    spike,
)
from raytransfer.tracing import trace

if TYPE_CHECKING:
    from collections.abc import Callable
    from concurrent.futures import Executor
    from pathlib import Path

BK7 = MATERIALS["N-BK7"]
SINGLET = SphericalLens("L", 20.0, 50.0, -70.0, 3.0, BK7)
RELAY = OpticalSystem("relay", (SINGLET,), sensor_distance=70.0)
DOUBLET = OpticalSystem(
    "two", (SINGLET, SphericalLens("M", 20.0, 80.0, math.inf, 2.0, BK7)), (15.0,), 30.0
)
PAIR = replace(telecentric_pair("LJ1430L1"), sensor_distance=26.0)
SLIT = OpticalSystem(
    "slit",
    (
        Aperture("slit", x=2.0),
        Lens("C", 30.0, 32.0, 31.0, 5.87, BK7, bends="x"),
    ),
    (0.0,),
    56.0,
)
"""A cylinder that images LEDs at 2.5 m onto the line, nearly."""


def hit(system: OpticalSystem, x: float, to: tuple[float, float], distance: float) -> float:
    start = np.array([[x], [0.0], [-distance]])
    out = trace(system, start, np.array([[to[0]], [to[1]], [0.0]]) - start)
    assert out.arrived.all()
    return float(out.x[0])


def paraxial_focus(system: OpticalSystem, height: float = 1e-3) -> float:
    """Behind the last vertex, from exact rays near the axis."""
    out = trace(
        replace(system, sensor_distance=0.0), [[height], [0.0], [-1.0]], [[0.0], [0.0], [1.0]]
    )
    return float(-out.x[0] * out.direction[2, 0] / out.direction[0, 0])


# what is drawn


def test_every_parameter_is_named_once_and_moves_something() -> None:
    head = prototype_head(collimator=collimating_pair("LK1085L2", "LJ1328L2"))
    head = replace(
        head, elements=(Aperture("slit", x=5.0), *head.elements), gaps=(10.0, *head.gaps)
    )
    limits = parameters(head, Tolerances())
    assert len({p.name for p in limits}) == len(limits) == 52
    for name, unit, limit in limits:
        assert unit in ("mm", "rad", "relative", "", "K")
        assert perturb(head, Tolerances(), {name: limit / 2}) != head


def test_draws_are_uniform_within_limits_and_kept_when_one_is_tightened() -> None:
    loose = Tolerances()
    tight = replace(loose, tilt=0.0, gap=loose.gap / 2)
    names = {p.name: p.limit for p in parameters(DOUBLET, loose)}
    seen = [draw(DOUBLET, loose, np.random.default_rng(seed)) for seed in range(400)]
    relative = np.array([[drawn[name] / limit for name, limit in names.items()] for drawn in seen])
    assert np.abs(relative).max() <= 1
    np.testing.assert_allclose(relative.std(axis=0), 1 / math.sqrt(3), rtol=0.12)
    tightened = draw(DOUBLET, tight, np.random.default_rng(7))
    for name, value in tightened.items():
        assert "tilt" not in name or name.startswith("sensor")
        assert value == pytest.approx(seen[7][name] * (0.5 if name == "gap 1-2" else 1))


def test_no_tolerances_leave_the_system_as_it_is() -> None:
    for system in (RELAY, DOUBLET, SLIT, prototype_head(), telecentric_pair()):
        assert perturb(system, EXACT, np.random.default_rng(3)) == system
        assert perturb(system, Tolerances(), {}) == system
    metric = TrackingMetrics(rays=(32, 16))
    study = monte_carlo(SLIT, metric, tolerances=EXACT, samples=3)
    assert (study.values == study.nominal).all()
    assert study.drawn.shape == (3, 0)


@pytest.mark.parametrize("name", [field.name for field in fields(Tolerances)])
def test_limits_are_checked(name: str) -> None:
    with pytest.raises(ValueError, match=f"{name} = nan"):
        replace(EXACT, **{name: math.nan})
    if name == "index_change":
        return
    with pytest.raises(ValueError, match=rf"{name} = -0.1: allowed is >= 0.*±"):
        replace(EXACT, **{name: -0.1})


def test_likely_mistakes_are_named() -> None:
    with pytest.raises(ValueError, match="degrees"):
        Tolerances(tilt=1.0)
    with pytest.raises(ValueError, match="percent"):
        Tolerances(radius=1.0)
    with pytest.raises(ValueError, match=r"drawn 1 L decentr: known are 1 L decentre x"):
        perturb(RELAY, EXACT, {"1 L decentr": 0.1})


# what it does to light


def test_a_decentred_lens_takes_the_image_along() -> None:
    shift, distance = 0.2, 300.0
    matrix = RELAY.matrix("x")
    # seen from the lens the source has moved the other way
    expected = shift + float(image_position(matrix, distance, -shift, 70.0))
    moved = perturb(RELAY, EXACT, {"1 L decentre x": shift})
    assert hit(moved, 0.0, (shift, 0.0), distance) == pytest.approx(expected, rel=1e-4)
    assert expected > shift


def test_a_shifted_sensor_sees_the_image_shifted_back() -> None:
    before = hit(DOUBLET, 20.0, (1.0, 2.0), 500.0)
    moved = perturb(DOUBLET, EXACT, {"sensor decentre x": 0.25})
    assert hit(moved, 20.0, (1.0, 2.0), 500.0) == pytest.approx(before - 0.25, abs=1e-12)


def test_a_tilted_sensor_cuts_the_rays_elsewhere() -> None:
    angle, start = 0.05, np.array([[60.0], [0.0], [-500.0]])
    flat = trace(DOUBLET, start, -start)
    slope = flat.direction[0, 0] / flat.direction[2, 0]
    # about Y the line's +X end comes toward the light
    expected = flat.x[0] / (math.cos(angle) + slope * math.sin(angle))
    tilted = perturb(DOUBLET, EXACT, {"sensor tilt y": angle})
    assert trace(tilted, start, -start).x[0] == pytest.approx(expected, rel=1e-12)
    assert abs(expected - flat.x[0]) > 1e-3


def test_a_gap_moves_the_focus_by_the_square_of_the_magnification() -> None:
    step = 0.01
    first = OpticalSystem("first", DOUBLET.elements[:1]).effective_focal_length("x")
    magnification = DOUBLET.effective_focal_length("x") / first
    wider = perturb(DOUBLET, EXACT, {"gap 1-2": step})
    moved = paraxial_focus(wider) - paraxial_focus(DOUBLET)
    assert moved == pytest.approx(-(magnification**2) * step, rel=1e-3)
    assert moved == pytest.approx(
        wider.back_focal_length("x") - DOUBLET.back_focal_length("x"), rel=1e-4
    )


def test_warmth_changes_the_focal_length_of_a_lens_by_expansion_and_index() -> None:
    lens = Lens("C", 10.0, 10.0, 25.84, 4.0, BK7)
    system = OpticalSystem("one", (lens,), sensor_distance=47.0)
    t, warmer = Tolerances(), 20.0
    warm = perturb(system, t, {"temperature": warmer})
    before, after = (s.effective_focal_length("x") for s in (system, warm))
    n = BK7.index()
    expected = (t.glass_expansion - t.index_change / (n - 1)) * warmer
    assert after / before - 1 == pytest.approx(expected, rel=1e-3)
    assert warm.sensor_distance == pytest.approx(47.0 * (1 + 7e-5 * 20))


def test_a_mount_that_grows_as_its_glass_only_makes_all_larger() -> None:
    t = Tolerances(glass_expansion=1e-4, mount_expansion=1e-4, index_change=0.0)
    warm = perturb(DOUBLET, t, {"temperature": -30.0})
    for length in ("effective_focal_length", "back_focal_length"):
        cold, nominal = (getattr(system, length)("x") for system in (warm, DOUBLET))
        assert cold == pytest.approx(nominal * (1 - 3e-3), rel=1e-12)
    assert warm.length == pytest.approx(DOUBLET.length * (1 - 3e-3), rel=1e-12)


def test_another_melt_has_another_index_and_the_same_dispersion() -> None:
    system = perturb(OpticalSystem("p", (Plate("P", 2.0, BK7),)), EXACT, {"1 P index": 5e-4})
    (plate,) = system.elements
    assert isinstance(plate, Plate)
    assert plate.material.index(D_LINE) == pytest.approx(BK7.index() + 5e-4, abs=1e-15)
    spread = BK7.index(0.486) - BK7.index(0.656)
    assert plate.material.index(0.486) - plate.material.index(0.656) == pytest.approx(
        spread, rel=1e-3
    )
    constant = perturb(prototype_head(), EXACT, {"5 TCD1304 window index": -1e-3})
    window = constant.elements[-1]
    assert isinstance(window, Plate)
    assert window.material.index() == pytest.approx(1.499)


def test_shapes_are_changed_as_drawn() -> None:
    made = perturb(
        DOUBLET,
        EXACT,
        {
            "1 L front radius": 0.01,
            "1 L back radius": -0.02,
            "2 M front radius": 0.03,
            "2 M thickness": -0.05,
            "sensor z": 0.4,
        },
    )
    first, second = made.elements
    assert isinstance(first, SphericalLens)
    assert isinstance(second, SphericalLens)
    assert (first.front_radius, first.back_radius) == pytest.approx((50.5, -68.6))
    assert (second.front_radius, second.centre_thickness) == pytest.approx((82.4, 1.95))
    assert math.isinf(second.back_radius)
    assert made.sensor_distance == pytest.approx(30.4)
    narrow = perturb(SLIT, EXACT, {"1 slit opening x": -0.1}).elements[0]
    assert (narrow.aperture("x"), narrow.aperture("y")) == (1.9, math.inf)


def test_deviations_are_added_to_those_there_are() -> None:
    off = replace(RELAY, placements=(Placement((0.1, 0.2), (0.01, 0.0, 0.0)),))
    (place,) = perturb(off, EXACT, {"1 L decentre x": 0.3, "1 L tilt x": -0.03}).placements
    assert place.decentre == pytest.approx((0.4, 0.2))
    assert place.tilt == pytest.approx((-0.02, 0.0, 0.0))


def test_glass_stops_at_contact() -> None:
    touching = perturb(PAIR, EXACT, {"gap 1-2": -0.1})
    assert touching.gaps == (0.0,)
    tilted = perturb(PAIR, EXACT, {"gap 1-2": -0.1, "1 LJ1430L1 tilt x": 0.005})
    # the vertices' lines touch at one end, 16 mm from the middle
    assert tilted.gaps[0] == pytest.approx(16 * 0.005, abs=0.01)
    with pytest.raises(ValueError, match="overlap"):
        replace(tilted, gaps=(tilted.gaps[0] - 2e-3,))
    sunk = perturb(replace(PAIR, sensor_distance=0.05), EXACT, {"sensor z": -0.1})
    assert sunk.sensor_distance == 0.0


def test_what_cannot_be_made_is_refused() -> None:
    thin = OpticalSystem("thin", (replace(SINGLET, centre_thickness=1.8),))
    with pytest.raises(ValueError, match="cross before the edge"):
        perturb(thin, EXACT, {"1 L thickness": -0.2})


# metrics


def test_metrics_follow_the_paraxial_image() -> None:
    metric = TrackingMetrics(wavelength=D_LINE)
    values = metric(SLIT)
    assert values["offset"] == pytest.approx(0.0, abs=1e-6)
    assert values["bend"] == pytest.approx(0.0, abs=1e-6)
    assert values["height"] == pytest.approx(0.0, abs=1e-6)
    magnification = float(image_position(SLIT.matrix("x"), 2500.0, 1.0, 56.0)) / TCD1304.pitch
    assert values["scale"] == pytest.approx(magnification, rel=0.01)
    shifted = metric(perturb(SLIT, EXACT, {"sensor decentre x": 0.2}))
    assert shifted["offset"] == pytest.approx(-25.0, abs=0.01)
    assert shifted["scale"] == pytest.approx(values["scale"], rel=1e-4)
    # all light of a strip across the slit, as high as a pixel magnified to the front, but for
    # 4 % at each of two faces
    strip = 2.0 * TCD1304.pixel_height * 2500 / (2500 + 56 + 5.87 / BK7.index())
    assert values["light"] == pytest.approx(strip * 0.9177, rel=0.01)


def test_a_spike_is_measured_as_in_the_analysis() -> None:
    place = (400.0, 100.0, 2500.0)
    head = prototype_head()
    light = spike(head, place, rays=(256, 64))
    whole = line_profile(head, place, rays=(256, 64), wavelength=0.63)
    assert light.median == pytest.approx(whole.median / TCD1304.pitch, abs=0.3)
    assert light.width == pytest.approx(whole.w80 / TCD1304.pitch, abs=0.3)
    response = pixel_response(head, place, wavelength=0.63, rays=(256, 64))
    assert light.light == pytest.approx(response.sum() * 2500.0**2, rel=1e-9)


def test_a_spike_narrower_than_a_pixel_goes_on_evenly() -> None:
    steps = TCD1304.pitch * np.arange(5) / 4
    seen = [
        spike(perturb(SLIT, EXACT, {"sensor decentre x": step}), (0.0, 0.0, 2500.0)).median
        for step in steps.tolist()
    ]
    np.testing.assert_allclose(seen, -np.arange(5) / 4, atol=0.01)


def test_a_rolled_cylinder_turns_height_into_sideways() -> None:
    roll = 0.004
    values = TrackingMetrics(wavelength=D_LINE, up=300.0)(
        perturb(SLIT, EXACT, {"2 C tilt z": roll})
    )
    magnification = float(image_position(SLIT.matrix("x"), 2500.0, 1.0, 56.0)) / TCD1304.pitch
    # in the lens's frame an LED at height h stands at x = h roll
    assert values["height"] == pytest.approx(magnification * 300.0 * roll, rel=0.02)


def test_darkness_is_an_error() -> None:
    with pytest.raises(ValueError, match=r"slit: no light of .* distance = \(0.0, -5000"):
        TrackingMetrics(up=5000.0)(SLIT)


# studies


def planted(system: OpticalSystem) -> dict[str, float]:
    """Of the gap most of all, a little of the sensor; and the square of the gap's error."""
    assert system.sensor_distance is not None
    gap, sensor = system.gaps[0] - 15.0, system.sensor_distance - 30.0
    return {"linear": 10.0 * gap + 2.0 * sensor, "square": gap**2, "constant": 4.0}


def test_a_planted_dominant_parameter_is_found() -> None:
    limits = replace(Tolerances(), temperature=0.0)
    study = monte_carlo(DOUBLET, planted, tolerances=limits, samples=200, seed=4)
    names, coefficients, explained = study.sensitivities("linear")
    assert names[:2] == ("gap 1-2", "sensor z")
    both = math.hypot(10, 2)
    np.testing.assert_allclose(coefficients[:2], [10 / both, 2 / both], rtol=0.1)
    assert np.abs(coefficients[2:]).max() < 1e-9
    assert explained == pytest.approx(1.0)
    assert study.sensitivities("square").explained < 0.2
    assert math.isnan(study.sensitivities("constant").explained)
    assert "linear     100%     gap 1-2 +0.9" in study.table()
    assert "nothing: it does not vary" in study.table()
    assert "e-1" not in study.table()
    with pytest.raises(ValueError, match="metric 'lin': known are linear, square, constant"):
        study.sensitivities("lin")


def test_a_short_study_ranks_nothing_and_is_the_start_of_a_longer_one() -> None:
    short, longer = (monte_carlo(DOUBLET, planted, samples=n, seed=9) for n in (5, 8))
    assert (longer.values[:5] == short.values).all()
    assert (longer.drawn[:5] == short.drawn).all()
    assert list(longer.numbers) == list(range(8))
    with pytest.raises(ValueError, match=r"5 samples cannot tell 23 parameters apart: .* 25"):
        short.sensitivities("linear")
    assert "hangs on" not in short.table()
    column = [p.name for p in short.parameters].index("gap 1-2")
    np.testing.assert_allclose(
        short.percentiles([50])[0, 1], np.median(short.values[:, 1]), rtol=1e-12
    )
    assert np.ptp(short.drawn[:, column]) > 0
    np.testing.assert_allclose(short.change("constant"), 0.0)


class Sometimes:
    """Counts its calls and raises at one of them."""

    def __init__(self, at: int, error: BaseException) -> None:
        self.calls = 0
        self.at = at
        self.error = error

    def __call__(self, system: OpticalSystem) -> float:
        self.calls += 1
        if self.calls == self.at:
            raise self.error
        return system.gaps[0]


def test_failures_are_kept_with_what_was_drawn() -> None:
    metric = Sometimes(4, ValueError("too dark"))
    study = monte_carlo(DOUBLET, metric, samples=6, seed=1)
    assert list(study.numbers) == [0, 1, 3, 4, 5]
    (failure,) = study.failures
    assert failure.number == 2
    assert failure.error == "ValueError: too dark"
    seed = np.random.SeedSequence(1).spawn(3)[2]
    assert failure.drawn == draw(DOUBLET, Tolerances(), np.random.default_rng(seed))
    assert "5 samples, 1 failed" in study.table()


def test_a_metric_that_fails_on_the_drawing_ends_the_study_at_once() -> None:
    with pytest.raises(ValueError, match="too dark"):
        monte_carlo(DOUBLET, Sometimes(1, ValueError("too dark")), samples=2)
    with pytest.raises(ValueError, match="metric value = nan"):
        monte_carlo(DOUBLET, lambda _: math.nan, samples=2)


def test_ctrl_c_keeps_what_is_done() -> None:
    with pytest.raises(KeyboardInterrupt, match="3 samples were done") as stopped:
        monte_carlo(DOUBLET, Sometimes(5, KeyboardInterrupt()), samples=50, seed=1)
    assert isinstance(stopped.value, Interrupted)
    whole = monte_carlo(DOUBLET, Sometimes(0, ValueError()), samples=3, seed=1)
    assert (stopped.value.study.values == whole.values).all()


def test_ctrl_c_keeps_what_an_executor_has_done() -> None:
    with ThreadPoolExecutor(1) as executor, pytest.raises(Interrupted) as stopped:
        monte_carlo(
            DOUBLET, Sometimes(9, KeyboardInterrupt()), samples=40, seed=1, executor=executor
        )
    done = stopped.value.study
    whole = monte_carlo(DOUBLET, Sometimes(0, ValueError()), samples=40, seed=1)
    assert list(done.numbers[:7]) == list(range(7))
    assert (done.values == whole.values[done.numbers]).all()


def test_an_executor_that_fails_says_why() -> None:
    with spawning(1) as executor, pytest.raises(ExecutorError, match="a metric that pickle"):
        monte_carlo(DOUBLET, lambda system: system.length, samples=4, executor=executor)


def spawning(workers: int) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"))


def same_as_alone(executor: Executor) -> None:
    head = prototype_head()
    metric = TrackingMetrics(rays=(48, 24))
    alone = monte_carlo(head, metric, samples=50, seed=11)
    spread = monte_carlo(head, metric, samples=50, seed=11, executor=executor)
    assert not alone.failures
    assert not spread.failures
    assert list(spread.numbers) == list(range(50))
    assert (spread.drawn == alone.drawn).all()
    assert (spread.values == alone.values).all()


@pytest.mark.parametrize("kind", [lambda: ThreadPoolExecutor(2), lambda: spawning(2)])
def test_executors_give_the_same_numbers(kind: Callable[[], Executor]) -> None:
    with kind() as executor:
        same_as_alone(executor)


def test_a_dask_cluster_gives_the_same_numbers(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(
            n_workers=2,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address=None,
            local_directory=str(tmp_path),
        ) as cluster,
        distributed.Client(cluster) as client,
        client.get_executor() as executor,
    ):
        same_as_alone(executor)


def test_studies_can_be_stored() -> None:
    study = monte_carlo(DOUBLET, planted, samples=3)
    again = pickle.loads(pickle.dumps(study))  # noqa: S301
    assert again.table() == study.table()


def test_stopped_studies_can_be_sent_from_one_process_to_another() -> None:
    study = monte_carlo(DOUBLET, planted, samples=3)
    for stopped in (Interrupted(study), ExecutorError(study, "OSError: no workers")):
        again = pickle.loads(pickle.dumps(stopped))  # noqa: S301
        assert type(again) is type(stopped)
        assert str(again) == str(stopped)
        assert again.study.table() == study.table()
