"""A session as a bag of ROS 1 or ROS 2 in the layout of the paper's authors' data set.

Their bags hold, per radar, `/UWBradar<k>/readings` (in earlier ones `/UWBradar<k>`) with one frame
per message as std_msgs/Float32MultiArray, which has neither stamp nor counter; `/odom` as
nav_msgs/Odometry; and a pose by laser as truth: Hector SLAM's `/slam_out_pose`, a
geometry_msgs/PoseStamped. Radars 2 and 4 look to the left, 1 and 3 to the right, as their public
launch file pairs them; each data set has a file of its own for that, so a rig file can change it.

What this program writes has two more kinds of topic, std_msgs/String with JSON, so that nothing is
lost on the way back: `/UWBradar<k>/info` and `/session`.

A frame's time is when it was recorded: the messages have no stamp of their own. Odometry and
truth keep the stamps of their headers where these are of the bag's clock.
"""

from __future__ import annotations

import json
import math
import re
import sqlite3
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_typestore

from slam.app.convert.imported_head import imported_info, imported_radar
from slam.app.session.writer import SessionLog
from slam.frames import RadarFrame
from slam.geometry import Mount, Rig
from slam.live.errors import AppError, OdometryError
from slam.live.frame_sources import recorded_frame
from slam.live.odometry_track import MOST_GAP_NS, NS_PER_S, OdometryTrack, TumSample
from slam.live.session import cdr
from slam.live.session.description import (
    radar_text,
    read_radar_text,
    read_session_table,
    session_table,
)
from slam.live.session.reader import RecordedSession, ScanEnd
from slam.live.session_records import RadarInfo, Scan, SessionInfo, TruthAt
from xethru_protocol.operating_system import StopFlag, StopRequestedError
from xethru_protocol.recordings.mcap import FLOAT_ARRAY, STRING, pack_array, pack_string
from xethru_protocol.validation import reason_of
from xethru_protocol.wire.errors import XeThruError
from xethru_protocol.wire.x4 import frame_area

ODOMETRY_TOPIC = "/odom"
TRUTH_TOPIC = "/slam_out_pose"
SESSION_TOPIC = "/session"

_FRAMES = re.compile(r"/?(UWBradar\d+)(/readings)?")
_INFO = re.compile(r"/?(UWBradar\d+)/info")


def authors_rig(ahead_m: float, aside_m: float) -> Rig:
    """Return the authors' four radars, so far ahead of or behind the middle, and to its side."""
    right, left = -math.pi / 2, math.pi / 2
    places = (
        (ahead_m, -aside_m, right),
        (-ahead_m, aside_m, left),
        (-ahead_m, -aside_m, right),
        (ahead_m, aside_m, left),
    )
    return Rig(
        mounts=tuple(
            Mount(name=f"UWBradar{number}", x_m=x, y_m=y, yaw_rad=yaw)
            for number, (x, y, yaw) in enumerate(places, start=1)
        )
    )


AUTHORS_RIG = authors_rig(0.1, 0.2)
"""The paper's mounts under the names of their topics."""


def _radar_of(pattern: re.Pattern[str], topic: str) -> str | None:
    """Return the radar of a topic, None for other topics.

    >>> [_radar_of(_FRAMES, topic) for topic in ("UWBradar3", "/UWBradar3/readings", "/x")]
    ['UWBradar3', 'UWBradar3', None]
    """
    found = pattern.fullmatch(topic)
    return found[1] if found else None


# A header's stamp further from the time of recording is of another clock.
_SAME_CLOCK_NS = NS_PER_S
_TIME_OF_DAY_NS = 1_000_000_000 * NS_PER_S  # of 2001; simulated clocks begin at 0
_TRUTH_TYPES = (cdr.POSE, cdr.POSE_WITH_COVARIANCE, cdr.ODOMETRY)
_PAPER_BINS, _PAPER_AREA_M = 1431, (0.2, 9.4)


@dataclass(slots=True, kw_only=True)
class _Stream:
    """The frames of one topic, as far as one look shows."""

    n_bins: int
    stamps_ns: list[int] = field(default_factory=list)


@dataclass(slots=True, kw_only=True)
class _Contents:
    streams: dict[str, _Stream] = field(default_factory=dict)
    infos: dict[str, str] = field(default_factory=dict)
    odometry: list[TumSample] = field(default_factory=list)
    truth: list[TumSample] = field(default_factory=list)
    session: str | None = None
    left_out: int = 0
    """Poses that were not later than the one before."""


