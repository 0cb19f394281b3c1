"""Bags as the paper's authors recorded them, made by nothing but the rosbags library."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_typestore

from slam.app.session.messages import Message

Pose = tuple[float, float, float]
"""x [m], y [m], heading [rad]."""


class AuthorsBag:
    """Collects messages and writes them by the time of recording; `*.bag` is ROS 1."""

    def __init__(
        self,
        path: Path,
        topics: str = "/UWBradar{}/readings",
        storage: StoragePlugin = StoragePlugin.SQLITE3,
    ) -> None:
        self.path = path
        self._storage = storage
        self._topics = topics
        self._is_ros1 = path.suffix == ".bag"
        store = get_typestore(Stores.ROS1_NOETIC if self._is_ros1 else Stores.ROS2_HUMBLE)
        self._store: Any = store
        self._rows: list[tuple[int, str, Message]] = []

    def add_frame(self, t_ns: int, radar: int, samples: NDArray[np.float32]) -> None:
        layout = self._make("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
        message = self._make("std_msgs/msg/Float32MultiArray", layout=layout, data=samples)
        self._rows.append((t_ns, self._topics.format(radar), message))

    def add_odometry(self, t_ns: int, stamp_ns: int, pose: Pose) -> None:
        zero = self._make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        message = self._make(
            "nav_msgs/msg/Odometry",
            header=self._header(stamp_ns, "odom"),
            child_frame_id="base_link",
            pose=self._make(
                "geometry_msgs/msg/PoseWithCovariance",
                pose=self._pose(pose),
                covariance=np.zeros(36),
            ),
            twist=self._make(
                "geometry_msgs/msg/TwistWithCovariance",
                twist=self._make("geometry_msgs/msg/Twist", linear=zero, angular=zero),
                covariance=np.zeros(36),
            ),
        )
        self._rows.append((t_ns, "/odom", message))

    def add_truth(self, t_ns: int, stamp_ns: int, pose: Pose) -> None:
        message = self._make(
            "geometry_msgs/msg/PoseStamped",
            header=self._header(stamp_ns, "map"),
            pose=self._pose(pose),
        )
        self._rows.append((t_ns, "/slam_out_pose", message))

    def write(self) -> None:
        path = self.path
        writer: Any = (
            Rosbag1Writer(path)
            if self._is_ros1
            else Rosbag2Writer(path, version=8, storage_plugin=self._storage)
        )
        serialise = self._store.serialize_ros1 if self._is_ros1 else self._store.serialize_cdr
        connections: dict[str, Any] = {}
        with writer:
            for t_ns, topic, message in sorted(self._rows, key=lambda row: row[0]):
                name = message.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, name, typestore=self._store)
                writer.write(connections[topic], t_ns, serialise(message, name))

    def _make(self, name: str, **parts: object) -> Message:
        return self._store.types[name](**parts)

    def _header(self, t_ns: int, frame: str) -> Message:
        seconds, rest = divmod(t_ns, 10**9)
        stamp = self._make("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest)
        extra = {"seq": 0} if self._is_ros1 else {}
        return self._make("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **extra)

    def _pose(self, pose: Pose) -> Message:
        x_m, y_m, heading = pose
        return self._make(
            "geometry_msgs/msg/Pose",
            position=self._make("geometry_msgs/msg/Point", x=x_m, y=y_m, z=0.0),
            orientation=self._make(
                "geometry_msgs/msg/Quaternion",
                x=0.0,
                y=0.0,
                z=math.sin(heading / 2),
                w=math.cos(heading / 2),
            ),
        )
