"""A recorded session comes back as it was; damaged and foreign files are one line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer

from hil_tests.unit.slam.app.sessions import FRAME_NS, feed, scan, session_info, snapshot
from slam.app.errors import AppError
from slam.app.odometry import OdometryTrack
from slam.app.session import LogLine
from slam.app.session_log import SessionLog
from slam.app.session_reader import TruthPose, open_session, scans
from slam.app.tum import TumSample, format_tum_line
from slam.frames import RadarFrame

N_SCANS = 60
LIGHT_OVER_MODULE = 299_792_458.0 / 3.0e8


def odometry() -> OdometryTrack:
    poses = [np.array([k / 3, k / 7, k / 11]) for k in range(80)]
    return OdometryTrack.from_lines(
        [format_tum_line(k * 200_000_000 + k, pose) for k, pose in enumerate(poses)]
    )


@pytest.fixture(scope="module")
def session_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("session") / "session.mcap"
    log = SessionLog(path, session_info(), odometry())
    feed(log, N_SCANS)
    log.close()
    return path


def test_head_and_rig_are_those_of_the_run(session_file: Path) -> None:
    session = open_session(session_file)
    expected = session_info()
    assert session.info.radars == expected.radars
    assert (session.info.scene, session.info.seed) == ("made_up", 7)
    np.testing.assert_array_equal(session.info.true_landmarks_m, expected.true_landmarks_m)
    assert [(m.name, m.x_m, m.y_m) for m in session.rig.mounts] == [
        ("radar0", 0.1, 0.2),
        ("radar1", 0.1, 0.5),
    ]


def test_frames_come_back_in_true_metres_with_their_own_stamps(session_file: Path) -> None:
    frames = [r for r in open_session(session_file).records() if isinstance(r, RadarFrame)]
    assert len(frames) == 2 * N_SCANS
    for index, frame in enumerate(frames):
        sent = scan(index // 2).frames[index % 2]
        assert (frame.radar, frame.counter, frame.t_ns) == (sent.radar, sent.counter, sent.t_ns)
        assert frame.samples.tobytes() == sent.samples.tobytes()
        assert frame.range_start_m == pytest.approx(0.2 * LIGHT_OVER_MODULE, rel=1e-12)
        assert frame.bin_length_m == pytest.approx(0.0064 * LIGHT_OVER_MODULE, rel=1e-12)


def test_odometry_truth_and_log_come_back(session_file: Path) -> None:
    records = list(open_session(session_file).records())
    samples = [r for r in records if isinstance(r, TumSample)]
    assert tuple(samples) == odometry().samples[: len(samples)]
    assert samples[-1].t_ns >= (N_SCANS - 1) * FRAME_NS
    truths = [r for r in records if isinstance(r, TruthPose)]
    assert len(truths) == N_SCANS
    np.testing.assert_allclose(truths[7].pose, snapshot(7).truth, atol=1e-12)
    lines = [r for r in records if isinstance(r, LogLine)]
    assert [(line.radar, line.warning) for line in lines] == [("radar0", False), ("radar1", True)]


def test_scans_group_by_tick_also_where_a_radar_started_whole_periods_late(tmp_path: Path) -> None:
    info = session_info()
    late = replace(info.radars[1], start_skew_ns=FRAME_NS + 50_000_000)
    info = replace(info, radars=(info.radars[0], late))
    path = tmp_path / "late.mcap"
    log = SessionLog(path, info, odometry())
    for tick in range(5):
        first, second = scan(tick).frames
        frames = (first,) if tick == 0 else (first, replace(second, counter=tick - 1))
        log.on_scan(replace(scan(tick), frames=frames))
    log.close()
    grouped = list(scans(open_session(path)))
    assert [(s.counter, [f.counter for f in s.frames]) for s in grouped] == [
        (0, [0]),
        *((tick, [tick, tick - 1]) for tick in range(1, 5)),
    ]
    assert [s.t_ns for s in grouped] == pytest.approx([tick * FRAME_NS for tick in range(5)])


@pytest.mark.parametrize("share", [0.3, 0.5, 0.77, 0.9])
def test_a_cut_file_is_read_to_its_last_message(
    session_file: Path, tmp_path: Path, share: float
) -> None:
    content = session_file.read_bytes()
    path = tmp_path / "cut.mcap"
    path.write_bytes(content[: round(share * len(content))])
    session = open_session(path)
    frames = [r for r in session.records() if isinstance(r, RadarFrame)]
    assert session.cut_at_byte is not None
    sent = [frame for k in range(N_SCANS) for frame in scan(k).frames]
    # whole frames only, in order, none skipped; frames hardly compress, so as many as fit
    assert [f.samples.tobytes() for f in frames] == [f.samples.tobytes() for f in sent][
        : len(frames)
    ]
    assert len(frames) >= share * len(sent) - 26  # a block of zstd holds 128 KiB, 23 frames


def test_a_whole_file_is_not_called_cut(session_file: Path) -> None:
    session = open_session(session_file)
    for _ in session.records():
        pass
    assert session.cut_at_byte is None


def foreign(path: Path) -> None:
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD)
        writer.start(profile="", library="somebody")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        channel = writer.register_channel("/chatter", "cdr", schema)
        writer.add_message(channel_id=channel, log_time=1, publish_time=1, data=b"\0\1\0\0")
        writer.finish()  # type: ignore[no-untyped-call]  # mcap annotates in part


def test_what_is_no_session_is_one_line(session_file: Path, tmp_path: Path) -> None:
    content = session_file.read_bytes()
    head = content.index(b"/radar/radar0/info") if b"/radar/radar0/info" in content else 400
    damaged = bytearray(content)
    damaged[len(content) // 2] ^= 0xFF
    cases: dict[str, bytes | None] = {
        "missing": None,
        "empty": b"",
        "text": b"hello\n" * 100,
        "magic only": content[:8],
        "head only": content[: min(head, 300)],
        "damaged": bytes(damaged),
    }
    expected = {
        "missing": "cannot read",
        "empty": "no MCAP file",
        "text": "no MCAP file",
        "magic only": "no session",
        "head only": "ends before any radar is named",
        "damaged": "damaged at byte",
    }
    for name, data in cases.items():
        path = tmp_path / f"{name}.mcap"
        if data is not None:
            path.write_bytes(data)
        with pytest.raises(AppError, match=expected[name]) as caught:
            for _ in open_session(path).records():
                pass
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)
    foreign(tmp_path / "foreign.mcap")
    with pytest.raises(AppError, match="no session of"):
        open_session(tmp_path / "foreign.mcap")
    with pytest.raises(AppError, match="cannot read: Is a directory"):
        open_session(tmp_path)
