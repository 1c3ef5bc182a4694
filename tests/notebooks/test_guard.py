"""The notebooks' guard: an untouched notebook passes, each kind of change fails."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import nbformat
import pytest
from nbformat.v4 import new_code_cell, new_notebook

if TYPE_CHECKING:
    from collections.abc import Callable

ROOT = Path(__file__).parents[2]
EXECUTE = ROOT / "notebooks" / "execute.py"

# one notebook with all that can change, written the way the project's notebooks are
CELLS = """\
import ipywidgets
import matplotlib.pyplot as plt
import sympy
from raytransfer.explorer import Explorer
from raytransfer.thesis import claims
---
claims("O1", "O2")
---
sympy.sqrt(sympy.Symbol("x")) / 2
---
print("focal length 29.8077 mm")
---
figure, ax = plt.subplots(figsize=(4, 2))
ax.plot([0, 1], [0, 1]);
---
explorer = Explorer(source_dist=2000)
explorer
---
def on_change(change):
    with log:
        print("moved to", change["new"])

log = ipywidgets.Output()
slider = ipywidgets.IntSlider(value=3, max=10)
slider.observe(on_change, names="value")
slider
---
slider.value = 4
log"""


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The notebook's text as execute.py saves it."""
    path = tmp_path_factory.mktemp("saved") / "sample.ipynb"
    cells = [new_code_cell(source) for source in CELLS.split("\n---\n")]
    nbformat.write(new_notebook(cells=cells), path)
    run = subprocess.run(
        [sys.executable, EXECUTE, path], capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr
    return path.read_text(encoding="utf-8")


def check(text: str, folder: Path, *options: str) -> tuple[int, str]:
    """Run pytest on a notebook with this text, beside the project's conftest."""
    (folder / "sample.ipynb").write_text(text, encoding="utf-8")
    shutil.copy(ROOT / "notebooks" / "conftest.py", folder)
    (folder / "pytest.ini").write_text("[pytest]\n", encoding="utf-8")
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "--color=no", "sample.ipynb", *options],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    return run.returncode, run.stdout + run.stderr


def replaced(old: str, new: str) -> Callable[[str], str]:
    """A change of the notebook's text that must find what it changes."""

    def change(text: str) -> str:
        assert old in text, f"{old!r} is not in the notebook"
        return text.replace(old, new)

    return change


def in_output(old: str, new: str) -> Callable[[str], str]:
    """A change in the saved outputs only, so that code and outputs disagree."""

    def change(text: str) -> str:
        notebook = json.loads(text)
        for cell in notebook["cells"]:
            outputs = json.dumps(cell["outputs"])
            if old in outputs:
                cell["outputs"] = json.loads(outputs.replace(old, new))
                return json.dumps(notebook)
        raise AssertionError(f"{old!r} is in no output")

    return change


def widget_state(model_name: str, change_state: Callable[[dict[str, Any]], None]) -> Any:
    """A change in the saved state of the first widget of a kind."""

    def change(text: str) -> str:
        notebook = json.loads(text)
        states = notebook["metadata"]["widgets"]["application/vnd.jupyter.widget-state+json"]
        models = [m for m in states["state"].values() if m["model_name"] == model_name]
        change_state(models[0]["state"])
        return json.dumps(notebook)

    return change


MUTATIONS = {
    "number in a table": (in_output("26.1047 mm", "26.1048 mm"), "mismatch 'text/markdown'"),
    "LaTeX": (in_output("sqrt{x}", "sqrt{y}"), "mismatch 'text/latex'"),
    "printed line": (replaced("29.8077 mm\\\\n", "29.8078 mm\\\\n"), "mismatch 'stdout'"),
    "figure": (replaced("ax.plot([0, 1], [0, 1])", "ax.plot([0, 1], [0, 0.95])"), "figure 1"),
    "figure is gone": (replaced("ax.plot([0, 1], [0, 1])", "plt.close()"), "Missing output"),
    "slider default": (replaced("value=3, max=10", "value=2, max=10"), "Cell outputs differ"),
    "slider default inside a widget": (
        replaced("Explorer(source_dist=2000)", "Explorer(source_dist=2010)"),
        "Widgets differ",
    ),
    "saved slider": (
        widget_state("IntSliderModel", lambda state: state.update(value=7)),
        "Widgets differ",
    ),
    "text captured by an Output widget": (
        replaced('\\"moved to\\"', '\\"shifted to\\"'),
        "Widgets differ",
    ),
    "error in a callback": (
        replaced('print(\\"moved to\\", change[\\"new\\"])', "1 / 0"),
        "ZeroDivisionError",
    ),
    "error in a callback that no cell triggers": (
        replaced('change[\\"new\\"])', 'change[\\"new\\"] if change[\\"new\\"] == 4 else 1 / 0)'),
        "ZeroDivisionError",
    ),
    "cell without its run": (replaced('"execution_count": 4', '"execution_count": null'), "having"),
}


def test_untouched_copy_passes(saved: str, tmp_path: Path) -> None:
    code, output = check(saved, tmp_path)
    assert code == 0, output
    assert f"{CELLS.count('---') + 3} passed" in output  # the cells and two checks of the widgets


@pytest.mark.parametrize("name", MUTATIONS)
def test_mutation_fails(name: str, saved: str, tmp_path: Path) -> None:
    change, reason = MUTATIONS[name]
    code, output = check(change(saved), tmp_path)
    assert code == 1, output
    assert reason in output


def test_lax_option_is_not_laxer(saved: str, tmp_path: Path) -> None:
    change, reason = MUTATIONS["printed line"]
    code, output = check(change(saved), tmp_path, "--nbval-lax")
    assert code == 1, output
    assert reason in output


def test_every_notebook_is_in_its_committed_form() -> None:
    """Executed by execute.py: no timing, no random ids, no leftovers of an editor."""
    notebooks = sorted((ROOT / "notebooks").glob("*.ipynb"))
    assert len(notebooks) >= 5
    for path in notebooks:
        notebook = json.loads(path.read_text(encoding="utf-8"))
        assert set(notebook["metadata"]) <= {"kernelspec", "language_info", "widgets"}, path
        for number, cell in enumerate(notebook["cells"], start=1):
            assert cell["id"] == f"cell-{number:02d}", path
            assert set(cell["metadata"]) <= {"tags"}, path
        runs = [c["execution_count"] for c in notebook["cells"] if c["cell_type"] == "code"]
        assert runs == list(range(1, len(runs) + 1)), path
