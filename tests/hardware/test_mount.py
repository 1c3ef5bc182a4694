"""The lens mount: sizes, places and volumes; variants that are good pass every check."""

from __future__ import annotations

import io
import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import trimesh

from hardware.checks import check_mount, first_hit, thinnest, used_light
from hardware.mesh import bounds, mesh, stl, volume
from hardware.mount import LensMount, lens_mount, mechanics, mount_rules, sensor_board
from hardware.render import exploded, picture
from hardware.solids import Box, Difference
from raytransfer.designs import DESIGNS
from raytransfer.lenses import CATALOGUE, Lens, Plate, SphericalLens
from raytransfer.materials import MATERIALS
from raytransfer.sensors import SENSORS, TCD1304
from raytransfer.systems import OpticalSystem, Placement, prototype_head, telecentric_pair

THESIS = DESIGNS["thesis"].system


def before_sensor(system: OpticalSystem) -> OpticalSystem:
    """Return lenses with the sensor where parallel light is in focus."""
    return replace(system, sensor_distance=round(system.back_focal_length("x"), 2))


def both_to_the_light(gap: float) -> OpticalSystem:
    first, second = telecentric_pair(gap=0.17).elements
    return before_sensor(
        OpticalSystem("curved sides to the light", (first.turned(), second), (gap,))
    )


def back_to_back(gap: float) -> OpticalSystem:
    elements = tuple(lens.turned() for lens in telecentric_pair().elements)
    return before_sensor(OpticalSystem("plane sides inside", elements, (gap,)))


GOOD = {
    "thesis": THESIS,
    "slit-f50-f100": DESIGNS["slit-f50-f100"].system,
    "slit-4mm": DESIGNS["slit-4mm"].system,
    "pair only": before_sensor(telecentric_pair(gap=0.17)),
    "f 50": before_sensor(telecentric_pair("LJ1695L1", gap=0.2)),
    "f 100": before_sensor(telecentric_pair("LJ1567L1", gap=0.2)),
    "head with f 50": prototype_head(
        pair=telecentric_pair("LJ1695L1"), pair_height=20.0, concave_height=37.0
    ),
    "one lens flipped": both_to_the_light(0.17),
    "both lenses flipped": back_to_back(2.0),
    "round lens": OpticalSystem(
        "round lens",
        (SphericalLens("plano-convex", 25.4, 25.8, math.inf, 5.3, MATERIALS["N-BK7"]),),
        sensor_distance=46.0,
    ),
}


@lru_cache
def mount_of(name: str) -> LensMount:
    return lens_mount(GOOD[name])


@pytest.mark.parametrize("name", GOOD)
def test_good_mounts_pass_every_check(name: str) -> None:
    assert check_mount(mount_of(name)) == []


def test_the_thesis_head_is_as_the_thesis_says() -> None:
    """Section 4.4.1: 45 × 45 × 59 mm; concave lens 40, pair 25.4, convex lens 3 mm high."""
    mount = mount_of("thesis")
    assert mount.size == pytest.approx((45, 45, 59), abs=0.05)
    both = np.array([bounds(half) for half in mount.halves.values()])
    assert both[:, 1].max(axis=0) - both[:, 0].min(axis=0) == pytest.approx((45, 45, 59), abs=0.05)
    heights = list(mount.heights().values())
    assert [heights[0], heights[2], heights[3]] == pytest.approx([40.0, 25.4, 3.0], abs=1e-9)
    assert heights[1] - heights[2] == pytest.approx(0.17 + 5.9, abs=1e-9)


