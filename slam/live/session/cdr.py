"""The messages of ROS 2 in a session: their types, and their bytes.

They are packed here: the rosbags library, which has their definitions and reads them, needs a
millisecond for what takes some microseconds so. Arrays and texts are those of every recording, see
`xethru_protocol.recordings.mcap`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cache
from typing import Any, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

from slam.imaging.back_projection import Grid
from slam.live.odometry_track import NS_PER_S, TumSample
from slam.live.session_records import LogLine, RadarImage, Snapshot
from slam.results import SmoothedRun
from xethru_protocol.recordings.mcap import CdrPacker

Array = NDArray[np.float64]
Message: TypeAlias = Any  # rosbags makes its message classes at run time

ODOMETRY = "nav_msgs/msg/Odometry"
PATH = "nav_msgs/msg/Path"
POSE = "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
RANGE = "sensor_msgs/msg/Range"
IMAGE = "sensor_msgs/msg/Image"
OCCUPANCY_GRID = "nav_msgs/msg/OccupancyGrid"
MARKERS = "visualization_msgs/msg/MarkerArray"
LOG = "rcl_interfaces/msg/Log"
NUMBER = "std_msgs/msg/UInt32"


@cache
def typestore() -> Any:  # noqa: ANN401 - rosbags' Typestore; its messages are untyped anyway
    """Return the definitions of the messages."""
    return get_typestore(Stores.ROS2_HUMBLE)


def schema_text(message_type: str) -> bytes:
    """Return the ros2msg schema of a type with everything it refers to."""
    text, _digest = typestore().generate_msgdef(message_type, ros_version=2)
    return bytes(text, "utf-8")


def deserialise(data: bytes, message_type: str) -> Message:
    """Read CDR bytes back; arrays come as numpy arrays."""
    return typestore().deserialize_cdr(data, message_type)


def pose_sample(message: Message, *, with_covariance: bool = False) -> TumSample:
    """Return the pose of a message, however deep the message holds it, at its header's stamp.

    `with_covariance` takes that of an Odometry's velocity, too.
    """
    pose = message.pose
    while not hasattr(pose, "position"):
        pose = pose.pose
    stamp = message.header.stamp
    return TumSample(
        t_ns=stamp.sec * NS_PER_S + stamp.nanosec,
        x_m=pose.position.x,
        y_m=pose.position.y,
        qz=pose.orientation.z,
        qw=pose.orientation.w,
        velocity_covariance=(
            tuple(message.twist.covariance[_PLANAR_TRIANGLE].tolist()) if with_covariance else ()
        ),
    )


class _Packer(CdrPacker):
    def stamp(self, t_ns: int) -> Self:
        seconds, rest = divmod(int(t_ns), NS_PER_S)
        return self.numbers("i", seconds).numbers("I", rest)

    def header(self, t_ns: int, frame: str) -> Self:
        return self.stamp(t_ns).text(frame)


def number(value: int) -> bytes:
    """Pack a UInt32."""
    return _Packer().numbers("I", value).done()


_LOG_INFO, _LOG_WARN = 20, 30


def log_line(t_ns: int, line: LogLine) -> bytes:
    """Pack a Log of one line of the protocol log; the radar is the logger's name."""
    level = _LOG_WARN if line.warning else _LOG_INFO
    message = _Packer().stamp(t_ns).numbers("B", level).text(line.radar).text(line.text)
    return message.text("").text("").numbers("I", 0).done()  # file, function, line


def read_log_line(t_ns: int, data: bytes) -> LogLine:
    """Read what `log_line` packed."""
    line = deserialise(data, LOG)
    return LogLine(t_ns=t_ns, radar=line.name, warning=line.level >= _LOG_WARN, text=line.msg)


def planar(pose: Array) -> tuple[float, ...]:
    """Return position and quaternion of a pose [x, y, heading]."""
    x, y, heading = (float(value) for value in pose)
    return x, y, 0.0, 0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2)


def pose_stamped(t_ns: int, frame: str, pose: Array) -> bytes:
    """Pack a PoseStamped of the robot in a frame; the pose has shape (3,)."""
    return _Packer().header(t_ns, frame).numbers("d", *planar(pose)).done()


def transforms(t_ns: int, links: Mapping[tuple[str, str], Array]) -> bytes:
    """Pack a TFMessage of (parent, child) -> pose of the child in the parent, shape (3,)."""
    message = _Packer().numbers("I", len(links))
    for (parent, child), pose in links.items():
        message.header(t_ns, parent).text(child).numbers("d", *planar(pose))
    return message.done()


_PLANAR = np.ix_((0, 1, 5), (0, 1, 5))
"""Where the covariance of x, y and heading lies among x, y, z and the turns about them."""
_PLANAR_TRIANGLE = np.arange(36).reshape(6, 6)[_PLANAR][np.triu_indices(3)]


