"""A run as programs of ROS 2 see it: each test in a domain of its own, on the loopback interface.

What is received is read by types declared by hand, those of `ros2_robot`.
"""

import hashlib
import json
import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hil_tests.unit.slam.app.ros2_robot import (
    Odometry,
    Path,
    Point,
    PoseWithCovarianceStamped,
    Quaternion,
    Subscriber,
    TFMessage,
    Vector3,
    ros_domain,
    t_ns_of,
    unique_name,
)
from hil_tests.unit.slam.app.sessions import FRAME_NS, scan, session_info, smoothed_run, snapshot
from slam.app.errors import UsageError
from slam.app.odometry.dds import TYPE_HASHES, Ros2Domain, idl_type
from slam.app.publish.ros2 import Ros2Sink
from slam.app.publish.sinks import Publishing
from slam.app.session.viewer_topics import landmark_markers
from slam.geometry import between, compose
from slam.live.session import cdr
from slam.live.session_records import SessionInfo
from xethru_protocol.recordings.mcap import FLOAT_ARRAY, pack_array

LATCHED = {"latched": True}


@pytest.fixture(autouse=True)
def domain() -> Iterator[int]:
    with ros_domain() as number:
        yield number


@pytest.fixture
def space() -> str:
    return unique_name()


def sink_in(space: str, info: SessionInfo | None = None, option: str = "") -> Ros2Sink:
    sink = Ros2Sink(f"{space}{option}")
    sink.open()
    sink.begin(info or session_info(), 0, "a map")
    return sink


def planar(position: Point | Vector3, turn: Quaternion) -> np.ndarray:
    assert (position.z, turn.x, turn.y) == (0.0, 0.0, 0.0)
    return np.array([position.x, position.y, 2.0 * math.atan2(turn.z, turn.w)])


def test_a_state_arrives_as_pose_odometry_and_transform(space: str) -> None:
    sink, state = (
        sink_in(space),
        replace(
            snapshot(3),
            pose_covariance=np.array([[4.0, 1.0, 0.5], [1.0, 3.0, 0.25], [0.5, 0.25, 2.0]]),
        ),
    )
    poses = Subscriber(f"/{space}/uwb_slam/pose", PoseWithCovarianceStamped)
    odometry = Subscriber(f"/{space}/uwb_slam/odometry", Odometry)
    transforms = Subscriber(f"/{space}/tf", TFMessage)
    for each in (poses, odometry, transforms):
        each.wait_for_publisher()
    sink.on_scan(scan(3))
    sink.on_snapshot(state)

    (pose,) = poses.take(1)
    assert (t_ns_of(pose.header), pose.header.frame_id) == (3 * FRAME_NS, "map")
    got = planar(pose.pose.pose.position, pose.pose.pose.orientation)
    np.testing.assert_allclose(got, state.estimate, rtol=1e-15)
    covariance = np.zeros((6, 6))
    covariance[np.ix_((0, 1, 5), (0, 1, 5))] = state.pose_covariance
    assert pose.pose.covariance == covariance.ravel().tolist()

    (whole,) = odometry.take(1)
    assert (whole.header, whole.pose) == (pose.header, pose.pose)
    assert whole.child_frame_id == "base_link"

    (message,) = transforms.take(1)
    (one,) = message.transforms  # odom -> base_link is the robot's
    assert (one.header.frame_id, one.child_frame_id) == ("map", "odom")
    assert t_ns_of(one.header) == 3 * FRAME_NS
    map_from_odom = planar(one.transform.translation, one.transform.rotation)
    np.testing.assert_allclose(
        compose(map_from_odom, state.odometry), state.estimate, rtol=1e-13, atol=1e-15
    )
    sink.close()


def test_the_transform_is_repeated_while_the_robot_stands_and_no_stamp_comes_twice(
    space: str,
) -> None:
    sink = sink_in(space)
    transforms = Subscriber(f"/{space}/tf", TFMessage)
    transforms.wait_for_publisher()
    for counter in range(10):
        sink.on_scan(scan(counter))
        if counter in {1, 2, 7}:
            sink.on_snapshot(snapshot(counter))
    stamps = [t_ns_of(one.transforms[0].header) for one in transforms.take(8)]
    assert stamps == [FRAME_NS * counter for counter in range(1, 9)]
    sink.close()


def test_the_transform_is_of_the_robots_own_odometry_once_that_was_restarted(space: str) -> None:
    sink, state, frame = sink_in(space), snapshot(3), np.array([1.0, -2.0, 0.5])
    transforms = Subscriber(f"/{space}/tf", TFMessage)
    transforms.wait_for_publisher()
    sink.on_scan(replace(scan(3), odom_frame=frame))
    sink.on_snapshot(state)
    (one,) = transforms.take(1)[0].transforms
    map_from_odom = planar(one.transform.translation, one.transform.rotation)
    own = between(frame, state.odometry)  # the pose that the robot's source has now
    np.testing.assert_allclose(compose(map_from_odom, own), state.estimate, atol=1e-12)
    sink.close()


