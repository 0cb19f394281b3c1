"""What other programs draw of a session, read by rosbags: nothing of ours takes it apart."""

import json
import math
import re
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from hil_tests.paths import FIXTURES
from hil_tests.unit.slam.app.sessions import (
    FRAME_NS,
    feed,
    odometry,
    scan,
    session_info,
    smoothed_run,
    snapshot,
)
from hil_tests.unit.slam.live.session.test_state_rows import robust_state
from slam.app.session.viewer_topics import Drawings, Topics
from slam.app.session.writer import SessionLog
from slam.imaging.back_projection import Grid
from slam.live.odometry_track import TumSample
from slam.live.session import cdr
from slam.live.session_records import RadarImage, Scan, SessionInfo, Snapshot

LIGHT_OVER_MODULE = 299_792_458.0 / 3.0e8
Messages = dict[str, list[tuple[int, Any]]]


def read(path: Path) -> Messages:
    """Read every message of every topic: time in the file, and what rosbags makes of it.

    Each is packed as rosbags packs it.
    """
    found = defaultdict(list)
    with AnyReader([path]) as reader:
        store = reader.typestore
        for connection, t_ns, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            assert bytes(store.serialize_cdr(message, connection.msgtype)) == raw, connection.topic
            found[connection.topic].append((t_ns, message))
    return found


def written(
    path: Path,
    states: Iterable[Snapshot] = (),
    scans: Iterable[Scan] = (),
    info: SessionInfo | None = None,
    *,
    drawn: bool = True,
) -> Messages:
    log = SessionLog(path, info or session_info(), drawn=drawn)
    for one in scans:
        log.on_scan(one)
    for state in states:
        log.on_snapshot(state)
    log.close()
    return read(path)


DRAWN = {
    "/estimate/odometry": "nav_msgs/msg/Odometry",
    "/estimate/path": "nav_msgs/msg/Path",
    "/estimate/path_points": "sensor_msgs/msg/PointCloud2",
    "/estimate/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/fields_of_view": "visualization_msgs/msg/MarkerArray",
    "/landmarks/markers": "visualization_msgs/msg/MarkerArray",
    "/odom/path": "nav_msgs/msg/Path",
    "/odom/path_points": "sensor_msgs/msg/PointCloud2",
    "/rerun/tf_static": "tf2_msgs/msg/TFMessage",
    "/scene": "visualization_msgs/msg/MarkerArray",
    "/slam/smoothed_landmarks": "sensor_msgs/msg/PointCloud2",
    "/slam/smoothed_path": "nav_msgs/msg/Path",
    "/slam/smoothed_path_points": "sensor_msgs/msg/PointCloud2",
    "/truth/path": "nav_msgs/msg/Path",
    "/truth/path_points": "sensor_msgs/msg/PointCloud2",
} | {
    f"/radar/radar{k}/{part}": kind
    for k in range(2)
    for part, kind in (
        ("bscan", "sensor_msgs/msg/Image"),
        ("bscan/axes", "std_msgs/msg/String"),
        ("range", "sensor_msgs/msg/Range"),
    )
}


def test_lean_leaves_out_what_is_drawn_and_nothing_else(tmp_path: Path) -> None:
    contents = {}
    for name, drawn in (("whole", True), ("lean", False)):
        path = tmp_path / f"{name}.mcap"
        log = SessionLog(path, session_info(), odometry(20), drawn=drawn)
        feed(log, 40)
        log.on_snapshot(robust_state(41 * FRAME_NS))
        log.on_smoothed(smoothed_run(40))
        log.close()
        with AnyReader([path]) as reader:
            # a set, as copies of the latched messages are between chunks
            contents[name] = {(c.topic, t_ns, raw) for c, t_ns, raw in reader.messages()}
            types = {c.topic: c.msgtype for c in reader.connections}
        read(path)  # rosbags takes every message apart
        assert {t: k for t, k in types.items() if t in DRAWN} == (DRAWN if drawn else {})
    assert {topic for topic, _, _ in contents["whole"]} >= set(DRAWN)
    assert {row for row in contents["whole"] if row[0] not in DRAWN} == contents["lean"]


