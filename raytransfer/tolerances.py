"""What becomes of a head when no part is exactly as drawn: tolerances, drawn at random, traced.

Every quantity is drawn from the uniform distribution between −limit and +limit around its nominal
value: makers reject what is outside, and little is known of how the rest is distributed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from concurrent.futures import as_completed
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from raytransfer import _checks as check
from raytransfer.irradiance import pixel_response
from raytransfer.lenses import Aperture, Lens, Plate, SphericalLens
from raytransfer.materials import D_LINE, ConstantIndex, Sellmeier
from raytransfer.sensors import TCD1304, LineSensor
from raytransfer.systems import MERIDIANS, NOMINAL, OpticalSystem, Placement

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from concurrent.futures import Executor, Future

    from numpy.typing import ArrayLike, NDArray

    from raytransfer.lenses import Element
    from raytransfer.materials import Material

    Metric = Callable[[OpticalSystem], float | Mapping[str, float]]


@dataclass(frozen=True)
class Tolerances:
    """Limits of what is made and mounted, each ±; 0 is exact.

    The defaults describe catalogue lenses in a mount from an FDM printer. *Assumption* marks what
    no data sheet says.

    Parameters
    ----------
    decentre : float
        Of every element but plates, along X and Y, mm. 0.15: a printed seat is good to 0.1 mm
        (assumption), and glass is up to 0.1 mm smaller than its catalogue size (Thorlabs), which
        lets it sit 0.05 mm aside.
    tilt : float
        Of every element about each axis that it is not symmetric about, rad. 0.005: a seat that is
        0.15 mm higher at one end of 30 mm than at the other (assumption).
    gap : float
        Air between two vertices, mm; what is behind moves along. 0.1 (assumption).
    radius : float
        Relative. 0.01: Thorlabs states focal lengths to ±1 %.
    thickness : float
        Of lenses and plates on the axis, mm; what is behind moves along. 0.1 (assumption, usual for
        catalogue lenses).
    index : float
        Refractive index, absolute; the dispersion stays. 0.0005: Schott's tolerance of n_d,
        step 3.
    opening : float
        Full width of screens, in each finite direction, mm. 0.1 (assumption: printed).
    temperature : float
        K around that for which the system is given, 20 °C; the same everywhere. 20 (assumption:
        outdoors in summer and winter).
    sensor_shift : float
        Sensor along X and Y, mm. 0.2 (assumption: a package in a socket on a printed seat).
    sensor_distance : float
        Sensor along Z, mm. 0.1 (assumption).
    sensor_tilt : float
        Sensor about X, Y and Z, rad. 0.005: 0.15 mm over the 29 mm of the line (assumption).
    glass_expansion : float
        Linear, 1/K; not a limit, but what temperature does. 7.1e-6: N-BK7 (Schott).
    index_change : float
        Refractive index in air, 1/K. 2.8e-6: N-BK7 at 0.63 µm, 20 to 40 °C, between 3.0e-6 at
        0.546 and 2.4e-6 at 1.06 µm (Schott).
    mount_expansion : float
        Linear, of gaps and of the distance to the sensor, 1/K. 7e-5 (assumption: PLA; other
        unfilled printing plastics have 6 to 10e-5).

    Raises
    ------
    ValueError
        If one is negative.
    """

    decentre: float = 0.15
    tilt: float = 0.005
    gap: float = 0.1
    radius: float = 0.01
    thickness: float = 0.1
    index: float = 0.0005
    opening: float = 0.1
    temperature: float = 20.0
    sensor_shift: float = 0.2
    sensor_distance: float = 0.1
    sensor_tilt: float = 0.005
    glass_expansion: float = 7.1e-6
    index_change: float = 2.8e-6
    mount_expansion: float = 7e-5

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name == "index_change":  # of some glasses it falls
                check.number(field.name, value, "1/K")
                continue
            check.not_negative(field.name, value, "a limit is given without its sign, ±")
        for name, most, mistake in (
            ("tilt", 0.5, "was it given in degrees?"),
            ("sensor_tilt", 0.5, "was it given in degrees?"),
            ("radius", 0.5, "it is relative: was it given in mm or percent?"),
        ):
            if getattr(self, name) > most:
                raise ValueError(
                    f"{name} = {getattr(self, name):g}: allowed is ≤ {most}; {mistake}"
                )


_COEFFICIENTS = ("glass_expansion", "index_change", "mount_expansion")

EXACT = replace(
    Tolerances(),
    **{field.name: 0.0 for field in fields(Tolerances) if field.name not in _COEFFICIENTS},
)
"""No tolerances: `replace` the one that is to be studied alone."""


class Parameter(NamedTuple):
    """One quantity that is drawn."""

    name: str
    unit: str
    limit: float


def parameters(system: OpticalSystem, tolerances: Tolerances) -> tuple[Parameter, ...]:
    """Return all that can deviate in a system, exact ones (limit 0) included.

    Elements are numbered from 1: ``"2 LJ1430L1 tilt z"``, ``"gap 1-2"``,
    ``"sensor decentre x"``.
    """
    limit = tolerances
    found: list[Parameter] = []
    for label, element in _labelled(system):
        own = [
            *((f"decentre {axis}", "mm", limit.decentre) for axis in _sideways(element)),
            *((f"tilt {axis}", "rad", limit.tilt) for axis in _turns(element)),
            *((side, "relative", limit.radius) for side in _radii(element)),
        ]
        if isinstance(element, Aperture):
            finite = (axis for axis in MERIDIANS if math.isfinite(element.aperture(axis)))
            own += [(f"opening {axis}", "mm", limit.opening) for axis in finite]
        else:
            own += [("thickness", "mm", limit.thickness), ("index", "", limit.index)]
        found += [Parameter(f"{label} {name}", unit, most) for name, unit, most in own]
    found += [
        Parameter(f"gap {number}-{number + 1}", "mm", limit.gap)
        for number in range(1, len(system.elements))
    ]
    if system.sensor_distance is not None:
        found += [Parameter(f"sensor decentre {axis}", "mm", limit.sensor_shift) for axis in "xy"]
        found.append(Parameter("sensor z", "mm", limit.sensor_distance))
        found += [Parameter(f"sensor tilt {axis}", "rad", limit.sensor_tilt) for axis in "xyz"]
    return (*found, Parameter("temperature", "K", limit.temperature))


def draw(
    system: OpticalSystem, tolerances: Tolerances, generator: np.random.Generator
) -> dict[str, float]:
    """Draw every parameter with a limit.

    One number is taken per parameter, exact or not: with the same seed the other parameters keep
    their values when a tolerance is tightened or left out.
    """
    every = parameters(system, tolerances)
    numbers = generator.uniform(-1.0, 1.0, len(every))
    return {
        parameter.name: float(number) * parameter.limit
        for parameter, number in zip(every, numbers, strict=True)
        if parameter.limit > 0
    }


def perturb(
    system: OpticalSystem,
    tolerances: Tolerances,
    drawn: np.random.Generator | Mapping[str, float],
) -> OpticalSystem:
    """Return the system as made: a new one, with every drawn deviation.

    A gap that would make two elements overlap is stopped where they touch, to 1 µm: they are put
    together by hand, and glass does not give way. A sensor does not come before the last vertex.
    Temperature stretches radii and thicknesses of glass with `glass_expansion`, gaps and the
    distance to the sensor with `mount_expansion`, and changes indices; openings and decentres it
    leaves alone. Placements that the system has already are added to, angle by angle.

    Parameters
    ----------
    system : OpticalSystem
    tolerances : Tolerances
        For a mapping, only its coefficients of temperature are used.
    drawn : numpy.random.Generator or mapping of str to float
        Deviations by the names of `parameters`; those left out are 0.

    Raises
    ------
    ValueError
        If a name is none, or an element cannot be made so (an edge without thickness).
    """
    if isinstance(drawn, np.random.Generator):
        drawn = draw(system, tolerances, drawn)
    names = [parameter.name for parameter in parameters(system, tolerances)]
    if unknown := sorted(set(drawn) - set(names)):
        raise ValueError(f"drawn {', '.join(unknown)}: known are {', '.join(names)}")
    deviation = {name: check.number(name, drawn.get(name, 0.0)) for name in names}
    warmer = deviation["temperature"]
    mount = 1 + tolerances.mount_expansion * warmer
    elements, placements = [], []
    before = system.placements or (NOMINAL,) * len(system.elements)
    for (label, element), placement in zip(_labelled(system), before, strict=True):
        own = partial(_of, deviation, label)
        elements.append(_made(element, own, tolerances, warmer))
        placements.append(_moved(placement, own))
    gaps = [
        (gap + deviation[f"gap {number}-{number + 1}"]) * mount
        for number, gap in enumerate(system.gaps, start=1)
    ]
    distance = system.sensor_distance
    if distance is not None:
        distance = max((distance + deviation["sensor z"]) * mount, 0.0)
    off = any(placement != NOMINAL for placement in placements)
    made = partial(
        replace,
        system,
        elements=tuple(elements),
        sensor_distance=distance,
        placements=tuple(placements) if off or system.placements else (),
        sensor_placement=_moved(system.sensor_placement, partial(_of, deviation, "sensor")),
    )
    try:
        return made(gaps=tuple(gaps))
    except ValueError:
        closed = [
            _contact((elements[i], elements[i + 1]), (placements[i], placements[i + 1]), gap)
            for i, gap in enumerate(gaps)
        ]
        return made(gaps=tuple(closed))


def _labelled(system: OpticalSystem) -> list[tuple[str, Element]]:
    return [(f"{i} {element.part}", element) for i, element in enumerate(system.elements, start=1)]


def _of(deviation: Mapping[str, float], label: str, name: str) -> float:
    return deviation.get(f"{label} {name}", 0.0)


def _sideways(element: Element) -> str:
    return "" if isinstance(element, Plate) else "xy"


def _turns(element: Element) -> str:
    """Return the axes about which a turn is seen in the light."""
    match element:
        case Lens():
            return "xyz"
        case Aperture():
            return "z"
    return "xy"


def _radii(element: Element) -> tuple[str, ...]:
    match element:
        case Lens():
            return ("radius",)
        case SphericalLens():
            sides = ("front_radius", "back_radius")
            return tuple(s.replace("_", " ") for s in sides if math.isfinite(getattr(element, s)))
    return ()


def _moved(place: Placement, own: Callable[[str], float]) -> Placement:
    x, y = place.decentre
    a, b, c = place.tilt
    return Placement(
        (x + own("decentre x"), y + own("decentre y")),
        (a + own("tilt x"), b + own("tilt y"), c + own("tilt z")),
    )


def _made(
    element: Element, own: Callable[[str], float], tolerances: Tolerances, warmer: float
) -> Element:
    """Return an element with its deviations of shape and glass."""
    if isinstance(element, Aperture):
        return replace(element, x=element.x + own("opening x"), y=element.y + own("opening y"))
    grown = 1 + tolerances.glass_expansion * warmer
    change = own("index") + tolerances.index_change * warmer
    material = _shifted(element.material, change)
    thickness = (element.thickness + own("thickness")) * grown
    if isinstance(element, Plate):
        return replace(element, thickness=thickness, material=material)
    radii = {
        side.replace(" ", "_"): getattr(element, side.replace(" ", "_")) * (1 + own(side)) * grown
        for side in _radii(element)
    }
    return replace(element, centre_thickness=thickness, material=material, **radii)


def _shifted(material: Material, change: float) -> Material:
    """Return a glass of another melt: its index at the d line changed, its dispersion kept."""
    if change == 0:
        return material
    if isinstance(material, ConstantIndex):
        return replace(material, n=material.n + change)
    n = material.index(D_LINE)
    # a term with C = 0 is a constant in n²
    constant = (n + change) ** 2 - n**2
    return Sellmeier(material.name, (*material.B, constant), (*material.C, 0.0), material.valid)


def _contact(
    elements: tuple[Element, Element], placements: tuple[Placement, Placement], gap: float
) -> float:
    """Return the gap, or the smallest one without overlap."""

    def fits(gap: float) -> bool:
        try:
            OpticalSystem("", elements, (gap,), placements=placements)
        except ValueError:
            return False
        return True

    overlaps = max(gap, 0.0)
    if fits(overlaps):
        return overlaps
    apart = 0.01
    while not fits(overlaps + apart):
        overlaps, apart = overlaps + apart, 2 * apart
        if apart > 100:
            return gap  # something else is wrong with it: refused when the system is made
    while apart > 1e-3:
        apart /= 2
        if not fits(overlaps + apart):
            overlaps += apart
    return overlaps + apart


PIECES = 40
"""Into so many an executor's work is divided: what is lost of a study that stops is in pieces."""

