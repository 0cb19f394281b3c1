"""The sink that publishes a run in ROS 2, without an installation of it.

It is a node `uwb_slam` in a namespace; docs/robot.md has its topics, frames and QoS. `odom` to
`base_link` is the robot's own (REP 105), so tf has `map` to `odom` only. Stamps are the odometry's
where that counts from 1970; else the time of day by this machine.
"""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np

from slam.app.errors import UsageError
from slam.app.odometry.dds import Ros2Domain, domain_number
from slam.app.publish.sinks import Sink
from slam.app.session.viewer_topics import GrowingPath, WheelMotion, landmark_markers
from slam.geometry import between, compose
from slam.live.odometry_track import NS_PER_S
from slam.live.session import cdr
from slam.live.session_records import RadarInfo, Scan, SessionInfo, Snapshot
from slam.results import SmoothedRun
from xethru_protocol.recordings.mcap import FLOAT_ARRAY, pack_array

_EVERY_NS = 2 * NS_PER_S
_SHOWN_POSES = 256
_SINCE_1970_NS = 1_000_000_000 * NS_PER_S
"""Clocks that show more count from 1970; this was in 2001."""

_LATCHED = {"path": cdr.PATH, "smoothed_path": cdr.PATH, "landmarks": cdr.MARKERS}
_VOLATILE = {"odometry": cdr.ODOMETRY, "pose": cdr.POSE_WITH_COVARIANCE}


class Ros2Sink(Sink):
    """Publishes in the ROS domain of the environment; the text is `[NAMESPACE][,frames]`."""

    def __init__(self, text: str) -> None:
        namespace, comma, option = text.partition(",")
        words = namespace.strip("/")
        is_name = not words or re.fullmatch(r"(?a)[A-Za-z_]\w*(/[A-Za-z_]\w*)*", words)
        if not is_name or (comma and option != "frames"):
            raise UsageError("must be ros2[:[NAMESPACE][,frames]], as ros2:robot1 or ros2:,frames")
        self._namespace = f"/{words}" if words else ""
        self._has_frames = bool(comma)
        domain_number()
        self._writers: dict[str, Callable[[bytes], None]] = {}
        self._path = GrowingPath("map")
        self._last: Snapshot | None = None
        self._drawn_ns: int | None = None
        self._offset_ns: int | None = None
        self._newest_ns = self._tf_ns = 0  # of scans, of the newest transform: time of ROS
        self._odom_frame = np.zeros(3)  # `Scan.odom_frame` of the newest one that SLAM took

    def open(self) -> None:
        """Enter the domain; others see the topics from now on."""
        self._domain = Ros2Domain()
        self._add("tf", f"{self._namespace}/tf", cdr.TRANSFORMS)
        for name, message_type in _VOLATILE.items():
            self._add(name, self._private(name), message_type)
        for name, message_type in _LATCHED.items():
            self._add(name, self._private(name), message_type, latched=True)

    def begin(self, info: SessionInfo, start_ns: int, map_id: str) -> None:
        self._info, self._wheels = info, WheelMotion(info.wheels)
        for radar in info.radars if self._has_frames else ():
            self._add(radar_topic(radar), self._private(radar_topic(radar)), FLOAT_ARRAY)

    def on_scan(self, scan: Scan) -> None:
        if self._newest_ns > self._tf_ns:  # the scan before led to no state: the robot stands
            self._write_transform(self._newest_ns)
        self._newest_ns = self._ros_ns(scan.t_ns)
        if scan.used:
            self._odom_frame = scan.odom_frame
        for frame in scan.frames if self._has_frames else ():
            name = radar_topic(self._info.radars[frame.radar])
            self._writers[name](pack_array(FLOAT_ARRAY, frame.samples))

    def on_snapshot(self, snapshot: Snapshot) -> None:
        self._last = snapshot
        twist = self._wheels.twist(snapshot.t_ns, snapshot.odometry)
        t_ns, covariance = self._ros_ns(snapshot.t_ns), snapshot.pose_covariance
        # that of a state which lags the newest scan is as good for that
        self._write_transform(max(self._newest_ns, self._tf_ns + 1))
        placed = cdr.planar(snapshot.estimate)
        self._writers["odometry"](cdr.odometry(t_ns, "map", placed, covariance, twist))
        self._writers["pose"](cdr.pose_with_covariance(t_ns, "map", snapshot.estimate, covariance))
        self._path.add(t_ns, snapshot.estimate)
        if self._drawn_ns is None or not 0 <= t_ns - self._drawn_ns < _EVERY_NS:
            self._draw()

    def on_smoothed(self, smoothed: SmoothedRun) -> None:
        path = GrowingPath("map")
        for t_ns, pose in zip(smoothed.t_ns.tolist(), smoothed.poses, strict=True):
            path.add(self._ros_ns(t_ns), pose)
        self._write_path("smoothed_path", path)

    def close(self) -> None:
        """Publish the map and the path once more, and leave the domain."""
        if self._last is not None:
            self._draw()
        self._writers.clear()
        del self._domain

    def _draw(self) -> None:
        assert self._last is not None
        self._drawn_ns = t_ns = self._ros_ns(self._last.t_ns)
        self._writers["landmarks"](cdr.markers(t_ns, "map", landmark_markers(self._last)))
        self._write_path("path", self._path)

    def _write_path(self, name: str, path: GrowingPath) -> None:
        stamps_ns, poses = path.thinned(_SHOWN_POSES)
        self._writers[name](cdr.path(int(stamps_ns[-1]), path.frame, stamps_ns, poses))

    def _write_transform(self, t_ns: int) -> None:
        if self._last is None:
            return
        self._tf_ns = t_ns
        odometry = between(self._odom_frame, self._last.odometry)
        map_from_odom = compose(self._last.estimate, between(odometry, np.zeros(3)))
        self._writers["tf"](cdr.transforms(t_ns, {("map", "odom"): map_from_odom}))

    def _ros_ns(self, t_ns: int) -> int:
        """Return the time of ROS at a session time."""
        if self._offset_ns is None:
            is_of_day = t_ns >= _SINCE_1970_NS
            self._offset_ns = 0 if is_of_day else self._info.started_unix_ns or 0
        return t_ns + self._offset_ns

    def _private(self, name: str) -> str:
        return f"{self._namespace}/uwb_slam/{name}"

    def _add(self, name: str, topic: str, message_type: str, *, latched: bool = False) -> None:
        self._writers[name] = self._domain.writer(topic, message_type, latched=latched)


def radar_topic(radar: RadarInfo) -> str:
    """Return the topic of a radar's frames in letters, digits and underscores, as ROS has them."""
    return f"frames/radar_{re.sub('[^A-Za-z0-9]', '_', radar.name)}"
