"""Messages of ROS 2 that are packed by hand: those of every state, and the long ones.

What the rosbags library needs a millisecond for takes some microseconds so.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from slam.app.odometry.track import NS_PER_S, TumSample

Array = NDArray[np.float64]

_LITTLE_ENDIAN = b"\x00\x01\x00\x00"
_HEAD = len(_LITTLE_ENDIAN)
_PLANAR = np.ix_((0, 1, 5), (0, 1, 5))
"""Where the covariance of x, y and heading lies among x, y, z and the turns about them."""


class _Message:
    """Bytes of a message in CDR, little-endian; numbers are aligned to their size."""

    def __init__(self) -> None:
        self._bytes = bytearray(_LITTLE_ENDIAN)

    def align(self, size: int) -> None:
        self._bytes += bytes(-(len(self._bytes) - _HEAD) % size)

    def numbers(self, kind: str, *values: float) -> None:
        """Append numbers of one kind of `struct`."""
        self.align(struct.calcsize(kind))
        self._bytes += struct.pack(f"<{len(values)}{kind}", *values)

    def text(self, text: str) -> None:
        data = text.encode() + b"\0"
        self.numbers("I", len(data))
        self._bytes += data

    def raw(self, data: bytes) -> None:
        self._bytes += data

    def header(self, t_ns: int, frame: str) -> None:
        seconds, rest = divmod(int(t_ns), NS_PER_S)
        self.numbers("i", seconds)
        self.numbers("I", rest)
        self.text(frame)

    def done(self) -> bytes:
        return bytes(self._bytes)


def planar(pose: Array) -> tuple[float, ...]:
    """Return position and quaternion of a pose [x, y, heading]."""
    x, y, heading = (float(value) for value in pose)
    return x, y, 0.0, 0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2)


def _covariance(of_pose: Array) -> Array:
    whole = np.zeros((6, 6))
    whole[_PLANAR] = of_pose
    return whole.ravel()


def pose_with_covariance(t_ns: int, frame: str, pose: Array, covariance: Array) -> bytes:
    """Pack a PoseWithCovarianceStamped; covariance (3, 3) of x, y, heading [m^2, m rad, rad^2]."""
    message = _Message()
    message.header(t_ns, frame)
    message.numbers("d", *planar(pose), *_covariance(covariance))
    return message.done()


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
    message = _Message()
    message.header(t_ns, frame)
    message.text("base_link")
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
    message = _Message()
    message.header(t_ns, frame)
    message.numbers("B", _ULTRASOUND)
    message.numbers("f", field_of_view_rad, *limits_m, range_m)
    return message.done()


def image(t_ns: int, frame: str, pixels: NDArray[np.float32]) -> bytes:
    """Pack pixels (height, width) as an Image of encoding 32FC1."""
    height, width = pixels.shape
    message = _Message()
    message.header(t_ns, frame)
    message.numbers("I", height, width)
    message.text("32FC1")
    message.numbers("B", 0)  # little-endian
    message.numbers("I", 4 * width, 4 * height * width)
    message.raw(np.ascontiguousarray(pixels, "<f4").tobytes())
    return message.done()


def path(t_ns: int, frame: str, stamps_ns: NDArray[np.int64], poses: NDArray[np.float64]) -> bytes:
    """Pack poses (n, 3) at stamps (n,) as a Path; they are rounded to float32.

    Micrometres do not matter in a drawing, and the zeros behind them take no room on the disk.
    """
    message = _Message()
    message.header(t_ns, frame)
    message.numbers("I", len(poses))
    name = frame.encode() + b"\0"
    head = 12 + len(name)
    rows = np.zeros(
        len(poses),
        np.dtype(
            [
                ("seconds", "<i4"),
                ("rest", "<u4"),
                ("length", "<u4"),
                ("name", f"S{len(name)}"),
                ("padding", f"S{-head % 8}"),
                ("pose", "<f8", 7),
            ]
        ),
    )
    rows["seconds"], rows["rest"] = np.divmod(stamps_ns, NS_PER_S)
    rows["length"], rows["name"] = len(name), name
    placed = np.zeros((len(poses), 7), np.float32)
    placed[:, :2] = poses[:, :2]
    placed[:, 5], placed[:, 6] = np.sin(poses[:, 2] / 2), np.cos(poses[:, 2] / 2)
    rows["pose"] = placed
    data = rows.tobytes()
    # Padding differs before the first pose only: all later ones begin at a multiple of 8.
    message.raw(data[:head])
    if len(poses):
        message.align(8)
    message.raw(data[head + -head % 8 :])
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
    message = _Message()
    message.numbers("I", 1 + len(drawn))
    nothing = Marker(group="", shape=Shape.CYLINDER, size_m=(0.0,) * 3, colour=(0.0,) * 4)
    _add_marker(message, t_ns, frame, nothing, _DELETE_ALL)
    for one in drawn:
        _add_marker(message, t_ns, frame, one, _ADD)
    return message.done()


def _add_marker(message: _Message, t_ns: int, frame: str, one: Marker, action: int) -> None:
    message.header(t_ns, frame)
    message.text(one.group)
    message.numbers("i", one.number, one.shape, action)
    message.numbers("d", *planar(one.pose), *one.size_m)
    message.numbers("f", *one.colour)
    message.numbers("I", 0, 0)  # lifetime: without end
    message.numbers("B", one.moves)
    message.numbers("I", len(one.points_m))
    if len(one.points_m):
        points = np.zeros((len(one.points_m), 3))
        points[:, :2] = one.points_m
        message.align(8)
        message.raw(points.astype("<f8").tobytes())
    message.numbers("I", 0)  # colours of the points
    message.text("")  # texture
    message.header(0, "")
    message.text("")
    message.numbers("I", 0, 0)
    message.text("")  # text
    message.text("")  # mesh
    message.text("")
    message.numbers("I", 0)
    message.numbers("B", 0)
