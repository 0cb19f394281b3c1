"""The results of a run: summary, files and printed table."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slam.app.errors import naming
from slam.app.publish.sinks import Publishing
from slam.app.run.maps import MapSaver, MapSummary, map_rows, map_summary
from slam.app.run.output import ResultRow, print_result, write_json
from slam.app.run.runner import RunRecord, RunSource
from slam.app.run.summary import Summary, summarise
from slam.library.evaluation import LandmarkScore
from slam.live.errors import AppError
from slam.live.odometry_track import NS_PER_S, Trajectory, write_tum
from slam.live.session_records import SessionInfo
from slam.results import SmoothedRun
from xethru_protocol.operating_system import (
    STDERR,
    STDOUT,
    PathInUseError,
    StopFlag,
    StopRequestedError,
    locked,
    written_whole,
)

SESSION, VIEW, REPORT = "session.mcap", "session.rrd", "report.html"
LAGGED, SMOOTHED, IMAGE = "lagged.tum", "smoothed.tum", "image.png"
_TRAJECTORIES = ("estimate.tum", LAGGED, SMOOTHED, "truth.tum", "odometry.tum")
RESULTS = ("map.png", IMAGE, "summary.json", *_TRAJECTORIES)


def finish(
    out: Path,
    source: RunSource,
    record: RunRecord,
    stop: StopFlag,
    also: Sequence[ResultRow] = (),
    *,
    publishing: Publishing,
    map_saver: MapSaver,
) -> None:
    """Write a run's results into an existing folder, then print its table; `also` are more rows.

    The files of an earlier run are removed first, and each new one has its name once it is whole.
    If one cannot be written, the table is printed nevertheless. Where a sink of `publishing` has
    standard output, it is printed on standard error. AppError, too, if its map was not saved.
    """
    stop.check()
    also = [*also, *publishing.rows()]
    outlet = STDERR if publishing.takes_stdout else STDOUT
    summary = summarise(record, source.info, source.rig)
    on_map, changes = None, source.slam.map_changes()
    if source.map_file is not None and changes is not None:
        on_map = map_summary(source.map_file, changes, record)
        also = [*map_rows(on_map), *also]
    try:
        remove_earlier(out, RESULTS)
        _write(out, source.info, record, summary, stop, on_map=on_map)
    except AppError:
        print_result(source, record, summary, also, outlet)
        raise
    with stop.at_once():  # a stream may block
        print_result(source, record, summary, also, outlet)
    map_saver.check()


def _write(
    out: Path,
    info: SessionInfo,
    record: RunRecord,
    summary: Summary | None,
    stop: StopFlag,
    *,
    on_map: MapSummary | None,
) -> None:
    stop.check()
    numbers = summary.numbers() if summary else _numbers_without_truth(info, record)
    if on_map is not None:
        numbers["map"] = asdict(on_map)
    write_json(out / "summary.json", numbers)
    write_trajectories(out, record)
    stop.check()
    if record.last is not None:
        # loads matplotlib, half a second
        from slam.app.run.pictures import draw_map, picture

        with picture(out / "map.png", width_in=9.0, height_in=6.6, dpi=150) as figure:
            draw_map(figure, info, record, summary)
        stop.check()


def write_trajectories(out: Path, record: RunRecord) -> None:
    """Write estimate, odometry and, where there are any, lagged and smoothed poses and truth."""
    states = record.states
    paths = {"estimate": states.estimate, "odometry": states.odometry}
    if states.has_truth:
        paths["truth"] = states.truth
    for name, poses in paths.items():
        write_path(out / f"{name}.tum", states.t_ns, poses)
    if len(record.lagged):
        write_path(out / LAGGED, record.lagged_ns, record.lagged)
    if record.smoothed is not None:
        write_smoothed(out, record.smoothed)


def write_smoothed(out: Path, smoothed: SmoothedRun) -> None:
    write_path(out / SMOOTHED, smoothed.t_ns, smoothed.poses)


def write_path(path: Path, t_ns: NDArray[np.int64], poses: NDArray[np.float64]) -> None:
    """Write poses (n, 3) at stamps as TUM text; AppError if the file cannot be written."""
    with naming(path), written_whole(path) as fresh:
        write_tum(fresh, Trajectory(stamps_ns=t_ns, poses=poses))


def _numbers_without_truth(info: SessionInfo, record: RunRecord) -> dict[str, object]:
    """Return the numbers of summary.json with None for everything that needs the truth."""
    duration_s = record.duration_ns / NS_PER_S
    n_landmarks = 0 if record.last is None else len(record.last.landmark_ids)
    unknown: dict[str, object] = {row.name: None for row in fields(Summary)}
    del unknown["nis_times"]
    known = {
        "scene": info.scene,
        "preset": info.preset,
        "seed": info.seed,
        "frames": record.n_frames,
        "duration_s": duration_s,
        "realtime_factor": duration_s / record.wall_s,
        "landmarks": {row.name: None for row in fields(LandmarkScore)} | {"estimated": n_landmarks},
    }
    return unknown | known


@contextmanager
def made_folder(folder: Path) -> Iterator[None]:
    """Make a folder; at the end it is removed, as those above it, if this made it and it is empty.

    AppError if it cannot be made.
    """
    made = [each for each in (folder, *folder.parents) if not each.exists()]
    with naming(folder):
        folder.mkdir(parents=True, exist_ok=True)
    try:
        yield
    finally:
        with suppress(OSError):  # from here on they are not empty
            for each in made:
                each.rmdir()


def hold_folder(out: Path, held: ExitStack) -> None:
    """Make a folder and lock it; the results of an earlier run stay until there are others."""
    held.enter_context(made_folder(out))
    with naming(out):
        try:
            held.enter_context(locked(out))
        except PathInUseError:
            raise AppError(
                f"{out}: another run is writing there; wait for its end or choose another --out"
            ) from None


def remove_earlier(out: Path, names: Sequence[str]) -> None:
    """Remove an earlier run's files from a folder so that no two runs mix."""
    for name in names:
        with naming(path := out / name):
            path.unlink(missing_ok=True)


@contextmanager
def saying_what_is_left(kept: str) -> Iterator[None]:
    """Add to the message of a stop by a signal what was recorded until then."""
    try:
        yield
    except StopRequestedError as stopped:
        raise StopRequestedError(stopped.received, kept) from None
