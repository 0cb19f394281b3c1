"""Frames of radars in Rerun: bar charts of frames and detections, and B-scans."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from slam.app.rig.echo_arcs import bscan_picture, n_shown_bins
from slam.app.view.rerun_recording import (
    FAULT_RGB,
    RADAR_RGB,
    RerunRecording,
    Rgb,
    RowTimes,
    arrow_column,
    part,
    rr,
)
from slam.frames import RadarFrame
from slam.live.odometry_track import NS_PER_S
from slam.live.session_records import RadarInfo, Scan, Snapshot

BLOCK_FRAMES = 128
"""Rows of one B-scan picture; as many frames are sent at once to a file."""

_DETECTION_WIDTH_M = 0.03
_ONE_VALUE = np.zeros(1, dtype=np.float32)
_NO_DETECTION = (0.0, 0.0)
"""A chart needs a bar: one without height at the antenna stands for none."""


class FrameLayer:
    """Collects frames and sends them in blocks; sends detections."""

    def __init__(self, recording: RerunRecording, radars: Sequence[RadarInfo]) -> None:
        self._recording = recording
        self._radars = tuple(radars)
        self._blocks = [_FrameBlock(entity=f"radar/{part(radar.name)}") for radar in radars]
        for index, radar in enumerate(radars):
            colour = RADAR_RGB[index % len(RADAR_RGB)]
            recording.static(f"radar/{part(radar.name)}/frame", chart_style(color=colour))
            recording.static(f"radar/{part(radar.name)}/detections", chart_style(color=FAULT_RGB))

    def on_scan(self, scan: Scan) -> None:
        """Take the frames of one tick; a full block goes out at once."""
        host = scan.host_ns or (None,) * len(scan.frames)
        for frame, host_ns in zip(scan.frames, host, strict=True):
            block = self._blocks[frame.radar]
            block.stamps.add(frame.t_ns, scan.counter, host_ns)
            block.frames.append(frame)
            if len(block.frames) == BLOCK_FRAMES:
                self._send_frames(block)

    def send(self) -> None:
        """Send the frames that wait."""
        for block in self._blocks:
            self._send_frames(block)

    def send_older(self, t_ns: int) -> None:
        """Send the frames of radars of which one from `t_ns` or before still waits."""
        for block in self._blocks:
            if block.frames and block.stamps.t_ns[0] <= t_ns:
                self._send_frames(block)

    def send_detections(self, snapshots: Sequence[Snapshot], stamps: RowTimes) -> None:
        """Send the detections of some states."""
        known = [row for row, snapshot in enumerate(snapshots) if snapshot.step is not None]
        steps = [step for snapshot in snapshots if (step := snapshot.step) is not None]
        if not steps:
            return
        for index, radar in enumerate(self._radars):
            # Where the echo lies in the frame: with the offset that ranges are freed of.
            bars = [
                [
                    (d.range_m + radar.range_offset_m, d.amplitude)
                    for d in step.detections
                    if d.radar == index
                ]
                or [_NO_DETECTION]
                for step in steps
            ]
            entity = f"radar/{part(radar.name)}/detections"
            self._recording.rows(entity, stamps.at(known), _bars(bars))

    def _send_frames(self, block: _FrameBlock) -> None:
        if not block.frames:
            return
        newest = block.frames[-1]
        # as far as the B-scan: over a whole frame the view's axis has no number but 0
        n_bins = n_shown_bins(len(newest.samples), newest.range_start_m, newest.bin_length_m)
        samples = np.stack([frame.samples[:n_bins] for frame in block.frames])
        n_frames = len(samples)
        if block.axis != (axis := (newest.range_start_m, newest.bin_length_m, n_bins)):
            block.axis = axis
            labels_m = (axis[0] + axis[1] * np.arange(n_bins)).astype(np.float32)
            style = chart_style(abscissa=labels_m, bar_m=newest.bin_length_m)
            self._recording.static(f"{block.entity}/frame", style)
        send_charts(self._recording, block.entity, block.stamps, {"frame": samples})
        block.shown.extend(block.frames)
        # Stamped with its first frame, so that the cursor is inside the picture it shows; where
        # blocks come early, because someone watches, the picture is of the newest frames.
        shown = samples
        if n_frames < BLOCK_FRAMES:
            shown = np.stack([frame.samples[:n_bins] for frame in block.shown])
        picture = bscan_picture(shown, newest.range_start_m, newest.bin_length_m)
        # The envelope lacks the first bin and the last.
        ends_m = newest.range_start_m + newest.bin_length_m * np.array([1, picture.shape[1]])
        send_bscan(
            self._recording,
            block.entity,
            block.stamps,
            picture,
            lasted_ns=newest.t_ns - block.shown[-len(shown)].t_ns,
            ends_m=(ends_m[0], ends_m[1]),
            brightest=255.0,
        )
        block.stamps, block.frames = RowTimes(), []


@dataclass(slots=True, kw_only=True)
class _FrameBlock:
    """Frames of one radar that wait to be sent together."""

    entity: str
    axis: tuple[float, float, int] | None = None
    shown: deque[RadarFrame] = field(default_factory=lambda: deque(maxlen=BLOCK_FRAMES))
    stamps: RowTimes = field(default_factory=RowTimes)
    frames: list[RadarFrame] = field(default_factory=list)


def send_charts(
    recording: RerunRecording,
    entity: str,
    stamps: RowTimes,
    charts: Mapping[str, NDArray[np.float32]],
) -> None:
    """Send frames as bar charts, a row each; the values of each chart have shape (n, n_bins)."""
    for chart, values in charts.items():
        flat = np.ascontiguousarray(values, dtype=np.float32).ravel()
        column = chart_values("BarChart:values", flat, np.full(len(values), values.shape[1]))
        recording.rows(f"{entity}/{chart}", stamps, [column])


def send_bscan(
    recording: RerunRecording,
    entity: str,
    stamps: RowTimes,
    picture: NDArray[np.float32] | NDArray[np.uint8],
    *,
    lasted_ns: int,
    ends_m: tuple[float, float],
    brightest: float,
    counted_from: str = "",
) -> None:
    """Send a picture of frames, slow time downwards, at the first of their stamps.

    A tensor's view has no scale: the names of its axes say how long it lasts, and where its ranges
    begin and end.
    """
    names = (
        f"time {lasted_ns / NS_PER_S:.1f} s",
        f"range {ends_m[0]:.2f} .. {ends_m[1]:.2f} m{counted_from}",
    )
    scan = rr.Tensor(picture, dim_names=names, value_range=(0.0, brightest))
    recording.row(f"{entity}/bscan", stamps, scan)


def chart_style(
    *,
    color: Rgb | None = None,
    abscissa: NDArray[np.float32] | None = None,
    bar_m: float | None = None,
) -> list[rr.DescribedComponentBatch]:
    """Return a bar chart without its values; `BarChart.from_fields` cannot leave them out."""
    widths = None if abscissa is None or bar_m is None else np.full(len(abscissa), bar_m)
    chart = rr.BarChart(_ONE_VALUE, color=color, abscissa=abscissa, widths=widths)
    batches = chart.as_component_batches()
    return [b for b in batches if b.component_descriptor().component != "BarChart:values"]


def _bars(rows: Sequence[Sequence[tuple[float, float]]]) -> list[rr.ComponentColumn]:
    """Make bar charts, one per row, of any number of bars, each a place and a height."""
    sizes = np.array([len(row) for row in rows])
    places, heights = np.array(list(chain(*rows)), dtype=np.float32).T
    widths = np.full(len(places), _DETECTION_WIDTH_M, dtype=np.float32)
    width = _component(rr.BarChart(_ONE_VALUE, widths=widths), "BarChart:widths")
    return [
        chart_values("BarChart:values", heights, sizes),
        chart_values("BarChart:abscissa", places, sizes),
        rr.ComponentColumn(width.component_descriptor(), width).partition(sizes),
    ]


def _component(chart: rr.BarChart, name: str) -> rr.DescribedComponentBatch:
    batches = chart.as_component_batches()
    return next(b for b in batches if b.component_descriptor().component == name)


def chart_values(
    component: str, values: NDArray[np.float32], sizes: NDArray[np.int64]
) -> rr.ComponentColumn:
    """Make a column of one-dimensional tensors, one per row, of the sizes given.

    rr.BarChart has no working `columns`, and one log call per frame costs half a millisecond. So
    the arrow array of n one-dimensional tensors is built here, without copying the samples.
    """
    template = _component(rr.BarChart(_ONE_VALUE, abscissa=_ONE_VALUE), component)
    tensor = template.as_arrow_array().type
    shape, names, buffer = (tensor.field(name).type for name in ("shape", "names", "buffer"))
    kinds = [buffer.field(index) for index in range(buffer.num_fields)]
    n_rows = len(sizes)
    row_ends = np.arange(n_rows + 1, dtype=np.int32)
    value_ends = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int32)
    float32 = [kind.name for kind in kinds].index("F32")
    children = [pa.array([], type=kind.type) for kind in kinds]
    children[float32] = pa.ListArray.from_arrays(
        pa.array(value_ends), pa.array(values), type=kinds[float32].type
    )
    codes = np.full(n_rows, float32, dtype=np.int8)
    union = pa.Array.from_buffers(
        buffer,
        n_rows,
        [None, pa.py_buffer(codes), pa.py_buffer(row_ends[:-1].copy())],
        children=children,
    )
    lengths = pa.array(sizes.astype(np.uint64))
    column = pa.StructArray.from_arrays(
        [
            pa.ListArray.from_arrays(pa.array(row_ends), lengths, type=shape),
            pa.nulls(n_rows, names),
            union,
        ],
        fields=[tensor.field(name) for name in ("shape", "names", "buffer")],
    )
    return arrow_column(template.component_descriptor(), column)
