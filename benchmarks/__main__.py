"""Run benchmarks, print a table, write build/bench.json."""

from __future__ import annotations

import argparse
import importlib
import os
import platform
from datetime import UTC, datetime
from pathlib import Path
from pkgutil import iter_modules

import numpy as np
from rich.console import Console
from rich.table import Table

import benchmarks
from benchmarks.measure import Result, write_json


def main() -> None:
    """Run the command."""
    available = [m.name for m in iter_modules(benchmarks.__path__) if m.name.startswith("bench_")]
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument(
        "names",
        nargs="*",
        metavar="NAME",
        help=f"only those with NAME in their name; there are {', '.join(available)}",
    )
    parser.add_argument("--output", type=Path, default=Path("build/bench.json"), metavar="FILE")
    arguments = parser.parse_args()
    wanted = arguments.names or [""]
    chosen = [module for module in available if any(name in module for name in wanted)]
    if not chosen:
        parser.error(f"no benchmark is called {' or '.join(wanted)}")

    console = Console()
    results: list[Result] = []
    try:
        for module in chosen:
            console.print(f"{module} …", style="dim")
            results += importlib.import_module(f"benchmarks.{module}").run()
    finally:  # one that fails does not take with it what the others measured
        write_json(results, arguments.output)
        console.print(_table(results))
        console.print(f"{arguments.output} has every sample")


def _table(results: list[Result]) -> Table:
    table = Table(title=_title(), title_justify="left")
    for column in ("name", "value", "unit", "target", "holds"):
        table.add_column(column, justify="right" if column in ("value", "target") else "left")
    for result in results:
        table.add_row(
            result.name,
            _number(result.value),
            result.unit,
            ""
            if result.target is None
            else f"{'≥' if result.direction == 'higher' else '≤'} {_number(result.target)}",
            {None: "", True: "yes", False: "[bold red]no[/]"}[result.holds],
        )
    return table


def _number(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def _title() -> str:
    return (
        f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC, {_cpu()}, {os.cpu_count()} cores\n"
        f"Python {platform.python_version()}, numpy {np.__version__}"
    )


def _cpu() -> str:
    """Return what Linux calls the processor or, on a Raspberry Pi, the board."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.is_file() else []
    for line in lines:
        key, _, value = line.partition(":")
        if key.strip() in ("model name", "Model"):
            return value.strip()
    return platform.processor() or platform.machine()


if __name__ == "__main__":
    main()
