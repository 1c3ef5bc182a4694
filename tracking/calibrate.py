"""The command ``linetrack calibrate``: recordings from measured places in, a calibration file out.

Nothing slow is imported before it runs, so that ``linetrack calibrate --help`` answers at once.
"""

from __future__ import annotations

import json
import math
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
            help="Text: lines of a session (.h5), the tracker's x and y there in mm, and its heading in "
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
    from tracking.calibration import Calibration, UndeterminedError, bundle
    from tracking.spikes import SpikeFinder
    from tracking.survey import look, read_survey

    for name, value in (
        ("place-error", place_error),
        ("heading-error", heading_error),
        ("led-error", led_error),
    ):
        if not value >= 0:
            raise UsageError(f"--{name} {value}: allowed is 0 (known) and more")
    if heading_error > 360:
        raise UsageError(f"--heading-error {heading_error}: degrees are needed, up to 360")
    if not math.isfinite(height):
        raise UsageError(f"--height {height}: a number of mm is needed")
    if output.suffix != ".json" or output.is_dir():
        raise UsageError(f"-o {output}: a calibration is a file that ends in .json")
    if not output.parent.is_dir():
        raise UsageError(f"-o {output}: there is no folder {output.parent}; make it first")
    if output.exists() and not overwrite:
        raise UsageError(f"-o {output}: exists; take another name, or --overwrite")
    led_map, places = read_leds(leds), read_survey(survey)
    console = Console(stderr=True, highlight=False, soft_wrap=True)
    finder = SpikeFinder()
    described: dict[str, Mapping[str, Any]] = {}
    observations: list[Observation] = []
    for number, place in enumerate(places, start=1):
        with open_session(place.recording) as session:
            about = session.metadata.lens_system
            sights = look(session, finder)
        if about:
            described.setdefault(json.dumps(about, sort_keys=True), about)
        if not sights:
            raise UsageError(
                f"{place.recording}: no frame of one LED alone, as --leds 0:80,1:80,- gives them"
            )
        if unknown := sorted(set(sights) - set(led_map.channels)):
            raise UsageError(
                f"{place.recording}: LED {unknown[0]} was lit, and {leds} does not have it"
            )
        if not quiet:
            console.print(f"{number}. {place.recording.name}: {_seen(sights)}", markup=False)
        try:
            observations.append(place.observed(sights, place_error, heading_error, height))
        except ValueError as error:
            raise UsageError(f"{survey}, line {place.line}: {error}") from error
    heads = list(described.values()) or [{}]
    if head is None and len(heads) > 1:
        raise UsageError(
            "the recordings say that they were made through different heads, "
            f"{' and '.join(str(about.get('name', '')) for about in heads)}: one calibration is of "
            "one head; if it is the same, name it with --head"
        )
    lens, *_ = [design(about, head) for about in heads]
    nominal = Calibration.nominal(lens, led_map)
    made = f"{len(places)} place{'' if len(places) == 1 else 's'}, {survey.name}."
    try:
        found = bundle(observations, led_map, nominal.camera, led_sigma=led_error, notes=made)
    except UndeterminedError as error:
        # what it advises in Python's terms
        console.print(
            f"linetrack: nothing is written: {error} What is known is said by --place-error, "
            "--heading-error and --led-error; best are more places.",
            style="red",
            markup=False,
        )
        return FAILED
    except (ValueError, RuntimeError) as error:
        console.print(
            f"linetrack: nothing is written: {error} (Observations are the survey's recordings, in "
            "their order; lengths in mm, angles in rad.)",
            style="red",
            markup=False,
        )
        return FAILED
    found.save(output)
    seen = {channel for observation in observations for channel in observation.channels}
    for channel in sorted(set(led_map.channels) - seen):
        console.print(f"LED {channel} was never seen: its place is the map's", style="yellow")
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
    off = off[[found.sigma(f"LED {n} x") > 0 for n in found.leds.channels]]
    if len(off):
        lines.append(
            f"  LEDs are off the map by {np.median(off):.1f} mm (median), {off.max():.1f} (most)"
        )
    for line in [*lines, found.notes]:
        console.print(line, markup=False)


def _drawn(found: Calibration, nominal: Calibration) -> list[str]:
    """The drawing's numbers; its model may have fewer terms."""
    known = dict(zip(nominal.camera.names, nominal.camera.parameters, strict=True))
    return [f"{known.get(name, 0.0):.6g}" for name in found.camera.names]
