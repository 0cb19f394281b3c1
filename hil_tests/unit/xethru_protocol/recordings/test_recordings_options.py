"""Options of a recorder: session, splitting, names, rate; against the vendor's recorder.

``fixtures/recordings/split_files`` was recorded with a file length of 1 s and a user header,
``split_directories`` with a directory size of 60 bytes.
"""

import os
import re
import uuid
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import pytest

from hil_tests.unit.xethru_protocol.recordings.messages import (
    META,
    MS,
    RECORDINGS,
    counters,
    frame,
    presence,
    read_with_faults,
    write_again,
    write_recording,
)
from xethru_protocol.recordings import (
    RecordingError,
    RecordingWriter,
    Split,
    convert,
    describe_recording,
    read_recording,
    recording_facts,
    session_directory,
)
from xethru_protocol.wire import messages as m


def session_bytes(meta: Path) -> bytes:
    """Return the session id of a meta file with its NUL: from byte 0x59 on, of length at 0x55."""
    content = meta.read_bytes()
    return content[0x59 : 0x59 + int.from_bytes(content[0x55:0x59], "little")]


@pytest.mark.parametrize("given", [None, ""])
def test_a_session_without_id_gets_a_uuid(given: str | None, tmp_path: Path) -> None:
    """The vendor's reader refuses an empty id: Protocol reference 12."""
    ids = []
    for name in ("a", "b"):
        with RecordingWriter(tmp_path / name, session_id=given) as writer:
            writer.write(frame(1), 0)
        stored = session_bytes(tmp_path / name / META)
        assert re.fullmatch(rb"[0-9a-f-]{36}\0", stored)
        found = uuid.UUID(stored[:-1].decode())
        assert found.version == 4
        assert writer.session_id == str(found) == recording_facts(tmp_path / name).session_id
        ids.append(found)
    assert ids[0] != ids[1]


def test_a_conversion_gives_the_session_an_id(tmp_path: Path) -> None:
    write_recording(tmp_path / "a", [(frame(1), 0)], session_id="x")
    content = bytearray((tmp_path / "a" / META).read_bytes())
    content[0x59] = 0
    (tmp_path / "a" / META).write_bytes(content)
    assert recording_facts(tmp_path / "a").session_id == ""
    convert(tmp_path / "a", tmp_path / "b")
    assert len(session_bytes(tmp_path / "b" / META)) == 37


def test_a_session_directory_is_named_as_the_vendor_does() -> None:
    zone = timezone(timedelta(hours=2))
    t_ns = 1795350757 * 10**9
    name = "xethru_recording_20261122_143237_55bd7850-dd4b-40a4-b3b4-489d6147c331"
    found = session_directory("rec", "55bd7850-dd4b-40a4-b3b4-489d6147c331", t_ns, zone)
    assert found == Path("rec") / name
    assert session_directory("rec", "a/../b c", 0, UTC).name == (
        "xethru_recording_19700101_000000_a_.._b_c"
    )


@pytest.mark.parametrize(
    ("name", "split"),
    [("split_files", Split(seconds=1)), ("split_directories", Split(bytes=60))],
)
def test_a_split_recording_is_written_as_the_vendor_does(
    name: str, split: Split, tmp_path: Path
) -> None:
    source = RECORDINGS / name
    if name == "split_directories":
        write_again(source, tmp_path / "again", split_directories=split)
    else:
        write_again(source, tmp_path / "again", split=split)
    theirs = {path.relative_to(source): path for path in source.rglob("*") if path.is_file()}
    ours = tmp_path / "again"
    assert theirs.keys() == {path.relative_to(ours) for path in ours.rglob("*") if path.is_file()}
    for path, original in theirs.items():
        assert (ours / path).read_bytes() == original.read_bytes(), path


def test_a_meta_file_is_read_with_those_that_follow() -> None:
    """Times as the vendor's reader gives them for the chain; counters as they were sent."""
    first, second = sorted((RECORDINGS / "split_directories").iterdir())
    whole = counters(first / META)
    assert whole == [1, 2, 3, 4, 5]
    assert counters(second / META) == [4, 5]
    assert counters(first) == [1, 2, 3]
    assert list(read_recording(RECORDINGS / "split_directories")) == list(
        read_recording(first / META)
    )


def test_a_directory_that_is_missing_in_a_chain_is_reported(tmp_path: Path) -> None:
    timed = [(frame(counter), counter * MS) for counter in range(3)]
    write_recording(tmp_path, timed, split_directories=Split(records=1), session_id="s")
    parts = sorted(tmp_path.iterdir())
    assert [part.name[-2:] for part in parts] == ["_0", "_1", "_2"]
    for path in parts[1].iterdir():
        path.unlink()
    parts[1].rmdir()
    found, faults = read_with_faults(parts[0] / META)
    assert [message for message, _ in found] == [frame(0)]
    assert "goes on in ../" in faults[0].reason
    # a name that leads elsewhere is not followed
    meta = (parts[0] / META).read_bytes()
    outside = f"../{parts[1].name}".encode()
    (parts[0] / META).write_bytes(meta.replace(outside, b"../../".ljust(len(outside), b"x")))
    assert [message for message, _ in read_with_faults(parts[0] / META)[0]] == [frame(0)]


