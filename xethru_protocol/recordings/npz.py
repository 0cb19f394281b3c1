"""Recordings as numpy archives, for analysis: `numpy.load` gives arrays, no other tool needed.

Every kind of bulk message has arrays of its own, with one row per message::

    frame_counter  u4 (n,)        frame_t_ns   i8 (n,)   ns since 1970; the least i8: unknown
    frame_samples  f4 (n, bins)   frame_index  i8 (n,)   place among all messages

and likewise ``baseband_iq_samples``, f4 (n, 2, bins), I and Q, with a row per header field; also
``baseband_ap``, ``pulsedoppler_float``, ``pulsedoppler_byte``, ``noisemap_float``,
``noisemap_byte`` and ``data_byte``. Where the messages of a kind differ in length, its samples are
one flat array, cut by the sum of ``frame_bins`` (for pairs: all of the first, then of the second).

Everything else is ragged: ``message_payload`` u1, cut at ``message_end``, with ``message_t_ns``,
``message_index``, ``message_name`` and ``message_fields``, the fields as JSON for reading (the
payload decides). ``facts`` are those of the recording, as JSON.

Where all frames have one layout, plain arrays of them lie beside the messages they came in:
``iq`` or ``rf`` and the others of `array_files`, for programs that read nothing else. They repeat
what the messages hold, and are not read here.

An archive that was cut cannot be read at all: it is for finished recordings. Samples are written
and read a message at a time; only headers and what is no bulk message are held in memory.
"""

import contextlib
import heapq
import json
import math
import shutil
import zipfile
import zlib
from array import array
from collections.abc import Callable, Iterable, Iterator
from operator import itemgetter
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any

import numpy as np
import numpy.typing as npt
from numpy.lib.format import read_array_header_1_0, read_magic, write_array, write_array_header_1_0

from xethru_protocol.recordings.array_files import Frames, add_arrays
from xethru_protocol.recordings.records import (
    NO_TIME_NS,
    RecordingError,
    RecordingFacts,
    Timed,
    TimedMessages,
    reading,
    writing,
)
from xethru_protocol.recordings.vendor.layouts import BINARY_KINDS, KIND_OF_MESSAGE, BinaryKind
from xethru_protocol.system import written_whole
from xethru_protocol.validation import shown
from xethru_protocol.wire.codec import decode_response, describe, encode
from xethru_protocol.wire.rows import Response

FORMAT = "xethru-hil recording 1"
SUFFIX = ".npz"

_Archive = Any  # what numpy.load gives
_AT_ONCE = 1 << 20  # bytes copied together
_DAMAGED = (
    zipfile.BadZipFile,
    zlib.error,
    EOFError,
    ValueError,
    KeyError,
    TypeError,
    IndexError,
    RuntimeError,  # JSON too deep, a zip of another kind
    MemoryError,
)
_GROUPS = {"datafloat": "frame", "databyte": "data_byte"}
# Names of arrays that are not those of the header's fields: units left out, and a frame's own.
_ARRAYS = {
    "byte_step_start_db": "byte_step_start",
    "byte_step_size_db": "byte_step_size",
    "frequency_start_hz": "frequency_start",
    "frequency_step_hz": "frequency_step",
}
_FRAME_ARRAYS = {"info": "counter", "length": "bins"}


def _group(kind: BinaryKind) -> str:
    return _GROUPS.get(kind.name, kind.name)


def _header_arrays(kind: BinaryKind) -> dict[str, str]:
    names = _FRAME_ARRAYS if kind.name == "datafloat" else _ARRAYS
    return {part: f"{_group(kind)}_{names.get(part, part)}" for part in kind.header.names or ()}