def convert_bag(
    bag: Path,
    out: Path,
    stop: StopFlag,
    *,
    preset: str,
    rig: Rig,
    area_m: tuple[float, float] | None,
    truth_topic: str,
) -> tuple[str, list[str]]:
    """Write a bag as a session; return a line about it, and warnings.

    Parameters
    ----------
    preset
        For bags that were not made of a session of this program.
    rig
        Mounts under the names of the topics (UWBradar1, ...); ignored if the bag has them.
    area_m
        Frame area that the modules were asked for, module metres; None: the paper's.
    truth_topic
        Of geometry_msgs/PoseStamped or PoseWithCovarianceStamped or nav_msgs/Odometry.

    Raises
    ------
    AppError
        No bag, a damaged one, one without radars or odometry, or frames that do not fit the frame
        area.
    """
    contents = _contents(bag, truth_topic, stop)
    warnings = []
    if contents.left_out:
        warnings.append(f"poses that went back in time and are left out: {contents.left_out}")
    names = sorted(contents.streams, key=lambda name: int(name.removeprefix("UWBradar")))
    radars = tuple(_radar_info(bag, name, contents, rig, area_m) for name in names)
    try:
        odometry = OdometryTrack(contents.odometry)
    except OdometryError:
        raise AppError(f"{bag}: holds no pose on {ODOMETRY_TOPIC}, nav_msgs/Odometry") from None
    truth = OdometryTrack(contents.truth, may_restart=False) if contents.truth else None
    if truth is None:
        warnings.append(f"no truth on {truth_topic}: numbers that need it will be null")
    period_ns = float(np.median([1e9 / radar.rate_hz for radar in radars]))
    start_ns = min(stream.stamps_ns[0] for stream in contents.streams.values())
    log = SessionLog(
        out,
        _session_info(bag, contents, radars, preset),
        odometry,
        truth_at=None if truth is None else _truth_at(truth),
        start_ns=min(start_ns, odometry.first_ns),
    )
    unused = n_scans = 0
    try:
        for scan in _scans(_frames(bag, names, radars, stop), period_ns):
            used = all(odometry.is_known(frame.t_ns) for frame in scan.frames)
            unused += not used
            n_scans += 1
            log.on_scan(replace(scan, used=used))
    finally:
        log.close()
    if unused:
        warnings.append(
            f"{unused} scans lie outside the odometry, or in a hole of it longer than "
            f"{MOST_GAP_NS // NS_PER_S} s, and are marked as not to be used"
        )
    n_frames = sum(len(stream.stamps_ns) for stream in contents.streams.values())
    return (
        f"{out}: {n_frames} frames of {len(radars)} radars in {n_scans} scans, "
        f"{len(odometry)} poses of the wheels, {len(contents.truth)} true poses",
        warnings,
    )


def _contents(bag: Path, truth_topic: str, stop: StopFlag) -> _Contents:
    contents = _Contents()
    with _open(bag) as reader:
        for connection in reader.connections:
            _check_type(bag, connection.topic, connection.msgtype, truth_topic)
        for connection, t_ns, raw in stop.each(reader.messages()):
            topic = connection.topic
            if (radar := _radar_of(_FRAMES, topic)) is not None:
                n_bins = len(reader.deserialize(raw, connection.msgtype).data)
                stream = contents.streams.setdefault(radar, _Stream(n_bins=n_bins))
                if n_bins != stream.n_bins:
                    raise AppError(
                        f"{bag}: {topic} has frames of {stream.n_bins} and of {n_bins} bins"
                    )
                stream.stamps_ns.append(t_ns)
            elif (radar := _radar_of(_INFO, topic)) is not None:
                contents.infos[radar] = reader.deserialize(raw, connection.msgtype).data
            elif topic == SESSION_TOPIC:
                contents.session = reader.deserialize(raw, connection.msgtype).data
            elif topic in (ODOMETRY_TOPIC, truth_topic):
                poses = contents.odometry if topic == ODOMETRY_TOPIC else contents.truth
                sample = cdr.pose_sample(reader.deserialize(raw, connection.msgtype))
                if abs(sample.t_ns - t_ns) >= _SAME_CLOCK_NS:
                    sample = replace(sample, t_ns=t_ns)
                if poses and sample.t_ns <= poses[-1].t_ns:
                    contents.left_out += 1
                else:
                    poses.append(sample)
    if not contents.streams:
        raise AppError(
            f"{bag}: holds no frames; they are looked for on /UWBradar1/readings and so on"
        )
    return contents


