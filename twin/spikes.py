"""Spikes without frames: what a spike finder would say, fast enough for hours of virtual time.

What light does is exact, and computed once: profiles of a head over angle and distance, on which a
spike finder has been run. Noise has the size that the Cramér–Rao bound gives it. On top comes what
a room does: LEDs out of view, too dim or too bright, people who stand between, shiny walls, frames
that get lost or late on the link.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from acquisition.frames import MASTER_CLOCK
from acquisition.protocol import check_periods
from raytransfer import TCD1304
from raytransfer import _checks as check
from raytransfer.irradiance import disc_image, photon_energy, pixel_response
from raytransfer.localisation import Noise, spike_bound
from tracking.spikes import Spike, SpikeFinder, SpikeFlags

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from raytransfer import LineSensor, OpticalSystem
    from twin.world import Led

DIFFUSION = 0.003
"""Standard deviation of the way that electrons wander in the silicon, mm."""

_FLAGS = tuple(SpikeFlags(n) for n in range(32))

FINE = 9
"""Parts of a pixel in which light is blurred by the LED's size; odd, so that one is its middle."""


class SpikeTable:
    """A head's spikes over angle and distance, from exact light.

    Parameters
    ----------
    system : OpticalSystem
        With a sensor_distance.
    sensor : LineSensor
    wavelength : float
        µm.
    extent : float
        Diameter of the LEDs, mm.
    background : float
        Electrons in a pixel from everything else.
    noise : Noise, optional
    finder : SpikeFinder, optional
        Says where a profile's spike is.
    field : float
        Largest angle from the axis, rad.
    angles : int
        Of the table.
    nearest, farthest : float
        Distances, mm.
    distances : int
        Of the table, evenly over 1/distance.
    rays : tuple of int
        As for `pixel_response`.
    """

    def __init__(
        self,
        system: OpticalSystem,
        sensor: LineSensor = TCD1304,
        *,
        wavelength: float = 0.63,
        extent: float = 2.0,
        background: float = 0.0,
        noise: Noise | None = None,
        finder: SpikeFinder | None = None,
        field: float = math.radians(28),
        angles: int = 97,
        nearest: float = 400.0,
        farthest: float = 12_000.0,
        distances: int = 9,
        rays: tuple[int, int] = (256, 48),
    ) -> None:
        if sensor.response is None:
            raise ValueError(f"{sensor.name}: its data file lacks the spectral response")
        if not 0 < nearest < farthest:
            raise ValueError(
                f"nearest = {nearest:g}, farthest = {farthest:g} mm: allowed is 0 < nearest < farthest"
            )
        check.whole("angles", angles)
        check.whole("distances", distances)
        self.noise = Noise() if noise is None else noise
        self.background = check.not_negative("background", background, "electrons")
        self.sensor = sensor
        finder = SpikeFinder() if finder is None else finder
        edge = math.tan(check.positive("field", field))
        self.tangents = np.linspace(-edge, edge, angles)
        self.nearness = np.linspace(1 / farthest, 1 / nearest, distances)
        efficiency = float(sensor.response.quantum_efficiency(wavelength))
        self.electrons_per_joule = efficiency / float(photon_energy(wavelength))
        focal_length = abs(system.effective_focal_length("x"))
        fields = np.full((5, angles, distances), np.nan)
        for j, near in enumerate(self.nearness.tolist()):
            distance = 1 / near
            blur = _blur(extent * focal_length / distance / sensor.pitch, DIFFUSION / sensor.pitch)
            for i, m in enumerate(self.tangents.tolist()):
                place = (-m * distance, 0.0, distance)
                light = pixel_response(system, place, sensor, wavelength=wavelength, rays=rays)
                light = np.convolve(light, blur, "same")
                peak = float(light.max())
                if peak > 0:
                    fields[:, i, j] = self._spike(light, peak, distance, finder)
        self.axes = np.array(
            [
                *(self.tangents[0], self.tangents[1] - self.tangents[0]),
                *(self.nearness[0], self.nearness[1] - self.nearness[0]),
            ]
        )
        self.fields = fields
        self._kernels = load_kernels()

    def _spike(
        self, light: NDArray[np.float64], peak: float, distance: float, finder: SpikeFinder
    ) -> tuple[float, ...]:
        """Position, ln width, ln light, and ln of a and b of σ² = a/height + b/height²."""
        high, low = 0.5 * self.noise.full_well, 500.0
        spike = finder.profile(light * (high / peak))
        if not spike.found:
            return (math.nan,) * 5
        at = int(light.argmax())
        near = slice(max(at - 250, 0), at + 251)
        shape = light[near] / peak
        squares = [
            spike_bound(shape * height, self.noise, background=self.background) ** 2
            for height in (high, low)
        ]
        # σ² h = a + b/h at both heights
        b = max((squares[1] * low - squares[0] * high) / (1 / low - 1 / high), 1e-12)
        a = max(squares[0] * high - b / high, 1e-12)
        width = max(spike.width, 1.0)
        return (
            spike.position,
            math.log(width),
            math.log(peak * distance**2),
            math.log(a),
            math.log(b),
        )

    def spike(self, tangent: float, distance: float) -> tuple[float, float, float]:
        """Position and width, px, and light of the brightest pixel, of a point of the table.

        Parameters
        ----------
        tangent : float
            −X / distance.
        distance : float
            Before the first vertex, mm.

        Returns
        -------
        position, width : float
            px; NaN where there is no spike.
        light : float
            Solid angle of the light in the brightest pixel, sr.
        """
        out = np.full(5, np.nan)
        if not self._kernels.look((self.axes, self.fields), tangent, 1 / distance, out):
            return math.nan, math.nan, 0.0
        position, width, light = out[:3].tolist()
        return position, math.exp(width), math.exp(light) / distance**2