def _covariance(of_pose: Array) -> Array:
    whole = np.zeros((6, 6))
    whole[_PLANAR] = of_pose
    return whole.ravel()


def pose_with_covariance(t_ns: int, frame: str, pose: Array, covariance: Array) -> bytes:
    """Pack a PoseWithCovarianceStamped; covariance (3, 3) of x, y, heading [m^2, m rad, rad^2]."""
    message = _Packer().header(t_ns, frame)
    return message.numbers("d", *planar(pose), *_covariance(covariance)).done()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Twist:
    """Velocity in the body frame.

    Attributes
    ----------
    velocity
        Shape (3,): forwards and to the left [m/s], turn rate [rad/s].
    covariance
        Shape (3, 3), of it.
    """

    velocity: Array
    covariance: Array


NO_TWIST = Twist(velocity=np.zeros(3), covariance=np.zeros((3, 3)))


def odometry(
    t_ns: int, frame: str, placed: Sequence[float], covariance: Array, twist: Twist
) -> bytes:
    """Pack an Odometry of the base link; `placed` as `planar` returns it, covariances (3, 3)."""
    message = _Packer().header(t_ns, frame).text("base_link")
    forwards, left, turning = twist.velocity.tolist()
    message.numbers("d", *placed, *_covariance(covariance))
    message.numbers("d", forwards, left, 0.0, 0.0, 0.0, turning, *_covariance(twist.covariance))
    return message.done()


def wheel_odometry(sample: TumSample, twist: Twist = NO_TWIST) -> bytes:
    """Pack a sample of the wheels; the covariance of the pose is zero, which means unknown in ROS.

    The quaternion is kept as it came, so replay sees the same floats.
    """
    placed = (sample.x_m, sample.y_m, 0.0, 0.0, 0.0, sample.qz, sample.qw)
    return odometry(sample.t_ns, "odom", placed, np.zeros((3, 3)), twist)


# PointCloud2 is the one standard message that carries named fields per point, so the covariance
# travels with its landmark and every viewer still draws the points. RViz wants float32 x, y, z.
LANDMARK_DTYPE = np.dtype(
    [
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("id", "<u4"),
        ("cov_xx", "<f4"),
        ("cov_xy", "<f4"),
        ("cov_yy", "<f4"),
    ]
)
_POINT_DTYPE = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])
_POINT_FIELD_TYPES = {np.dtype("<u4"): 6, np.dtype("<f4"): 7}


def landmark_cloud(t_ns: int, of: Snapshot | SmoothedRun) -> bytes:
    """Pack the landmarks of a state or a smoothed run, with id and covariance, in the map frame."""
    points = np.zeros(len(of.landmark_ids), dtype=LANDMARK_DTYPE)
    points["x"] = of.landmarks_m[:, 0]
    points["y"] = of.landmarks_m[:, 1]
    points["id"] = of.landmark_ids
    points["cov_xx"] = of.landmark_covariances_m2[:, 0, 0]
    points["cov_xy"] = of.landmark_covariances_m2[:, 0, 1]
    points["cov_yy"] = of.landmark_covariances_m2[:, 1, 1]
    return _cloud(t_ns, "map", points)


def path_cloud(t_ns: int, frame: str, poses: Array) -> bytes:
    """Pack the positions of poses (n, 3) as points."""
    points = np.zeros(len(poses), dtype=_POINT_DTYPE)
    points["x"], points["y"] = poses[:, 0], poses[:, 1]
    return _cloud(t_ns, frame, points)


def _cloud(t_ns: int, frame: str, points: NDArray[Any]) -> bytes:
    """Pack a PointCloud2 of one row."""
    message = _Packer().header(t_ns, frame).numbers("I", 1, len(points))
    columns = points.dtype.fields
    assert columns is not None
    message.numbers("I", len(columns))
    for name, (kind, offset, *_) in columns.items():
        message.text(name).numbers("I", offset)
        message.numbers("B", _POINT_FIELD_TYPES[kind]).numbers("I", 1)
    message.numbers("B", 0)  # little-endian
    message.numbers("I", points.itemsize, points.nbytes, points.nbytes)
    return message.array(points.view(np.uint8)).numbers("B", 1).done()  # no point is invalid


_ULTRASOUND = 0  # the nearest that Range has to a radar: a cone with an echo in it


def echo_range(
    t_ns: int,
    frame: str,
    *,
    field_of_view_rad: float,
    limits_m: tuple[float, float],
    range_m: float,
) -> bytes:
    """Pack a Range; an infinite range stands for no echo (REP 117)."""
    message = _Packer().header(t_ns, frame).numbers("B", _ULTRASOUND)
    return message.numbers("f", field_of_view_rad, *limits_m, range_m).done()


