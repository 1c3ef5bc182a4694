"""The notebooks' guard: an untouched notebook passes, each kind of change fails."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from functools import partial
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


def changed(part: str, old: str, new: str) -> Callable[[str], str]:
    """A change in the sources or in the saved outputs, so that the two disagree."""

    def change(text: str) -> str:
        notebook = json.loads(text)
        for cell in notebook["cells"]:
            as_text = json.dumps(cell[part], ensure_ascii=False)
            if old in as_text:
                cell[part] = json.loads(as_text.replace(old, new))
                return json.dumps(notebook)
        raise AssertionError(f"{old!r} is in none of the {part}")

    return change


in_source = partial(changed, "source")
in_output = partial(changed, "outputs")


def without_widgets(text: str) -> str:
    """The notebook as JupyterLab saves it unless told to keep the widgets' state."""
    notebook = json.loads(text)
    del notebook["metadata"]["widgets"]
    return json.dumps(notebook)


def never_run(text: str) -> str:
    """The notebook with a cell that was saved before it ran."""
    notebook = json.loads(text)
    notebook["cells"][3].update(execution_count=None, outputs=[])
    return json.dumps(notebook)


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
    "printed line": (in_output("29.8077 mm", "29.8078 mm"), "mismatch 'stdout'"),
    "figure": (in_source("[0, 1], [0, 1]", "[0, 1], [0, 0.95]"), "figure 1 differs"),
    "colour of a line": (in_source("[0, 1], [0, 1]", "[0, 1], [0, 1], 'C1'"), "figure 1 differs"),
    "figure is gone": (in_source("ax.plot([0, 1], [0, 1])", "plt.close()"), "Missing output"),
    "slider default": (in_source("value=3", "value=2"), "mismatch 'text/plain'"),
    "slider default inside a widget": (in_source("=2000", "=2010"), "Widgets differ"),
    "saved slider": (
        widget_state("IntSliderModel", lambda state: state.update(value=7)),
        "Widgets differ",
    ),
    "text captured by an Output widget": (in_source("moved to", "shifted to"), "Widgets differ"),
    "error in a callback": (
        in_source('print(\\"moved to\\", change[\\"new\\"])', "1 / 0"),
        "ZeroDivisionError",
    ),
    "error in a callback that no cell triggers": (
        in_source('change[\\"new\\"])', 'change[\\"new\\"] // (change[\\"new\\"] == 4) * 1)'),
        "ZeroDivisionError",
    ),
    "error when the sensor is let go": (
        in_source(
            "Explorer(source_dist=2000)",
            "Explorer(source_dist=2000)\\n"
            "explorer.sensor_dist.observe(lambda c: 1 / explorer.focus.value, 'value')",
        ),
        "ZeroDivisionError",
    ),
    "cell that is skipped": (
        in_source("print(", "#NBVAL_IGNORE_OUTPUT\\nprint("),
        "would leave this cell unchecked",
    ),
    "widgets that were not saved": (without_widgets, "Widgets were not saved"),
    "cell that never ran": (never_run, "saved without having run"),
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
