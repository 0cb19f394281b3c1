"""Single records at any place: seek, peek, filter, as the vendor's DataReader has them.

Expected positions are what that reader gave for the same files; for ``split_directories`` by hand:
there it adds the durations of the directories up, 0.798 and 0.8 s, and leaves the 0.4 s between
them out, and a seek never finds the last record of a directory.
"""

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from hil_tests.unit.xethru_protocol.recordings.messages import META, MS, RECORDINGS, frame, presence
from xethru_protocol.recordings import (
    Record,
    RecordingError,
    RecordingReader,
    RecordingWriter,
    Split,
    read_recording,
)
from xethru_protocol.wire import messages as m

EVERY_KIND = RECORDINGS / "every_kind"


@pytest.fixture
def every_kind() -> Iterator[RecordingReader]:
    with RecordingReader(EVERY_KIND) as reader:
        yield reader


@pytest.fixture
def split() -> Iterator[RecordingReader]:
    with RecordingReader(RECORDINGS / "split_directories") as reader:
        yield reader


def number(record: Record) -> int:
    assert isinstance(record.message, m.DataFloat)
    return record.message.info


def test_the_totals_are_those_the_vendors_reader_gives(
    every_kind: RecordingReader, split: RecordingReader
) -> None:
    assert (every_kind.start_ns, every_kind.duration_ns) == (1795351386270 * MS, 117 * MS)
    assert (every_kind.size_bytes, every_kind.largest_record_bytes) == (2052, 195)
    assert (every_kind.session_id, every_kind.profile_id) == ("every-kind", 0)
    assert every_kind.meta_version == 13
    assert (split.start_ns, split.duration_ns) == (1795351390382 * MS, 1998 * MS)
    assert (split.size_bytes, split.largest_record_bytes, len(split)) == (120, 24, 5)
    assert split.kinds == {m.DataFloat}


@pytest.mark.parametrize(
    "name", ["every_kind", "split_files", "split_directories", "iq", "float", "single"]
)
def test_all_records_are_what_the_stream_gives(name: str) -> None:
    with RecordingReader(RECORDINGS / name) as reader:
        found = [(record.message, record.t_ns) for record in reader]
    assert found == list(read_recording(RECORDINGS / name))


@pytest.mark.parametrize(
    ("position_ms", "kind", "t_ms"),
    [
        (0, m.DataFloat, 270),
        (1, m.DataString, 275),
        (40, m.NoiseMapByte, 311),
        (57, m.SleepStatus, 331),
        (100, m.RadarBasebandFloat, 372),
        (101, m.RadarBasebandFloat, 372),
    ],
)
def test_a_time_is_found(
    position_ms: int, kind: type[m.Response], t_ms: int, every_kind: RecordingReader
) -> None:
    every_kind.seek_ms(position_ms)
    record = every_kind.peek()
    assert (type(record.message), record.t_ns) == (kind, (1795351386000 + t_ms) * MS)


@pytest.mark.parametrize(
    ("position", "kind", "begin"),
    [
        (0, m.DataFloat, 0),
        (23, m.DataFloat, 0),
        (24, m.DataString, 57),  # in the titles before it
        (100, m.DataByte, 97),
        (300, m.PulseDopplerByte, 249),
        (1000, m.SleepStatus, 965),
        (2051, m.DataString, 1996),
    ],
)
def test_a_byte_is_found(
    position: int, kind: type[m.Response], begin: int, every_kind: RecordingReader
) -> None:
    every_kind.seek_byte(position)
    record = every_kind.peek()
    assert (type(record.message), record.position) == (kind, begin)


def test_directories_are_one_recording(split: RecordingReader) -> None:
    found = []
    for position_ms in (0, 398, 399, 799, 1199, 1598):
        split.seek_ms(position_ms)
        found.append(None if split.at_end else number(split.peek()))
    assert found == [1, 2, 3, 4, 5, 5]
    split.seek_byte(72)
    assert [number(record) for record in split] == [4, 5]
    assert split.at_end


def test_peek_stays_and_read_goes_on(split: RecordingReader) -> None:
    assert [number(record) for record in (split.peek(), split.peek(), split.read())] == [1, 1, 1]
    assert [record.position for record in split] == [24, 48, 72, 96]
    for call in (split.peek, split.read):
        with pytest.raises(RecordingError):
            call()


