"""Recording directories of the vendor: every byte of what its library wrote, read and written."""

import json
import struct
from datetime import UTC
from pathlib import Path

import numpy as np
import pytest

from hil_tests.paths import real_recording, shared_data
from hil_tests.unit.xethru_protocol.recordings.messages import (
    META,
    MS,
    RECORDINGS,
    frame,
    presence,
    write_again,
    write_recording,
)
from xethru_protocol.recordings import (
    RecordingError,
    RecordingFault,
    RecordingWriter,
    Split,
    describe_recording,
    read_recording,
    recording_facts,
)
from xethru_protocol.recordings.vendor.writer import session_directory
from xethru_protocol.wire import messages as m


def contents(directory: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in directory.iterdir()}


@pytest.mark.parametrize("name", ["iq", "float", "single"])
def test_what_the_vendor_wrote_is_written_again_byte_for_byte(name: str, tmp_path: Path) -> None:
    write_again(RECORDINGS / name, tmp_path / "again")
    theirs, ours = contents(RECORDINGS / name), contents(tmp_path / "again")
    assert theirs.keys() == ours.keys()
    different = [file for file in theirs if theirs[file] != ours[file]]
    if name == "single":
        # In one line of 40 the vendor's text has another millisecond than its own index: it reads
        # the clock twice. Nothing else differs.
        assert different == ["xethru_presence_single_20261121_003604.csv"]
        pairs = zip(theirs[different[0]].splitlines(), ours[different[0]].splitlines(), strict=True)
        assert [pair for pair in pairs if pair[0] != pair[1]] == [
            (
                b"2026-11-21T00:36:05.638+00:00;182;2;24;2;6",
                b"2026-11-21T00:36:05.637+00:00;182;2;24;2;6",
            )
        ]
    else:
        assert different == []


def test_the_real_meta_file_of_2017_is_written_again_byte_for_byte(tmp_path: Path) -> None:
    real = real_recording()
    facts = recording_facts(real)
    assert facts.session_id == "baseband_recording"
    # its file name has the local time of Oslo in summer, 15:04 where UTC had 13:04
    write_again(real, tmp_path / "again")
    ours = contents(tmp_path / "again")
    theirs = contents(real)
    name = "xethru_baseband_iq_20170913_"
    assert ours[META].replace(name.encode() + b"130437", name.encode() + b"150437") == theirs[META]
    assert ours[name + "130437.dat"] == theirs[name + "150437.dat"]


@pytest.mark.parametrize(
    ("name", "user_header", "kind", "times_ms"),
    [
        ("iq", b"", "BASEBAND_IQ", (1795221357928, 1948, 2050)),
        ("float", b"hdr1", "DATA FLOAT", (1795221362468, 1949, 2051)),
        ("single", b"", "PRESENCE_SINGLE", (1795221364739, 1949, 2050)),
    ],
)
def test_the_facts_are_those_the_vendors_reader_gives(
    name: str, user_header: bytes, kind: str, times_ms: tuple[int, int, int]
) -> None:
    """Expected: what the vendor's reader said of each, from the manifest they came with.

    Start, and since then the last record and the end.
    """
    start_ms, last_ms, closed_ms = times_ms
    facts = recording_facts(RECORDINGS / name)
    assert facts.session_id == f"session-{name}"
    assert facts.profile_id == 21842616
    assert facts.user_header == user_header
    assert facts.closed_ns == (start_ms + closed_ms) * MS
    assert facts.parameter_file == b"# own test parameter file\nkey=value\n"
    summary = describe_recording(RECORDINGS / name)
    assert summary.format == "vendor"
    assert summary.messages == {kind: 40}
    assert (summary.start_ns, summary.duration_ns) == (start_ms * MS, last_ms * MS)
    assert summary.parameter_file == "xethru_parameter_file.par"
    assert summary.faults == ()


