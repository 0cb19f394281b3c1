"""The session log: what goes in comes out, in rosbags and mcap, also after a crash."""

import cmath
import dataclasses
import json
import struct
import subprocess
import sys
import tracemalloc
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.summary import Summary
from rosbags.highlevel import AnyReader

from hil_tests.unit.slam.app.sessions import (
    feed,
    odometry,
    scan,
    session_info,
    snapshot,
    surviving_counters,
    write_scans,
    write_session,
)
from slam.app.session.writer import CannotWriteError, SessionLog
from slam.geometry import ReceivedPulse
from slam.live.session import cdr
from slam.live.session.reader import open_session
from slam.live.session_records import LogLine
from xethru_protocol.recordings.mcap import McapWriter

N_SCANS = 300


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_session(tmp_path_factory.mktemp("log") / "session.mcap", N_SCANS, odometry(20))


def messages(path: Path, topic: str) -> list[tuple[int, int, Any]]:
    """Return (sequence, log time, message) of one topic, with our types."""
    with path.open("rb") as stream:
        return [
            (message.sequence, message.log_time, cdr.deserialise(message.data, schema.name))
            for schema, _, message in make_reader(stream).iter_messages(topics=[topic])
            if schema is not None
        ]


def summary_of(path: Path) -> Summary:
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return summary


def test_counters_stamps_and_samples_come_back_identical(finished: Path) -> None:
    for radar in range(2):
        rows = messages(finished, f"/radar/radar{radar}/frame")
        assert len(rows) == N_SCANS
        for counter, (sequence, t_ns, message) in enumerate(rows):
            sent = scan(counter).frames[radar]
            assert (sequence, t_ns) == (sent.counter, sent.t_ns)
            assert message.data.tobytes() == sent.samples.tobytes()
            assert message.layout.dim[0].label == "range_bin"


def test_the_pulse_of_a_module_comes_back_for_replay(tmp_path: Path) -> None:
    pulse = ReceivedPulse(
        step_m=0.0388, relative_error=0.02, real=(0.1, 1 / 3, 0.7), imaginary=(0.0, 1e-17, -0.2)
    )
    info = session_info()
    first, *others = info.radars
    radars = (dataclasses.replace(first, pulse=pulse), *others)
    path = write_session(
        tmp_path / "s.mcap", 2, odometry(2), dataclasses.replace(info, radars=radars)
    )
    assert [mount.pulse for mount in open_session(path).rig.mounts] == [pulse, None]


def test_odometry_is_written_as_far_as_the_scans_need_it(tmp_path: Path) -> None:
    path = write_session(tmp_path / "session.mcap", 4, odometry(20))
    last_scan_ns = scan(3).t_ns
    stamps = [t_ns for _, t_ns, _ in messages(path, "/odom")]
    # up to the sample that closes the last interval, and nothing of the future beyond it
    assert stamps[-2] < last_scan_ns <= stamps[-1]


def test_frames_keep_their_own_stamps_and_the_odometry_they_need(tmp_path: Path) -> None:
    """Radars of one scan sample at different times, up to a frame after the scan's own."""
    path = tmp_path / "session.mcap"
    skews_ns = (0, 190_000_000)
    scans = []
    for counter in range(4):
        one = scan(counter)
        frames = tuple(
            dataclasses.replace(frame, t_ns=frame.t_ns + skew_ns)
            for frame, skew_ns in zip(one.frames, skews_ns, strict=True)
        )
        scans.append(dataclasses.replace(one, frames=frames))
    write_scans(path, scans, odometry(20))
    for radar, skew_ns in enumerate(skews_ns):
        stamps = [row[:2] for row in messages(path, f"/radar/radar{radar}/frame")]
        assert stamps == [(counter, scan(counter).t_ns + skew_ns) for counter in range(4)]
    assert messages(path, "/odom")[-1][1] >= scan(3).t_ns + max(skews_ns)


