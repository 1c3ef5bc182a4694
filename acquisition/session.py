"""Sessions: many frames and all that is known about their capture, in one HDF5 file.

A session can be read while it is written, and what `SessionWriter.append` has returned from is in
the file whatever happens to the process afterwards. It is a plain HDF5 file (h5py's
``File(path, swmr=True)`` opens it) with

==============  =====================================================================
``/elements``   uint16, (N, 3694): converter counts, as read
``/frames``     N rows, one per frame: the fields of `acquisition.frames.stack` but the
                elements, and two checksums (`checksums`)
attributes      of the root group: schema and version, units, and `Metadata`; texts have a
                fixed length (h5py returns bytes), in UTF-8
==============  =====================================================================

`/frames` grows after `/elements`: its length is the number of frames.
"""

from __future__ import annotations

import importlib
import io
import json
import os
import queue
import socket
import struct
import threading
import time
import zlib
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, fields
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, Protocol, Self

import numpy as np

from acquisition.frames import (
    CHANNELS,
    ELEMENTS,
    MASTER_CLOCK,
    Frame,
    FrameFlags,
    SpikeFrame,
    stack,
)

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

SCHEMA: Final = "linetrack session"
SCHEMA_VERSION: Final = 1
"""A reader refuses files of a later one."""

ROW: Final = np.dtype(
    [
        ("sequence", "<u8"),
        ("leds", "<u8"),
        ("exposures", "<u4", (CHANNELS,)),
        ("sh_period", "<u4"),
        ("icg_period", "<u4"),
        ("master_clock", "<u4"),
        ("timestamp", "<i8"),
        ("utc_ns", "<i8"),
        ("monotonic_ns", "<i8"),
        ("flags", "<u4"),
        ("elements_crc32", "<u4"),
        ("row_crc32", "<u4"),
    ]
)
"""A row of `/frames`."""

UNITS: Final = {
    "elements": "ADC counts, 12 bit; light lowers them",
    "sequence": "read-outs, from 0",
    "leds": "mask, bit n is channel n",
    "exposures": "master clocks by channel, 0 = unlit or unknown",
    "sh_period": "master clocks, 0 = unknown",
    "icg_period": "master clocks, 0 = unknown",
    "master_clock": "Hz",
    "timestamp": "ns, device clock, end of the integration; -1 = unknown",
    "utc_ns": "ns since 1970-01-01 UTC, host, when the frame had arrived; 0 = unknown",
    "monotonic_ns": "ns, host's monotonic clock, when the frame had arrived; 0 = unknown",
    "flags": "acquisition.frames.FrameFlags",
    "elements_crc32": "CRC-32 (zlib) of the frame's elements as little-endian uint16",
    "row_crc32": "CRC-32 (zlib) of the row before this field",
}

State = Literal["closed", "being written", "cut off"]

BATCH: Final = 64
"""The most frames that `record` stores at once."""

_CHUNK: Final = 16  # frames
_ROWS: Final = 256  # rows of /frames in a chunk
_SIGNATURE: Final = b"\x89HDF\r\n\x1a\n"
_FRAME_BYTES: Final = 2 * ELEMENTS
_U32: Final = 0xFFFF_FFFF
# of HDF5, version 3: signature, version, sizes, flags, four addresses (the third: the file's end),
# checksum
_SUPERBLOCK: Final = struct.Struct("<8sBBBBQQQQI")
_OPENED: Final = 0b101  # flags: for writing, for SWMR writing
_ATTEMPTS: Final = 10  # to read what is being written
_PAUSE: Final = 0.005  # s between them
_ROOM: Final = 1 << 16  # bytes of disk; more than HDF5's own tables grow by with one batch


class SessionError(Exception):
    """A session cannot be written, or a file is no session or damaged: says which file and why."""


def _version() -> str:
    try:
        return version("linetrack")
    except PackageNotFoundError:
        return "unknown"


def _wiring() -> str:
    return Path(__file__).with_name("wiring.toml").read_text(encoding="utf-8")


