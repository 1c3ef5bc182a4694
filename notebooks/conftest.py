"""Notebooks as strict regression tests: what nbval leaves open is closed here.

Every cell's text, LaTeX, tables and streams are compared by nbval. On top of that

* figures are compared by the RMS of their grey levels, and of their colours within small squares;
* what an `Output` widget captured belongs to that widget, not to the cell, and an error that it
  captured fails the cell;
* a closing semicolon silences a cell, as it does in a notebook;
* a cell that was never run has nothing to compare with, and fails;
* after the last cell the widgets themselves are compared with those saved in the notebook, and
  every control is moved: a callback that raises fails, wherever its traceback went;
* nbval's tags and comments that leave a cell unchecked are refused.

`pytest notebooks/x.ipynb` is all it takes; nbval's own options are not needed.
"""

from __future__ import annotations

import base64
import io
import json
import os
import re
import shutil
import tempfile
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from nbformat.v4 import new_code_cell
from nbval.plugin import IPyNbCell, IPyNbFile, NbCellError
from PIL import Image

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

GREY_RMS = 2.0
"""Figures that differ by more than this many of 255 grey levels (root mean square) are different."""

TILE = 32
TILE_RMS = 5.0
"""The same for colours within any square of so many pixels."""

GREY = np.array([0.299, 0.587, 0.114])

WIDGET_STATE = "application/vnd.jupyter.widget-state+json"

NOT_COMPARED = ("children", "layout", "msg_id", "style")
"""What a widget's state holds of random ids."""

NEEDS = {"18-hardware.ipynb": "ngspice"}
"""Programs that PyPI does not have. Without them a notebook is skipped, but in CI it fails."""

NOT_ALLOWED = ("nbval-skip", "nbval-ignore-output", "nbval-raises-exception", "raises-exception")
"""Tags, also as comments, that would leave a cell unchecked."""

MOVE_EVERY_CONTROL = """
def _move_every_control():
    import sys
    if "ipywidgets" not in sys.modules:
        return
    from ipywidgets import widgets as w
    from ipywidgets.widgets import widget_float as f, widget_int as i, widget_selection as s
    shows_only = (w.HTML, w.HTMLMath, w.Label, w.Image, w.Audio, w.Video, w.Valid,
                  w.FloatProgress, w.IntProgress)

    def elsewhere(control):
        value = control.value
        if isinstance(control, (w.Checkbox, w.ToggleButton)):
            return [not value]
        if isinstance(control, w.FloatLogSlider):
            return [control.base ** control.min, control.base ** control.max]
        if isinstance(control, (f._BoundedFloatRange, i._BoundedIntRange)):
            return [(control.min, control.max), (control.min, control.min)]
        if isinstance(control, (f._BoundedFloat, i._BoundedInt)):
            step = control.step or (control.max - control.min) / 10
            near = [v for v in (value - step, value + step) if control.min <= v <= control.max]
            return [*near, control.min, control.max]
        if isinstance(control, s._MultipleSelection):
            return [(), control._options_values]
        if isinstance(control, s.SelectionRangeSlider):
            return [(control._options_values[0], control._options_values[-1])]
        if isinstance(control, s._Selection):
            return list(control._options_values)
        if isinstance(control, (w.FloatText, w.IntText)):
            return [value + 1]
        if isinstance(control, (w.Text, w.Textarea, w.Combobox)):
            return [value + "x"]
        raise TypeError(f"the notebooks' guard does not know how to move a {type(control).__name__}")

    def move(controls):
        for control in controls:
            before = control.value
            for value in elsewhere(control):
                control.value = value
            control.value = before

    controls = [control for control in w.widget._instances.values()
                if hasattr(control, "value") and not isinstance(control, shows_only)]
    enabled = [control for control in controls if not getattr(control, "disabled", False)]
    move(enabled)
    # what a switch enables is moved while it is the other way
    for switch in enabled:
        if isinstance(switch, (w.Checkbox, w.ToggleButton)):
            switch.value = not switch.value
            move([control for control in controls if control not in enabled
                  and not control.disabled])
            switch.value = not switch.value
    for control in list(w.widget._instances.values()):
        if isinstance(control, w.Button):
            control.click()
_move_every_control()
"""


def pytest_collect_file(file_path: Path, parent: pytest.Collector) -> StrictNotebook | None:
    """Collect notebooks strictly, whatever nbval was told on the command line."""
    if file_path.suffix != ".ipynb":
        return None
    parent.config.option.nbval = parent.config.option.nbval_lax = False
    notebook: StrictNotebook = StrictNotebook.from_parent(parent, path=file_path)
    return notebook


