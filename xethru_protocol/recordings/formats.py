"""Every kind of recording: which kind a path is, its messages, its summary."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from xethru_protocol.recordings import wire_capture
from xethru_protocol.recordings.array_files import is_array_file
from xethru_protocol.recordings.clock import steady
from xethru_protocol.recordings.frame_layout import FrameLayout, FrameLayouts
from xethru_protocol.recordings.recorded_messages import (
    FaultHandler,
    RecordingContent,
    RecordingError,
    RecordingFacts,
    RecordingFault,
    TimedMessages,
    format_by_magic,
    optional_packages,
    reading,
)
from xethru_protocol.recordings.vendor.layouts import PARAMETER_FILE_NAME
from xethru_protocol.recordings.vendor.reader import (
    is_vendor_file,
    read_vendor,
    vendor_about,
    vendor_facts,
)
from xethru_protocol.wire.table import ROWS, Response, UnknownMessage

RecordingFormat = Literal["vendor", "wire", "mcap"]


def message_name(message: Response) -> str:
    """Name of a message as in dumps, for example ``"DATA FLOAT"``."""
    return "UNKNOWN" if isinstance(message, UnknownMessage) else ROWS[type(message)].name


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingSummary:
    """What a recording holds.

    ``start_ns`` is the time of the first message [ns since 1970], ``duration_ns`` lasts from there
    to the last; both are None without times. ``messages`` counts each kind by name, ``size_bytes``
    is of all files, ``parameter_file`` the name of the stored one, ``frames`` what the DATA FLOAT
    messages of radar frames hold, by their number of values.
    """

    path: Path
    format: RecordingFormat
    start_ns: int | None
    duration_ns: int | None
    messages: dict[str, int]
    size_bytes: int
    session_id: str
    profile_id: int | None
    parameter_file: str | None
    frames: dict[int, FrameLayout]
    faults: tuple[RecordingFault, ...]


def recording_format(path: Path | str) -> RecordingFormat:
    """Return the format of a recording; RecordingError if there is nothing that this can read."""
    path = Path(path)
    with reading(path):
        if not path.exists():
            raise RecordingError(f"there is no recording {path}")
        if path.is_dir() or is_vendor_file(path):
            return "vendor"
        if path.is_char_device():
            raise RecordingError(f"{path} is a port, not a recording; name it with --port")
        if not path.is_file():  # a pipe would be waited for
            raise RecordingError(f"{path} is not a file; a recording is read from files only")
        with path.open("rb") as stream:
            found = format_by_magic(stream.read(16))
    if found in ("mcap", "wire"):
        return found
    if is_array_file(path):
        raise RecordingError(
            f"{path} is read for arrays only, by xethru_protocol.load and 'xethru convert';"
            f" messages are kept in .mcap"
        )
    if found == "rerun":
        raise RecordingError(f"{path} is a view in Rerun's format; 'uwb-slam view' opens it")
    raise RecordingError(
        f"{path} is not a recording: those are .mcap, .xtwire, arrays (.npz, .npy, .mat, .csv), and"
        " directories or files of ModuleConnector, such as xethru_datafloat_*.dat"
    )


def read_recording(
    path: Path | str, on_fault: FaultHandler | None = None, *, radar: str | None = None
) -> TimedMessages:
    """Yield the messages of a recording with their times [ns since 1970], None where unknown.

    Times of vendor directories have a resolution of 1 ms. Those of one kind of message do not
    fall: where the recorder's clock was set back, the frame counter tells how much later they are.
    RecordingError if there is nothing to read, or messages are lost and ``on_fault`` is None.

    Parameters
    ----------
    path
        A directory of ModuleConnector, its meta file or one data file in it; a wire capture
        (`WireCapture`) or an MCAP file.
    on_fault
        Called with what could not be read; the rest is read all the same. None: what costs
        messages raises, what costs only times passes.
    radar
        Which radar's, by its name in `recording_content`; needed where there are several.
    """
    path = Path(path)
    found = recording_format(path)
    if found != "mcap":
        refuse_name(path, radar)
    match found:
        case "wire":
            messages = wire_capture.read_wire(path, on_fault)
            yield from steady(messages, path.name, on_fault)
        case "mcap":
            with optional_packages():
                from xethru_protocol.recordings.mcap import read_mcap

            yield from steady(read_mcap(path, on_fault, radar), path.name, on_fault)
        case "vendor":
            yield from read_vendor(path, on_fault)


def refuse_name(path: Path, radar: str | None) -> None:
    if radar is not None:
        raise RecordingError(f"{path} is of one radar and names none; leave the name out")


def recording_content(path: Path | str) -> RecordingContent:
    """Return radars and texts; only MCAP has names and texts.

    RecordingError if there is nothing to read.
    """
    path = Path(path)
    match recording_format(path):
        case "vendor":
            return RecordingContent(radars={"": vendor_about(path)})
        case "wire":
            return RecordingContent(radars={"": wire_capture.wire_about(path)})
    with optional_packages():
        from xethru_protocol.recordings.mcap import mcap_content

    return mcap_content(path)


def recording_facts(path: Path | str, on_fault: FaultHandler | None = None) -> RecordingFacts:
    """Return the facts of a recording; RecordingError if it cannot be read.

    Those that are damaged are the defaults, which is reported to ``on_fault``.
    """
    path = Path(path)
    match recording_format(path):
        case "wire":
            return wire_capture.wire_facts(path, on_fault)
        case "mcap":
            with optional_packages():
                from xethru_protocol.recordings.mcap import mcap_facts

            return mcap_facts(path, on_fault)
        case "vendor":
            return vendor_facts(path)


def describe_recording(
    path: Path | str, *, radar: str | None = None, downconversion: bool | None = None
) -> RecordingSummary:
    """Read a whole recording, or the named radar's part, and summarise it.

    ``downconversion`` says whether its frames are baseband; None: decide by the
    recording, where it shows that.
    """
    path = Path(path)
    layouts = FrameLayouts(downconversion)
    faults: list[RecordingFault] = []
    counts: Counter[str] = Counter()
    first_ns = last_ns = None
    for message, t_ns in read_recording(path, faults.append, radar=radar):
        counts[message_name(message)] += 1
        layouts.take(message)
        if t_ns is not None:
            first_ns = t_ns if first_ns is None else min(first_ns, t_ns)
            last_ns = t_ns if last_ns is None else max(last_ns, t_ns)
    facts = recording_facts(path, faults.append)
    with reading(path):
        files: Iterable[Path] = [path]
        if path.is_dir() or path.name.startswith("xethru_"):
            files = (path if path.is_dir() else path.parent).rglob("xethru_*")
        size_bytes = sum(file.stat().st_size for file in files if file.is_file())
    return RecordingSummary(
        path=path,
        format=recording_format(path),
        start_ns=first_ns,
        duration_ns=None if first_ns is None or last_ns is None else last_ns - first_ns,
        messages=dict(counts),
        size_bytes=size_bytes,
        session_id=facts.session_id,
        profile_id=facts.profile_id,
        parameter_file=None if facts.parameter_file is None else PARAMETER_FILE_NAME,
        frames=layouts.layouts(),
        faults=tuple(faults),
    )