def test_every_record_is_what_the_vendors_reader_gives() -> None:
    manifest = shared_data("recordings") / "manifest.json"
    for recording in json.loads(manifest.read_text())["recordings"]:
        told = [record for record in recording["records"] if "values" in record]
        found = list(read_recording(RECORDINGS / recording["directory"]))
        assert [t_ns for _, t_ns in found] == [record["epoch_ms"] * MS for record in told]
        for (message, _), record in zip(found, told, strict=True):
            values = record["values"]
            match message:
                case m.BasebandIq():
                    assert message.counter == values["frame_counter"]
                    np.testing.assert_array_equal(message.i, np.float32(values["i"]))
                    np.testing.assert_array_equal(message.q, np.float32(values["q"]))
                case m.DataFloat():
                    assert (message.content_id, message.info) == (0, values["info"])
                    np.testing.assert_array_equal(message.values, np.float32(values["data"]))
                case m.PresenceSingle():
                    assert message.counter == values["counter"]
                    assert message.state == values["presence_state"]
                    assert message.distance_m == values["distance"]
                    assert message.direction == values["direction"]
                    assert message.signal_quality == values["signal_quality"]
                case _:
                    pytest.fail(f"{message} was not recorded")


def test_several_kinds_keep_their_order_in_time(tmp_path: Path) -> None:
    written = [(frame(1), 10 * MS), (presence(2), 20 * MS), (frame(3), 30 * MS)]
    write_recording(tmp_path / "two", written)
    assert sorted(path.name for path in (tmp_path / "two").iterdir()) == [
        "xethru_datafloat_19700101_000000.dat",
        "xethru_presence_single_19700101_000000.csv",
        META,
    ]
    assert list(read_recording(tmp_path / "two")) == written


@pytest.mark.parametrize(
    ("split", "files"),
    [
        (Split(records=2), 3),
        (Split(bytes=48), 3),  # a record of three bins has 24 bytes
        (Split(seconds=0.02), 3),
        (Split(records=1), 5),
        (Split(records=5), 1),
    ],
)
def test_split_files_are_read_as_one(tmp_path: Path, split: Split, files: int) -> None:
    written = [(frame(counter), counter * 10 * MS) for counter in range(5)]
    folder = tmp_path / "split"
    write_recording(folder, written, user_header=b"head", split=split)
    data = sorted(folder.glob("*.dat"))
    assert len(data) == files + 1  # and the meta file
    assert list(read_recording(folder)) == written
    assert describe_recording(folder).faults == ()
    one = list(read_recording(data[1] if files > 1 else data[0]))
    assert [message for message, _ in one] == [message for message, _ in written][
        (slice(1, 2) if split.records == 1 else slice(2, 4)) if files > 1 else slice(0, 5)
    ]


def test_a_split_closes_a_full_file_at_once_in_the_index(tmp_path: Path) -> None:
    """Entries by hand: ms, kind, data type, size, file, begin in the file, end over all files."""
    timed = [(frame(1), 5 * MS), (frame(2), 9 * MS)]
    write_recording(tmp_path / "split", timed, session_id="s", split=Split(records=1))
    meta = (tmp_path / "split" / META).read_bytes()
    index = meta[0x59 + 2 :]  # behind the session id and its NUL
    assert [struct.unpack_from("<IBIIIQQ", index, 33 * row) for row in range(4)] == [
        (0, 1, 1024, 24, 0, 0, 24),
        (0, 2, 1024, 0, 0, 24, 24),
        (4, 1, 1024, 24, 1, 0, 48),
        (4, 2, 1024, 0, 1, 24, 48),
    ]
    names = (
        b"xethru_datafloat_19700101_000000.dat\0",
        b"xethru_datafloat_19700101_000000_009ms.dat\0",
    )
    assert index[4 * 33 :] == struct.pack("<IBI", 4, 3, 2) + b"".join(
        struct.pack("<I", len(name)) + name for name in names
    )


def test_one_of_several_files_has_its_own_times_without_a_list_of_files(tmp_path: Path) -> None:
    """A recorder that was killed leaves an index without the names of the files."""
    writer = RecordingWriter(tmp_path / "split", split=Split(records=1), timezone=UTC)
    for counter in range(3):
        writer.write(frame(counter), counter * 10 * MS)
    last = tmp_path / "split" / "xethru_datafloat_19700101_000000_020ms.dat"
    assert list(read_recording(last)) == [(frame(2), 20 * MS)]
    assert [t_ns for _, t_ns in read_recording(tmp_path / "split")] == [0, 10 * MS, 20 * MS]
    writer.close()
    assert list(read_recording(last)) == [(frame(2), 20 * MS)]


