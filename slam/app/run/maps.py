"""Maps of earlier runs: what a command begins with, the file that it writes, what it found.

`--map`, `--start`, `--localise` and `--save-map` of `run`, `demo` and `replay`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TypedDict

import numpy as np

from slam.app.errors import UsageError
from slam.app.run.output import ResultRow, mm_text, note
from slam.app.run.runner import RunRecord
from slam.config import BackEnd, ConfigError, SlamConfig
from slam.geometry import MOST_M, between
from slam.library.saved_map import MapFile, load_map, map_text, parse_map, save_map
from slam.live.errors import AppError
from slam.live.session_records import SessionInfo, SessionObserver, Snapshot
from slam.results import MapChanges, Pipeline, SmoothedRun, StartOnMap


class MapOptions(TypedDict, total=False):
    """The options, as they are given."""

    map_path: Path | None
    start: Sequence[float] | None  # x, y [m] and heading [degrees], map frame
    localise: bool
    save_map: Path | None


@dataclass(frozen=True, slots=True, kw_only=True)
class MapUse:
    """The map that a run begins with, if there is one, and how."""

    file: MapFile | None = None
    on_map: StartOnMap | None = None

    @property
    def text(self) -> str:
        """Return the text of `SessionInfo.map_json`."""
        if self.file is None or self.on_map is None:
            return ""
        how = {"start": self.on_map.pose, "localise": self.on_map.is_fixed}
        return json.dumps({"file": map_text(self.file), **how})


def map_use(config: SlamConfig, options: MapOptions) -> MapUse:
    """Return what the options ask for.

    Raises
    ------
    UsageError
        The map cannot be used, the preset has none, or an option lacks `--map`.
    """
    path = options.get("map_path")
    start, is_fixed = options.get("start"), options.get("localise", False)
    if (path or options.get("save_map")) and config.back_end is not BackEnd.ROBUST:
        raise UsageError("--map, --save-map: preset paper begins and ends without; use robust")
    if path is None:
        if start is not None or is_fixed:
            raise UsageError("--start and --localise are about a map: name it with --map MAP.json")
        return MapUse()
    try:
        file = load_map(path)
    except ConfigError as error:
        raise UsageError(str(error)) from None
    pose = None if start is None else (start[0], start[1], math.radians(start[2]))
    if start is not None and max(map(abs, start)) > MOST_M:
        raise UsageError(f"--start: no number may be more than {MOST_M:g}")
    on_map = StartOnMap(map=file.map, pose=pose, is_fixed=is_fixed)
    return MapUse(file=file, on_map=on_map)


def recorded_use(info: SessionInfo, source: Path) -> MapUse:
    """Return the map that a recorded run began with; AppError if it cannot be read here."""
    if not info.map_json:
        return MapUse()
    try:
        tables = json.loads(info.map_json)
        file = parse_map(tables["file"], f"{source}: its map")
        pose, is_fixed = tables["start"], bool(tables["localise"])
        if pose is not None:
            x, y, heading = map(float, pose)
            if not max(map(abs, (x, y, heading))) <= MOST_M:
                raise ValueError(f"its start is {pose}")
            pose = (x, y, heading)
    except (KeyError, TypeError, ValueError) as error:
        raise AppError(f"{source}: the map that it began with cannot be read: {error}") from None
    return MapUse(file=file, on_map=StartOnMap(map=file.map, pose=pose, is_fixed=is_fixed))


class MapSaver(SessionObserver):
    """Writes the map of a run where its smoothed path is due: at its end, and when it is asked for.

    Without a path it does nothing. What fails does not end the run: `check` raises it afterwards.
    """

    def __init__(self, path: Path | None, slam: Pipeline, info: SessionInfo) -> None:
        self._path, self._slam, self._info = path, slam, info
        self._world_from_map: tuple[float, float, float] | None = None
        self._failure = "no map was saved: the robot is lost, or the run ended within a step"

    def on_snapshot(self, snapshot: Snapshot) -> None:
        if np.isfinite(snapshot.truth).all():
            x, y, heading = snapshot.world_from_map.tolist()
            self._world_from_map = (x, y, heading)

    def on_smoothed(self, smoothed: SmoothedRun) -> None:
        if self._path is None or (saved := self._slam.saved_map()) is None:
            return
        info = self._info
        made = {"scene": info.scene, "preset": info.preset, "states": str(len(smoothed.t_ns))}
        made |= {"seed": str(info.seed)} if info.seed is not None else {}
        made |= {"simulated": "yes"} if info.simulated else {}
        try:
            save_map(self._path, MapFile(map=saved, made=made, world_from_map=self._world_from_map))
        except OSError as error:
            self._failure = f"{self._path}: cannot be written: {error.strerror or error}"
            note(self._failure)
        else:
            self._failure = ""
            note(f"{self._path} has {len(saved.landmarks)} landmarks, {len(saved.walls)} walls")

    def check(self) -> None:
        """Raise AppError if the newest map could not be written."""
        if self._path is not None and self._failure:
            raise AppError(self._failure)


@dataclass(frozen=True, slots=True, kw_only=True)
class MapSummary:
    """What a run made of the map that it was given: key `map` of summary.json.

    Errors are of states that were not reported as lost, in the map frame, not aligned; None without
    truth. `found_after_m` is the way by the wheels until the first such state; None: there is none.
    """

    id: str
    found_after_m: float | None
    lost_share: float
    error_rmse_m: float | None
    error_max_m: float | None
    landmarks: int
    seen: tuple[int, ...]
    gone: tuple[int, ...]
    new: tuple[int, ...]


def map_summary(file: MapFile, changes: MapChanges, record: RunRecord) -> MapSummary:
    states, placed = record.states, ~record.states.lost
    first = int(np.argmax(placed)) if placed.any() else None
    steps_m = np.linalg.norm(np.diff(states.odometry[:, :2], axis=0), axis=1)
    errors_m = np.zeros(0)
    if states.has_truth:
        truth = np.array([between(record.world_from_map, pose) for pose in states.truth])
        errors_m = np.linalg.norm(states.estimate[:, :2] - truth[:, :2], axis=1)[placed]
    return MapSummary(
        id=file.id,
        found_after_m=None if first is None else float(steps_m[:first].sum()),
        lost_share=float(np.mean(~placed)) if len(placed) else 1.0,
        error_rmse_m=float(np.sqrt(np.mean(errors_m**2))) if len(errors_m) else None,
        error_max_m=float(errors_m.max()) if len(errors_m) else None,
        landmarks=len(file.map.landmarks),
        **asdict(changes),
    )


def map_rows(found: MapSummary) -> list[ResultRow]:
    """Return the rows of a run's table about the map that it was given."""
    where = "-"
    if found.found_after_m is not None:
        where = f"{found.found_after_m:.2f} m"
    gone, new = (", ".join(map(str, ids)) or "none" for ids in (found.gone, found.new))
    error: list[ResultRow] = []
    if found.error_rmse_m is not None:  # of a real robot no truth is known
        at_most = f"RMS of positions, not aligned, at most {mm_text(found.error_max_m)}"
        error = [("error on map", mm_text(found.error_rmse_m), at_most)]
    return [
        ("place on map", where, f"way until it was known; lost in {100 * found.lost_share:.1f} %"),
        *error,
        (
            "of the map",
            f"{len(found.seen)} of {found.landmarks}",
            f"landmarks seen again; gone: {gone}; new: {new}",
        ),
    ]
