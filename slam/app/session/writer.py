"""The durable record of a run: one MCAP file that ROS 2, Foxglove, PlotJuggler and Rerun open.

Times in the file are session time. The order of the file is the order in which the run learned of
things: what stands before a scan's mark was known when SLAM took that scan.

A chunk is closed and handed to the operating system after 256 KiB or one second, so a killed
process leaves a file without index that lacks its last chunk only.
"""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from slam.app.session.viewer_topics import Drawings, Topics, WheelMotion
from slam.geometry import between, compose
from slam.live.errors import AppError
from slam.live.odometry_track import OdometryTrack, TumSample, symmetric
from slam.live.session import cdr
from slam.live.session.description import (
    METADATA_NAME,
    SESSION_TOPIC,
    radar_text,
    session_table,
)
from slam.live.session.state_rows import smoothed_row, state_row, step_row
from slam.live.session_records import (
    LogLine,
    RadarImage,
    Scan,
    SessionInfo,
    SessionObserver,
    Snapshot,
    TruthAt,
)
from slam.results import SmoothedRun
from xethru_protocol.recordings.mcap import (
    BYTE_ARRAY,
    CHUNK_BYTES,
    DOUBLE_ARRAY,
    FLOAT_ARRAY,
    STRING,
    McapWriter,
    pack_array,
    pack_string,
)
from xethru_protocol.recordings.recorded_messages import PieceFile, RecordingError

_ORIGIN = np.zeros(3)
_CHUNK_NS = 1_000_000_000
# MCAP's message record: opcode, length, channel, sequence, two times.
_RECORD_OVERHEAD_BYTES = 31

_TOPICS = {
    "/scan": DOUBLE_ARRAY,
    "/scan_unused": DOUBLE_ARRAY,
    "/slam/step": DOUBLE_ARRAY,
    "/slam/state": DOUBLE_ARRAY,
    "/odom": cdr.ODOMETRY,
    "/truth": cdr.POSE,
    "/estimate": cdr.POSE,
    "/landmarks": cdr.POINT_CLOUD,
    "/tf": cdr.TRANSFORMS,
    "/tf_static": cdr.TRANSFORMS,
    "/log": cdr.LOG,
}
"""Those of every session, besides those of its radars."""

_LATCHED_QOS = """\
- history: 1
  depth: 1
  reliability: 1
  durability: 1
  deadline: {sec: 9223372036, nsec: 854775807}
  lifespan: {sec: 9223372036, nsec: 854775807}
  liveliness: 1
  liveliness_lease_duration: {sec: 9223372036, nsec: 854775807}
  avoid_ros_namespace_conventions: false
"""


class CannotWriteError(AppError):
    """The file cannot be written any further; the message describes what is kept."""


