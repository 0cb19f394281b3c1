"""Recordings that are damaged, incomplete, refused or cut off: those of the vendor first."""

import io
import os
import shutil
import signal
import struct
import subprocess
import sys
import tracemalloc
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
import zstandard

from hil_tests.patience import seconds
from hil_tests.unit.xethru_protocol.recordings.messages import (
    META,
    MS,
    RECORDINGS,
    frame,
    presence,
    read_with_faults,
    write_recording,
)
from xethru_protocol.recordings import (
    RecordingError,
    RecordingWriter,
    convert,
    read_recording,
    recording_facts,
)
from xethru_protocol.recordings.mcap import LocatedRecord, index_of
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.connection import Connection, Role

PARAMETERS = "xethru_parameter_file.par"


def copy_of(name: str, tmp_path: Path) -> Path:
    copy = Path(shutil.copytree(RECORDINGS / name, tmp_path / "copy"))
    for path in (copy, *copy.iterdir()):
        path.chmod(0o755)
    return copy


def test_the_meta_file_names_the_recording(tmp_path: Path) -> None:
    assert len(list(read_recording(RECORDINGS / "float" / META))) == 40
    copy = copy_of("single", tmp_path)
    next(copy.glob("*.csv")).rename(copy / "elsewhere.csv")
    with pytest.raises(RecordingError):
        list(read_recording(copy / META))


@pytest.mark.parametrize("header", [b"hello", b"two\nlines\n", bytes(range(256)) * 3])
@pytest.mark.parametrize("message", [frame(7, 50), presence(7)])
def test_any_user_header_is_found_without_an_index(
    header: bytes, message: m.Response, tmp_path: Path
) -> None:
    timed = [(message, number * MS) for number in range(3)]
    write_recording(tmp_path / "r", timed, user_header=header)
    assert recording_facts(tmp_path / "r").user_header == header
    (tmp_path / "r" / META).unlink()
    found, faults = read_with_faults(tmp_path / "r")
    assert [message for message, _ in found] == [message] * 3
    assert [(fault.file, fault.minor) for fault in faults] == [(META, True)]


@pytest.mark.parametrize(
    "prefix", ["pulsedoppler_byte", "noisemap_byte", "radar_baseband_q15", "radar_rf"]
)
def test_a_cut_file_of_small_numbers_holds_its_whole_records_only(
    prefix: str, tmp_path: Path
) -> None:
    """Small numbers look like heads of records; the cut by one byte is the hardest."""
    (file,) = (RECORDINGS / "every_kind").glob(f"xethru_{prefix}_2*.dat")
    record = file.read_bytes()
    for cut in range(1, len(record)):
        copy = tmp_path / file.name
        copy.write_bytes(3 * record)
        os.truncate(copy, 3 * len(record) - cut)
        found, faults = read_with_faults(copy)
        assert (len(found), [fault.offset for fault in faults]) == (2, [2 * len(record)])


@pytest.mark.parametrize(
    ("name", "cut", "offset"),
    [
        *(("single", cut, 1909 - 47) for cut in (1, 10, 46)),
        *(("iq", cut, 39 * 104) for cut in (1, 50, 103)),
    ],
)
def test_a_cut_record_is_reported_after_all_whole_ones(
    name: str, cut: int, offset: int, tmp_path: Path
) -> None:
    """Cuts at every byte of every format are in hil_tests/property."""
    copy = copy_of(name, tmp_path)
    (file,) = (path for path in copy.iterdir() if path.name not in {META, PARAMETERS})
    file.write_bytes(file.read_bytes()[:-cut])
    found, faults = read_with_faults(copy)
    assert len(found) == 39
    assert [(fault.file, fault.offset) for fault in faults] == [(file.name, offset)]
    with pytest.raises(RecordingError):
        list(read_recording(copy))


EMPTY = m.DataFloat(info=0, values=np.empty(0, np.float32))  # 12 zeros in the file