def test_states_landmarks_and_their_covariance_come_back(finished: Path) -> None:
    _, t_ns, cloud = messages(finished, "/landmarks")[7]
    sent = snapshot(7)
    assert t_ns == sent.t_ns
    assert cloud.header.frame_id == "map"
    points = cloud.data.view(cdr.LANDMARK_DTYPE)
    assert points["id"].tolist() == sent.landmark_ids.tolist()
    np.testing.assert_allclose(points["x"], sent.landmarks_m[:, 0], rtol=1e-6)
    np.testing.assert_allclose(points["cov_xy"], sent.landmark_covariances_m2[:, 0, 1], rtol=1e-6)


Planar = tuple[complex, float]
"""Position as a complex number and heading [rad]: turning is multiplying, without our geometry."""


def planar(position: cdr.Message, orientation: cdr.Message) -> Planar:
    assert (position.z, orientation.x, orientation.y) == (0, 0, 0)
    turned = complex(orientation.w, orientation.z) ** 2  # half the angle is in a quaternion
    assert abs(turned) == pytest.approx(1.0)
    return complex(position.x, position.y), cmath.phase(turned)


def chained(first: Planar, second: Planar) -> Planar:
    return first[0] + cmath.rect(1.0, first[1]) * second[0], first[1] + second[1]


def assert_is(found: Planar, expected: Iterable[float]) -> None:
    x, y, heading = map(float, expected)
    assert found[0] == pytest.approx(complex(x, y))
    assert found[1] == pytest.approx(heading)


def links_of(message: cdr.Message) -> dict[tuple[str, str], Planar]:
    return {
        (row.header.frame_id, row.child_frame_id): planar(
            row.transform.translation, row.transform.rotation
        )
        for row in message.transforms
    }


def test_whole_poses_come_back(finished: Path) -> None:
    sent = snapshot(7)
    for topic, frame, pose in (("truth", "world", sent.truth), ("estimate", "map", sent.estimate)):
        _, t_ns, message = messages(finished, f"/{topic}")[7]
        stamp = message.header.stamp
        assert (message.header.frame_id, t_ns) == (frame, sent.t_ns)
        assert stamp.sec * 10**9 + stamp.nanosec == sent.t_ns
        assert_is(planar(message.pose.position, message.pose.orientation), pose)


def test_transforms_chain_to_the_estimate(finished: Path) -> None:
    _, _, message = messages(finished, "/tf")[9]
    links = links_of(message)
    assert set(links) == {("map", "odom"), ("odom", "base_link")}
    assert_is(links["odom", "base_link"], snapshot(9).odometry)
    both = chained(links["map", "odom"], links["odom", "base_link"])
    assert_is(both, snapshot(9).estimate)


def test_transforms_are_of_the_frame_that_odometry_has_since_its_source_was_restarted(
    tmp_path: Path,
) -> None:
    frame, state = np.array([1.0, -2.0, 0.5]), snapshot(3)
    with SessionLog(tmp_path / "s.mcap", session_info(), odometry(20)) as log:
        log.on_scan(dataclasses.replace(scan(3), odom_frame=frame))
        log.on_snapshot(state)
    links = links_of(messages(tmp_path / "s.mcap", "/tf")[0][2])
    assert_is(chained((complex(1.0, -2.0), 0.5), links["odom", "base_link"]), state.odometry)
    assert_is(chained(links["map", "odom"], links["odom", "base_link"]), state.estimate)


def test_the_newest_static_message_holds_every_static_transform(tmp_path: Path) -> None:
    path = tmp_path / "s.mcap"
    log = SessionLog(path, session_info(), odometry(20))
    place = np.array([3.0, -2.0, 0.7])
    for counter in range(3):
        log.on_snapshot(dataclasses.replace(snapshot(counter), world_from_map=place))
    log.close()
    # repeated, so that damage leaves one
    first, *_, last = (links_of(row[2]) for row in messages(path, "/tf_static"))
    for links in (first, last):
        assert_is(links["base_link", "radar_radar0"], (0.1, 0.2, 1.57))
        assert_is(links["base_link", "radar_radar1"], (0.1, 0.5, 0.57))
    assert len(first) == 2
    assert_is(last["world", "map"], place)
    assert len(last) == 3