def test_the_estimate_has_its_covariance(tmp_path: Path) -> None:
    covariance = np.array([[4.0, 1.0, 0.5], [1.0, 9.0, 0.25], [0.5, 0.25, 16.0]]) * 1e-4
    state = replace(snapshot(7), pose_covariance=covariance)
    found = written(tmp_path / "s.mcap", [state])
    expected = np.zeros((6, 6))  # x, y, z, then the turns about them
    for row, line in zip((0, 1, 5), covariance, strict=True):
        expected[row, [0, 1, 5]] = line
    for topic in ("/estimate/pose", "/estimate/odometry"):
        ((t_ns, message),) = found[topic]
        assert (t_ns, message.header.frame_id) == (7 * FRAME_NS, "map")
        assert message.pose.covariance.tolist() == expected.ravel().tolist()
        x, y, heading = state.estimate.tolist()
        pose = message.pose.pose
        assert (pose.position.x, pose.position.y) == (x, y)
        assert 2.0 * math.atan2(pose.orientation.z, pose.orientation.w) == pytest.approx(heading)


def on_a_circle(t_s: float, speed_mps: float, turn_radps: float) -> NDArray[np.float64]:
    """Return the pose of a robot that turns to the left from the origin, forwards along x."""
    radius_m, turned = speed_mps / turn_radps, turn_radps * t_s
    return np.array([radius_m * math.sin(turned), radius_m * (1 - math.cos(turned)), turned])


def test_a_circle_driven_at_constant_speed_has_that_speed(tmp_path: Path) -> None:
    """By the wheels in /odom and /estimate/odometry, whatever corrections the estimate makes."""
    wheels = {"along_m_per_sqrt_m": 0.002, "scale_sigma": 0.01, "turn_scale_sigma": 0.02}
    wheels |= {"heading_rad_per_sqrt_m": 0.0, "heading_rad_per_rad": 0.0}
    wheels |= {"curvature_sigma_rad_per_m": 0.0, "floor_m": 0.0, "floor_rad": 0.0}
    log = SessionLog(tmp_path / "s.mcap", replace(session_info(), wheels=wheels))
    for k, t_s in enumerate((10.0, 10.2, 10.5)):
        x, y, heading = pose = on_a_circle(t_s, 0.5, 1.5)
        qz, qw = math.sin(heading / 2), math.cos(heading / 2)
        log.on_odometry(TumSample(t_ns=round(t_s * 1e9), x_m=x, y_m=y, qz=qz, qw=qw))
        log.on_snapshot(replace(snapshot(k), t_ns=round(t_s * 1e9), odometry=pose))
    log.close()
    found = read(tmp_path / "s.mcap")
    for topic, frame in (("/odom", "odom"), ("/estimate/odometry", "map")):
        assert len(found[topic]) == 3
        for dt_s, (_, message) in zip((0.2, 0.3), found[topic][1:], strict=True):
            assert (message.header.frame_id, message.child_frame_id) == (frame, "base_link")
            twist = message.twist.twist
            assert [twist.linear.x, twist.linear.y, twist.angular.z] == pytest.approx(
                [0.5, 0.0, 1.5], abs=1e-9
            )
            variances = message.twist.covariance.reshape(6, 6).diagonal()
            along = 0.002**2 * 0.5 * dt_s / dt_s**2 + (0.01 * 0.5) ** 2
            assert variances[0] == pytest.approx(along, rel=1e-6)
            assert variances[5] == pytest.approx((0.02 * 1.5) ** 2, rel=1e-6)
        first = found[topic][0][1].twist
        assert (first.twist.linear.x, float(np.abs(first.covariance).max())) == (0.0, 0.0)


def test_a_standing_robot_and_two_stamps_at_once_have_no_speed(tmp_path: Path) -> None:
    states = [snapshot(0), replace(snapshot(1), odometry=snapshot(0).odometry)]
    states.append(replace(snapshot(2), t_ns=FRAME_NS))
    for _, message in written(tmp_path / "s.mcap", states)["/estimate/odometry"]:
        twist = message.twist.twist
        assert (twist.linear.x, twist.linear.y, twist.angular.z) == (0.0, 0.0, 0.0)


def positions(message: Any) -> NDArray[np.float64]:  # noqa: ANN401 - made at run time by rosbags
    return np.array([[one.pose.position.x, one.pose.position.y] for one in message.poses])


