"""The only file that knows Rerun: a session as an .rrd with a blueprint for newcomers.

Whoever needs a view imports this module at that moment, since it costs half a second. The
recording is re-creatable from the session log and never the only copy: Rerun reads files of
adjacent versions only. Rerun's 2D views have y downwards and ours upwards: `_screen` is the one
place that negates it.
"""

from __future__ import annotations

import json
import os
import warnings
from collections import defaultdict
from dataclasses import asdict
from pathlib import Path
from threading import Thread

import numpy as np
import pyarrow as pa

# Rerun tells of a full disk in lines of its own, from its own threads; `close` says it in one.
os.environ.setdefault("RUST_LOG", "off")

import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray
from rerun.chunk import RrdReader

from slam.app.bscan import bscan_picture
from slam.app.ellipse import ellipse_95, rotate_covariances
from slam.app.errors import AppError
from slam.app.session import LogLine, Scan, SessionInfo, Snapshot
from slam.app.tum import NS_PER_S
from slam.app.view_guide import ABOUT
from slam.geometry import transform

_BLOCK_FRAMES = 128
"""Frames sent at once, and rows of one B-scan picture."""
_BLOCK_SNAPSHOTS = 128
_CLOSE_LIMIT_S = 20.0
"""Longest wait for Rerun to finish the file."""
_MAP_PERIOD_NS = NS_PER_S
_PATH_PERIOD_NS = 2 * NS_PER_S

_MAP_MARGIN_M = 0.6
_ARROW_M = 0.25

_TRUTH_RGB = (120, 120, 120)
_ODOMETRY_RGB = (230, 130, 30)
_ESTIMATE_RGB = (40, 120, 220)
_LANDMARK_RGB = (200, 40, 90)

# Name, colour, half line width, draw order: the truth lies below, wide enough to be seen.
_PATHS = (
    ("truth", _TRUTH_RGB, 0.02, 10.0),
    ("odometry", _ODOMETRY_RGB, 0.006, 20.0),
    ("estimate", _ESTIMATE_RGB, 0.006, 30.0),
)


