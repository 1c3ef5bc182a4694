"""Design files: exact round trips, refusals, nothing half-written."""

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from raytransfer import CATALOGUE, SENSORS, TCD1304, ConstantIndex, OpticalSystem, prototype_head
from raytransfer.designs import DESIGNS, Design, design_text, load_design, save_design
from raytransfer.lenses import Aperture, Plate, SphericalLens
from raytransfer.materials import MATERIALS, Sellmeier
from raytransfer.systems import Placement


def everything() -> OpticalSystem:
    """One of each kind, off its place, with numbers that have no short decimals."""
    glass = Sellmeier('own, "quoted" – λ\x7f', (1.1, 0.2 / 3), (0.006, 0.1 / 3), (0.3, 2.0))
    lens = replace(CATALOGUE["LJ1430L1"].turned(), clear=(28.0 + 1 / 3, 30.0))
    own = replace(
        CATALOGUE["LK1085L2"].bending("y"),
        part="mine",
        height=15.0,
        length=30.0,
        material=glass,
        radius=-10.1,
    )
    doublet = SphericalLens(
        "ball", 20.0, math.inf, -math.pi * 10, 5.0, ConstantIndex("n", 1.5 + 1e-15)
    )
    assert TCD1304.window is not None
    elements = (
        Aperture("slit", x=math.sqrt(30)),
        own,
        lens,
        Aperture("iris", x=7.0, y=1 / 3),
        doublet,
        Plate("filter", 1.1, MATERIALS["N-BK7"]),
        TCD1304.window,
    )
    rng = np.random.default_rng(1)
    placements = tuple(
        Placement(
            (float(rng.normal(0, 0.1)), float(rng.normal(0, 0.1))),
            (float(rng.normal(0, 1e-3)), 0.0, float(rng.normal(0, 1e-17))),
        )
        for _ in elements
    )
    gaps = tuple(float(gap) for gap in rng.uniform(5, 6, len(elements) - 1))
    return OpticalSystem(
        "all\nof it",
        elements,
        gaps,
        0.1 + 0.2,
        placements,
        Placement((1e-5, -0.0), (0.0, 0.0, 1e-9)),
    )