@pytest.mark.parametrize("frame", ["a", "map", "odom", "world", "base_link", "longer_than_a_word"])
@pytest.mark.parametrize("n_poses", [0, 1, 2, 5])
def test_a_path_is_packed_as_ros_has_it(frame: str, n_poses: int) -> None:
    """Names of all lengths, as what follows a text is aligned."""
    stamps_ns = 1_700_000_000_000_000_005 + 10**9 * np.arange(n_poses)
    poses = np.random.default_rng(n_poses).uniform(-3.0, 3.0, (n_poses, 3))
    store = get_typestore(Stores.ROS2_HUMBLE)
    packed = cdr.path(5, frame, stamps_ns, poses)
    found: Any = store.deserialize_cdr(packed, "nav_msgs/msg/Path")
    assert (found.header.frame_id, found.header.stamp.nanosec) == (frame, 5)
    assert len(found.poses) == n_poses
    for one, t_ns, (x, y, heading) in zip(found.poses, stamps_ns, poses, strict=True):
        stamp, pose = one.header.stamp, one.pose
        assert (one.header.frame_id, stamp.sec * 10**9 + stamp.nanosec) == (frame, t_ns)
        assert (pose.position.x, pose.position.y) == (float(np.float32(x)), float(np.float32(y)))
        assert pose.orientation.z == pytest.approx(math.sin(heading / 2), abs=1e-7)
        assert pose.orientation.w == pytest.approx(math.cos(heading / 2), abs=1e-7)
    assert bytes(store.serialize_cdr(found, "nav_msgs/msg/Path")) == packed