@pytest.mark.parametrize("zeros", [1, 13, 4092])
@pytest.mark.parametrize("last", [frame(7), EMPTY, m.DataString(text="two\nlines")])
def test_zeros_behind_the_last_record_are_no_records(
    last: m.Response, zeros: int, tmp_path: Path
) -> None:
    """A file system leaves them after a loss of power."""
    timed: list[tuple[m.Response, int | None]] = [(last, 0), (last, MS)]
    write_recording(tmp_path, timed)
    assert list(read_recording(tmp_path)) == timed
    (file,) = tmp_path.glob("xethru_data*")
    size = file.stat().st_size
    os.truncate(file, size + zeros)
    found, faults = read_with_faults(tmp_path)
    assert found == timed
    assert [(fault.offset, fault.minor) for fault in faults] == [(size, False)]


@pytest.mark.parametrize("begin", [104 * 30, 104 * 30 + 3])
@pytest.mark.parametrize("has_index", [True, False])
def test_records_in_place_of_which_zeros_are_there_are_cut(
    begin: int, has_index: bool, tmp_path: Path
) -> None:
    copy = copy_of("iq", tmp_path)
    (file,) = copy.glob("xethru_baseband_iq_*")
    os.truncate(file, begin)
    os.truncate(file, 104 * 40)
    if not has_index:
        (copy / META).unlink()
    found, faults = read_with_faults(copy)
    assert len(found) == 30
    assert [fault.offset for fault in faults if not fault.minor] == [104 * 30]


@pytest.mark.parametrize(
    ("column", "cell", "reason"),
    [
        (0, "9999-12-31T23:59:59+00:00", "64 bits"),
        (0, "0001-01-01T00:00:00+23:59", "64 bits"),
        (1, "-1", "counter=-1"),
        (1, "4294967296", "counter=4294967296"),
        (4, "256", "direction=256"),
        (2, "two", "a line cannot be read"),
    ],
)
def test_a_line_that_fits_no_message_costs_itself_only(
    column: int, cell: str, reason: str, tmp_path: Path
) -> None:
    copy = copy_of("single", tmp_path)
    file = next(copy.glob("*.csv"))
    lines = file.read_text().splitlines(keepends=True)
    cells = lines[1].split(";")
    line, lines[1] = lines[1], ";".join([*cells[:column], cell, *cells[column + 1 :]])
    file.write_text("".join(lines))
    found, faults = read_with_faults(copy)
    whole = [message for message, _ in read_recording(RECORDINGS / "single")]
    assert [message for message, _ in found] == whole[1:]
    assert [reason in fault.reason for fault in faults if not fault.minor] == [True]
    sizes = f"the index gives this record {len(line)} bytes, it has {len(lines[1])}"
    others = [fault.reason for fault in faults if fault.minor]
    assert others == ([] if len(line) == len(lines[1]) else [sizes])


def test_a_stamp_without_zone_is_in_that_of_this_machine(tmp_path: Path) -> None:
    line = "2026-07-21T12:00:00.500;1;2;1.5;0;7\n"
    file = tmp_path / "xethru_presence_single_20260721_120000.csv"
    file.write_text("TimeStamp;Counter;PresenceState;Distance;Direction;SignalQuality\n" + line)
    ((_, t_ns),) = read_recording(file)
    assert t_ns == round(datetime(2026, 7, 21, 12).timestamp()) * 1000 * MS + 500 * MS


@pytest.mark.parametrize(
    ("offset", "damage", "reason"),
    [
        (0x00, b"\0", "does not begin like a meta file"),
        (0x04, b"\x0e", "its format version is 14, known is 13"),
        (0x55, b"\xff\xff\xff\xff", "never completed"),  # length of the session id
        (0x1D, b"\x01" + bytes(7), "never completed"),  # where the index ends
        (0x08, b"\xff" * 7 + b"\x7f", "its start is not a time"),
        (0x08, bytes(7) + b"\x80", "its start is not a time"),
    ],
)
def test_a_damaged_head_of_the_meta_file_costs_no_message(
    offset: int, damage: bytes, reason: str, tmp_path: Path
) -> None:
    """The recording has a user header, whose length only the index tells."""
    copy = copy_of("float", tmp_path)
    meta = bytearray((copy / META).read_bytes())
    meta[offset : offset + len(damage)] = damage
    (copy / META).write_bytes(meta)
    found, faults = read_with_faults(copy)
    whole = [message for message, _ in read_recording(RECORDINGS / "float")]
    assert found == [(message, None) for message in whole]
    assert list(read_recording(copy)) == found, "nobody asked for faults, no message is lost"
    assert [(fault.file, fault.minor) for fault in faults] == [(META, True)]
    assert reason in faults[0].reason