def image(t_ns: int, frame: str, pixels: NDArray[np.float32]) -> bytes:
    """Pack pixels (height, width) as an Image of encoding 32FC1."""
    height, width = pixels.shape
    message = _Packer().header(t_ns, frame).numbers("I", height, width).text("32FC1")
    message.numbers("B", 0)  # little-endian
    message.numbers("I", 4 * width, 4 * height * width)
    return message.array(pixels.astype("<f4")).done()


def occupancy_grid(image: RadarImage) -> bytes:
    """Pack an image as an OccupancyGrid of the map frame: its levels stand for probabilities."""
    grid = image.grid
    message = _Packer().header(image.t_ns, "map").stamp(image.t_ns).numbers("f", grid.cell_m)
    message.numbers("I", grid.columns, grid.rows)
    message.numbers("d", *planar(np.array([grid.x_m, grid.y_m, 0.0])))
    return message.numbers("I", image.levels.size).array(image.levels).done()


def read_occupancy_grid(t_ns: int, data: bytes) -> RadarImage:
    """Read what `occupancy_grid` packed; a cell's length is as float32 had it."""
    message = deserialise(data, OCCUPANCY_GRID)
    info = message.info
    grid = Grid(
        x_m=info.origin.position.x,
        y_m=info.origin.position.y,
        cell_m=info.resolution,
        rows=info.height,
        columns=info.width,
    )
    return RadarImage(t_ns=t_ns, grid=grid, levels=message.data.reshape(grid.rows, grid.columns))


def path(t_ns: int, frame: str, stamps_ns: NDArray[np.int64], poses: Array) -> bytes:
    """Pack poses (n, 3) at stamps (n,) as a Path; they are rounded to float32.

    Micrometres do not matter in a drawing, and the zeros behind them take no room on the disk.
    """
    message = _Packer().header(t_ns, frame).numbers("I", len(poses))
    placed = np.zeros((len(poses), 7), np.float32)
    placed[:, :2] = poses[:, :2]
    placed[:, 5], placed[:, 6] = np.sin(poses[:, 2] / 2), np.cos(poses[:, 2] / 2)
    for stamp_ns, row in zip(stamps_ns.tolist(), placed.tolist(), strict=True):
        message.header(stamp_ns, frame).numbers("d", *row)
    return message.done()


class Shape(IntEnum):
    """What a marker is."""

    CYLINDER = 3
    LINE_STRIP = 4
    LINE_LIST = 5
    SPHERE_LIST = 7


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Marker:
    """Something drawn, see visualization_msgs/Marker.

    Attributes
    ----------
    group
        What can be shown and hidden together.
    size_m
        Along x, y and z of the pose; of lines the first is the width.
    colour
        Red, green, blue, opacity, 0 to 1.
    points_m
        Shape (n, 2), of lists and strips, in the frame of the pose.
    moves
        Whether it stays in its frame while that moves.
    """

    group: str
    shape: Shape
    size_m: tuple[float, float, float]
    colour: tuple[float, float, float, float]
    number: int = 0
    pose: Array = field(default_factory=lambda: np.zeros(3))
    points_m: Array = field(default_factory=lambda: np.zeros((0, 2)))
    moves: bool = False


_ADD, _DELETE_ALL = 0, 3


def markers(t_ns: int, frame: str, drawn: Sequence[Marker]) -> bytes:
    """Pack a MarkerArray that replaces all earlier ones of its topic."""
    message = _Packer().numbers("I", 1 + len(drawn))
    nothing = Marker(group="", shape=Shape.CYLINDER, size_m=(0.0,) * 3, colour=(0.0,) * 4)
    _add_marker(message, t_ns, frame, nothing, _DELETE_ALL)
    for one in drawn:
        _add_marker(message, t_ns, frame, one, _ADD)
    return message.done()


def _add_marker(message: _Packer, t_ns: int, frame: str, one: Marker, action: int) -> None:
    message.header(t_ns, frame).text(one.group)
    message.numbers("i", one.number, one.shape, action)
    message.numbers("d", *planar(one.pose), *one.size_m)
    message.numbers("f", *one.colour)
    message.numbers("I", 0, 0)  # lifetime: without end
    message.numbers("B", one.moves)
    message.numbers("I", len(one.points_m))
    message.array(np.pad(one.points_m.astype("<f8"), ((0, 0), (0, 1))))
    message.numbers("I", 0)  # colours of the points
    message.text("")  # texture
    message.header(0, "").text("").numbers("I", 0, 0)  # an image of it
    message.text("")  # text
    message.text("").text("").numbers("I", 0).numbers("B", 0)  # mesh
