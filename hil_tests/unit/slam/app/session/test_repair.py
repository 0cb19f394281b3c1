"""What `uwb-slam repair` says and refuses; what it keeps is tested in property/."""

import errno
import json
import signal
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from mcap.opcode import Opcode
from mcap.reader import make_reader

from hil_tests.unit.slam.app.session.mcap_files import chunks_of, records_of, rewrite
from hil_tests.unit.slam.app.sessions import (
    FRAME_NS,
    SlowClock,
    run,
    scan,
    session_info,
    write_session,
)
from slam.app.session.repair import repair
from slam.app.session.writer import SessionLog
from slam.frames import RadarFrame
from slam.live.session.reader import ScanEnd, open_session
from slam.live.session_records import Gap, LogLine
from xethru_protocol.operating_system import StopFlag, StopRequestedError, locked
from xethru_protocol.recordings.mcap import is_latched


@pytest.fixture
def cut(tmp_path: Path) -> Path:
    path = write_session(tmp_path / "session.mcap", 30)
    path.write_bytes(path.read_bytes()[:-200_000])
    return path


def test_it_says_what_is_kept_and_where_the_old_file_is(
    cut: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    size = cut.stat().st_size
    code, out, err = run(capsys, "repair", cut)
    assert (code, err) == (0, "")
    n_scans = sum(1 for _ in open_session(cut).scans())
    assert f"{(n_scans - 1) * 0.199261498:.1f} s" in out
    assert f"{cut}.unrepaired" in out
    assert Path(f"{cut}.unrepaired").stat().st_size == size
    assert run(capsys, "repair", cut)[0] == 0


def test_a_drive_lasts_from_its_first_message_on(tmp_path: Path) -> None:
    """Session time is that of the odometry, which was on for six minutes before."""
    path, before_ns = tmp_path / "session.mcap", 369 * 10**9
    log = SessionLog(path, session_info(), clock_ns=SlowClock())
    log.on_log(LogLine(t_ns=0, radar="radar0", warning=False, text="it begins"))
    for counter in range(30):
        one = scan(counter)
        frames = tuple(replace(frame, t_ns=frame.t_ns + before_ns) for frame in one.frames)
        log.on_scan(replace(one, t_ns=one.t_ns + before_ns, frames=frames))
    log.close()
    for data in (path.read_bytes(), path.read_bytes()[:-2_000]):
        path.write_bytes(data)
        found = repair(path, None, StopFlag())
        assert found.duration_s() == pytest.approx(29 * FRAME_NS / 1e9)


def test_it_never_overwrites_what_it_did_not_write(
    cut: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = cut.read_bytes()
    kept = Path(f"{cut}.unrepaired")
    kept.write_text("precious")
    assert run(capsys, "repair", cut)[:2] == (1, "")
    there = tmp_path / "there.mcap"
    there.write_text("precious")
    assert run(capsys, "repair", cut, "--out", there)[0] == 1
    texts = kept.read_text(), there.read_text()
    assert (cut.read_bytes(), *texts) == (before, "precious", "precious")
    assert sorted(tmp_path.iterdir()) == [cut, kept, there]


def test_a_folder_in_which_a_run_is_recording_is_left_alone(
    cut: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = cut.read_bytes()
    with locked(tmp_path):
        code, out, err = run(capsys, "repair", cut)
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert cut.read_bytes() == before


def test_a_signal_leaves_everything_as_it_was(cut: Path, tmp_path: Path) -> None:
    before = cut.read_bytes()

    class StopWhileWriting(StopFlag):
        def check(self) -> None:
            if (tmp_path / f".{cut.name}.repairing").exists():
                raise StopRequestedError(signal.SIGTERM)

    with pytest.raises(StopRequestedError):
        repair(cut, None, StopWhileWriting())
    assert list(tmp_path.iterdir()) == [cut]
    assert cut.read_bytes() == before


@pytest.mark.parametrize("has_second_names", [True, False], ids=["hard links", "none, as on FAT"])
def test_a_file_that_cannot_take_its_place_leaves_everything_as_it_was(
    has_second_names: bool,
    cut: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = cut.read_bytes()
    replace = Path.replace

    def fail(path: Path, target: Path) -> Path:
        if path.suffix == ".repairing":
            raise OSError(errno.EIO, "Input/output error", str(path))
        return replace(path, target)

    def no_names(path: Path, target: Path) -> None:
        raise OSError(errno.EPERM, "Operation not permitted", str(path))

    monkeypatch.setattr(Path, "replace", fail)
    if not has_second_names:
        monkeypatch.setattr(Path, "hardlink_to", no_names)
    code, _, err = run(capsys, "repair", cut)
    assert (code, err.count("\n")) == (1, 1)
    assert f"{cut} is as it was" in err
    assert (list(tmp_path.iterdir()), cut.read_bytes()) == ([cut], before)
    monkeypatch.setattr(Path, "replace", replace)
    assert run(capsys, "repair", cut)[0] == 0
    assert Path(f"{cut}.unrepaired").read_bytes() == before


@pytest.fixture
def holed(tmp_path: Path) -> Path:
    """Return a session that lacks the chunk in its middle, some ten scans."""
    path = write_session(tmp_path / "session.mcap", 60)
    content = bytearray(path.read_bytes())
    chunks = chunks_of(content)
    content[chunks[len(chunks) // 2] + 2000] ^= 0xFF
    path.write_bytes(content)
    return path


def test_it_says_what_is_lost_and_writes_it_into_the_file(
    holed: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, err = run(capsys, "repair", holed)
    assert (code, err) == (0, "")
    (line,) = [line for line in out.splitlines() if "lost:" in line]
    left = {one.counter for one in open_session(holed).records() if isinstance(one, ScanEnd)}
    gone = sorted(set(range(60)) - left)
    assert gone == list(range(gone[0], gone[-1] + 1)) != []
    assert f"scans {gone[0]} to {gone[-1]}" in line
    with holed.open("rb") as stream:  # what mcap's own reader finds
        texts = [m.data[8:] for _, c, m in make_reader(stream).iter_messages("/session/gap")]
    (row,) = [json.loads(text.rstrip(b"\0")) for text in texts]
    assert row["scans"] == [gone[0], gone[-1]]
    frames = [f for f in open_session(holed).records() if isinstance(f, RadarFrame)]
    n_left = {name: sum(f.radar == k for f in frames) for k, name in enumerate(row["frames"])}
    assert row["frames"] == {name: 60 - n_left[name] for name in ("radar0", "radar1")}
    assert row["from_ns"] <= gone[0] * FRAME_NS <= gone[-1] * FRAME_NS <= row["to_ns"]


def test_damage_of_the_index_loses_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_session(tmp_path / "session.mcap", 60)
    content = bytearray(path.read_bytes())
    (data_end,) = (at for kind, at in records_of(content) if kind == Opcode.DATA_END)
    content[data_end + 13] = 0  # the code of the first record of the index
    path.write_bytes(content)
    code, out, _ = run(capsys, "repair", path)
    assert (code, "nothing that was recorded is lost" in out, "lost:" in out) == (0, True, False)


def test_a_chunk_that_was_cut_out_whole_is_lost(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_session(tmp_path / "session.mcap", 60)

    def n_messages() -> int:  # but those that are repeated
        with path.open("rb") as stream:
            rows = make_reader(stream).iter_messages()
            return sum(not is_latched(channel.metadata) for _, channel, _ in rows)

    n_before = n_messages()
    content = path.read_bytes()
    chunks = chunks_of(content)
    at = chunks[len(chunks) // 2]
    (size,) = struct.unpack_from("<Q", content, at + 1)
    path.write_bytes(content[:at] + content[at + 9 + size :])
    code, out, _ = run(capsys, "repair", path)
    assert (code, "nothing that was recorded is lost" in out) == (0, False)
    assert f"lost: {n_before - n_messages()} messages" in out


def gaps_in(path: Path) -> Iterator[Gap]:
    return (record for record in open_session(path).records() if isinstance(record, Gap))


def test_a_second_repair_keeps_the_gap_of_the_first(holed: Path, tmp_path: Path) -> None:
    first = tmp_path / "first.mcap"
    repair(holed, first, StopFlag())
    content = first.read_bytes()
    again = tmp_path / "again.mcap"
    again.write_bytes(content[:-100])
    out = tmp_path / "out.mcap"
    repair(again, out, StopFlag())
    assert list(gaps_in(out)) == list(gaps_in(first))
    assert len(list(gaps_in(out))) == 1


def test_a_session_that_nothing_describes_is_a_failure(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = write_session(tmp_path / "whole.mcap", 20)
    path = tmp_path / "session.mcap"
    rewrite(
        whole,
        path,
        lambda topic, data: None if topic.endswith("/info") else data,
        with_metadata=False,
        finished=False,
    )
    whole.unlink()
    before = path.read_bytes()
    code, out, err = run(capsys, "repair", path)
    assert (code, out, err.count("\n")) == (1, "", 1)
    assert "is lost" in err
    assert "--out" in err
    assert [path] == list(tmp_path.iterdir())
    assert path.read_bytes() == before
    saved = tmp_path / "saved.mcap"
    code, out, err = run(capsys, "repair", path, "--out", saved)
    assert (code, out, err.count("\n")) == (1, "", 1)
    with saved.open("rb") as stream:
        frames = sum(1 for _ in make_reader(stream).iter_messages("/radar/radar0/frame"))
    assert frames > 10


def test_damage_that_costs_nothing_is_said_to_cost_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write_session(tmp_path / "session.mcap", 20)
    content = bytearray(path.read_bytes())
    copies = chunks_of(content)
    content[copies[1] + 300] ^= 1
    path.write_bytes(content)
    code, out, _ = run(capsys, "repair", path)
    assert code == 0
    assert "nothing that was recorded is lost" in out
    assert list(gaps_in(path)) == []
