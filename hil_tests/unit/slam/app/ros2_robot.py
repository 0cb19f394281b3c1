"""A robot of ROS 2: messages declared by hand, packed and sent by Cyclone DDS itself."""
# mypy: disable-error-code="call-arg, misc"

import os
import random
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import pytest

pytest.importorskip("cyclonedds", reason="cyclonedds is not installed: pip install '.[ros2]'")

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, float64, int32, sequence, uint32
from cyclonedds.internal import InvalidSample
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from hil_tests.patience import seconds
from hil_tests.system.installation import LOOPBACK


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@dataclass
class Point(IdlStruct, typename="geometry_msgs::msg::dds_::Point_"):
    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@dataclass
class Quaternion(IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0
    w: float64 = 1.0


@dataclass
class Pose(IdlStruct, typename="geometry_msgs::msg::dds_::Pose_"):
    position: Point
    orientation: Quaternion


@dataclass
class PoseWithCovariance(IdlStruct, typename="geometry_msgs::msg::dds_::PoseWithCovariance_"):
    pose: Pose
    covariance: array[float64, 36]


@dataclass
class Twist(IdlStruct, typename="geometry_msgs::msg::dds_::Twist_"):
    linear: Vector3 = field(default_factory=Vector3)
    angular: Vector3 = field(default_factory=Vector3)


@dataclass
class TwistWithCovariance(IdlStruct, typename="geometry_msgs::msg::dds_::TwistWithCovariance_"):
    twist: Twist
    covariance: array[float64, 36]


@dataclass
class Odometry(IdlStruct, typename="nav_msgs::msg::dds_::Odometry_"):
    header: Header
    child_frame_id: str
    pose: PoseWithCovariance
    twist: TwistWithCovariance


@dataclass
class Transform(IdlStruct, typename="geometry_msgs::msg::dds_::Transform_"):
    translation: Vector3
    rotation: Quaternion


@dataclass
class TransformStamped(IdlStruct, typename="geometry_msgs::msg::dds_::TransformStamped_"):
    header: Header
    child_frame_id: str
    transform: Transform


@dataclass
class TFMessage(IdlStruct, typename="tf2_msgs::msg::dds_::TFMessage_"):
    transforms: sequence[TransformStamped]


@dataclass
class PoseStamped(IdlStruct, typename="geometry_msgs::msg::dds_::PoseStamped_"):
    header: Header
    pose: Pose


@dataclass
class Path(IdlStruct, typename="nav_msgs::msg::dds_::Path_"):
    header: Header
    poses: sequence[PoseStamped]


@dataclass
class PoseWithCovarianceStamped(
    IdlStruct, typename="geometry_msgs::msg::dds_::PoseWithCovarianceStamped_"
):
    header: Header
    pose: PoseWithCovariance


def stamp(t_ns: int) -> Time:
    return Time(t_ns // 10**9, t_ns % 10**9)


def t_ns_of(header: Header) -> int:
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def odometry(
    t_ns: int,
    x_m: float = 0.0,
    *,
    frames: tuple[str, str] = ("odom", "base_link"),
    turn: Quaternion | None = None,
    twist_covariance: list[float] | None = None,
) -> Odometry:
    pose = Pose(Point(x_m, -0.25, 7.0), turn or Quaternion())
    return Odometry(
        Header(stamp(t_ns), frames[0]),
        frames[1],
        PoseWithCovariance(pose, [0.0] * 36),
        TwistWithCovariance(Twist(), twist_covariance or [0.0] * 36),
    )


def transform(t_ns: int, x_m: float, frames: tuple[str, str]) -> TransformStamped:
    moved = Transform(Vector3(x_m, -0.25, 7.0), Quaternion(0.0, 0.0, 0.6, 0.8))
    return TransformStamped(Header(stamp(t_ns), frames[0]), frames[1], moved)


class Robot:
    """Publishes messages of one type on one topic."""

    def __init__(self, topic: str, kind: type, *, reliable: bool = True) -> None:
        participant = DomainParticipant(int(os.environ["ROS_DOMAIN_ID"]))
        reliability = Policy.Reliability
        qos = Qos(
            reliability.Reliable(duration(seconds=1)) if reliable else reliability.BestEffort,
            Policy.History.KeepLast(10),
        )
        self._writer = DataWriter(participant, Topic(participant, f"rt{topic}", kind), qos=qos)

    def wait_for_listener(self) -> None:
        give_up_s = time.monotonic() + seconds(1.5)
        while not self._writer.get_matched_subscriptions():
            assert time.monotonic() < give_up_s, "nobody listens"
            time.sleep(0.01)

    def publish(self, message: object) -> None:
        self._writer.write(message)

    def close(self) -> None:
        del self._writer


class Subscriber:
    """Takes the messages of one type on one topic, in a domain of the environment."""

    def __init__(
        self, topic: str, kind: type, *, latched: bool = False, kept: int | None = None
    ) -> None:
        participant = DomainParticipant(int(os.environ["ROS_DOMAIN_ID"]))
        durability, history = Policy.Durability, Policy.History
        qos = Qos(
            Policy.Reliability.Reliable(duration(seconds=1)),
            durability.TransientLocal if latched else durability.Volatile,
            history.KeepAll if kept is None else history.KeepLast(kept),
        )
        self.reader = DataReader(participant, Topic(participant, f"rt{topic}", kind), qos=qos)

    def wait_for_publisher(self) -> None:
        give_up_s = time.monotonic() + seconds(1.5)
        while not self.reader.get_matched_publications():
            assert time.monotonic() < give_up_s, "nobody publishes"
            time.sleep(0.01)

    def take(self, at_least: int) -> list[Any]:
        """Return all messages that came, once there are so many."""
        got: list[Any] = []
        give_up_s = time.monotonic() + seconds(1.5)
        while len(got) < at_least:
            assert time.monotonic() < give_up_s, f"{len(got)} of {at_least} messages came"
            got += [one for one in self.reader.take(1000) if not isinstance(one, InvalidSample)]
            time.sleep(0.01)
        return got

    def close(self) -> None:
        del self.reader


@contextmanager
def ros_domain() -> Iterator[int]:
    """Let this process be in a ROS domain of its own, on the loopback interface."""
    number = random.SystemRandom().randrange(1, 101)  # above lie ports that others are given
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(number))
        patch.setenv("CYCLONEDDS_URI", LOOPBACK)
        yield number


def unique_name() -> str:
    """Return a name for a topic: two tests may be in one domain."""
    return f"test_{random.SystemRandom().getrandbits(64):x}"
