"""Recording directories of the vendor's ModuleConnector: what was received, and when.

A data file holds records without separators: a message's payload without its leading codes
(Protocol reference 12). The meta file's index gives each record's time; its layout was read off
recordings with known contents.
"""

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from xethru_protocol.codec import decode_response
from xethru_protocol.codes import AppDataId, ResponseCode
from xethru_protocol.errors import XeThruError
from xethru_protocol.table import Response

META_NAME = "xethru_recording_meta.dat"
_META_MAGIC = 0xA0B1C2D3
_META_HEAD = struct.Struct("<IIq")  # magic, version, start [ms since 1970]
_META_INDEX_END = struct.Struct("<Q")  # at 0x1D: where the index ends
_META_TEXT = struct.Struct("<I")  # at 0x55: length of the session id, which the index follows
_META_ENTRY = struct.Struct("<IBIQQQ")  # ms since start, 1, data type, size, begin, end
_MS_NS = 1_000_000


class RecordingError(XeThruError):
    """A recording cannot be read."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingFault:
    """A damaged record: nothing from ``offset`` on could be read from ``file``."""

    file: str
    offset: int
    reason: str


@dataclass(frozen=True, slots=True)
class _Layout:
    """One kind of data file."""

    name: str  # what its file name begins with
    data_type: int  # bit in the meta file
    prefix: bytes  # what the payload has and the record has not
    header: int  # bytes before the elements
    count_at: int  # offset of the u32 element count
    element: int  # bytes per element


_LAYOUTS = (
    _Layout(
        "xethru_baseband_iq_",
        2,
        bytes((ResponseCode.XTS_SPR_APPDATA, AppDataId.XTS_ID_BASEBAND_IQ, 0, 0, 0)),
        24,
        4,
        8,
    ),
)


def read_recording(
    path: Path | str, on_fault: Callable[[RecordingFault], None] | None = None
) -> Iterator[tuple[Response, int | None]]:
    """Messages of a recording directory (or of one data file in it) with their times.

    Parameters
    ----------
    path
        Directory, or one of its ``xethru_baseband_iq_*.dat`` files.
    on_fault
        Called with what could not be read, after all that could; None: that raises.

    Yields
    ------
    The message, and its time [ns since 1970, resolution 1 ms], None without a usable meta file.

    Raises
    ------
    RecordingError
        If there is nothing to read, or a record is cut short and ``on_fault`` is None.
    """
    path = Path(path)
    files = _data_files(path)
    times = _record_times(files[0][0].parent / META_NAME)
    for file, layout in files:
        stamps = iter(times.get(layout.data_type, ()))
        data = _read(file)
        position = 0
        while position < len(data):
            record = _record(data, position, layout)
            if record is None:
                fault = RecordingFault(
                    file=file.name,
                    offset=position,
                    reason=f"the last record is cut: {len(data) - position} bytes of it are there",
                )
                if on_fault is None:
                    raise RecordingError(f"{file}: {fault.reason} (at byte {position})")
                on_fault(fault)
                break
            yield decode_response(layout.prefix + record), next(stamps, None)
            position += len(record)


def _data_files(path: Path) -> list[tuple[Path, _Layout]]:
    if not path.exists():
        raise RecordingError(f"there is no recording {path}")
    candidates = sorted(path.iterdir()) if path.is_dir() else [path]
    files = [
        (file, layout)
        for layout in _LAYOUTS
        for file in candidates
        if file.name.startswith(layout.name) and file.suffix == ".dat"
    ]
    if not files:
        wanted = " or ".join(f"{layout.name}*.dat" for layout in _LAYOUTS)
        raise RecordingError(f"{path} holds no recording this can read; it needs a file {wanted}")
    return files


def _record(data: bytes, position: int, layout: _Layout) -> bytes | None:
    if position + layout.header > len(data):
        return None
    (count,) = struct.unpack_from("<I", data, position + layout.count_at)
    end = position + layout.header + count * layout.element
    return data[position:end] if end <= len(data) else None


def _record_times(meta: Path) -> dict[int, list[int]]:
    """Read the records' times [ns since 1970] by data type; empty without a usable meta."""
    if not meta.is_file():
        return {}
    data = _read(meta)
    times: dict[int, list[int]] = {}
    try:
        magic, _, start_ms = _META_HEAD.unpack_from(data, 0)
        (index_end,) = _META_INDEX_END.unpack_from(data, 0x1D)
        (text,) = _META_TEXT.unpack_from(data, 0x55)
    except struct.error:
        return {}
    if magic != _META_MAGIC:
        return {}
    position = 0x59 + text
    while position + _META_ENTRY.size <= min(index_end, len(data)):
        since_ms, _, data_type, size, _, _ = _META_ENTRY.unpack_from(data, position)
        if size:  # the closing entry has none
            times.setdefault(data_type, []).append((start_ms + since_ms) * _MS_NS)
        position += _META_ENTRY.size
    return times


def _read(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        raise RecordingError(f"{file} cannot be read: {error.strerror}") from None
