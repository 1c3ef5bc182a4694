"""Run all studies: ``python -m raytransfer [--output FOLDER]``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.table import Table

from raytransfer import report
from raytransfer.thesis import ClaimTable, claims


def main() -> int:
    """Write figures and report, print the table of claims, and say how to go on."""
    parser = argparse.ArgumentParser(
        prog="python -m raytransfer",
        description="Run all studies: table of claims, figures, report.html.",
    )
    parser.add_argument(
        "--output", type=Path, default=Path("build"), metavar="FOLDER", help="default: build"
    )
    folder = parser.parse_args().output
    console = Console()
    columns = (TextColumn("{task.description:28s}"), BarColumn(), MofNCompleteColumn())
    try:
        with Progress(*columns, console=console) as progress:
            task = progress.add_task("studies", total=len(report.FIGURES) + 1)
            for name in report.write(folder):
                progress.update(task, description=name, advance=1)
            progress.update(task, description="done")
    except OSError as error:
        console.print(f"[red]{folder} cannot be written:[/] {error.strerror}; try --output FOLDER")
        return 1
    console.print(_table(claims()))
    console.print(
        f"figures: {folder / 'figures'}   report: {folder / 'report.html'}\n"
        "next: [bold]make lab[/] opens the notebooks, 05-explorer.ipynb has the sliders; "
        "[bold]make test[/] checks every number in them",
        soft_wrap=True,
    )
    return 0


def _table(rows: ClaimTable) -> Table:
    table = Table(title="the thesis's optics: quoted, reproduced (paraxial), difference")
    for number, header in enumerate(rows.HEADER[:5]):
        table.add_column(header, justify="right" if number >= 2 else "left")
    table.add_column("")
    marks = {True: "[green]agrees[/]", False: "[yellow]differs[/]", None: ""}
    for claim in rows:
        table.add_row(*claim.cells()[:5], marks[claim.agrees])
    return table


if __name__ == "__main__":
    sys.exit(main())
