"""A recorder's clock that is set back, or stored damaged: times do not fall, the counter tells."""

import itertools
import shutil
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from hil_tests.unit.xethru_protocol.recordings.messages import (
    META,
    MS,
    frame,
    presence,
    read_with_faults,
    write_capture,
)
from xethru_protocol.recordings import (
    RecordingError,
    RecordingFacts,
    RecordingFault,
    RecordingReader,
    RecordingWriter,
    convert,
    load,
)
from xethru_protocol.recordings.clock import steady
from xethru_protocol.recordings.mcap import write_mcap
from xethru_protocol.recordings.recorded_messages import TimedMessages
from xethru_protocol.wire import messages as m

START_MS = 1_700_000_000_000
PERIOD_MS = 100
# as a recorder stores them whose clock begins anew with frame 6, counter 17; one frame is missing
COUNTERS = [11, 12, 13, 14, 15, 17, 18, 19]
STORED_MS = [0, 100, 200, 300, 400, 0, 100, 200]
RIGHT_MS = [0, 100, 200, 300, 400, 600, 700, 800]


def _timed(stored_ms: Sequence[int]) -> list[tuple[m.Response, int | None]]:
    return [
        (frame(counter, 3), (START_MS + ms) * MS)
        for counter, ms in zip(COUNTERS, stored_ms, strict=True)
    ]


def _write_vendor(path: Path, stored_ms: Sequence[int]) -> None:
    """Write times that rise, then those that are wanted into the index."""
    with RecordingWriter(path) as writer:
        for (message, _), ms in zip(_timed(stored_ms), range(len(stored_ms)), strict=True):
            writer.write(message, (START_MS + ms) * MS)
    meta = bytearray((path / META).read_bytes())
    for ms, wanted in reversed(list(enumerate(stored_ms))):
        at = meta.index(struct.pack("<IBI", ms, 1, 1 << 10))
        meta[at : at + 4] = struct.pack("<I", wanted)
    (path / META).write_bytes(meta)


def _write(path: Path, stored_ms: Sequence[int]) -> None:
    """Write frames with times that are stored as they are."""
    match path.suffix:
        case "":
            _write_vendor(path, stored_ms)
        case ".xtwire":
            write_capture(path, _timed(stored_ms))
        case ".mcap":
            write_mcap(path, _timed(stored_ms), RecordingFacts())
        case ".npz":
            t_ns = (START_MS + np.array(stored_ms)) * MS
            np.savez(path, rf=np.zeros((len(t_ns), 3), np.float32), t_ns=t_ns, counter=COUNTERS)
        case ".csv":
            rows = zip(COUNTERS, stored_ms, strict=True)
            lines = [f"{(START_MS + ms) * MS},{counter},1,2,3\n" for counter, ms in rows]
            path.write_text("t_ns,counter,rf_0,rf_1,rf_2\n" + "".join(lines))


FORMATS = ["rec", "a.xtwire", "a.mcap", "a.npz", "a.csv"]


