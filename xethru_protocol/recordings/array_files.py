"""Files of plain arrays: frames of one radar as ``.csv``, ``.mat`` (MATLAB 5) and ``.npz``.

``.mat`` and ``.npz`` have the variables::

    iq or rf       (n, bins)  complex64 or float32     t_ns           (n,)     int64, ns since 1970
    ranges_m       (bins,)    float64, module metres   counter        (n,)     uint32
    frame_rate_hz             float64                  settings       by their names in X4Setting

What is unknown is left out; ``settings`` is JSON text in ``.npz`` and a struct in MATLAB, where
vectors are columns.

A ``.csv`` file has a line of titles and a line for each frame: ``t_ns``, ``counter``, ``time_s``
(since the first frame, for reading; not read back), then ``rf_<range>``, or all ``i_<range>`` and
then all ``q_<range>``. The range is in module metres with its unit, ``i_0.4m``, or the number of
the bin, ``i_0``, where ranges are unknown. Numbers have as many digits as it takes to read the same
float32 back, those of ranges end at a micrometre. The settings are left out.

Other files with these variables or columns are read, too, and by their content, whatever their
names: ``.npy`` of shape (n, bins), of complex numbers or of values as sent, and lines of complex
numbers as numpy, Python and MATLAB write them, a frame in each. Only this file loads scipy, for
``.mat``.
"""

import csv
import itertools
import json
import math
import re
import struct
import zipfile
import zlib
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np
import numpy.typing as npt
from numpy.lib.format import (
    read_array_header_1_0,
    read_array_header_2_0,
    read_magic,
    write_array,
    write_array_header_1_0,
)

from xethru_protocol.driver.frames import complex_of
from xethru_protocol.operating_system import written_whole
from xethru_protocol.recordings.clock import steady_times
from xethru_protocol.recordings.frame_layout import FrameLayout, FrameLayouts
from xethru_protocol.recordings.recorded_messages import (
    NO_TIME_NS,
    FaultHandler,
    RecordingError,
    RecordingFault,
    format_by_magic,
    optional_packages,
    reading,
    report,
    writing,
)
from xethru_protocol.recordings.vendor.layouts import kind_of_file
from xethru_protocol.recordings.vendor.reader import is_vendor_file
from xethru_protocol.validation import reason_of, shown
from xethru_protocol.wire.messages import DataFloat

Samples = npt.NDArray[Any]
"""In the dtype of their kind."""
FrameKind = Literal["rf", "iq"]
Settings = Mapping[str, Any]
DTYPES: Mapping[FrameKind, np.dtype[Any]] = {
    "rf": np.dtype(np.float32),
    "iq": np.dtype(np.complex64),
}
SUFFIXES = (".csv", ".mat", ".npz")
_TEXT = ".txt"  # of complex numbers
_LONGEST_START = 1 << 16  # bytes; a line of numbers is shorter
_AT_ONCE = 256  # frames of a file that are read together
_LINES_AT_ONCE = 8  # a number as text is ten times as large


@dataclass(frozen=True, slots=True, kw_only=True)
class Frames:
    """Frames of one layout, not read yet.

    Attributes
    ----------
    about
        What they are, for people.
    kind
        None where it is not known.
    chunks
        Reads them from the first on: arrays of shape (k, n_bins) in the dtype of ``kind``.
    n_frames, n_bins
        ``n_bins`` is the number of values where ``kind`` is not known.
    counter
        Shape (n_frames,); None if unknown.
    t_ns
        Shape (n_frames,), ns since 1970; None if no time is known.
    ranges_m
        Shape (n_bins,) [module metres]; None if unknown.
    frame_rate_hz
        Of the settings; None if unknown.
    inferred
        Whether ``kind`` is a conclusion from the samples.
    """

    about: str
    kind: FrameKind | None
    chunks: Callable[[], Iterator[Samples]]
    n_frames: int
    n_bins: int
    counter: npt.NDArray[np.uint32] | None
    t_ns: npt.NDArray[np.int64] | None
    ranges_m: npt.NDArray[np.float64] | None
    frame_rate_hz: float | None
    settings: Settings
    inferred: bool = False