def test_paths_begin_together_and_end_where_the_robot_is(tmp_path: Path) -> None:
    """The wheels' path is drawn in the map, as if they had been right until the first state."""
    apart = np.array([5.0, -3.0, math.pi / 2])  # odometry of a robot that was driven before
    states = []
    for k in range(80):
        pose = np.array([0.05 * k, 0.0, 0.0])
        wheels = np.array([apart[0], apart[1] + 0.05 * k, apart[2]])  # turned by 90 degrees
        states.append(
            replace(
                snapshot(k),
                truth=np.array([1.0 + 0.05 * k, 2.0, 0.0]),
                estimate=pose,
                odometry=wheels,
            )
        )
    found = written(tmp_path / "s.mcap", states)
    for topic, start in (("/estimate", (0, 0)), ("/odom", (0, 0)), ("/truth", (1, 2))):
        (_, early), (t_ns, last) = found[f"{topic}/path"]  # after 10 s, and at the end
        assert t_ns == states[-1].t_ns
        expected = np.array(start) + np.outer(0.05 * np.arange(80), [1.0, 0.0])
        np.testing.assert_allclose(positions(last), expected, atol=1e-6)
        assert 40 < len(early.poses) < 60
        np.testing.assert_allclose(positions(early), expected[: len(early.poses)], atol=1e-6)
        (_, points) = found[f"{topic}/path_points"][-1]
        table = points.data.view([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
        np.testing.assert_allclose(table["x"], expected[:, 0], atol=1e-6)
        assert [field.name for field in points.fields] == ["x", "y", "z"]
        assert (points.header.frame_id, last.header.frame_id) == (
            ("world",) * 2 if topic == "/truth" else ("map",) * 2
        )


def test_the_smoothed_run_is_a_path_with_its_landmarks_in_the_map_frame() -> None:
    kept, made = Kept(), smoothed_run(5000)
    drawings = Drawings(kept, session_info(), 0)
    drawings.on_smoothed(smoothed_run(3))
    drawings.on_smoothed(made)
    store = get_typestore(Stores.ROS2_HUMBLE)
    found: Any = store.deserialize_cdr(kept.messages["/slam/smoothed_path"][1], "nav_msgs/msg/Path")
    assert found.header.frame_id == "map"
    # every second pose, from the newest one backwards
    np.testing.assert_allclose(positions(found), made.poses[1::2, :2], atol=1e-5)
    last = found.poses[-1]
    t_ns = last.header.stamp.sec * 1_000_000_000 + last.header.stamp.nanosec
    assert t_ns == made.t_ns[-1]
    cloud: Any = store.deserialize_cdr(
        kept.messages["/slam/smoothed_landmarks"][1], "sensor_msgs/msg/PointCloud2"
    )
    points = cloud.data.view(cdr.LANDMARK_DTYPE)
    assert points["id"].tolist() == [3, 8]
    np.testing.assert_allclose(points["y"], made.landmarks_m[:, 1], rtol=1e-6)
    np.testing.assert_allclose(points["cov_xy"], [0.0, 1e-4], rtol=1e-6)


class Kept(Topics):
    """Topics that keep what is written."""

    def __init__(self) -> None:
        self.messages: dict[str, list[bytes]] = {}

    def add_topic(self, topic: str, message_type: str, *, latched: bool = False) -> None:
        self.messages.setdefault(topic, [])

    def write(
        self,
        topic: str,
        t_ns: int,
        data: bytes,
        *,
        sequence: int = 0,
        publish_ns: int | None = None,
    ) -> None:
        self.messages[topic].append(data)


def test_what_is_written_of_paths_grows_with_the_run_and_not_with_its_square() -> None:
    kept = Kept()
    drawings = Drawings(kept, session_info(), 0)
    state = snapshot(1)
    for k in range(5000):
        pose = np.array([0.001 * k, 0.0, 0.0])
        drawings.on_snapshot(replace(state, t_ns=k * FRAME_NS, estimate=pose))
    drawings.close()
    packed = kept.messages["/estimate/path"]
    assert 95 < len(packed) <= 5000 * FRAME_NS / 10e9 + 1
    whole, short = 72 * 3600 + 64, 72 * 256 + 64  # bytes of so many poses, and the head
    assert max(map(len, packed[:-1])) <= short
    assert len(packed[-1]) <= whole
    store = get_typestore(Stores.ROS2_HUMBLE)
    for message, n_states in ((packed[-1], 5000), (packed[-2], 4980)):
        found: Any = store.deserialize_cdr(message, "nav_msgs/msg/Path")
        x = positions(found)[:, 0]
        assert (x[0], x[-1]) == (0.0, pytest.approx(0.001 * n_states, abs=0.06))
        assert (found.poses[-1].header.stamp.sec) == found.header.stamp.sec
        if n_states == 5000:
            assert len(x) >= 1800
            assert x[-1] == pytest.approx(4.999)
            assert np.diff(x).max() <= 0.002 + 1e-6  # every second state


def groups_of(message: Any) -> dict[str, list[Any]]:  # noqa: ANN401 - as above
    """Return the markers by their group; the first one deletes what was there."""
    first, *rest = message.markers
    assert first.action == 3
    found = defaultdict(list)
    for marker in rest:
        assert marker.action == 0
        found[marker.ns].append(marker)
    return found


def test_landmarks_have_their_ellipses_ten_times_enlarged(tmp_path: Path) -> None:
    walls = np.array([[[0.0, 1.0], [2.0, 1.0]]])
    state = replace(snapshot(11), wall_spans_m=walls)
    (_, message) = written(tmp_path / "s.mcap", [state])["/landmarks/markers"][-1]
    groups = groups_of(message)
    assert {m.header.frame_id for m in message.markers} == {"map"}
    (points,) = groups["landmarks"]
    assert [(p.x, p.y, p.z) for p in points.points] == [(1.01, 0.5, 0.0), (-0.5, 2.02, 0.0)]
    (lines,) = groups["walls"]
    assert (lines.type, [(p.x, p.y) for p in lines.points]) == (5, [(0.0, 1.0), (2.0, 1.0)])
    upright, tilted = groups["95 % ellipses, 10 x"]
    assert (upright.id, tilted.id) == (3, 8)
    # 95 % of a plane's Gaussian lie within 2.4477 sigma; sizes are diameters
    unit = 2.0 * 10.0 * 2.447746830680816
    assert [upright.scale.x, upright.scale.y] == pytest.approx([unit * 0.02, unit * 0.01])
    assert [tilted.scale.x, tilted.scale.y] == pytest.approx(
        [unit * math.sqrt(3e-4), unit * math.sqrt(1e-4)]
    )
    assert (tilted.pose.position.x, tilted.pose.position.y) == (-0.5, 2.02)
    for marker, slope in ((upright, 0.0), (tilted, 1.0)):
        angle = 2.0 * math.atan2(marker.pose.orientation.z, marker.pose.orientation.w)
        assert math.tan(angle) == pytest.approx(slope, abs=1e-9)


@pytest.mark.parametrize("unknown", [math.inf, math.nan])
def test_a_landmark_of_unknown_covariance_has_no_ellipse_and_ends_nothing(
    unknown: float, tmp_path: Path
) -> None:
    covariances = np.array([np.diag([4e-4, 1e-4]), np.full((2, 2), unknown)])
    state = replace(snapshot(11), landmark_covariances_m2=covariances)
    (_, message) = written(tmp_path / "s.mcap", [state])["/landmarks/markers"][-1]
    groups = groups_of(message)
    assert [marker.id for marker in groups["95 % ellipses, 10 x"]] == [3]
    assert len(groups["landmarks"][0].points) == 2


def test_beams_and_the_true_scene_are_there_from_the_start(tmp_path: Path) -> None:
    config = {"back_end": "robust", "robust": {"field_of_view_deg": 60.0}}
    config["detection"] = {"min_range_m": 0.3, "max_range_m": 2.0}
    outline = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0]])
    info = replace(session_info(), config_json=json.dumps(config), outlines_m=(outline,))
    found = written(tmp_path / "s.mcap", [robust_state()], info=info)
    t_ns, message = found["/fields_of_view"][0]  # copies follow it
    wedges = groups_of(message)["fields of view"]
    assert (t_ns, len(wedges)) == (0, 2)
    for wedge, radar in zip(wedges, info.radars, strict=True):
        assert (wedge.header.frame_id, wedge.frame_locked) == ("base_link", True)
        rim = np.array([[p.x, p.y] for p in wedge.points])[1:-1] - [radar.x_m, radar.y_m]
        np.testing.assert_allclose(np.hypot(*rim.T), 2.0)
        ends = np.arctan2(rim[[0, -1], 1], rim[[0, -1], 0]) - radar.yaw_rad
        assert np.rad2deg(ends).tolist() == pytest.approx([-30.0, 30.0])
    _, message = found["/scene"][0]
    groups = groups_of(message)
    assert {m.header.frame_id for m in message.markers} == {"world"}
    assert [(p.x, p.y) for p in groups["true walls"][0].points] == [(0, 0), (4, 0), (4, 3)]
    assert [(p.x, p.y) for p in groups["true landmarks"][0].points] == [(1.0, 0.5), (-0.5, 2.0)]
    for k in range(2):
        ((_, echo),) = found[f"/radar/radar{k}/range"]
        assert echo.field_of_view == pytest.approx(math.radians(60.0))
        assert (echo.min_range, echo.max_range) == (pytest.approx(0.3), 2.0)


