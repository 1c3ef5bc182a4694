"""The command ``linetrack build``: everything that making a head takes, into one folder.

Nothing slow is imported before it runs, so that ``linetrack build --help`` answers at once.
"""

from __future__ import annotations

from pathlib import Path  # noqa: TC003  # typer reads annotations
from typing import TYPE_CHECKING, Annotated, Final

import typer

from acquisition.cli import FAILED, UsageError

if TYPE_CHECKING:
    from rich.console import Console

    from hardware.package import Package
    from raytransfer.designs import Design

VARIANTS: Final = ("improved", "thesis")

_EPILOG: Final = """\
[bold]Examples[/]
  linetrack build thesis -o package
      [dim]the thesis's lenses, with boards that have none of the thesis's known hazards[/]
  linetrack build thesis -o package --variant thesis
      [dim]the thesis's boards as they were; the package lists their hazards[/]
  linetrack build my-head.toml -o package
      [dim]a head of your own, from its design file[/]

Faults that a check finds are listed, and nothing is written: exit code 1. Other exit codes:
linetrack --help"""

app = typer.Typer(add_completion=False, rich_markup_mode="rich")


@app.command(epilog=_EPILOG)
def build(
    head: Annotated[
        str,
        typer.Argument(
            metavar="HEAD", show_default=False, help="The lens head: a design, or its file."
        ),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="FOLDER",
            show_default=False,
            help="Where to; is made. An earlier package there is replaced.",
        ),
    ],
    variant: Annotated[
        str,
        typer.Option(
            "--variant",
            metavar="NAME",
            help="Which boards: improved, or thesis, with the hazards that these have.",
        ),
    ] = VARIANTS[0],
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Only errors, no summary.")] = False,
) -> None:
    """Write all that building a head takes: parts to print, boards, bill, wiring, instructions."""
    raise typer.Exit(_run(head, output, variant, quiet=quiet))


def _run(head: str, output: Path, variant: str, *, quiet: bool) -> int:
    from rich.console import Console

    if variant not in VARIANTS:
        raise UsageError(f"--variant {variant}: allowed are {' and '.join(VARIANTS)}")
    design = _design(head)
    try:
        from hardware.package import FaultsError, build_package

        package = build_package(
            design.system, output, sensor=design.sensor, variant=variant, notes=design.notes
        )
    except ModuleNotFoundError as error:
        raise UsageError(
            f"{error.name or error}: a package needs more than is installed, "
            "pip install 'linetrack[hardware]'"
        ) from error
    except FaultsError as error:
        console = Console(stderr=True, highlight=False, soft_wrap=True)
        console.print(str(error), style="red", markup=False)
        return FAILED
    if not quiet:
        _tell(package, Console(highlight=False, soft_wrap=True))
    return 0


def _tell(package: Package, console: Console) -> None:
    plan, manifest = package.plan, package.manifest
    figures = manifest["figures"]
    size = " × ".join(f"{side:.1f}" for side in figures["mount_size_mm"])
    heights = figures["lens_heights_above_cover_mm"]
    checked = ["lens mount", "stand", "LED mount", "boards", "board files"]
    checked += ["circuits"] if plan.measurements is not None else []
    lines = [
        f"head: {manifest['head']}",
        f"lens mount: {size} mm; above the sensor's cover: "
        + ", ".join(f"{name} {height:.2f} mm" for name, height in heights.items()),
        (
            f"boards: {', '.join(manifest['boards'])} ({plan.variant} variant); LEDs from "
            f"{plan.led_supply:g} V"
        ),
        f"priced parts: {figures['priced_total_euro']} €",
        f"no fault found in: {', '.join(checked)}",
    ]
    for line in lines:
        console.print(line, markup=False)
    for what in plan.left_out():
        console.print(f"left out: {what}", style="yellow", markup=False)
    for hazard in plan.hazards:
        console.print(f"hazard: {hazard}", style="yellow", markup=False)
    total = sum(entry["size"] for entry in manifest["files"])
    console.print(
        f"{len(manifest['files']) + 1} files, {total / 1e6:.1f} MB, in {package.folder}; begin with "
        f"{package.page.name}",
        markup=False,
    )
    console.print("Calculated and simulated: nothing of this has been fabricated.", markup=False)


def _design(head: str) -> Design:
    """The head: a design by its name, or from its file."""
    from raytransfer.designs import find_design

    try:
        return find_design(head)
    except LookupError as error:
        raise UsageError(str(error)) from error
