"""The durable record of a run: one MCAP file that ROS 2, Foxglove, PlotJuggler and Rerun open.

A chunk is closed and handed to the operating system after 256 KiB or one second, so a killed
process leaves everything but its last chunk. Times in the file are session time.
"""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable
from dataclasses import asdict
from io import BufferedWriter, FileIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from mcap.writer import CompressionType, Writer

from slam.app import ros_messages as ros
from slam.app.odometry import OdometryTrack
from slam.app.session import LogLine, Scan, SessionInfo, Snapshot
from slam.geometry import between, compose

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

_CHUNK_BYTES = 256 * 1024
_CHUNK_NS = 1_000_000_000
# MCAP's message record: opcode, length, channel, sequence, two times.
_RECORD_OVERHEAD_BYTES = 31

_ORIGIN = np.zeros(3)

LENGTH_UNIT = "module metres, c = 3.0e8 m/s"
"""Of a radar's range_start_m and bin_length_m in its info; its mount is in true metres."""

METADATA_NAME = "xethru-hil session"

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


class _NamedFile(FileIO):
    """Says its name when it cannot be written; all failures of the log pass here."""

    def write(self, data: ReadableBuffer, /) -> int:
        try:
            return super().write(data)
        except OSError as error:
            error.filename = self.name
            raise


