"""The microcontroller with sensor and lights attached, in virtual time.

`Machine` executes the machine code of an ELF for the STM32F401 and nothing else: no function of
the firmware is recognised or replaced, and only the CPU and DMA write its memory. Peripherals,
sensor and time are modelled in C (``twin/core``), the CPU is unicorn's. Equal inputs give equal
results, bit for bit.

Whatever the model does not know, and whatever real hardware or the sensor's datasheet would not
forgive, raises `MachineError`: an unclocked peripheral, a reserved bit, a null pointer, a write to
flash, a fault, a read-out with wrong timing.
"""

from __future__ import annotations

import ctypes
import functools
import importlib.util
import platform
import struct
import tomllib
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from typing import Self

    from numpy.typing import ArrayLike, NDArray

    #: (charge in electrons by pixel, cycles of the transfer) -> 3694 codes and the idle level's
    Digitise = Callable[[NDArray[np.float64], int], ArrayLike]
    #: (cycles, LEDs lit from then on, by bit) -> whether it has changed the rates
    Light = Callable[[int, int], bool]

__all__ = ["CLOCK", "Machine", "MachineError", "TimingViolation", "Violation"]

CLOCK = 84_000_000  # cycles per second, the unit of `Machine.time`
PIXELS = 3648
ELEMENTS = 3694
SOURCES = 65  # of light: the one always on, then LED channels 0 to 63
TICKS_PER_CYCLE = 4  # of the core's own unit of time
TICKS = CLOCK * TICKS_PER_CYCLE

_PINS = 128
_ROLES = ["none", "fM", "SH", "ICG", "OS", "adc_clock", "SCLK", "MISO", "MOSI"]
_ROLES += ["chain_clock", "chain_data", "chain_latch", "chain_enable"]
_ROLE_LED = len(_ROLES)
_SPECIAL = {"SCK": 0x100, "ADC": 0x101}
_UNICORN = (
    *("open", "close", "ctl", "mem_map_ptr", "mmio_map", "hook_add"),
    *("reg_read", "reg_write", "emu_start", "emu_stop", "strerror"),
)
_KINDS = ["fM", "t1", "t2", "t3", "t4", "SH/ICG", "integration", "cut", "fM changed"]

_DIGITISE = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_uint64, ctypes.c_void_p)
_LIGHT = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_uint64, ctypes.c_uint64)


class _Config(ctypes.Structure):
    """As ``struct config`` of the core."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in _UNICORN),
        ("role", ctypes.c_uint8 * _PINS),
        ("chain_first", ctypes.c_uint8),
        ("inverted", ctypes.c_uint8),
        ("record", ctypes.c_uint8),
        ("record_clocks", ctypes.c_uint8),
        ("singly", ctypes.c_uint8),
        ("idle_code", ctypes.c_uint16),
        ("rates", ctypes.c_void_p),
        ("transfer_fraction", ctypes.c_double),
        ("full_well", ctypes.c_double),
        ("digitise", _DIGITISE),
        ("light_moves", _LIGHT),
    )


_EDGE = np.dtype([("time", "u8"), ("pin", "u2"), ("level", "u1"), ("pad", "u1", 5)])
_EXCEPTION = np.dtype([("time", "u8"), ("number", "u2"), ("kind", "u1"), ("pad", "u1", 5)])
_VIOLATION = np.dtype([("time", "u8"), ("value", "f8"), ("kind", "u4"), ("pad", "u4")])
_READOUT = np.dtype(
    [
        *(("transfer", "u8"), ("start", "u8"), ("integration", "u8")),
        *(("lit", "u8", SOURCES), ("problems", "u4"), ("sampled", "u4")),
    ]
)


class MachineError(RuntimeError):
    """The firmware did something that hardware would not forgive or the model does not know."""


class TimingViolation(MachineError):  # noqa: N818 - what it is called where it is measured
    """A read-out that the firmware sampled broke a limit of the sensor's datasheet."""


class Violation(NamedTuple):
    """A limit of the datasheet that was broken, in a read-out sampled or not.

    ``kind`` is one of fM, t1 to t4, SH/ICG, integration, cut, fM changed; ``time`` is in cycles;
    ``value`` what was measured, in seconds (hertz for fM).
    """

    kind: str
    time: int
    value: float