@dataclass(frozen=True, kw_only=True)
class Metadata:
    """What a session says about its capture as a whole.

    Parameters
    ----------
    link : str
        By which link the frames came, such as ``spi``, ``twin`` or ``replay FILE``.
    firmware_build : str
        As the device told it; empty if it did not (original mode).
    command : mapping
        The command sent: periods and exposures in master clocks. Anything that JSON can hold.
    lens_system : mapping
        Description of the lens head in front of the sensor. Anything that JSON can hold.
    extra : mapping
        Anything else that JSON can hold, such as the settings of a link.
    master_clock : int
        Of the sensor, Hz.
    wiring : str
        Text of wiring.toml, which says how the prototype is wired.
    linetrack_version : str
    created_utc_ns : int
        ns since 1970-01-01 UTC.
    """

    link: str = ""
    firmware_build: str = ""
    command: Mapping[str, Any] = field(default_factory=dict)
    lens_system: Mapping[str, Any] = field(default_factory=dict)
    extra: Mapping[str, Any] = field(default_factory=dict)
    master_clock: int = MASTER_CLOCK
    wiring: str = field(default_factory=_wiring)
    linetrack_version: str = field(default_factory=_version)
    created_utc_ns: int = field(default_factory=time.time_ns)


_JSON_FIELDS: Final = frozenset({"command", "lens_system", "extra"})
_INT_FIELDS: Final = frozenset({"master_clock", "created_utc_ns"})


class SessionWriter:
    """Writes a session; use it as a context manager, or call `close`.

    Parameters
    ----------
    path : str or Path
    metadata : Metadata, optional
    overwrite : bool
        Replace a file that is there.

    Raises
    ------
    SessionError
        The file exists, cannot be made, the metadata are too much for it, or h5py is missing.
    """

    def __init__(
        self, path: str | Path, metadata: Metadata | None = None, *, overwrite: bool = False
    ) -> None:
        self.path = Path(path)
        self._count = 0
        hdf5 = require_h5py()
        if not overwrite and self.path.exists():
            raise SessionError(f"{path} exists; choose another name, or ask to overwrite it")
        part = self.path.with_name(f".{self.path.name}.{os.getpid()}.part")
        # Under its own name the file shows up once all of it is there, open for readers.
        with _converted(self.path, "cannot be written"):
            self._file: Any = None
            self._reserved = 0
            try:
                self._file = hdf5.File(part, "w", libver="latest")
                self._make(metadata if metadata is not None else Metadata())
                self._file.swmr_mode = True
                _publish(part, self.path, overwrite=overwrite)
            except BaseException:
                if self._file is not None:
                    self._file.close()
                with suppress(OSError):
                    part.unlink()
                raise

    def _make(self, metadata: Metadata) -> None:
        attributes: dict[str, str | int] = {
            "schema": SCHEMA,
            "schema_version": SCHEMA_VERSION,
            "units": json.dumps(UNITS),
            "writer": json.dumps(_this_process()),
        }
        for name, value in asdict(metadata).items():
            attributes[name] = json.dumps(value) if name in _JSON_FIELDS else value
        self._reserve(2 * sum(len(str(value).encode()) for value in attributes.values()))
        _describe(self._file, attributes)
        self._elements = self._file.create_dataset(
            "elements",
            shape=(0, ELEMENTS),
            maxshape=(None, ELEMENTS),
            dtype="<u2",
            chunks=(_CHUNK, ELEMENTS),
        )
        _describe(self._elements, {"unit": UNITS["elements"]})
        self._frames = self._file.create_dataset(
            "frames", shape=(0,), maxshape=(None,), dtype=ROW, chunks=(_ROWS,)
        )
        _describe(self._frames, {"units": json.dumps(UNITS)})

    def append(self, frames: Frame | Sequence[Frame]) -> None:
        """Store frames; on return they are in the file, for readers and after a kill.

        One call with 32 frames costs about as much as two with one each.

        Parameters
        ----------
        frames : Frame or sequence of Frame
            The reasons for `FrameFlags.INVALID` are not kept, the flag is.

        Raises
        ------
        SessionError
            The file cannot be written, such as on a full disk; a value does not fit its column.
        """
        if isinstance(frames, Frame | SpikeFrame):
            frames = [frames]
        if not frames:
            return
        if not all(isinstance(frame, Frame) for frame in frames):
            raise SessionError(
                "a session keeps pixels, and frames of spikes mode have none: record in stream mode"
            )
        first, last = self._count, self._count + len(frames)
        with _converted(self.path, "cannot be written"):
            arrays = stack(frames)
            elements = arrays.pop("elements").astype("<u2", copy=False)
            rows = np.zeros(len(frames), ROW)
            for name, values in arrays.items():
                rows[name] = values
            rows["elements_crc32"], rows["row_crc32"] = checksums(rows, elements)
            chunks, tables = len(frames) // _CHUNK + 1, len(frames) // _ROWS + 1
            self._reserve(chunks * _CHUNK * _FRAME_BYTES + tables * _ROWS * ROW.itemsize)
            self._elements.resize(last, axis=0)
            self._elements[first:last] = elements
            self._elements.flush()
            self._frames.resize(last, axis=0)
            self._frames[first:last] = rows
            self._frames.flush()
        self._count = last

    def _reserve(self, size: int) -> None:
        """Have the disk's room before HDF5 needs it: after a write that fails, it crashes."""
        needed = self._file.id.get_filesize() + size + _ROOM
        if needed > self._reserved:
            os.posix_fallocate(self._file.id.get_vfd_handle(), 0, needed)
            self._reserved = needed

    def __len__(self) -> int:
        return self._count

    def close(self) -> None:
        """Close the file; doing so twice is no mistake.

        Raises
        ------
        SessionError
            The last of it could not be written.
        """
        if not self._file:
            return
        with _converted(self.path, "cannot be written"):
            own = os.dup(self._file.id.get_vfd_handle())
            try:
                self._file.close()
                end = _SUPERBLOCK.unpack(os.pread(own, _SUPERBLOCK.size, 0))[7]
                os.ftruncate(own, end)  # gives back what was reserved and not used
            finally:
                os.close(own)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _describe(target: Any, attributes: Mapping[str, str | int]) -> None:
    """Set attributes, texts with a fixed length: others lie in a heap without a checksum."""
    for name, value in attributes.items():
        target.attrs[name] = np.bytes_(value.encode()) if isinstance(value, str) else value


