"""What every kind of recording holds: messages with their times, and facts about the whole."""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from functools import partial
from io import FileIO
from operator import ne
from pathlib import Path
from typing import Any, Literal, Self, get_type_hints

from xethru_protocol.optional_packages import what_is_missing
from xethru_protocol.validation import reason_of, shown
from xethru_protocol.wire.errors import XeThruError
from xethru_protocol.wire.table import Response

# Bytes that files begin with
MCAP_MAGIC = b"\x89MCAP0\r\n"
WIRE_MAGIC = b"\x89XTWIRE\n"
NPY_MAGIC = b"\x93NUMPY"
ZIP_MAGIC = b"PK\x03\x04"  # .npz, too
MAT_MAGIC = b"MATLAB 5.0 MAT"
RERUN_MAGIC = b"RRF"


class RecordingError(XeThruError):
    """A recording cannot be read or written."""


@contextmanager
def optional_packages(what: str = "MCAP needs packages that are optional") -> Iterator[None]:
    """Import what a format needs; RecordingError, with ``what`` in it, where that is missing."""
    try:
        yield
    except ModuleNotFoundError as error:
        missing = what_is_missing(error)
        if missing is None:
            raise
        raise RecordingError(f"{what}; {missing}") from None


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingFault:
    """A damaged part: what could not be read of ``file`` at byte ``offset``, and why.

    ``minor``: no message is lost, only its time or the order among several files.
    """

    file: str
    offset: int
    reason: str
    minor: bool = False

    def __str__(self) -> str:
        return f"{self.file}: {self.reason} (at byte {self.offset})"


FaultHandler = Callable[[RecordingFault], None]


def report(fault: RecordingFault, on_fault: FaultHandler | None) -> None:
    """Hand a fault over; without a handler, one that costs messages raises `RecordingError`."""
    if on_fault is not None:
        on_fault(fault)
    elif not fault.minor:
        raise RecordingError(str(fault))


@contextmanager
def doing(what: str, path: object) -> Iterator[None]:
    """Turn an error of the operating system into one that says what cannot be done to a file."""
    try:
        yield
    except OSError as error:
        raise RecordingError(f"{path} cannot be {what}: {error.strerror or error}") from None


reading, writing = partial(doing, "read"), partial(doing, "written")


def is_like(head: bytes, magic: bytes) -> bool:
    """Whether a file begins with a magic number, one damaged byte allowed."""
    return len(head) == len(magic) and sum(map(ne, head, magic)) <= 1


MagicFormat = Literal["mcap", "wire", "rerun", ".npy", ".npz", ".mat"]
_MAGICS: Mapping[bytes, MagicFormat] = {
    MCAP_MAGIC: "mcap",
    WIRE_MAGIC: "wire",
    RERUN_MAGIC: "rerun",
    NPY_MAGIC: ".npy",
    ZIP_MAGIC: ".npz",
    MAT_MAGIC: ".mat",
}
_SHORT = 4  # bytes, of which one damaged one would leave too little


def format_by_magic(start: bytes) -> MagicFormat | None:
    """Return the format of a file that begins so; None if it has no magic number."""
    for magic, found in _MAGICS.items():
        head = start[: len(magic)]
        if head == magic or (len(magic) > _SHORT and is_like(head, magic)):
            return found
    return None


class GrowingFile:
    """A new file that grows by whole pieces, each handed to the operating system at once.

    With ``flush`` each piece is on the disk before `append` returns; with ``replace`` the file may
    exist. Creating it and every method raise RecordingError if it cannot be made or written.
    """

    def __init__(self, path: Path, *, flush: bool = False, replace: bool = False) -> None:
        self.path = path
        self.size = 0
        self._flush = flush
        with writing(path):
            self._stream = FileIO(path, "w" if replace else "x")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    @property
    def closed(self) -> bool:
        return self._stream.closed

    def append(self, data: bytes) -> None:
        """Write all of ``data`` at the end, or leave the file as it was."""
        view = memoryview(data)
        with writing(self.path):
            try:
                while view:
                    view = view[self._stream.write(view) :]
                if self._flush:
                    os.fsync(self._stream.fileno())
            except OSError:
                with suppress(OSError):  # the disk itself may be gone
                    os.ftruncate(self._stream.fileno(), self.size)  # no part of a piece stays
                    self._stream.seek(self.size)
                raise
        self.size += len(data)

    def finish(self, head: bytes) -> None:
        """Write ``head`` over the file's beginning and close it."""
        with writing(self.path), self._stream:
            self._stream.seek(0)
            self._stream.write(head)

    def close(self) -> None:
        """Close the file; calling it again does nothing."""
        with writing(self.path):
            self._stream.close()


