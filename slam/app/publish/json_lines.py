"""States of a run as lines of JSON, and the sink that writes them to a file or a pipe."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from stat import S_ISREG

import numpy as np
from numpy.typing import NDArray

from slam.app.errors import UsageError, naming
from slam.app.publish.sinks import Sink
from slam.live.errors import AppError
from slam.live.session.reader import begins_with
from slam.live.session_records import SessionInfo, Snapshot
from slam.results import SmoothedRun


class LineMaker:
    """Makes the lines of one run, see docs/robot.md.

    A state has the landmarks that changed since the line before, so lines that follow on each other
    give the whole map. A line that is longer than `most_bytes` is split into several: each is whole
    and has another part of the landmarks, or of the path.

    All landmarks are given again after a session time of `repeat_ns`, for receivers that miss lines
    or come late, and where session time falls.
    """

    def __init__(
        self, map_id: str, most_bytes: float = math.inf, repeat_ns: float = math.inf
    ) -> None:
        self._map_id, self._most_bytes, self._repeat_ns = map_id, most_bytes, repeat_ns
        self._given: dict[int, bytes] = {}  # numbers of landmarks, by id
        self._whole_ns = -math.inf  # when all of them were given

    def begin_anew(self) -> None:
        """Give all landmarks with the next state: a line was lost."""
        self._whole_ns = -math.inf

    def state(self, snapshot: Snapshot) -> Iterator[bytes]:
        """Yield the lines of a state; each has its pose."""
        is_whole = not 0 <= snapshot.t_ns - self._whole_ns < self._repeat_ns
        if is_whole:
            self._given, self._whole_ns = {}, snapshot.t_ns
        rows = np.column_stack(
            [snapshot.landmarks_m, snapshot.landmark_covariances_m2.reshape(-1, 4)]
        )
        before, self._given, changed = self._given, {}, []
        for id_, row in zip(snapshot.landmark_ids.tolist(), rows, strict=True):
            self._given[id_] = row.tobytes()
            if before.get(id_) != self._given[id_]:
                numbers = {"position": _numbers(row[:2]), "covariance": _numbers(row[2:])}
                changed.append(_json({"id": id_} | numbers))
        head = {
            "kind": "state",
            "map": self._map_id,
            "t_ns": snapshot.t_ns,
            "pose": _numbers(snapshot.estimate),
            "covariance": _numbers(snapshot.pose_covariance),
            "lost": snapshot.step is not None and snapshot.step.is_lost,
        }
        lagged = () if snapshot.step is None else snapshot.step.lagged
        once = {
            "lagged": [[one.t_ns, *_numbers(one.pose)] for one in lagged],
            "removed": [id_ for id_ in before if id_ not in self._given],
            "reset": is_whole,
        }
        for first, part in self._parts(head | once, changed):
            rest = once if first == 0 else {"lagged": [], "removed": [], "reset": False}
            yield _line(head | rest, "landmarks", part)

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


class LinesSink(Sink):
    """Gives the lines of a run to `write`; after one that raises, all landmarks come again."""

    limits: tuple[float, float] = (math.inf, math.inf)
    """Most bytes of a line, and after what session time all landmarks come again [ns]."""

    def begin(self, info: SessionInfo, start_ns: int, map_id: str) -> None:
        self._lines = LineMaker(map_id, *self.limits)

    def on_snapshot(self, snapshot: Snapshot) -> None:
        self._give(self._lines.state(snapshot))

    def on_smoothed(self, smoothed: SmoothedRun) -> None:
        self._give(self._lines.smoothed(smoothed))

    def _give(self, lines: Iterable[bytes]) -> None:
        try:
            for line in lines:
                self.write(line)
        except OSError:
            self._lines.begin_anew()
            raise

    def write(self, line: bytes) -> None:
        """Write or send one line."""
        raise NotImplementedError


_STDOUT = 1
_APPENDING = os.O_WRONLY | os.O_APPEND | os.O_CLOEXEC


class JsonLinesSink(LinesSink):
    """Writes to standard output (`-`), or to the end of a file or FIFO.

    A line that cannot be written whole is taken out of a file again.
    """

    def __init__(self, text: str) -> None:
        if not text:
            raise UsageError("give jsonl:FILE, or jsonl:- for standard output")
        self._path = Path(text)
        self.takes_stdout = text == "-"
        self._descriptor: int | None = None

    def open(self) -> None:
        """Open the file; a FIFO is opened later, as that waits for its reader."""
        if self.takes_stdout:
            self._descriptor = os.dup(_STDOUT)
            os.set_blocking(self._descriptor, True)
        elif not self._path.is_fifo():
            is_empty = not self._path.is_file() or self._path.stat().st_size == 0
            if not is_empty and not begins_with(self._path, b"{"):
                raise AppError(f"{self._path}: holds no lines of JSON; give another file")
            with naming(self._path):
                self._descriptor = os.open(self._path, _APPENDING | os.O_CREAT, 0o666)

    def begin(self, info: SessionInfo, start_ns: int, map_id: str) -> None:
        super().begin(info, start_ns, map_id)
        if self._descriptor is None:
            self._descriptor = os.open(self._path, _APPENDING)

    def write(self, line: bytes) -> None:
        assert self._descriptor is not None
        status, rest = os.fstat(self._descriptor), line
        try:
            while rest:
                rest = rest[os.write(self._descriptor, rest) :]
        except OSError:
            if S_ISREG(status.st_mode):
                os.ftruncate(self._descriptor, status.st_size)
            raise

    def close(self) -> None:
        if self._descriptor is not None:
            os.close(self._descriptor)