@pytest.mark.parametrize("system", [prototype_head(), everything()], ids=lambda s: repr(s.name))
def test_a_design_comes_back_bit_for_bit(system: OpticalSystem, tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    save_design(system, path, notes='notes "of" two\nlines \\')
    design = load_design(path)
    assert design == Design(system, TCD1304, 'notes "of" two\nlines \\')
    assert repr(design.system) == repr(system)  # −0.0 and 0.0 are equal, but not alike
    save_design(design.system, path, notes=design.notes)
    assert load_design(path) == design
    assert [file.name for file in tmp_path.iterdir()] == ["a.toml"]


def test_parts_are_named_and_others_described() -> None:
    text = design_text(Design(everything()))
    assert 'part = "LJ1430L1"\nbends = "x"\nreversed = true\nclear = [' in text
    assert text.count("\nradius") == 1  # that of the lens that is no part
    text = design_text(Design(prototype_head()))
    assert "radius" not in text
    assert text.count('kind = "window"') == 1


def test_the_thesis_design_is_its_head() -> None:
    assert DESIGNS["thesis"].system == prototype_head()
    assert DESIGNS["thesis"].sensor is TCD1304


@pytest.mark.parametrize("name", DESIGNS)
def test_shipped_files_are_as_they_would_be_written(name: str) -> None:
    import raytransfer

    file = Path(raytransfer.__file__).parent / "data" / "designs" / f"{name}.toml"
    assert file.read_text(encoding="utf-8") == design_text(DESIGNS[name])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('format = "linetrack design"', 'format = "x"', "no design file"),
        ('format = "linetrack design"\n', "", "no design file"),
        ("version = 1", "version = 2", "version = 2: this program reads version 1"),
        ("version = 1", "version = true", "version = True"),
        (
            'part = "PCX_30_32_60"',
            'part = "PCX_30_32_61"',
            "element 2, part = 'PCX_30_32_61': known",
        ),
        ('sensor = "TCD1304"', 'sensor = "TCD1305"', "sensor = 'TCD1305': known are TCD1304"),
        ("sensor_distance = 0.82\n", "", "missing: sensor_distance"),
        ("gaps = ", "gabs = 1\ngaps = ", "unknown: gabs"),
        ("gaps = [2.63, ", "gaps = [-2.63, ", "gap between PCV_15_30_20 and .* allowed is >= 0"),
        ("gaps = [2.63, ", "gaps = [", "4 gaps between them, not 3"),
        ("gaps = [2.63, ", "gaps = ['2.63', ", r"gaps\[0\] = '2.63': a single real number"),
        ("0.82", "1" + 400 * "0", "sensor_distance is a whole number beyond all"),
        ("0.82", "nan", "sensor_distance = nan: allowed are finite"),
        ("0.82", "inf", "sensor_distance = inf: allowed are finite"),
        ("reversed = true", "reversed = 1", "element 2, reversed = 1: true or false is needed"),
        ('bends = "y"', 'bends = "z"', "bends of PCV_15_30_20 = 'z'|bends = 'z'"),
        ("reversed = true", "reverse = true", "element 2, unknown: reverse; known are .*reversed"),
        ("reversed = true", "radius = 31.0", "element 2, missing: centre_thickness, height"),
        ("reversed = true", "clear = [40.0, 1.0]", "clear height of PCX_30_32_60 = 40"),
        ("reversed = true", "clear = [4.0]", r"element 2, clear = \[4.0\]: 2 numbers"),
        (
            "reversed = true",
            "[element.placement]\ntilt = [0.0, 0.0, 0.0]",
            "placement, missing: decentre",
        ),
        (
            "reversed = true",
            "placement = { decentre = [0.0, 0.0], tilt = [0.0, 0.0, 0.0] }",
            "placement: give one for each element",
        ),
        ("reversed = true", "placement = 3", "element 2, placement = 3: a table"),
        ('kind = "window"', 'kind = "prism"', "element 5, kind = 'prism': known are lens"),
        ('kind = "window"', 'kind = "window"\nthickness = 1.0', "element 5, unknown: thickness"),
        (
            'kind = "window"',
            'kind = "plate"\npart = "p"',
            "element 5, missing: material, thickness",
        ),
        (
            'kind = "window"',
            'kind = "plate"\npart = "p"\nthickness = 1.0\nmaterial = "ice"',
            "element 5, material = 'ice': known",
        ),
        (
            'kind = "window"',
            'kind = "plate"\npart = "p"\nthickness = 1.0\nmaterial = { name = "ice", n = 0.3 }',
            "index of ice = 0.3",
        ),
        (
            'kind = "window"',
            'kind = "screen"\npart = "s"\nx = -1.0',
            "x of s = -1: allowed is > 0",
        ),
        ("[[element]]", "[[element", "line 9|Expected"),
    ],
)
def test_refusals_name_the_file_the_place_and_the_value(
    old: str, new: str, message: str, tmp_path: Path
) -> None:
    text = design_text(Design(prototype_head()))
    assert old in text
    path = tmp_path / "wrong.toml"
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ValueError, match=f"(?s)^{re.escape(str(path))}: .*({message})"):
        load_design(path)


def test_text_that_is_not_utf8_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "wrong.toml"
    path.write_bytes(b'format = "\xff"')
    with pytest.raises(ValueError, match=r"wrong\.toml: .*utf-8"):
        load_design(path)


def test_a_system_that_is_no_head_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    with pytest.raises(ValueError, match="a design needs sensor_distance"):
        save_design(replace(prototype_head(), sensor_distance=None), path)
    own = replace(TCD1304, name="mine")
    with pytest.raises(
        ValueError, match=f"sensor 'mine': a design names one of {', '.join(SENSORS)}"
    ):
        save_design(prototype_head(), path, sensor=own)
    with pytest.raises(ValueError, match=r"a\.txt: a design file ends in \.toml"):
        save_design(prototype_head(), tmp_path / "a.txt")
    with pytest.raises(TypeError, match="an OpticalSystem is needed"):
        Design("head")  # type: ignore[arg-type]
    assert not any(tmp_path.iterdir())


def test_nothing_is_half_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.toml"
    save_design(prototype_head(), path)
    before = path.read_bytes()

    def full(_: int) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="no space left"):
        save_design(everything(), path)
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["a.toml"]


def test_a_folder_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no folder .*missing; make it first"):
        save_design(DESIGNS["thesis"].system, tmp_path / "missing" / "head.toml")
