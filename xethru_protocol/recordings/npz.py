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

An archive that was cut cannot be read at all: it is for finished recordings. Samples are written
and read a message at a time; only headers and what is no bulk message are held in memory.
"""

import contextlib
import heapq
import json
import math
import os
import shutil
import zipfile
import zlib
from array import array
from collections.abc import Iterable, Iterator
from operator import itemgetter
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any, Literal

import numpy as np
import numpy.typing as npt
from numpy.lib.format import read_array_header_1_0, read_magic, write_array, write_array_header_1_0

from xethru_protocol.recordings.records import (
    RecordingError,
    RecordingFacts,
    Timed,
    TimedMessages,
    unreadable,
    unwritable,
)
from xethru_protocol.recordings.vendor.layouts import LAYOUTS, Layout, layout_of
from xethru_protocol.wire.codec import decode_response, describe, encode
from xethru_protocol.wire.table import Response

FORMAT = "xethru-hil recording 1"
SUFFIX = ".npz"
NO_TIME = np.iinfo(np.int64).min
"""Stands for an unknown time."""

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
_FRAME_NAMES = {"info": "counter", "length": "bins"}


def _kind_name(layout: Layout) -> str:
    name = layout.file_prefix.removeprefix("xethru_").removesuffix("_")
    return {"datafloat": "frame", "databyte": "data_byte"}.get(name, name)


def _field_name(layout: Layout, name: str) -> str:
    names = _FRAME_NAMES if _kind_name(layout) == "frame" else {}
    return f"{_kind_name(layout)}_{names.get(name, name)}"


class _Gathered:
    """Bulk messages of one kind while they are gathered; their samples wait on the disk."""

    def __init__(self, layout: Layout, folder: Path) -> None:
        self.layout = layout
        self.index = array("q")
        self.t_ns = array("q")
        self.headers = bytearray()
        self.samples = TemporaryFile(dir=folder)  # noqa: SIM115 - `write_npz` closes it

    def add(self, index: int, t_ns: int | None, record: bytes) -> None:
        self.index.append(index)
        self.t_ns.append(NO_TIME if t_ns is None else t_ns)
        self.headers += record[: self.layout.header.itemsize]
        self.samples.write(record[self.layout.header.itemsize :])

    def save(self, archive: zipfile.ZipFile) -> None:
        headers = np.frombuffer(self.headers, self.layout.header)
        name = _kind_name(self.layout)
        _add(archive, f"{name}_index", np.array(self.index, np.int64))
        _add(archive, f"{name}_t_ns", np.array(self.t_ns, np.int64))
        for part in self.layout.header.names or ():
            _add(archive, _field_name(self.layout, part), headers[part])
        counts = headers[self.layout.count].astype(np.int64)
        shape: tuple[int, ...] = (int(counts.sum()) * self.layout.columns,)
        if np.ptp(counts) == 0:
            columns = (self.layout.columns,) if self.layout.columns > 1 else ()
            shape = (len(headers), *columns, int(counts[0]))
        about = {"descr": self.layout.values, "fortran_order": False, "shape": shape}
        self.samples.seek(0)
        with _member(archive, f"{name}_samples", "w") as stream:
            write_array_header_1_0(stream, about)
            shutil.copyfileobj(self.samples, stream, _AT_ONCE)


class _Others:
    """All other messages while they are gathered."""

    def __init__(self) -> None:
        self.index = array("q")
        self.t_ns = array("q")
        self.end = array("q")
        self.payload = bytearray()
        self.names: list[str] = []
        self.fields: list[str] = []

    def add(self, index: int, t_ns: int | None, message: Response) -> None:
        self.index.append(index)
        self.t_ns.append(NO_TIME if t_ns is None else t_ns)
        self.payload += encode(message)
        self.end.append(len(self.payload))
        name, shown = describe(message)
        self.names.append(name)
        self.fields.append(json.dumps(shown))

    def save(self, archive: zipfile.ZipFile) -> None:
        _add(archive, "message_index", np.array(self.index, np.int64))
        _add(archive, "message_t_ns", np.array(self.t_ns, np.int64))
        _add(archive, "message_end", np.array(self.end, np.int64))
        _add(archive, "message_payload", np.frombuffer(self.payload, np.uint8))
        _add(archive, "message_name", np.array(self.names, dtype=np.str_))
        _add(archive, "message_fields", np.array(self.fields, dtype=np.str_))


def write_npz(path: Path, messages: Iterable[Timed], facts: RecordingFacts) -> None:
    """Write messages to a new archive; samples wait in unnamed files beside it meanwhile.

    Raises
    ------
    RecordingError
        If the file exists or cannot be written; then it is not left behind.
    """
    if path.exists():
        raise RecordingError(f"{path} exists already")
    bulk: dict[int, _Gathered] = {}
    others = _Others()
    partial = path.with_name(path.name + ".part")
    try:
        with contextlib.ExitStack() as cleanup:
            for index, (message, t_ns) in enumerate(messages):
                payload = encode(message, bulk=True)
                layout = layout_of(payload)
                if layout is None:
                    others.add(index, t_ns, message)
                    continue
                if layout.data_type not in bulk:
                    gathered = bulk[layout.data_type] = _Gathered(layout, path.parent)
                    cleanup.callback(gathered.samples.close)
                bulk[layout.data_type].add(index, t_ns, payload[len(layout.prefix) :])
            cleanup.callback(partial.unlink, missing_ok=True)
            with zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as archive:
                _add(archive, "format", np.array(FORMAT))
                _add(archive, "facts", np.array(json.dumps(facts.as_json())))
                others.save(archive)
                for gathered in bulk.values():
                    gathered.save(archive)
            os.replace(partial, path)
    except OSError as error:
        raise unwritable(path, error) from None


def _member(archive: zipfile.ZipFile, name: str, mode: Literal["r", "w"]) -> IO[bytes]:
    return archive.open(f"{name}.npy", mode, force_zip64=mode == "w")


def _add(archive: zipfile.ZipFile, name: str, values: npt.NDArray[Any]) -> None:
    with _member(archive, name, "w") as stream:
        write_array(stream, values, allow_pickle=False)


def read_npz(path: Path) -> TimedMessages:
    """Messages of an archive of this module, in their order.

    Raises
    ------
    RecordingError
        If the file is cut, damaged or not of this kind.
    """
    try:
        with contextlib.ExitStack() as cleanup:
            archive = cleanup.enter_context(np.load(path, allow_pickle=False))
            _check_format(path, archive)
            # Checksums stand for whole arrays: without this, damaged samples would come out first.
            if (damaged := archive.zip.testzip()) is not None:
                raise ValueError(f"the checksum of {damaged} is wrong")
            found = [_other_messages(archive)]
            found += [
                _bulk_messages(layout, archive, cleanup)
                for layout in LAYOUTS
                if f"{_kind_name(layout)}_index" in archive
            ]
            for _, t_ns, payload in heapq.merge(*found, key=itemgetter(0)):
                yield decode_response(payload), None if t_ns == NO_TIME else t_ns
    except OSError as error:
        raise unreadable(path, error) from None
    except _DAMAGED as error:
        raise RecordingError(f"{path} is cut or damaged: {error}") from None


def npz_facts(path: Path) -> RecordingFacts:
    """Return the facts of an archive; RecordingError if it cannot be read."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            _check_format(path, archive)
            return RecordingFacts.from_json(json.loads(str(archive["facts"])))
    except OSError as error:
        raise unreadable(path, error) from None
    except _DAMAGED as error:
        raise RecordingError(f"{path}: its description is damaged: {error}") from None