@pytest.mark.parametrize("name", ["thesis", "slit-f50-f100"])
def test_volume_is_that_of_the_description(name: str) -> None:
    """Count points inside, without any kernel: the mesh's volume lies within what chance allows."""
    mount = mount_of(name)
    low, high = bounds(mount.lower)
    count = 40_000
    points = low + np.random.default_rng(3).random((count, 3)) * (high - low)
    share = mount.lower.contains(points.T).mean()
    whole = np.prod(high - low)
    spread = whole * math.sqrt(share * (1 - share) / count)
    assert volume(mount.lower) == pytest.approx(share * whole, abs=4 * spread)
    assert 4 * spread < 0.02 * volume(mount.lower)
    assert volume(mount.upper) == pytest.approx(volume(mount.lower), rel=1e-9)


def test_glass_has_the_volume_of_the_lens() -> None:
    """Closed form: a plate of the edge's thickness and a segment of the circle."""
    for name in ("thesis", "slit-f50-f100"):
        mount = mount_of(name)
        elements = [e for e in mount.system.elements if isinstance(e, Lens)]
        for lens, glass in zip(elements, mount.lenses, strict=True):
            angle = math.asin(lens.height / 2 / abs(lens.radius))
            segment = lens.radius**2 * (angle - math.sin(2 * angle) / 2)
            area = lens.height * lens.edge_thickness + math.copysign(segment, lens.radius)
            assert volume(glass.glass) == pytest.approx(area * lens.length, rel=2e-4)
            assert bounds(glass.glass)[:, 2] == pytest.approx(glass.box, abs=1e-6)


def test_a_larger_lens_makes_a_larger_mount() -> None:
    """Walls and screws keep their distances; the board stays the same."""
    lens = replace(CATALOGUE["LJ1567L1"], height=40.0, length=50.0, centre_thickness=8.0)
    system = before_sensor(telecentric_pair(lens, gap=2.0))
    mount = lens_mount(system)
    assert mount.size[:2] == pytest.approx((55.0, 54.2))
    assert mount.board == mount_of("thesis").board
    assert check_mount(mount) == []


def test_stl_files_pass_the_checks_too() -> None:
    mount = mount_of("thesis")
    surfaces: dict[str, trimesh.Trimesh] = {}
    for half, solid in mount.halves.items():
        data = stl(mesh(solid))
        assert data == stl(mesh(solid))
        surfaces[half] = trimesh.load_mesh(io.BytesIO(data), file_type="stl")
    assert check_mount(mount, surfaces) == []


@pytest.mark.parametrize("name", ["thesis", "slit-f50-f100"])
def test_halves_print_without_supports(name: str) -> None:
    """Turned for the printer nothing hangs over but the upper sides of the board's screw holes."""
    mount = mount_of(name)
    screw_holes = len(mount.board.holes) / 2 * mount.rules.core_depth * mount.rules.core_hole
    for half, solid in mount.printed().items():
        surface = mesh(solid)
        assert surface.volume == pytest.approx(volume(mount.halves[half]), rel=1e-9)
        assert surface.bounds[:, 2] == pytest.approx([0, mount.half_size[1]])
        down = surface.face_normals[:, 2] < -math.sin(math.radians(45))
        above = surface.triangles[:, :, 2].min(axis=1) > 0.01
        assert surface.area_faces[down & ~above].sum() > 2000  # lies on the bed
        # seen from below, half of each hole's cylinder is a quarter turn wide
        assert surface.area_faces[down & above].sum() < math.pi / 2 * screw_holes


def test_used_light_starts_at_the_field_and_ends_on_the_line() -> None:
    """Rays of all eighteen LEDs are there, and none but those that the sensor can use."""
    mount = mount_of("slit-f50-f100")
    points = used_light(mount)
    assert points.shape[:2] == (len(mount.system.elements) * 2 - 1 + 2, 3)
    assert points[0, 2] == pytest.approx(mount.front - 10)
    assert points.shape[2] > 300
    assert np.abs(points[-1, 1]).max() <= mount.rules.field.strip
    assert np.abs(points[-1, 0]).max() <= TCD1304.length / 2
    slope = (points[1] - points[0])[:2] / (points[1] - points[0])[2]
    edge = math.tan(math.radians(mount.rules.field.along))
    assert slope[0].min() < -0.97 * edge
    assert slope[0].max() > 0.97 * edge