@pytest.mark.rare
def test_a_long_index_stays_packed_in_memory(tmp_path: Path) -> None:
    n_messages = 20_000
    timed = ((frame(counter, 1), counter * MS) for counter in range(n_messages))
    write_recording(tmp_path / "long", timed)
    tracemalloc.start()
    try:
        counters = [message.info for message, _ in read_recording(tmp_path / "long")]  # type: ignore[attr-defined]  # frames only
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert counters == list(range(n_messages))
    # 33 bytes in the file, 40 of the list above, and a block of entries at work
    assert peak < n_messages * 100 + 2_000_000


def test_other_columns_are_reported_and_not_guessed_at(tmp_path: Path) -> None:
    copy = copy_of("single", tmp_path)
    file = next(copy.glob("*.csv"))
    file.write_bytes(file.read_bytes().replace(b"Counter;PresenceState", b"PresenceState;Counter"))
    found, faults = read_with_faults(copy)
    assert found == []
    reason = faults[0].reason
    assert reason.startswith('its columns are not the known ones: "TimeStamp;PresenceState;')


def test_a_size_in_the_index_that_is_wrong_costs_nothing(tmp_path: Path) -> None:
    copy = copy_of("iq", tmp_path)
    data = bytearray((copy / META).read_bytes())
    data[data.index(struct.pack("<BII", 1, 2, 104)) + 5] = 5  # size of the first record
    (copy / META).write_bytes(data)
    found, faults = read_with_faults(copy)
    assert found == list(read_recording(RECORDINGS / "iq"))
    assert "the index gives this record" in faults[0].reason


@pytest.mark.parametrize("damaged", [0, 7, 39])
def test_a_damaged_count_costs_its_record_where_the_index_tells_the_size(
    damaged: int, tmp_path: Path
) -> None:
    whole = list(read_recording(RECORDINGS / "iq"))
    copy = copy_of("iq", tmp_path)
    file = next(copy.glob("xethru_baseband_iq_*"))
    data = bytearray(file.read_bytes())
    begin = len(data) // 40 * damaged  # 40 records of one size
    data[begin + 4 : begin + 8] = b"\xff\xff\xff\x7f"
    file.write_bytes(data)
    found, faults = read_with_faults(copy)
    assert found == whole[:damaged] + whole[damaged + 1 :]
    assert [(fault.file, fault.offset) for fault in faults] == [(file.name, begin)]
    with pytest.raises(RecordingError):
        list(read_recording(copy))


def test_an_index_that_is_too_short_or_too_long_is_reported(tmp_path: Path) -> None:
    copy = copy_of("iq", tmp_path)
    file = next(copy.glob("*iq*.dat"))
    data = file.read_bytes()
    file.write_bytes(data + data[-104:])
    found, faults = read_with_faults(copy)
    assert [t_ns for _, t_ns in found[-2:]] == [1795221359876 * MS, None]
    assert faults == []
    file.write_bytes(data[:-104])
    found, faults = read_with_faults(copy)
    assert len(found) == 39
    assert [fault.reason for fault in faults] == ["the index lists more records than it holds"]


def test_a_missing_data_file_is_reported(tmp_path: Path) -> None:
    write_recording(tmp_path / "two", [(frame(1), 0), (presence(2), 0)])
    next((tmp_path / "two").glob("*.csv")).unlink()
    found, faults = read_with_faults(tmp_path / "two")
    assert found == [(frame(1), 0)]
    assert [fault.file for fault in faults] == ["xethru_presence_single_19700101_000000.csv"]
    with pytest.raises(RecordingError):
        list(read_recording(tmp_path / "two"))


