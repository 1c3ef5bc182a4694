"""How long `import raytransfer` takes beyond `import numpy`, in fresh processes."""

from __future__ import annotations

import subprocess
import sys

from benchmarks.measure import Result, interleaved

ROUNDS = 15
HEAVY = {"sympy", "matplotlib", "IPython", "ipywidgets"}

_PROGRAM = """
import sys, time
start = time.perf_counter()
import {module}
print(time.perf_counter() - start, *sys.modules)
"""


def run() -> list[Result]:
    """Import both in turns."""
    raytransfer, numpy = interleaved(
        ROUNDS, lambda: _import_seconds("raytransfer"), lambda: _import_seconds("numpy")
    )
    beyond = [ours - numpy_alone for ours, numpy_alone in zip(raytransfer, numpy, strict=True)]
    return [Result("import raytransfer − numpy", "s", beyond, "lower", 0.1)]


def _import_seconds(module: str) -> float:
    """Time the import; refuse one that loads what the package promises to load on demand only."""
    command = [sys.executable, "-c", _PROGRAM.format(module=module)]
    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    taken, *loaded = output.split()
    if unwanted := HEAVY.intersection(loaded):
        raise RuntimeError(f"import {module} loads {', '.join(sorted(unwanted))}")
    return float(taken)