def test_first_hit_is_where_planes_are_crossed() -> None:
    rng = np.random.default_rng(4)
    triangles = rng.normal(size=(60, 1, 3)) * 2 + rng.normal(size=(60, 3, 3)) / 2
    start, end = rng.normal(size=(2, 3, 400)) * 2
    expected = np.full(400, np.inf)
    for a, b, c in triangles:
        for ray in range(400):
            along = end[:, ray] - start[:, ray]
            u, v, t = np.linalg.solve(np.stack([b - a, c - a, -along], axis=1), start[:, ray] - a)
            if min(u, v, 1 - u - v) >= 0 and 0 <= t <= 1:
                expected[ray] = min(expected[ray], t)
    assert 50 < np.isfinite(expected).sum() < 350
    assert first_hit(start, end, triangles) == pytest.approx(expected)


def test_thinnest_wall() -> None:
    cup = Difference(Box((0, 0, 0), (10, 10, 10)), (Box((2, 2, 0.7), (9, 8, 11)),))
    thickness, at = thinnest(mesh(cup), 2.0)
    assert thickness == pytest.approx(0.7)
    assert at[2] == pytest.approx(0.0) or at[2] == pytest.approx(0.7)
    assert thinnest(mesh(Box((0, 0, 0), (5, 5, 5))), 2.0)[0] == math.inf


@pytest.mark.parametrize(
    ("system", "message"),
    [
        (replace(THESIS, sensor_distance=None), "sensor_distance"),
        (replace(THESIS, placements=(Placement((0.1, 0.0)),) * 5), "in their places"),
        (
            OpticalSystem(
                "p",
                (Plate("p", 1.0, MATERIALS["N-BK7"]), *THESIS.elements),
                (9.0, *THESIS.gaps),
                0.82,
            ),
            "edges are not known",
        ),
        (
            replace(THESIS, elements=(*THESIS.elements[:-1], Plate("p", 0.7, MATERIALS["N-BK7"]))),
            "edges are not known",
        ),
        (OpticalSystem("w", (TCD1304.window,), sensor_distance=0.82), "no lens"),  # type: ignore[arg-type]
        (prototype_head(convex_height=1.0), "before the sensor's window"),
    ],
)
def test_what_cannot_be_mounted_is_refused(system: OpticalSystem, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        lens_mount(system)


def test_sensors_without_a_known_package_are_refused() -> None:
    with pytest.raises(ValueError, match="TCD1703"):
        sensor_board(SENSORS["TCD1703"])


def test_mechanics_says_everything_once() -> None:
    """The window's height follows from package and sockets; the package is the sensor's."""
    data = mechanics()
    board = sensor_board(data=data)
    package, sockets = data["package"]["TCD1304"], data["sensor_board"]["sockets"]
    assert board.window_height == package["height"] + sockets["height"]
    assert (package["pins_in_a_row"] - 1) * package["pitch"] < package["length"]
    assert package["length"] > TCD1304.length
    assert TCD1304.top_to_chip < package["height"]
    rules = mount_rules(data)
    assert rules.axial_clearance * 2 < 0.17  # the pair cannot touch
    assert rules.core_hole < board.hole_diameter


def test_picture_shows_every_part() -> None:
    mount = mount_of("thesis")
    image = picture(exploded(mount), pixels=160)
    assert max(image.shape[:2]) == pytest.approx(160, abs=2)
    blue = (image[..., 2].astype(int) - image[..., 0]) > 20
    green = (image[..., 1].astype(int) - image[..., 0]) > 15
    plastic = (image[..., 0].astype(int) - image[..., 2] > 4) & (image[..., 0] < 250)
    white = (image == 255).all(axis=2)
    assert min(blue.mean(), green.mean()) > 0.005
    assert plastic.mean() > 0.1
    assert white[0].all()
    assert white[:, -1].all()