def test_without_truth_no_scene_is_drawn(tmp_path: Path) -> None:
    info = replace(session_info(), true_landmarks_m=np.empty((0, 2)))
    states = [replace(snapshot(k), truth=np.full(3, np.nan)) for k in range(3)]
    found = written(tmp_path / "s.mcap", states, info=info)
    assert "/scene" not in found
    assert "/truth/path" not in found
    assert found["/estimate/path"]


def test_the_range_is_that_of_the_strongest_echo(tmp_path: Path) -> None:
    """Radar 1 has two, the stronger one nearer; no echo at all is an infinite range (REP 117)."""
    state = robust_state()
    assert state.step is not None
    silent = replace(
        state, t_ns=10**9, step=replace(state.step, t_ns=10**9, detections=(), range_sigmas_m=())
    )
    found = written(tmp_path / "s.mcap", [state, silent])
    (_, first), (_, none) = found["/radar/radar1/range"]
    assert first.range == np.float32(1 / 3)
    assert (first.header.frame_id, first.header.stamp.nanosec) == ("radar_radar1", 77)
    assert none.range == math.inf
    assert found["/radar/radar0/range"][0][1].range == 0.5


def echo_scan(tick: int, range_m: float, amplitude: float, *, stream: int = 0) -> Scan:
    """Return frames with one pulse at the carrier, whose sign changes from frame to frame."""
    start_m, bin_m = 0.2 * LIGHT_OVER_MODULE, 0.0064 * LIGHT_OVER_MODULE
    away_m = start_m + bin_m * np.arange(1431) - range_m
    wave = np.cos(4.0 * np.pi * 7.29e9 * away_m / 299_792_458.0)
    pulse = (-1) ** tick * amplitude * np.exp(-((away_m / 0.1) ** 2)) * wave
    one = scan(tick)
    frames = tuple(
        replace(
            frame,
            samples=(0.01 + pulse).astype("f4"),
            range_start_m=start_m,
            bin_length_m=bin_m,
            stream=stream,
        )
        for frame in one.frames
    )
    return replace(one, frames=frames)