class RerunView:
    """Writes frames, B-scans, map, scalars and the link's log to an .rrd file, in blocks.

    Raises
    ------
    AppError
        From `close`, when the finished file does not hold every frame and state that was sent.
    """

    def __init__(self, path: Path, info: SessionInfo, *, simulated: bool) -> None:
        rr.set_strict_mode(True)
        self._path = path
        self._info = info
        self._frames: dict[int, _FrameBlock] = {
            index: _FrameBlock(radar.name) for index, radar in enumerate(info.radars)
        }
        self._snapshots: list[Snapshot] = []
        self._paths: dict[str, list[NDArray[np.float64]]] = defaultdict(list)
        self._next_map_ns = self._next_path_ns = 0
        self._sent: dict[str, int] = defaultdict(int)
        # Never `with` this stream: leaving the block closes the file and drops what follows.
        self._stream: rr.RecordingStream | None = rr.RecordingStream(
            "xethru-hil", recording_id=f"{info.scene}-{info.preset}-{info.seed}"
        )
        self._stream.set_log_time_enabled(False)
        self._stream.set_log_tick_enabled(False)
        self._stream.save(path, default_blueprint=_blueprint(info))
        self._stream.send_recording_name(f"{info.scene}, preset {info.preset}, seed {info.seed}")
        self._stream.send_recording_start_time_nanos(0)
        origin = "simulated" if simulated else "measured"
        about = ABOUT.format(block=_BLOCK_FRAMES, origin=origin)
        self._static("about", rr.TextDocument(about, media_type=rr.MediaType.MARKDOWN))
        settings = json.dumps([asdict(radar) for radar in info.radars], indent=1)
        self._static("radars", rr.TextDocument(settings))
        for name, colour in (("truth", _TRUTH_RGB), ("estimate", _ESTIMATE_RGB)):
            style = rr.Arrows2D.from_fields(colors=colour, radii=0.02, draw_order=40.0)
            self._static(f"map/{name}/robot", style)
        if len(info.true_landmarks_m):
            self._static("map/landmarks/true", _crosses(info.true_landmarks_m))

    def on_scan(self, scan: Scan) -> None:
        """Take the frames of one counter; a block of them goes out at once."""
        for frame in scan.frames:
            block = self._frames[frame.radar]
            block.counters.append(frame.counter)
            block.stamps_ns.append(frame.t_ns)
            block.samples.append(frame.samples)
            block.range_start_m, block.bin_length_m = frame.range_start_m, frame.bin_length_m
            if len(block.samples) == _BLOCK_FRAMES:
                self._send_frames(block)

    def on_snapshot(self, snapshot: Snapshot) -> None:
        """Take a state of SLAM: poses and scalars in blocks, the map once per second."""
        self._snapshots.append(snapshot)
        self._paths["truth"].append(snapshot.truth[:2])
        self._paths["odometry"].append(transform(snapshot.world_from_map, snapshot.odometry[:2]))
        self._paths["estimate"].append(transform(snapshot.world_from_map, snapshot.estimate[:2]))
        if snapshot.t_ns >= self._next_map_ns:
            self._next_map_ns = snapshot.t_ns + _MAP_PERIOD_NS
            self._send_landmarks(snapshot)
        if snapshot.t_ns >= self._next_path_ns:
            # Sent whole, as a view shows the newest row only; ever rarer, so the sum stays small.
            self._next_path_ns = snapshot.t_ns + max(_PATH_PERIOD_NS, snapshot.t_ns // 100)
            self._send_paths(snapshot)
        if len(self._snapshots) == _BLOCK_SNAPSHOTS:
            self._send_snapshots()

    def on_log(self, line: LogLine) -> None:
        """Take a line about the link."""
        level = rr.TextLogLevel.WARN if line.warning else rr.TextLogLevel.INFO
        stream = self._open_stream()
        stream.set_time("device_time", duration=np.timedelta64(line.t_ns, "ns"))
        stream.log(f"link/{line.radar}", rr.TextLog(line.text, level=level))
        stream.reset_time()

    def close(self) -> None:
        """Send what is left, finish the file and count its rows."""
        if self._stream is None:
            return
        for block in self._frames.values():
            self._send_frames(block)
        if self._snapshots:
            last = self._snapshots[-1]
            self._send_landmarks(last)
            self._send_paths(last)
            self._send_snapshots()
        stream, self._stream = self._stream, None
        # On a full disk Rerun's writer is gone and disconnect may wait for it without end.
        closing = Thread(target=stream.disconnect, daemon=True)
        closing.start()
        closing.join(_CLOSE_LIMIT_S)
        if closing.is_alive():
            rr.unregister_shutdown()  # or it waits once more when the interpreter ends
            raise AppError(f"{self._path}: cannot be finished; is the disk full?")
        try:
            found = count_rows(self._path)
        except RuntimeError:  # Rerun's own errors about a damaged file
            raise AppError(f"{self._path}: is incomplete; is the disk full?") from None
        for entity, sent in self._sent.items():
            if found.get(entity, 0) != sent:
                raise AppError(
                    f"{self._path}: holds {found.get(entity, 0)} of {sent} rows of {entity}; "
                    "the view is incomplete, the session log is not affected"
                )

    def _open_stream(self) -> rr.RecordingStream:
        if self._stream is None:
            raise ValueError("the view is closed already")
        return self._stream

    def _static(self, entity: str, what: rr.AsComponents) -> None:
        self._open_stream().log(entity, what, static=True)

    def _send_frames(self, block: _FrameBlock) -> None:
        if not block.samples:
            return
        frames = np.stack(block.samples)
        times = _time_columns(block.stamps_ns, block.counters)
        entity = f"radar/{block.name}/frame"
        self._open_stream().send_columns(entity, times, [_bar_charts(frames)])
        self._sent[f"/{entity}"] += len(frames)
        # Stamped with its first frame, so that the cursor is inside the picture it shows.
        self._set_time(block.stamps_ns[0], block.counters[0])
        picture = bscan_picture(frames, block.range_start_m, block.bin_length_m)
        self._open_stream().log(
            f"radar/{block.name}/bscan",
            rr.Tensor(picture, dim_names=("frame", "range_bin"), value_range=(0.0, 255.0)),
        )
        block.clear()

    def _send_snapshots(self) -> None:
        rows, self._snapshots = self._snapshots, []
        stream = self._open_stream()
        times = _time_columns([row.t_ns for row in rows], [row.counter for row in rows])
        in_world = np.array([transform(row.world_from_map, row.estimate[:2]) for row in rows])
        truth = np.array([row.truth for row in rows])
        error_m = np.linalg.norm(in_world - truth[:, :2], axis=1)
        landmarks = np.array([len(row.landmark_ids) for row in rows], dtype=np.float64)
        stream.send_columns("error/pose_m", times, rr.Scalars.columns(scalars=error_m))
        stream.send_columns("landmarks/count", times, rr.Scalars.columns(scalars=landmarks))
        self._sent["/error/pose_m"] += len(rows)
        heading_rad = np.array([row.estimate[2] + row.world_from_map[2] for row in rows])
        for name, positions, headings in (
            ("truth", truth[:, :2], truth[:, 2]),
            ("estimate", in_world, heading_rad),
        ):
            vectors = _ARROW_M * np.stack([np.cos(headings), np.sin(headings)], axis=-1)
            stream.send_columns(
                f"map/{name}/robot",
                times,
                rr.Arrows2D.columns(origins=_screen(positions), vectors=_screen(vectors)),
            )
        surprised = [row for row in rows if row.nis_per_dof]
        if surprised:
            stream.send_columns(
                "consistency/nis_per_dof",
                _time_columns([r.t_ns for r in surprised], [r.counter for r in surprised]),
                rr.Scalars.columns(
                    scalars=np.array([np.mean(row.nis_per_dof) for row in surprised])
                ),
            )

    def _send_landmarks(self, snapshot: Snapshot) -> None:
        self._set_time(snapshot.t_ns, snapshot.counter)
        points = transform(snapshot.world_from_map, snapshot.landmarks_m)
        covariances = rotate_covariances(
            snapshot.world_from_map[2], snapshot.landmark_covariances_m2
        )
        outlines = [_screen(ellipse_95(*pair)) for pair in zip(points, covariances, strict=True)]
        stream = self._open_stream()
        stream.log(
            "map/landmarks/estimated",
            rr.Points2D(
                _screen(points),
                colors=_LANDMARK_RGB,
                radii=0.025,
                labels=[str(number) for number in snapshot.landmark_ids],
                show_labels=False,
            ),
        )
        stream.log("map/landmarks/ellipses", rr.LineStrips2D(outlines, colors=_LANDMARK_RGB))

    def _send_paths(self, snapshot: Snapshot) -> None:
        self._set_time(snapshot.t_ns, snapshot.counter)
        for name, colour, radius_m, draw_order in _PATHS:
            points = self._paths[name]
            # One point per five states is 5 cm of path: no corner is lost.
            path = _screen(np.array([*points[::5], points[-1]]))
            self._open_stream().log(
                f"map/{name}/path",
                rr.LineStrips2D([path], colors=colour, radii=radius_m, draw_order=draw_order),
            )

    def _set_time(self, t_ns: int, counter: int) -> None:
        stream = self._open_stream()
        stream.set_time("device_time", duration=np.timedelta64(t_ns, "ns"))
        stream.set_time("frame", sequence=counter)


def count_rows(path: Path) -> dict[str, int]:
    """Count the rows of every entity of an .rrd file."""
    rows: dict[str, int] = defaultdict(int)
    with warnings.catch_warnings():
        # of a file without its footer; what is missing then is found by counting
        warnings.simplefilter("ignore", rr.error_utils.RerunWarning)
        for chunk in RrdReader(path).stream():
            rows[str(chunk.entity_path)] += chunk.num_rows
    return dict(rows)


class _FrameBlock:
    """Frames of one radar that wait to be sent together."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.range_start_m = self.bin_length_m = 0.0
        self.clear()

    def clear(self) -> None:
        """Forget the frames."""
        self.counters: list[int] = []
        self.stamps_ns: list[int] = []
        self.samples: list[NDArray[np.float32]] = []


def _screen(points: NDArray[np.float64]) -> NDArray[np.float32]:
    """Turn points or vectors, shape (n, 2), y up, into Rerun's 2D views, y down."""
    flipped: NDArray[np.float32] = (points * np.array([1.0, -1.0])).astype(np.float32)
    return flipped


def _time_columns(stamps_ns: list[int], counters: list[int]) -> list[rr.TimeColumn]:
    durations = np.array(stamps_ns, dtype="timedelta64[ns]")
    return [
        rr.TimeColumn("device_time", duration=durations),
        rr.TimeColumn("frame", sequence=np.array(counters, dtype=np.int64)),
    ]


class _ArrowBatch:
    """A ready arrow array in the shape that rr.ComponentColumn takes."""

    def __init__(self, descriptor: rr.ComponentDescriptor, array: pa.Array) -> None:
        self._descriptor, self._array = descriptor, array

    def component_descriptor(self) -> rr.ComponentDescriptor:
        return self._descriptor

    def as_arrow_array(self) -> pa.Array:
        return self._array


def _bar_charts(frames: NDArray[np.float32]) -> rr.ComponentColumn:
    """Make one bar chart per row of shape (n_frames, n_bins), as one column.

    rr.BarChart has no working `columns`, and one log call per frame costs half a millisecond. So
    the arrow array of n one-dimensional tensors is built here, without copying the samples.
    """
    n_frames, n_bins = frames.shape
    (template,) = rr.BarChart(np.zeros(1, dtype=np.float32)).as_component_batches()
    tensor = template.as_arrow_array().type
    shape, names, buffer = (tensor.field(name).type for name in ("shape", "names", "buffer"))
    kinds = [buffer.field(index) for index in range(buffer.num_fields)]
    ends = np.arange(n_frames + 1, dtype=np.int32)
    sizes = pa.array(np.full(n_frames, n_bins, dtype=np.uint64))
    float32 = [kind.name for kind in kinds].index("F32")
    children = [pa.array([], type=kind.type) for kind in kinds]
    children[float32] = pa.ListArray.from_arrays(
        pa.array(ends * n_bins), pa.array(frames.ravel()), type=kinds[float32].type
    )
    codes = np.full(n_frames, float32, dtype=np.int8)
    union = pa.Array.from_buffers(
        buffer,
        n_frames,
        [None, pa.py_buffer(codes), pa.py_buffer(ends[:-1].copy())],
        children=children,
    )
    column = pa.StructArray.from_arrays(
        [
            pa.ListArray.from_arrays(pa.array(ends), sizes, type=shape),
            pa.nulls(n_frames, names),
            union,
        ],
        fields=[tensor.field(name) for name in ("shape", "names", "buffer")],
    )
    descriptor = template.component_descriptor()
    return rr.ComponentColumn(descriptor, _ArrowBatch(descriptor, column))


def _crosses(points: NDArray[np.float64], arm_m: float = 0.04) -> rr.LineStrips2D:
    """Draw a cross at each point, shape (n, 2)."""
    strips = [
        _screen(np.array([point - arm, point + arm]))
        for point in points
        for arm in (np.array([arm_m, arm_m]), np.array([arm_m, -arm_m]))
    ]
    return rr.LineStrips2D(strips, colors=_TRUTH_RGB, radii=0.008)


def _blueprint(info: SessionInfo) -> rrb.Blueprint:
    """Lay out map, B-scans, newest frames, errors and the link's log."""
    bounds = None
    if len(info.true_landmarks_m):
        corners = _screen(info.true_landmarks_m)
        low, high = corners.min(axis=0) - _MAP_MARGIN_M, corners.max(axis=0) + _MAP_MARGIN_M
        bounds = rrb.VisualBounds2D(
            x_range=[float(low[0]), float(high[0])], y_range=[float(low[1]), float(high[1])]
        )
    names = [radar.name for radar in info.radars]
    mapping = rrb.TensorScalarMapping(colormap="viridis")
    bscans = [
        rrb.TensorView(
            name=f"B-scan {name}",
            origin=f"/radar/{name}/bscan",
            view_fit="fill",
            scalar_mapping=mapping,
        )
        for name in names
    ]
    frames = [
        rrb.BarChartView(name=f"Frame {name}", origin=f"/radar/{name}/frame") for name in names
    ]
    scalars = rrb.Tabs(
        rrb.TimeSeriesView(name="Pose error [m]", origin="/error"),
        rrb.TimeSeriesView(name="NIS / dof, gated", origin="/consistency"),
        rrb.TimeSeriesView(name="Landmarks", origin="/landmarks"),
    )
    text = rrb.Tabs(
        rrb.TextDocumentView(name="What you see", origin="/about"),
        rrb.TextLogView(name="Link", origin="/link"),
        rrb.TextDocumentView(name="Radars", origin="/radars"),
    )
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial2DView(name="Map", origin="/map", visual_bounds=bounds),
            rrb.Vertical(rrb.Tabs(*bscans), rrb.Tabs(*frames), scalars),
            text,
            column_shares=[4, 3, 2],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="expanded", timeline="device_time"),
        auto_views=False,
    )