FINE = 8
"""Parts of a pixel in which light is collected to find a spike's median and width."""


class Failure(NamedTuple):
    """A sample whose system or metric could not be computed."""

    number: int
    drawn: dict[str, float]
    error: str


class Sensitivities(NamedTuple):
    """What one value hangs on.

    Attributes
    ----------
    names : tuple of str
        Parameters, the strongest first.
    coefficients : ndarray, shape (P,)
        Standardised: standard deviations of the value per standard deviation of the parameter.
        With independent parameters their squares are the shares of the variance.
    explained : float
        Share of the value's variance that a linear function of the parameters explains, adjusted
        for their number; NaN if the value does not vary. Far below 1 the value is not linear, and
        the ranking says little.
    """

    names: tuple[str, ...]
    coefficients: NDArray[np.float64]
    explained: float


@dataclass(frozen=True)
class ToleranceStudy:
    """Samples of a head as made.

    Attributes
    ----------
    parameters : tuple of Parameter
        What was drawn.
    metrics : tuple of str
        Names of the values.
    nominal : ndarray, shape (M,)
        Of the system as drawn.
    numbers : ndarray of int, shape (S,)
        Of the samples, in rising order.
    drawn : ndarray, shape (S, P)
    values : ndarray, shape (S, M)
    failures : tuple of Failure
        Samples without a value; they are not among the S.
    seed : int
    """

    parameters: tuple[Parameter, ...]
    metrics: tuple[str, ...]
    nominal: NDArray[np.float64]
    numbers: NDArray[np.int64]
    drawn: NDArray[np.float64]
    values: NDArray[np.float64]
    failures: tuple[Failure, ...]
    seed: int

    def of(self, metric: str) -> NDArray[np.float64]:
        """Values of one metric, shape (S,)."""
        return np.asarray(self.values[:, self._column(metric)])

    def change(self, metric: str) -> NDArray[np.float64]:
        """Values of one metric minus the nominal one, shape (S,)."""
        return np.asarray(self.of(metric) - self.nominal[self._column(metric)])

    def percentiles(self, q: ArrayLike = (5, 50, 95)) -> NDArray[np.float64]:
        """Percentiles of all values, shape (len(q), M)."""
        if not len(self.values):
            raise ValueError(f"no sample has a value; the first failure: {self.failures[:1]}")
        return np.asarray(np.percentile(self.values, np.asarray(q, dtype=float), axis=0))

    def sensitivities(self, metric: str) -> Sensitivities:
        """Regress one value on what was drawn.

        Raises
        ------
        ValueError
            If there are too few samples, or no such value.
        """
        value = self.of(metric)
        count, width = self.drawn.shape
        if count < width + 2:
            raise ValueError(
                f"{count} samples cannot tell {width} parameters apart: at least {width + 2} are "
                f"needed, {5 * width} are better"
            )
        names = [parameter.name for parameter in self.parameters]
        spread = value.std()
        if spread <= 1e-12 * np.abs(value).max():
            return Sensitivities(tuple(names), np.zeros(width), np.nan)
        centred = self.drawn - self.drawn.mean(axis=0)
        scaled = centred / centred.std(axis=0)
        target = (value - value.mean()) / spread
        coefficients = np.linalg.lstsq(scaled, target)[0]
        unexplained = np.mean((target - scaled @ coefficients) ** 2)
        adjusted = 1 - unexplained * (count - 1) / (count - width - 1)
        order = np.argsort(-np.abs(coefficients), kind="stable")
        return Sensitivities(tuple(names[i] for i in order), coefficients[order], float(adjusted))

    def table(self) -> str:
        """Return nominal values, percentiles and each value's three strongest parameters."""
        failed = f", {len(self.failures)} failed" if self.failures else ""
        lines = [f"{len(self.values)} samples{failed}, seed {self.seed}", ""]
        width = max(map(len, self.metrics))
        lines.append(f"{'':{width}}    nominal        5 %       50 %       95 %")
        rows = np.vstack([self.nominal, self.percentiles()]).T
        rows[np.abs(rows) < 1e-9 * np.abs(rows).max(axis=1, keepdims=True)] = (
            0.0  # but for rounding
        )
        for metric, row in zip(self.metrics, rows, strict=True):
            lines.append(f"{metric:{width}} " + " ".join(f"{value:10.4g}" for value in row))
        if len(self.values) < len(self.parameters) + 2:
            return "\n".join(lines)
        lines += ["", f"{'':{width}}  linear    hangs on (standardised coefficient)"]
        for metric in self.metrics:
            names, coefficients, explained = self.sensitivities(metric)
            if np.isnan(explained):
                lines.append(f"{metric:{width}}      –     nothing: it does not vary")
                continue
            strongest = zip(names[:3], coefficients[:3], strict=True)
            text = ", ".join(f"{name} {value:+.2f}" for name, value in strongest)
            lines.append(f"{metric:{width}} {explained:6.0%}     {text}")
        return "\n".join(lines)

    def _column(self, metric: str) -> int:
        if metric not in self.metrics:
            raise ValueError(f"metric {metric!r}: known are {', '.join(self.metrics)}")
        return self.metrics.index(metric)