def test_foreign_files_are_left_alone_or_refused(tmp_path: Path) -> None:
    copy = copy_of("iq", tmp_path)
    (copy / "notes.txt").write_text("hello")
    (copy / "xethru_unheard_of_20261121_003557.dat").write_bytes(b"\0" * 100)
    found, faults = read_with_faults(copy)
    assert (len(found), faults) == (40, [])
    with pytest.raises(RecordingError):
        list(read_recording(copy / "notes.txt"))


def test_the_system_refusing_is_an_error_of_ours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy = copy_of("iq", tmp_path)

    def refuse(self: Path) -> None:
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "iterdir", refuse)
    with pytest.raises(RecordingError):
        list(read_recording(copy))
    with pytest.raises(RecordingError):
        RecordingWriter(tmp_path / "new")


_KILLED = """
import os, signal, sys
import numpy as np
from xethru_protocol.wire.messages import DataFloat
from xethru_protocol.recordings import RecordingWriter
writer = RecordingWriter(sys.argv[1], session_id="killed", user_header=b"hello")
for counter in range(7):
    writer.write(DataFloat(info=counter, values=np.zeros(5, np.float32)), counter * 10**9)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_killed_recorder_leaves_every_message_and_every_time(tmp_path: Path) -> None:
    script = subprocess.run([sys.executable, "-c", _KILLED, tmp_path / "r"], check=False)
    assert script.returncode == -signal.SIGKILL
    found, faults = read_with_faults(tmp_path / "r")
    assert [
        (message.info, t_ns) for message, t_ns in found if isinstance(message, m.DataFloat)
    ] == [(counter, counter * 10**9) for counter in range(7)]
    assert len(list(read_recording(tmp_path / "r"))) == 7
    assert [(fault.file, fault.minor) for fault in faults] == [(META, True)]
    assert "never completed" in faults[0].reason
    facts = recording_facts(tmp_path / "r")
    assert facts.session_id == "killed"
    assert facts.closed_ns is None


@pytest.mark.parametrize(
    "note",
    [
        b'{"facts": 5}',
        b'{"facts": {"session_id": 7}}',
        b'{"facts": {"stopped_ns": "late"}}',
        b'{"facts": {"user_header": "no hex"}}',
    ],
    ids=["number", "session id", "time", "bytes"],
)
def test_a_note_that_makes_no_sense_is_named_and_costs_no_message(
    note: bytes, tmp_path: Path
) -> None:
    path = tmp_path / "a.xtwire"
    path.write_bytes(b"\x89XTWIRE\n" + struct.pack("<II", 1, len(note)) + note)
    pong = Connection(Role.MODULE).send(m.Pong(value=0xAAEEAEEA))
    with path.open("ab") as stream:
        stream.write(b"<" + struct.pack("<qI", 7, len(pong)) + pong)
    done = convert(path, tmp_path / "copy.mcap")
    assert [(fault.file, fault.minor) for fault in done.faults] == [(path.name, True)]
    assert list(read_recording(tmp_path / "copy.mcap")) == [(m.Pong(value=0xAAEEAEEA), 7)]


def test_a_note_without_end_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.xtwire"
    path.write_bytes(b"\x89XTWIRE\n" + struct.pack("<II", 1, 100_000) + b"[" * 100_000)
    with pytest.raises(RecordingError):
        convert(path, tmp_path / "copy")


def mcap_record(code: int, body: bytes) -> bytes:
    return struct.pack("<BQ", code, len(body)) + body


def mcap_chunk(packed: bytes, claimed: int) -> bytes:
    """Return a zstd chunk without a checksum, https://mcap.dev/spec#chunk-op0x06."""
    head = struct.pack("<QQQII", 0, 0, claimed, 0, 4) + b"zstd" + struct.pack("<Q", len(packed))
    return mcap_record(6, head + packed)


