"""The command ``linetrack calibrate``: recordings from measured places in, a calibration file out.

Nothing slow is imported before it runs, so that ``linetrack calibrate --help`` answers at once.
"""

from __future__ import annotations

from pathlib import Path  # noqa: TC003  # typer reads annotations
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from acquisition.cli import FAILED, UsageError
from tracking.cli import design, read_leds

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rich.console import Console

    from tracking.calibration import Calibration, Observation
    from tracking.survey import Sight

_EPILOG: Final = """\
[bold]Example[/]
  linetrack capture --stream -n 90 --leds -,0:80,0:20,1:80,1:20,2:80,2:20 -o spot01.h5
      [dim]at 20 places or more, all over the area: one LED a frame, for 20 and for 5 us, as near ones
      would saturate; and - for none[/]
  linetrack calibrate survey.txt --leds leds.txt --head slit-4mm -o room.json
      [dim]survey.txt: lines such as  spot01.h5  -400  1500  5  (mm, mm, degrees)[/]
      [dim]leds.txt: lines such as  0  -250  0  (channel, x, y in mm)[/]
  linetrack track --calibration room.json

Exit codes: linetrack --help"""

app = typer.Typer(add_completion=False, rich_markup_mode="rich")


@app.command(epilog=_EPILOG)
def calibrate(
    survey: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            show_default=False,
            help="Text: lines of a recording, the tracker's x and y there in mm, and its heading in "
            "degrees, counter-clockwise from above; the heading may be left out. # begins a comment.",
        ),
    ],
    leds: Annotated[
        Path,
        typer.Option(
            "--leds",
            metavar="FILE",
            show_default=False,
            help="Where the LEDs are, about: lines of channel, x, y and z in mm, z may be left out.",
        ),
    ],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="FILE", show_default=False, help="NAME.json"),
    ],
    head: Annotated[
        str | None,
        typer.Option(
            "--head",
            metavar="NAME",
            help="Lens head: a design, or its file.  \\[default: the recordings'; or thesis]",
        ),
    ] = None,
    place_error: Annotated[
        float,
        typer.Option("--place-error", metavar="MM", help="How well x and y are known, 1 σ."),
    ] = 1.0,
    heading_error: Annotated[
        float,
        typer.Option("--heading-error", metavar="DEGREES", help="The same of the headings."),
    ] = 0.2,
    led_error: Annotated[
        float, typer.Option("--led-error", metavar="MM", help="The same of the LEDs' x and y.")
    ] = 5.0,
    height: Annotated[
        float,
        typer.Option("--height", metavar="MM", help="Of the tracker, as the LEDs' z counts."),
    ] = 0.0,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace a file that is there.")
    ] = False,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="Only warnings and errors, no summary.")
    ] = False,
) -> None:
    """Calibrate camera and LEDs from recordings made at measured places."""
    raise typer.Exit(_run(**locals()))


def _run(
    *,
    survey: Path,
    leds: Path,
    output: Path,
    head: str | None,
    place_error: float,
    heading_error: float,
    led_error: float,
    height: float,
    overwrite: bool,
    quiet: bool,
) -> int:
    from rich.console import Console

    from acquisition.session import open_session
    from tracking.calibration import Calibration, bundle
    from tracking.spikes import SpikeFinder
    from tracking.survey import look, read_survey

    if output.suffix != ".json":
        raise UsageError(f"-o {output}: a calibration file ends in .json")
    if not output.parent.is_dir():
        raise UsageError(f"-o {output}: there is no folder {output.parent}; make it first")
    if output.exists() and not overwrite:
        raise UsageError(f"-o {output}: exists; take another name, or --overwrite")
    led_map, places = read_leds(leds), read_survey(survey)
    console = Console(stderr=True, highlight=False, soft_wrap=True)
    finder = SpikeFinder()
    described: dict[Path, Any] = {}
    observations: list[Observation] = []
    for place in places:
        with open_session(place.recording) as session:
            described[place.recording] = session.metadata.lens_system
            sights = look(session, finder)
        if not sights:
            raise UsageError(
                f"{place.recording}: no frame of one LED alone, as --leds 0:80,1:80,- gives them"
            )
        if unknown := sorted(set(sights) - set(led_map.channels)):
            raise UsageError(
                f"{place.recording}: LED {unknown[0]} was lit, and {leds} does not have it"
            )
        if not quiet:
            console.print(f"{place.recording.name}: {_seen(sights)}", markup=False)
        try:
            observations.append(place.observed(sights, place_error, heading_error, height))
        except ValueError as error:
            raise UsageError(f"{survey}, line {place.line}: {error}") from error
    first, *others = described
    if head is None:
        for other in others:
            if described[other] != described[first]:
                raise UsageError(
                    f"{other} and {first} were made through different heads, as they say: one "
                    "calibration is of one head; if it is the same, name it with --head"
                )
    nominal = Calibration.nominal(design(described[first], head, console), led_map)
    made = f"{len(places)} places, {survey.name}."
    try:
        found = bundle(observations, led_map, nominal.camera, led_sigma=led_error, notes=made)
    except (ValueError, RuntimeError) as error:
        console.print(f"linetrack: nothing is written: {error}", style="red", markup=False)
        return FAILED
    found.save(output)
    if not quiet:
        _tell(found, nominal, output, console)
    return 0


def _seen(sights: Mapping[int, Sight]) -> str:
    """Which LEDs are used, and which are not for what reason."""
    by_reason: dict[str, list[str]] = {"used": []}
    for channel, sight in sights.items():
        by_reason.setdefault(sight.why or "used", []).append(str(channel))
    return "; ".join(f"{why}: {', '.join(which) or 'none'}" for why, which in by_reason.items())


def _tell(found: Calibration, nominal: Calibration, output: Path, console: Console) -> None:
    import numpy as np

    lines = [
        (
            f"{output}: {found.spikes} spikes, residuals {found.rms:.3f} px RMS; the camera model leaves "
            f"{found.camera.model_error:.3f} px"
        )
    ]
    lines += [
        f"  {name:16}{value:12.6g} ± {found.sigma(name):.2g}   (drawing: {drawn})"
        for name, value, drawn in zip(
            found.camera.names, found.camera.parameters, _drawn(found, nominal), strict=True
        )
        if found.sigma(name) > 0
    ]
    off = np.linalg.norm((found.leds.positions - nominal.leds.positions)[:, :2], axis=1)
    lines.append(
        f"  LEDs are off the map by {np.median(off):.1f} mm (median), {off.max():.1f} (most)"
    )
    for line in [*lines, found.notes]:
        console.print(line, markup=False)


def _drawn(found: Calibration, nominal: Calibration) -> list[str]:
    """The drawing's numbers; its model may have fewer terms."""
    known = dict(zip(nominal.camera.names, nominal.camera.parameters, strict=True))
    return [f"{known.get(name, 0.0):.6g}" for name in found.camera.names]
