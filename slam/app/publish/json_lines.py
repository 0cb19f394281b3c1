"""States of a run as lines of JSON, and the sink that writes them to a file or a pipe."""

from __future__ import annotations

import json
import math
import os
import select
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from stat import S_ISREG

import numpy as np
from numpy.typing import NDArray

from slam.app.errors import UsageError, naming
from slam.app.publish.sinks import Sink
from slam.live.errors import AppError
from slam.live.session_records import SessionInfo, Snapshot
from slam.results import SmoothedRun


class LineMaker:
    """Makes the lines of one run, see docs/robot.md.

    A state has the landmarks that changed since the line before, so lines that follow on each other
    give the whole map. A line that is longer than `most_bytes` is split into several: each is whole
    and has another part of the landmarks, or of the path.

    Parameters
    ----------
    map_id
        Names the map of the run.
    most_bytes
        Of a line with its end; None if there is no limit.
    repeat_ns
        Session time after which all landmarks are given again, for receivers that miss lines or
        come late; None if never.
    """

    def __init__(
        self, map_id: str, most_bytes: int | None = None, repeat_ns: int | None = None
    ) -> None:
        self._map_id, self._most_bytes, self._repeat_ns = map_id, most_bytes, repeat_ns
        self._given: dict[int, bytes] = {}  # numbers of landmarks, by id
        self._whole_ns: int | None = None  # when all of them were given

    def begin_anew(self) -> None:
        """Give all landmarks with the next state: a line was lost."""
        self._whole_ns = None

    def state(self, snapshot: Snapshot) -> Iterator[bytes]:
        """Yield the lines of a state; each has its pose."""
        t_ns, whole_ns = snapshot.t_ns, self._whole_ns
        is_whole = whole_ns is None or (
            # also where session time falls
            self._repeat_ns is not None and not 0 <= t_ns - whole_ns < self._repeat_ns
        )
        if is_whole:
            self._given, self._whole_ns = {}, t_ns
        rows = np.column_stack(
            [snapshot.landmarks_m, snapshot.landmark_covariances_m2.reshape(-1, 4)]
        )
        before, self._given, changed = self._given, {}, []
        for id_, row in zip(snapshot.landmark_ids.tolist(), rows, strict=True):
            self._given[id_] = row.tobytes()
            if before.get(id_) != self._given[id_]:
                numbers = {"position": _numbers(row[:2]), "covariance": _numbers(row[2:])}
                changed.append(_json({"id": id_} | numbers))
        report = None if snapshot.step is None else snapshot.step.report
        head = {
            "kind": "state",
            "map": self._map_id,
            "t_ns": t_ns,
            "pose": _numbers(snapshot.estimate),
            "covariance": _numbers(snapshot.pose_covariance),
            "lost": report is not None and report.lost,
            "removed": [id_ for id_ in before if id_ not in self._given],
        }
        for first, part in self._parts(head, changed):
            yield _line(head | {"reset": is_whole and first == 0}, "landmarks", part)

    def smoothed(self, smoothed: SmoothedRun) -> Iterator[bytes]:
        """Yield the lines of a smoothed path."""
        path = [
            _json([t_ns, *_numbers(pose)])
            for t_ns, pose in zip(smoothed.t_ns.tolist(), smoothed.poses, strict=True)
        ]
        head = {"kind": "smoothed", "map": self._map_id, "states": len(path)}
        for first, part in self._parts(head, path):
            yield _line(head | {"first": first}, "path", part)

    def _parts(
        self, head: Mapping[str, object], texts: Sequence[str]
    ) -> Iterator[tuple[int, Sequence[str]]]:
        """Yield texts so that each line with the head fits, with the index of the first."""
        first, n_bytes = 0, 0
        room = math.inf
        if self._most_bytes is not None:
            room = self._most_bytes - len(_json(head)) - _OTHER_BYTES
        for index, text in enumerate(texts):
            n_bytes += len(text) + 1
            if n_bytes > room and index > first:
                yield first, texts[first:index]
                first, n_bytes = index, len(text) + 1
        yield first, texts[first:]


_OTHER_BYTES = 64
"""Of a line beside its head and its items: two keys, a number, brackets and the end."""


def _numbers(values: NDArray[np.float64]) -> list[float | None]:
    """Return numbers row by row; None for one that JSON does not have."""
    return [value if math.isfinite(value) else None for value in values.ravel().tolist()]


def _json(value: object) -> str:
    return json.dumps(value, separators=(",", ":"), allow_nan=False)


def _line(head: Mapping[str, object], name: str, texts: Sequence[str]) -> bytes:
    return f'{_json(head)[:-1]},"{name}":[{",".join(texts)}]}}\n'.encode("ascii")


class JsonLinesSink(Sink):
    """Writes to standard output (`-`), or to the end of a file or FIFO.

    A line that cannot be written whole is taken out of a file again; the next one has all
    landmarks.
    """

    def __init__(self, text: str) -> None:
        if not text:
            raise UsageError("give jsonl:FILE, or jsonl:- for standard output")
        self._path = Path(text)
        self.takes_stdout = text == "-"
        self._descriptor: int | None = None
        self._is_file = False

    def open(self) -> None:
        """Open the file; a FIFO is opened later, as that waits for its reader."""
        if self.takes_stdout:
            self._descriptor = os.dup(_STDOUT)
        elif not self._path.is_fifo():
            with naming(self._path):
                self._descriptor = self._opened(os.O_RDWR)
                self._is_file = S_ISREG(os.fstat(self._descriptor).st_mode)
                self._go_on_behind_lines()

    def begin(self, info: SessionInfo, start_ns: int, map_id: str) -> None:
        self._lines = LineMaker(map_id)
        if self._descriptor is None:
            self._descriptor = self._opened(os.O_WRONLY)  # else it would be a reader itself

    def on_snapshot(self, snapshot: Snapshot) -> None:
        self._write(self._lines.state(snapshot))

    def on_smoothed(self, smoothed: SmoothedRun) -> None:
        self._write(self._lines.smoothed(smoothed))

    def close(self) -> None:
        if self._descriptor is not None:
            os.close(self._descriptor)

    def _opened(self, way: int) -> int:
        return os.open(self._path, way | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o666)

    def _go_on_behind_lines(self) -> None:
        """End a line that a killed program left; AppError if the file holds something else."""
        assert self._descriptor is not None
        size = os.fstat(self._descriptor).st_size
        if not self._is_file or not size:
            return
        if os.pread(self._descriptor, 1, 0) != b"{":
            os.close(self._descriptor)
            raise AppError(f"{self._path}: holds something else than lines of JSON; give another")
        if os.pread(self._descriptor, 1, size - 1) != b"\n":
            os.write(self._descriptor, b"\n")

    def _write(self, lines: Iterable[bytes]) -> None:
        descriptor = self._descriptor
        assert descriptor is not None
        size = os.fstat(descriptor).st_size
        try:
            for line in lines:
                rest = line
                while rest:
                    rest = rest[_written(descriptor, rest) :]
        except OSError:
            self._lines.begin_anew()
            if self._is_file:
                os.ftruncate(descriptor, size)
            raise


_STDOUT = 1


def _written(descriptor: int, data: bytes) -> int:
    """Return how many bytes a descriptor took; one that does not block is waited for."""
    try:
        return os.write(descriptor, data)
    except BlockingIOError:
        select.select([], [descriptor], [])
        return 0