def test_a_filter_holds_wherever_the_reader_is(every_kind: RecordingReader) -> None:
    every_kind.set_filter(m.PresenceSingle, m.PresenceMovingList)
    assert every_kind.filter == {m.PresenceSingle, m.PresenceMovingList}
    assert [type(record.message) for record in every_kind] == [
        m.PresenceSingle,
        m.PresenceMovingList,
    ]
    every_kind.seek_ms(47)
    assert isinstance(every_kind.peek().message, m.PresenceMovingList)
    every_kind.seek_ms(100)
    assert every_kind.at_end
    every_kind.set_filter()
    assert isinstance(every_kind.read().message, m.RadarBasebandFloat)
    with pytest.raises(RecordingError):
        every_kind.set_filter(m.Ack)


@pytest.mark.parametrize("position_ms", [-1, 117.001, float("nan")])
def test_times_outside_are_refused(position_ms: float, every_kind: RecordingReader) -> None:
    with pytest.raises(RecordingError, match=r"lies outside the recording, 0 \.\.\. 117 ms"):
        every_kind.seek_ms(position_ms)
    with pytest.raises(RecordingError, match=r"outside the recording, 0 \.\.\. 2052"):
        every_kind.seek_byte(2053)


def test_a_recording_that_was_never_completed_is_read(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path, session_id="s", split=Split(records=2))
    timed = [(frame(1), 5 * MS), (presence(2), 7 * MS), (frame(3), 9 * MS), (frame(4), 12 * MS)]
    for message, t_ns in timed:
        writer.write(message, t_ns)
    with RecordingReader(tmp_path) as reader:
        assert [(record.message, record.t_ns) for record in reader] == timed
        assert reader.duration_ns == 7 * MS
        reader.seek_ms(2)
        assert reader.read().message == presence(2)
    writer.close()


def test_damage_costs_one_record(tmp_path: Path) -> None:
    shutil.copytree(RECORDINGS / "split_files", tmp_path / "r")
    file = sorted((tmp_path / "r").glob("xethru_datafloat_*"))[0]
    content = bytearray(file.read_bytes())
    content[4 + 24 + 8] = 200  # the length of the second record, behind the user header
    file.write_bytes(content)
    reader = RecordingReader(tmp_path / "r")
    assert number(reader.read()) == 1
    with pytest.raises(RecordingError, match="a record is damaged: the index gives it 24 bytes"):
        reader.read()
    assert number(reader.read()) == 3
    file.unlink()
    reader.close()
    reader.seek_ms(0)
    with pytest.raises(RecordingError):
        reader.read()
    reader.close()


def test_a_recording_without_meta_file_is_refused(tmp_path: Path) -> None:
    shutil.copytree(RECORDINGS / "iq", tmp_path / "r")
    (tmp_path / "r" / META).unlink()
    with pytest.raises(RecordingError, match=r"has no xethru_recording_meta\.dat"):
        RecordingReader(tmp_path / "r")


@pytest.mark.parametrize("at", [17, 25], ids=["begin", "end"])
def test_an_index_with_a_place_that_no_file_has_is_refused(tmp_path: Path, at: int) -> None:
    shutil.copytree(RECORDINGS / "split_directories", tmp_path / "r")
    meta = min((tmp_path / "r").rglob(META))
    content = bytearray(meta.read_bytes())
    first = 89 + int.from_bytes(content[85:89], "little")  # behind the head and the session id
    content[first + at : first + at + 8] = b"\xff" * 8
    meta.write_bytes(content)
    with pytest.raises(RecordingError, match=f"index of .*{meta.parent.name} is damaged"):
        RecordingReader(tmp_path / "r")


def test_names_that_no_file_can_have_cost_no_record(tmp_path: Path) -> None:
    directory = tmp_path / "xethru_recording_2\u00b2"  # no number, though a digit
    shutil.copytree(RECORDINGS / "every_kind", directory)
    meta = directory / META
    meta.write_bytes(meta.read_bytes().replace(b"xethru_datafloat", b"xethru\0datafloat"))
    with RecordingReader(tmp_path) as reader, RecordingReader(EVERY_KIND) as original:
        assert [record.data for record in reader] == [record.data for record in original]


def test_iq_records_hold_their_bytes(tmp_path: Path) -> None:
    content = (RECORDINGS / "iq" / "xethru_baseband_iq_20261121_003557.dat").read_bytes()
    with RecordingReader(RECORDINGS / "iq") as reader:
        reader.seek_byte(5 * 104)
        record = reader.read()
    assert record.data == content[5 * 104 : 6 * 104]
    assert isinstance(record.message, m.BasebandIq)
    assert record.message.counter == 49
    np.testing.assert_allclose(record.message.i[:2], [0.049, 0.098], rtol=1e-6)