def _attribute(target: Any, name: str) -> str | int:
    """Return an attribute; only of the types that `_describe` writes is it looked at."""
    dtype, shape = target.attrs.get_id(name).dtype, target.attrs.get_id(name).shape
    if shape != () or dtype.kind not in "iuS":
        raise TypeError(f"attribute {name} is neither text of a fixed length nor a number")
    value = target.attrs[name]
    return bytes(value).decode() if dtype.kind == "S" else int(value)


def checksums(
    rows: NDArray[np.void], elements: NDArray[np.uint16] | None = None
) -> tuple[list[int], list[int]]:
    """Return the checksums of frames in a session.

    Parameters
    ----------
    rows : ndarray of `ROW`, shape (N,)
    elements : ndarray of little-endian uint16, shape (N, 3694), optional
        Left out, the rows' own ``elements_crc32`` are believed.

    Returns
    -------
    elements_crc32, row_crc32 : list of int
    """
    if elements is None:
        of_elements = rows["elements_crc32"].tolist()
    else:
        of_elements = [zlib.crc32(line) for line in np.ascontiguousarray(elements)]
    rows = rows.copy()
    rows["elements_crc32"] = of_elements
    offset = ROW.fields["row_crc32"][1] if ROW.fields else 0
    return of_elements, [zlib.crc32(row.tobytes()[:offset]) for row in rows]


class Appendable(Protocol):
    """What `record` writes to: a `SessionWriter`, or a `acquisition.dat.DatWriter`."""

    def append(self, frames: Sequence[Frame]) -> None:
        """Store the frames; on return they are safe."""