_NUMBERS: Mapping[FrameKind, str] = {"rf": "real numbers", "iq": "numbers"}
_DAMAGED = (
    *(zipfile.BadZipFile, zlib.error, EOFError, ValueError, KeyError, TypeError, IndexError),
    *(csv.Error, OverflowError, struct.error, MemoryError, RuntimeError),
)


def is_array_file(path: Path) -> bool:
    """Whether a file holds arrays and no messages."""
    return bool(_format_of(path))


def _format_of(path: Path) -> str:
    """Return the suffix of a format of arrays, by content or else by name; "" for other files."""
    if not path.is_file() or kind_of_file(path.name) is not None:
        return ""
    with reading(path), path.open("rb") as stream:
        start = stream.read(_LONGEST_START)
    lines = (line.strip().decode("latin-1") for line in start.splitlines())
    line = next((line for line in lines if line and not line.startswith("#")), "")
    found = format_by_magic(start)
    if found in (".npy", ".npz", ".mat"):
        return found
    if found is not None or is_vendor_file(path):
        return ""
    return _TEXT if _complex_row(line) else path.suffix if path.suffix in SUFFIXES else ""


def read_array_file(
    path: Path, on_fault: FaultHandler | None = None, *, downconversion: bool | None = None
) -> Frames:
    """Return what a file of arrays holds; its samples are read by ``chunks``, of ``.mat`` at once.

    Times do not fall: where the recorder's clock was set back, the counter tells how much later
    they are. That is reported, and so are lines of ``.csv`` that are damaged and left out.
    RecordingError if it cannot be read, or lacks ``iq`` and ``rf``.
    """

    def note(reason: str, *, minor: bool = False) -> None:
        report(RecordingFault(file=path.name, offset=0, reason=reason, minor=minor), on_fault)

    def note_time(number: int, text: str) -> None:
        note(f"frame {number}: {text}", minor=True)

    with _naming(path):
        match _format_of(path):
            case ".csv":
                frames = _read_csv(path, note)
            case ".mat":
                frames = _read_mat(path)
            case ".npz":
                frames = _read_npz(path)
            case ".npy":
                frames = _read_npy(path, downconversion)
            case _:
                frames = _read_text(path, note)
    if frames.t_ns is None:
        return frames
    counters: Iterable[tuple[str, int] | None] = itertools.repeat(None)
    if frames.counter is not None:
        counters = (("frame", int(count)) for count in frames.counter)
    return replace(frames, t_ns=steady_times(frames.t_ns, counters, note_time))


def write_array_file(path: Path, frames: Frames) -> None:
    """Write a new file in the format of its suffix; RecordingError if it cannot be written.

    ``.mat`` needs as much memory as the samples take, the others none.
    """
    if frames.kind is None:
        raise RecordingError(
            f"{frames.about} may be RF or complex baseband; say which: --frames rf or baseband, in "
            "Python downconversion="
        )
    with writing(path), written_whole(path) as fresh:
        match path.suffix:
            case ".csv":
                _write_csv(fresh, frames, frames.kind)
            case ".mat":
                _write_mat(fresh, frames, frames.kind, path)
            case _:
                _write_npz(fresh, frames, frames.kind)


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    try:
        with reading(path):
            yield
    except _DAMAGED as error:
        text = " ".join(reason_of(error).split())
        raise RecordingError(f"{path} cannot be read as arrays: {text}") from None


