"""The table of the thesis's claims: complete, honest about differences, in every form."""

from __future__ import annotations

import html
import re

import pytest

from raytransfer.thesis import Claim, ClaimTable, claims

IDS = [f"O{number}" for number in range(1, 17)]
TABLE = claims()
BY_ID = {claim.id: claim for claim in TABLE}


def test_all_claims_in_order() -> None:
    assert isinstance(TABLE, ClaimTable)
    assert [claim.id for claim in TABLE] == IDS


@pytest.mark.parametrize(
    ("name", "reproduced", "unit"),
    [
        ("O1", "26.1047", "mm"),
        ("O2", "27.8003", "mm"),
        ("O3", "1.6180", "mm"),
        ("O4", "46.757", "mm"),
        ("O5", "20.496", "mm"),
        ("O6", "1.4505", "m"),
        ("O7", "2.4280", "m"),
        ("O8", "1.0502", "m"),
        ("O9", "1.3350", "mm"),
        ("O10", "2.745", "m"),
        ("O11", "0.281", "m"),
        ("O12", "29.8077", "mm"),
        ("O16", "25.4047", "mm"),
    ],
)
def test_reproduced_values(name: str, reproduced: str, unit: str) -> None:
    decimals = len(reproduced.partition(".")[2])
    assert BY_ID[name].reproduced == pytest.approx(float(reproduced), abs=0.5 * 10**-decimals)
    assert BY_ID[name].unit == unit
    assert type(BY_ID[name].reproduced) is float


def test_figures_are_reproduced_as_focus_distances() -> None:
    """By the lens equation, from the pair's focal length and principal planes alone."""
    f, principal = 31 / 0.52 / 2, 5.9 / 1.52

    def focus(source_dist: float) -> float:
        return 1 / (1 / f - 1 / (source_dist + principal)) - principal

    assert BY_ID["O13"].reproduced == pytest.approx(focus(200), rel=1e-12)
    assert BY_ID["O15"].reproduced == pytest.approx(focus(500) - focus(5000), rel=1e-10)
    magnification = -f / (200 + principal - f)
    assert f"{50 * magnification:.4f} mm from the axis" in BY_ID["O13"].note
    assert f"{focus(10_000) - focus(5000):.3f} mm" in BY_ID["O15"].note


def test_the_collimator_spreads_the_light() -> None:
    """O14 step by step: a source, the concave lens, 32 mm, the convex lens."""
    power = 0.52 / 10.3
    height, angle = 1.0, 1 / 5000
    for thickness, lens_power, gap in ((2.0, -power, 32.0), (5.2, power, 0.0)):
        angle -= lens_power * height
        height += angle * (thickness / 1.52 + gap)
    assert BY_ID["O14"].reproduced == pytest.approx(-height / angle, rel=1e-10)


@pytest.mark.parametrize(
    ("name", "quoted"),
    [
        ("O1", "26.1"),
        ("O2", "27.8"),
        ("O3", "1.6"),
        ("O4", "46.8"),
        ("O5", "20.5"),
        ("O6", "1.45"),
        ("O7", "2.42"),
        ("O8", "1.05"),
        ("O9", "1.35"),
        ("O10", "2.7"),
        ("O11", "0.28"),
        ("O12", None),
        ("O13", None),
        ("O14", None),
        ("O15", None),
        ("O16", "25.4"),
    ],
)
def test_quoted_values_are_as_the_thesis_prints_them(name: str, quoted: str | None) -> None:
    assert BY_ID[name].quoted == quoted


def test_the_full_length_of_the_sensor_is_told() -> None:
    assert "14.592 mm gives 2.4350 m" in BY_ID["O7"].note
    assert "14.592 mm gives 1.0473 m" in BY_ID["O8"].note


def test_only_two_claims_differ() -> None:
    assert [claim.id for claim in TABLE if claim.agrees is False] == ["O7", "O9"]
    assert [claim.id for claim in TABLE if claim.agrees is None] == ["O12", "O13", "O14", "O15"]


