"""Odometry from a topic of ROS 2, as TUM lines: nav_msgs/Odometry, or a transform of tf."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NoReturn

from rosbags.serde import SerdeError

from slam.app.odometry.dds import Ros2Domain, domain_number
from slam.live.errors import OdometryError
from slam.live.odometry_track import NS_PER_S, TumSample, format_sample
from slam.live.session import cdr

FRAMES = ("odom", "base_link", "base_footprint")
"""Parent and children of a robot's odometry, as REP 105 and REP 120 name them."""

UNFOUND_S = 8.0
"""After so long without a publisher, or without the transform, what there is instead is named."""
_WAIT_S = 0.2
_LOOK_EVERY_S = 1.0
_MOST_NAMED = 12
_UNKNOWN = ("", False)


def topic_lines(
    topic: str, frames: tuple[str, ...], is_stopped: Callable[[], bool]
) -> Iterator[tuple[str, int]]:
    """Yield a TUM line for each pose, with the host's monotonic time [ns] when it came.

    `frames` are a parent and its possible children, (): those of REP 105. Reading is reliable if
    all publishers are; else best effort, which fits both. Publishers may go and come back.

    Raises
    ------
    OdometryError
        There is no publisher, or its type or its frames are other ones.
    """
    domain, poses = Ros2Domain(), _TopicPoses(topic, *(frames or FRAMES))
    offered = _UNKNOWN
    take: Callable[[float], list[bytes]] = _nothing
    began_s, look_s = time.monotonic(), 0.0
    while not is_stopped():
        now_s = time.monotonic()
        if now_s >= look_s:
            newest = poses.offered(domain)
            if newest not in (_UNKNOWN, offered):
                offered, take = newest, domain.reader(topic, newest[0], reliable=newest[1])
            look_s = now_s + (_LOOK_EVERY_S if offered[0] else _WAIT_S)
        for data in take(_WAIT_S):
            arrival_ns = time.monotonic_ns()
            try:
                for sample in _READERS[offered[0]](poses, data):
                    yield format_sample(sample), arrival_ns
            except SerdeError as error:  # the line is refused, and the user gets a warning
                yield str(error), arrival_ns
        if now_s - began_s > UNFOUND_S and not poses.is_found:
            poses.check(domain, is_published=bool(offered[0]))


def _nothing(wait_s: float) -> list[bytes]:
    time.sleep(wait_s)
    return []


class _TopicPoses:
    """Finds the poses of a child in its parent in the messages of a topic.

    Attributes
    ----------
    is_found
        Whether there was one.
    """

    def __init__(self, topic: str, parent: str, *children: str) -> None:
        self._topic, self._parent, self._children = topic, parent, children
        self._others: set[str] = set()  # pairs of other frames that came
        self.is_found = False

    def offered(self, domain: Ros2Domain) -> tuple[str, bool]:
        """Return the topic's type, "" without a publisher, and whether all are reliable."""
        reliable: dict[str, list[bool]] = {}
        for offer in domain.offers():
            if offer.topic == self._topic:
                reliable.setdefault(offer.message_type, []).append(offer.is_reliable)
        for kind in _READERS.keys() & reliable:
            return kind, all(reliable[kind])
        if reliable:
            self._fail(f"is of type {_named(set(reliable))}; must be {' or '.join(_READERS)}")
        return _UNKNOWN

    def of_odometry(self, data: bytes) -> Iterator[TumSample]:
        message = cdr.deserialise(data, cdr.ODOMETRY)
        if not self._is_asked(message.header.frame_id, message.child_frame_id):
            self._fail_by_frames()
        sample = cdr.pose_sample(message, with_covariance=True)
        covariance = sample.velocity_covariance
        is_known = any(covariance) and all(map(math.isfinite, covariance))
        yield sample if is_known else replace(sample, velocity_covariance=())

    def of_transforms(self, data: bytes) -> Iterator[TumSample]:
        for one in cdr.deserialise(data, cdr.TRANSFORMS).transforms:
            if self._is_asked(one.header.frame_id, one.child_frame_id):
                t_ns = one.header.stamp.sec * NS_PER_S + one.header.stamp.nanosec
                place, turn = one.transform.translation, one.transform.rotation
                yield TumSample(t_ns=t_ns, x_m=place.x, y_m=place.y, qz=turn.z, qw=turn.w)

    def check(self, domain: Ros2Domain, *, is_published: bool) -> None:
        """Raise OdometryError if the topic has no publisher, or other frames."""
        if self._others:
            self._fail_by_frames()
        if not is_published:
            there = _named({offer.topic for offer in domain.offers()})
            self._fail(
                f"it has no publisher in domain {domain_number()} (ROS_DOMAIN_ID); topics there: "
                f"{there or 'none; does multicast reach the robot?'}"
            )

    def _is_asked(self, parent: str, child: str) -> bool:
        is_asked = parent == self._parent and child in self._children
        self.is_found |= is_asked
        if not is_asked:
            self._others.add(f"{parent} -> {child}")
        return is_asked

    def _fail_by_frames(self) -> NoReturn:
        self._fail(
            f"its frames are {_named(self._others)}, not {self._parent} -> "
            f"{' or '.join(self._children)}; to use others: ros2:{self._topic}:PARENT:CHILD"
        )

    def _fail(self, text: str) -> NoReturn:
        raise OdometryError(f"odometry from ROS 2 topic {self._topic}: {text}")


_READERS = {
    cdr.ODOMETRY: _TopicPoses.of_odometry,
    cdr.TRANSFORMS: _TopicPoses.of_transforms,
}


def _named(names: set[str]) -> str:
    more = len(names) - _MOST_NAMED
    return ", ".join(sorted(names)[:_MOST_NAMED]) + (f" and {more} more" if more > 0 else "")
