"""The command ``linetrack build``: what it says, and with which exit code it ends."""

from __future__ import annotations

import shutil
import subprocess
import sys
from typing import TYPE_CHECKING, Any

import pytest
from typer.testing import CliRunner

from acquisition.cli import UsageError
from hardware import package
from hardware.cli import VARIANTS, app
from hardware.findings import Finding
from hardware.package import Fault, FaultsError, Package
from raytransfer.designs import DESIGNS, save_design

if TYPE_CHECKING:
    from pathlib import Path

    from typer.testing import Result

PLAN = package.make_plan


@pytest.fixture(scope="session")
def plan() -> package.Plan:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shutil, "which", lambda *_, **__: None)
        return PLAN(DESIGNS["thesis"].system, variant="thesis")


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch, plan: package.Plan) -> list[Any]:
    """Keep what the command asks for; nothing is written."""
    calls: list[Any] = []

    def build(system: Any, folder: Path, **options: Any) -> Package:
        calls.append((system, folder, options))
        return Package(folder, plan, {**package._manifest(plan, folder), "boards": ["a", "b"]})

    monkeypatch.setattr(package, "build_package", build)
    return calls


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_a_design_by_name(asked: list[Any], tmp_path: Path) -> None:
    done = run("slit-4mm", "-o", tmp_path)
    assert done.exit_code == 0, done.output
    ((system, folder, options),) = asked
    assert system == DESIGNS["slit-4mm"].system
    assert folder == tmp_path
    assert options["variant"] == "improved"


def test_a_design_file_and_a_variant(asked: list[Any], tmp_path: Path) -> None:
    save_design(DESIGNS["thesis"].system, tmp_path / "mine.toml", notes="my own")
    run(tmp_path / "mine.toml", "-o", tmp_path, "--variant", "thesis")
    ((system, _, options),) = asked
    assert system == DESIGNS["thesis"].system
    assert (options["variant"], options["notes"]) == ("thesis", "my own")


@pytest.mark.usefixtures("asked")
def test_it_says_what_was_made_and_what_not(tmp_path: Path) -> None:
    text = run("thesis", "-o", tmp_path).output
    for words in (
        "45.0 × 45.0 × 59.0 mm",
        "25.40 mm",
        "left out: circuit simulation: ngspice is not installed",
        "hazard: TCD1304 board: logic level",
        "nothing of this has been fabricated",
    ):
        assert words in text
    assert run("thesis", "-o", tmp_path, "--quiet").output == ""


def test_faults_are_all_listed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    faults = [Fault("stand", Finding("holes", "base", f"number {n}")) for n in range(3)]

    def build(*_: object, **__: object) -> None:
        raise FaultsError(faults)

    monkeypatch.setattr(package, "build_package", build)
    done = run("thesis", "-o", tmp_path)
    assert done.exit_code == 1
    assert done.output.splitlines() == [
        "3 faults, nothing was written",
        *(f"stand: holes: base: number {n}" for n in range(3)),
    ]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("nobody",), "neither a design file nor one of the designs slit-4mm"),
        (("thesis", "--variant", "better"), "allowed are improved and thesis"),
    ],
)
def test_wrong_usage(arguments: tuple[str, ...], message: str, tmp_path: Path) -> None:
    error = run(*arguments, "-o", tmp_path / "package").exception
    assert isinstance(error, UsageError)
    assert message in str(error)
    assert list(tmp_path.iterdir()) == []


def test_what_is_missing_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def build(*_: object, **__: object) -> None:
        raise ModuleNotFoundError("no module", name="trimesh")

    monkeypatch.setattr(package, "build_package", build)
    error = run("thesis", "-o", tmp_path).exception
    assert isinstance(error, UsageError)
    assert "trimesh" in str(error)
    assert "pip install 'linetrack[hardware]'" in str(error)


def test_variants_are_the_package_s() -> None:
    assert VARIANTS == package.VARIANTS


def test_help_loads_nothing_heavy() -> None:
    code = (
        "import sys\nfrom typer.testing import CliRunner\nfrom hardware.cli import app\n"
        "assert 'HEAD' in CliRunner().invoke(app, ['--help']).output\n"
        "heavy = {'numpy', 'trimesh', 'manifold3d', 'raytransfer', 'hardware.package'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