class _SessionFile(Topics):
    """An MCAP file of ROS 2 messages, in chunks that are cut by size and by time.

    If the disk refuses a chunk, the file is closed after the last whole one and CannotWriteError is
    raised; whatever is written from then on is discarded.
    """

    def __init__(self, path: Path, start_ns: int, clock_ns: Callable[[], int]) -> None:
        self.path = path
        self._start_ns = start_ns
        self._clock_ns = clock_ns
        self._gave_up = False
        try:
            self._disk = PieceFile(path, replace=True)
        except RecordingError as error:
            raise CannotWriteError(str(error)) from None
        # Chunks are cut here, by size and by time; the writer itself knows size only.
        self._writer = McapWriter(self._disk, chunk_bytes=2 * CHUNK_BYTES)
        self._channels: dict[str, int] = {}
        self._pending_bytes = 0
        self._newest_ns = self._whole_ns = start_ns
        self._chunk_started_ns = clock_ns()

    def add_metadata(self, name: str, table: Mapping[str, str]) -> None:
        self._writer.add_metadata(name, dict(table))

    def add_topic(self, topic: str, message_type: str, *, latched: bool = False) -> None:
        """Make a channel, if the topic has none yet; a latched one keeps its last message."""
        if self._gave_up or topic in self._channels:
            return
        metadata = {"offered_qos_profiles": _LATCHED_QOS} if latched else {}
        self._channels[topic] = self._writer.add_channel(
            topic, message_type, cdr.schema_text(message_type), metadata
        )

    def write(
        self,
        topic: str,
        t_ns: int,
        data: bytes,
        *,
        sequence: int = 0,
        publish_ns: int | None = None,
    ) -> None:
        """Write a message in CDR at a session time [ns]; ``publish_ns`` is the same if None."""
        if self._gave_up:
            return
        size = len(data) + _RECORD_OVERHEAD_BYTES
        late = self._clock_ns() - self._chunk_started_ns >= _CHUNK_NS
        is_head = not self._writer.has_copies  # which is one chunk, however slow the machine is
        if not is_head and (late or self._pending_bytes + size > CHUNK_BYTES):
            self.cut_chunk()
        self._pending_bytes += size
        self._newest_ns = max(self._newest_ns, t_ns)
        self._writer.add_message(
            channel_id=self._channels[topic],
            log_time=t_ns,
            publish_time=t_ns if publish_ns is None else publish_ns,
            sequence=sequence,
            data=data,
        )

    def cut_chunk(self) -> None:
        if self._gave_up:
            return
        with self._giving_up():
            self._writer.end_chunk()
            self._disk.hand_over()
        self._whole_ns = self._newest_ns
        self._pending_bytes = 0
        self._chunk_started_ns = self._clock_ns()

    def end_head(self) -> None:
        """End the chunk that describes the run, and have it repeated, for the first time here."""
        self.cut_chunk()
        self._writer.has_copies = True
        with self._giving_up():
            self._writer.write_copy()
            self._disk.hand_over()

    def close(self) -> None:
        """Write index and footer, and close the file; doing so again does nothing."""
        if self._disk.closed:
            return
        self.cut_chunk()
        with self._giving_up():
            self._writer.finish()
            self._disk.hand_over()
            self._disk.close()

    @contextlib.contextmanager
    def _giving_up(self) -> Iterator[None]:
        try:
            yield
        except RecordingError as error:
            self._gave_up = True
            self._disk.close()
            kept = (
                f"its first {(self._whole_ns - self._start_ns) / 1e9:.1f} s are kept there "
                f"without an index: make room, then `uwb-slam repair {self.path}`"
                if self._whole_ns > self._start_ns
                else "nothing was recorded: make room"
            )
            raise CannotWriteError(f"{error}; {kept}") from None