def _frames(
    path: Path,
    kind: FrameKind,
    shape: tuple[int, ...],
    dtype: np.dtype[Any],
    *,
    chunks: Callable[[], Iterator[Samples]],
    beside: Mapping[str, Any],
    settings: Settings | None = None,
) -> Frames:
    """Check the variables ``beside`` the samples of ``shape``; ValueError for wrong ones."""
    if len(shape) != 2 or (shape[0] > 0 and shape[1] == 0):
        raise ValueError(f"{kind} has shape {shape}, must have (n_frames, n_bins)")
    if dtype.kind not in ("fciub" if kind == "iq" else "fiub"):
        raise ValueError(f"{kind} holds {dtype}, must hold {_NUMBERS[kind]}")

    def vector(name: str, length: int, dtype: Any) -> npt.NDArray[Any] | None:  # noqa: ANN401 - as numpy names types
        values = beside.get(name)
        if values is None or np.size(values) == 0 != length:
            return None
        values = np.ravel(values)
        if len(values) != length:
            raise ValueError(f"{name} has {len(values)} values, must have {length}")
        if values.dtype.kind == "f" and dtype == np.int64:
            values = np.where(np.isfinite(values), values, NO_TIME_NS)
        if values.dtype.kind == "c":
            raise ValueError(f"{name} holds complex numbers, must hold real ones")
        if values.dtype.kind in "fiu" and dtype != np.float64 and length:
            least, most = np.iinfo(dtype).min, np.iinfo(dtype).max
            is_finite = bool(np.isfinite(values).all())
            if not is_finite or int(values.min()) < least or int(values.max()) > most:
                raise ValueError(f"{name} must hold numbers from {least} to {most}")
        return values.astype(dtype)

    rate_hz = vector("frame_rate_hz", 1, np.float64)
    if rate_hz is not None and not 0 < rate_hz[0] < np.inf:
        raise ValueError(f"frame_rate_hz is {rate_hz[0]:g}, must be above 0, or left out")
    what = {"rf": "RF bins", "iq": "complex bins"}[kind]

    def checked() -> Iterator[Samples]:
        with _naming(path):
            yield from chunks()

    return Frames(
        about=f"{shape[1]} {what} ({path.suffix or path.name})",
        kind=kind,
        chunks=checked,
        n_frames=shape[0],
        n_bins=shape[1],
        counter=vector("counter", shape[0], np.uint32),
        t_ns=vector("t_ns", shape[0], np.int64),
        ranges_m=vector("ranges_m", shape[1], np.float64),
        frame_rate_hz=None if rate_hz is None else float(rate_hz[0]),
        settings=settings or {},
    )


def _kind_in(names: Iterable[str]) -> FrameKind:
    held = set(names)
    if "iq" in held:
        return "iq"
    if "rf" in held:
        return "rf"
    found = ", ".join(sorted(name for name in held if not name.startswith("__"))) or "nothing"
    raise ValueError(f"it holds {found}, and neither iq nor rf")


def _beside(frames: Frames) -> dict[str, npt.NDArray[Any]]:
    """Return the known arrays beside the samples, by name."""
    known = {name: getattr(frames, name) for name in _VECTORS}
    return {name: np.asarray(values) for name, values in known.items() if values is not None}


# --- .npz ---------------------------------------------------------------------------------------


