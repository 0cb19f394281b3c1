"""Odometry from topics of ROS 2: each test in a domain of its own, on the loopback interface."""

import queue
import threading
import time
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import pytest

from hil_tests.patience import seconds
from hil_tests.unit.slam.app.ros2_robot import (
    Header,
    Odometry,
    Point,
    Pose,
    PoseWithCovariance,
    PoseWithCovarianceStamped,
    Quaternion,
    Robot,
    TFMessage,
    odometry,
    ros_domain,
    stamp,
    transform,
    unique_name,
)
from slam.app.errors import UsageError
from slam.app.odometry import ros2
from slam.app.odometry.dds import Ros2Domain
from slam.app.odometry.live import LineSource, LiveOdometry, SourceKind, parse_source, read_lines
from slam.live.errors import AppError, OdometryError
from slam.live.odometry_track import TumSample
from slam.live.session import cdr

NS_PER_S = 1_000_000_000


@pytest.fixture(autouse=True)
def domain() -> Iterator[int]:
    with ros_domain() as number:
        yield number


class Reading:
    """Lines of a source, read in a thread as a run does it."""

    def __init__(self, text: str) -> None:
        self._source = parse_source(text)
        self._stopped = threading.Event()
        self._got: queue.Queue[tuple[str, int] | AppError] = queue.Queue()
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self) -> None:
        try:
            for one in read_lines(self._source, self._stopped.is_set):
                self._got.put(one)
        except AppError as error:
            self._got.put(error)

    def next(self) -> tuple[str, int]:
        got = self._got.get(timeout=seconds(1.5))
        if isinstance(got, AppError):
            raise got
        return got

    def failure(self) -> str:
        """Return why it failed."""
        with pytest.raises(OdometryError) as failed:
            self.next()
        return str(failed.value)

    def __enter__(self) -> "Reading":
        return self

    def __exit__(self, *_: object) -> None:
        self._stopped.set()
        self._thread.join(seconds(1.5))
        assert not self._thread.is_alive()


@pytest.mark.parametrize("reliable", [True, False])
def test_lines_have_the_floats_of_the_messages_whatever_is_offered(reliable: bool) -> None:
    topic = f"/{unique_name()}"
    robot = Robot(topic, Odometry, reliable=reliable)
    twist = [0.0] * 36
    for number, at in enumerate((0, 1, 5, 7, 11, 35)):
        twist[at] = twist[6 * (at % 6) + at // 6] = (number + 1) / 3
    sent = odometry(
        1_700_000_000_000_000_005,
        1 / 3,
        turn=Quaternion(0.0, 0.0, -0.6, 0.8),
        twist_covariance=twist,
    )
    with Reading(f"ros2:{topic}") as reading:
        robot.wait_for_listener()
        before_ns = time.monotonic_ns()
        robot.publish(sent)
        line, arrival_ns = reading.next()
        robot.publish(odometry(1_700_000_001_000_000_000))
        other, _ = reading.next()
    covariance = " ".join(repr((number + 1) / 3) for number in range(6))
    assert line == f"1700000000.000000005 {1 / 3!r} -0.25 0 0 0 -0.6 0.8 {covariance}"
    assert before_ns < arrival_ns < time.monotonic_ns()
    assert other == "1700000001.000000000 0.0 -0.25 0 0 0 0.0 1.0"  # zeros mean unknown


def test_a_publisher_that_comes_later_goes_and_comes_back_is_read_on() -> None:
    """The second one is best effort, which a reliable reader would not get."""
    topic = f"/{unique_name()}"
    with Reading(f"ros2:{topic}") as reading:
        for number, reliable in enumerate((True, False, True)):
            robot = Robot(topic, Odometry, reliable=reliable)
            robot.wait_for_listener()
            robot.publish(odometry(number * NS_PER_S))
            assert reading.next()[0].startswith(f"{number}.000000000 ")
            robot.close()


def test_in_another_domain_nothing_is_heard_and_the_error_names_what_is_there(
    domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ros2, "UNFOUND_S", 1.5)
    topic, other = f"/{unique_name()}", f"/{unique_name()}"
    robot, _neighbour = Robot(topic, Odometry), Robot(other, Odometry)
    with Reading(f"ros2:{topic}") as reading:
        robot.wait_for_listener()
        robot.publish(odometry(0))
        reading.next()
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain % 100 + 1))
    with Reading(f"ros2:{topic}") as reading:
        robot.publish(odometry(1))
        failure = reading.failure()
    assert topic in failure
    assert f"domain {domain % 100 + 1} " in failure
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    robot.close()
    with Reading(f"ros2:{topic}") as reading:
        failure = reading.failure()
    assert f"domain {domain} " in failure
    assert other in failure


def test_frames_that_are_others_are_named_and_taken_where_they_are_given() -> None:
    for given in ("", ":map:robot1/base"):
        topic = f"/{unique_name()}"
        robot = Robot(topic, Odometry)
        with Reading(f"ros2:{topic}{given}") as reading:
            robot.wait_for_listener()
            robot.publish(odometry(0, frames=("map", "robot1/base")))
            if given:
                assert reading.next()[0].startswith("0.000000000 ")
            else:
                failure = reading.failure()
    assert "map -> robot1/base" in failure
    assert "odom -> base_link" in failure


