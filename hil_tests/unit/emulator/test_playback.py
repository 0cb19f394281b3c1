"""A recording whose last record is cut plays all the others, and says so."""

import shutil
from pathlib import Path

import pytest

from emulator.identity import Identity
from emulator.loopback import LoopbackTransport
from emulator.playback import RecordingError, recording_device
from hil_tests.golden.vectors import FIXTURES
from xethru_protocol.driver import X4M300
from xethru_protocol.errors import ResponseTimeout
from xethru_protocol.recordings import RecordingFault

IDENTITY = Identity(serial="123456789012")


def copy_of_the_vendors_recording(folder: Path) -> Path:
    return Path(shutil.copytree(FIXTURES / "recordings" / "iq", folder / "recording"))


def counters_played(recording: Path, faults: list[RecordingFault]) -> list[int]:
    device = recording_device(recording, IDENTITY, rate=0, loop=False, on_fault=faults.append)
    line = LoopbackTransport(device)
    counters = []
    with X4M300(line, clock=line.clock_ns) as radar:
        while True:
            try:
                counters.append(radar.read_frame(timeout_s=5).counter)
            except ResponseTimeout:
                return counters


def test_a_cut_last_record_costs_that_record_only(tmp_path: Path) -> None:
    recording = copy_of_the_vendors_recording(tmp_path)
    faults: list[RecordingFault] = []
    whole = counters_played(recording, faults)
    assert faults == []
    data = next(recording.glob("*baseband_iq*.dat"))
    data.write_bytes(data.read_bytes()[:-1])
    assert counters_played(recording, faults) == whole[:-1]
    assert [Path(fault.file).name for fault in faults] == [data.name]


def test_a_recording_of_nothing_is_refused(tmp_path: Path) -> None:
    recording = copy_of_the_vendors_recording(tmp_path)
    next(recording.glob("*baseband_iq*.dat")).write_bytes(b"")
    with pytest.raises(RecordingError):
        recording_device(recording, IDENTITY, rate=0, loop=False, on_fault=lambda fault: None)