def _blur(disc: float, sigma: float) -> NDArray[np.float64]:
    """Image of a disc of this diameter, px, spread by diffusion of this standard deviation, px."""
    reach = math.ceil(4 * sigma * FINE)
    spread = np.exp(-0.5 * (np.arange(-reach, reach + 1) / (sigma * FINE)) ** 2)
    image = np.convolve(disc_image(disc * FINE), spread / spread.sum())
    beside = (FINE - len(image)) // 2 % FINE  # parts that are missing of the outermost pixels
    return np.asarray(np.pad(image, beside).reshape(-1, FINE).sum(axis=1))


@dataclass(frozen=True)
class Faults:
    """What goes wrong, and how often. Of each kind one in each period `…_every`, in s; inf: never.

    Parameters
    ----------
    blocked_every, blocked : float
        One LED is hidden, on average for so long (exponentially distributed), s.
    dark_every, dark : float
        All LEDs are hidden, s.
    mirror_every, mirror : float
        An LED is reflected by something: a second spike, 5 to 90 % as high, 30 to 900 px away, s.
    longest : float
        Of all these, s.
    gross : float
        Probability of a spike that is 5 to 300 px off.
    lost, late, twice : float
        Probability of a frame to get lost, to come after some later ones, to come twice.
    burst_every, burst : float
        All frames get lost, s.
    """

    blocked_every: float = 20.0
    blocked: float = 0.8
    dark_every: float = 30.0
    dark: float = 0.5
    mirror_every: float = 60.0
    mirror: float = 1.0
    longest: float = 4.0
    gross: float = 2e-4
    lost: float = 2e-3
    late: float = 1e-3
    twice: float = 1e-3
    burst_every: float = 60.0
    burst: float = 0.05

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if name.endswith("every"):
                if not value > 0:
                    raise ValueError(f"{name} = {value}: allowed is > 0 s; inf is never")
            else:
                check.not_negative(name, value)
        for name in ("gross", "lost", "late", "twice"):
            if getattr(self, name) > 1:
                raise ValueError(f"{name} = {getattr(self, name)}: a probability is 1 at most")

    @classmethod
    def none(cls) -> Faults:
        """Nothing goes wrong."""
        never = dict.fromkeys(
            ("blocked_every", "dark_every", "mirror_every", "burst_every"), math.inf
        )
        return cls(**never, gross=0.0, lost=0.0, late=0.0, twice=0.0)


Path = Callable[[float], tuple[float, float, float]]
"""x, y in mm and heading in rad at a time in s."""


