"""Session records as ROS 2 messages in CDR, without a ROS installation.

Types and serialisation are those of the rosbags library; the arrays of a frame are copied once,
into the serialised bytes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore

from slam.app.session import Snapshot
from slam.app.tum import NS_PER_S, TumSample

FLOAT_ARRAY = "std_msgs/msg/Float32MultiArray"
DOUBLE_ARRAY = "std_msgs/msg/Float64MultiArray"
BYTE_ARRAY = "std_msgs/msg/UInt8MultiArray"
STRING = "std_msgs/msg/String"
ODOMETRY = "nav_msgs/msg/Odometry"
POSE = "geometry_msgs/msg/PoseStamped"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
LOG = "rcl_interfaces/msg/Log"

_LOG_INFO, _LOG_WARN = 20, 30
_POINT_FIELD_FLOAT32, _POINT_FIELD_UINT32 = 7, 6

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

Message: TypeAlias = Any  # rosbags makes its message classes at run time


@cache
def _typestore() -> Any:  # noqa: ANN401 - rosbags' Typestore; its messages are untyped anyway
    return get_typestore(Stores.ROS2_HUMBLE)


@cache
def _type(name: str) -> Any:  # noqa: ANN401 - a message class made at run time
    return _typestore().types[name]


def schema_text(message_type: str) -> bytes:
    """Return the ros2msg schema of a type with everything it refers to."""
    text, _digest = _typestore().generate_msgdef(message_type, ros_version=2)
    return bytes(text, "utf-8")


def serialise(message: Message) -> memoryview:
    """Serialise any of the messages of this module to CDR."""
    data: memoryview = _typestore().serialize_cdr(message, message.__msgtype__)
    return data


def deserialise(data: bytes, message_type: str) -> Message:
    """Read CDR bytes back; arrays come as numpy arrays."""
    return _typestore().deserialize_cdr(data, message_type)


def float_array(samples: NDArray[np.float32]) -> Message:
    """Wrap one frame, shape (n_bins,), as an array with the dimension `range_bin`."""
    return _array(FLOAT_ARRAY, "range_bin", samples)


def double_array(label: str, values: NDArray[np.float64]) -> Message:
    """Wrap numbers, shape (n,), as an array with one labelled dimension."""
    return _array(DOUBLE_ARRAY, label, values)


def byte_array(label: str, data: bytes) -> Message:
    """Wrap bytes as an array with one labelled dimension."""
    return _array(BYTE_ARRAY, label, np.frombuffer(data, dtype=np.uint8))


def string(text: str) -> Message:
    """Wrap text."""
    return _type(STRING)(data=text)


def odometry(sample: TumSample) -> Message:
    """Wrap an odometry sample; the quaternion is kept as it came, so replay sees the same floats.

    Covariances are zero, which means unknown in ROS.
    """
    pose = _pose(sample.x_m, sample.y_m, sample.qz, sample.qw)
    with_covariance = _type("geometry_msgs/msg/PoseWithCovariance")(
        pose=pose, covariance=np.zeros(36)
    )
    zero = _type("geometry_msgs/msg/Vector3")(x=0.0, y=0.0, z=0.0)
    twist = _type("geometry_msgs/msg/TwistWithCovariance")(
        twist=_type("geometry_msgs/msg/Twist")(linear=zero, angular=zero), covariance=np.zeros(36)
    )
    return _type(ODOMETRY)(
        header=_header(sample.t_ns, "odom"),
        child_frame_id="base_link",
        pose=with_covariance,
        twist=twist,
    )


def odometry_sample(message: Message) -> TumSample:
    """Read an odometry message back."""
    pose = message.pose.pose
    stamp = message.header.stamp
    return TumSample(
        t_ns=stamp.sec * NS_PER_S + stamp.nanosec,
        x_m=pose.position.x,
        y_m=pose.position.y,
        qz=pose.orientation.z,
        qw=pose.orientation.w,
    )


def pose_stamped(t_ns: int, frame: str, pose: NDArray[np.float64]) -> Message:
    """Wrap a planar pose, shape (3,), of the robot in a frame."""
    return _type(POSE)(header=_header(t_ns, frame), pose=_pose_of(pose))


def transforms(t_ns: int, links: Mapping[tuple[str, str], NDArray[np.float64]]) -> Message:
    """Wrap planar transforms: (parent, child) -> pose of the child in the parent, shape (3,)."""
    rows = []
    for (parent, child), pose in links.items():
        x, y, heading = (float(value) for value in pose)
        transform = _type("geometry_msgs/msg/Transform")(
            translation=_type("geometry_msgs/msg/Vector3")(x=x, y=y, z=0.0),
            rotation=_quaternion(math.sin(heading / 2), math.cos(heading / 2)),
        )
        rows.append(
            _type("geometry_msgs/msg/TransformStamped")(
                header=_header(t_ns, parent), child_frame_id=child, transform=transform
            )
        )
    return _type(TRANSFORMS)(transforms=rows)


def landmark_cloud(snapshot: Snapshot) -> Message:
    """Wrap the landmarks of a state, with id and covariance, in the map frame."""
    points = np.zeros(len(snapshot.landmark_ids), dtype=LANDMARK_DTYPE)
    points["x"] = snapshot.landmarks_m[:, 0]
    points["y"] = snapshot.landmarks_m[:, 1]
    points["id"] = snapshot.landmark_ids
    points["cov_xx"] = snapshot.landmark_covariances_m2[:, 0, 0]
    points["cov_xy"] = snapshot.landmark_covariances_m2[:, 0, 1]
    points["cov_yy"] = snapshot.landmark_covariances_m2[:, 1, 1]
    return _type(POINT_CLOUD)(
        header=_header(snapshot.t_ns, "map"),
        height=1,
        width=len(points),
        fields=_landmark_fields(),
        is_bigendian=False,
        point_step=LANDMARK_DTYPE.itemsize,
        row_step=LANDMARK_DTYPE.itemsize * len(points),
        data=points.view(np.uint8),
        is_dense=True,
    )


def log_line(t_ns: int, radar: str, text: str, *, warning: bool) -> Message:
    """Wrap one line of the protocol log; the radar is the logger's name."""
    return _type(LOG)(
        stamp=_time(t_ns),
        level=_LOG_WARN if warning else _LOG_INFO,
        name=radar,
        msg=text,
        file="",
        function="",
        line=0,
    )


