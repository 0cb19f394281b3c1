"""What other programs draw of a session: B-scans, paths, ellipses, walls, beams, ranges.

Nothing here is read back: it is made of what the session holds anyway, for programs that draw
neither float arrays nor covariances. docs/sessions.md has the topics.
"""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from slam.app.rig.echo_arcs import envelope_db, wedge
from slam.config import WheelNoise
from slam.frames import RadarFrame
from slam.geometry import between, compose
from slam.live.odometry_track import NS_PER_S
from slam.live.session import cdr
from slam.live.session.cdr import Marker, Shape
from slam.live.session_records import RadarInfo, Scan, SessionInfo, Snapshot
from slam.results import SmoothedRun
from xethru_protocol.recordings.mcap import STRING, pack_string
from xethru_protocol.wire.x4 import TRUE_PER_MODULE_METRE

Array = NDArray[np.float64]


class Topics(Protocol):
    """Takes messages in CDR; see `SessionLog`."""

    def add_topic(self, topic: str, message_type: str, *, latched: bool = False) -> None: ...

    def write(
        self,
        topic: str,
        t_ns: int,
        data: bytes,
        *,
        sequence: int = 0,
        publish_ns: int | None = None,
    ) -> None: ...

    def add_metadata(self, name: str, table: Mapping[str, str]) -> None:
        """Take a table that describes the run; for files."""
        return

    def end_head(self) -> None:
        """Note that all that describes the run was written; for files."""
        return

    def close(self) -> None:
        """Take no more messages."""
        return