def picture_difference(one: bytes, other: bytes) -> str:
    """Say how two pictures differ; empty if they do not."""
    new, saved = (np.asarray(Image.open(io.BytesIO(p)).convert("RGB"), float) for p in (one, other))
    if new.shape != saved.shape:
        return f"size {new.shape[:2]} instead of {saved.shape[:2]}"
    grey = np.sqrt(np.mean(((new - saved) @ GREY) ** 2))
    if grey > GREY_RMS:
        return f"RMS of grey levels {grey:.2f} > {GREY_RMS}"
    # a line of another colour, a marker elsewhere: little in the whole, much where it is
    square = np.mean((new - saved) ** 2, axis=2)
    height, width = (size // TILE * TILE for size in square.shape)
    tiles = square[:height, :width].reshape(height // TILE, TILE, width // TILE, TILE)
    worst = np.sqrt(tiles.mean(axis=(1, 3)).max())
    if worst > TILE_RMS:
        return f"RMS of colour levels {worst:.2f} > {TILE_RMS} within {TILE} pixels"
    return ""


class StrictNotebook(IPyNbFile):  # type: ignore[misc]
    """A notebook whose cells are compared strictly and whose widgets are watched."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.compare_outputs = True
        self.models: dict[str, dict[str, Any]] = {}
        """State of the running notebook's widgets by model id."""

    def collect(self) -> Iterator[pytest.Item]:
        """Yield the cells, then two checks of the widgets."""
        needed = NEEDS.get(self.path.name)
        if needed and not shutil.which(needed) and not os.environ.get("CI"):
            pytest.skip(f"{needed} is missing: apt install {needed}")
        cells = list(super().collect())
        for item in cells:
            yield StrictCell.from_parent(
                self, name=item.name, cell_num=item.cell_num, cell=item.cell, options=item.options
            )
        yield Widgets.from_parent(self, name="widgets are as saved")
        yield StrictCell.from_parent(
            self,
            name="every control moves",
            cell_num=len(cells),
            cell=new_code_cell(MOVE_EVERY_CONTROL, execution_count=0),
            options={"check": True, "skip": False, "check_exception": False},
        )

    def setup(self) -> None:
        """Start the kernel with a profile of its own, and run cells as a notebook does.

        nbval keeps cells out of the history, and without it a closing semicolon silences nothing.
        """
        self._profile = tempfile.mkdtemp(prefix="ipython-")
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("IPYTHONDIR", self._profile)
            patch.setenv("OPENBLAS_NUM_THREADS", "1")  # as execute.py does
            super().setup()
        self.kernel.execute_cell_input = partial(
            self.kernel.kc.execute, store_history=True, stop_on_error=False
        )

    def teardown(self) -> None:
        """Stop the kernel and remove its profile."""
        super().teardown()
        shutil.rmtree(self._profile, ignore_errors=True)

    def get_kernel_message(self, timeout: float | None = None, stream: str = "iopub") -> Any:
        """Return the next message that belongs to a cell; what belongs to widgets is kept here."""
        while True:
            message = super().get_kernel_message(timeout, stream)
            kind, content = message["msg_type"], message["content"]
            if kind == "comm_open" and content.get("target_name") == "jupyter.widget":
                self.models[content["comm_id"]] = {}
            if kind in ("comm_open", "comm_msg") and content["comm_id"] in self.models:
                self._update(content["comm_id"], content["data"], message.get("buffers", ()))
            model = self._captured_by(message)
            if model is None or kind == "error":
                return message
            if kind == "clear_output":
                model["outputs"] = []
            elif kind in ("stream", "display_data", "execute_result"):
                model.setdefault("outputs", []).append({"output_type": kind, **content})
            else:
                return message

    def _update(self, comm_id: str, data: dict[str, Any], buffers: Any) -> None:
        if "state" in data:
            self.models[comm_id].update(data["state"])
            for path, buffer in zip(data.get("buffer_paths", ()), buffers, strict=True):
                self.models[comm_id][path[0]] = bytes(buffer)

    def _captured_by(self, message: dict[str, Any]) -> dict[str, Any] | None:
        """Return the Output widget that holds the cell's output at the moment, if there is one."""
        parent = message["parent_header"].get("msg_id")
        for model in self.models.values():
            if model.get("_model_name") == "OutputModel" and model.get("msg_id") == parent:
                return model
        return None


class StrictCell(IPyNbCell):  # type: ignore[misc]
    """A cell whose figures are compared too."""

    def runtest(self) -> None:
        """Refuse a cell that was saved without having run; nbval would pass it unchecked."""
        tags = [tag.lower().replace("_", "-") for tag in self.cell.metadata.get("tags", ())]
        comments = self.cell.source.lower().replace("_", "-")
        for tag in NOT_ALLOWED:
            if tag in tags or re.search(rf"^\s*#\s*{tag}\s*$", comments, flags=re.MULTILINE):
                self.raise_cell_error(f"{tag} would leave this cell unchecked")
        if self.cell.execution_count is None and self.cell.source.strip():
            self.raise_cell_error("This cell was saved without having run")
        super().runtest()

    def compare_outputs(self, test: Any, ref: Any, skip_compare: Any = None) -> bool:
        """Compare text as nbval does, then the pictures."""
        if not super().compare_outputs(test, ref, skip_compare):
            return False
        new, saved = ([png for out in outs if (png := _png(out))] for outs in (test, ref))
        if len(new) != len(saved):
            self.comparison_traceback.append(f"{len(saved)} figures saved, {len(new)} drawn")
            return False
        for number, (one, other) in enumerate(zip(new, saved, strict=True), start=1):
            if difference := picture_difference(one, other):
                self.comparison_traceback.append(f"figure {number} differs: {difference}")
                return False
        return True


class Widgets(pytest.Item):
    """The widgets of a notebook against those it was saved with."""

    parent: StrictNotebook

    def runtest(self) -> None:
        """Compare states as text, pictures by their grey levels."""
        models = list(self.parent.models.values())
        widgets = self.parent.nb.metadata.get("widgets")
        if models and not widgets:
            raise NbCellError(0, "Widgets were not saved", "run: python notebooks/execute.py")
        states = widgets[WIDGET_STATE]["state"].values() if widgets else ()
        saved_texts, saved_pictures = _split([_saved_state(entry) for entry in states])
        new_texts, new_pictures = _split(models)
        if saved_texts != new_texts:
            gone = [text for text in saved_texts if text not in new_texts]
            come = [text for text in new_texts if text not in saved_texts]
            message = ["saved, but not so now:", *gone, "now, but not saved:", *come]
            raise NbCellError(0, "Widgets differ", "\n".join(message))
        for picture in saved_pictures:
            same = [new for new in new_pictures if not picture_difference(new, picture)]
            if not same:
                reasons = (picture_difference(new, picture) for new in new_pictures)
                raise NbCellError(0, "A widget's picture differs", "; ".join(reasons))
            new_pictures.remove(same[0])
        if new_pictures:
            raise NbCellError(0, f"{len(new_pictures)} more pictures in widgets than saved", "")

    def repr_failure(self, excinfo: Any, style: Any = None) -> Any:
        """Show what differs, without a traceback of this file."""
        if isinstance(excinfo.value, NbCellError):
            return f"{excinfo.value}\n{excinfo.value.source}"
        return super().repr_failure(excinfo, style)

    def reportinfo(self) -> tuple[Path, int, str]:
        """Name the notebook."""
        return self.path, 0, f"{self.path.name}: {self.name}"


def _png(output: Any) -> bytes | None:
    data = output.get("data", {}).get("image/png")
    return base64.b64decode(data) if data else None


def _saved_state(entry: dict[str, Any]) -> dict[str, Any]:
    """Return a saved widget's state, with its buffers in it as bytes."""
    state = {"_model_name": entry["model_name"], **entry["state"]}
    for buffer in entry.get("buffers", ()):
        state[buffer["path"][0]] = base64.b64decode(buffer["data"])
    return state


def _split(models: list[dict[str, Any]]) -> tuple[list[str], list[bytes]]:
    """Return the states of widgets as text without random ids, and their pictures."""
    texts, pictures = [], []
    for model in models:
        shown = {}
        for key, value in sorted(model.items()):
            if isinstance(value, bytes):
                pictures.append(value)
            elif key == "outputs":
                shown[key] = "".join(str(out.get("text", out.get("data"))) for out in value)
            elif not key.startswith("_") and key not in NOT_COMPARED and value is not None:
                shown[key] = value
        if shown:
            texts.append(f"{model.get('_model_name')} {json.dumps(shown, sort_keys=True)}")
    return sorted(texts), pictures
