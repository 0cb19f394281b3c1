"""A Rerun recording that is written to a file or a viewer, with its rows counted.

The only module that imports Rerun; that takes half a second, and names vanish often.
Rerun's 2D views have y downwards, our frames upwards: only `screen` negates it.
"""

from __future__ import annotations

import os

# Rerun reports a full disk or a closed viewer in lines of its own, from its own threads; we report
# it in one.
os.environ.setdefault("RUST_LOG", "off")
# Rerun's allocator keeps freed memory, tens of megabytes in an hour of a run, unless this is set
# before it is loaded.
os.environ.setdefault("MIMALLOC_PURGE_DELAY", "0")

import warnings
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from threading import Thread

import numpy as np
import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray
from rerun.chunk import RrdReader
from rerun.error_utils import RerunWarning
from rerun.experimental import ViewerClient

from slam.live.errors import AppError

__all__ = ["RrdReader", "ViewerClient", "rr", "rrb"]

Rgb = tuple[int, int, int]

# On a dark ground; what is drawn alike differs also for those who see two colours only.
TRUTH_RGB: Rgb = (165, 165, 165)
ODOMETRY_RGB: Rgb = (240, 150, 40)
ESTIMATE_RGB: Rgb = (70, 140, 255)
SMOOTHED_RGB: Rgb = (245, 235, 150)
LANDMARK_RGB: Rgb = (225, 50, 120)
WALL_RGB: Rgb = (95, 95, 95)
GRID_RGB: Rgb = (38, 40, 44)
TICK_RGB: Rgb = (150, 155, 165)
WEDGE_RGB: Rgb = (70, 80, 95)
USED_RGB: Rgb = (60, 220, 180)
UNUSED_RGB: Rgb = (120, 110, 70)
FIX_RGB: Rgb = (240, 220, 70)
KEPT_RGB: Rgb = (60, 220, 180)
REJECTED_RGB: Rgb = (200, 70, 20)
BAND_RGB: Rgb = (130, 130, 130)
FAULT_RGB: Rgb = (240, 60, 60)
ROBOT_RGB: Rgb = (255, 255, 255)

RADAR_RGB: tuple[Rgb, ...] = ((76, 175, 200), (240, 170, 60), (150, 120, 230), (120, 200, 100))
"""One per radar, in the order of the rig; used again from the first beyond the fourth."""

DEVICE_TIME, HOST_TIME, FRAME = "device_time", "host_time", "frame"
"""The timelines: session time of the radars, time of day of arrival, tick."""

_STATIC = " (static)"

_FILE_BATCHES = rr.ChunkBatcherConfig(flush_tick=10.0, flush_num_bytes=4 << 20)
"""Rerun keeps an entry of every chunk of a file until its end, so chunks are few."""

_FILE_LIMIT_S = 20.0
"""Longest wait for Rerun to begin or to finish a file."""
_VIEWER_CLOSE_LIMIT_S = 5.0
"""Longest wait for a viewer to take the last rows."""


@dataclass(slots=True, kw_only=True)
class RowTimes:
    """When rows happened: session times, ticks, and nanoseconds since 1970.

    `host_ns` is left out of the recording as soon as one of its rows has none.
    """

    t_ns: list[int] = field(default_factory=list)
    counters: list[int] = field(default_factory=list)
    host_ns: list[int | None] = field(default_factory=list)

    @classmethod
    def of(cls, t_ns: int, counter: int, host_ns: int | None) -> RowTimes:
        """Return the stamps of one row."""
        return cls(t_ns=[t_ns], counters=[counter], host_ns=[host_ns])

    def __len__(self) -> int:
        return len(self.t_ns)

    def add(self, t_ns: int, counter: int, host_ns: int | None) -> None:
        self.t_ns.append(t_ns)
        self.counters.append(counter)
        self.host_ns.append(host_ns)

    def at(self, rows: Iterable[int]) -> RowTimes:
        picked = RowTimes()
        for row in rows:
            picked.add(self.t_ns[row], self.counters[row], self.host_ns[row])
        return picked

    def columns(self, epoch_ns: int) -> list[rr.TimeColumn]:
        """Return Rerun's time columns, device time counted from an epoch."""
        since_ns = np.maximum(np.array(self.t_ns, dtype=np.int64) - epoch_ns, 0)
        columns = [
            rr.TimeColumn(DEVICE_TIME, duration=since_ns.astype("timedelta64[ns]")),
            rr.TimeColumn(FRAME, sequence=np.array(self.counters, dtype=np.int64)),
        ]
        if None not in self.host_ns:
            stamps = np.array(self.host_ns, dtype="datetime64[ns]")
            columns.append(rr.TimeColumn(HOST_TIME, timestamp=stamps))
        return columns


