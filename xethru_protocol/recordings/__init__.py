"""Recordings of everything a module sent: read, written, converted.

`read_recording` takes any of them; `RecordingWriter` writes what the vendor's ModuleConnector
does.
"""

from xethru_protocol.recordings.detect import (
    RecordingSummary,
    describe_recording,
    read_recording,
    recording_facts,
)
from xethru_protocol.recordings.errors import RecordingError, RecordingFault
from xethru_protocol.recordings.records import RecordingFacts
from xethru_protocol.recordings.vendor_writer import RecordingWriter, Split

__all__ = [
    "RecordingError",
    "RecordingFacts",
    "RecordingFault",
    "RecordingSummary",
    "RecordingWriter",
    "Split",
    "describe_recording",
    "read_recording",
    "recording_facts",
]