class _Bulk:
    """Bulk messages of one kind while they are gathered; their samples wait on the disk."""

    def __init__(self, kind: BinaryKind, folder: Path) -> None:
        self.kind = kind
        self.index = array("q")
        self.t_ns = array("q")
        self.headers = bytearray()
        self.samples = TemporaryFile(dir=folder)  # noqa: SIM115 - `write_npz` closes it

    def add(self, message: Response) -> None:
        record = encode(message, bulk=True)[len(self.kind.prefix) :]
        self.headers += record[: self.kind.header.itemsize]
        self.samples.write(record[self.kind.header.itemsize :])

    def save(self, archive: zipfile.ZipFile) -> None:
        kind, group = self.kind, _group(self.kind)
        headers = np.frombuffer(self.headers, kind.header)
        _add(archive, f"{group}_index", np.array(self.index, np.int64))
        _add(archive, f"{group}_t_ns", np.array(self.t_ns, np.int64))
        for part, name in _header_arrays(kind).items():
            _add(archive, name, headers[part])
        counts = headers[kind.count].astype(np.int64)
        shape: tuple[int, ...] = (int(counts.sum()) * kind.columns,)
        if np.ptp(counts) == 0:
            columns = (kind.columns,) if kind.columns > 1 else ()
            shape = (len(headers), *columns, int(counts[0]))
        about = {"descr": kind.values, "fortran_order": False, "shape": shape}
        self.samples.seek(0)
        with _new_member(archive, f"{group}_samples") as stream:
            write_array_header_1_0(stream, about)
            shutil.copyfileobj(self.samples, stream, _AT_ONCE)


class _Others:
    def __init__(self) -> None:
        self.index = array("q")
        self.t_ns = array("q")
        self.end = array("q")
        self.payload = bytearray()
        self.names: list[str] = []
        self.fields: list[str] = []

    def add(self, message: Response) -> None:
        self.payload += encode(message)
        self.end.append(len(self.payload))
        name, fields = describe(message)
        self.names.append(name)
        self.fields.append(json.dumps(fields))

    def save(self, archive: zipfile.ZipFile) -> None:
        _add(archive, "message_index", np.array(self.index, np.int64))
        _add(archive, "message_t_ns", np.array(self.t_ns, np.int64))
        _add(archive, "message_end", np.array(self.end, np.int64))
        _add(archive, "message_payload", np.frombuffer(self.payload, np.uint8))
        _add(archive, "message_name", np.array(self.names, dtype=np.str_))
        _add(archive, "message_fields", np.array(self.fields, dtype=np.str_))


def write_npz(
    path: Path,
    messages: Iterable[Timed],
    facts: RecordingFacts,
    arrays: Callable[[], Frames | None] = lambda: None,
) -> None:
    """Write messages to a new archive; samples wait in unnamed files beside it meanwhile.

    ``arrays`` gives the frames among the messages for plain arrays, None for no such.

    RecordingError if the file exists or cannot be written; then it is not left behind.
    """
    if path.exists():
        raise RecordingError(f"{path} exists already")
    bulk: dict[int, _Bulk] = {}
    others = _Others()
    with writing(path), contextlib.ExitStack() as cleanup:
        for index, (message, t_ns) in enumerate(messages):
            kind = KIND_OF_MESSAGE.get(type(message))
            group: _Bulk | _Others = others
            if isinstance(kind, BinaryKind):
                if kind.data_type not in bulk:
                    bulk[kind.data_type] = _Bulk(kind, path.parent)
                    cleanup.callback(bulk[kind.data_type].samples.close)
                group = bulk[kind.data_type]
            group.add(message)
            group.index.append(index)
            group.t_ns.append(NO_TIME_NS if t_ns is None else t_ns)
        fresh = cleanup.enter_context(written_whole(path))
        with zipfile.ZipFile(fresh, "w", zipfile.ZIP_DEFLATED) as archive:
            _add(archive, "format", np.array(FORMAT))
            _add(archive, "facts", np.array(json.dumps(facts.as_json())))
            others.save(archive)
            for part in bulk.values():
                part.save(archive)
            if (frames := arrays()) is not None and frames.kind is not None:
                add_arrays(archive, frames, frames.kind)


