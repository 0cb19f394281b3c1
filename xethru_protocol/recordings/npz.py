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
payload decides). ``facts`` is what the recording says about itself, as JSON.

An archive that was cut cannot be read at all: it is for finished recordings.
"""

import json
import os
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from xethru_protocol.codec import decode_response, describe, encode
from xethru_protocol.recordings.errors import RecordingError, unreadable, unwritable
from xethru_protocol.recordings.layouts import LAYOUTS, Layout, layout_of
from xethru_protocol.recordings.records import RecordingFacts, Timed, TimedMessages

FORMAT = "xethru-hil recording 1"
SUFFIX = ".npz"
NO_TIME = np.iinfo(np.int64).min
"""Stands for an unknown time."""

_Arrays = dict[str, npt.NDArray[Any]]
_FRAME_NAMES = {"info": "counter", "length": "bins"}


def _kind_name(layout: Layout) -> str:
    name = layout.file_prefix.removeprefix("xethru_").removesuffix("_")
    return {"datafloat": "frame", "databyte": "data_byte"}.get(name, name)


def _field_name(layout: Layout, name: str) -> str:
    names = _FRAME_NAMES if _kind_name(layout) == "frame" else {}
    return f"{_kind_name(layout)}_{names.get(name, name)}"


@dataclass(slots=True)
class _Gathered:
    """Messages of one kind while they are gathered."""

    index: list[int] = field(default_factory=list)
    t_ns: list[int] = field(default_factory=list)
    records: list[bytes] = field(default_factory=list)

    def add(self, index: int, t_ns: int | None, record: bytes) -> None:
        self.index.append(index)
        self.t_ns.append(NO_TIME if t_ns is None else t_ns)
        self.records.append(record)


def write_npz(path: Path, messages: Iterable[Timed], facts: RecordingFacts) -> None:
    """Write messages to a new archive; all of them are held in memory meanwhile.

    Raises
    ------
    RecordingError
        If the file exists or cannot be written; then it is not left behind.
    """
    bulk: dict[int, _Gathered] = {}
    others = _Gathered()
    names: list[str] = []
    fields: list[str] = []
    for index, (message, t_ns) in enumerate(messages):
        payload = encode(message, bulk=True)
        layout = layout_of(payload)
        if layout is not None:
            record = payload[len(layout.prefix) :]
            bulk.setdefault(layout.data_type, _Gathered()).add(index, t_ns, record)
        else:
            others.add(index, t_ns, encode(message))
            name, shown = describe(message)
            names.append(name)
            fields.append(json.dumps(shown))
    arrays: _Arrays = {
        "format": np.array(FORMAT),
        "facts": np.array(json.dumps(facts.as_json())),
        "message_index": np.array(others.index, np.int64),
        "message_t_ns": np.array(others.t_ns, np.int64),
        "message_end": np.cumsum([len(record) for record in others.records], dtype=np.int64),
        "message_payload": np.frombuffer(b"".join(others.records), np.uint8),
        "message_name": np.array(names, dtype=np.str_),
        "message_fields": np.array(fields, dtype=np.str_),
    }
    for layout in LAYOUTS:
        if layout.data_type in bulk:
            arrays |= _bulk_arrays(layout, bulk[layout.data_type])
    _save(path, arrays)


def _bulk_arrays(layout: Layout, gathered: _Gathered) -> _Arrays:
    size = layout.header.itemsize
    headers = np.frombuffer(b"".join(record[:size] for record in gathered.records), layout.header)
    values = np.frombuffer(b"".join(record[size:] for record in gathered.records), layout.values)
    counts = set(headers[layout.count].tolist())
    if len(counts) == 1:
        columns = (layout.columns,) if layout.columns > 1 else ()
        values = values.reshape(len(headers), *columns, counts.pop())
    name = _kind_name(layout)
    return {
        f"{name}_index": np.array(gathered.index, np.int64),
        f"{name}_t_ns": np.array(gathered.t_ns, np.int64),
        f"{name}_samples": values,
    } | {_field_name(layout, part): headers[part] for part in layout.header.names or ()}


def _save(path: Path, arrays: dict[str, Any]) -> None:
    if path.exists():
        raise RecordingError(f"{path} exists already")
    partial = path.with_name(path.name + ".part")
    try:
        with partial.open("wb") as stream:
            np.savez_compressed(stream, **arrays)
        os.replace(partial, path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise unwritable(path, error) from None


def read_npz(path: Path) -> TimedMessages:
    """Messages of an archive of this module, in their order.

    Raises
    ------
    RecordingError
        If the file is cut, damaged or not of this kind.
    """
    arrays = _load(path)
    try:
        found = list(_other_messages(arrays))
        for layout in LAYOUTS:
            if f"{_kind_name(layout)}_index" in arrays:
                found += _bulk_messages(layout, arrays)
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise RecordingError(f"{path}: its arrays do not fit together: {error}") from None
    found.sort(key=lambda item: item[0])
    for _, t_ns, payload in found:
        yield decode_response(payload), None if t_ns == NO_TIME else t_ns


def npz_facts(path: Path) -> RecordingFacts:
    """Return what an archive says about itself; RecordingError if it cannot be read."""
    try:
        return RecordingFacts.from_json(json.loads(str(_load(path, only="facts")["facts"])))
    except (KeyError, ValueError, TypeError, RecursionError) as error:
        raise RecordingError(f"{path}: what it says about itself is damaged: {error}") from None


_Found = Iterator[tuple[int, int, bytes]]  # place, time, payload


def _other_messages(arrays: _Arrays) -> _Found:
    payload = arrays["message_payload"].tobytes()
    begin = 0
    rows = (arrays[f"message_{name}"].tolist() for name in ("index", "t_ns", "end"))
    for index, t_ns, end in zip(*rows, strict=True):
        yield index, t_ns, payload[begin:end]
        begin = end


def _bulk_messages(layout: Layout, arrays: _Arrays) -> _Found:
    name = _kind_name(layout)
    index = arrays[f"{name}_index"].tolist()
    headers = np.zeros(len(index), layout.header)
    for part in layout.header.names or ():
        headers[part] = arrays[_field_name(layout, part)]
    sizes = headers[layout.count].astype(np.int64) * layout.element_bytes
    values = np.ascontiguousarray(arrays[f"{name}_samples"], layout.values).tobytes()
    if int(sizes.sum()) != len(values):
        raise ValueError(f"{name}_samples holds {len(values)} bytes, not {int(sizes.sum())}")
    begin = 0
    rows = (index, arrays[f"{name}_t_ns"].tolist(), sizes.tolist(), headers)
    for place, t_ns, size, header in zip(*rows, strict=True):
        yield place, t_ns, layout.prefix + header.tobytes() + values[begin : begin + size]
        begin += size


def _load(path: Path, only: str | None = None) -> _Arrays:
    try:
        with np.load(path, allow_pickle=False) as archive:
            if "format" not in archive or str(archive["format"]) != FORMAT:
                raise RecordingError(f"{path} is a numpy archive, and no recording of this program")
            return {name: archive[name] for name in archive.files if only in (None, name)}
    except OSError as error:
        raise unreadable(path, error) from None
    except (zipfile.BadZipFile, zlib.error, EOFError, ValueError, KeyError) as error:
        raise RecordingError(f"{path} is cut or damaged: {error}") from None
