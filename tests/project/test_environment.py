"""environment.txt is the user's file: complete, locked, and resolvable on a Raspberry Pi."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
NAME = re.compile(r"^[A-Za-z0-9._-]+")


def names(lines: list[str]) -> set[str]:
    """Normalised names of the packages in requirement lines."""
    found = (NAME.match(line.strip()) for line in lines)
    return {re.sub(r"[-_.]+", "-", match.group()).lower() for match in found if match}


def requirements(file: str) -> list[str]:
    lines = (ROOT / file).read_text(encoding="utf-8").splitlines()
    return [line for line in lines if line.strip() and not line.startswith(("#", "-c"))]


def test_environment_holds_what_the_user_asked_for() -> None:
    asked = "numpy sympy matplotlib jupyterlab ipywidgets nbval spidev RPi.GPIO".lower()
    assert {name.replace(".", "-") for name in asked.split()} <= names(
        requirements("environment.txt")
    )


def test_environment_holds_what_the_project_requires() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    groups = project["optional-dependencies"]
    del groups["cad"]  # a gigabyte; CI installs it
    extras = [line for extra in groups.values() for line in extra]
    assert names(project["dependencies"] + extras) <= names(requirements("environment.txt"))


def test_every_package_is_locked() -> None:
    assert names(requirements("environment.txt")) <= names(requirements("constraints.txt"))
    assert all("==" in line for line in requirements("constraints.txt"))


@pytest.mark.parametrize("python", ["3.11", "3.13"])
@pytest.mark.parametrize("machine", ["aarch64", "x86_64"])
def test_environment_resolves(machine: str, python: str) -> None:
    """Resolve for 64-bit Raspberry Pi OS and for a PC; all but the two Pi drivers as wheels."""
    run = subprocess.run(
        [
            *(sys.executable, "-m", "uv", "pip", "compile", "--quiet", "--no-header"),
            *("--python-platform", f"{machine}-manylinux_2_36", "--python-version", python),
            *("--only-binary", ":all:", "--no-binary", "spidev", "--no-binary", "rpi-gpio"),
            "environment.txt",
        ],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    if (
        run.returncode
        and "error sending request" in run.stderr.lower()
        and not os.environ.get("CI")
    ):
        pytest.skip("the package registry cannot be reached")
    assert run.returncode == 0, run.stderr
    resolved = names(run.stdout.splitlines())
    drivers = {"spidev", "rpi-gpio"}
    assert resolved & drivers == (drivers if machine == "aarch64" else set())
    assert "numpy" in resolved
    assert "rpi-lgpio" not in resolved  # never beside RPi.GPIO
