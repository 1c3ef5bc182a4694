"""execute.py: the same notebook gives the same bytes, and a bad one is left alone."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest
from nbformat.v4 import new_code_cell, new_notebook

NOTEBOOKS = Path(__file__).parents[2] / "notebooks"


def execute(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, NOTEBOOKS / "execute.py", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_two_runs_give_the_same_bytes(tmp_path: Path) -> None:
    path = tmp_path / "explorer.ipynb"
    shutil.copy(NOTEBOOKS / "05-explorer.ipynb", path)
    assert execute(path).returncode == 0
    first = path.read_bytes()
    assert execute(path).returncode == 0
    assert path.read_bytes() == first
    assert execute("--check", path).returncode == 0


def test_pieces_of_text_are_joined(tmp_path: Path) -> None:
    """What is printed slowly comes in pieces; how many is up to the clock."""
    path = tmp_path / "slow.ipynb"
    source = "import time\nfor n in range(3):\n    print(n, flush=True)\n    time.sleep(0.5)\n    display(n)"
    nbformat.write(new_notebook(cells=[new_code_cell(source)]), path)
    assert execute(path).returncode == 0
    outputs = nbformat.read(path, as_version=4).cells[0].outputs
    assert [output.output_type for output in outputs] == ["stream", *["display_data"] * 3]
    assert outputs[0].text == "0\n1\n2\n"


def test_check_notices_and_does_not_write(tmp_path: Path) -> None:
    path = tmp_path / "one.ipynb"
    nbformat.write(new_notebook(cells=[new_code_cell("1 + 1")]), path)
    before = path.read_bytes()
    run = execute("--check", path)
    assert run.returncode == 1
    assert "changed" in run.stdout
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ("1 / 0", "ZeroDivisionError"),
        ("import sys; print('oh', file=sys.stderr)", "writes to stderr"),
        ("object()", "memory address"),
        (
            "import ipywidgets as w\nout = w.Output()\nwith out:\n    1 / 0\nout",
            "ZeroDivisionError",
        ),
    ],
)
def test_what_may_not_be_committed_is_not_written(source: str, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.ipynb"
    nbformat.write(new_notebook(cells=[new_code_cell(source)]), path)
    before = path.read_bytes()
    run = execute(path)
    assert run.returncode != 0
    assert reason in run.stderr
    assert path.read_bytes() == before
