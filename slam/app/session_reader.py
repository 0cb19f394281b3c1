"""A recorded session read back: what `uwb-slam demo` wrote, in the order it was written.

`open_session` reads who recorded what; `RecordedSession.records` streams frames (true metres, own
stamps), odometry, truth and log lines with the same floats the run itself saw. Nothing is held
but one chunk of the file, so a recording of hours costs no more memory than one of seconds.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from slam.app import ros_messages as ros
from slam.app.errors import AppError, OdometryError
from slam.app.mcap_messages import Metadata, RawMessage, read_entries
from slam.app.odometry import OdometryTrack
from slam.app.session import LogLine, RadarInfo, Scan, SessionInfo
from slam.app.session_log import LENGTH_UNIT, METADATA_NAME
from slam.app.sources import TRUE_PER_MODULE_METRE, sampler_limits, whole_periods
from slam.app.tum import TumSample
from slam.frames import RadarFrame
from slam.geometry import Mount, Rig
from xethru_protocol.driver import RawConfig
from xethru_protocol.x4 import frame_time_ns

_LOG_WARN = 30


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TruthPose:
    """Where the robot really was; shape (3,), [x m, y m, heading rad], world frame."""

    t_ns: int
    pose: NDArray[np.float64]


SessionRecord: TypeAlias = RadarFrame | TumSample | TruthPose | LogLine
"""What a session is made of; a TumSample is odometry."""


class RecordedSession:
    """One session file.

    Attributes
    ----------
    path
        The file.
    info
        Scene, preset, seed, radars and versions of the run.
    cut_at_byte
        Where the file ends too early, after `records` has come to its end; None where it is whole.
    """

    def __init__(self, path: Path, info: SessionInfo) -> None:
        self.path = path
        self.info = info
        self.cut_at_byte: int | None = None

    @property
    def rig(self) -> Rig:
        """Return the mounts as the run knew them."""
        return Rig(
            mounts=tuple(
                Mount(
                    name=radar.name,
                    x_m=radar.x_m,
                    y_m=radar.y_m,
                    yaw_rad=radar.yaw_rad,
                    range_offset_m=radar.range_offset_m,
                    phase_offset_rad=radar.phase_offset_rad,
                )
                for radar in self.info.radars
            )
        )

    def records(self) -> Iterator[SessionRecord]:
        """Yield what was recorded, in the order of the file; may be called again.

        Raises
        ------
        AppError
            The file is damaged other than by being cut at its end.
        """
        frame_of = {
            f"/radar/{radar.name}/frame": (index, radar, _limits(radar))
            for index, radar in enumerate(self.info.radars)
        }
        for entry in read_entries(self.path, self._on_cut):
            if not isinstance(entry, RawMessage):
                continue
            try:
                if entry.topic in frame_of:
                    yield _frame(entry, *frame_of[entry.topic])
                elif entry.topic == "/odom":
                    yield ros.odometry_sample(ros.deserialise(entry.data, ros.ODOMETRY))
                elif entry.topic == "/truth":
                    yield _truth(entry)
                elif entry.topic == "/log":
                    yield _log_line(entry)
            except (ValueError, TypeError, AssertionError, IndexError) as error:
                raise AppError(
                    f"{self.path}: a message of {entry.topic} at "
                    f"{entry.t_ns / 1e9:.3f} s cannot be read: {error}"
                ) from None

    def odometry(self) -> OdometryTrack:
        """Return the whole track of the wheels.

        Raises
        ------
        AppError
            None was recorded, or the file is damaged.
        """
        samples = [record for record in self.records() if isinstance(record, TumSample)]
        try:
            return OdometryTrack(samples)
        except OdometryError as error:
            raise AppError(f"{self.path}: {error}") from None

    def _on_cut(self, at_byte: int) -> None:
        self.cut_at_byte = at_byte


def open_session(path: Path) -> RecordedSession:
    """Read the head of a session file.

    Raises
    ------
    AppError
        One line with the file: missing, foreign, damaged, or cut before the radars are named.
    """
    head: dict[str, str] | None = None
    radars: list[RadarInfo] = []
    for entry in read_entries(path, lambda _: None):
        if isinstance(entry, Metadata):
            if entry.name == METADATA_NAME:
                head = entry.values
        elif entry.topic.startswith("/radar/") and entry.topic.endswith("/info"):
            radars.append(_radar_info(path, entry))
        else:
            break  # the infos come before everything else
    if head is None:
        raise AppError(
            f"{path}: an MCAP file, but no session of `uwb-slam demo`; "
            f"its metadata {METADATA_NAME!r} is missing"
        )
    if not radars:
        raise AppError(f"{path}: ends before any radar is named; record the session again")
    return RecordedSession(path, _session_info(path, head, tuple(radars)))


def scans(session: RecordedSession) -> Iterator[Scan]:
    """Yield the frames of a session by tick, as a live source does; see `Scan`.

    The frames of one tick stand together in the file.
    """
    radars = session.info.radars
    late = [whole_periods(radar.start_skew_ns, radar.rate_hz) for radar in radars]
    held: list[RadarFrame] = []
    for record in session.records():
        if not isinstance(record, RadarFrame):
            continue
        if held and record.counter + late[record.radar] != held[0].counter + late[held[0].radar]:
            yield _scan(held, radars, late)
            held = []
        held.append(record)
    if held:
        yield _scan(held, radars, late)


def _scan(frames: list[RadarFrame], radars: tuple[RadarInfo, ...], late: list[int]) -> Scan:
    radar = frames[0].radar
    tick = frames[0].counter + late[radar]
    return Scan(counter=tick, t_ns=frame_time_ns(tick, radars[radar].rate_hz), frames=tuple(frames))


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


def _limits(radar: RadarInfo) -> tuple[float, float] | None:
    """Return the sampler's limits where the recorded settings are those of this driver."""
    known = {field.name for field in fields(RawConfig)}
    if set(radar.settings) != known:
        return None
    return sampler_limits(RawConfig(**dict(radar.settings)))  # type: ignore[arg-type]  # from JSON


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


def _radar_info(path: Path, message: RawMessage) -> RadarInfo:
    try:
        facts = json.loads(ros.deserialise(message.data, ros.STRING).data)
        unit = facts["length_unit"]
        known = {
            field.name: facts[field.name] for field in fields(RadarInfo) if field.name in facts
        }
        missing = [
            field.name
            for field in fields(RadarInfo)
            if field.name not in known
            and field.default is MISSING
            and field.default_factory is MISSING
        ]
    except (ValueError, TypeError, KeyError, AssertionError, IndexError) as error:
        raise AppError(f"{path}: {message.topic} cannot be read: {error!r}") from None
    if missing:
        raise AppError(f"{path}: {message.topic} does not tell {', '.join(missing)}")
    if unit != LENGTH_UNIT:
        raise AppError(f"{path}: {message.topic}: lengths in {unit!r}, expected {LENGTH_UNIT!r}")
    return RadarInfo(**known)


def _session_info(path: Path, head: dict[str, str], radars: tuple[RadarInfo, ...]) -> SessionInfo:
    try:
        landmarks = np.array(json.loads(head["true_landmarks_m"]), dtype=np.float64)
        return SessionInfo(
            scene=head["scene"],
            preset=head["preset"],
            seed=int(head["seed"]),
            radars=radars,
            true_landmarks_m=landmarks.reshape(-1, 2),
            versions=json.loads(head["versions"]),
        )
    except (KeyError, ValueError) as error:
        raise AppError(f"{path}: metadata {METADATA_NAME!r} cannot be read: {error!r}") from None