def test_stamps_of_transforms_rise_when_session_time_falls(space: str) -> None:
    """As where a clock was set while a session was recorded that is replayed."""
    sink = sink_in(space)
    transforms = Subscriber(f"/{space}/tf", TFMessage)
    transforms.wait_for_publisher()
    for counter in (50, 51, 3, 4, 5, 53):
        sink.on_scan(scan(counter))
        sink.on_snapshot(snapshot(counter))
    stamps = [t_ns_of(one.transforms[0].header) for one in transforms.take(6)]
    assert stamps == sorted(set(stamps))
    assert (stamps[0], stamps[-1]) == (50 * FRAME_NS, 53 * FRAME_NS)
    sink.close()


def test_who_comes_later_gets_paths_and_map(space: str) -> None:
    sink = sink_in(space)
    for counter in range(30):
        sink.on_snapshot(snapshot(counter))
    sink.on_smoothed(smoothed_run(30))
    (path,) = Subscriber(f"/{space}/uwb_slam/path", Path, **LATCHED).take(1)
    last_ns = t_ns_of(path.poses[-1].header)
    assert t_ns_of(path.header) == last_ns
    np.testing.assert_allclose(
        [[one.pose.position.x, one.pose.position.y] for one in path.poses],
        [snapshot(counter).estimate[:2] for counter in range(last_ns // FRAME_NS + 1)],
        rtol=1e-6,
    )
    (smoothed,) = Subscriber(f"/{space}/uwb_slam/smoothed_path", Path, **LATCHED).take(1)
    np.testing.assert_allclose(
        [one.pose.position.x for one in smoothed.poses], smoothed_run(30).poses[:, 0], rtol=1e-6
    )
    markers = Subscriber(f"/{space}/uwb_slam/landmarks", idl_type(cdr.MARKERS), **LATCHED)
    (drawn,) = markers.take(1)
    expected = cdr.deserialise(drawn.packed, cdr.MARKERS).markers
    assert [one.ns for one in expected] == ["", "landmarks", *["95 % ellipses, 10 x"] * 2]
    sink.close()


def test_with_frames_their_samples_are_published(space: str) -> None:
    info = session_info()
    names = (replace(info.radars[0], name="right"), replace(info.radars[1], name="left 2"))
    sink = sink_in(space, replace(info, radars=names), ",frames")
    topic = f"/{space}/uwb_slam/frames/radar_left_2"
    frames = Subscriber(topic, idl_type(FLOAT_ARRAY))
    frames.wait_for_publisher()
    sink.on_scan(scan(4))
    (message,) = frames.take(1)
    samples = cdr.deserialise(message.packed, FLOAT_ARRAY).data
    np.testing.assert_array_equal(samples, scan(4).frames[1].samples)
    assert len({offer.topic for offer in Ros2Domain().offers()} & {topic}) == 1
    sink.close()


@pytest.mark.parametrize(
    ("session_s", "started_s", "ros_s"),
    [(0, 1_700_000_000, 1_700_000_000), (1_700_000_000, -5, 1_700_000_000), (0, None, 0)],
)
def test_stamps_are_the_odometrys_where_it_counts_from_1970_or_else_the_time_of_day(
    space: str, session_s: int, started_s: int | None, ros_s: int
) -> None:
    started_ns = None if started_s is None else started_s * 10**9
    sink = sink_in(space, replace(session_info(), started_unix_ns=started_ns))
    poses = Subscriber(f"/{space}/uwb_slam/pose", PoseWithCovarianceStamped)
    poses.wait_for_publisher()
    sink.on_snapshot(replace(snapshot(1), t_ns=session_s * 10**9 + 7))
    (pose,) = poses.take(1)
    assert t_ns_of(pose.header) == ros_s * 10**9 + 7
    sink.close()


def test_another_domain_hears_nothing(
    space: str, domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    sink = sink_in(space)
    topic = f"/{space}/uwb_slam/pose"
    near = Subscriber(topic, PoseWithCovarianceStamped)
    near.wait_for_publisher()
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain % 100 + 1))
    far = Subscriber(topic, PoseWithCovarianceStamped)
    sink.on_snapshot(snapshot(1))
    near.take(1)
    assert far.reader.get_matched_publications() == []
    assert far.reader.take(1) == []
    sink.close()


def test_a_subscriber_that_goes_or_never_takes_costs_the_run_nothing(space: str) -> None:
    """One is gone after ten states; one never takes any, and keeps the first hundred."""
    goes = Subscriber(f"/{space}/uwb_slam/odometry", Odometry)
    sleeps = Subscriber(f"/{space}/uwb_slam/pose", PoseWithCovarianceStamped, kept=100)
    stays = Subscriber(f"/{space}/uwb_slam/pose", PoseWithCovarianceStamped)
    logged: list[str] = []

    def log(subject: str, text: str, *, warning: bool) -> None:
        logged.append(text)

    info = session_info()
    with Publishing([f"ros2:{space}"]) as publishing:
        for each in (goes, sleeps, stays):
            each.wait_for_publisher()
        publishing.begin(info, log)
        for counter in range(100):
            publishing.take(snapshot(counter))
            if counter == 10:
                goes.take(1)
                goes.close()
        got = stays.take(100)
    assert [t_ns_of(one.header) for one in got] == [FRAME_NS * k for k in range(100)]
    (queued,) = publishing.queued
    assert (queued.n_sent, queued.n_dropped, queued.n_failed) == (100, 0, 0)
    assert logged == []
    assert len(sleeps.take(100)) == 100


def messages() -> Iterator[tuple[str, bytes]]:
    """Yield a message of every type that is published or read, as this program packs it."""
    state, run = snapshot(2), smoothed_run(7)
    twist = cdr.Twist(velocity=np.array([0.1, 0.2, 0.3]), covariance=np.diag([1.0, 2.0, 3.0]))
    covariance = state.pose_covariance
    links = {("map", "odom"): state.odometry, ("odom", "b"): state.estimate}
    yield cdr.TRANSFORMS, cdr.transforms(10**18 + 3, links)
    placed = cdr.planar(state.estimate)
    yield cdr.ODOMETRY, cdr.odometry(5, "map", placed, covariance, twist)
    pose = cdr.pose_with_covariance(5, "map_frame", state.estimate, covariance)
    yield cdr.POSE_WITH_COVARIANCE, pose
    yield cdr.PATH, cdr.path(5, "map", run.t_ns, run.poses)
    yield cdr.MARKERS, cdr.markers(5, "map", landmark_markers(state))
    yield FLOAT_ARRAY, pack_array(FLOAT_ARRAY, scan(1).frames[0].samples)


@pytest.mark.parametrize(("message_type", "packed"), list(messages()))
def test_cyclone_packs_every_message_into_the_same_bytes(message_type: str, packed: bytes) -> None:
    codec = idl_type(message_type).__idl__
    codec.populate()
    message = codec.deserialize(packed)
    # Cyclone pads the end to four bytes, and says so in the header
    assert codec.serialize(message, use_version_2=False)[4:].rstrip(b"\0") == packed[4:].rstrip(
        b"\0"
    )


_TYPE_IDS = {
    "uint8": 3,
    "int32": 6,
    "uint32": 7,
    "float32": 10,
    "float64": 11,
    "bool": 15,
    "string": 17,
}
"""Of type_description_interfaces/msg/FieldType; 48 more of an array, 144 of a sequence."""


def described(message_type: str, described_types: dict[str, Any]) -> None:
    """Add the description of a type by REP 2016, and of all that it refers to."""
    from rosbags.interfaces import Nodetype
    from rosbags.typesys import Stores, get_typestore

    fields = []
    store: Any = get_typestore(Stores.ROS2_JAZZY)
    for name, (kind, value) in store.fielddefs[message_type][1]:
        added, capacity = 0, 0
        if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            added = 48 if kind == Nodetype.ARRAY else 144
            capacity = value[1]
            kind, value = value[0]
        nested = value if kind == Nodetype.NAME else ""
        number = 1 if nested else _TYPE_IDS[value[0]]
        fields.append(
            {
                "name": name,
                "type": {
                    "type_id": number + added,
                    "capacity": capacity,
                    "string_capacity": 0,
                    "nested_type_name": nested,
                },
            }
        )
        if nested:
            described(nested, described_types)
    described_types[message_type] = {"type_name": message_type, "fields": fields}


@pytest.mark.parametrize("message_type", sorted(TYPE_HASHES))
def test_hashes_are_those_of_the_definitions_by_rep_2016(message_type: str) -> None:
    known: dict[str, Any] = {}
    described(message_type, known)
    whole = {
        "type_description": known.pop(message_type),
        "referenced_type_descriptions": [known[name] for name in sorted(known)],
    }
    assert hashlib.sha256(json.dumps(whole).encode()).hexdigest() == TYPE_HASHES[message_type]


def test_ros_from_iron_on_finds_the_hash_of_a_type(space: str) -> None:
    from cyclonedds.core import Policy

    sink = sink_in(space)
    subscriber = Subscriber(f"/{space}/tf", TFMessage)
    subscriber.wait_for_publisher()
    (handle,) = subscriber.reader.get_matched_publications()
    endpoint = subscriber.reader.get_matched_publication_data(handle)
    (user_data,) = [policy for policy in endpoint.qos if isinstance(policy, Policy.Userdata)]
    assert user_data.data == f"typehash=RIHS01_{TYPE_HASHES[cdr.TRANSFORMS]};".encode()
    sink.close()


@pytest.mark.parametrize("text", ["9", "a b", "a//b", "a,b", ",", "a:b", "\u00e4"])
def test_what_is_no_namespace_is_wrong_usage(text: str) -> None:
    with pytest.raises(UsageError):
        Ros2Sink(text)


def test_without_a_namespace_the_transform_is_on_tf() -> None:
    sink = Ros2Sink("")
    sink.open()
    offers = {(offer.topic, offer.message_type) for offer in Ros2Domain().offers()}
    assert ("/tf", cdr.TRANSFORMS) in offers
    assert ("/uwb_slam/pose", cdr.POSE_WITH_COVARIANCE) in offers
    sink.close()