def packed_zeros(count: int) -> bytes:
    """Return a Zstandard frame of zeros (RFC 8878): blocks of 128 KiB that repeat one byte."""
    block, n_blocks = 1 << 17, count >> 17
    repeated = (1 << 1 | block << 3).to_bytes(3, "little") + b"\0"
    last = (1 | 1 << 1 | block << 3).to_bytes(3, "little") + b"\0"
    # magic, a content size of 8 bytes, a window of 512 KiB
    head = b"\x28\xb5\x2f\xfd\xc0\x48" + count.to_bytes(8, "little")
    return head + (n_blocks - 1) * repeated + last


@pytest.mark.parametrize(
    ("content", "claimed", "whole"),
    [
        (1 << 33, 1 << 33, True),
        (1 << 33, 1000, True),
        (1 << 33, 1 << 33, False),
        (1 << 28, 1 << 28, True),
    ],
    ids=["8 GiB", "8 GiB that claim 1 kB", "8 GiB, cut", "256 MiB"],
)
def test_a_small_file_takes_no_large_memory(
    content: int, claimed: int, whole: bool, tmp_path: Path
) -> None:
    """Bounded by the largest chunk that is believed, 256 MiB, and two copies of it; and soon."""
    assert zstandard.decompress(packed_zeros(1 << 18)) == bytes(1 << 18)
    chunk = mcap_chunk(packed_zeros(content), claimed)
    path = tmp_path / "zeros.mcap"
    magic = b"\x89MCAP0\r\n"
    header = mcap_record(1, bytes(8))
    end = mcap_record(15, bytes(4)) + mcap_record(2, bytes(20)) + magic
    path.write_bytes(magic + header + (chunk + end if whole else chunk[: len(chunk) // 2]))
    assert path.stat().st_size < 300_000
    limit = 4 << 30  # of addresses; a process takes a good one
    script = (
        "import resource, sys; from xethru_protocol.cli import main;"
        f"resource.setrlimit(resource.RLIMIT_AS, ({limit}, {limit})); sys.exit(main(sys.argv[1:]))"
    )
    done = subprocess.run(
        [sys.executable, "-B", "-c", script, "dump", path],
        capture_output=True,
        text=True,
        timeout=seconds(2),
        check=False,
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
    )
    assert done.returncode == 1
    assert "it is cut or damaged: " in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("missing", [1, 8, 100])
def test_a_cut_index_of_mcap_is_reported_after_all_messages(missing: int, tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    convert(copy_of("float", tmp_path), path)
    expected = list(read_recording(path))
    path.write_bytes(path.read_bytes()[:-missing])
    messages, faults = read_with_faults(path)
    assert len(messages) == len(expected)
    assert [fault.offset for fault in faults] == [path.stat().st_size]


def test_the_index_of_a_whole_mcap_file_is_read_and_a_damaged_one_is_not(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    convert(copy_of("float", tmp_path), path)
    whole = path.read_bytes()
    (at,) = struct.unpack_from("<Q", whole, len(whole) - 28)  # behind the data, by the footer
    found = list(index_of(io.BytesIO(whole), len(whole)))
    assert (found[0].at, found[-1].at) == (at, len(whole) - 37)
    assert found[-1].code == 0x02
    damaged = bytearray(whole)
    damaged[at + 12] ^= 1
    assert not list(index_of(io.BytesIO(damaged), len(damaged)))


def test_a_record_of_mcap_that_claims_more_than_the_file_is_not_waited_for(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(b"\x89MCAP0\r\n\x06" + struct.pack("<Q", 3_000_000_000))
    with pytest.raises(RecordingError):
        list(read_recording(path))


@pytest.mark.parametrize("length", range(46))
def test_a_record_that_is_too_short_is_a_value_error(length: int) -> None:
    """The body of Statistics begins with numbers of 8, 2, 4, 4, 4, 4, 8 and 8 bytes."""
    with pytest.raises(ValueError, match="a record ends"):
        LocatedRecord(at=0, code=0x0B, body=bytes(length)).content()
