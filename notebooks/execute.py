"""Execute notebooks in place, so that the same notebook always gives the same bytes.

    python notebooks/execute.py [--check] [NOTEBOOK ...]

Left out: all of this folder. Nothing is written where a cell fails, warns or prints to stderr.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient

AT_ONCE = min(os.cpu_count() or 1, 4)

ROUNDING = {"OPENBLAS_NUM_THREADS": "1", "OPENBLAS_CORETYPE": "Haswell"}
"""Sums are rounded otherwise on several threads, and by what OpenBLAS has for newer processors."""

WIDGET_STATE = "application/vnd.jupyter.widget-state+json"


class NotReproducible(Exception):  # noqa: N818, it says what the notebook is
    """A notebook that may not be committed as it is."""


def executed(path: Path) -> str:
    """Return the notebook with fresh outputs, as the text of its file."""
    notebook = nbformat.read(path, as_version=4)
    client = NotebookClient(
        notebook,
        timeout=300,
        kernel_name="python3",
        record_timing=False,
        resources={"metadata": {"path": str(path.parent)}},
    )
    with tempfile.TemporaryDirectory(prefix="ipython-") as profile:
        # not the user's own profile
        client.execute(env={**os.environ, **ROUNDING, "IPYTHONDIR": profile})
    for number, cell in enumerate(notebook.cells, start=1):
        cell.id = f"cell-{number:02d}"
        cell.metadata = {key: value for key, value in cell.metadata.items() if key == "tags"}
        if cell.cell_type == "code":
            cell.outputs = _joined(cell.outputs)
        for output in cell.get("outputs", ()):
            _refuse(path, number, output)
    widgets = notebook.metadata.get("widgets", {}).get(WIDGET_STATE, {}).get("state", {})
    for model in widgets.values():
        if "outputs" in model["state"]:
            model["state"]["outputs"] = _joined(model["state"]["outputs"])
        for output in model["state"].get("outputs", ()):
            _refuse(path, 0, output)
    notebook.metadata = {
        "kernelspec": {
            "display_name": "Python 3 (ipykernel)",
            "language": "python",
            "name": "python3",
        },
        "language_info": {"name": "python"},
        **({"widgets": notebook.metadata["widgets"]} if widgets else {}),
    }
    return _renumbered(nbformat.writes(notebook), list(widgets))


def _joined(outputs: list[Any]) -> list[Any]:
    """Join what was printed: the kernel sends it in pieces, divided by the clock."""
    joined: list[Any] = []
    streams: dict[str, Any] = {}
    for output in outputs:
        name = output.get("name")
        if output["output_type"] == "stream" and name in streams:
            streams[name]["text"] += output["text"]
            continue
        if output["output_type"] == "stream":
            streams[name] = output
        joined.append(output)
    return joined


def _refuse(path: Path, number: int, output: dict[str, Any]) -> None:
    where = f"{path.name}, cell {number}" if number else f"{path.name}, in an Output widget"
    if output["output_type"] == "error":
        raise NotReproducible(f"{where}: {output['ename']}: {output['evalue']}")
    if output.get("name") == "stderr":
        raise NotReproducible(f"{where} writes to stderr: {output['text']}")
    if address := re.search(r"\bat 0x[0-9a-f]{6,}", json.dumps(output)):
        raise NotReproducible(f"{where} shows a memory address: {address.group()}")


def _renumbered(text: str, model_ids: list[str]) -> str:
    """Replace the random ids of widgets by numbers in the order of their creation."""
    for number, model_id in enumerate(model_ids, start=1):
        text = text.replace(model_id, f"{number:032x}")
    in_new_order: str = nbformat.writes(nbformat.reads(text, as_version=4))
    return in_new_order + "\n"


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description="Execute notebooks in place.")
    parser.add_argument("notebooks", nargs="*", type=Path, metavar="NOTEBOOK")
    parser.add_argument(
        "--check", action="store_true", help="write nothing; fail if a notebook would change"
    )
    options = parser.parse_args()
    changed = 0
    paths = options.notebooks or sorted(Path(__file__).parent.glob("*.ipynb"))
    with ThreadPoolExecutor(AT_ONCE) as kernels, ExitStack() as at_end:
        at_end.callback(kernels.shutdown, wait=False, cancel_futures=True)  # also after an error
        for path, new in zip(paths, kernels.map(executed, paths), strict=True):
            old = path.read_text(encoding="utf-8")
            changed += new != old
            print(f"{path}: {'unchanged' if new == old else 'changed'}", flush=True)
            if new != old and not options.check:
                part = path.with_suffix(".part")
                part.write_text(new, encoding="utf-8")
                part.replace(path)
    return 1 if options.check and changed else 0


if __name__ == "__main__":
    sys.exit(main())
