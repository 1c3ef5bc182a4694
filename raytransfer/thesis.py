"""The thesis's optical claims O1 to O16, each beside what its own model gives.

C. Prossenitsch, *Outdoor Inside-Out Linear Image Sensor Tracking*, sections 4.2, 4.4 and 5.3.
Every number under "reproduced" is computed on the spot by the public functions of this package, in
the paraxial model with the thesis's rounded lenses and its index of 1.52.
"""

from __future__ import annotations

import html
from dataclasses import dataclass

from raytransfer.casting import cast_rays
from raytransfer.sensors import TCD1304
from raytransfer.studies import (
    FAR,
    NEAR,
    THESIS_HALF_LENGTH,
    beam_width,
    field_edge,
    lateral_resolution,
    tracking_start,
    untracked_margin,
)
from raytransfer.systems import collimating_pair, telecentric_pair

LENS_WIDTH = 30.0
"""Full aperture of the telecentric pair, mm."""

LED_SPACING = 500.0
"""The thesis's LED spacing, mm."""

COVER = 0.7
"""The thesis's distance between cover and sensor, mm; it is the thickness of the glass."""

CONVEX_TO_SENSOR = 3.0 + COVER
"""From the collimator's convex lens to the sensor as the thesis counts it, mm."""


@dataclass(frozen=True)
class Claim:
    """A number of the thesis and its reproduction.

    Attributes
    ----------
    id : str
        O1 to O16.
    quantity : str
    unit : str
    quoted : str or None
        As the thesis prints it; None where it shows a figure or nothing.
    reproduced : float
    note : str
        Why the two differ, or how the number came about.
    """

    id: str
    quantity: str
    unit: str
    quoted: str | None
    reproduced: float
    note: str

    @property
    def difference(self) -> float | None:
        """Reproduced minus quoted."""
        return None if self.quoted is None else self.reproduced - float(self.quoted)

    @property
    def agrees(self) -> bool | None:
        """Whether the two are the same at the quoted digits; None without a quoted number."""
        if self.quoted is None:
            return None
        decimals = len(self.quoted.partition(".")[2])
        return round(self.reproduced, decimals) == float(self.quoted)

    @property
    def remark(self) -> str:
        """Whether the two agree at the quoted digits, and the note."""
        verdict = {True: "agrees", False: "differs", None: ""}[self.agrees]
        return "; ".join(text for text in (verdict, self.note) if text)

    def cells(self) -> tuple[str, ...]:
        """Return the row as text: id, quantity, quoted, reproduced, difference, remark."""
        difference = "–" if self.difference is None else f"{self.difference:+.3g}"
        quoted = "–" if self.quoted is None else f"{self.quoted} {self.unit}"
        reproduced = f"{self.reproduced:.6g} {self.unit}"
        return self.id, self.quantity, quoted, reproduced, difference, self.remark


class ClaimTable(tuple[Claim, ...]):
    """Claims that show themselves as a table, in a notebook or as text."""

    __slots__ = ()

    HEADER = ("", "quantity", "quoted", "reproduced", "difference", "remark")

    def __repr__(self) -> str:
        rows = [self.HEADER[:5], *(claim.cells()[:5] for claim in self)]
        widths = [max(len(row[column]) for row in rows) for column in range(5)]
        lines = []
        for row in rows:
            left = (cell.ljust(width) for cell, width in zip(row[:2], widths[:2], strict=True))
            right = (cell.rjust(width) for cell, width in zip(row[2:], widths[2:], strict=True))
            lines.append("  ".join([*left, *right]).rstrip())
        return "\n".join(lines)

    def _repr_markdown_(self) -> str:
        lines = ["| " + " | ".join(self.HEADER) + " |", "|---|---|--:|--:|--:|---|"]
        lines += ["| " + " | ".join(claim.cells()) + " |" for claim in self]
        return "\n".join(lines)

    def html(self) -> str:
        """Return the table as HTML."""
        head = "".join(f"<th>{cell}</th>" for cell in self.HEADER)
        rows = (
            "".join(f"<td>{html.escape(cell)}</td>" for cell in claim.cells()) for claim in self
        )
        body = "".join(f"<tr>{row}</tr>\n" for row in rows)
        return f'<table class="claims">\n<tr>{head}</tr>\n{body}</table>'


def claims(*ids: str) -> ClaimTable:
    """Reproduce the thesis's optical claims.

    Parameters
    ----------
    *ids : str
        Such as "O1", "O12"; all sixteen when left out.

    Raises
    ------
    ValueError
        If an id is not one of O1 to O16.
    """
    table = ClaimTable(_reproduce())
    known = [claim.id for claim in table]
    for wanted in ids:
        if wanted not in known:
            raise ValueError(f"{wanted!r}: known claims are {known[0]} to {known[-1]}")
    return ClaimTable(claim for claim in table if not ids or claim.id in ids)