def test_a_topic_of_another_type_is_refused_with_its_type() -> None:
    topic = f"/{unique_name()}"
    robot = Robot(topic, PoseWithCovarianceStamped)
    with Reading(f"ros2:{topic}") as reading:
        pose = PoseWithCovariance(Pose(Point(), Quaternion()), [0.0] * 36)
        robot.publish(PoseWithCovarianceStamped(Header(stamp(0), "map"), pose))
        assert "geometry_msgs/msg/PoseWithCovarianceStamped" in reading.failure()


def test_of_tf_the_transform_that_is_asked_for_is_taken() -> None:
    topic = f"/{unique_name()}/tf"
    robot = Robot(topic, TFMessage)
    wheel = transform(0, 9.0, ("base_link", "wheel"))
    with Reading(f"ros2:{topic}") as reading:
        robot.wait_for_listener()
        robot.publish(TFMessage([wheel]))
        robot.publish(TFMessage([wheel, transform(5, 1 / 3, ("odom", "base_footprint"))]))
        assert reading.next()[0] == f"0.000000005 {1 / 3!r} -0.25 0 0 0 0.6 0.8"


def test_of_tf_without_that_transform_the_others_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ros2, "UNFOUND_S", 1.5)
    topic = f"/{unique_name()}/tf"
    robot = Robot(topic, TFMessage)
    with Reading(f"ros2:{topic}:odom:body") as reading:
        robot.wait_for_listener()
        robot.publish(TFMessage([transform(0, 0.0, ("odom", "base_link"))]))
        failure = reading.failure()
    assert "odom -> body" in failure
    assert "odom -> base_link" in failure


def test_a_clock_that_jumps_costs_the_poses_before_it_catches_up() -> None:
    topic = f"/{unique_name()}"
    robot, live = Robot(topic, Odometry), LiveOdometry("a test")
    with Reading(f"ros2:{topic}") as reading:
        robot.wait_for_listener()
        for t_s in (5.0, 5.1, 2.0, 5.2):
            robot.publish(odometry(round(t_s * NS_PER_S)))
            live.take(*reading.next())
    assert live.n_refused == 1
    assert live.last_ns == 5_200_000_000


def test_a_message_that_cannot_be_read_is_refused_and_the_next_one_is_read() -> None:
    """Its frame is no UTF-8, which Cyclone passes on."""
    topic, live = f"/{unique_name()}", LiveOdometry("a test")
    message = bytearray(cdr.wheel_odometry(TumSample(t_ns=5, x_m=0.0, y_m=0.0, qz=0.0, qw=1.0)))
    at = message.index(b"odom")
    write = Ros2Domain().writer(topic, cdr.ODOMETRY)
    robot = Robot(topic, Odometry)  # tells when the reader is there
    with Reading(f"ros2:{topic}") as reading:
        robot.wait_for_listener()
        robot.publish(odometry(4))
        live.take(*reading.next())
        message[at] = 0xFF
        write(bytes(message))
        live.take(*reading.next())
        assert live.n_refused == 1
        message[at] = ord("o")
        write(bytes(message))
        live.take(*reading.next())
    assert (live.n_refused, live.last_ns) == (1, 5)


def test_of_more_messages_than_are_kept_the_newest_are_read() -> None:
    topic = f"/{unique_name()}"
    robot = Robot(topic, Odometry)
    source = LineSource(kind=SourceKind.ROS2, place=topic)
    give_up_s = time.monotonic() + seconds(1.5)
    lines = read_lines(source, lambda: time.monotonic() > give_up_s)

    def stamps_ns() -> Iterator[int]:
        for line, _ in lines:
            yield int(line.partition(" ")[0].replace(".", ""))

    def publish_first() -> None:
        robot.wait_for_listener()
        robot.publish(odometry(0))

    stamps, first = stamps_ns(), threading.Thread(target=publish_first)
    first.start()
    assert next(stamps) == 0
    first.join()
    for number in range(1, 501):
        robot.publish(odometry(number))
    time.sleep(0.5)  # what a busy reader does
    got = [next(stamps)]
    while got[-1] < 500:
        got.append(next(stamps))
    assert len(got) <= 200
    assert all(later - earlier == 1 for earlier, later in pairwise(got))


@pytest.mark.parametrize("text", ["ros2:", "ros2:9", "ros2:/a//b", "ros2:/odom:odom", "ros2:/a b"])
def test_what_is_no_topic_is_wrong_usage(text: str) -> None:
    with pytest.raises(UsageError):
        parse_source(text)


@pytest.mark.parametrize("number", ["-1", "233", "x", "1e1"])
def test_a_domain_that_there_cannot_be_is_wrong_usage(
    number: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", number)
    with pytest.raises(UsageError):
        parse_source("ros2:/odom")


def test_a_covariance_of_the_message_is_that_of_the_sample() -> None:
    """Through the line, to the last bit."""
    values = np.random.default_rng(3).normal(size=(3, 3))
    covariance = values @ values.T
    twist = np.zeros((6, 6))
    twist[np.ix_((0, 1, 5), (0, 1, 5))] = covariance
    topic = f"/{unique_name()}"
    robot, live = Robot(topic, Odometry), LiveOdometry("a test", has_covariance=True)
    with Reading(f"ros2:{topic}") as reading:
        robot.wait_for_listener()
        robot.publish(odometry(NS_PER_S, twist_covariance=twist.ravel().tolist()))
        sample, warning = live.take(*reading.next())
    assert sample is not None
    assert not warning
    assert sample.velocity_covariance == tuple(covariance[np.triu_indices(3)].tolist())