class RerunRecording:
    """Sends rows to an .rrd file, to a viewer that listens or to one that reads standard output.

    Parameters
    ----------
    target
        A file, the address of a viewer, or None for standard output.
    blueprint
        How a viewer lays it out, unless its user chose otherwise.
    recording_id
        The same for the same run: a file written twice is the same.
    name, start_ns
        What viewers call it, and when it began, since 1970.
    called
        What messages call the file; None: its path.

    Attributes
    ----------
    epoch_ns
        Session time that `device_time` is counted from: the first scan's. What was before it is
        shown at it.

    Raises
    ------
    AppError
        The file cannot be begun; from `finish`: it does not hold every row that was sent.
    """

    def __init__(
        self,
        target: Path | str | None,
        blueprint: rrb.Blueprint,
        *,
        recording_id: str,
        name: str,
        start_ns: int,
        called: str | None = None,
        application_id: str = "xethru-hil",
    ) -> None:
        rr.set_strict_mode(True)
        self._target, self._called = target, called or str(target)
        self.epoch_ns = 0
        self.sent: dict[str, int] = defaultdict(int)
        # Never `with` this stream: leaving the block closes the file and drops what follows.
        self._stream: rr.RecordingStream | None = rr.RecordingStream(
            application_id,
            recording_id=recording_id,
            batcher_config=_FILE_BATCHES if isinstance(target, Path) else None,
        )
        self._stream.set_log_time_enabled(False)
        self._stream.set_log_tick_enabled(False)
        if isinstance(target, Path):
            self._begin_file(self._stream, target, blueprint)
        elif target is None:
            self._stream.stdout(default_blueprint=blueprint)
        else:
            self._stream.connect_grpc(target, default_blueprint=blueprint)
        self._stream.send_recording_name(name)
        self._stream.send_recording_start_time_nanos(start_ns)

    def _begin_file(self, stream: rr.RecordingStream, path: Path, blueprint: rrb.Blueprint) -> None:
        reasons: list[str] = []

        def save() -> None:
            try:
                stream.save(path, default_blueprint=blueprint)
            except RuntimeError as error:  # Rerun's own, with the system's message at its end
                reasons.append(str(error).rpartition(": ")[2])

        # On a full disk Rerun's writer may be gone before it has the blueprint, and save waits.
        if not _ends_within(_FILE_LIMIT_S, save):
            rr.unregister_shutdown()  # or it waits once more when the interpreter ends
            reasons.append("it takes nothing; is the disk full?")
        if reasons:
            raise AppError(f"{self._called}: cannot be written: {reasons[0]}")

    @property
    def is_finished(self) -> bool:
        return self._stream is None

    def arrange(self, blueprint: rrb.Blueprint) -> None:
        """Lay out what is sent by now in another way."""
        self._open().send_blueprint(blueprint)

    def static(
        self, entity: str, what: rr.AsComponents | Sequence[rr.DescribedComponentBatch]
    ) -> None:
        """Send what holds at all times."""
        self._open().log(entity, what, static=True)
        self.sent[f"/{entity}{_STATIC}"] += 1

    def rows(self, entity: str, stamps: RowTimes, columns: Iterable[rr.ComponentColumn]) -> None:
        """Send a row for each stamp, all at once."""
        if len(stamps):
            self._open().send_columns(entity, stamps.columns(self.epoch_ns), columns)
            self.sent[f"/{entity}"] += len(stamps)

    def row(self, entity: str, stamps: RowTimes, what: rr.AsComponents) -> None:
        """Send one row, of something that Rerun cannot batch."""
        stream = self._open()
        since_ns = max(stamps.t_ns[0] - self.epoch_ns, 0)
        stream.set_time(DEVICE_TIME, duration=np.timedelta64(since_ns, "ns"))
        stream.set_time(FRAME, sequence=stamps.counters[0])
        if stamps.host_ns[0] is not None:
            stream.set_time(HOST_TIME, timestamp=np.datetime64(stamps.host_ns[0], "ns"))
        stream.log(entity, what)
        stream.reset_time()
        self.sent[f"/{entity}"] += 1

    def finish(self) -> None:
        """Send what is left; count the rows of a file."""
        if self._stream is None:
            return
        stream, self._stream = self._stream, None
        is_file = isinstance(self._target, Path)
        if self._target is None:  # the reader decides how fast
            limit_s = None
        else:
            limit_s = _FILE_LIMIT_S if is_file else _VIEWER_CLOSE_LIMIT_S
        # On a full disk Rerun's writer is gone and disconnect may wait for it without end.
        if not _ends_within(limit_s, stream.disconnect):
            rr.unregister_shutdown()  # or it waits once more when the interpreter ends
            if is_file:
                raise AppError(f"{self._called}: cannot be finished; is the disk full?")
        elif isinstance(self._target, Path):
            self._check_rows(self._target)

    def _check_rows(self, path: Path) -> None:
        try:
            found = count_rows(path)
        except RuntimeError:  # Rerun's own errors about a damaged file
            raise AppError(f"{self._called}: is incomplete; is the disk full?") from None
        for entity, count in self.sent.items():
            if found.get(entity, 0) != count:
                raise AppError(
                    f"{self._called}: holds {found.get(entity, 0)} of {count} rows of {entity}; "
                    "the view is incomplete, the session log is not affected"
                )

    def _open(self) -> rr.RecordingStream:
        if self._stream is None:
            raise ValueError("the view is closed already")
        return self._stream


