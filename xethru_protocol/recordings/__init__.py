"""Recordings of everything a module sent: read, written, converted.

`load` gives any of them as arrays, `read_recording` its messages; `RecordingWriter` writes what the
vendor's ModuleConnector does, `Recorder` what a driver receives; `RecordingReader` reads one record
by record, with seek, peek and filter; `WireCapture` keeps the bytes of a port; `convert` goes from
any to any. The rest is in the modules of this package: layouts and meta file of the vendor's format
first.
"""

from xethru_protocol.recordings.conversion import Conversion, convert
from xethru_protocol.recordings.formats import (
    RecordingFormat,
    RecordingSummary,
    describe_recording,
    read_recording,
    recording_facts,
    recording_format,
)
from xethru_protocol.recordings.frame_layout import FrameLayout
from xethru_protocol.recordings.loading import RadarArrays, Recording, TextColumn, load
from xethru_protocol.recordings.recorded_messages import (
    RecordingError,
    RecordingFacts,
    RecordingFault,
)
from xethru_protocol.recordings.recorder import Recorder, SessionRecorder
from xethru_protocol.recordings.vendor.reader import Record, RecordingReader
from xethru_protocol.recordings.vendor.writer import (
    RecordingWriter,
    Split,
    WriterOptions,
    session_directory,
)
from xethru_protocol.recordings.wire_capture import Chunk, WireCapture, read_chunks, read_note

__all__ = [
    "Chunk",
    "Conversion",
    "FrameLayout",
    "RadarArrays",
    "Record",
    "Recorder",
    "Recording",
    "RecordingError",
    "RecordingFacts",
    "RecordingFault",
    "RecordingFormat",
    "RecordingReader",
    "RecordingSummary",
    "RecordingWriter",
    "SessionRecorder",
    "Split",
    "TextColumn",
    "WireCapture",
    "WriterOptions",
    "convert",
    "describe_recording",
    "load",
    "read_chunks",
    "read_note",
    "read_recording",
    "recording_facts",
    "recording_format",
    "session_directory",
]