_Found = Iterator[tuple[int, int, bytes]]  # place, time, payload


def _other_messages(archive: _Archive) -> _Found:
    payload = archive["message_payload"].tobytes()
    begin = 0
    rows = (archive[f"message_{name}"].tolist() for name in ("index", "t_ns", "end"))
    for index, t_ns, end in zip(*rows, strict=True):
        yield index, t_ns, payload[begin:end]
        begin = end


def _bulk_messages(layout: Layout, archive: _Archive, cleanup: contextlib.ExitStack) -> _Found:
    name = _kind_name(layout)
    index = archive[f"{name}_index"]
    headers = np.zeros(len(index), layout.header)
    for part in layout.header.names or ():
        headers[part] = archive[_field_name(layout, part)]
    sizes = headers[layout.count].astype(np.int64) * layout.element_bytes
    samples = cleanup.enter_context(_member(archive.zip, f"{name}_samples", "r"))
    held = _samples_bytes(samples, layout)
    if int(sizes.sum()) != held:
        raise ValueError(f"{name}_samples holds {held} bytes, not {int(sizes.sum())}")
    stamps_ns = archive[f"{name}_t_ns"]
    for place, t_ns, size, header in zip(index, stamps_ns, sizes.tolist(), headers, strict=True):
        data = samples.read(size)
        if len(data) < size:
            raise EOFError(f"{name}_samples ends too soon")
        yield int(place), int(t_ns), layout.prefix + header.tobytes() + data


def _samples_bytes(stream: IO[bytes], layout: Layout) -> int:
    """Read an array's head and return how many bytes of values follow it."""
    if read_magic(stream) != (1, 0):
        raise ValueError("its samples are of an unknown version of numpy's format")
    shape, column_major, kind = read_array_header_1_0(stream)
    if kind != np.dtype(layout.values) or (column_major and len(shape) > 1):
        raise ValueError(f"its samples are {kind}, not {layout.values} row by row")
    return math.prod(shape) * kind.itemsize


def _check_format(path: Path, archive: _Archive) -> None:
    if "format" not in archive or str(archive["format"]) != FORMAT:
        raise RecordingError(f"{path} is a numpy archive, and no recording of this program")