def _new_member(archive: zipfile.ZipFile, name: str) -> IO[bytes]:
    return archive.open(f"{name}.npy", "w", force_zip64=True)


def _add(archive: zipfile.ZipFile, name: str, values: npt.NDArray[Any]) -> None:
    with _new_member(archive, name) as stream:
        write_array(stream, values, allow_pickle=False)


def read_npz(path: Path) -> TimedMessages:
    """Messages of an archive; RecordingError if it is cut, damaged or not of this program."""
    with _open(path, " is cut or damaged") as archive, contextlib.ExitStack() as cleanup:
        # Checksums are of whole arrays: without this, damaged samples would come out first.
        if (damaged := archive.zip.testzip()) is not None:
            raise ValueError(f"the checksum of {shown(damaged)} is wrong")
        found = [_other_messages(archive)]
        found += [
            _bulk_messages(kind, archive, cleanup)
            for kind in BINARY_KINDS
            if f"{_group(kind)}_index" in archive
        ]
        for _, t_ns, payload in heapq.merge(*found, key=itemgetter(0)):
            yield decode_response(payload), None if t_ns == NO_TIME_NS else t_ns


def npz_facts(path: Path) -> RecordingFacts:
    with _open(path, ": its description is damaged") as archive:
        return RecordingFacts.from_json(json.loads(str(archive["facts"])))


@contextlib.contextmanager
def _open(path: Path, problem: str) -> Iterator[_Archive]:
    """Open an archive of this module; every error of damage becomes one with ``problem``."""
    try:
        with (
            reading(path),
            path.open("rb") as stream,
            np.load(stream, allow_pickle=False) as archive,
        ):
            if "format" not in archive or str(archive["format"]) != FORMAT:
                raise RecordingError(f"{path} is a numpy archive, and no recording of this program")
            yield archive
    except _DAMAGED as error:
        raise RecordingError(f"{path}{problem}: {error}") from None


_Found = Iterator[tuple[int, int, bytes]]  # place, time, payload


def _other_messages(archive: _Archive) -> _Found:
    payload = archive["message_payload"].tobytes()
    begin = 0
    rows = (archive[f"message_{name}"].tolist() for name in ("index", "t_ns", "end"))
    for index, t_ns, end in zip(*rows, strict=True):
        yield index, t_ns, payload[begin:end]
        begin = end


def _bulk_messages(kind: BinaryKind, archive: _Archive, cleanup: contextlib.ExitStack) -> _Found:
    group = _group(kind)
    index = archive[f"{group}_index"]
    headers = np.zeros(len(index), kind.header)
    for part, name in _header_arrays(kind).items():
        headers[part] = archive[name]
    sizes = headers[kind.count].astype(np.int64) * kind.element_bytes
    samples = cleanup.enter_context(archive.zip.open(f"{group}_samples.npy"))
    held = _samples_bytes(samples, kind)
    if int(sizes.sum()) != held:
        raise ValueError(f"{group}_samples holds {held} bytes, not {int(sizes.sum())}")
    stamps_ns = archive[f"{group}_t_ns"]
    for place, t_ns, size, header in zip(index, stamps_ns, sizes.tolist(), headers, strict=True):
        data = samples.read(size)
        if len(data) < size:
            raise EOFError(f"{group}_samples ends too soon")
        yield int(place), int(t_ns), kind.prefix + header.tobytes() + data


def _samples_bytes(stream: IO[bytes], kind: BinaryKind) -> int:
    """Read an array's head and return how many bytes of values follow it."""
    if read_magic(stream) != (1, 0):
        raise ValueError("its samples are of an unknown version of numpy's format")
    shape, column_major, found = read_array_header_1_0(stream)
    if found != np.dtype(kind.values) or (column_major and len(shape) > 1):
        raise ValueError(f"its samples are {found}, not {kind.values} row by row")
    return math.prod(shape) * found.itemsize