class Wander:
    """A random smooth path within a rectangle: sines of many frequencies, at any time at once.

    Parameters
    ----------
    seed : int
    area : tuple of float
        Lowest and highest x, lowest and highest y, mm.
    speed, turning : float
        Largest speed, mm/s, and rate of the heading, rad/s, in the first ten minutes.
    slow, fast : float
        Frequencies, Hz.
    """

    SINES = 10

    def __init__(
        self,
        seed: int,
        area: tuple[float, float, float, float],
        *,
        speed: float = 1000.0,
        turning: float = 1.0,
        slow: float = 0.02,
        fast: float = 0.6,
    ) -> None:
        low_x, high_x, low_y, high_y = area
        if not (low_x < high_x and low_y < high_y):
            raise ValueError(f"area = {area}: lowest and highest x, lowest and highest y, mm")
        check.positive("speed", speed, "mm/s")
        check.positive("turning", turning, "rad/s")
        if not 0 < slow < fast:
            raise ValueError(f"slow = {slow:g}, fast = {fast:g} Hz: allowed is 0 < slow < fast")
        random = np.random.default_rng(seed)
        self._middle = np.array([(low_x + high_x) / 2, (low_y + high_y) / 2, 0.0])
        steps = np.geomspace(slow, fast, self.SINES)
        rates = math.tau * steps * random.uniform(0.8, 1.25, (3, self.SINES))
        self._phases = random.uniform(0, math.tau, (3, self.SINES))
        self._phases[2, 0] += random.uniform(0, math.tau)
        # each frequency has its part in the speed, slow ones more
        sizes = random.normal(size=(3, self.SINES)) / rates**1.5
        reach = np.array([high_x - low_x, high_y - low_y]) / 2
        times = np.arange(0, 600, 0.02)

        def rate(axes: slice) -> float:
            angle = rates[axes, None] * times[:, None] + self._phases[axes, None]
            parts = np.einsum("ak,atk->at", (sizes * rates)[axes], np.cos(angle))
            return float(np.sqrt((parts**2).sum(axis=0)).max())

        sizes[:2] *= speed / rate(slice(0, 2))
        sizes[2] *= turning / rate(slice(2, 3))
        # where the area is left, the same speed in smaller and faster swings
        for axis in range(2):
            widest = np.abs(sizes[axis]).sum() / reach[axis]
            if widest > 1:
                sizes[axis] /= widest
                rates[axis] *= widest
        sizes[:2] *= min(speed / rate(slice(0, 2)), 1.0)
        self._sizes, self._rates = sizes, rates

    def __call__(self, seconds: float) -> tuple[float, float, float]:
        """x, y and heading."""
        x, y, heading = self.at(np.array([seconds]))[0].tolist()
        return x, y, heading

    def at(self, seconds: NDArray[np.float64]) -> NDArray[np.float64]:
        """x, y and heading at many times, shape (N, 3)."""
        angle = self._rates * seconds[:, None, None] + self._phases
        return np.asarray(self._middle + (self._sizes * np.sin(angle)).sum(axis=2))


class Reading(NamedTuple):
    """What arrives of a frame.

    Attributes
    ----------
    t_ns : int
        When its exposure ended.
    lit : dict of int to int
    spikes : dict of int to Spike
        By channel, one for each LED that was lit.
    """

    t_ns: int
    lit: Mapping[int, int]
    spikes: dict[int, Spike]


BLOCK = 4096
"""Frames whose poses are computed at once, and LEDs for which random numbers are drawn at once."""