@functools.cache
def _load() -> tuple[ctypes.CDLL, ctypes.CDLL]:
    spec = importlib.util.find_spec("unicorn")
    if spec is None or not spec.submodule_search_locations:
        raise ImportError("the twin needs unicorn: pip install unicorn")
    folder = Path(next(iter(spec.submodule_search_locations))) / "lib"
    unicorn = ctypes.CDLL(str(folder / "libunicorn.so.2"))
    path = Path(__file__).parent / "core" / "build" / f"libtwin-{platform.machine()}.so"
    if not path.exists():
        raise ImportError(f"{path} is missing: run `make setup` in the project's folder")
    core = ctypes.CDLL(str(path))
    pointer, u8, u32, u64 = ctypes.c_void_p, ctypes.c_uint8, ctypes.c_uint32, ctypes.c_uint64
    signatures: dict[str, tuple[Any, list[Any]]] = {
        "twin_new": (pointer, [ctypes.POINTER(_Config)]),
        "twin_free": (None, [pointer]),
        "twin_load": (ctypes.c_bool, [pointer, u32, ctypes.c_char_p, u32]),
        "twin_reset": (None, [pointer]),
        "twin_run": (ctypes.c_int, [pointer, u64]),
        "twin_wait": (ctypes.c_int, [pointer, u8, u8, u64]),
        "twin_transfer": (ctypes.c_int, [pointer, ctypes.c_char_p, pointer, u64, u64]),
        "twin_drive": (None, [pointer, u8, ctypes.c_int]),
        "twin_time": (u64, [pointer]),
        "twin_message": (ctypes.c_char_p, [pointer]),
        "twin_failure": (ctypes.c_int, [pointer]),
        "twin_pin": (ctypes.c_int, [pointer, u8]),
        "twin_read": (ctypes.c_bool, [pointer, u32, pointer, u32]),
        "twin_register": (u32, [pointer, ctypes.c_int]),
        "twin_log_exceptions": (None, [pointer]),
        "twin_log": (pointer, [pointer, ctypes.c_int, ctypes.POINTER(u64)]),
        "twin_log_clear": (None, [pointer, ctypes.c_int]),
        "twin_readouts": (u64, [pointer, pointer]),
        "twin_underruns": (u64, [pointer]),
        "twin_rates_changed": (None, [pointer]),
        "twin_charge": (None, [pointer, pointer]),
        "twin_pin_at": (None, [pointer, u64, u8, u8]),
        "twin_sizes": (u64, [ctypes.c_int]),
    }
    for name, (result, arguments) in signatures.items():
        function = getattr(core, name)
        function.restype, function.argtypes = result, arguments
    sizes = [ctypes.sizeof(_Config)]
    sizes += [t.itemsize for t in (_EDGE, _EXCEPTION, _VIOLATION, _READOUT)]
    if [core.twin_sizes(i) for i in range(5)] != sizes:
        raise ImportError(f"{path} does not fit twin/machine.py: run `make setup`")
    return unicorn, core


def _number(pin: str) -> int:
    if len(pin) < 3 or pin[0] != "P" or pin[1] not in "ABCDEH" or not pin[2:].isdigit():
        raise ValueError(f"{pin!r} is no pin of the STM32F401: expected PA0 to PH15")
    if int(pin[2:]) > 15:
        raise ValueError(f"{pin!r} is no pin of the STM32F401: a port has 16 pins")
    return 16 * (ord(pin[1]) - ord("A")) + int(pin[2:])


def _wiring() -> dict[str, Any]:
    with resources.files("acquisition").joinpath("wiring.toml").open("rb") as file:
        return tomllib.load(file)


class _Elf:
    """Segments to load, at their physical addresses, and the symbols of a 32-bit ARM ELF."""

    def __init__(self, data: bytes) -> None:
        if data[:6] != b"\x7fELF\x01\x01" or struct.unpack_from("<H", data, 18)[0] != 40:
            raise ValueError("not a little-endian ELF for 32-bit ARM")
        program, sections = struct.unpack_from("<II", data, 28)
        size, count, section_size, section_count = struct.unpack_from("<4H", data, 42)
        self.segments: list[tuple[int, bytes]] = []
        for i in range(count):
            kind, offset, _, address, length = struct.unpack_from("<5I", data, program + i * size)
            if kind == 1 and length:
                self.segments.append((address, data[offset : offset + length]))
        headers = [
            struct.unpack_from("<10I", data, sections + i * section_size)
            for i in range(section_count)
        ]
        self.symbols: dict[str, int] = {}
        for header in headers:
            if header[1] != 2:  # SHT_SYMTAB
                continue
            names = headers[header[6]][4]
            for at in range(header[4], header[4] + header[5], 16):
                name, value, _, info = struct.unpack_from("<IIIB", data, at)
                text = data[names + name : data.index(b"\0", names + name)].decode()
                if text and info & 0xF in (0, 1, 2):  # no type, object, function
                    self.symbols.setdefault(text, value & ~1 if info & 0xF == 2 else value)


