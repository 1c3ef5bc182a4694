"""The prototype without hardware as a link: the firmware image, the sensor and a room, in one."""

from __future__ import annotations

import tomllib
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from acquisition.frames import CHANNELS, MASTER_CLOCK
from acquisition.links import LinkError, LinkUnavailable
from acquisition.protocol import ICG_MIN
from acquisition.wiring import PROTOCOL, sh_edge
from raytransfer.designs import DESIGNS, Design, design_text, load_design
from twin.machine import CLOCK, Machine
from twin.rooms import FORMAT as ROOM
from twin.rooms import ROOMS, KnownLeds, load_room
from twin.sensor import Electronics, SensorModel
from twin.world import World

if TYPE_CHECKING:
    from numpy.typing import NDArray

SPI_CLOCK = 15_625_000
"""What a Raspberry Pi makes of "16 MHz": 250 MHz / 16, Hz."""

BOOT = 0.01
"""Virtual seconds between power-on and the first call: real hosts come much later."""

LIGHT_STEP = 50e-6
"""Virtual seconds for which light counts as constant: 50 nm of way at 1 m/s."""

IMAGE = "F401_FW_TCD1304.elf"

_CYCLES = CLOCK // MASTER_CLOCK
_SETTLED = 50 * CLOCK // 1_000_000  # cycles until the interrupt of an exposure's end is over


def firmware_image() -> Path:
    """Path of the firmware's ELF: in an installed wheel, or built in a source tree.

    Raises
    ------
    FileNotFoundError
        If it has not been built.
    """
    package = Path(str(files("twin")))
    for path in (package / IMAGE, package.parent / "firmware" / "build" / IMAGE):
        if path.is_file():
            return path
    raise FileNotFoundError(f"{IMAGE} is not built: run `make setup` in the project's folder")