class SessionLog:
    """Writes a session as it happens.

    Topics: `/radar/<name>/frame` with the frame counter in the record's sequence number and a
    latched `/radar/<name>/info` (JSON); `/odom`, `/truth`, `/estimate`, `/landmarks`, `/tf`,
    `/tf_static`, `/log`. A metadata record names scene, preset, seed and versions.
    """

    def __init__(
        self,
        path: Path,
        info: SessionInfo,
        odometry: OdometryTrack,
        *,
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._clock_ns = clock_ns
        self._stream = BufferedWriter(_NamedFile(path, "wb"))
        # Chunks are cut here, by size and by time; the writer itself knows size only.
        self._writer = Writer(
            self._stream, chunk_size=2 * _CHUNK_BYTES, compression=CompressionType.ZSTD
        )
        self._pending_bytes = 0
        self._chunk_started_ns = clock_ns()
        self._samples = iter(odometry.samples)
        self._odometry_ns = -1  # of the newest sample written
        self._schemas: dict[str, int] = {}
        self._frame_channels: list[int] = []
        try:
            self._begin(info)
        except BaseException:
            with contextlib.suppress(OSError):  # what is in its buffer cannot be written either
                self._stream.close()
            raise

    def _begin(self, info: SessionInfo) -> None:
        self._writer.start(profile="ros2", library="xethru-hil")
        self._writer.add_metadata(
            METADATA_NAME,
            {
                "scene": info.scene,
                "preset": info.preset,
                "seed": str(info.seed),
                "true_landmarks_m": json.dumps(info.true_landmarks_m.tolist()),
                "versions": json.dumps(dict(info.versions)),
            },
        )
        for radar in info.radars:
            self._frame_channels.append(
                self._channel(f"/radar/{radar.name}/frame", ros.FLOAT_ARRAY)
            )
            channel = self._channel(f"/radar/{radar.name}/info", ros.STRING, latched=True)
            facts = asdict(radar) | {"length_unit": LENGTH_UNIT}
            self._write(channel, 0, ros.string(json.dumps(facts)))
        self._odometry = self._channel("/odom", ros.ODOMETRY)
        self._truth = self._channel("/truth", ros.POSE)
        self._estimate = self._channel("/estimate", ros.POSE)
        self._landmarks = self._channel("/landmarks", ros.POINT_CLOUD)
        self._transforms = self._channel("/tf", ros.TRANSFORMS)
        self._static_transforms = self._channel("/tf_static", ros.TRANSFORMS, latched=True)
        self._log = self._channel("/log", ros.LOG)
        # The topic is latched with depth 1, so each message holds all that is static so far.
        self._placements = {
            ("base_link", f"radar_{radar.name}"): np.array([radar.x_m, radar.y_m, radar.yaw_rad])
            for radar in info.radars
        }
        self._write(self._static_transforms, 0, ros.transforms(0, self._placements))
        self._cut_chunk()

    def on_scan(self, scan: Scan) -> None:
        """Write the frames of one tick, and the odometry that their poses come from."""
        needed_ns = max(scan.t_ns, *(frame.t_ns for frame in scan.frames))
        while self._odometry_ns < needed_ns and (sample := next(self._samples, None)) is not None:
            self._write(self._odometry, sample.t_ns, ros.odometry(sample))
            self._odometry_ns = sample.t_ns
        for frame in scan.frames:
            self._write(
                self._frame_channels[frame.radar],
                frame.t_ns,
                ros.float_array(frame.samples),
                sequence=frame.counter,
            )

    def on_snapshot(self, snapshot: Snapshot) -> None:
        """Write a state of SLAM with its landmarks and transforms."""
        t_ns = snapshot.t_ns
        if ("world", "map") not in self._placements:
            self._placements["world", "map"] = snapshot.world_from_map
            self._write(self._static_transforms, t_ns, ros.transforms(t_ns, self._placements))
        self._write(self._truth, t_ns, ros.pose_stamped(t_ns, "world", snapshot.truth))
        self._write(self._estimate, t_ns, ros.pose_stamped(t_ns, "map", snapshot.estimate))
        self._write(self._landmarks, t_ns, ros.landmark_cloud(snapshot))
        links = {
            ("map", "odom"): compose(snapshot.estimate, between(snapshot.odometry, _ORIGIN)),
            ("odom", "base_link"): snapshot.odometry,
        }
        self._write(self._transforms, t_ns, ros.transforms(t_ns, links))

    def on_log(self, line: LogLine) -> None:
        """Write a line about the link."""
        message = ros.log_line(line.t_ns, line.radar, line.text, warning=line.warning)
        self._write(self._log, line.t_ns, message)

    def close(self) -> None:
        """Write index and footer, and close the file."""
        if self._stream.closed:
            return
        with self._stream:
            self._writer.finish()  # type: ignore[no-untyped-call]  # mcap annotates in part

    def _channel(self, topic: str, message_type: str, *, latched: bool = False) -> int:
        if message_type not in self._schemas:
            self._schemas[message_type] = self._writer.register_schema(
                message_type, "ros2msg", ros.schema_text(message_type)
            )
        metadata = {"offered_qos_profiles": _LATCHED_QOS} if latched else {}
        return self._writer.register_channel(topic, "cdr", self._schemas[message_type], metadata)

    def _write(self, channel: int, t_ns: int, message: ros.Message, *, sequence: int = 0) -> None:
        # The writer only concatenates, so the serialiser's memoryview needs no copy.
        data = ros.serialise(message)
        size = len(data) + _RECORD_OVERHEAD_BYTES
        late = self._clock_ns() - self._chunk_started_ns >= _CHUNK_NS
        if late or self._pending_bytes + size > _CHUNK_BYTES:
            self._cut_chunk()
        self._pending_bytes += size
        self._writer.add_message(
            channel_id=channel,
            log_time=t_ns,
            publish_time=t_ns,
            sequence=sequence,
            data=data,  # type: ignore[arg-type]  # annotated bytes, any buffer works
        )

    def _cut_chunk(self) -> None:
        # A private method: mcap's writer closes a chunk by size only and offers no public way to
        # close it by time. pyproject pins the minor version of mcap for this line; before that is
        # raised, see that the method is still there and still writes the pending chunk. The tests
        # of chunks cut by time and of files never finished fail if not.
        self._writer._Writer__finalize_chunk()  # type: ignore[attr-defined]  # see above
        self._stream.flush()
        self._pending_bytes = 0
        self._chunk_started_ns = self._clock_ns()
