"""What a session is made of, and how each message of its file says so."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from slam.app import ros_messages as ros
from slam.app.mcap_messages import RawMessage
from slam.app.session import LogLine, RadarInfo, Snapshot
from slam.app.session_states import snapshot_of
from slam.app.sources import TRUE_PER_MODULE_METRE, sampler_limits
from slam.app.tum import TumSample
from slam.frames import RadarFrame
from xethru_protocol.driver import RawConfig

_LOG_WARN = 30


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TruthPose:
    """Where the robot really was; shape (3,), [x m, y m, heading rad], world frame."""

    t_ns: int
    pose: NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class ReceivedFrame:
    """A frame and when it arrived at the host, nanoseconds since 1970; None where nobody noted."""

    frame: RadarFrame
    host_ns: int | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScanEnd:
    """The frames before it made a scan; see `Scan`.

    ``members`` are their radars and counters, so that a scan is known to be whole.
    ``truth`` has shape (3,), [x m, y m, heading rad], world frame; None where nobody knew.
    """

    counter: int
    t_ns: int
    used: bool
    members: tuple[tuple[int, int], ...]
    truth: NDArray[np.float64] | None


Recorded: TypeAlias = ReceivedFrame | TumSample | TruthPose | LogLine | ScanEnd | Snapshot
"""What the messages of a session say; a TumSample is odometry."""

FrameTopics: TypeAlias = Mapping[str, tuple[int, RadarInfo, tuple[float, float] | None]]
"""By topic: index and description of a radar, and the limits of its sampler."""


def read_record(message: RawMessage, frame_of: FrameTopics) -> Recorded | None:
    """Return what a message says; None for those that say nothing new."""
    found = frame_of.get(message.topic)
    if found is not None:
        host_ns = None if message.publish_ns == message.t_ns else message.publish_ns
        return ReceivedFrame(frame=_frame(message, *found), host_ns=host_ns)
    read = _READERS.get(message.topic)
    return None if read is None else read(message)


def _frame(
    message: RawMessage, index: int, radar: RadarInfo, limits: tuple[float, float] | None
) -> RadarFrame:
    samples = np.asarray(ros.deserialise(message.data, ros.FLOAT_ARRAY).data, dtype=np.float32)
    if len(samples) != radar.n_bins:
        raise ValueError(f"{len(samples)} samples, but the radar was set to {radar.n_bins}")
    return RadarFrame(
        radar=index,
        t_ns=message.t_ns,
        counter=message.sequence,
        samples=samples,
        range_start_m=radar.range_start_m * TRUE_PER_MODULE_METRE,
        bin_length_m=radar.bin_length_m * TRUE_PER_MODULE_METRE,
        limits=limits,
    )


def limits_of(radar: RadarInfo) -> tuple[float, float] | None:
    """Return the sampler's limits where the recorded settings are those of this driver."""
    known = {field.name for field in fields(RawConfig)}
    if set(radar.settings) != known:
        return None
    return sampler_limits(RawConfig(**dict(radar.settings)))  # type: ignore[arg-type]  # from JSON


def _scan_end(message: RawMessage) -> ScanEnd:
    values = ros.deserialise(message.data, ros.DOUBLE_ARRAY).data
    n_frames = int(values[0]) if len(values) else -1
    members, truth = np.split(values[1:], [2 * n_frames])
    if n_frames < 0 or len(members) != 2 * n_frames or len(truth) not in (0, 3):
        raise ValueError(f"a scan's mark of {len(values)} numbers says it has {n_frames} frames")
    return ScanEnd(
        counter=message.sequence,
        t_ns=message.t_ns,
        used=message.topic == "/scan",
        members=tuple((int(radar), int(counter)) for radar, counter in members.reshape(-1, 2)),
        truth=truth if len(truth) else None,
    )


def _state(message: RawMessage) -> Snapshot:
    row = ros.deserialise(message.data, ros.DOUBLE_ARRAY).data
    return snapshot_of(message.sequence, message.t_ns, row)


def _odometry(message: RawMessage) -> TumSample:
    return ros.odometry_sample(ros.deserialise(message.data, ros.ODOMETRY))


def _truth(message: RawMessage) -> TruthPose:
    pose = ros.deserialise(message.data, ros.POSE).pose
    heading_rad = 2.0 * math.atan2(pose.orientation.z, pose.orientation.w)
    return TruthPose(
        t_ns=message.t_ns, pose=np.array([pose.position.x, pose.position.y, heading_rad])
    )


def _log_line(message: RawMessage) -> LogLine:
    line = ros.deserialise(message.data, ros.LOG)
    return LogLine(
        t_ns=message.t_ns, radar=line.name, warning=line.level >= _LOG_WARN, text=line.msg
    )


_READERS: Mapping[str, Callable[[RawMessage], Recorded]] = {
    "/scan": _scan_end,
    "/scan_unused": _scan_end,
    "/slam/state": _state,
    "/odom": _odometry,
    "/truth": _truth,
    "/log": _log_line,
}