@pytest.mark.parametrize("claim", TABLE, ids=IDS)
def test_agreement_is_half_a_unit_of_the_last_digit(claim: Claim) -> None:
    if claim.quoted is None:
        assert claim.difference is None
        assert not claim.remark.startswith(("agrees", "differs"))
        return
    decimals = len(claim.quoted.partition(".")[2])
    assert claim.difference is not None
    assert claim.difference == claim.reproduced - float(claim.quoted)
    assert claim.agrees == (abs(claim.difference) <= 0.5 * 10**-decimals)
    assert claim.remark.startswith("agrees" if claim.agrees else "differs")


@pytest.mark.parametrize(
    ("quoted", "reproduced", "agrees"),
    [
        ("1.6", 1.649, True),
        ("1.6", 1.651, False),
        ("1.60", 1.606, False),
        ("27", 27.4, True),
        ("27", 27.6, False),
        ("-1.5", -1.46, True),
        (None, 3.0, None),
    ],
)
def test_agrees_counts_the_quoted_digits(
    quoted: str | None, reproduced: float, agrees: bool | None
) -> None:
    assert Claim("O0", "any", "mm", quoted, reproduced, "").agrees is agrees


def test_differences_are_explained() -> None:
    for claim in TABLE:
        if claim.agrees is not True:
            assert claim.note, claim.id


# --- the table as text ----------------------------------------------------------------------


def test_text_has_a_line_for_each_claim() -> None:
    header, *lines = repr(TABLE).splitlines()
    assert header.split() == ["quantity", "quoted", "reproduced", "difference"]
    assert [line.split()[0] for line in lines] == IDS
    for line, claim in zip(lines, TABLE, strict=True):
        for cell in claim.cells()[:5]:
            assert cell in line
        # right-aligned below their headings
        for column, heading in ((2, "quoted"), (3, "reproduced"), (4, "difference")):
            end = header.index(heading) + len(heading)
            assert line[:end].endswith(claim.cells()[column])


def test_markdown_has_a_row_for_each_claim() -> None:
    lines = TABLE._repr_markdown_().splitlines()
    assert len(lines) == 2 + 16
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert {len(row) for row in rows} == {6}  # no cell holds a bar
    assert [tuple(row) for row in rows[2:]] == [claim.cells() for claim in TABLE]


def test_html_has_a_row_for_each_claim() -> None:
    page = TABLE.html()
    rows = re.findall(r"<tr>(.*?)</tr>", page)
    assert len(rows) == 1 + 16
    for row, claim in zip(rows[1:], TABLE, strict=True):
        cells = [html.unescape(cell) for cell in re.findall(r"<td>(.*?)</td>", row)]
        assert tuple(cells) == claim.cells()


def test_html_escapes() -> None:
    page = ClaimTable([Claim("O0", "a < b & c", "mm", None, 1.0, "<script>")]).html()
    assert "a &lt; b &amp; c" in page
    assert "<script>" not in page


def test_cells() -> None:
    assert BY_ID["O1"].cells()[2:5] == ("26.1 mm", "26.1047 mm", "+0.00474")
    assert BY_ID["O9"].cells()[2:5] == ("1.35 mm", "1.33498 mm", "-0.015")
    assert BY_ID["O12"].cells()[2:5] == ("–", "29.8077 mm", "–")


def test_texts_are_clean() -> None:
    for claim in TABLE:
        for text in (claim.quantity, claim.note, claim.remark):
            assert "  " not in text
            assert text == text.strip()


# --- selection ------------------------------------------------------------------------------


def test_claims_by_id() -> None:
    assert [claim.id for claim in claims("O9")] == ["O9"]
    assert [claim.id for claim in claims("O12", "O3", "O7")] == ["O3", "O7", "O12"]
    assert isinstance(claims("O3"), ClaimTable)
    assert claims("O3")[0] == BY_ID["O3"]


@pytest.mark.parametrize("wanted", ["O17", "O0", "o1", "", "T1"])
def test_unknown_claims_are_refused(wanted: str) -> None:
    with pytest.raises(ValueError, match=f"^'{wanted}': known claims are O1 to O16"):
        claims("O1", wanted)