def _ends_within(limit_s: float | None, function: Callable[[], object]) -> bool:
    """Call a function in a thread that may hang; return whether it ended in time."""
    calling = Thread(target=function, daemon=True)
    calling.start()
    calling.join(limit_s)
    return not calling.is_alive()


def count_rows(path: Path) -> dict[str, int]:
    """Count the rows of every entity of an .rrd file, static ones under a name of their own."""
    rows: dict[str, int] = defaultdict(int)
    with warnings.catch_warnings():
        # of a file without its footer; what is missing then is found by counting
        warnings.simplefilter("ignore", RerunWarning)
        for chunk in RrdReader(path).stream():
            kind = _STATIC if chunk.is_static else ""
            rows[f"{chunk.entity_path}{kind}"] += chunk.num_rows
    return dict(rows)


def screen(points: NDArray[np.float64]) -> NDArray[np.float32]:
    """Turn points or vectors, shape (..., 2), y up, into Rerun's 2D views, y down."""
    flipped: NDArray[np.float32] = (points * np.array([1.0, -1.0])).astype(np.float32)
    return flipped


class _ArrowBatch:
    """A ready arrow array in the shape that rr.ComponentColumn takes."""

    def __init__(self, descriptor: rr.ComponentDescriptor, array: pa.Array) -> None:
        self._descriptor, self._array = descriptor, array

    def component_descriptor(self) -> rr.ComponentDescriptor:
        return self._descriptor

    def as_arrow_array(self) -> pa.Array:
        return self._array


def arrow_column(descriptor: rr.ComponentDescriptor, array: pa.Array) -> rr.ComponentColumn:
    """Return a column of a ready arrow array, one element per row."""
    return rr.ComponentColumn(descriptor, _ArrowBatch(descriptor, array))


def strips_column(strips: NDArray[np.float32]) -> rr.ComponentColumn:
    """Return lines of equally many points, shape (n, n_points, 2), as a column of one line a row.

    Rerun's own conversion looks at every point in Python, which would be most of a view's cost.
    """
    (template,) = rr.LineStrips2D(np.zeros((1, 2, 2), dtype=np.float32)).as_component_batches()
    kind = template.as_arrow_array().type
    n_points = strips.shape[1]
    ends = np.arange(0, (len(strips) + 1) * n_points, n_points, dtype=np.int32)
    points = pa.FixedSizeListArray.from_arrays(pa.array(strips.ravel()), type=kind.value_type)
    lines = pa.ListArray.from_arrays(pa.array(ends), points, type=kind)
    return arrow_column(template.component_descriptor(), lines)


def part(name: str) -> str:
    """Return a user's name as one part of an entity's path, whatever characters are in it."""
    return rr.escape_entity_path_part(name)