def record(frames: Iterable[Frame], writer: Appendable, *, batch: int = BATCH) -> Generator[Frame]:
    """Store frames as they come, and hand on each one once it is safe in the file.

    The frames are taken from their iterator in a thread of its own, so that the link is served
    while the disk is waited for; whatever has come in the meantime is stored at one go. If the
    loop over this generator ends early, frames that had arrived by then are stored, too.

    Parameters
    ----------
    frames : iterable of Frame
        Such as from `acquisition.capture.capture`.
    writer : SessionWriter or DatWriter
    batch : int
        The most frames to be stored at once.

    Yields
    ------
    Frame
        After the writer has returned from it: this frame survives whatever comes.

    Raises
    ------
    SessionError, OSError
        From the writer.
    Exception
        What the frames' iterator raised, after all frames before it were handed on.
    """
    waiting: queue.Queue[Frame | _End] = queue.Queue(maxsize=4 * batch)
    stop = threading.Event()
    thread = threading.Thread(target=_fetch, args=(frames, waiting, stop), daemon=True)
    thread.start()
    end: _End | None = None
    broken = False
    try:
        while end is None:
            taken, end = _take(waiting, batch)
            broken = True
            writer.append(taken)
            broken = False
            yield from taken
    finally:
        stop.set()
        while end is None:  # ends soon: the thread looks at `stop` after each frame
            taken, end = _take(waiting, batch)
            if not broken:
                writer.append(taken)
        thread.join()
    if end.error is not None:
        raise end.error


@dataclass(frozen=True)
class _End:
    error: BaseException | None


def _fetch(
    frames: Iterable[Frame], waiting: queue.Queue[Frame | _End], stop: threading.Event
) -> None:
    error: BaseException | None = None
    iterator = iter(frames)
    try:
        for frame in iterator:
            waiting.put(frame)
            if stop.is_set():
                break
    except BaseException as caught:  # noqa: BLE001  raised again by `record`
        error = caught
    try:
        close = getattr(iterator, "close", None)
        if close is not None:
            close()
    except BaseException as caught:  # noqa: BLE001
        error = error or caught
    waiting.put(_End(error))


def _take(waiting: queue.Queue[Frame | _End], most: int) -> tuple[list[Frame], _End | None]:
    """Wait for one frame; return it and those behind it, and the end if it was reached."""
    taken: list[Frame] = []
    item = waiting.get()
    while not isinstance(item, _End):
        taken.append(item)
        if len(taken) == most:
            return taken, None
        try:
            item = waiting.get_nowait()
        except queue.Empty:
            return taken, None
    return taken, item


