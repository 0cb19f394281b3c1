"""A session as a bag of ROS 1 or ROS 2 in the layout of the paper's authors' data set."""

from __future__ import annotations

import dataclasses
import json
import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_typestore

from slam.app import ros_messages as ros
from slam.app import rosbag_layout as layout
from slam.app.errors import AppError
from slam.app.session_head import radar_text, session_table
from slam.app.session_reader import RecordedSession
from slam.app.session_records import ScanEnd
from slam.app.tum import TumSample
from slam.frames import RadarFrame


class _Bag(Protocol):
    """What both kinds of bag take."""

    def write(self, topic: str, t_ns: int, message: ros.Message) -> None:
        """Write a message; the topic appears with its first one."""

    def close(self) -> None:
        """Write the index."""


class _Ros1Bag:
    def __init__(self, path: Path) -> None:
        self._store: Any = get_typestore(Stores.ROS1_NOETIC)
        self._writer: Any = Rosbag1Writer(path)
        self._writer.open()
        self._connections: dict[str, Any] = {}

    def write(self, topic: str, t_ns: int, message: ros.Message) -> None:
        name = message.__msgtype__
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, name, typestore=self._store, latching=1 if name == ros.STRING else None
            )
        data = self._store.serialize_ros1(self._as_ros1(message), name)
        self._writer.write(self._connections[topic], t_ns, data)

    def close(self) -> None:
        self._writer.close()

    def _as_ros1(self, value: object) -> object:
        """Rebuild a message with the classes of ROS 1, whose header has a number more."""
        if isinstance(value, list):
            return [self._as_ros1(item) for item in value]
        name = getattr(value, "__msgtype__", None)
        if name is None or not dataclasses.is_dataclass(value):
            return value
        parts = {
            field.name: self._as_ros1(getattr(value, field.name))
            for field in dataclasses.fields(value)
            if field.name != "__msgtype__"
        }
        if name == "std_msgs/msg/Header":
            parts["seq"] = 0
        return self._store.types[name](**parts)


class _Ros2Bag:
    def __init__(self, path: Path) -> None:
        self._store: Any = get_typestore(Stores.ROS2_HUMBLE)
        # 8 is the older of the two that can be written; older releases of ROS 2 read it, too
        self._writer: Any = Rosbag2Writer(path, version=8, storage_plugin=StoragePlugin.SQLITE3)
        self._writer.open()
        self._connections: dict[str, Any] = {}

    def write(self, topic: str, t_ns: int, message: ros.Message) -> None:
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, message.__msgtype__, typestore=self._store
            )
        self._writer.write(self._connections[topic], t_ns, ros.serialise(message))

    def close(self) -> None:
        self._writer.close()


def write_bag(session: RecordedSession, out: Path, check: Callable[[], None]) -> str:
    """Write frames, odometry and truth of a session; return what was written, in words.

    Parameters
    ----------
    session
        A recording.
    out
        ``*.bag`` for ROS 1, otherwise a new folder for ROS 2; bag times are session times.
    check
        Called for every message; may raise to stop, which leaves nothing behind.

    Raises
    ------
    AppError
        It exists already or cannot be written, or the session is damaged.
    """
    if out.exists():
        raise AppError(f"{out}: exists; choose another name")
    try:
        bag: _Bag = _Ros1Bag(out) if out.suffix == ".bag" else _Ros2Bag(out)
        try:
            counts = _fill(bag, session, check)
        finally:
            bag.close()
    except BaseException as error:
        _remove(out)
        if isinstance(
            error, OSError | sqlite3.Error
        ):  # SQLite has words of its own for a full disk
            reason = getattr(error, "strerror", None) or error
            raise AppError(f"{out}: cannot be written: {reason}") from None
        raise
    frames, poses, truths = counts
    kind = "ROS 1" if out.suffix == ".bag" else "ROS 2"
    return f"{out}: {kind}, {frames} frames, {poses} poses of the wheels, {truths} true poses"


def _fill(bag: _Bag, session: RecordedSession, check: Callable[[], None]) -> tuple[int, int, int]:
    begun = False
    frames = poses = truths = 0
    for record in session.records():
        check()
        if isinstance(record, RadarFrame | TumSample | ScanEnd) and not begun:
            begun = True
            _write_head(bag, session, record.t_ns)
        if isinstance(record, RadarFrame):
            topic = layout.frames_topic(record.radar)
            bag.write(topic, record.t_ns, ros.float_array(record.samples))
            frames += 1
        elif isinstance(record, TumSample):
            bag.write(layout.ODOMETRY_TOPIC, record.t_ns, ros.odometry(record))
            poses += 1
        elif isinstance(record, ScanEnd) and record.truth is not None:
            message = ros.pose_stamped(record.t_ns, "world", record.truth)
            bag.write(layout.TRUTH_TOPIC, record.t_ns, message)
            truths += 1
    if not frames:
        raise AppError(f"{session.path}: holds no frame")
    return frames, poses, truths


def _write_head(bag: _Bag, session: RecordedSession, t_ns: int) -> None:
    table = json.dumps(session_table(session.info))
    bag.write(layout.SESSION_TOPIC, t_ns, ros.string(table))
    for index, radar in enumerate(session.info.radars):
        bag.write(layout.info_topic(index), t_ns, ros.string(radar_text(radar)))


def _remove(out: Path) -> None:
    if out.is_dir():
        shutil.rmtree(out, ignore_errors=True)
    else:
        out.unlink(missing_ok=True)