def test_info_is_latched_and_tells_how_to_read_frames(finished: Path) -> None:
    texts = [message.data for _, _, message in messages(finished, "/radar/radar1/info")]
    assert len(texts) > 2  # repeated, so that damage leaves one
    assert len(set(texts)) == 1
    info = json.loads(texts[0])
    assert info["serial"] == "000000000001"
    assert info["length_unit"] == "module metres, c = 3.0e8 m/s"
    assert (info["n_bins"], info["range_start_m"], info["rate_hz"]) == (1431, 0.2, 5.018533)
    summary = summary_of(finished)
    latched = {c.topic for c in summary.channels.values() if "durability: 1" in str(c.metadata)}
    of_radars = {f"/radar/radar{k}/{part}" for k in range(2) for part in ("info", "bscan/axes")}
    assert latched == {*of_radars, *ONCE}


def test_link_log_keeps_radar_and_level(finished: Path) -> None:
    rows = [row[2] for row in messages(finished, "/log")]
    assert [(row.name, row.level, row.msg) for row in rows] == [
        ("radar0", 20, "Ping -> Pong"),
        ("radar1", 30, "CRC fault"),
    ]


ONCE = ("/session/info", "/tf_static", "/rerun/tf_static", "/scene", "/fields_of_view")
FIRST_NS = 1_700_000_000_123_456_789


def test_a_session_by_the_time_of_day_begins_with_its_first_scan(tmp_path: Path) -> None:
    """Its lines about setting up come before there is a time; at 0 it would span 53 years."""
    path = tmp_path / "s.mcap"
    log = SessionLog(path, session_info(), start_ns=FIRST_NS)
    log.on_log(LogLine(t_ns=0, radar="radar0", warning=False, text="tx Ping"))
    log.on_wire("radar0", "rx", b"pong", 77)
    for k in range(40):
        t_ns = FIRST_NS + scan(k).t_ns
        frames = tuple(dataclasses.replace(frame, t_ns=t_ns) for frame in scan(k).frames)
        log.on_scan(dataclasses.replace(scan(k), t_ns=t_ns, frames=frames))
        log.on_snapshot(dataclasses.replace(snapshot(k), t_ns=t_ns))
    log.on_log(LogLine(t_ns=t_ns, radar="radar0", warning=False, text="tx SetMode"))
    log.close()
    statistics = summary_of(path).statistics
    assert statistics is not None
    assert statistics.message_start_time == FIRST_NS
    assert statistics.message_end_time == FIRST_NS + scan(39).t_ns
    first, last = messages(path, "/log")
    assert (first[1], last[1]) == (FIRST_NS, FIRST_NS + scan(39).t_ns)
    stamp = first[2].stamp
    assert stamp.sec * 10**9 + stamp.nanosec == FIRST_NS
    for latched in ("/tf_static", "/scene", "/fields_of_view", "/radar/radar0/bscan/axes"):
        assert messages(path, latched)[0][1] == FIRST_NS


def test_rosbags_opens_the_bare_file_with_its_own_types(finished: Path) -> None:
    with AnyReader([finished]) as reader:
        types = {c.topic: c.msgtype for c in reader.connections}
        assert types["/landmarks"] == "sensor_msgs/msg/PointCloud2"
        connection = next(c for c in reader.connections if c.topic == "/radar/radar0/frame")
        (_, t_ns, raw), *_ = reader.messages([connection])
        message: Any = reader.deserialize(raw, connection.msgtype)
    assert t_ns == 0
    np.testing.assert_array_equal(message.data, scan(0).frames[0].samples)


def test_chunks_stay_below_the_limit(finished: Path) -> None:
    summary = summary_of(finished)
    sizes = [chunk.uncompressed_size for chunk in summary.chunk_indexes]
    assert len(sizes) > 10
    assert max(sizes) <= 256 * 1024
    assert {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}


def test_a_chunk_is_cut_after_a_second_even_if_small(tmp_path: Path) -> None:
    now = [0]
    path = tmp_path / "s.mcap"
    log = SessionLog(path, session_info(), odometry(20), clock_ns=lambda: now[0])
    before = path.stat().st_size
    log.on_scan(scan(0))
    assert path.stat().st_size == before
    now[0] += 1_000_000_000
    log.on_scan(scan(1))
    assert path.stat().st_size > before
    log.close()


