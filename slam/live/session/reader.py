"""A recorded session read back: what `SessionLog` wrote, in the order it was written.

Frames (true metres, own stamps), odometry, states and log lines have the same floats that the run
saw. Only one chunk of the file is in memory.
"""

from __future__ import annotations

import json
import math
import os
import re
import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import BinaryIO, Literal, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from slam.config import ConfigError, SlamConfig, WheelNoise, with_added_keys, without_removed_keys
from slam.frames import Detection, RadarFrame
from slam.geometry import Rig
from slam.live.errors import AppError, OdometryError, refuse_pipe
from slam.live.frame_sources import less_gain, recorded_frame, sampler_limits
from slam.live.odometry_track import OdometryTrack, TumSample
from slam.live.session import cdr
from slam.live.session.description import (
    GAP_TOPIC,
    METADATA_NAME,
    SESSION_TOPIC,
    check_format,
    read_radar_text,
    read_session_table,
)
from slam.live.session.lost_messages import read_gap
from slam.live.session.state_rows import smoothed_of, snapshot_of, with_step
from slam.live.session_records import (
    Gap,
    LogLine,
    RadarImage,
    RadarInfo,
    Scan,
    SessionInfo,
    Snapshot,
)
from slam.results import NoiseAt, SmoothedRun
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.operating_system import StopFlag
from xethru_protocol.recordings.formats import recording_format
from xethru_protocol.recordings.mcap import (
    BYTE_ARRAY,
    DOUBLE_ARRAY,
    FLOAT_ARRAY,
    MAGIC,
    Channel,
    Cut,
    Damage,
    McapMessage,
    Metadata,
    end_time_of,
    unpack_array,
    unpack_string,
)
from xethru_protocol.recordings.mcap import read_entries as entries_of
from xethru_protocol.recordings.recorded_messages import (
    MAT_MAGIC,
    RERUN_MAGIC,
    ZIP_MAGIC,
    RecordingError,
    is_like,
)
from xethru_protocol.validation import problem_text, reason_of

_KINDS = {
    RERUN_MAGIC: "a Rerun recording (.rrd), a view that other versions of Rerun may not open; the "
    "record of the run is the session.mcap beside it",
    b"#ROSBAG V2": "a bag of ROS 1; `uwb-slam convert` makes a session of it",
    b"#ROSBAG": "a bag of ROS 1 of an old version; `rosbag migrate` it first",
    b"SQLite format 3\0": "an SQLite file, like those in a rosbag2 folder; give that folder to "
    "`uwb-slam convert`",
    MAT_MAGIC: "a MATLAB file; `uwb-slam convert` reads detections from it",
    b"\x89HDF": "an HDF5 file",
    ZIP_MAGIC: "a zip archive, or arrays of numpy; `xethru view` shows arrays",
    b"\x1f\x8b": "a gzip file; unpack it first",
    b"\x28\xb5\x2f\xfd": "a zstd file; unpack it first",
}


_OF_A_MODULE = "a recording of one module; `xethru view` shows it, `xethru dump` prints it"


def describe_kind(path: Path) -> str:
    r"""Return ``, it is ...`` for a file that is known by its first bytes, or what to give instead.

    >>> from tempfile import NamedTemporaryFile
    >>> with NamedTemporaryFile() as file:
    ...     _ = file.write(b"#ROSBAG V2.0\n")
    ...     file.flush()
    ...     describe_kind(Path(file.name))
    ', it is a bag of ROS 1; `uwb-slam convert` makes a session of it'
    """
    if path.is_dir():
        if (path / "metadata.yaml").exists():
            return " with a rosbag2 in it; `uwb-slam convert` makes a session of it"
        is_recording = any(path.glob("xethru_*"))
        return f" with {_OF_A_MODULE}" if is_recording else " without a session.mcap in it"
    with path.open("rb") as stream:
        head = stream.read(32)
    if not head:
        return ", it is empty; whatever was to write it ended before it did"
    with suppress(RecordingError, OSError):
        if recording_format(path) in {"vendor", "wire"}:
            return f", it is {_OF_A_MODULE}"
    for magic, kind in _KINDS.items():
        if head.startswith(magic):
            return f", it is {kind}"
    return "; give the session.mcap of a run"


