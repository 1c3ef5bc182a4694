"""`import raytransfer` is light, and everything it promises is there."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import raytransfer

HEAVY = ["numba", "sympy", "matplotlib", "scipy", "IPython", "ipywidgets", "pandas", "traitlets"]


def run(code: str) -> str:
    result = subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        capture_output=True,
        text=True,
        check=False,
        env={"MPLBACKEND": "Agg", "PATH": ""},
    )
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_import_loads_none_of_the_heavy_packages_until_they_are_asked_for() -> None:
    code = f"""
import sys
import raytransfer as rt

heavy = {HEAVY}
print([name for name in heavy if name in sys.modules])

# numbers, studies and the thesis's table need none of them either
import raytransfer.studies
from raytransfer.thesis import claims
claims()
rt.cast_rays(30, rt.telecentric_pair().matrix("x"), 5000, 0)
print([name for name in heavy if name in sys.modules])

# nor do the modules of exact light, before they trace
from raytransfer import analysis, designs, irradiance, outdoors, reference, tolerances, tracing
print([name for name in heavy if name in sys.modules])

# a figure loads matplotlib, but nothing else
ax = rt.plot_ray_cast(30, 11.8, rt.telecentric_pair().matrix("x"), 200, 50)
print(len(ax.lines) >= 3, rt.plot_ray_cast is raytransfer.plots.plot_ray_cast)
print([name for name in heavy if name in sys.modules])

import sympy
print(type(rt.trans_mat(sympy.Symbol("d"))).__name__)
"""
    assert run(code).splitlines() == [
        "[]",
        "[]",
        "[]",
        "True True",
        "['matplotlib']",
        "FreeSpace",
    ]


def test_kernels_are_compiled_where_nothing_can_be_written() -> None:
    """An installation without write access, and a user without a home: no cache, but light."""
    code = """
from numba.core.caching import CacheImpl
CacheImpl._locator_classes = []
from raytransfer import _kernels
print(_kernels.CACHE, _kernels._sum(_kernels.np.ones(3), 3))
"""
    assert run(code).split() == ["False", "3.0"]


def test_star_import_has_every_name() -> None:
    assert run(
        "from raytransfer import *\nimport raytransfer\n"
        "print([name for name in raytransfer.__all__ if name not in globals()])"
    ).splitlines() == ["[]"]


@pytest.mark.parametrize("name", raytransfer.__all__)
def test_every_name_resolves(name: str) -> None:
    assert getattr(raytransfer, name) is not None


def test_every_name_is_listed() -> None:
    """What `dir` lists is what a Tab completes."""
    assert set(raytransfer.__all__) <= set(dir(raytransfer))
    for name in dir(raytransfer):
        getattr(raytransfer, name)
    assert len(set(raytransfer.__all__)) == len(raytransfer.__all__)


def test_unknown_names_are_refused() -> None:
    with pytest.raises(AttributeError, match="'raytransfer' has no attribute 'plot_everything'"):
        getattr(raytransfer, "plot_everything")  # noqa: B009
    assert not hasattr(raytransfer, "cast_ray")


def test_version_is_the_projects() -> None:
    project = Path(__file__).parents[2] / "pyproject.toml"
    assert raytransfer.__version__ == tomllib.loads(project.read_text())["project"]["version"]