@cache
def _landmark_fields() -> list[Message]:
    fields = LANDMARK_DTYPE.fields
    assert fields is not None
    return [
        _type("sensor_msgs/msg/PointField")(
            name=name,
            offset=fields[name][1],
            datatype=_POINT_FIELD_UINT32 if name == "id" else _POINT_FIELD_FLOAT32,
            count=1,
        )
        for name in LANDMARK_DTYPE.names or ()
    ]


def _array(message_type: str, label: str, values: NDArray[Any]) -> Message:
    size = len(values)
    dimension = _type("std_msgs/msg/MultiArrayDimension")(label=label, size=size, stride=size)
    layout = _type("std_msgs/msg/MultiArrayLayout")(dim=[dimension], data_offset=0)
    # a row of an array in Fortran order is none that can be written as it lies
    return _type(message_type)(layout=layout, data=np.ascontiguousarray(values))


def _time(t_ns: int) -> Message:
    seconds, rest = divmod(int(t_ns), NS_PER_S)
    return _type("builtin_interfaces/msg/Time")(sec=seconds, nanosec=rest)


def _header(t_ns: int, frame: str) -> Message:
    return _type("std_msgs/msg/Header")(stamp=_time(t_ns), frame_id=frame)


def _quaternion(qz: float, qw: float) -> Message:
    return _type("geometry_msgs/msg/Quaternion")(x=0.0, y=0.0, z=qz, w=qw)


def _pose(x_m: float, y_m: float, qz: float, qw: float) -> Message:
    return _type("geometry_msgs/msg/Pose")(
        position=_type("geometry_msgs/msg/Point")(x=x_m, y=y_m, z=0.0),
        orientation=_quaternion(qz, qw),
    )


def _pose_of(pose: NDArray[np.float64]) -> Message:
    x, y, heading = (float(value) for value in pose)
    return _pose(x, y, math.sin(heading / 2), math.cos(heading / 2))