def test_more_than_ten_directories_keep_their_order(tmp_path: Path) -> None:
    folder = tmp_path / "rec" / "xethru_recording_19700101_000000_s"
    timed = [(frame(counter), counter * MS) for counter in range(12)]
    write_recording(folder, timed, split_directories=Split(records=1), session_id="s")
    assert counters(folder) == list(range(12))
    assert counters(tmp_path / "rec") == list(range(12))


def test_a_day_ends_at_its_hour_in_the_zone_of_the_recorder(tmp_path: Path) -> None:
    zone = timezone(timedelta(hours=-3))
    times = [
        datetime(2026, 11, 22, 13, 59, 59, tzinfo=zone),
        datetime(2026, 11, 22, 14, 0, 0, tzinfo=zone),
        datetime(2026, 11, 23, 13, 59, 59, tzinfo=zone),
        datetime(2026, 11, 23, 14, 0, 0, tzinfo=zone),
    ]
    split = Split(daily_hour=14)
    with RecordingWriter(tmp_path, split=split, timezone=zone) as writer:
        for counter, time in enumerate(times):
            writer.write(frame(counter), int(time.timestamp()) * 10**9)
    files = sorted(tmp_path.glob("xethru_datafloat_*"))
    assert [path.name[17:32] for path in files] == [
        "20261122_135959",
        "20261122_140000",
        "20261123_140000",
    ]
    assert [path.stat().st_size // 24 for path in files] == [1, 2, 1]


@pytest.mark.parametrize("hour", [-1, 24])
def test_an_hour_that_no_day_has_is_refused(hour: int) -> None:
    with pytest.raises(RecordingError, match="the hour of a day must be 0"):
        Split(daily_hour=hour)


def test_files_under_other_names_are_found_by_the_index(tmp_path: Path) -> None:
    """As the vendor's recorder names them: the base name, a stamp, the kind's suffix."""
    names = {m.DataFloat: "lab", m.PresenceSingle: "who"}
    timed = [(frame(1), 0), (presence(2), 5 * MS), (frame(3), 9 * MS)]
    write_recording(tmp_path, timed, basenames=names)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "lab_19700101_000000.dat",
        "who_19700101_000000.csv",
        META,
    ]
    assert list(read_recording(tmp_path)) == timed
    assert describe_recording(tmp_path).faults == ()
    with pytest.raises(RecordingError, match='"a/b" cannot begin the name of a file'):
        RecordingWriter(tmp_path / "x", basenames={m.DataFloat: "a/b"})
    with pytest.raises(RecordingError):
        RecordingWriter(tmp_path / "x", basenames={m.Ack: "a"})


def test_a_rate_limit_leaves_messages_out_by_kind(tmp_path: Path) -> None:
    """Expected: what the vendor's recorder does with messages every 60 ms and a limit of 120 ms."""
    with RecordingWriter(tmp_path, interval_s=0.12) as writer:
        stored = [
            (writer.write(frame(k), 60 * k * MS), writer.write(presence(k), (60 * k + 20) * MS))
            for k in range(5)
        ]
    assert stored == [(True, True), (False, False)] * 2 + [(True, True)]
    times_ms = [0, 20, 120, 140, 240, 260]
    assert [t_ns for _, t_ns in read_recording(tmp_path)] == [time * MS for time in times_ms]


def test_a_recorder_reports_files_that_are_complete(tmp_path: Path) -> None:
    complete: list[tuple[str, str, int]] = []
    metas: list[tuple[str, str]] = []
    with RecordingWriter(
        tmp_path,
        session_id="s",
        split=Split(records=2),
        split_directories=Split(records=3),
        on_file=lambda kind, path: complete.append(
            (kind.__name__, path.parent.name[-2:], path.stat().st_size)
        ),
        on_meta_file=lambda session, path: metas.append((session, path.parent.name[-2:])),
    ) as writer:
        for counter in range(4):
            writer.write(frame(counter), counter * MS)
        assert complete == [("DataFloat", "_0", 48), ("DataFloat", "_0", 24)]
        assert metas == [("s", "_0")]
    assert complete[2:] == [("DataFloat", "_1", 24)]
    assert metas[1:] == [("s", "_1")]


def test_flush_on_write_has_each_record_on_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[int] = []
    monkeypatch.setattr(os, "fsync", synced.append)
    for flush, calls in ((False, 0), (True, 5)):  # head, two records and their index entries
        synced.clear()
        with RecordingWriter(tmp_path / str(flush), flush_on_write=flush) as writer:
            writer.write(frame(1), 0)
            writer.write(frame(2), 0)
            assert len(synced) == calls