@contextmanager
def open_mcap(path: Path, size: int | None = None) -> Iterator[tuple[BinaryIO, int]]:
    """Open a file whose first bytes are those of MCAP; yield it and how much of it to read [bytes].

    That is `size`, if given, of a file that grows.

    Raises
    ------
    AppError
        Missing, unreadable or not MCAP; the message names the kind of file if it is known.
    """
    with ExitStack() as stack:
        try:
            refuse_pipe(path)
            stream = stack.enter_context(path.open("rb"))
            if not is_like(stream.read(len(MAGIC)), MAGIC):
                raise AppError(f"{path}: is not an MCAP file{describe_kind(path)}")
            whole = os.fstat(stream.fileno()).st_size
        except IsADirectoryError:
            raise AppError(
                f"{path}: is a directory{describe_kind(path)}; give the session.mcap of a run, or "
                "the run's folder"
            ) from None
        except OSError as error:
            raise _unreadable(path, error) from None
        yield stream, whole if size is None else min(size, whole)


def read_entries(
    path: Path, size: int | None = None, channels: dict[int, Channel] | None = None
) -> Iterator[Metadata | McapMessage | Cut]:
    """Yield metadata and messages in the order of the file, holding one chunk in memory.

    The last entry is a `Cut` if the file ends too early. `size` is how many bytes to read, so that
    a file that grows reads the same again; None: all. `channels` by their numbers are known
    already, as where the chunk that names them is damaged. Damage before a copy of the head that
    no other message precedes loses nothing.

    Raises
    ------
    AppError
        Missing, unreadable, not MCAP, or damaged other than by being cut.
    """
    damage: Damage | None = None
    for found in _found_in(path, size, channels):
        if isinstance(found, Damage):
            damage = damage or found
            continue
        if damage is not None and _is_first_copy(found):
            damage = None
        if damage is not None and not isinstance(found, Metadata):
            break
        yield found
    if damage is not None:
        raise AppError(
            f"{path}: damaged at byte {damage.at}: {damage.reason}; "
            f"`uwb-slam repair {path}` keeps what is whole"
        )


def _is_first_copy(found: Metadata | McapMessage | Cut) -> bool:
    return isinstance(found, McapMessage) and (found.topic, found.sequence) == (SESSION_TOPIC, 0)


def _found_in(
    path: Path, size: int | None, channels: dict[int, Channel] | None
) -> Iterator[Metadata | McapMessage | Cut | Damage]:
    with open_mcap(path, size) as (stream, n_bytes):
        try:
            for found in entries_of(stream, n_bytes, channels):
                if not isinstance(found, Channel):
                    yield found
        except OSError as error:
            raise _unreadable(path, error) from None


def begins_with(path: Path, magic: bytes) -> bool:
    """Return whether a regular file begins so, whatever its name; AppError if it is unreadable."""
    try:
        if not path.is_file():  # a pipe would be waited for
            return False
        with path.open("rb") as stream:
            return stream.read(len(magic)) == magic
    except OSError as error:
        raise _unreadable(path, error) from None