class SessionLog(SessionObserver):
    """Writes a session as it happens, into a file or into other topics.

    docs/sessions.md has the topics. A frame's counter is the record's sequence number;
    `/radar/<name>/stream` precedes the first frame of every stream but number 0, and `/scan` or
    `/scan_unused` follow the frames of a scan.

    Parameters
    ----------
    place
        The file, replaced if it exists; or other topics that take the messages, as a server's.
    odometry
        The whole track where it is known before the run; None where `on_odometry` brings it.
    truth_at
        The robot's true pose; None if unknown.
    start_ns
        Session time of the first scan [ns], that of everything that has no time or an earlier one:
        of latched messages and of lines about setting up.
    drawn
        Whether to write `viewer_topics` for other programs, too.
    clock_ns
        Monotonic time [ns]; ends chunks.

    Raises
    ------
    CannotWriteError
        Here and in every other method: the disk is full or fails.
    """

    def __init__(
        self,
        place: Path | Topics,
        info: SessionInfo,
        odometry: OdometryTrack | None = None,
        *,
        truth_at: TruthAt | None = None,
        start_ns: int = 0,
        drawn: bool = True,
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._file: Topics = (
            _SessionFile(place, start_ns, clock_ns) if isinstance(place, Path) else place
        )
        self._start_ns = start_ns
        self._samples: Iterator[TumSample] = iter(odometry or ())
        self._odometry_ns = -1  # of the newest sample written
        self._odom_frame = _ORIGIN  # `Scan.odom_frame` of the newest one that SLAM took
        self._truth_at = truth_at
        self._t_ns = start_ns
        self._names = [radar.name for radar in info.radars]
        self._streams = [0] * len(self._names)
        table = session_table(info)
        self._file.add_metadata(METADATA_NAME, table)
        # The same with a checksum, and repeated; metadata have neither, but other programs show it.
        self._file.add_topic(SESSION_TOPIC, STRING, latched=True)
        self._file.write(SESSION_TOPIC, start_ns, pack_string(json.dumps(table)))
        for radar in info.radars:
            self._file.add_topic(f"/radar/{radar.name}/frame", FLOAT_ARRAY)
            self._file.add_topic(f"/radar/{radar.name}/info", STRING, latched=True)
            text = pack_string(radar_text(radar))
            self._file.write(f"/radar/{radar.name}/info", start_ns, text)
        for topic, message_type in _TOPICS.items():
            self._file.add_topic(topic, message_type, latched=topic == "/tf_static")
        # The topic is latched with depth 1, so each message holds all that is static so far.
        self._placements = {
            ("base_link", f"radar_{radar.name}"): np.array([radar.x_m, radar.y_m, radar.yaw_rad])
            for radar in info.radars
        }
        self._file.write("/tf_static", start_ns, cdr.transforms(start_ns, self._placements))
        self._wheels = WheelMotion(info.wheels)
        self._has_covariance = info.odometry_covariance
        self._drawings = Drawings(self._file, info, start_ns) if drawn else None
        self._file.end_head()

    def on_scan(self, scan: Scan) -> None:
        """Write the frames of one tick, and the odometry that their poses come from."""
        self._t_ns = scan.t_ns
        if scan.used:
            self._odom_frame = scan.odom_frame
        needed_ns = max([scan.t_ns, *(frame.t_ns for frame in scan.frames)])
        while self._odometry_ns < needed_ns and (sample := next(self._samples, None)) is not None:
            self.on_odometry(sample)
        arrivals = scan.host_ns or (None,) * len(scan.frames)
        for frame, host_ns in zip(scan.frames, arrivals, strict=True):
            if frame.stream != self._streams[frame.radar]:
                self._streams[frame.radar] = frame.stream
                number = cdr.number(frame.stream)
                self._write_rare(frame.radar, "stream", cdr.NUMBER, frame.t_ns, number)
            self._file.write(
                f"/radar/{self._names[frame.radar]}/frame",
                frame.t_ns,
                pack_array(FLOAT_ARRAY, frame.samples),
                sequence=frame.counter,
                publish_ns=host_ns,
            )
        truth = np.zeros(0) if self._truth_at is None else self._truth_at(np.array([scan.t_ns]))[0]
        known = truth if np.all(np.isfinite(truth)) else np.zeros(0)
        # which frames they are, so that a reader of a damaged file knows what is missing
        members = [number for frame in scan.frames for number in (frame.radar, frame.counter)]
        row = np.array([len(scan.frames), *members, *known], dtype=np.float64)
        mark = pack_array(DOUBLE_ARRAY, row, "n_frames_radars_counters_truth")
        topic = "/scan" if scan.used else "/scan_unused"
        self._file.write(topic, scan.t_ns, mark, sequence=scan.counter)
        if self._drawings is not None:
            self._drawings.on_scan(scan)

    def on_detections(self, radar: int, t_ns: int, ranges_m: NDArray[np.float64]) -> None:
        """Write ranges of the scan that comes next, shape (n,) [m], of a radar by its index."""
        message = pack_array(DOUBLE_ARRAY, ranges_m, "range_m")
        self._write_rare(radar, "detections", DOUBLE_ARRAY, t_ns, message)

    def on_odometry(self, sample: TumSample) -> None:
        t_ns, pose = sample.t_ns, np.array([sample.x_m, sample.y_m, sample.heading_rad])
        twist = self._wheels.twist(t_ns, pose)
        if self._has_covariance:
            twist = replace(twist, covariance=symmetric(sample.velocity_covariance))
        self._file.write("/odom", t_ns, cdr.wheel_odometry(sample, twist))
        self._odometry_ns = t_ns

    def on_snapshot(self, snapshot: Snapshot) -> None:
        """Write a state of SLAM with its landmarks and transforms."""
        t_ns = snapshot.t_ns
        if ("world", "map") not in self._placements:
            self._placements["world", "map"] = snapshot.world_from_map
            self._file.write("/tf_static", t_ns, cdr.transforms(t_ns, self._placements))
        if np.all(np.isfinite(snapshot.truth)):
            self._file.write("/truth", t_ns, cdr.pose_stamped(t_ns, "world", snapshot.truth))
        self._file.write("/estimate", t_ns, cdr.pose_stamped(t_ns, "map", snapshot.estimate))
        self._file.write("/landmarks", t_ns, cdr.landmark_cloud(t_ns, snapshot))
        odometry = snapshot.odometry
        if self._odom_frame.any():
            odometry = between(self._odom_frame, odometry)
        links = {
            ("map", "odom"): compose(snapshot.estimate, between(odometry, _ORIGIN)),
            ("odom", "base_link"): odometry,
        }
        self._file.write("/tf", t_ns, cdr.transforms(t_ns, links))
        if snapshot.step is not None:  # before its state, which a reader waits for
            step = step_row(snapshot.step, snapshot.wall_spans_m)
            message = pack_array(DOUBLE_ARRAY, step, "step")
            self._file.write("/slam/step", t_ns, message, sequence=snapshot.counter)
        state = pack_array(DOUBLE_ARRAY, state_row(snapshot), "state")
        self._file.write("/slam/state", t_ns, state, sequence=snapshot.counter)
        if self._drawings is not None:
            self._drawings.on_snapshot(snapshot)

    def on_smoothed(self, smoothed: SmoothedRun) -> None:
        self._file.add_topic("/slam/smoothed", DOUBLE_ARRAY)
        message = pack_array(DOUBLE_ARRAY, smoothed_row(smoothed), "smoothed")
        self._file.write("/slam/smoothed", int(smoothed.t_ns[-1]), message)
        if self._drawings is not None:
            self._drawings.on_smoothed(smoothed)

    def on_image(self, image: RadarImage) -> None:
        self._file.add_topic("/image", cdr.OCCUPANCY_GRID)
        self._file.write("/image", image.t_ns, cdr.occupancy_grid(image))

    def on_log(self, line: LogLine) -> None:
        t_ns = max(line.t_ns, self._start_ns)
        self._file.write("/log", t_ns, cdr.log_line(t_ns, line))

    def on_wire(self, radar: str, way: Literal["rx", "tx"], data: bytes, host_ns: int) -> None:
        """Write bytes as a radar's port gave (rx) or took (tx) them, at a host time [ns].

        Their time in the file is that of the newest scan; `host_ns` is their publish time.
        """
        if not data:
            return
        message = pack_array(BYTE_ARRAY, np.frombuffer(data, np.uint8))
        topic = f"/radar/{radar}/{way}"
        self._file.add_topic(topic, BYTE_ARRAY)
        self._file.write(topic, self._t_ns, message, publish_ns=host_ns)

    def _write_rare(self, radar: int, part: str, message_type: str, t_ns: int, data: bytes) -> None:
        """Write to a topic that few sessions have; its channel is made when it is first needed."""
        topic = f"/radar/{self._names[radar]}/{part}"
        self._file.add_topic(topic, message_type)
        self._file.write(topic, t_ns, data)

    def close(self) -> None:
        drawings, self._drawings = self._drawings, None
        try:
            if drawings is not None:
                drawings.close()
        finally:
            self._file.close()
