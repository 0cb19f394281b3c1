"""Recordings that the vendor's own library wrote from messages with known contents."""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from hil_tests.paths import FIXTURES, REPOSITORY
from xethru_protocol.recordings import RecordingError, RecordingFault, read_recording
from xethru_protocol.wire.messages import BasebandIq

SHARED = Path(os.environ.get("XETHRU_SHARED_DATA", REPOSITORY.parent / "shared" / "data"))
REAL = SHARED / "x4_baseband_iq_2017"
# fixtures/recordings/iq: made for this project by the vendor's library from synthetic messages
SYNTHETIC = FIXTURES / "recordings" / "iq"
DATA_FILE = "xethru_baseband_iq_20261121_003557.dat"
FIRST_TIMES_MS = (1795221357928, 1795221358085, 1795221358086, 1795221358086)


def messages(path: Path) -> list[tuple[BasebandIq, int | None]]:
    found = []
    for message, time_ns in read_recording(path):
        assert isinstance(message, BasebandIq)
        found.append((message, time_ns))
    return found


def test_records_have_the_values_that_were_written() -> None:
    records = messages(SYNTHETIC)
    assert [message.counter for message, _ in records] == list(range(44, 84))
    for message, _ in records:
        step = np.arange(1, 11) * message.counter * 1e-3
        np.testing.assert_allclose(message.i, step, rtol=1e-6)
        np.testing.assert_allclose(message.q, -2 * step, rtol=1e-6)
        assert message.range_offset_m == np.float32(0.4)
        assert message.carrier_frequency_hz == np.float32(7.29e9)


def test_times_are_those_the_vendors_reader_gives() -> None:
    times = [time_ns for _, time_ns in messages(SYNTHETIC)]
    assert times[:4] == [ms * 1_000_000 for ms in FIRST_TIMES_MS]
    assert None not in times


def test_data_file_alone_has_no_times(tmp_path: Path) -> None:
    shutil.copy(SYNTHETIC / DATA_FILE, tmp_path)
    records = messages(tmp_path / DATA_FILE)
    assert len(records) == 40
    assert {time_ns for _, time_ns in records} == {None}


@pytest.mark.parametrize("cut", [1, 50, 100, 103])
def test_cut_record_is_reported_after_all_whole_ones(tmp_path: Path, cut: int) -> None:
    shutil.copytree(SYNTHETIC, tmp_path / "cut")
    file = tmp_path / "cut" / DATA_FILE
    file.write_bytes(file.read_bytes()[:-cut])
    faults: list[RecordingFault] = []
    assert len(list(read_recording(tmp_path / "cut", faults.append))) == 39
    assert [(fault.file, fault.offset) for fault in faults] == [(DATA_FILE, 39 * 104)]
    with pytest.raises(RecordingError, match="the last record is cut"):
        list(read_recording(tmp_path / "cut"))


def test_damaged_meta_file_costs_only_the_times(tmp_path: Path) -> None:
    shutil.copytree(SYNTHETIC, tmp_path / "damaged")
    for content in (b"", b"no recording", bytes(200)):
        (tmp_path / "damaged" / "xethru_recording_meta.dat").write_bytes(content)
        assert len(messages(tmp_path / "damaged")) == 40


def test_what_is_no_recording_is_called_so(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="there is no recording"):
        list(read_recording(tmp_path / "nothing"))
    with pytest.raises(RecordingError, match="needs a file xethru_baseband_iq_"):
        list(read_recording(tmp_path))


@pytest.mark.skipif(
    not REAL.is_dir(), reason="real recording not found; name its folder in XETHRU_SHARED_DATA"
)
def test_real_recording_is_read_whole() -> None:
    records = messages(REAL)
    assert len(records) == 514
    assert {message.num_bins for message, _ in records} == {54}
    assert {message.range_offset_m for message, _ in records} == {np.float32(0.3343209922)}
    strength = np.mean([np.abs(message.i + 1j * message.q) for message, _ in records], axis=0)
    assert int(np.argmax(strength)) == 0
    assert strength[0] == pytest.approx(0.0294, abs=1e-4)