def _check_type(bag: Path, topic: str, message_type: str, truth_topic: str) -> None:
    if _radar_of(_FRAMES, topic) is not None:
        allowed: tuple[str, ...] = (FLOAT_ARRAY,)
    elif _radar_of(_INFO, topic) is not None or topic == SESSION_TOPIC:
        allowed = (STRING,)
    elif topic == ODOMETRY_TOPIC:
        allowed = (cdr.ODOMETRY,)
    elif topic == truth_topic:
        allowed = _TRUTH_TYPES
    else:
        return
    if message_type not in allowed:
        raise AppError(f"{bag}: {topic} is {message_type}, must be {' or '.join(allowed)}")


@contextmanager
def _open(bag: Path) -> Iterator[Any]:
    """Open a bag; whatever reading it raises becomes one line."""
    folder = bag.parent if bag.suffix in (".db3", ".yaml") else bag
    store = get_typestore(Stores.ROS2_HUMBLE)
    try:
        with AnyReader([folder], default_typestore=store) as reader:
            yield reader
    except (AppError, StopRequestedError):
        raise
    except FileNotFoundError:
        raise AppError(f"{bag}: no bag is there") from None
    except OSError as error:
        raise AppError(f"{bag}: cannot read: {error.strerror or error}") from None
    except Exception as error:  # rosbags documents no exceptions for damaged bags
        reason = " ".join(reason_of(error).split())
        raise AppError(
            f"{bag}: no bag of ROS 1 or 2, or a damaged one: {reason}; `rosbag reindex` or "
            "`ros2 bag reindex` mend some"
        ) from None


def _radar_info(
    bag: Path,
    name: str,
    contents: _Contents,
    rig: Rig,
    area_m: tuple[float, float] | None,
) -> RadarInfo:
    stream = contents.streams[name]
    if name in contents.infos:
        return read_radar_text(bag, f"/{name}/info", contents.infos[name])
    mount = next((mount for mount in rig.mounts if mount.name == name), None)
    if mount is None:
        known = ", ".join(mount.name for mount in rig.mounts)
        raise AppError(f"{bag}: radar {name} is not in the rig ({known}); give --rig")
    if area_m is None and stream.n_bins != _PAPER_BINS:
        raise AppError(
            f"{bag}: frames of {stream.n_bins} bins, not the paper's {_PAPER_BINS}; "
            "say --frame-area START END, in metres, as the modules were asked for"
        )
    area_m = area_m or _PAPER_AREA_M
    try:
        area = frame_area(*area_m)
    except XeThruError as error:
        raise AppError(f"--frame-area: {error}") from None
    if area.n_bins != stream.n_bins:
        raise AppError(
            f"{bag}: frames of {stream.n_bins} bins, but a frame area of {area_m[0]:g} to "
            f"{area_m[1]:g} m has {area.n_bins}; say another --frame-area"
        )
    steps_ns = np.diff(stream.stamps_ns)
    period_ns = float(np.median(steps_ns)) if len(steps_ns) else 0.0
    return imported_radar(
        mount,
        range_start_m=area.start_m,
        bin_length_m=(area.end_m - area.start_m) / area.n_bins,
        n_bins=area.n_bins,
        rate_hz=NS_PER_S / period_ns if period_ns > 0 else 1.0,
    )


def _session_info(
    bag: Path, contents: _Contents, radars: tuple[RadarInfo, ...], preset: str
) -> SessionInfo:
    if contents.session is not None:
        try:
            table = json.loads(contents.session)
        except ValueError as error:
            raise AppError(f"{bag}: {SESSION_TOPIC} cannot be read: {error}") from None
        return read_session_table(bag, table, radars)
    info = imported_info(bag, radars, preset, time_base="recording")
    first_ns = min(stream.stamps_ns[0] for stream in contents.streams.values())
    return replace(info, started_unix_ns=0 if first_ns > _TIME_OF_DAY_NS else None)


def _truth_at(track: OdometryTrack) -> TruthAt:
    """Return what gives true poses; NaN further outside the truth than it is held."""

    def pose_at(t_ns: int) -> NDArray[np.float64]:
        try:
            return track.pose_at(t_ns)
        except OdometryError:
            return np.full(3, math.nan)

    return lambda stamps_ns: np.array([pose_at(int(t_ns)) for t_ns in stamps_ns])


def _frames(
    bag: Path, names: Sequence[str], radars: Sequence[RadarInfo], stop: StopFlag
) -> Iterator[RadarFrame]:
    counters = [0] * len(names)
    with _open(bag) as reader:
        wanted = [one for one in reader.connections if _radar_of(_FRAMES, one.topic) is not None]
        for connection, t_ns, raw in stop.each(reader.messages(wanted)):
            index = names.index(str(_radar_of(_FRAMES, connection.topic)))
            message = reader.deserialize(raw, connection.msgtype)
            samples = np.asarray(message.data, dtype=np.float32)
            yield recorded_frame(index, radars[index], samples, t_ns=t_ns, counter=counters[index])
            counters[index] += 1