class Interrupted(KeyboardInterrupt):
    """A study that was stopped by Ctrl-C; `study` has the samples that were done."""

    def __init__(self, study: ToleranceStudy) -> None:
        super().__init__(f"{len(study.values)} samples were done; they are in .study")
        self.study = study

    def __reduce__(self) -> tuple[type[Interrupted], tuple[ToleranceStudy]]:
        """Pickle what it was made of: a study may itself run in another process."""
        return Interrupted, (self.study,)


class ExecutorError(RuntimeError):
    """A study whose executor failed; `study` has the samples that were done."""

    def __init__(self, study: ToleranceStudy, reason: str) -> None:
        super().__init__(
            f"{reason} ({len(study.values)} samples were done; they are in .study). Processes need "
            "a metric that pickle can find by its name, and are spawned, not forked: a fork of a "
            "process that has traced rays cannot trace"
        )
        self.study, self.reason = study, reason

    def __reduce__(self) -> tuple[type[ExecutorError], tuple[ToleranceStudy, str]]:
        """Pickle what it was made of."""
        return ExecutorError, (self.study, self.reason)


class _Sample(NamedTuple):
    number: int
    drawn: dict[str, float]
    values: dict[str, float]
    error: str


def monte_carlo(
    system: OpticalSystem,
    metric: Metric,
    *,
    tolerances: Tolerances | None = None,
    samples: int = 200,
    seed: int = 0,
    executor: Executor | None = None,
) -> ToleranceStudy:
    """Make the system many times and look at each.

    Each sample has a seed of its own, so the result is the same whatever runs it, and the first
    samples of a longer study are those of a shorter one.

    Parameters
    ----------
    system : OpticalSystem
    metric : callable
        Takes an `OpticalSystem`, returns a number or a mapping of names to numbers: the same names
        each time. `TrackingMetrics` is one.
    tolerances : Tolerances, optional
        `Tolerances()` when left out.
    samples : int
    seed : int
    executor : concurrent.futures.Executor, optional
        What runs the samples, in `PIECES` pieces at most; in this thread when left out. Processes
        are the usual choice, and must be spawned:
        ``ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn"))``. Dask's
        ``Client.get_executor()`` is one, too. A ThreadPoolExecutor needs numba's threading layer
        omp or tbb (``numba.config.THREADING_LAYER``) where the metric traces rays: the layer
        workqueue is not thread-safe. The executor is not shut down.

    Raises
    ------
    Exception
        Whatever `metric` raises on the system as it is. What it raises on a sample does not end
        the study: see `ToleranceStudy.failures`.
    Interrupted
        On Ctrl-C.
    ExecutorError
        If the executor fails.
    """
    tolerances = Tolerances() if tolerances is None else tolerances
    nominal = _named(metric(system))
    numbered = list(enumerate(np.random.SeedSequence(seed).spawn(check.whole("samples", samples))))
    run = partial(_run, system, metric, tolerances, tuple(nominal))
    study = partial(_study, system, tolerances, nominal, seed)
    done: list[_Sample] = []
    pending: list[Future[list[_Sample]]] = []
    try:
        if executor is None:
            for sample in numbered:
                done += run([sample])
        else:
            size = -(-samples // PIECES)
            pieces = (numbered[start : start + size] for start in range(0, samples, size))
            pending.extend(executor.submit(run, piece) for piece in pieces)
            for future in as_completed(pending):
                future.result()
    except KeyboardInterrupt as stop:
        raise Interrupted(study(done + _finished(pending))) from stop
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        raise ExecutorError(study(done + _finished(pending)), reason) from error
    return study(done + _finished(pending))


def _finished(futures: Sequence[Future[list[_Sample]]]) -> list[_Sample]:
    """Return what futures have, and cancel the others."""
    for future in futures:
        future.cancel()
    having = (f for f in futures if f.done() and not f.cancelled() and f.exception() is None)
    return [sample for future in having for sample in future.result()]


def _run(
    system: OpticalSystem,
    metric: Metric,
    tolerances: Tolerances,
    names: tuple[str, ...],
    numbered: Sequence[tuple[int, np.random.SeedSequence]],
) -> list[_Sample]:
    result = []
    for number, seed in numbered:
        drawn = draw(system, tolerances, np.random.default_rng(seed))
        try:
            values = _named(metric(perturb(system, tolerances, drawn)))
            if set(values) != set(names):
                raise ValueError(f"the metric gave {', '.join(values)}, before {', '.join(names)}")
            sample = _Sample(number, drawn, values, "")
        except Exception as error:  # noqa: BLE001  # whatever it is, it belongs to this sample
            sample = _Sample(number, drawn, {}, f"{type(error).__name__}: {error}")
        result.append(sample)
    return result


def _named(values: float | Mapping[str, float]) -> dict[str, float]:
    """Return a metric's values by name, or refuse them."""
    named = values if isinstance(values, Mapping) else {"value": values}
    return {name: check.number(f"metric {name}", value) for name, value in named.items()}


def _study(
    system: OpticalSystem,
    tolerances: Tolerances,
    nominal: dict[str, float],
    seed: int,
    samples: list[_Sample],
) -> ToleranceStudy:
    drawn = tuple(p for p in parameters(system, tolerances) if p.limit > 0)
    samples = sorted(samples)
    good = [sample for sample in samples if not sample.error]
    return ToleranceStudy(
        drawn,
        tuple(nominal),
        np.array(list(nominal.values())),
        np.array([sample.number for sample in good], dtype=np.int64),
        np.array([[s.drawn[p.name] for p in drawn] for s in good]).reshape(len(good), len(drawn)),
        np.array([[s.values[m] for m in nominal] for s in good]).reshape(len(good), len(nominal)),
        tuple(Failure(s.number, s.drawn, s.error) for s in samples if s.error),
        seed,
    )


@dataclass(frozen=True)
class TrackingMetrics:
    """What a tracker notices of a head: where it sees LEDs, how sharp and how bright.

    Five point LEDs are traced: straight ahead, to both sides, above and below. Only the light that
    falls on the pixel line counts.

    Called with a system it returns

    * ``offset``: position of the LED straight ahead, px from the middle of the line. Calibration
      removes it.
    * ``scale``: px per mm of LED, from the two at the sides. Calibration removes it.
    * ``bend``: how far the LED straight ahead stands beside the middle of those two, px. Removing
      it takes a calibration with more than two numbers.
    * ``height``: half the way that the image goes along the line when an LED moves from below to
      above, px: neither offset nor scale remove that.
    * ``width``: the largest of those straight ahead and at the sides, px.
    * ``light``: of the LED straight ahead, mm².

    Positions, widths and light are those of `spike`.

    Parameters
    ----------
    distance : float
        Of the LEDs before the first vertex, mm.
    side, up : float
        Of those off the axis, mm.
    wavelength : float
        µm.
    sensor : LineSensor
    rays : tuple of int
        Columns and rows of rays over the opening, as for `irradiance.pixel_response`.
    """

    distance: float = 2500.0
    side: float = 500.0
    up: float = 500.0
    wavelength: float = 0.63
    sensor: LineSensor = TCD1304
    rays: tuple[int, int] = (256, 48)

    def __call__(self, system: OpticalSystem) -> dict[str, float]:
        """Trace the five LEDs; `ValueError` if one leaves no light on the line."""
        places = (0.0, 0.0), (-self.side, 0.0), (self.side, 0.0), (0.0, -self.up), (0.0, self.up)
        ahead, left, right, low, high = (
            spike(
                system,
                (x, y, self.distance),
                self.sensor,
                wavelength=self.wavelength,
                rays=self.rays,
            )
            for x, y in places
        )
        return {
            "offset": ahead.median,
            "scale": (right.median - left.median) / (2 * self.side),
            "bend": ahead.median - (left.median + right.median) / 2,
            "height": (high.median - low.median) / 2,
            "width": max(ahead.width, left.width, right.width),
            "light": ahead.light,
        }


class Spike(NamedTuple):
    """Light of one LED on the pixel line.

    Attributes
    ----------
    median : float
        Half of the light lies on either side of it; px from the middle of the line.
    width : float
        Of the shortest part of the line that holds 80 % of the light, px.
    light : float
        Area of the opening that all goes to the line, mm²: solid angle times squared distance.
    """

    median: float
    width: float
    light: float


def spike(
    system: OpticalSystem,
    position: tuple[float, float, float],
    sensor: LineSensor = TCD1304,
    *,
    wavelength: float = 0.63,
    rays: tuple[int, int] = (256, 48),
) -> Spike:
    """Trace one point LED; parameters as for `irradiance.pixel_response`.

    Light is collected on eighths of pixels, so that where the pixels lie does not matter. With the
    default rays, the median is good to about 1/1000 of the width.

    Raises
    ------
    ValueError
        If none of its light falls on the pixels.
    """
    # one thread: it is the studies that run in parallel
    fine = replace(sensor, pixels=sensor.pixels * FINE, pitch=sensor.pitch / FINE)
    light = pixel_response(system, position, fine, wavelength=wavelength, rays=rays, threads=1)
    if not light.any():
        raise ValueError(
            f"{system.name}: no light of an LED at X, Y, distance = {position} mm falls on the "
            "pixels"
        )
    below = np.concatenate([[0.0], np.cumsum(light)])
    below /= below[-1]
    edges = (np.arange(len(below)) - len(light) / 2) / FINE
    begin = np.linspace(0.0, 0.2, 401)
    widths = np.interp(begin + 0.8, below, edges) - np.interp(begin, below, edges)
    return Spike(
        float(np.interp(0.5, below, edges)),
        float(widths.min()),
        float(light.sum()) * position[2] ** 2,
    )