class SpikeWorld:
    """LEDs, a moving tracker and a link, as a spike finder meets them.

    Parameters
    ----------
    leds : sequence of twin.world.Led
        All in the plane of the tracker. Their extent and wavelength are those of the table.
    table : SpikeTable
    path : Wander
    sh_period, icg_period : int
        As in `Command`, master clocks.
    faults : Faults, optional
    seed : int
    scale : float
        Error of the spikes' positions as a multiple of the Cramér–Rao bound.
    threshold : float
        Least height of a spike that is found, in standard deviations of the pixels' noise.
    master_clock : int
        Hz.
    """

    def __init__(
        self,
        leds: Sequence[Led],
        table: SpikeTable,
        path: Wander,
        *,
        sh_period: int,
        icg_period: int,
        faults: Faults | None = None,
        seed: int = 0,
        scale: float = 1.3,
        threshold: float = 8.0,
        master_clock: int = MASTER_CLOCK,
    ) -> None:
        check_periods(sh_period, icg_period)
        if any(led.position[2] for led in leds):
            raise ValueError("leds: all must be at z = 0, where the table was computed")
        self.leds = tuple(leds)
        self.table, self.path = table, path
        self.faults = Faults() if faults is None else faults
        self.period_ns = icg_period * 1_000_000_000 // master_clock
        self.sh_period, self._clock = sh_period, master_clock
        self._rows = {led.channel: row for row, led in enumerate(self.leds)}
        if len(self._rows) != len(self.leds):
            raise ValueError("leds: each channel may be used once")
        positions = np.array([led.position for led in self.leds])
        facings = np.array([led.facing for led in self.leds])
        normals = np.column_stack([-np.sin(facings), np.cos(facings)])
        powers = np.array([led.power for led in self.leds])
        rates = powers / math.pi * table.electrons_per_joule
        self._kernels = load_kernels()
        f = self.faults
        episodes = np.array(
            [
                *(f.blocked_every, f.blocked, f.dark_every, f.dark, f.longest),
                *(f.mirror_every, f.mirror),
            ]
        )
        noise = table.noise
        dark = float(np.sqrt(noise.variance(table.background)))
        self._least = threshold * dark
        full = noise.saturation - table.background
        full -= 3 * math.sqrt(float(noise.variance(noise.saturation)))
        self._noise = np.array([self._least, full, check.positive("scale", scale), f.gross])
        self._seed = check.whole("seed + 1", seed + 1)
        self._random = np.random.default_rng(seed)
        self._draws = np.empty((0, 5))
        self._drawn = 0
        self._late: list[tuple[int, Reading]] = []
        self._block = -1
        self._poses = np.empty((0, 3))
        self._last = float(table.sensor.pixels - 1)
        # what the kernels know of it, in their order
        self._room = (positions, normals, rates, (table.axes, table.fields), self._last, episodes)

    def time_ns(self, frame: int) -> int:
        """When a frame's exposure ends, ns."""
        return (frame + 1) * self.period_ns

    def pose(self, frame: int) -> NDArray[np.float64]:
        """True x, y and heading at a frame's `time_ns`."""
        block, row = divmod(frame, BLOCK)
        if block != self._block:
            frames = np.arange(block * BLOCK, (block + 1) * BLOCK)
            seconds = (frames + 1) * (self.period_ns * 1e-9)
            self._poses = self.path.at(np.asarray(seconds, np.float64))
            self._block = block
        return np.asarray(self._poses[row])

    def visible(self, frame: int) -> int:
        """How many LEDs would be found if they were lit for the whole integration."""
        count: int = self._kernels.visible(
            self._seed,
            self.time_ns(frame) * 1e-9,
            self.pose(frame),
            *self._room,
            self.sh_period / self._clock,
            self._least,
        )
        return count

    def expose(
        self,
        frame: int,
        lit: Mapping[int, int],
        windows: Mapping[int, tuple[int, int]] | None = None,
    ) -> dict[int, Spike]:
        """What a spike finder says of a frame.

        Parameters
        ----------
        frame : int
        lit : mapping of int to int
            Exposures in master clocks by channel.
        windows : mapping of int to (int, int), optional
            First and last pixel in which to look for each LED; the whole line when left out.

        Returns
        -------
        dict of int to Spike
            One for each LED lit: the strongest in its window, whoever's it is; without windows the
            strongest of the line, the second, and so on.
        """
        if not lit:
            return {}
        rows = np.array([self._rows[channel] for channel in lit], np.int64)
        seconds = np.array([clocks / self._clock for clocks in lit.values()])
        places = [] if windows is None else [windows[channel] for channel in lit]
        limits = np.array(places, float).reshape(-1, 2)
        out = np.empty((len(rows), 5))
        self._kernels.expose(
            self._seed,
            self._draw(len(rows)),
            self.time_ns(frame) * 1e-9,
            self.pose(frame),
            *self._room,
            self._noise,
            rows,
            seconds,
            limits,
            out,
        )
        return {
            channel: Spike(position, sigma, width, height, _FLAGS[int(flags)])
            for channel, (position, sigma, width, height, flags) in zip(
                lit, out.tolist(), strict=True
            )
        }

    def _draw(self, count: int) -> NDArray[np.float64]:
        """Two normal and three uniform random numbers for so many LEDs."""
        if self._drawn + count > len(self._draws):
            normal = self._random.standard_normal((BLOCK, 2))
            self._draws = np.hstack([normal, self._random.random((BLOCK, 3))])
            self._drawn = 0
        self._drawn += count
        return self._draws[self._drawn - count : self._drawn]

    def receive(
        self,
        frame: int,
        lit: Mapping[int, int],
        windows: Mapping[int, tuple[int, int]] | None = None,
    ) -> list[Reading]:
        """What arrives over the link when a frame has been read: mostly it, at times none or more.

        Parameters
        ----------
        frame, lit, windows
            As for `expose`.
        """
        faults, t_ns = self.faults, self.time_ns(frame)
        burst = self._kernels.episode(
            self._seed, -1, 3, t_ns * 1e-9, faults.burst_every, faults.burst, faults.longest
        )
        reading = Reading(t_ns, lit, self.expose(frame, lit, windows))
        chance = self._random.random()
        arrived = []
        if burst < 0 and chance >= faults.lost:
            chance -= faults.lost
            if chance < faults.late:
                self._late.append((frame + 1 + int(self._random.integers(3)), reading))
            else:
                arrived.append(reading)
                if chance < faults.late + faults.twice:
                    arrived.append(reading)
        if self._late:
            arrived += [late for due, late in self._late if due <= frame]
            self._late = [entry for entry in self._late if entry[0] > frame]
        return arrived


def load_kernels() -> Any:
    """Return `twin._spikes`, which takes numba to load."""
    from twin import _spikes

    return _spikes