def _scans(frames: Iterator[RadarFrame], period_ns: float) -> Iterator[Scan]:
    """Group frames: a scan ends before a radar's second frame, or one period after its first."""
    held: dict[int, RadarFrame] = {}
    number = 0
    for frame in frames:
        first = next(iter(held.values()), None)
        if first is not None and (frame.radar in held or frame.t_ns - first.t_ns >= period_ns):
            yield _scan(number, held)
            held = {}
            number += 1
        held[frame.radar] = frame
    if held:
        yield _scan(number, held)


def _scan(number: int, held: dict[int, RadarFrame]) -> Scan:
    frames = tuple(held[radar] for radar in sorted(held))
    return Scan(counter=number, t_ns=min(frame.t_ns for frame in frames), frames=frames)


class _Bag:
    """A bag of ROS 1 if the path ends in .bag, else of ROS 2."""

    def __init__(self, path: Path) -> None:
        self._is_ros1 = path.suffix == ".bag"
        self._ros2_store: Any = get_typestore(Stores.ROS2_HUMBLE)
        self._store: Any = self._ros2_store
        self._writer: Any
        if self._is_ros1:
            self._store = get_typestore(Stores.ROS1_NOETIC)
            self._writer = Rosbag1Writer(path)
        else:
            # 8 is the older of two versions: older releases of ROS 2 read it, too
            self._writer = Rosbag2Writer(path, version=8, storage_plugin=StoragePlugin.SQLITE3)
        self._writer.open()
        self._connections: dict[str, Any] = {}

    def write(self, topic: str, t_ns: int, message_type: str, data: bytes) -> None:
        """Write a message in CDR; the topic appears with its first one."""
        if topic not in self._connections:
            latching = {"latching": 1 if message_type == STRING else None} if self._is_ros1 else {}
            self._connections[topic] = self._writer.add_connection(
                topic, message_type, typestore=self._store, **latching
            )
        if self._is_ros1:
            data = self._ros2_store.cdr_to_ros1(data, message_type)
        self._writer.write(self._connections[topic], t_ns, data)

    def close(self) -> None:
        self._writer.close()


def write_bag(session: RecordedSession, out: Path, stop: StopFlag) -> str:
    """Write frames, odometry and truth of a session; return a line about it.

    `*.bag` is for ROS 1, any other name a new folder for ROS 2; bag times are session times.
    """
    try:
        with closing(_Bag(out)) as bag:
            counts = _fill(bag, session, stop)
    except (OSError, sqlite3.Error) as error:  # SQLite has its own for a full disk
        reason = getattr(error, "strerror", None) or error
        raise AppError(f"{out}: cannot be written: {reason}") from None
    frames, poses, truths = counts
    kind = "ROS 1" if out.suffix == ".bag" else "ROS 2"
    return f"{out}: {kind}, {frames} frames, {poses} poses of the wheels, {truths} true poses"


def _fill(bag: _Bag, session: RecordedSession, stop: StopFlag) -> tuple[int, int, int]:
    head_is_written = False
    frames = poses = truths = 0
    for record in session.records():
        stop.check()
        if isinstance(record, RadarFrame | TumSample | ScanEnd) and not head_is_written:
            head_is_written = True
            table = json.dumps(session_table(session.info))
            bag.write(SESSION_TOPIC, record.t_ns, STRING, pack_string(table))
            for number, radar in enumerate(session.info.radars, start=1):
                topic = f"/UWBradar{number}/info"
                bag.write(topic, record.t_ns, STRING, pack_string(radar_text(radar)))
        if isinstance(record, RadarFrame):
            topic = f"/UWBradar{record.radar + 1}/readings"
            bag.write(topic, record.t_ns, FLOAT_ARRAY, pack_array(FLOAT_ARRAY, record.samples))
            frames += 1
        elif isinstance(record, TumSample):
            bag.write(ODOMETRY_TOPIC, record.t_ns, cdr.ODOMETRY, cdr.wheel_odometry(record))
            poses += 1
        elif isinstance(record, ScanEnd) and record.truth is not None:
            data = cdr.pose_stamped(record.t_ns, "world", record.truth)
            bag.write(TRUTH_TOPIC, record.t_ns, cdr.POSE, data)
            truths += 1
    if not frames:
        raise AppError(f"{session.path}: holds no frame")
    return frames, poses, truths