class Drawings:
    """Draws a session into topics of its file.

    `start_ns` is the session time of the latched messages [ns].
    """

    def __init__(self, file: Topics, info: SessionInfo, start_ns: int) -> None:
        self._file = file
        self._radars = info.radars
        self._field = info.field_of_view
        self._wheels = WheelMotion(info.wheels)
        self._newest_ns = start_ns
        self._map_from_odom: Array | None = None
        self._last: Snapshot | None = None
        self._markers_ns = self._paths_ns = start_ns
        self._bscans = {
            index: _Bscan(file, radar, self._field.max_range_m, start_ns)
            for index, radar in enumerate(info.radars)
            if radar.n_bins >= _FEWEST_BINS
        }
        for radar in info.radars:
            file.add_topic(f"/radar/{radar.name}/range", cdr.RANGE)
        file.add_topic("/estimate/pose", cdr.POSE_WITH_COVARIANCE)
        file.add_topic("/estimate/odometry", cdr.ODOMETRY)
        file.add_topic("/landmarks/markers", cdr.MARKERS)
        self._paths = {
            "/odom": GrowingPath("map"),
            "/estimate": GrowingPath("map"),
        }
        for topic in self._paths:
            self._add_path(f"{topic}/path")
        self._write_latched("/fields_of_view", "base_link", self._fields_of_view())
        # Rerun's views are of its own root, which no transform of ROS leads to, and it takes
        # transforms from any topic; other programs take theirs from /tf and /tf_static.
        file.add_topic("/rerun/tf_static", cdr.TRANSFORMS, latched=True)
        link = cdr.transforms(start_ns, {(_RERUN_ROOT, "world"): np.zeros(3)})
        file.write("/rerun/tf_static", start_ns, link)
        if scene := _scene(info):
            self._write_latched("/scene", "world", scene)
            self._paths["/truth"] = GrowingPath("world")
            self._add_path("/truth/path")

    def on_scan(self, scan: Scan) -> None:
        self._newest_ns = scan.t_ns
        for frame in scan.frames:
            if frame.radar in self._bscans:
                self._bscans[frame.radar].add(frame)

    def on_snapshot(self, snapshot: Snapshot) -> None:
        t_ns = snapshot.t_ns
        if self._map_from_odom is None:
            start = between(snapshot.odometry, np.zeros(3))
            self._map_from_odom = compose(snapshot.estimate, start)
        twist = self._wheels.twist(t_ns, snapshot.odometry)
        self._last = snapshot
        covariance = snapshot.pose_covariance
        pose = cdr.pose_with_covariance(t_ns, "map", snapshot.estimate, covariance)
        self._file.write("/estimate/pose", t_ns, pose)
        placed = cdr.planar(snapshot.estimate)
        odometry = cdr.odometry(t_ns, "map", placed, covariance, twist)
        self._file.write("/estimate/odometry", t_ns, odometry)
        self._write_ranges(snapshot)
        self._paths["/odom"].add(t_ns, compose(self._map_from_odom, snapshot.odometry))
        self._paths["/estimate"].add(t_ns, snapshot.estimate)
        if "/truth" in self._paths and np.isfinite(snapshot.truth).all():
            self._paths["/truth"].add(t_ns, snapshot.truth)
        if not 0 <= t_ns - self._markers_ns < _MARKERS_EVERY_NS:  # session time may fall
            self._markers_ns = t_ns
            self._write_landmarks(snapshot)
        if not 0 <= t_ns - self._paths_ns < _PATHS_EVERY_NS:
            self._paths_ns = t_ns
            self._write_paths(t_ns, most=_SHOWN_POSES)

    def on_smoothed(self, smoothed: SmoothedRun) -> None:
        self._add_path("/slam/smoothed_path")
        self._file.add_topic("/slam/smoothed_landmarks", cdr.POINT_CLOUD)
        t_ns, step = int(smoothed.t_ns[-1]), -(-len(smoothed.t_ns) // (_KEPT_POSES - 1))
        # counted from the end, whose pose is the newest
        stamps_ns, poses = smoothed.t_ns[::-step][::-1], smoothed.poses[::-step][::-1]
        self._write_path("/slam/smoothed_path", t_ns, "map", stamps_ns, poses)
        landmarks = cdr.landmark_cloud(t_ns, smoothed)
        self._file.write("/slam/smoothed_landmarks", t_ns, landmarks)

    def close(self) -> None:
        """Write the last rows of the B-scans, the whole paths and the last map."""
        for bscan in self._bscans.values():
            bscan.write()
        if self._last is not None:
            self._write_landmarks(self._last)
            self._write_paths(self._last.t_ns, most=_KEPT_POSES)

    def _add_path(self, topic: str) -> None:
        self._file.add_topic(topic, cdr.PATH)
        self._file.add_topic(f"{topic}_points", cdr.POINT_CLOUD)

    def _write_paths(self, t_ns: int, *, most: int) -> None:
        for topic, path in self._paths.items():
            stamps_ns, poses = path.thinned(most)
            if len(stamps_ns):
                self._write_path(f"{topic}/path", t_ns, path.frame, stamps_ns, poses)

    def _write_path(
        self, topic: str, t_ns: int, frame: str, stamps_ns: NDArray[np.int64], poses: Array
    ) -> None:
        """Write a path as poses, and as points to the topic that is named after it."""
        self._file.write(topic, t_ns, cdr.path(t_ns, frame, stamps_ns, poses))
        self._file.write(f"{topic}_points", t_ns, cdr.path_cloud(t_ns, frame, poses))

    def _write_latched(self, topic: str, frame: str, drawn: Sequence[Marker]) -> None:
        self._file.add_topic(topic, cdr.MARKERS, latched=True)
        self._file.write(topic, self._newest_ns, cdr.markers(self._newest_ns, frame, drawn))

    def _fields_of_view(self) -> list[Marker]:
        return [
            Marker(
                group="fields of view",
                shape=Shape.LINE_STRIP,
                number=number,
                size_m=(0.005, 0.0, 0.0),
                colour=(0.6, 0.6, 0.6, 1.0),
                points_m=wedge(self._field, radar),
                moves=True,
            )
            for number, radar in enumerate(self._radars)
        ]

    def _write_ranges(self, snapshot: Snapshot) -> None:
        if snapshot.step is None:
            return
        for index, radar in enumerate(self._radars):
            own = [one for one in snapshot.step.detections if one.radar == index]
            strongest = max(
                own,
                # the nearest where amplitudes are unknown
                key=lambda one: -math.inf if math.isnan(one.amplitude) else one.amplitude,
                default=None,
            )
            message = cdr.echo_range(
                snapshot.t_ns if strongest is None else strongest.t_ns,
                f"radar_{radar.name}",
                field_of_view_rad=self._field.opening_rad,
                limits_m=(self._field.min_range_m, self._field.max_range_m),
                range_m=math.inf if strongest is None else strongest.range_m,
            )
            self._file.write(f"/radar/{radar.name}/range", snapshot.t_ns, message)

    def _write_landmarks(self, snapshot: Snapshot) -> None:
        message = cdr.markers(snapshot.t_ns, "map", landmark_markers(snapshot))
        self._file.write("/landmarks/markers", snapshot.t_ns, message)


_RERUN_ROOT = "tf#/"
_MARKERS_EVERY_NS = 2 * NS_PER_S
_PATHS_EVERY_NS = 10 * NS_PER_S
_CHI_95 = math.sqrt(-2.0 * math.log(0.05))  # of two degrees of freedom

_RED, _PALE_RED, _BLUE = (0.84, 0.15, 0.16, 1.0), (0.84, 0.15, 0.16, 0.35), (0.12, 0.47, 0.71, 1.0)

ENLARGED = 10
"""How many times larger than they are the ellipses of landmarks are drawn."""


def landmark_markers(snapshot: Snapshot) -> list[Marker]:
    """Draw landmarks, their 95 % ellipses, `ENLARGED`, and stretches of wall, map frame."""
    drawn: list[Marker] = []
    if len(snapshot.wall_spans_m):
        drawn.append(
            Marker(
                group="walls",
                shape=Shape.LINE_LIST,
                size_m=(0.03, 0.0, 0.0),
                colour=_BLUE,
                points_m=snapshot.wall_spans_m.reshape(-1, 2),
            )
        )
    if len(snapshot.landmark_ids):
        drawn.append(
            Marker(
                group="landmarks",
                shape=Shape.SPHERE_LIST,
                size_m=(0.05,) * 3,
                colour=_RED,
                points_m=snapshot.landmarks_m,
            )
        )
        covariances = snapshot.landmark_covariances_m2
        known = np.isfinite(covariances).all(axis=(1, 2))
        variances, axes = np.linalg.eigh(covariances[known])
        long_first = 2.0 * ENLARGED * _CHI_95 * np.sqrt(np.maximum(variances, 0.0))[:, ::-1]
        turns = np.arctan2(axes[:, 1, 1], axes[:, 0, 1])
        for id_, place, turn, size in zip(
            snapshot.landmark_ids[known].tolist(),
            snapshot.landmarks_m[known],
            turns,
            long_first.tolist(),
            strict=True,
        ):
            drawn.append(
                Marker(
                    group=f"95 % ellipses, {ENLARGED} x",
                    shape=Shape.CYLINDER,
                    number=id_,
                    size_m=(size[0], size[1], 0.01),
                    colour=_PALE_RED,
                    pose=np.append(place, turn),
                )
            )
    return drawn


def _scene(info: SessionInfo) -> list[Marker]:
    """Draw what is truly there, world frame; nothing if it is unknown."""
    drawn = [
        Marker(
            group="true walls",
            shape=Shape.LINE_STRIP,
            number=number,
            size_m=(0.02, 0.0, 0.0),
            colour=(0.5, 0.5, 0.5, 1.0),
            points_m=line,
        )
        for number, line in enumerate(info.outlines_m)
    ]
    if len(info.true_landmarks_m):
        drawn.append(
            Marker(
                group="true landmarks",
                shape=Shape.SPHERE_LIST,
                size_m=(0.03,) * 3,
                colour=(0.2, 0.2, 0.2, 1.0),
                points_m=info.true_landmarks_m,
            )
        )
    return drawn


class WheelMotion:
    """Velocity by the wheels from pose to pose, with the errors that SLAM assumes of them.

    `errors` are the fields of `WheelNoise`; without them the covariance is zero, which in ROS means
    unknown.
    """

    def __init__(self, errors: Mapping[str, float]) -> None:
        self._noise = WheelNoise(**errors) if errors else None
        self._newest: tuple[int, Array] | None = None

    def twist(self, t_ns: int, pose: Array) -> cdr.Twist:
        """Return the constant velocity that leads to a pose (3,) from that of the last call."""
        before, self._newest = self._newest, (t_ns, pose)
        if before is None or t_ns <= before[0]:
            return cdr.NO_TWIST
        dt_s = (t_ns - before[0]) / NS_PER_S
        dx, dy, turn = between(before[1], pose).tolist()
        # along an arc of constant curvature: a pose is the exponential of its twist
        half = turn / 2.0
        stretch = half / math.tan(half) if abs(half) > 1e-9 else 1.0
        forwards, left = stretch * dx + half * dy, stretch * dy - half * dx
        velocity = np.array([forwards, left, turn]) / dt_s
        if self._noise is None:
            return cdr.Twist(velocity=velocity, covariance=np.zeros((3, 3)))
        noise, distance_m = self._noise, math.hypot(forwards, left)
        variances = np.array(noise.step_variances(distance_m, turn))
        variances[:2] += (noise.scale_sigma * np.array([forwards, left])) ** 2
        variances[2] += (noise.turn_scale_sigma * turn) ** 2
        variances[2] += (noise.curvature_sigma_rad_per_m * distance_m) ** 2
        return cdr.Twist(velocity=velocity, covariance=np.diag(variances) / dt_s**2)


_SHOWN_POSES = 256
"""Of a path that is still driven, so that what is written of it in an hour stays in proportion."""
_KEPT_POSES = 3600


class GrowingPath:
    """A path that grows: all poses up to 3600, then every second, every fourth, and so on."""

    def __init__(self, frame: str) -> None:
        self.frame = frame
        self._stamps: list[int] = []
        self._poses: list[tuple[float, ...]] = []
        self._every, self._n_added = 1, 0
        self._newest: tuple[int, tuple[float, ...]] | None = None

    def add(self, t_ns: int, pose: Array) -> None:
        self._newest = t_ns, tuple(pose.tolist())
        if self._n_added % self._every == 0:
            self._stamps.append(t_ns)
            self._poses.append(self._newest[1])
        self._n_added += 1
        if len(self._poses) >= _KEPT_POSES:
            self._every *= 2
            del self._stamps[1::2], self._poses[1::2]

    def thinned(self, most: int) -> tuple[NDArray[np.int64], Array]:
        """Return stamps (n,) and poses (n, 3) to the end of the path, so many at most."""
        if self._newest is None:
            return np.zeros(0, np.int64), np.zeros((0, 3))
        step = -(-len(self._poses) // (most - 1))
        stamps, poses = self._stamps[::step], self._poses[::step]
        if stamps[-1] != self._newest[0]:
            stamps, poses = [*stamps, self._newest[0]], [*poses, self._newest[1]]
        return np.array(stamps), np.array(poses)


_ROWS = 128
_NEW_ROWS = 32
_BINS_PER_COLUMN = 4
_REACHES = 2.0
_FLOOR_DB, _STEP_DB = -62.0, 0.5
_FEWEST_BINS = 2 * _BINS_PER_COLUMN
"""Sessions made of ranges have frames without samples."""


class _Bscan:
    """The newest frames of a radar as a picture that grows downwards, 32 frames at a time.

    A row is a frame, a column 4 bins, a quarter of what the pulse resolves, up to twice the range
    that SLAM looks at. A value is the largest envelope in them, in decibels above -62 dB of full
    scale, which is the receiver's noise, rounded to 0.5 dB, and 0 below. No value is negative, as
    viewers take images of one float per pixel for depths. What stayed the same over the last 128
    frames is taken away. A lost frame is a row of NaN. After 128 rows a new picture begins.
    """

    def __init__(self, file: Topics, radar: RadarInfo, reach_m: float, start_ns: int) -> None:
        self._file = file
        self._frame_id = f"radar_{radar.name}"
        self._topic = f"/radar/{radar.name}/bscan"
        file.add_topic(self._topic, cdr.IMAGE)
        self._recent: deque[NDArray[np.float32]] = deque(maxlen=_ROWS)
        self._n_bins, self._n_new = radar.n_bins, 0
        self._last: RadarFrame | None = None
        self._rows: list[NDArray[np.float32]] = []
        self._gaps: list[int] = []  # before each new frame
        bin_m = radar.bin_length_m * TRUE_PER_MODULE_METRE
        first_bin = 1 + (_BINS_PER_COLUMN - 1) / 2
        start_m = radar.range_start_m * TRUE_PER_MODULE_METRE - radar.range_offset_m
        n_shown = min(max(int((_REACHES * reach_m - start_m) / bin_m), _FEWEST_BINS), radar.n_bins)
        self._n_columns = (n_shown - 2) // _BINS_PER_COLUMN
        about = {
            "value": "envelope of the echoes, the mean of the last 128 frames taken away",
            "unit": f"dB above {_FLOOR_DB:g} dB of full scale",
            "columns": {
                "what": "range from the antenna",
                "unit": "m",
                "first": start_m + first_bin * bin_m,
                "step": _BINS_PER_COLUMN * bin_m,
                "count": self._n_columns,
            },
            "rows": {
                "what": "time of the frame; the last row is of the stamp in the header",
                "unit": "s",
                "step": 1.0 / radar.rate_hz,
                "most": _ROWS,
            },
            "lost frames": "NaN",
        }
        file.add_topic(f"{self._topic}/axes", STRING, latched=True)
        file.write(f"{self._topic}/axes", start_ns, pack_string(json.dumps(about)))

    def add(self, frame: RadarFrame) -> None:
        if len(frame.samples) != self._n_bins:
            return  # of other settings than the picture
        last = self._last
        gap = 0
        if last is not None:
            gap = frame.counter - last.counter - 1 if frame.stream == last.stream else 1
        self._last = frame
        self._gaps.append(min(max(gap, 0), _ROWS))
        self._recent.append(frame.samples)
        self._n_new += 1
        if self._n_new == _NEW_ROWS:
            self.write()

    def write(self) -> None:
        """Write the picture with the frames that came since the last time."""
        if self._last is None or not self._n_new:
            return
        n_bins = 2 + self._n_columns * _BINS_PER_COLUMN
        recent = np.stack([samples[:n_bins] for samples in self._recent])
        recent = np.nan_to_num(recent, copy=False)
        echoes = recent[-self._n_new :] - recent.mean(axis=0)
        levels = envelope_db(echoes, self._last.bin_length_m)
        columns = levels.reshape(self._n_new, self._n_columns, _BINS_PER_COLUMN).max(axis=2)
        steps = np.round((columns - np.float32(_FLOOR_DB)) / np.float32(_STEP_DB))
        rounded = np.maximum(steps, 0.0) * np.float32(_STEP_DB)
        missing = np.full(self._n_columns, np.nan, dtype=np.float32)
        if len(self._rows) >= _ROWS:
            self._rows = []
        for gap, row in zip(self._gaps, rounded, strict=True):
            self._rows += [missing] * gap
            self._rows.append(row)
        self._rows = self._rows[-_ROWS:]
        self._gaps, self._n_new = [], 0
        message = cdr.image(self._last.t_ns, self._frame_id, np.array(self._rows))
        self._file.write(self._topic, self._last.t_ns, message)
