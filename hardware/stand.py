"""What the head and its electronics stand on, and what an LED is held to its pole by.

The thesis's motherboard in four parts: a base that carries the Raspberry Pi and the Nucleo, and three
feet, of which one holds the lens mount and one the LED control board. Frame: that of the lens
mount, Y up, with the mount in its place. The LED's mount has its own: Z along the pole.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from hardware.mount import mechanics
from hardware.solids import Box, Cylinder, Difference, Union

if TYPE_CHECKING:
    from collections.abc import Mapping

    from hardware.mount import LensMount
    from hardware.solids import Solid


@dataclass(frozen=True)
class PlacedBoard:
    """A board that lies on posts, its length along Z.

    Parameters
    ----------
    name : str
        As in mechanics.toml.
    part : str
        Of the stand, that it lies on.
    corner : tuple of float
        Lowest x, y of its underside, lowest z, mm.
    size : tuple of float
        Along Z and X, mm.
    holes : tuple of tuple of float
        z and x from the corner, mm.
    """

    name: str
    part: str
    corner: tuple[float, float, float]
    size: tuple[float, float]
    holes: tuple[tuple[float, float], ...]

    def centres(self) -> list[tuple[float, float]]:
        """Return x and z of the holes, mm."""
        return [(self.corner[0] + x, self.corner[2] + z) for z, x in self.holes]

    def slab(self, thickness: float = 1.6) -> Box:
        """Return the board itself."""
        x, y, z = self.corner
        return Box((x, y, z), (x + self.size[1], y + thickness, z + self.size[0]))


@dataclass(frozen=True)
class Stand:
    """The motherboard.

    Parameters
    ----------
    mount : LensMount
        That stands on it.
    parts : mapping of str to Solid
        ``base``, ``lens holder``, ``foot`` and ``LED board holder``.
    boards : tuple of PlacedBoard
    foot_screws : tuple of tuple
        x and z of the M2.5 that join base and feet, and the foot's name.
    top : float
        y of the base's upper side, mm.
    rules : mapping
        Table ``stand`` of mechanics.toml.
    """

    mount: LensMount
    parts: Mapping[str, Solid]
    boards: tuple[PlacedBoard, ...]
    foot_screws: tuple[tuple[float, float, str], ...]
    top: float
    rules: Mapping[str, Any]

    @property
    def under(self) -> float:
        """Y of the base's lower side, on which the feet's plates meet it, mm."""
        return self.top - float(self.rules["plate"])


def _board(
    data: Mapping[str, Any], name: str, part: str, corner: tuple[float, float, float]
) -> PlacedBoard:
    entry = data["boards"][name]
    length, width = entry["size"]
    return PlacedBoard(
        name, part, corner, (length, width), tuple((u, v) for u, v in entry["holes"])
    )


def stand(mount: LensMount, data: Mapping[str, Any] | None = None) -> Stand:
    """Lay out the motherboard behind and under a lens mount.

    Parameters
    ----------
    mount : LensMount
    data : mapping, optional
        Another `mechanics()`.
    """
    data = mechanics() if data is None else data
    rules = data["stand"]
    plate, leg, margin = rules["plate"], rules["leg"], rules["margin"]
    under = -mount.half_size[1]  # the head's lower side: on the holder's plate, as the base is
    top = under + plate
    low = under - plate - rules["leg_height"]

    # the base, with both computers side by side
    start = mount.face + rules["behind_head"]
    widths = [data["boards"][name]["size"][1] for name in ("raspberry_pi", "nucleo")]
    half = (sum(widths) + 3 * margin) / 2
    on_posts = top + rules["post"]
    computers = (
        _board(data, "raspberry_pi", "base", (-half + margin, on_posts, start + margin)),
        _board(data, "nucleo", "base", (half - margin - widths[1], on_posts, start + margin)),
    )
    end = start + max(board.size[0] for board in computers) + 2 * margin
    legs = {
        "lens holder": start,
        "foot": (start + end - leg) / 2,
        "LED board holder": end - leg,
    }
    foot_screws = tuple(
        (x, z + leg / 2, name)
        for name, z in legs.items()
        for x in (margin / 2 - half, half - margin / 2)
    )
    base = _with_posts(Box((-half, under, start), (half, top, end)), computers, rules)
    base = Difference(
        base,
        tuple(
            Cylinder("y", (x, z), under - 1, top + 1, rules["screw_hole"])
            for x, z, _ in foot_screws
        ),
    )

    # the feet: legs across the base, plates for what they hold
    parts: dict[str, Solid] = {"base": base}
    wide = mount.half_size[0] + 1.0 + rules["rib"]
    led = _board(
        data,
        "led_control",
        "LED board holder",
        (-data["boards"]["led_control"]["size"][1] / 2, under + rules["post"], end + margin),
    )
    ribs = tuple(
        Box((min(x, s * wide), low, mount.front), (max(x, s * wide), under - plate, start))
        for s in (-1, 1)
        for x in (s * (wide - rules["rib"]),)
    )
    plates: dict[str, tuple[Solid, ...]] = {
        "lens holder": (Box((-wide, under - plate, mount.front), (wide, under, start)), *ribs),
        "LED board holder": (_led_plate(led, under, end, rules),),
    }
    for name, z in legs.items():
        foot = Union((_leg(half, low, under, z, rules), *plates.get(name, ())))
        cut: list[Solid] = [
            Cylinder("y", (x, at), under - rules["core_depth"], under + 1, rules["core_hole"])
            for x, at, of in foot_screws
            if of == name
        ]
        if name == "lens holder":
            cut += [
                Cylinder("y", at, under - plate - 1, under + 1, mount.rules.screw_hole)
                for at in mount.screws
            ]
        if name == "LED board holder":
            cut += _cores(led, rules)
        parts[name] = Difference(foot, tuple(cut))
    return Stand(mount, parts, (*computers, led), foot_screws, top, rules)


def _leg(half: float, low: float, under: float, z: float, rules: Mapping[str, Any]) -> Solid:
    """Return an arch across the base, cables pass under it."""
    leg, plate = rules["leg"], rules["plate"]
    span = half - 2 * leg
    whole = Box((-half, low, z), (half, under, z + leg))
    return Difference(
        whole, (Box((-span, low - 1, z - 1), (span, under - 2 * plate, z + leg + 1)),)
    )


def _led_plate(led: PlacedBoard, under: float, start: float, rules: Mapping[str, Any]) -> Solid:
    x, _, z = led.corner
    margin = rules["margin"]
    plate = Box(
        (x - margin, under - rules["plate"], start - 1),
        (x + led.size[1] + margin, under, z + led.size[0] + margin),
    )
    return Union((plate, *_posts(led, under - 1, rules)))


def _with_posts(
    plate: Box, boards: tuple[PlacedBoard, ...], rules: Mapping[str, Any]
) -> Difference:
    posts = [post for board in boards for post in _posts(board, plate.high[1] - 1, rules)]
    cores = [core for board in boards for core in _cores(board, rules)]
    return Difference(Union((plate, *posts)), tuple(cores))


def _posts(board: PlacedBoard, low: float, rules: Mapping[str, Any]) -> list[Solid]:
    return [Cylinder("y", at, low, board.corner[1], rules["post"]) for at in board.centres()]


def _cores(board: PlacedBoard, rules: Mapping[str, Any]) -> list[Solid]:
    y = board.corner[1]
    return [
        Cylinder("y", at, y - rules["core_depth"], y + 1, rules["core_hole"])
        for at in board.centres()
    ]


@dataclass(frozen=True)
class LedMount:
    """The part that holds one LED and its heat sink on a pole.

    Parameters
    ----------
    solid : Solid
        The plate faces −y.
    plate : float
        y of the plate's face, mm.
    screws : tuple of tuple of float
        x and z of the M3 that hold LED and heat sink.
    clamp : tuple of float
        y and z of the M3 that pulls the ears together.
    rules : mapping
        Table ``led_mount`` of mechanics.toml.
    """

    solid: Solid
    plate: float
    screws: tuple[tuple[float, float], ...]
    clamp: tuple[float, float]
    rules: Mapping[str, Any]


def led_mount(data: Mapping[str, Any] | None = None) -> LedMount:
    """Lay out the LED's mount: a ring that a screw closes around the pole, and a plate on it.

    Parameters
    ----------
    data : mapping, optional
        Another `mechanics()`.
    """
    rules = (mechanics() if data is None else data)["led_mount"]
    width, height = rules["plate"]
    bore = (rules["pole"] + rules["clearance"]) / 2
    ring = bore + rules["wall"]
    thick, reach = rules["ear"]
    face = -(bore + rules["core_depth"])
    side = rules["slit"] / 2 + thick
    body = Union(
        (
            Cylinder("z", (0.0, 0.0), 0.0, height, 2 * ring),
            Box((-width / 2, face, 0.0), (width / 2, 0.0 - bore / 2, height)),
            Box((-side, bore, 0.0), (side, ring + reach, height)),
        )
    )
    screws = tuple(
        (x, height / 2) for x in (-rules["hole_distance"] / 2, rules["hole_distance"] / 2)
    )
    clamp = (ring + reach / 2, height / 2)
    solid = Difference(
        body,
        (
            Cylinder("z", (0.0, 0.0), -1.0, height + 1, 2 * bore),
            Box((-rules["slit"] / 2, 0.0, -1.0), (rules["slit"] / 2, ring + reach + 1, height + 1)),
            *(
                Cylinder("y", at, face - 1, face + rules["core_depth"], rules["core_hole"])
                for at in screws
            ),
            Cylinder("x", clamp, -side - 1, side + 1, rules["screw_hole"]),
        ),
    )
    return LedMount(solid, face, screws, clamp, rules)
