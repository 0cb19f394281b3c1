"""Bags as the paper's authors recorded them, made by nothing but the rosbags library."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_typestore

from slam.live.session.cdr import Message

Pose = tuple[float, float, float]
"""x [m], y [m], heading [rad]."""

N_SCANS = 12
N_BINS = 1431
START_NS = 1_690_000_000_000_000_000
STEP_NS = 200_000_000


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


def jittered_ns(radar: int, number: int) -> int:
    """When a laptop would have recorded a frame of a radar that is not synchronised."""
    late_ns = int(np.random.default_rng((radar, number)).integers(0, 20_000_000))
    return START_NS + number * STEP_NS + radar * 30_000_000 + late_ns


def samples(radar: int, number: int, n_bins: int = N_BINS) -> NDArray[np.float32]:
    rng = np.random.default_rng((radar, number))
    return rng.normal(0, 1e-3, n_bins).astype(np.float32)


def authors_bag(
    path: Path,
    *,
    topics: str = "/UWBradar{}/readings",
    n_bins: int = N_BINS,
    odometry: bool = True,
    jump_back: bool = False,
    truth: bool = True,
    storage: StoragePlugin = StoragePlugin.SQLITE3,
) -> Path:
    """Write a bag of noise and a straight drive as the authors' recorder would have."""
    bag = AuthorsBag(path, topics, storage)
    for number in range(N_SCANS):
        for radar in range(4):
            bag.add_frame(jittered_ns(radar, number), radar + 1, samples(radar, number, n_bins))
    for k in range(6 * N_SCANS):
        t_ns = START_NS - 300_000_000 + k * STEP_NS // 5
        stamp_ns = t_ns - 300_000_000 if jump_back and k == 20 else t_ns
        if odometry:
            bag.add_odometry(t_ns + 3_000_000, stamp_ns, (0.01 * k, -0.5, 0.2))
        if truth:
            bag.add_truth(t_ns + 9_000_000, t_ns, (0.01 * k + 2.0, -0.5, 0.2))
    bag.write()
    return path