class PieceFile(GrowingFile):
    """A `GrowingFile` as a stream; what is written to it waits until `hand_over` ends a piece."""

    def __init__(self, path: Path, *, replace: bool = False) -> None:
        super().__init__(path, replace=replace)
        self._waiting = bytearray()

    def write(self, data: bytes) -> int:
        self._waiting += data
        return len(data)

    def tell(self) -> int:
        return self.size + len(self._waiting)

    def flush(self) -> None:
        """Do nothing: `hand_over` ends a piece."""

    def hand_over(self) -> None:
        if self._waiting:
            self.append(bytes(self._waiting))
            self._waiting = bytearray()


MS_NS = 1_000_000
MODULE_METRES = "module metres, c = 3.0e8 m/s"  # unit of lengths in the description of a radar
NO_TIME_NS = -(2**63)  # stands for an unknown time
LATEST_MS = 2**63 // MS_NS - 2**32
"""Latest time at which a recording may begin [ms since 1970]: each of its times [ns], at most
2**32 ms later, fits 64 bits."""
EARLIEST_MS = -LATEST_MS
Timed = tuple[Response, int | None]
"""A message and its time [ns since 1970]; None where the recording has none."""
TimedMessages = Iterator[Timed]


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingContent:
    """The radars of a recording by name, and lines of other sensors, each with its time [ns].

    A radar has its description as an MCAP file holds it, or an empty one; the only radar of a
    recording without names is ``""``.
    """

    radars: Mapping[str, Mapping[str, Any]]
    texts: Mapping[str, Sequence[tuple[int, str]]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingFacts:
    """Facts about a recording, beside its messages; None where unknown.

    ``profile_id`` is of the profile that ran (Protocol reference 4.3), ``parameter_file`` the
    content of the module's parameter file, ``user_header`` what the recorder put before the records
    of each data file; ``stopped_ns`` and ``closed_ns`` are when the last data file and the
    recording were closed [ns since 1970].
    """

    session_id: str = ""
    profile_id: int | None = None
    parameter_file: bytes | None = None
    user_header: bytes = b""
    stopped_ns: int | None = None
    closed_ns: int | None = None

    def as_json(self) -> dict[str, Any]:
        """JSON-able form: bytes in hexadecimal."""
        return asdict(self) | {
            "parameter_file": None if self.parameter_file is None else self.parameter_file.hex(),
            "user_header": self.user_header.hex(),
        }

    @classmethod
    def read(
        cls, path: Path, values: Callable[[], Mapping[str, Any]], on_fault: FaultHandler | None
    ) -> Self:
        """Return what a file says about itself; damage is reported and gives the defaults."""
        try:
            return cls.from_json(values())
        except (AttributeError, KeyError, ValueError, TypeError, RecursionError) as error:
            reason = f"what it says about itself is damaged: {reason_of(error)}"
            report(RecordingFault(file=path.name, offset=0, reason=reason, minor=True), on_fault)
            return cls()

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        """Read `as_json` back without unknown keys; ValueError or TypeError for a bad value."""
        known = {name: values[name] for name in cls.__slots__ if name in values}
        for name in ("parameter_file", "user_header"):
            if known.get(name) is not None:
                known[name] = bytes.fromhex(known[name])
        for name, hint in get_type_hints(cls).items():
            if name in known and not isinstance(known[name], hint):
                raise ValueError(f"{name} cannot be {shown(known[name])}")
        return cls(**known)