def pixels(message: Any) -> NDArray[np.float32]:  # noqa: ANN401 - as above
    assert (message.encoding, message.is_bigendian) == ("32FC1", 0)
    assert message.step == 4 * message.width
    values: NDArray[np.float32] = message.data.view("<f4").reshape(message.height, message.width)
    return values


def test_the_b_scan_shows_an_echo_where_it_is_and_how_strong(tmp_path: Path) -> None:
    found = written(tmp_path / "s.mcap", scans=[echo_scan(k, 1.25, 0.02) for k in range(64)])
    _, text = found["/radar/radar0/bscan/axes"][0]
    about = json.loads(text.data)
    (_, _), (t_ns, message) = found["/radar/radar0/bscan"]
    assert (t_ns, message.header.frame_id) == (63 * FRAME_NS, "radar_radar0")
    picture = pixels(message)
    columns = about["columns"]
    assert picture.shape == (64, columns["count"])
    ranges_m = columns["first"] + columns["step"] * np.arange(columns["count"])
    assert ranges_m[-1] == pytest.approx(3.0, abs=0.05)  # twice what SLAM looks at
    assert np.abs(ranges_m[picture.argmax(axis=1)] - 1.25).max() <= columns["step"]
    # the envelope of the pulse is its amplitude, and the constant part of the frames is no echo
    assert about["unit"] == "dB above -62 dB of full scale"
    assert np.abs(picture.max(axis=1) - (20.0 * math.log10(0.02) + 62.0)).max() <= 0.5
    assert picture.min() == 0.0
    assert picture[:, ranges_m > 1.6].max() == 0.0
    assert about["rows"]["step"] == pytest.approx(1.0 / 5.018533)


def test_the_b_scan_grows_and_begins_anew_and_shows_lost_frames(tmp_path: Path) -> None:
    lost = {40, 41}
    scans = [echo_scan(k, 1.0, 0.02) for k in range(170) if k not in lost]
    found = written(tmp_path / "s.mcap", scans=scans)["/radar/radar1/bscan"]
    heights = [message.height for _, message in found]
    assert heights == [32, 66, 98, 130 - 2, 32, 32 + 8]  # of no picture more than 128
    second = pixels(found[1][1])
    assert np.isnan(second[40:42]).all()
    assert np.isfinite(np.delete(second, [40, 41], axis=0)).all()
    assert second[:32].tobytes() == pixels(found[0][1]).tobytes()


def test_another_stream_is_a_gap_of_one_row_whatever_its_counters(tmp_path: Path) -> None:
    scans = [echo_scan(k, 1.0, 0.02) for k in range(16)]
    scans += [echo_scan(k, 1.0, 0.02, stream=1) for k in range(90, 106)]
    ((_, message),) = written(tmp_path / "s.mcap", scans=scans)["/radar/radar0/bscan"]
    assert np.flatnonzero(np.isnan(pixels(message)[:, 0])).tolist() == [16]


def test_a_frame_of_another_length_is_not_drawn_and_ends_nothing(tmp_path: Path) -> None:
    scans = [echo_scan(k, 1.0, 0.02) for k in range(32)]
    short = scans[20].frames[0].samples[:50]
    frames = (replace(scans[20].frames[0], samples=short), scans[20].frames[1])
    scans[20] = replace(scans[20], frames=frames)
    found = written(tmp_path / "s.mcap", scans=scans)
    ((_, message),) = found["/radar/radar0/bscan"]
    assert np.flatnonzero(np.isnan(pixels(message)[:, 0])).tolist() == [20]


def test_rerun_finds_a_way_from_its_own_root_to_the_world(tmp_path: Path) -> None:
    _, message = written(tmp_path / "s.mcap")["/rerun/tf_static"][0]
    (link,) = message.transforms
    assert (link.header.frame_id, link.child_frame_id) == ("tf#/", "world")
    assert link.transform.rotation.w == 1.0