def test_a_file_that_was_never_finished_lacks_its_last_chunk_only(tmp_path: Path) -> None:
    path = tmp_path / "s.mcap"
    log = SessionLog(path, session_info(), odometry(20), clock_ns=lambda: 0)
    feed(log, N_SCANS)
    survived = tmp_path / "survived.mcap"
    survived.write_bytes(path.read_bytes())
    log.close()
    size = path.stat().st_size
    log.close()  # again: does nothing
    assert path.stat().st_size == size
    counters = surviving_counters(survived, "/radar/radar0/frame")
    assert counters == list(range(len(counters)))
    # 256 KiB hold 21 scans of two radars
    assert N_SCANS - 25 <= len(counters) < N_SCANS


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full (Linux)")
def test_a_full_disk_from_the_start_is_one_line() -> None:
    with pytest.raises(CannotWriteError, match="/dev/full cannot be written: No space") as caught:
        SessionLog(Path("/dev/full"), session_info(), odometry(20))
    assert "nothing was recorded" in str(caught.value)


FULL_DISK = """
import sys
from pathlib import Path
from hil_tests.unit.full_disk import full_disk
from hil_tests.unit.slam.app.sessions import feed, session_info
from slam.app.session.writer import CannotWriteError, SessionLog

with full_disk(1_000_000):
    log = SessionLog(Path(sys.argv[1]), session_info(), clock_ns=lambda: 0)
    try:
        feed(log, 300)
    except CannotWriteError as error:
        print(error)
    feed(log, 3)  # goes nowhere
    log.on_wire("radar0", "rx", b"7", 0)
    log.close()
    log.close()
"""


def test_a_full_disk_keeps_every_whole_chunk(tmp_path: Path) -> None:
    path = tmp_path / "s.mcap"
    done = subprocess.run(
        [sys.executable, "-c", FULL_DISK, str(path)], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    (line,) = done.stdout.splitlines()
    assert str(path) in line
    assert "File too large" in line
    session = open_session(path)
    taken = [one for one in session.scans()]
    # a chunk of 256 KiB did not fit into 1 MB any more; what stood before it is whole
    assert 600_000 < path.stat().st_size <= 1_000_000
    assert [one.counter for one in taken] == list(range(len(taken)))
    assert len(taken) > 50
    # the last chunk may end within the scan after the last whole one
    last_s = [taken[-1].t_ns / 1e9, scan(len(taken)).t_ns / 1e9]
    assert any(f"its first {t_s:.1f} s are kept" in line for t_s in last_s)
    assert session.cut_at_byte == path.stat().st_size  # not within a chunk: that room was freed


def test_the_index_leads_to_the_messages_of_every_channel(finished: Path) -> None:
    """What programs seek by: each offset of a chunk's index is a record of that channel."""
    content = finished.read_bytes()
    chunks = summary_of(finished).chunk_indexes
    assert len(chunks) > 3
    for chunk in chunks:
        assert len(chunk.message_index_offsets) > 3
        for channel, at in chunk.message_index_offsets.items():
            # opcode and length of the record, and its channel
            assert struct.unpack_from("<BQH", content, at)[::2] == (0x07, channel)


def test_a_chunk_leaves_little_in_memory(tmp_path: Path) -> None:
    """An hour has thousands of chunks, and the index of each is written at the end."""
    with (tmp_path / "s.mcap").open("wb") as stream:
        writer = McapWriter(stream)
        channels = [writer.add_channel(f"/{n}", "std_msgs/msg/Empty", b"", {}) for n in range(40)]

        def write(n_chunks: int) -> None:
            for _ in range(n_chunks):
                for channel in channels:
                    writer.add_message(channel, 1, b"\0" * 5, 1)
                writer.end_chunk()

        write(10)  # what is there once
        tracemalloc.start()
        try:
            write(500)
            kept = tracemalloc.get_traced_memory()[0]
        finally:
            tracemalloc.stop()
        writer.finish()
    # 40 offsets of ten bytes each; a dictionary of them takes 3 kB
    assert kept / 500 < 1000