class _Snapshot(io.RawIOBase):
    """A file as long as it is now, whose HDF5 library shall take it for closed.

    The library's own way to read what is being written, SWMR, tries the same damaged place
    again, up to a hundred times, and doubles its pause each time: with a damaged file it hangs.
    What SWMR writers leave is sound at any moment but for two things in the file's first bytes:
    the flags that say it is open, and its length.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._file: io.FileIO | None = None
        self._file = path.open("rb", buffering=0)
        self._at = 0
        self.size = os.fstat(self._file.fileno()).st_size
        self._head = self._file.read(_SUPERBLOCK.size) or b""
        self.unfinished = False
        try:
            self._patch(path)
        except BaseException:
            self.close()
            raise

    def _patch(self, path: Path) -> None:
        if not self._head.startswith(_SIGNATURE):
            raise SessionError(f"{path}: no HDF5 file; expected a session of linetrack")
        if len(self._head) < _SUPERBLOCK.size:
            raise SessionError(f"{path}: no session of linetrack, or damaged (it ends at once)")
        values = list(_SUPERBLOCK.unpack(self._head))
        if values[1:4] != [3, 8, 8] or not values[4] & _OPENED:
            return
        if values[-1] != _lookup3(self._head[:-4]):
            message = f"{path}: no session of linetrack, or damaged (checksum of its first bytes)"
            raise SessionError(message)
        self.unfinished = True
        values[4] = 0
        values[7] = self.size
        head = _SUPERBLOCK.pack(*values)[:-4]
        self._head = head + _lookup3(head).to_bytes(4, "little")

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        start = {os.SEEK_SET: 0, os.SEEK_CUR: self._at, os.SEEK_END: self.size}[whence]
        self._at = start + offset
        return self._at

    def tell(self) -> int:
        return self._at

    def readinto(self, buffer: Any) -> int:
        view = memoryview(buffer).cast("B")[: max(0, self.size - self._at)]
        if self._file is None:
            raise ValueError("the file is closed")
        count = os.preadv(self._file.fileno(), [view], self._at)
        patched = self._head[self._at : self._at + count]
        view[: len(patched)] = patched
        self._at += count
        return count

    def close(self) -> None:
        if self._file is not None:
            self._file.close()
        super().close()


def _lookup3(data: bytes) -> int:
    """Bob Jenkins's hash, by which HDF5 checks its metadata."""
    a = b = c = (0xDEADBEEF + len(data)) & _U32
    words = struct.unpack(
        f"<{-(-len(data) // 12) * 3}I", data.ljust(-(-len(data) // 12) * 12, b"\0")
    )
    for at in range(0, len(words), 3):
        a, b, c = (x + y & _U32 for x, y in zip((a, b, c), words[at : at + 3], strict=True))
        if at + 3 < len(words):
            for turns in (4, 6, 8, 16, 19, 4):
                a = (a - c & _U32) ^ _turned(c, turns)
                c = c + b & _U32
                a, b, c = b, c, a
    for turns in (14, 11, 25, 16, 4, 14, 24):
        c = (c ^ b) - _turned(b, turns) & _U32
        a, b, c = b, c, a
    return b


def _turned(word: int, bits: int) -> int:
    return (word << bits | word >> 32 - bits) & _U32


class Session:
    """A session to read from: `len`, an index and a loop give its frames.

    Nothing is loaded before it is asked for. Every value read is checked against its checksum.

    Attributes
    ----------
    path : Path
    metadata : Metadata
    state : {"closed", "being written", "cut off"}
        "cut off": its writer was killed, or could not write any more. What it had acknowledged is
        there.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.state: State = "closed"
        self._open()

    def _open(self) -> None:
        """Open the file as it is now, once more if a writer was just changing it."""
        for attempt in range(_ATTEMPTS):
            try:
                self._open_once()
            except SessionError:
                if self.state != "being written" or attempt == _ATTEMPTS - 1:
                    raise
                time.sleep(_PAUSE)
            else:
                return

    def _open_once(self) -> None:
        raw = _Snapshot(self.path)  # OSError if it cannot be read
        try:
            hdf5 = require_h5py()
            with _converted(self.path, "no session of linetrack, or damaged"):
                self._file = hdf5.File(raw if raw.unfinished else self.path, "r")
        except BaseException:
            raw.close()
            raise
        self._raw = raw
        try:
            with _converted(self.path, "no session of linetrack, or damaged"):
                self.metadata, writer = self._header()
                if raw.unfinished:
                    self.state = "being written" if _alive(writer) else "cut off"
                else:
                    self.state = "closed"
                self._elements = self._dataset("elements", np.dtype("<u2"), (ELEMENTS,))
                self._frames = self._dataset("frames", ROW, ())
                self._count = self._counted(raw.size)
        except BaseException:
            self.close()
            raise

    def _header(self) -> tuple[Metadata, object]:
        root = self._file
        if "schema" not in root.attrs or _attribute(root, "schema") != SCHEMA:
            message = f"{self.path}: an HDF5 file, but no session of linetrack"
            raise SessionError(message)
        if (number := _attribute(root, "schema_version")) != SCHEMA_VERSION:
            raise SessionError(
                f"{self.path}: session of version {number}, expected {SCHEMA_VERSION}; "
                "is there a newer linetrack?"
            )
        values: dict[str, Any] = {}
        for name in (item.name for item in fields(Metadata)):
            value: Any = _attribute(root, name)
            if not isinstance(value, int if name in _INT_FIELDS else str):
                raise SessionError(
                    f"{self.path}: attribute {name} is of type {type(value).__name__}"
                )
            if name in _JSON_FIELDS:
                value = json.loads(str(value))
                if not isinstance(value, dict):
                    raise SessionError(f"{self.path}: attribute {name} is no JSON object")
            values[name] = value
        writer = _attribute(root, "writer")
        return Metadata(**values), json.loads(writer) if isinstance(writer, str) else None

    def _dataset(self, name: str, dtype: np.dtype[Any], shape: tuple[int, ...]) -> Any:
        hdf5 = require_h5py()
        plain = isinstance(self._file.get(name, getlink=True), hdf5.HardLink)
        dataset = self._file[name] if plain else None
        # nothing that would make HDF5 open other files, or run a filter
        if (
            not isinstance(dataset, hdf5.Dataset)
            or dataset.dtype != dtype
            or dataset.shape[1:] != shape
            or dataset.is_virtual
            or dataset.external
            or dataset.id.get_create_plist().get_nfilters()
        ):
            raise SessionError(f"{self.path}: /{name} is not what a session has there")
        return dataset

    def _counted(self, size: int) -> int:
        """How many frames are complete."""
        count = int(min(self._frames.shape[0], self._elements.shape[0]))
        possible = size // _FRAME_BYTES
        if self.state == "closed" and self._frames.shape == self._elements.shape[:1]:
            if count > possible:
                raise SessionError(f"{self.path}: damaged, its tables are longer than the file")
            return count
        if self.state == "closed":  # after a write that failed
            self.state = "cut off"
        # Of frames that were not acknowledged any part may be there: leave them out.
        count = min(count, possible)
        while count and not self._complete(count - 1):
            count -= 1
        return count

    def _complete(self, index: int) -> bool:
        rows, elements = self._frames[index : index + 1], self._elements[index : index + 1]
        of_elements, of_rows = checksums(rows, elements)
        return bool(of_elements == rows["elements_crc32"] and of_rows == rows["row_crc32"])

    def refresh(self) -> int:
        """Look for frames that were added since; return how many there are now.

        Raises
        ------
        SessionError
        """
        if self.state != "closed":
            self.close()
            self._open()
        return self._count

    def _load(self, name: str, first: int, last: int) -> NDArray[Any]:
        """Read from one of the tables; again if a writer was just changing the way there."""
        for attempt in range(_ATTEMPTS):
            try:
                with _converted(self.path, "damaged"):
                    table = self._frames if name == "frames" else self._elements
                    loaded: NDArray[Any] = table[first:last]
                    return loaded
            except SessionError:
                if self.state != "being written" or attempt == _ATTEMPTS - 1:
                    raise
                time.sleep(_PAUSE)
                self.refresh()
        raise AssertionError  # the loop returns or raises

    def __len__(self) -> int:
        return self._count

    def table(self, start: int = 0, stop: int | None = None) -> NDArray[np.void]:
        """Return what is known of each frame but its elements.

        Parameters
        ----------
        start, stop : int, optional
            As of a slice; left out, all frames.

        Returns
        -------
        ndarray of `ROW`, shape (N,)

        Raises
        ------
        SessionError
            A checksum does not fit.
        """
        first, last, _ = slice(start, stop).indices(self._count)
        last = max(first, last)
        rows: NDArray[np.void] = self._load("frames", first, last)
        _, of_rows = checksums(rows)
        self._compare(first, rows["row_crc32"], of_rows)
        return rows

    def arrays(self, start: int = 0, stop: int | None = None) -> dict[str, NDArray[Any]]:
        """Return frames as arrays with a leading axis, as `acquisition.frames.stack` does.

        Parameters
        ----------
        start, stop : int, optional
            As of a slice; left out, all frames (7.4 kB each).

        Raises
        ------
        SessionError
            A checksum does not fit.
        """
        first, last, _ = slice(start, stop).indices(self._count)
        last = max(first, last)
        rows = self.table(first, last)
        elements = self._load("elements", first, last)
        of_elements, _ = checksums(rows, elements)
        self._compare(first, rows["elements_crc32"], of_elements)
        names = [name for name in rows.dtype.names or () if not name.endswith("crc32")]
        return {
            "elements": elements.astype(np.uint16, copy=False),
            **{name: rows[name].astype(rows[name].dtype.newbyteorder("=")) for name in names},
        }

    def _compare(self, first: int, stored: NDArray[Any], computed: list[int]) -> None:
        wrong = np.flatnonzero(stored != np.array(computed, stored.dtype))
        if wrong.size:
            raise SessionError(
                f"{self.path}: frame {first + int(wrong[0])} is damaged, its checksum does not fit"
            )

    def frames(self, start: int = 0, stop: int | None = None) -> Iterator[Frame]:
        """Yield frames, loading a few at a time.

        Parameters
        ----------
        start, stop : int, optional
            As of a slice; left out, all frames there are now.

        Raises
        ------
        SessionError
            A frame is damaged.
        """
        first, last, _ = slice(start, stop).indices(self._count)
        for at in range(first, last, BATCH):
            arrays = self.arrays(at, min(at + BATCH, last))
            for n in range(len(arrays["elements"])):
                yield self._frame(at + n, {name: values[n] for name, values in arrays.items()})

    def _frame(self, index: int, values: dict[str, Any]) -> Frame:
        exposures, timestamp = values["exposures"], int(values["timestamp"])
        try:
            return Frame(
                values["elements"],
                sequence=int(values["sequence"]),
                leds=int(values["leds"]),
                exposures={int(n): int(exposures[n]) for n in np.flatnonzero(exposures)},
                sh_period=int(values["sh_period"]),
                icg_period=int(values["icg_period"]),
                master_clock=int(values["master_clock"]),
                timestamp=None if timestamp < 0 else timestamp,
                utc_ns=int(values["utc_ns"]),
                monotonic_ns=int(values["monotonic_ns"]),
                flags=FrameFlags(int(values["flags"])),
            )
        except ValueError as error:
            raise SessionError(f"{self.path}: frame {index}: {error}") from error

    def __getitem__(self, index: int) -> Frame:
        position = index + self._count if index < 0 else index
        if not 0 <= position < self._count:
            raise IndexError(f"{self.path}: frame {index} of {self._count}")
        return next(self.frames(position, position + 1))

    def __iter__(self) -> Iterator[Frame]:
        return self.frames()

    def close(self) -> None:
        """Close the file; doing so twice is no mistake."""
        try:
            with _converted(self.path, "damaged"):
                self._file.close()
        finally:
            self._raw.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def open_session(path: str | Path) -> Session:
    """Open a session for reading, also one that is being written or was cut off.

    Parameters
    ----------
    path : str or Path

    Raises
    ------
    SessionError
        The file is something else, or damaged; h5py is missing.
    OSError
        It cannot be read.
    """
    return Session(path)


def require_h5py() -> Any:
    """Return the module h5py.

    Raises
    ------
    SessionError
        It is not installed.
    """
    try:
        return importlib.import_module("h5py")
    except ImportError as error:
        raise SessionError(
            "sessions need h5py: pip install 'linetrack[capture]' (or write .dat files)"
        ) from error


@contextmanager
def _converted(path: Path, message: str) -> Iterator[None]:
    """Turn whatever h5py may raise into `SessionError`."""
    try:
        yield
    except SessionError:
        raise
    except Exception as error:
        text = getattr(error, "strerror", None) or str(error)
        text = text.strip().partition("\n")[0] or type(error).__name__
        raise SessionError(f"{path}: {message} ({text})") from error


def _publish(part: Path, path: Path, *, overwrite: bool) -> None:
    if overwrite:
        part.replace(path)
        return
    try:
        path.hardlink_to(part)  # refuses to replace
    except FileExistsError as error:
        raise SessionError(f"{path} exists; choose another name") from error
    except OSError:  # a file system without links
        part.rename(path)
    else:
        part.unlink()


def _this_process() -> dict[str, object]:
    return {"host": socket.gethostname(), "pid": os.getpid(), "started": _started(os.getpid())}


def _started(pid: int) -> str:
    """When a process began, in clock ticks since boot; empty if there is none (or no /proc)."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace")
    except OSError:
        return ""
    values = text.rpartition(")")[2].split()
    return "" if values[0] in "ZX" else values[19]  # a zombie writes no more


def _alive(writer: object) -> bool:
    """Whether the process that writes a session is still there; another host's is taken so."""
    if not isinstance(writer, dict) or not isinstance(pid := writer.get("pid"), int):
        return False
    return writer.get("host") != socket.gethostname() or (
        bool(writer.get("started")) and _started(pid) == writer["started"]
    )