def types_of(path: Path) -> dict[str, str]:
    """Return the type of every topic of a session, its radars called <name>."""
    with AnyReader([path]) as reader:
        return {
            re.sub(r"^/radar/[^/]+/", "/radar/<name>/", connection.topic): connection.msgtype
            for connection in reader.connections
        }


RARE = {  # in few sessions, or not before the robot has moved
    "/image": "nav_msgs/msg/OccupancyGrid",
    "/radar/<name>/stream": "std_msgs/msg/UInt32",
    "/radar/<name>/rx": "std_msgs/msg/UInt8MultiArray",
    "/radar/<name>/tx": "std_msgs/msg/UInt8MultiArray",
    "/radar/<name>/detections": "std_msgs/msg/Float64MultiArray",
    "/session/gap": "std_msgs/msg/String",
    "/slam/smoothed": "std_msgs/msg/Float64MultiArray",
    "/slam/smoothed_landmarks": "sensor_msgs/msg/PointCloud2",
    "/slam/smoothed_path": "nav_msgs/msg/Path",
    "/slam/smoothed_path_points": "sensor_msgs/msg/PointCloud2",
}


def test_every_topic_is_in_the_docs_and_every_topic_of_the_docs_is_there(tmp_path: Path) -> None:
    written(tmp_path / "s.mcap", [robust_state()], [scan(0)])
    text = (FIXTURES.parent / "docs" / "sessions.md").read_text("utf-8")
    rows = re.findall(r"^\| `(/\S+)` \| `(\S+/msg/\S+)` \|", text, re.MULTILINE)
    assert len(dict(rows)) == len(rows)
    assert dict(rows) == types_of(tmp_path / "s.mcap") | RARE


def strings_of(part: object) -> Iterable[str]:
    if isinstance(part, dict):
        for key, value in part.items():
            yield from (key, *strings_of(value))
    elif isinstance(part, list):
        for value in part:
            yield from strings_of(value)
    elif isinstance(part, str):
        yield part


def test_the_views_that_ship_show_what_sessions_have(tmp_path: Path) -> None:
    names = ("left_rear", "left_front", "right_rear", "right_front")
    info = session_info(4)
    radars = zip(info.radars, names, strict=True)
    info = replace(info, radars=tuple(replace(radar, name=name) for radar, name in radars))
    log = SessionLog(tmp_path / "s.mcap", info, odometry(3))
    log.on_scan(scan(1, 4))
    log.on_snapshot(robust_state())
    log.on_smoothed(smoothed_run(3))
    grid = Grid(x_m=0.0, y_m=0.0, cell_m=0.1, rows=1, columns=2)
    log.on_image(RadarImage(t_ns=1, grid=grid, levels=np.array([[-1, 100]], dtype=np.int8)))
    log.close()
    found = read(tmp_path / "s.mcap")
    whole = types_of(tmp_path / "s.mcap")
    foxglove = json.loads((FIXTURES / "views" / "foxglove.json").read_text("utf-8"))
    paths = [text for text in strings_of(foxglove) if text.startswith("/")]
    for path in paths:
        topic, *fields = path.split(".")
        assert re.sub(r"^/radar/[^/]+/", "/radar/<name>/", topic) in whole, topic
        value: Any = found[topic][0][1] if fields else None
        for field in fields:  # of a plot, down to a number
            name, _, index = field.rstrip("]").partition("[")
            value = getattr(value, name)[int(index)] if index else getattr(value, name)
        if fields:
            float(value)
    assert {f"/radar/{name}/bscan" for name in names} <= set(paths)
    assert {"/landmarks/markers", "/estimate/path", "/estimate/pose", "/log"} <= set(paths)
    rviz = (FIXTURES / "views" / "session.rviz").read_text("utf-8")
    displays = re.findall(
        r"Class: rviz_default_plugins/(\w+)\n.*?Durability Policy: ([\w ]+)\n.*?Value: (/\S+)",
        re.sub(r"(?s)\A.*?Show Names", "", rviz),
        re.DOTALL,
    )
    assert displays
    for display, durability, topic in displays:
        kind = whole[re.sub(r"^/radar/[^/]+/", "/radar/<name>/", topic)]
        assert kind.rsplit("/", 1)[1] in {display, f"{display}Stamped"}
        latched = topic in {"/scene", "/fields_of_view"}
        assert durability == ("Transient Local" if latched else "Volatile")