def _write_npz(fresh: Path, frames: Frames, kind: FrameKind) -> None:
    """Write the archive, a part of the samples at a time."""
    dtype = DTYPES[kind].newbyteorder("<")
    about = {
        "descr": dtype.str,
        "fortran_order": False,
        "shape": (frames.n_frames, frames.n_bins),
    }
    settings = np.array(json.dumps(dict(frames.settings)))
    with zipfile.ZipFile(fresh, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, values in (_beside(frames) | {"settings": settings}).items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
                write_array(stream, np.asarray(values), allow_pickle=False)
        with archive.open(f"{kind}.npy", "w", force_zip64=True) as stream:
            write_array_header_1_0(stream, about)
            for chunk in frames.chunks():
                stream.write(np.ascontiguousarray(chunk, dtype).tobytes())


def _read_npz(path: Path) -> Frames:
    with path.open("rb") as opened, np.load(opened, allow_pickle=False) as archive:
        if "message_payload" in archive.files and not {"iq", "rf"} & {*archive.files}:
            raise RecordingError(
                f"{path} holds messages, which are kept in .mcap now; convert it to that with"
                " the version that wrote it"
            )
        kind = _kind_in(archive.files)
        shape, dtype = _declared(archive.zip, kind)
        names = [name for name in (*_VECTORS, "settings") if name in archive.files]
        for name in names:  # before it is unpacked, which may take more memory than there is
            room = _LONGEST_SETTINGS if name == "settings" else 8 * max(*shape[:2], 2)
            length, of = _declared(archive.zip, name)
            if math.prod(length) * of.itemsize > 4 * room:
                raise ValueError(f"{name} has shape {length}, which does not fit {kind} of {shape}")
        beside = {name: archive[name] for name in names if name != "settings"}
        settings = json.loads(str(archive["settings"])) if "settings" in names else {}
    if not isinstance(settings, dict):
        raise ValueError("its settings are not a table")
    settings = {
        name: tuple(value) if isinstance(value, list) else value for name, value in settings.items()
    }
    chunks = partial(_npz_chunks, path, kind)
    return _frames(path, kind, shape, dtype, chunks=chunks, beside=beside, settings=settings)


_VECTORS = ("t_ns", "counter", "ranges_m", "frame_rate_hz")
_LONGEST_SETTINGS = 1 << 20


def _declared(archive: zipfile.ZipFile, name: str) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Return shape and type of an array by its head; ValueError if the archive has less or more."""
    member = archive.getinfo(f"{name}.npy")
    with archive.open(member) as stream:
        shape, _, dtype = _header(stream)
        held = member.file_size - stream.tell()
    shape = tuple(map(int, shape))
    if dtype.hasobject:
        raise ValueError(f"{name} holds objects of Python, must hold numbers")
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != held:
        raise ValueError(f"{name} has {held} bytes, which do not fit its shape {shape}")
    return shape, dtype


def _header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    version = read_magic(stream)
    read = read_array_header_1_0 if version == (1, 0) else read_array_header_2_0
    return read(stream)


def _npz_chunks(path: Path, kind: FrameKind) -> Iterator[Samples]:
    with path.open("rb") as opened, np.load(opened, allow_pickle=False) as archive:
        with archive.zip.open(f"{kind}.npy") as stream:
            (n_frames, n_bins), in_columns, dtype = _header(stream)
            if not in_columns:
                row_bytes = max(n_bins * dtype.itemsize, 1)
                for begin in range(0, n_frames, _AT_ONCE):
                    n_rows = min(_AT_ONCE, n_frames - begin)
                    data = stream.read(n_rows * row_bytes) if n_bins else b""
                    rows = np.frombuffer(data, dtype).reshape(n_rows, n_bins)
                    yield rows.astype(DTYPES[kind])
                return
        yield archive[kind].astype(DTYPES[kind])


def _read_npy(path: Path, downconversion: bool | None) -> Frames:
    values = np.load(path, mmap_mode="r", allow_pickle=False)
    if values.ndim != 2 or values.dtype.kind not in "fciu":
        raise ValueError(f"it holds {values.dtype} of shape {values.shape}, not frames x bins")
    kind: FrameKind | None = "iq"
    inferred = False
    n_bins = values.shape[1]
    if values.dtype.kind != "c":
        layouts = FrameLayouts(downconversion)
        for row in values[:_AT_ONCE]:
            layouts.take(DataFloat(info=0, values=row.astype(np.float32)))
        layout = layouts.layouts().get(n_bins, FrameLayout(values=n_bins, downconversion=False))
        kind = None if layout.downconversion is None else "iq" if layout.downconversion else "rf"
        inferred = layout.inferred
        n_bins = layout.bins or n_bins

    def chunks() -> Iterator[Samples]:
        for begin in range(0, len(values), _AT_ONCE):
            rows = values[begin : begin + _AT_ONCE]
            if kind == "iq" and values.dtype.kind != "c":
                rows = complex_of(*np.split(rows.astype(np.float32), 2, axis=1))
            yield rows.astype(DTYPES[kind or "rf"])

    shape = len(values), n_bins
    frames = _frames(path, kind or "rf", shape, np.dtype("f4"), chunks=chunks, beside={})
    return replace(frames, kind=kind, inferred=inferred)


# --- .mat ---------------------------------------------------------------------------------------

_LARGEST_MAT = 2**31  # bytes of a variable: the format counts them in 32 bits, with a sign


def _write_mat(fresh: Path, frames: Frames, kind: FrameKind, path: Path) -> None:
    with optional_packages("a .mat file needs a package that is optional"):
        from scipy.io import savemat

    size = frames.n_frames * frames.n_bins * DTYPES[kind].itemsize
    if size >= _LARGEST_MAT:
        raise RecordingError(
            f"{path}: {size * 1e-9:.1f} GB of samples, and a .mat file of version 5 has room for "
            "2.1 GB; convert to .npz"
        )
    samples = np.empty((frames.n_frames, frames.n_bins), DTYPES[kind])
    row = 0
    for chunk in frames.chunks():
        samples[row : row + len(chunk)] = chunk
        row += len(chunk)
    variables: dict[str, Any] = {kind: samples, **_beside(frames)}
    if frames.settings:
        variables["settings"] = {
            name: np.array(value, np.float64) for name, value in frames.settings.items()
        }
    with fresh.open("wb") as stream:
        # takes files, the stubs know names
        savemat(stream, variables, oned_as="column")  # type: ignore[arg-type]  # its stubs know no stream


_MAT_HEAD = 128
_MATRIX, _COMPRESSED = 14, 15
_MAT_TYPES = frozenset(range(1, 19)) - {8, 10, 11}


def _check_mat(path: Path) -> None:
    """Raise ValueError for elements of unknown types or sizes, at which scipy would crash."""
    with path.open("rb") as stream:
        head = stream.read(_MAT_HEAD)
    order = {b"IM": "<", b"MI": ">"}.get(head[126:])
    if order is not None and head[125 if order == "<" else 124] == 1:  # version 5
        _check_elements(np.memmap(path, np.uint8, "r", _MAT_HEAD).data, order)


def _check_elements(data: memoryview, order: str) -> None:
    at = 0
    while at < len(data):
        kind, size = struct.unpack_from(f"{order}II", data, at)
        if kind >> 16:  # of up to four bytes, which stand in the place of the size
            kind, size, begin, end = kind & 0xFFFF, kind >> 16, at + 4, at + 8
        else:
            begin = at + 8
            end = begin + size + (0 if kind == _COMPRESSED else -size % 8)
        if kind not in _MAT_TYPES or begin + size > min(end, len(data)):
            raise ValueError(f"an element is damaged at byte {at}")
        content = data[begin : begin + size]
        if kind == _MATRIX:
            _check_elements(content, order)
        elif kind == _COMPRESSED:
            _check_elements(memoryview(zlib.decompress(content)), order)
        at = end


def _read_mat(path: Path) -> Frames:
    with optional_packages("a .mat file needs a package that is optional"):
        from scipy.io import loadmat

    _check_mat(path)
    try:
        with path.open("rb") as stream:
            found = loadmat(stream)  # type: ignore[arg-type]  # as above
    except NotImplementedError:
        raise RecordingError(
            f"{path} is a MATLAB file of version 7.3; in MATLAB, save it with '-v7'"
        ) from None
    except OSError:
        raise
    except Exception as error:  # scipy documents no exceptions for damaged files
        raise ValueError(f"no MATLAB file, or a damaged one: {reason_of(error)}") from None
    kind = _kind_in(found)
    samples = np.asarray(found[kind])
    settings = found.get("settings")
    table: dict[str, Any] = {}
    for name in (settings.dtype.names or ()) if isinstance(settings, np.ndarray) else ():
        values = np.ravel(np.asarray(settings)[name].flat[0]).tolist()
        values = [int(value) if float(value).is_integer() else value for value in values]
        table[name] = values[0] if len(values) == 1 else tuple(values)

    def chunks() -> Iterator[Samples]:
        yield samples.astype(DTYPES[kind])

    return _frames(
        path, kind, samples.shape, samples.dtype, chunks=chunks, beside=found, settings=table
    )


# --- .csv ---------------------------------------------------------------------------------------

_TITLE = re.compile(r"(rf|i|q)_(?:([-+.\deE]+)m|(\d+))")


def _write_csv(fresh: Path, frames: Frames, kind: FrameKind) -> None:
    titles = [str(at) for at in range(frames.n_bins)]
    if frames.ranges_m is not None:
        titles = [
            f"{np.format_float_positional(range_m, 6, trim='-')}m" for range_m in frames.ranges_m
        ]
    parts = ("i", "q") if kind == "iq" else ("rf",)
    front = [name for name in ("t_ns", "counter") if getattr(frames, name) is not None]
    stamps = itertools.repeat(None) if frames.t_ns is None else frames.t_ns.tolist()
    counts = itertools.repeat(None) if frames.counter is None else frames.counter.tolist()
    if frames.t_ns is not None:
        front.append("time_s")
    rows = zip(stamps, counts, (row for chunk in frames.chunks() for row in chunk), strict=False)
    with fresh.open("w", encoding="utf-8", newline="\n") as stream:
        columns = [f"{part}_{title}" for part in parts for title in titles]
        stream.write(",".join([*front, *columns]) + "\n")
        first_ns = None
        for t_ns, counter, row in itertools.islice(rows, frames.n_frames):
            cells = []
            is_known = t_ns is not None and t_ns != NO_TIME_NS
            if frames.t_ns is not None:
                cells.append(str(t_ns) if is_known else "")
            if counter is not None:
                cells.append(str(counter))
            if frames.t_ns is not None:
                first_ns = t_ns if first_ns is None and is_known else first_ns
                cells.append(_seconds(t_ns - first_ns) if is_known else "")
            halves = (row.real, row.imag) if kind == "iq" else (row,)
            for half in halves:
                cells += half.astype(str).tolist()
            stream.write(",".join(cells) + "\n")


def _seconds(t_ns: int) -> str:
    """Write a time exactly.

    >>> _seconds(-1_500_000_000), _seconds(1)
    ('-1.500000000', '0.000000001')
    """
    seconds, rest = divmod(abs(t_ns), 10**9)
    return f"{'-' if t_ns < 0 else ''}{seconds}.{rest:09}"


def _read_csv(path: Path, note: Callable[[str], None]) -> Frames:
    damaged: set[int] = set()  # lines
    with _csv_rows(path) as rows:
        _, titles = next(rows, (1, []))
        columns: dict[str, list[int]] = {"rf": [], "i": [], "q": []}
        ranges: dict[str, list[str | None]] = {"rf": [], "i": [], "q": []}
        for at, title in enumerate(titles):
            if found := _TITLE.fullmatch(title):
                columns[found[1]].append(at)
                ranges[found[1]].append(found[2])
        kind: FrameKind = "rf" if columns["rf"] else "iq"
        part = "rf" if columns["rf"] else "i"
        if not columns[part] or (kind == "iq" and ranges["i"] != ranges["q"]):
            raise ValueError(
                f"its first line is {shown(','.join(titles))}; it must have columns rf_0, rf_1 ... "
                "or i_0 ... q_0 ..., or with ranges i_0.4m ..."
            )
        places = {name: titles.index(name) for name in ("t_ns", "counter") if name in titles}
        vectors = {name: array("q") for name in places}
        wanted = columns["rf"] or columns["i"] + columns["q"]
        n_frames = 0
        for number, row in rows:
            try:
                if len(row) != len(titles):
                    raise ValueError(f"it has {len(row)} cells, the first {len(titles)}")
                array("f", (float(row[at]) for at in wanted))
                cells = {name: row[at] for name, at in places.items()}
                if not cells.get("t_ns", "0"):
                    cells["t_ns"] = str(NO_TIME_NS)
                numbers = array("q", map(int, cells.values()))
            except (ValueError, OverflowError) as error:
                note(f"line {number} cannot be read: {reason_of(error)}")
                damaged.add(number)
                continue
            n_frames += 1
            for vector, value in zip(vectors.values(), numbers, strict=True):
                vector.append(value)
    beside: dict[str, Any] = {name: np.array(vectors[name], np.int64) for name in vectors}
    known = [text for text in ranges[part] if text is not None]
    if len(known) == len(columns[part]):
        beside["ranges_m"] = np.array([float(text) for text in known])
    n_bins = len(columns[part])

    def chunks() -> Iterator[Samples]:
        with _csv_rows(path) as rows:
            next(rows)
            whole = (row for number, row in rows if number not in damaged)
            while several := list(itertools.islice(whole, _LINES_AT_ONCE)):
                cells = [[row[at] for at in wanted] for row in several]
                values = np.array(cells, dtype="U").astype(np.float32)
                yield values if kind == "rf" else complex_of(*np.split(values, 2, axis=1))

    return _frames(path, kind, (n_frames, n_bins), DTYPES[kind], chunks=chunks, beside=beside)


# --- lines of complex numbers -------------------------------------------------------------------

_BETWEEN = re.compile(r"[,;\s]+")
_IMAGINARY = re.compile(r"[\d.][ij]$")


def _complex_row(line: str) -> list[complex] | None:
    """Return the numbers of a line, one of which has an imaginary part; None for another line.

    >>> _complex_row("(1+-2j), 3i"), _complex_row("1, 2"), _complex_row("# a+bj")
    ([(1-2j), 3j], None, None)
    """
    cells = [cell.strip("()[]") for cell in _BETWEEN.split(line.strip())]
    if not any(_IMAGINARY.search(cell) for cell in cells):
        return None
    try:
        return [complex(re.sub("i$", "j", cell.replace("+-", "-"))) for cell in cells if cell]
    except ValueError:
        return None


def _read_text(path: Path, note: Callable[[str], None]) -> Frames:
    def rows(report_line: Callable[[str], None]) -> Iterator[list[complex]]:
        n_bins = 0
        with path.open(encoding="latin-1") as stream:
            for number, line in enumerate(stream, start=1):
                row = _complex_row(line)
                n_bins = n_bins or len(row or ())
                if row is not None and len(row) == n_bins:
                    yield row
                elif line.strip() and not line.lstrip().startswith("#"):
                    report_line(f"line {number} is not {n_bins} complex numbers")

    lengths = [len(row) for row in rows(note)]

    def chunks() -> Iterator[Samples]:
        for row in rows(lambda reason: None):
            yield np.array([row], np.complex64)

    shape = len(lengths), max(lengths, default=0)
    return _frames(path, "iq", shape, DTYPES["iq"], chunks=chunks, beside={})


@contextmanager
def _csv_rows(path: Path) -> Iterator[Iterator[tuple[int, list[str]]]]:
    """Read lines, each with its number from 1; empty ones are left out."""
    with path.open(encoding="utf-8-sig", newline="", errors="replace") as stream:
        # line by line: a quotation mark that damage made must not take the next ones
        rows = enumerate((next(csv.reader([line]), []) for line in stream), start=1)
        yield (numbered for numbered in rows if numbered[1])