def test_a_recording_split_by_directory_is_read_as_one(tmp_path: Path) -> None:
    for part in range(2):
        folder = tmp_path / f"xethru_recording_{part}_s"
        write_recording(folder, [(frame(part), part * MS)], session_id="s")
    assert [message for message, _ in read_recording(tmp_path)] == [frame(0), frame(1)]
    write_recording(tmp_path / "xethru_recording_2_other", [(frame(2), 0)], session_id="other")
    with pytest.raises(RecordingError, match="holds 3 recordings of 2 sessions"):
        list(read_recording(tmp_path))


@pytest.mark.parametrize("n_lost", [0, 1, 2])
def test_a_directory_whose_meta_file_is_lost_is_known_by_its_name(
    n_lost: int, tmp_path: Path
) -> None:
    timed = [(frame(counter), 1000 * counter * MS) for counter in range(3)]
    write_recording(tmp_path, timed, session_id="a b", split_directories=Split(records=1))
    folders = sorted(tmp_path.iterdir())
    for folder in folders[:n_lost]:
        (folder / META).unlink()
    faults: list[RecordingFault] = []
    found = [message for message, _ in read_recording(tmp_path, faults.append)]
    assert found == [frame(0), frame(1), frame(2)]
    assert len(faults) == n_lost


def test_sessions_whose_names_differ_in_a_number_are_not_joined(tmp_path: Path) -> None:
    for name in ("lab_1", "lab_2"):
        folder = session_directory(tmp_path, name, 0, UTC)
        write_recording(folder, [(frame(1), 0)], session_id=name)
        if name == "lab_1":
            (folder / META).unlink()
    with pytest.raises(RecordingError, match="of 2 sessions"):
        list(read_recording(tmp_path))


@pytest.mark.parametrize("meta", [True, False])
def test_directories_without_session_id_are_not_taken_for_one_recording(
    meta: bool, tmp_path: Path
) -> None:
    for radar in range(2):
        folder = tmp_path / f"xethru_recording_{radar}"
        write_recording(folder, [(frame(radar), 0)], session_id="x")
        content = bytearray((folder / META).read_bytes())
        content[0x59] = 0  # as earlier versions wrote
        (folder / META).write_bytes(content)
        if not meta:
            (folder / META).unlink()
    with pytest.raises(RecordingError, match="holds 2 recordings of 2 sessions; name one"):
        list(read_recording(tmp_path))
    ((found, _),) = read_recording(tmp_path / "xethru_recording_1")
    assert found == frame(1)


def test_a_limit_that_leaves_no_room_is_refused() -> None:
    with pytest.raises(RecordingError, match="must be positive, not 0"):
        Split(records=0)
    with pytest.raises(RecordingError):
        Split(seconds=float("nan"))


def test_a_closed_recording_takes_nothing_more(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "closed")
    writer.write(frame(1), 0)
    writer.close()
    writer.close()
    with pytest.raises(RecordingError):
        writer.write(frame(2), 0)


def test_records_have_the_values_and_times_that_were_written() -> None:
    """The vendor's library wrote the recording from messages with these values."""
    records = list(read_recording(RECORDINGS / "iq"))
    assert [t_ns for _, t_ns in records[:4]] == [
        1795221357000 * MS + ms * MS for ms in (928, 1085, 1086, 1086)
    ]
    for counter, (message, _) in enumerate(records, start=44):
        assert isinstance(message, m.BasebandIq)
        assert message.counter == counter
        np.testing.assert_allclose(message.i, np.arange(1, 11) * counter * 1e-3, rtol=1e-6)
        np.testing.assert_allclose(message.q, np.arange(1, 11) * counter * -2e-3, rtol=1e-6)
        assert message.range_offset_m == np.float32(0.4)
        assert message.carrier_frequency_hz == np.float32(7.29e9)