class TwinLink:
    """A `Link` to the twin. Its time is virtual: nothing waits, nothing depends on the machine.

    Parameters
    ----------
    world : World, optional
        Two LEDs, a tracker at 1300 mm, a dark room when left out.
    seed : int
        Of the sensor's pattern and noise.
    spi_clock : float
        Hz.
    host_latency : float
        Virtual seconds from the handshake (or the end of a transfer) to the first clock.
    image : Path, optional
        Another firmware ELF.
    electronics : Electronics, optional
        Of the sensor and the ADC.
    record : bool
        Keep the edges of all pins, see `Machine`.
    known_leds : KnownLeds, optional
        What a tracker is told of the LEDs: where the plan has them. Where the world has them when
        left out.

    Attributes
    ----------
    world, sensor, machine
        The room, the specimen of the sensor, the microcontroller.
    known_leds : KnownLeds
    """

    def __init__(
        self,
        world: World | None = None,
        *,
        seed: int = 1304,
        spi_clock: float = SPI_CLOCK,
        host_latency: float = 1e-4,
        image: Path | None = None,
        electronics: Electronics | None = None,
        record: bool = False,
        known_leds: KnownLeds | None = None,
    ) -> None:
        if not 0 < spi_clock <= 42e6:
            raise ValueError(f"spi_clock = {spi_clock:g} Hz: allowed is > 0 to 42e6; in MHz?")
        if not 0 <= host_latency < 10:
            raise ValueError(f"host_latency = {host_latency:g} s: allowed is 0 to 10; in ms?")
        self.world = World() if world is None else world
        self.sensor = SensorModel(seed, electronics, self.world.sensor)
        self.known_leds = KnownLeds.of(self.world.leds) if known_leds is None else known_leds
        self.spi_clock = spi_clock
        self.host_latency = host_latency
        self._rates = np.zeros((1 + CHANNELS, self.world.sensor.pixels))
        self._step = self._step_end = self._known = 0
        self._rates[0] = self.world.ambient_rate() * self.sensor.response
        self._rates[0] += self.sensor.dark_rates()
        self._light(0, lit=(1 << CHANNELS) - 1)
        figures = self.sensor.electronics
        self.machine = Machine(
            firmware_image() if image is None else image,
            rates=self._rates,
            full_well=figures.full_well / figures.transfer_fraction,
            transfer_fraction=figures.transfer_fraction,
            digitise=self._digitise,
            light=self._light if self.world.changing else None,
            idle_code=int(figures.code(np.array(figures.dark_voltage))),
            record=record,
        )
        self.machine.run(BOOT)
        self._open = True

    def _light(self, cycles: int, lit: int) -> bool:
        """Electrons per second: after what is always there, a row for each LED channel.

        Of those lit, by bit: light of an LED that is not would be computed in vain.
        """
        if cycles >= self._step_end:
            self._step, self._step_end = cycles, cycles + round(LIGHT_STEP * CLOCK)
            self._known = 0
        new = lit & ~self._known  # all LEDs of an exposure ask, one after the other
        if not new:
            return False
        self._known |= new
        channels = [channel for channel in range(CHANNELS) if new >> channel & 1]
        rates = dict(self.world.lit(self._step / CLOCK, channels))
        for channel in channels:
            rate = rates.get(channel)
            self._rates[1 + channel] = 0.0 if rate is None else rate * self.sensor.response
        return True

    def _digitise(self, charge: NDArray[np.float64], _: int) -> NDArray[np.uint16]:
        # with an SH pulse every so often, as much dark signal is gathered as is carried over
        integration = self.machine.readouts[-1]["integration"] / CLOCK
        codes, idle = self.sensor.digitise(charge, integration)
        return np.append(codes, np.uint16(idle))

    @property
    def lens_system(self) -> dict[str, object]:
        """The head in front of the sensor as its design file has it, for a session's metadata."""
        text = design_text(Design(self.world.head, self.world.sensor))
        return {"name": self.world.head.name, "description": tomllib.loads(text)}

    @property
    def clock_offset(self) -> float:
        """World time of the device's time 0, s: a frame's ``timestamp`` (ns) is that much later.

        The device counts master clocks from when it has booted. As of the newest read-out, exact to
        the cycle: each time that a command sets other periods, its clock stands still for less than
        a master clock.

        Raises
        ------
        LinkError
            If there was no read-out for longer than an ICG period, since the device waits for the
            sync line, or it runs another firmware.
        """
        self._check_open()
        try:
            edge, period = (
                int.from_bytes(self.machine.read(self.machine.symbol(name), size), "little")
                for name, size in (("edge_time", 8), ("icg_period", 4))
            )
        except KeyError as error:
            raise LinkError(f"this firmware does not tell its time: no {error}") from error
        ends = self.machine.readouts["transfer"].astype(np.int64)
        offsets = ends - (edge + sh_edge(PROTOCOL)) * _CYCLES
        since = self.machine.time - ends
        if not ends.size or since[-1] > period * _CYCLES + _SETTLED:
            raise LinkError("no read-out tells the device's time: does it wait for the sync line?")
        if since[-1] < _SETTLED:  # the interrupt may not have counted the newest one yet
            early = offsets[(offsets > 0) & (offsets < ICG_MIN * _CYCLES)]
            offsets = early if early.size else offsets
        return float(offsets[-1] / CLOCK)

    def wait_ready(self, timeout: float) -> bool:
        """Whether the handshake line is high now or within `timeout` virtual seconds."""
        self._check_open()
        ready = self.machine.wait_pin("PB2", level=True, timeout=timeout)
        if ready and self.host_latency:
            self.machine.run(self.host_latency)
        return ready

    def transfer(self, tx: bytes) -> bytes:
        """Clock bytes out and as many in."""
        self._check_open()
        return self.machine.transfer(tx, self.spi_clock)

    def sleep(self, seconds: float) -> None:
        """Let virtual time pass."""
        self._check_open()
        self.machine.run(seconds)

    def close(self) -> None:
        """Free the emulator; the link cannot be used afterwards."""
        self._open = False
        self.machine.close()

    def _check_open(self) -> None:
        if not self._open:
            raise LinkError("the link to the twin is closed")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def open_twin(argument: str | None = None, **options: Any) -> TwinLink:
    """Open the twin for ``--link twin``.

    Parameters
    ----------
    argument : str, optional
        A room or a lens head: a room file or the name of one of `ROOMS`; a design file or the name
        of one of `DESIGNS`. The thesis's head and room when left out.
    **options
        For `TwinLink`, without a world if there is an argument. A room's seed and plan of the LEDs
        hold if none is given.

    Raises
    ------
    LinkUnavailable
        If there is no such room or design, or something that the twin needs is missing.
    ValueError
        If the file is neither, or something in it is wrong.
    """
    if argument is not None:
        options = _described(argument) | options
    try:
        return TwinLink(**options)
    except (FileNotFoundError, ImportError) as error:
        raise LinkUnavailable(str(error)) from error


def _described(argument: str) -> dict[str, Any]:
    """Options that a room or a design, by name or file, stands for."""
    if argument not in DESIGNS and argument not in ROOMS and not Path(argument).is_file():
        raise LinkUnavailable(
            f"--link twin {argument}: neither a room file, one of the rooms {', '.join(ROOMS)}, "
            f"a design file nor one of the designs {', '.join(DESIGNS)}"
        )
    if argument in ROOMS or (argument not in DESIGNS and _says(Path(argument), ROOM)):
        room = load_room(argument)
        return {"world": room.world, "seed": room.seed, "known_leds": room.known_leds()}
    design = DESIGNS[argument] if argument in DESIGNS else load_design(argument)
    return {"world": World(head=design.system, sensor=design.sensor)}


def _says(path: Path, form: str) -> bool:
    """Whether a file says that it has a format; what cannot be read is left to its reader."""
    try:
        return bool(tomllib.loads(path.read_text(encoding="utf-8")).get("format") == form)
    except ValueError:
        return False