@pytest.mark.parametrize("name", FORMATS)
def test_behind_a_restart_the_counter_gives_the_times(name: str, tmp_path: Path) -> None:
    _write(tmp_path / name, STORED_MS)
    faults: list[RecordingFault] = []
    radar = load(tmp_path / name, faults.append).radar
    assert radar.t_ns is not None
    assert ((radar.t_ns // MS - START_MS) == RIGHT_MS).all()
    assert radar.frame_rate_hz == pytest.approx(1000 / PERIOD_MS)
    assert [fault.minor for fault in faults] == [True]
    assert "0.400 s" in faults[0].reason, "how far it was set back"
    assert load(tmp_path / name).radar.n_frames == len(COUNTERS), "no message is lost"


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("at", range(len(COUNTERS) - 1))
@pytest.mark.parametrize("off_ms", [-1_000_000_000, 1_000_000])
def test_one_damaged_time_does_not_move_the_others(
    at: int, off_ms: int, name: str, tmp_path: Path
) -> None:
    if name == "rec" and off_ms < 0:
        off_ms = -RIGHT_MS[at]  # the format has none before the start
    stored = [ms + off_ms * (row == at) for row, ms in enumerate(RIGHT_MS)]
    _write(tmp_path / name, stored)
    radar = load(tmp_path / name, lambda fault: None).radar
    assert radar.t_ns is not None
    found_ms = radar.t_ns // MS - START_MS
    assert (np.diff(found_ms) >= 0).all()
    others = np.arange(len(stored)) != at
    if at > 0 or off_ms > 0:  # a clock that was set ahead behind the first frame is possible
        assert (found_ms == RIGHT_MS)[others].all()


def test_without_a_counter_times_go_on_and_the_note_says_so() -> None:
    timed = [(m.Ack(), second * 10**9) for second in (5, 6, 7, 1, 2)]
    faults: list[RecordingFault] = []
    found = [t_ns for _, t_ns in steady(iter(timed), "a", faults.append)]
    assert found == [5 * 10**9, 6 * 10**9, 7 * 10**9, 7 * 10**9, 8 * 10**9]
    assert len(faults) == 1


def test_single_records_have_the_times_of_the_stream(tmp_path: Path) -> None:
    _write(tmp_path / "rec", STORED_MS)
    whole, _ = read_with_faults(tmp_path / "rec")
    with RecordingReader(tmp_path / "rec") as reader:
        assert [record.t_ns for record in reader] == [t_ns for _, t_ns in whole]
        assert reader.duration_ns == RIGHT_MS[-1] * MS
        reader.seek_ms(650)
        assert reader.read().t_ns == (START_MS + 700) * MS


def test_text_files_without_an_index_begin_anew_each(tmp_path: Path) -> None:
    """Times of the next file begin before those of the last end; that is no fault."""
    with RecordingWriter(tmp_path / "rec") as writer:
        for second in range(3):
            writer.write(presence(second), second * 10**9)
            status = m.SleepStage(counter=second, stage=1)
            writer.write(status, second * 10**9)
    (tmp_path / "rec" / META).unlink()
    found, faults = read_with_faults(tmp_path / "rec")
    assert sorted(t_ns or 0 for _, t_ns in found) == [0, 0, 10**9, 10**9, 2 * 10**9, 2 * 10**9]
    assert [fault.file for fault in faults] == [META]


@pytest.mark.parametrize("target", ["b.xtwire", "b.mcap", "b.csv", "b.npz", "copy", "b.pcap"])
def test_what_is_converted_has_times_that_do_not_fall(target: str, tmp_path: Path) -> None:
    _write(tmp_path / "a.xtwire", STORED_MS)
    done = convert(tmp_path / "a.xtwire", tmp_path / target)
    assert len(done.faults) == 1
    if target.endswith(".pcap"):
        data = (tmp_path / target).read_bytes()[24:]
        found_ms = []
        while data:
            seconds, rest_ns, size, _ = struct.unpack_from("<IIII", data)
            found_ms.append(seconds * 1000 + rest_ns // MS - START_MS)
            data = data[16 + size :]
    else:
        t_ns = load(tmp_path / target).radar.t_ns
        assert t_ns is not None
        found_ms = list(t_ns // MS - START_MS)
    assert found_ms == RIGHT_MS


def test_the_shipped_example_of_a_restart(tmp_path: Path) -> None:
    """Ten frames a second by counter and by each half of the times."""
    _write(tmp_path / "rec", [0, 120, 228, 298, 412, 0, 104, 198])
    shutil.copytree(tmp_path / "rec", tmp_path / "again")
    rate_hz = load(tmp_path / "again").radar.frame_rate_hz
    assert rate_hz == pytest.approx(10, abs=0.6)


def test_lines_behind_the_end_of_an_index_keep_their_own_times(tmp_path: Path) -> None:
    """A killed recorder leaves files of lines whose times overlap; no clock was set back."""
    times_ns = [(START_MS + 500 * number) * MS for number in range(12)]
    with RecordingWriter(tmp_path / "r") as writer:
        for number, t_ns in enumerate(times_ns):
            text = m.DataString(content_id=0, info=number, text=str(number))
            writer.write(text if number % 2 else presence(number), t_ns)
    meta = tmp_path / "r" / META
    third = meta.read_bytes().index(struct.pack("<IB", 1000, 1))
    meta.write_bytes(meta.read_bytes()[:third])
    found, faults = read_with_faults(tmp_path / "r")
    assert [t_ns for _, t_ns in found] == times_ns
    assert ["never completed" in fault.reason for fault in faults] == [True]


def test_an_error_comes_behind_all_messages_before_it() -> None:
    """Also behind the last one, which the next time might have put right."""
    timed = _timed(RIGHT_MS)

    def cut() -> TimedMessages:
        yield from timed
        raise RecordingError("cut")

    read = steady(cut(), "a.xtwire", None)
    assert list(itertools.islice(read, len(timed))) == timed
    with pytest.raises(RecordingError):
        next(iter(read))


@pytest.mark.parametrize("late_ms", [50, 250])
def test_a_message_that_was_stored_late_keeps_its_time_and_moves_no_other(
    late_ms: int, tmp_path: Path
) -> None:
    rows: list[tuple[m.Response, int | None]] = []
    for counter in range(12):
        rows.append((frame(counter, 3), (START_MS + counter * PERIOD_MS) * MS))
        if counter % 4 == 3:
            late = m.DataString(text=str(counter))
            rows.append((late, (START_MS + counter * PERIOD_MS - late_ms) * MS))
    write_mcap(tmp_path / "x.mcap", iter(rows), RecordingFacts())
    found, faults = read_with_faults(tmp_path / "x.mcap")
    assert faults == []
    for kind in (m.DataFloat, m.DataString):
        assert [row for row in found if isinstance(row[0], kind)] == [
            row for row in rows if isinstance(row[0], kind)
        ]
