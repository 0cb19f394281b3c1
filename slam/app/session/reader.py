"""A recorded session read back: what `SessionLog` wrote, in the order it was written.

`open_session` reads who recorded what; `RecordedSession.records` streams frames (true metres, own
stamps), odometry, truth, states and log lines with the same floats the run itself saw. Nothing is
held but one chunk of the file, so a recording of hours costs no more memory than one of seconds.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from slam.app.errors import AppError, OdometryError
from slam.app.odometry.track import OdometryTrack, TumSample
from slam.app.records import LogLine, RadarInfo, Scan, SessionInfo, Snapshot
from slam.app.rig.sources import TRUE_PER_MODULE_METRE, sampler_limits
from slam.app.session import messages as ros
from slam.app.session.mcap import read_entries
from slam.app.session.messages import (
    METADATA_NAME,
    check_format,
    read_radar_text,
    read_session_table,
    snapshot_of,
)
from slam.frames import Detection, RadarFrame
from slam.geometry import Mount, Rig
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.recordings.mcap import (
    BYTE_ARRAY,
    DOUBLE_ARRAY,
    FLOAT_ARRAY,
    Message,
    Metadata,
    unpack_array,
    unpack_string,
)

_LOG_WARN = 30


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TruthPose:
    """Where the robot really was; shape (3,), [x m, y m, heading rad], world frame."""

    t_ns: int
    pose: NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class ReceivedFrame:
    """A frame and when it arrived at the host, nanoseconds since 1970; None if not recorded."""

    frame: RadarFrame
    host_ns: int | None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScanEnd:
    """The frames before it made a scan; see `Scan`.

    ``members`` are their radars and counters, so that a scan is known to be whole.
    ``truth`` has shape (3,), [x m, y m, heading rad], world frame; None if unknown.
    """

    counter: int
    t_ns: int
    used: bool
    members: tuple[tuple[int, int], ...]
    truth: NDArray[np.float64] | None


Recorded: TypeAlias = ReceivedFrame | TumSample | TruthPose | LogLine | ScanEnd | Snapshot
"""A record of the file; a TumSample is odometry."""

FrameTopics: TypeAlias = Mapping[str, tuple[int, RadarInfo, tuple[float, float] | None]]
"""By topic: index and description of a radar, and the limits of its sampler."""


def read_record(message: Message, frame_of: FrameTopics) -> Recorded | None:
    """Return the content of a message; None for messages that repeat others."""
    found = frame_of.get(message.topic)
    if found is not None:
        host_ns = None if message.publish_ns == message.t_ns else message.publish_ns
        return ReceivedFrame(frame=_frame(message, *found), host_ns=host_ns)
    read = _READERS.get(message.topic)
    return None if read is None else read(message)


def _frame(
    message: Message, index: int, radar: RadarInfo, limits: tuple[float, float] | None
) -> RadarFrame:
    samples = unpack_array(FLOAT_ARRAY, message.data)
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


def _scan_end(message: Message) -> ScanEnd:
    values = unpack_array(DOUBLE_ARRAY, message.data)
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


def _state(message: Message) -> Snapshot:
    row = unpack_array(DOUBLE_ARRAY, message.data)
    return snapshot_of(message.sequence, message.t_ns, row)


def _odometry(message: Message) -> TumSample:
    return ros.odometry_sample(ros.deserialise(message.data, ros.ODOMETRY))


def _truth(message: Message) -> TruthPose:
    pose = ros.deserialise(message.data, ros.POSE).pose
    heading_rad = 2.0 * math.atan2(pose.orientation.z, pose.orientation.w)
    return TruthPose(
        t_ns=message.t_ns, pose=np.array([pose.position.x, pose.position.y, heading_rad])
    )


def _log_line(message: Message) -> LogLine:
    line = ros.deserialise(message.data, ros.LOG)
    return LogLine(
        t_ns=message.t_ns, radar=line.name, warning=line.level >= _LOG_WARN, text=line.msg
    )


_READERS: Mapping[str, Callable[[Message], Recorded]] = {
    "/scan": _scan_end,
    "/scan_unused": _scan_end,
    "/slam/state": _state,
    "/odom": _odometry,
    "/truth": _truth,
    "/log": _log_line,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class WireBytes:
    """Bytes as a radar's port gave (rx) or took (tx) them.

    ``t_ns`` is the session time of the newest scan then, ``host_ns`` the driver's own clock.
    """

    radar: str
    way: Literal["rx", "tx"]
    data: bytes
    t_ns: int
    host_ns: int


SessionRecord: TypeAlias = RadarFrame | TumSample | TruthPose | LogLine | ScanEnd | Snapshot
"""What `RecordedSession.records` yields; a TumSample is odometry."""


class RecordedSession:
    """One session file.

    Attributes
    ----------
    path
        The file.
    info
        Scene, preset, seed, settings, radars and versions of the run.
    cut_at_byte
        Where the file ends too early, after `records` has come to its end; None where it is whole.
    """

    def __init__(self, path: Path, info: SessionInfo, *, size: int | None = None) -> None:
        self.path = path
        self._size = size  # when it was opened: a run may be writing it still
        self.info = info
        self.cut_at_byte: int | None = None

    @property
    def rig(self) -> Rig:
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
        for record in self._received():
            yield record.frame if isinstance(record, ReceivedFrame) else record

    def scans(self) -> Iterator[tuple[Scan, NDArray[np.float64] | None]]:
        """Yield every scan as the run took it, and the true pose at it, shape (3,), if known.

        A scan that damage or the end of a cut file left incomplete is not among them.
        """
        held: list[ReceivedFrame] = []
        for record in self._received():
            if isinstance(record, ReceivedFrame):
                held.append(record)
            elif isinstance(record, ScanEnd):
                # frames before them are of a scan whose mark is lost
                held = held[max(len(held) - len(record.members), 0) :]
                if tuple((row.frame.radar, row.frame.counter) for row in held) != record.members:
                    held = []
                    continue
                arrivals = tuple(row.host_ns for row in held if row.host_ns is not None)
                yield (
                    Scan(
                        counter=record.counter,
                        t_ns=record.t_ns,
                        frames=tuple(row.frame for row in held),
                        host_ns=arrivals if len(arrivals) == len(held) else (),
                        used=record.used,
                    ),
                    record.truth,
                )
                held = []

    def detections(self) -> dict[int, tuple[Detection, ...]]:
        """Return the recorded ranges by the time of their scan [ns]; amplitudes are unknown."""
        index_of = {
            f"/radar/{radar.name}/detections": index for index, radar in enumerate(self.info.radars)
        }
        of_scan: dict[int, tuple[Detection, ...]] = {}
        held: list[Detection] = []
        for entry in read_entries(self.path, self._on_cut, self._size):
            if not isinstance(entry, Message):
                continue
            if entry.topic in index_of:
                with self._naming(entry):
                    ranges_m = unpack_array(DOUBLE_ARRAY, entry.data).tolist()
                radar, t_ns = index_of[entry.topic], entry.t_ns
                held += [
                    Detection(radar=radar, t_ns=t_ns, range_m=range_m, amplitude=math.nan)
                    for range_m in ranges_m
                ]
            elif entry.topic == "/scan":
                of_scan[entry.t_ns] = tuple(one for one in held if one.t_ns == entry.t_ns)
                held = []
        return of_scan

    def wire(self) -> Iterator[WireBytes]:
        """Yield the raw bytes of all ports in the order of the file; nothing if none are in it."""
        ways: dict[str, tuple[str, Literal["rx", "tx"]]] = {}
        for radar in self.info.radars:
            ways[f"/radar/{radar.name}/rx"] = (radar.name, "rx")
            ways[f"/radar/{radar.name}/tx"] = (radar.name, "tx")
        for entry in read_entries(self.path, self._on_cut, self._size):
            if isinstance(entry, Message) and (found := ways.get(entry.topic)):
                with self._naming(entry):
                    data = unpack_array(BYTE_ARRAY, entry.data).tobytes()
                yield WireBytes(
                    radar=found[0],
                    way=found[1],
                    data=data,
                    t_ns=entry.t_ns,
                    host_ns=entry.publish_ns,
                )

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

    def _received(self) -> Iterator[Recorded]:
        frame_of = {
            f"/radar/{radar.name}/frame": (index, radar, limits_of(radar))
            for index, radar in enumerate(self.info.radars)
        }
        for entry in read_entries(self.path, self._on_cut, self._size):
            if not isinstance(entry, Message):
                continue
            with self._naming(entry):
                record = read_record(entry, frame_of)
            if record is not None:
                yield record

    @contextmanager
    def _naming(self, entry: Message) -> Iterator[None]:
        try:
            yield
        except (ValueError, TypeError, AssertionError, IndexError, struct.error) as error:
            raise AppError(
                f"{self.path}: a message of {entry.topic} at "
                f"{entry.t_ns / 1e9:.3f} s cannot be read: {error}"
            ) from None

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
    cut: list[int] = []
    try:
        size = path.stat().st_size
    except OSError:
        size = None  # reading it reports what is wrong
    for entry in read_entries(path, cut.append, size):
        if isinstance(entry, Metadata):
            if entry.name == METADATA_NAME:
                head = entry.values
                check_format(path, head)
        elif entry.topic.startswith("/radar/") and entry.topic.endswith("/info"):
            radars.append(_radar_info(path, entry))
        else:
            break  # the infos come before everything else
    if head is None:
        if cut:
            raise AppError(f"{path}: ends at byte {cut[0]}, before it says what run it is of")
        raise AppError(
            f"{path}: an MCAP file, but no session of `uwb-slam`: its metadata {METADATA_NAME!r} "
            "is missing; of a bag in the layout of the paper's data set `uwb-slam convert` makes a "
            "session"
        )
    if not radars:
        raise AppError(f"{path}: ends before any radar is named; record the session again")
    return RecordedSession(path, read_session_table(path, head, tuple(radars)), size=size)


def _radar_info(path: Path, message: Message) -> RadarInfo:
    try:
        text = unpack_string(message.data)
    except (ValueError, TypeError, AssertionError, IndexError, struct.error) as error:
        raise AppError(f"{path}: {message.topic} cannot be read: {error!r}") from None
    return read_radar_text(path, message.topic, text)
