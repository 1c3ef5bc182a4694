"""What the comparison with other tracers calls an agreement; peers are replaced by the reference."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from benchmarks import agreement, peers
from benchmarks.agreement import (
    GRAZING,
    NEAR,
    TOLERANCE,
    Comparison,
    cylinder,
    pair_with_sensor,
    plate,
    random_system,
    skew_rays,
    slit,
    sphere,
)
from raytransfer import reference
from raytransfer.prescription import surface_frames
from raytransfer.tracing import Status, Trace, trace

if TYPE_CHECKING:
    from benchmarks.peers import Array, Fates, Index
    from raytransfer.systems import OpticalSystem

KINDS = (cylinder, plate, slit, sphere)


def as_fates(end: Trace) -> Fates:
    return peers.Fates(end.x, end.y, end.status, end.surface, np.ones(len(end.x)))


@pytest.fixture(scope="module")
def ends() -> Trace:
    pair = pair_with_sensor()
    end = trace(pair, *skew_rays(np.random.default_rng(2), pair, 500))
    assert end.arrived.any()
    assert not end.arrived.all()
    return end


def compared(ours: Trace, theirs: Fates) -> Comparison:
    result = Comparison("peer", "systems")
    result.add("system", ours, theirs)
    return result


def test_equal_fates_agree(ends: Trace) -> None:
    result = compared(ends, as_fates(ends))
    assert result.holds
    assert (result.rays, result.worst, result.disagreements) == (500, 0.0, [])
    assert sum(result.lost.values()) == np.count_nonzero(~ends.arrived)


@pytest.mark.parametrize("what", ["status", "surface"])
@pytest.mark.parametrize("arrived", [True, False])
def test_one_fate_that_differs_is_named(ends: Trace, what: str, arrived: bool) -> None:
    ray = int(np.flatnonzero(ends.arrived == arrived)[7])
    changed = getattr(ends, what).copy()
    changed[ray] = (changed[ray] + 1) % 4
    result = compared(ends, replace(as_fates(ends), **{what: changed}))
    assert not result.holds
    assert len(result.disagreements) == 1
    assert f"ray {ray}:" in result.disagreements[0]


def moved(ends: Trace, ray: int, by: float, x: float = 1.0, cosine: float = 1.0) -> Comparison:
    """Compare where a peer has one ray at another place."""
    ours, theirs, cosines = ends.x.copy(), ends.x.copy(), np.ones(len(ends.x))
    ours[ray], theirs[ray], cosines[ray] = x, x + by, cosine
    y = np.zeros(len(ours))
    fates = replace(as_fates(ends), x=theirs, y=y, cosine=cosines)
    return compared(replace(ends, x=ours, y=y), fates)


@pytest.mark.parametrize(
    ("by", "x", "cosine", "expected"),
    [
        (0.9 * TOLERANCE, 1.0, 1.0, True),
        (-0.9 * TOLERANCE, 1.0, 1.0, True),
        (1.1 * TOLERANCE, 1.0, 1.0, False),
        (-1.1 * TOLERANCE, 1.0, 1.0, False),
        (1.1 * TOLERANCE, 1.0, GRAZING, False),  # not yet near grazing
        (1.1 * TOLERANCE, 1.0, GRAZING / 2, True),
        (3 * TOLERANCE / GRAZING, 1.0, GRAZING / 2, False),
        (15 * TOLERANCE, 0.7 * NEAR, 1.0, False),  # on the sensor nothing is relative
        (15 * TOLERANCE, 20 * NEAR, 1.0, True),
        (40 * TOLERANCE * NEAR, 20 * NEAR, 1.0, False),
        (math.nan, 1.0, 1.0, False),
        (math.nan, 1.0, GRAZING / 2, False),
    ],
)
def test_positions(ends: Trace, by: float, x: float, cosine: float, expected: bool) -> None:
    ray = int(np.flatnonzero(ends.arrived)[0])
    assert moved(ends, ray, by, x, cosine).holds is expected


def test_positions_of_lost_rays_do_not_matter(ends: Trace) -> None:
    assert moved(ends, int(np.flatnonzero(~ends.arrived)[0]), 1.0).holds


def test_surfaces_are_placed_as_the_tracer_places_them() -> None:
    # two computations of the same frames: rotations here are scipy's
    rng = np.random.default_rng(5)
    systems = [random_system(rng, KINDS) for _ in range(20)]
    assert sum(bool(system.placements) for system in systems) > 4
    for system in systems:
        *placed, sensor = peers.places(system, lambda material: material.index())
        frames = [*surface_frames(system), (sensor.surface, *system.places()[-1])]
        for place, (surface, rotation, origin) in zip([*placed, sensor], frames, strict=True):
            assert place.surface == surface
            np.testing.assert_allclose(place.rotation, rotation, rtol=0, atol=1e-15)
            np.testing.assert_allclose(place.origin, origin, rtol=0, atol=1e-13)


def test_random_systems_and_rays_try_every_kind_of_surface_and_loss() -> None:
    rng = np.random.default_rng(11)
    bends, lost = set(), set()
    for _ in range(40):
        system = random_system(rng, KINDS)
        bends |= {(s.bends, s.curvature > 0) for e in system.elements for s in e.surfaces()}
        position, direction = skew_rays(rng, system, 200)
        assert position[2].max() < -90
        np.testing.assert_allclose((direction**2).sum(axis=0), 1.0)
        lost |= set(trace(system, position, direction).status.tolist())
    assert {(axis, sign) for axis in ("x", "y", "xy") for sign in (True, False)} <= bends
    assert lost == set(Status)


def test_random_systems_do_not_change_with_the_day() -> None:
    first, second = (random_system(np.random.default_rng(3), KINDS) for _ in range(2))
    assert first == second


@pytest.mark.parametrize("wrong", [False, True])
def test_the_exit_status(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], wrong: bool
) -> None:
    def tracer(system: OpticalSystem, position: Array, direction: Array, index: Index) -> Fates:
        assert index(system.elements[0].surfaces()[0].material or plate(rng).material) > 1
        fates = as_fates(reference.trace(system, position, direction))
        near = np.flatnonzero((fates.status == Status.ARRIVED) & (np.hypot(fates.x, fates.y) < 10))
        fates.x[near[:1]] += 1e-9 * wrong
        return fates

    rng = np.random.default_rng(0)
    monkeypatch.setattr(agreement, "PEERS", {"numpy": (tracer, (sphere, plate))})
    assert agreement.main(["--systems", "3", "--rays", "200"]) == int(wrong)
    printed = capsys.readouterr().out
    assert "numpy" in printed
    assert ("no" in printed.split()) == wrong