def _reproduce() -> list[Claim]:
    f60 = telecentric_pair().matrix("x")
    f50 = telecentric_pair("PCX_30_32_50").matrix("x")
    f100 = telecentric_pair("PCX_30_32_100").matrix("x")
    collimator = collimating_pair().matrix("y")
    half = THESIS_HALF_LENGTH
    focus_far = cast_rays(LENS_WIDTH, f60, FAR, 0).focal_length
    focus_near = cast_rays(LENS_WIDTH, f60, NEAR, 0).focal_length
    start_full = tracking_start(f60, LED_SPACING, TCD1304.length / 2)
    edge_full = field_edge(f60, FAR, TCD1304.length / 2) / 1000
    figure = cast_rays(LENS_WIDTH, f60, 200, 50)
    spread = cast_rays(15, collimator, FAR, 0).focal_length
    beyond = cast_rays(LENS_WIDTH, f60, 2 * FAR, 0).focal_length - focus_far
    far_margin, near_margin = untracked_margin(15, collimator, [FAR, NEAR], CONVEX_TO_SENSOR)
    return [
        Claim("O1", "focus behind the f60 pair, source at 5 m", "mm", "26.1", focus_far, ""),
        Claim("O2", "focus behind the f60 pair, source at 0.5 m", "mm", "27.8", focus_near, ""),
        Claim(
            "O3",
            "beam width on the sensor, source at 0.5 m, sensor at the 5 m focus",
            "mm",
            "1.6",
            float(beam_width(LENS_WIDTH, f60, NEAR, focus_far)),
            "full 30 mm aperture",
        ),
        Claim(
            "O4",
            "focus behind the f100 pair, source at 5 m",
            "mm",
            "46.8",
            cast_rays(LENS_WIDTH, f100, FAR, 0).focal_length,
            "with the catalogue's R 51.68, thickness 5.22",
        ),
        Claim(
            "O5",
            "focus behind the f50 pair, source at 5 m",
            "mm",
            "20.5",
            cast_rays(LENS_WIDTH, f50, FAR, 0).focal_length,
            "with the catalogue's R 25.84, thickness 6.80",
        ),
        Claim(
            "O6",
            "largest lateral offset on the sensor at 5 m, f100 pair",
            "m",
            "1.45",
            float(field_edge(f100, FAR, half)) / 1000,
            "half length 14.55 mm",
        ),
        Claim(
            "O7",
            "largest lateral offset on the sensor at 5 m, f60 pair",
            "m",
            "2.42",
            float(field_edge(f60, FAR, half)) / 1000,
            "the thesis cuts the digits off where rounding gives 2.43; "
            f"the full half length of 14.592 mm gives {edge_full:.4f} m",
        ),
        Claim(
            "O8",
            "start of continuous tracking, LEDs 0.5 m apart",
            "m",
            "1.05",
            tracking_start(f60, LED_SPACING, half) / 1000,
            f"the full half length of 14.592 mm gives {start_full / 1000:.4f} m",
        ),
        Claim(
            "O9",
            "lateral move that shifts the image one pixel, source at 5 m",
            "mm",
            "1.35",
            float(lateral_resolution(f60, FAR, TCD1304.pitch)),
            "the thesis searched by hand; this is the solution of the same equation",
        ),
        Claim(
            "O10",
            "margin of the untracked axis, source at 5 m",
            "m",
            "2.7",
            float(far_margin) / 1000,
            "edge ray of the 15 mm lens to the axis 3.7 mm behind the convex lens",
        ),
        Claim(
            "O11",
            "margin of the untracked axis, source at 0.5 m",
            "m",
            "0.28",
            float(near_margin) / 1000,
            "same ray",
        ),
        Claim(
            "O12",
            "effective focal length of the f60 pair",
            "mm",
            None,
            telecentric_pair().effective_focal_length("x"),
            "the thesis gives none; −1/C of the system matrix",
        ),
        Claim(
            "O13",
            "figure 4.5: focus of three rays, source 200 mm away and 50 mm off axis",
            "mm",
            None,
            figure.focal_length,
            f"a plot; the rays meet {figure.focal_offset:.4f} mm from the axis",
        ),
        Claim(
            "O14",
            "figure 4.3: focus behind concave + 32 mm + convex, source at 5 m",
            "mm",
            None,
            spread,
            f"a plot; the sensor, {CONVEX_TO_SENSOR:g} mm behind the convex lens, is far inside "
            "the focus: the pair of lenses spreads light over it, it does not image",
        ),
        Claim(
            "O15",
            "figure 4.4: focus behind the sensor, source at 0.5 m",
            "mm",
            None,
            focus_near - focus_far,
            f"a plot; 0 at 5 m, where the sensor stands, and {beyond:.3f} mm (before the sensor) "
            "at 10 m",
        ),
        Claim(
            "O16",
            "lens mount: pair above the cover",
            "mm",
            "25.4",
            focus_far - COVER,
            "focus less 0.7 mm, as computed there; but 0.7 mm is the glass, and the chip is "
            f"{TCD1304.top_to_chip:g} mm below its top",
        ),
    ]