def _unreadable(path: Path, error: OSError) -> AppError:
    return AppError(f"{path}: cannot read: {error.strerror or error}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScanEnd:
    """The frames before it made a scan; see `Scan`.

    `members` are their radars and counters, so that a scan is known to be whole.
    `truth` has shape (3,), [x m, y m, heading rad], world frame; None if unknown.
    """

    counter: int
    t_ns: int
    used: bool
    members: tuple[tuple[int, int], ...]
    truth: NDArray[np.float64] | None


SessionRecord: TypeAlias = (
    RadarFrame | TumSample | LogLine | ScanEnd | Snapshot | SmoothedRun | RadarImage | Gap
)
"""What `RecordedSession.records` yields; a TumSample is odometry."""


def _limits_of(radar: RadarInfo) -> tuple[float, float] | None:
    """Return the sampler's limits where the recorded settings are those of this driver."""
    known = {field.name for field in fields(RawConfig)}
    if set(radar.settings) != known:
        return None
    return sampler_limits(RawConfig(**dict(radar.settings)))  # type: ignore[arg-type]  # from JSON


def _scan_end(message: McapMessage) -> ScanEnd:
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


def _state(message: McapMessage, step: McapMessage | None) -> Snapshot:
    row = unpack_array(DOUBLE_ARRAY, message.data)
    state = snapshot_of(message.sequence, message.t_ns, row)
    if step is None or step.t_ns != state.t_ns:  # none was recorded, or damage took it
        return state
    return with_step(state, unpack_array(DOUBLE_ARRAY, step.data))


_READERS: Mapping[str, Callable[[McapMessage], SessionRecord]] = {
    GAP_TOPIC: lambda one: read_gap(unpack_string(one.data)),
    "/scan": _scan_end,
    "/scan_unused": _scan_end,
    "/log": lambda one: cdr.read_log_line(one.t_ns, one.data),
    "/image": lambda one: cdr.read_occupancy_grid(one.t_ns, one.data),
    "/slam/smoothed": lambda one: smoothed_of(one.t_ns, unpack_array(DOUBLE_ARRAY, one.data)),
}

_TopicPart: TypeAlias = Literal["frame", "stream", "detections", "rx", "tx", ""]
"""The last word of a radar's topic."""


class RecordedSession:
    """One session file; iterating yields the scans that SLAM was stepped with, with odometry.

    Attributes
    ----------
    cut_at_byte
        Where the file ends too early, after `records` has come to its end; None where it is whole.
    end_ns
        Session time of the newest message by the file's own index; None for a file without one,
        as a run leaves it that was killed.
    """

    def __init__(
        self,
        path: Path,
        info: SessionInfo,
        *,
        size: int | None = None,
        end_ns: int | None = None,
        channels: Mapping[int, Channel] | None = None,
        stop: StopFlag | None = None,
    ) -> None:
        self.path = path
        self._stop = stop or StopFlag()
        self._channels = dict(channels or {})
        self._size = size  # when it was opened: a run may be writing it still
        self.info = info
        self.end_ns = end_ns
        self.cut_at_byte: int | None = None
        parts: tuple[_TopicPart, ...] = ("frame", "stream", "detections", "rx", "tx")
        self._of_radars = {
            f"/radar/{radar.name}/{part}": (index, part)
            for index, radar in enumerate(info.radars)
            for part in parts
        }

    @property
    def rig(self) -> Rig:
        """Return the mounts that SLAM used."""
        return Rig(mounts=tuple(radar.mount for radar in self.info.radars))

    @property
    def config(self) -> SlamConfig:
        """Return the settings that SLAM had; AppError if they cannot be read.

        `Slam` with these, `rig`, `wheels` and `odometry_noise` makes the recorded states again.
        """
        self._need(self.info.config_json)
        try:
            tables = json.loads(self.info.config_json)
            if isinstance(tables, dict):
                tables = with_added_keys(without_removed_keys(tables, str(self.path)))
            return SlamConfig.model_validate(tables)
        except json.JSONDecodeError as error:
            raise AppError(f"{self.path}: its settings cannot be read: {error}") from None
        except ConfigError as error:
            raise AppError(str(error)) from None
        except ValidationError as error:
            text = problem_text(error.errors(), SlamConfig)
            raise AppError(
                f"{self.path}: its settings are not those of this version: {text}; "
                f"it was recorded with xethru-hil {self.info.versions.get('xethru-hil', '?')}"
            ) from None

    @property
    def wheels(self) -> WheelNoise:
        """Return the wheel errors that SLAM assumed; AppError if they are unknown here."""
        self._need(self.info.wheels)
        try:
            return WheelNoise(**self.info.wheels)
        except TypeError:
            text = "its description of the wheels is unknown here"
            raise AppError(f"{self.path}: {text}") from None

    def _need(self, part: object) -> None:
        if not part:
            raise AppError(
                f"{self.path}: does not hold SLAM's settings; "
                "its frames can be read, but not be replayed; record it again"
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Do nothing: every reading opens the file and closes it."""

    def __iter__(self) -> Iterator[Scan]:
        """Yield the scans that SLAM was stepped with, their frames without the radars' gains.

        AppError if ranges were recorded and no frames, or the file is damaged.
        """
        if self.info.has_detections:
            raise AppError(f"{self.path}: holds ranges in place of frames: see `detections`")
        gains_db, odometry = [radar.gain_db for radar in self.info.radars], self.odometry()
        for scan in self.scans():
            if scan.used:
                frames = tuple(less_gain(frame, gains_db[frame.radar]) for frame in scan.frames)
                yield replace(scan, frames=frames, odometry=odometry.pose_at)

    def records(self) -> Iterator[SessionRecord]:
        """Yield what was recorded, in the order of the file; may be called again.

        Raises
        ------
        AppError
            The file is damaged other than by being cut at its end.
        """
        for _, record in self._records():
            yield record

    def scans(self) -> Iterator[Scan]:
        """Yield every scan but those that damage or the end of a cut file left incomplete."""
        return (record for record in self.played() if isinstance(record, Scan))

    def played(
        self,
    ) -> Iterator[Scan | TumSample | LogLine | Snapshot | SmoothedRun | RadarImage | Gap]:
        """Yield what `records` does, with the frames put together into scans as in `scans`."""
        held: list[tuple[RadarFrame, int]] = []
        for message, record in self._records():
            if isinstance(record, RadarFrame):
                held.append((record, message.publish_ns))
            elif isinstance(record, ScanEnd):
                # frames before them are of a scan whose mark is lost
                held = held[max(len(held) - len(record.members), 0) :]
                frames = tuple(frame for frame, _ in held)
                # the same as the stamp, if it was not recorded when the frame arrived
                arrivals = tuple(host_ns for frame, host_ns in held if host_ns != frame.t_ns)
                held = []
                if tuple((frame.radar, frame.counter) for frame in frames) == record.members:
                    yield Scan(
                        counter=record.counter,
                        t_ns=record.t_ns,
                        frames=frames,
                        host_ns=arrivals if len(arrivals) == len(frames) else (),
                        used=record.used,
                        truth=record.truth,
                    )
            else:
                yield record

    def frames(self) -> Iterator[RadarFrame]:
        """Yield every frame without its radar's gain, used or not, and read nothing else."""
        for radar, part, entry in self._messages():
            if part == "frame":
                info = self.info.radars[radar]
                with _naming(self.path, entry):
                    samples = unpack_array(FLOAT_ARRAY, entry.data)
                    frame = recorded_frame(
                        radar, info, samples, t_ns=entry.t_ns, counter=entry.sequence
                    )
                yield less_gain(frame, info.gain_db)

    def detections(self) -> dict[int, tuple[Detection, ...]]:
        """Return the recorded ranges by the time of their scan [ns]; amplitudes are unknown."""
        of_scan: dict[int, tuple[Detection, ...]] = {}
        held: list[Detection] = []
        for radar, part, entry in self._messages():
            if part == "detections":
                with _naming(self.path, entry):
                    held += [
                        Detection(radar=radar, t_ns=entry.t_ns, range_m=range_m, amplitude=math.nan)
                        for range_m in unpack_array(DOUBLE_ARRAY, entry.data).tolist()
                    ]
            elif entry.topic == "/scan":
                of_scan[entry.t_ns] = tuple(one for one in held if one.t_ns == entry.t_ns)
                held = []
        return of_scan

    def wire(self) -> Iterator[tuple[str, Literal["rx", "tx"], bytes, int]]:
        """Yield the raw bytes of all ports in the order of the file.

        Each with the radar's name, the way, and the time by the driver's clock [ns]; nothing if
        none were recorded.
        """
        for radar, part, entry in self._messages():
            if part in ("rx", "tx"):
                with _naming(self.path, entry):
                    data = unpack_array(BYTE_ARRAY, entry.data).tobytes()
                yield self.info.radars[radar].name, part, data, entry.publish_ns

    @property
    def odometry_noise(self) -> NoiseAt | None:
        """Return the noise of odometry by time, where SLAM took it from its covariances."""
        return self.odometry().noise_at if self.info.odometry_covariance else None

    def odometry(self) -> OdometryTrack:
        samples = [record for record in self.records() if isinstance(record, TumSample)]
        try:
            return OdometryTrack(samples)
        except OdometryError as error:
            raise AppError(f"{self.path}: {error}") from None

    def _records(self) -> Iterator[tuple[McapMessage, SessionRecord]]:
        """Yield the messages that do not repeat others, each with its content."""
        limits = list(map(_limits_of, self.info.radars))
        streams = [0] * len(self.info.radars)
        step: McapMessage | None = None
        for radar, part, entry in self._messages():
            record: SessionRecord | None = None
            with _naming(self.path, entry):
                if part == "frame":
                    record = recorded_frame(
                        radar,
                        self.info.radars[radar],
                        unpack_array(FLOAT_ARRAY, entry.data),
                        t_ns=entry.t_ns,
                        counter=entry.sequence,
                        limits=limits[radar],
                        stream=streams[radar],
                    )
                elif part == "stream":
                    streams[radar] = int(cdr.deserialise(entry.data, cdr.NUMBER).data)
                elif entry.topic == "/slam/step":
                    step = entry
                elif entry.topic == "/slam/state":
                    record = _state(entry, step)
                elif entry.topic == "/odom":
                    message = cdr.deserialise(entry.data, cdr.ODOMETRY)
                    with_covariance = self.info.odometry_covariance
                    record = cdr.pose_sample(message, with_covariance=with_covariance)
                elif entry.topic in _READERS:
                    record = _READERS[entry.topic](entry)
            if record is not None:
                yield entry, record

    def _messages(self) -> Iterator[tuple[int, _TopicPart, McapMessage]]:
        """Yield the messages; of a radar's topic with its index and what the topic holds."""
        entries = read_entries(self.path, self._size, dict(self._channels))
        for entry in self._stop.each(entries):
            if isinstance(entry, McapMessage):
                yield *self._of_radars.get(entry.topic, (-1, "")), entry
            elif isinstance(entry, Cut):
                self.cut_at_byte = entry.at


@contextmanager
def _naming(path: Path, message: McapMessage) -> Iterator[None]:
    try:
        yield
    except (
        ValueError,
        TypeError,
        AssertionError,
        IndexError,
        KeyError,
        OverflowError,
        struct.error,
    ) as error:
        raise AppError(
            f"{path}: a message of {message.topic} at "
            f"{message.t_ns / 1e9:.3f} s cannot be read: {reason_of(error)}"
        ) from None


@dataclass(slots=True, kw_only=True)
class _Head:
    """What describes a session, as far as it has been read.

    `table` is that of a message, whose chunk has a checksum, or else that of the metadata.
    """

    table: dict[str, str] | None = None
    has_message: bool = False
    radars: dict[str, RadarInfo] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    cut: Cut | None = None
    is_damaged: bool = False

    def names(self) -> list[str]:
        """Return the radars in their order; of an old session those that are described."""
        if self.table is not None and "radars" in self.table:
            return [str(name) for name in json.loads(self.table["radars"])]
        return list(self.radars)

    def is_whole(self) -> bool:
        return self.has_message and set(self.names()) <= set(self.radars)

    def take(self, path: Path, found: Metadata | McapMessage) -> bool:
        """Whether it is part of a head."""
        if isinstance(found, Metadata):
            if found.name == METADATA_NAME and self.table is None:
                self.table = found.metadata
        elif found.topic == SESSION_TOPIC:
            self.table, self.has_message = _session_table(path, found), True
        elif name := RADAR_INFO.fullmatch(found.topic):
            self.radars[name[1]] = _radar_info(path, found)
        else:
            return False
        return True


RADAR_INFO = re.compile(r"/radar/(.+)/info")


def open_session(path: str | Path, stop: StopFlag | None = None) -> RecordedSession:
    """Read what describes a session: at its head, or where that is damaged in a later copy.

    A signal that ``stop`` catches ends reading at once, here and later.

    Raises
    ------
    AppError
        Missing, foreign, cut before the radars are named, or damaged beyond all copies.
    """
    path = Path(path)
    try:
        size = path.stat().st_size
    except OSError:
        size = None  # reading it reports what is wrong
    stop = stop or StopFlag()
    head = _read_head(path, size, stop)
    if head.table is None:
        if head.cut is not None:
            raise AppError(f"{path}: ends at byte {head.cut.at}, before it says what run it is of")
        raise AppError(
            f'{path}: an MCAP file, but no session of `uwb-slam`: its metadata "{METADATA_NAME}" '
            "is missing; of a bag in the layout of the paper's data set `uwb-slam convert` makes a "
            "session, a recording of one module `xethru view` shows"
        )
    check_format(path, head.table)
    names = head.names()
    if not names or not head.radars:
        raise AppError(f"{path}: ends before any radar is named; record the session again")
    if missing := [name for name in names if name not in head.radars]:
        raise AppError(f"{path}: the description of radar {missing[0]} is lost")
    info = read_session_table(path, head.table, tuple(head.radars[name] for name in names))
    with open_mcap(path, size) as opened:
        end_ns = end_time_of(*opened)
    return RecordedSession(path, info, size=size, end_ns=end_ns, channels=head.channels, stop=stop)


def _read_head(path: Path, size: int | None, stop: StopFlag) -> _Head:
    head = _Head()
    for found in stop.each(_found_in(path, size, head.channels)):
        if isinstance(found, Cut):
            head.cut = found
        elif isinstance(found, Damage):
            head.is_damaged = True
        elif not head.take(path, found) and (head.is_whole() or not head.is_damaged):
            break  # the head comes before everything else
    return head


def _session_table(path: Path, message: McapMessage) -> dict[str, str]:
    with _naming(path, message):
        table = json.loads(unpack_string(message.data))
        if not isinstance(table, dict):
            raise ValueError("it is not a table")
        return {str(key): str(value) for key, value in table.items()}


def _radar_info(path: Path, message: McapMessage) -> RadarInfo:
    with _naming(path, message):
        text = unpack_string(message.data)
    return read_radar_text(path, message.topic, text)