class Machine:
    """An STM32F401RE that runs an ELF, wired to the sensor, the lights and the link.

    Parameters
    ----------
    elf
        Path or content of the firmware; loaded at its physical addresses, vectors at 0x0800_0000.
    rates
        Electrons per second, (65, 3648): row 0 always (ambient light and dark current), row 1 + k
        while LED channel k is lit. Kept, not copied, if it is a C-contiguous float64 array;
        whoever changes it afterwards does so in `light` or calls `rates_changed`. None: dark.
    digitise
        Called at the first sample of a read-out with the mean charge transferred (electrons, 3648
        pixels) and the time of its transfer (cycles); returns 3694 codes and, last, the code of
        the idle output. None: the idle code everywhere.
    light
        Called, if the world moves, when an LED goes on and when a read-out starts, with the time
        in cycles and the channels that are lit from then on, by bit: row 0 and their rows are the
        ones that count until the next call. May change `rates` in place; returns whether it did.
    transfer_fraction
        Part of a pixel's charge that an SH pulse takes; the rest is image lag.
    full_well
        Electrons at which a pixel saturates.
    idle_code
        Code of the output before the first read-out.
    wiring
        As ``acquisition/wiring.toml``, which is the default.
    record
        Keep the edges of all output pins but clocks, see `edges`.
    record_clocks
        Keep those of fM and the ADC's clock too: millions.
    log_exceptions
        Keep entries and returns, see `exception_log`.
    singly
        Move every byte and sample in an event of its own: slower, the same results.

    Raises
    ------
    ImportError
        If unicorn or the compiled core is missing.
    ValueError
        If the ELF is none, does not fit the flash, or `rates` has another shape.
    """

    def __init__(
        self,
        elf: str | Path | bytes,
        *,
        rates: NDArray[np.float64] | None = None,
        digitise: Digitise | None = None,
        light: Light | None = None,
        transfer_fraction: float = 0.5,
        full_well: float = 60_000.0,
        idle_code: int = 3900,
        wiring: Mapping[str, Any] | None = None,
        record: bool = False,
        record_clocks: bool = False,
        log_exceptions: bool = False,
        singly: bool = False,
    ) -> None:
        self._machine: int | None = None
        unicorn, self._core = _load()
        content = elf if isinstance(elf, bytes) else Path(elf).read_bytes()
        self._elf = _Elf(content)
        self._exception: BaseException | None = None
        self._rates = np.zeros((SOURCES, PIXELS)) if rates is None else rates
        self._rates = np.ascontiguousarray(self._rates, dtype=np.float64)
        if self._rates.shape != (SOURCES, PIXELS):
            raise ValueError(f"rates: expected ({SOURCES}, {PIXELS}), got {self._rates.shape}")
        if not 0.0 < transfer_fraction <= 1.0:
            raise ValueError(f"transfer_fraction: expected 0 to 1, got {transfer_fraction}")
        self._digitise_python, self._light_python = digitise, light
        config = _Config()
        for name in _UNICORN:
            setattr(config, name, ctypes.cast(unicorn[f"uc_{name}"], ctypes.c_void_p))
        self._wire(config, _wiring() if wiring is None else wiring)
        config.record, config.record_clocks = record, record_clocks
        config.singly = singly
        config.idle_code = idle_code
        config.rates = self._rates.ctypes.data
        config.transfer_fraction, config.full_well = transfer_fraction, full_well
        if digitise is not None:
            config.digitise = _DIGITISE(self._digitise)
        if light is not None:
            config.light_moves = _LIGHT(self._light)
        self._config = config  # keeps the callbacks alive
        self._machine = self._core.twin_new(ctypes.byref(config))
        if not self._machine:
            raise MemoryError
        self._check()
        for address, segment in self._elf.segments:
            if not self._core.twin_load(self._machine, address, segment, len(segment)):
                raise ValueError(f"{len(segment)} bytes at 0x{address:08X} are outside the flash")
        if log_exceptions:
            self._core.twin_log_exceptions(self._machine)
        self._core.twin_reset(self._machine)
        self._check()

    @staticmethod
    def _wire(config: _Config, wiring: Mapping[str, Any]) -> None:
        pins = wiring["pins"]
        for name, pin in pins.items():
            if name in _ROLES:
                config.role[_number(pin["pin"])] = _ROLES.index(name)
        for channel, name in enumerate(wiring["leds"]["gpio"]):
            config.role[_number(pins[name]["pin"])] = _ROLE_LED + channel
        config.chain_first = wiring["leds"]["chain_first"]
        config.inverted = wiring["sensor"]["inverted"]

    def close(self) -> None:
        """Free the machine; it cannot be used afterwards. May be called twice."""
        if self._machine:
            self._core.twin_free(self._machine)
        self._machine = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __del__(self) -> None:
        self.close()

    # --- callbacks from the core: exceptions are kept and raised when it has returned ------------
    def _digitise(self, charge: int, time: int, codes: int) -> int:
        try:
            assert self._digitise_python is not None  # noqa: S101
            pixels = np.ctypeslib.as_array((ctypes.c_double * PIXELS).from_address(charge))
            out = np.ctypeslib.as_array((ctypes.c_uint16 * (ELEMENTS + 1)).from_address(codes))
            out[:] = self._digitise_python(pixels, time // TICKS_PER_CYCLE)
        except BaseException as error:  # noqa: BLE001 - raised by _check
            self._exception = error
            return 1
        return 0

    def _light(self, time: int, lit: int) -> int:
        try:
            assert self._light_python is not None  # noqa: S101
            return bool(self._light_python(time // TICKS_PER_CYCLE, lit))
        except BaseException as error:  # noqa: BLE001 - raised by _check
            self._exception = error
            return -1

    def _check(self) -> None:
        failure = self._core.twin_failure(self._machine)
        if not failure:
            return
        if failure == 3 and self._exception is not None:
            raise self._exception
        message = self._core.twin_message(self._machine).decode()
        raise TimingViolation(message) if failure == 2 else MachineError(message)

    # --- running ---------------------------------------------------------------------------------
    def run(self, seconds: float) -> None:
        """Let virtual time pass.

        Raises
        ------
        MachineError
            If the firmware fails; the machine then stays as it is and says so at every call.
        """
        self._core.twin_run(self._machine, round(seconds * TICKS))
        self._check()

    def wait_pin(self, pin: str, level: bool = True, timeout: float = 1.0) -> bool:
        """Run until a pin has a level (at once if it has), at most `timeout` virtual seconds.

        Raises
        ------
        MachineError
            If the firmware fails meanwhile.
        """
        result = self._core.twin_wait(self._machine, _number(pin), level, round(timeout * TICKS))
        self._check()
        return bool(result == 1)

    def transfer(self, tx: bytes, clock: float) -> bytes:
        """Clock bytes through the link at `clock` hertz, SPI mode 0; the firmware runs meanwhile.

        Returns what the machine shifted out: as many bytes; zeros where it does not listen.

        Raises
        ------
        MachineError
            If the firmware fails meanwhile.
        ValueError
            If the clock is not 1 Hz to 42 MHz.
        """
        if not 1 <= clock <= 42e6:
            raise ValueError(f"clock: expected 1 Hz to 42 MHz, got {clock}")
        rx = bytearray(len(tx))
        if tx:
            buffer = (ctypes.c_uint8 * len(tx)).from_buffer(rx)
            self._core.twin_transfer(self._machine, bytes(tx), buffer, len(tx), round(clock))
        self._check()
        return bytes(rx)

    def reset(self) -> None:
        """Reset the microcontroller; RAM, the sensor and time stay.

        Raises
        ------
        MachineError
            If it has failed before.
        """
        self._core.twin_reset(self._machine)
        self._check()

    def drive(self, pin: str, level: bool | None) -> None:
        """Hold a pin that the firmware reads at a level from outside; None lets it go."""
        self._core.twin_drive(self._machine, _number(pin), -1 if level is None else int(level))
        self._check()

    def rates_changed(self) -> None:
        """Tell that `rates` has been changed from outside; call between runs only."""
        self._core.twin_rates_changed(self._machine)

    # --- looking ---------------------------------------------------------------------------------
    @property
    def time(self) -> int:
        """Virtual time in cycles of 84 MHz since power-on."""
        return int(self._core.twin_time(self._machine)) // TICKS_PER_CYCLE

    @property
    def seconds(self) -> float:
        """Virtual time in seconds since power-on."""
        return float(self._core.twin_time(self._machine) / TICKS)

    def level(self, pin: str) -> bool:
        """Level of a pin now."""
        return bool(self._core.twin_pin(self._machine, _number(pin)))

    def symbol(self, name: str) -> int:
        """Address of a symbol of the ELF.

        Raises
        ------
        KeyError
            If it has none of that name.
        """
        return self._elf.symbols[name]

    def read(self, address: int, size: int) -> bytes:
        """Bytes of RAM or flash, for tests; nothing can be written.

        Raises
        ------
        ValueError
            If they are elsewhere.
        """
        buffer = (ctypes.c_uint8 * size)()
        if not self._core.twin_read(self._machine, address, buffer, size):
            raise ValueError(f"0x{address:08X}: neither RAM nor flash")
        return bytes(buffer)

    def _log(self, which: int, dtype: np.dtype[Any]) -> NDArray[Any]:
        count = ctypes.c_uint64()
        address = self._core.twin_log(self._machine, which, ctypes.byref(count))
        if not count.value:
            return np.empty(0, dtype)
        data = (ctypes.c_uint8 * (count.value * dtype.itemsize)).from_address(address)
        return np.frombuffer(bytes(data), dtype).copy()

    def edges(self, pin: str | None = None) -> NDArray[Any]:
        """Edges recorded so far, in order of time (``record=True``).

        Parameters
        ----------
        pin
            Of this pin only; "SCK" is the link's clock (level 1: it runs; gaps under 1 µs do not
            count), "ADC" its sampling switch (1: closed). None: all.

        Returns
        -------
        NDArray
            Structured: `time` (cycles), `pin` (number, 16 a port from PA0; 256 SCK, 257 ADC),
            `level`.
        """
        log = self._log(0, _EDGE)[["time", "pin", "level"]]
        if pin is not None:
            log = log[log["pin"] == (_SPECIAL[pin] if pin in _SPECIAL else _number(pin))]
        log = log[np.argsort(log["time"], kind="stable")]
        log["time"] //= TICKS_PER_CYCLE
        return log

    def clear_edges(self) -> None:
        """Forget the edges recorded so far."""
        self._core.twin_log_clear(self._machine, 0)

    @property
    def exception_log(self) -> NDArray[Any]:
        """What the NVIC did: `time` (cycles), `number`, `kind` (0 entry, 1 tail-chain, 2 return).

        Kept with ``log_exceptions=True``. Numbers as in IPSR: IRQ n is 16 + n.
        """
        log = self._log(1, _EXCEPTION)[["time", "number", "kind"]]
        log["time"] //= TICKS_PER_CYCLE
        return log

    @property
    def violations(self) -> list[Violation]:
        """Limits of the sensor's datasheet broken so far (the first 4096)."""
        return [
            Violation(
                _KINDS[int(v["kind"]).bit_length() - 1],
                int(v["time"]) // TICKS_PER_CYCLE,
                float(v["value"]),
            )
            for v in self._log(2, _VIOLATION)
        ]

    @property
    def readouts(self) -> NDArray[Any]:
        """The last 64 read-outs of the sensor, sampled by the firmware or not.

        Structured, times in cycles: `transfer` (SH falls), `start` (ICG rises), `integration`,
        `lit` (how long each of the 65 sources was on within it), `problems` (bits, in the order
        of `Violation.kind`), `sampled`.
        """
        out = np.zeros(64, _READOUT)
        count = self._core.twin_readouts(self._machine, out.ctypes.data)
        out = out[:count]
        for name in ("transfer", "start", "integration", "lit"):
            out[name] //= TICKS_PER_CYCLE
        return out

    @property
    def underruns(self) -> int:
        """Bytes that the host clocked while the slave had nothing new to say."""
        return int(self._core.twin_underruns(self._machine))

    @property
    def charge(self) -> NDArray[np.float64]:
        """Mean charge of every pixel now, in electrons: for tests."""
        out = np.empty(PIXELS)
        self._core.twin_charge(self._machine, out.ctypes.data)
        return out
