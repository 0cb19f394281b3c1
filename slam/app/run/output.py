"""Progress lines, tables and JSON files."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slam.app.errors import naming
from slam.app.run.runner import RunRecord, RunSource
from slam.app.run.summary import Summary, ratio
from slam.geometry import Rig, transform
from slam.library.evaluation import MIN_POSES, LandmarkScore
from slam.live.odometry_track import NS_PER_S
from slam.live.session_records import LogLine, Scan, SessionInfo, SessionObserver, Snapshot
from xethru_protocol.operating_system import (
    STDERR,
    STDOUT,
    Outlet,
    each_line,
    one_line,
    written_whole,
)

_LIVE_PERIOD_S = 0.2
_PLAIN_PERIOD_S = 10.0
_NO_RADARS = frozenset({"odometry", "run"})
"""Other subjects of log lines."""
_FAR_SIGMAS = 3.0
"""How far a constant may be from its stated value: where the standard deviation is right, one in
370 is farther, so of the seven constants of four radars one in 53 runs."""
_WHEELS = (
    ("distances", 100.0, "%", "the radius of the wheels", "scale_sigma"),
    ("turns", 100.0, "%", "the track width", "turn_scale_sigma"),
    ("curvature", 1.0, " rad/m", "the radii of the wheels", "curvature_sigma_rad_per_m"),
)
"""Of s, w and kappa of the wheels: what they are errors of, factor and unit in which they are
written, what may be wrong, and the key of their standard deviation in the rig file."""


class RunProgress(SessionObserver):
    """Shows session time, frames/s per radar, pose error against truth, landmarks, lost frames.

    One line is rewritten on a terminal. A run never waits for standard error: a line is left out
    while it blocks, and warnings are written once it takes text again.

    Parameters
    ----------
    lost_frames, also
        Called when a line is shown; `also` returns text to add.
    end_ns
        Session time at which the run ends; None if unknown.
    """

    def __init__(
        self,
        info: SessionInfo,
        lost_frames: Callable[[], int],
        *,
        end_ns: int | None = None,
        also: Callable[[], str] = str,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._n_radars, self._end_ns = max(len(info.radars), 1), end_ns
        self._lost_frames, self._also, self._clock = lost_frames, also, clock
        self._is_terminal = STDERR.is_terminal
        # carriage return and erase: the live line stays one line
        self._erased = "\r\x1b[K" if self._is_terminal else ""
        self._period_s = _LIVE_PERIOD_S if self._is_terminal else _PLAIN_PERIOD_S
        self._started = self._shown = clock()
        self._n_frames = self._t_ns = 0
        self._start_ns: int | None = None  # in the real world session time begins anywhere
        self._snapshot: Snapshot | None = None

    def on_scan(self, scan: Scan) -> None:
        self._n_frames += len(scan.frames)
        if self._start_ns is None:
            self._start_ns = scan.t_ns
        self._t_ns = scan.t_ns - self._start_ns
        if self._clock() - self._shown >= self._period_s:
            self._show()

    def on_snapshot(self, snapshot: Snapshot) -> None:
        self._snapshot = snapshot

    def on_log(self, line: LogLine) -> None:
        if line.warning:
            who = line.radar if line.radar in _NO_RADARS else f"radar {line.radar}"
            STDERR.write_soon(self._erased + one_line(f"warning: {who}: {line.text}") + "\n")

    def close(self) -> None:
        """Show the last line and leave it standing."""
        self._show()
        if self._is_terminal:
            STDERR.write_soon("\n")

    def line(self) -> str:
        wall_s = max(self._clock() - self._started, 1e-9)
        rate = self._n_frames / self._n_radars / wall_s
        text = f"scene time {self._t_ns / NS_PER_S:6.1f} "
        if self._end_ns is None:
            text += "s"
        else:
            text += f"of {(self._end_ns - (self._start_ns or 0)) / NS_PER_S:.1f} s"
        text += f"  {rate:5.0f} frames/s per radar"
        if self._snapshot is not None:
            state = self._snapshot
            estimate = transform(state.world_from_map, state.estimate[:2])
            error_m = float(np.linalg.norm(estimate - state.truth[:2]))
            if not np.isnan(error_m):
                text += f"  pose error {1e3 * error_m:6.1f} mm"
            text += f"  {len(state.landmark_ids)} landmarks"
        return f"{text}  {self._lost_frames()} frames lost{self._also()}"

    def _show(self) -> None:
        self._shown = self._clock()
        if self._is_terminal:  # erasing reaches one row only, so the line must not wrap
            line = self.line()[: shutil.get_terminal_size().columns - 1]
            STDERR.offer(self._erased + line)
        else:
            STDERR.offer(f"{self.line()}\n")


def note(text: str) -> None:
    """Print a line about the program itself; like all that prints here, it never raises."""
    print_progress(f"uwb-slam: {text}")


def print_progress(line: str) -> None:
    """Print a line on standard error; while that blocks, it is kept and the program goes on."""
    STDERR.write_soon(f"{one_line(line)}\n")


def print_text(lines: str) -> None:
    """Print lines of a result on standard output, after its files are written.

    What cannot be printed does not raise here: the exit code reports it.
    """
    STDOUT.write(each_line(lines) + "\n")


def write_json(path: Path, numbers: Mapping[str, object]) -> None:
    """Write numbers without NaN; raise AppError if the file cannot be written."""
    text = json.dumps(numbers, indent=2, allow_nan=False)
    with naming(path), written_whole(path) as fresh:
        fresh.write_text(text + "\n", encoding="ascii")


ResultRow = tuple[str, str, str]
"""Name, value and note."""


def print_table(title: str, header: Sequence[str] | None, rows: Sequence[Sequence[str]]) -> None:
    print_text(table_text(title, header, rows).rstrip("\n"))


def table_text(title: str, header: Sequence[str] | None, rows: Sequence[Sequence[str]]) -> str:
    """Return a table: the first column to the left, others to the right.

    Without a header, rows are a `ResultRow` each, whose note is to the left, too.
    """
    left = {0, 2} if header is None else {0}
    title = one_line(title)
    table = [[*map(one_line, row)] for row in (*([] if header is None else [header]), *rows)]
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    lines = [
        "  ".join(
            cell.ljust(width) if column in left else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in table
    ]
    rule = "-" * max(map(len, [title, *lines]))
    if header is not None:
        lines.insert(1, rule)
    return "\n".join([title, rule, *lines, rule]) + "\n"


def print_result(
    source: RunSource,
    record: RunRecord,
    summary: Summary | None,
    also: Sequence[ResultRow] = (),
    outlet: Outlet = STDOUT,
) -> None:
    """Print the table of a run; without `summary` no truth is known. `also` are more rows."""
    info, lost_frames = source.info, source.lost_frames()
    if summary is None:
        what = "emulated radars" if info.simulated else "a real drive"
        title = f"{info.scene}, preset {info.preset}: {what}, with no truth to compare with"
        rows = run_rows(info, record, lost_frames)
    else:
        kind = ": a drive" if summary.seed is None else f", seed {summary.seed}: simulated numbers"
        title = f"{summary.scene}, preset {summary.preset}{kind}"
        lag_states = source.slam.config.window.size - 1
        rows = summary_rows(
            summary, lag_states=lag_states, wall_s=record.wall_s, lost_frames=lost_frames
        )
    outlet.write(table_text(title, None, [*rows, *also]))
    smoothed = record.whole_smoothed
    if smoothed is not None and smoothed.constants is not None:
        for line in constant_warnings(source.rig, smoothed.constants):
            print_progress(line)


def constant_warnings(rig: Rig, constants: NDArray[np.float64]) -> list[str]:
    """Return a line for each constant of `SmoothedRun.constants` that is far from what was stated.

    `rig` has the radars as they were stated. The covariances of a run take the statement for true,
    so they are too small until enough was measured.
    """
    stated = [
        (
            f"odometry: its error of {what}",
            0.0,
            factor,
            unit,
            f"correct {cause} in the odometry, or raise {key} under [wheels] of the rig file",
        )
        for what, factor, unit, cause, key in _WHEELS
    ]
    remedy = "set range_offset_m in the rig file to that, or run uwb-slam calibrate"
    for mount in rig.mounts:
        what = f"radar {mount.name}: its range offset"
        stated.append((what, mount.range_offset_m, 1.0, " m", remedy))
    warnings = []
    for (away, sigma), (what, mean, factor, unit, remedy) in zip(
        constants.tolist(), stated, strict=True
    ):
        if abs(away) > _FAR_SIGMAS * sigma:
            found, said, by = (f"{factor * one:.3g}{unit}" for one in (mean + away, mean, sigma))
            warnings.append(
                f"warning: {what} was found to be {found}, {abs(away) / sigma:.1f} standard "
                f"deviations from the stated {said} +- {by}: the covariances of the first poses "
                f"are too small; {remedy}"
            )
    return warnings


def summary_rows(
    summary: Summary, *, lag_states: int, wall_s: float, lost_frames: int
) -> list[ResultRow]:
    """Return errors in mm with their ratio to odometry's, landmarks and speed.

    `lag_states` is the number of newer states that a filtered state has seen.
    """
    lag = f"filtered, {lag_states} states late" if lag_states else "causal"
    icp_ratio = ratio(summary.ate_icp_rmse_m, summary.odometry_ate_rmse_m)
    return [
        ("odometry ATE", mm_text(summary.odometry_ate_rmse_m), "wheels alone, SE(2)-aligned"),
        (
            "SLAM ATE",
            mm_text(summary.ate_rmse_m),
            f"{summary.ate_ratio:.2f} of odometry's, SE(2)-aligned, {lag}",
        ),
        *_lagged_and_smoothed_rows(summary),
        (
            "SLAM ATE, ICP",
            mm_text(summary.ate_icp_rmse_m),
            f"{icp_ratio:.2f} of odometry's ATE; paper's metric: nearest point, no time",
        ),
        ("final error", mm_text(summary.final_error_m), "at the last state, not aligned"),
        *_landmark_rows(summary.landmarks),
        (
            "speed",
            f"{summary.realtime_factor:.0f} x real time",
            f"{summary.frames} frames in {wall_s:.1f} s, {lost_frames} lost",
        ),
    ]


def _lagged_and_smoothed_rows(summary: Summary) -> list[ResultRow]:
    """Return the rows of lagged and of smoothed poses, as far as there are such."""
    rows, share = list[ResultRow](), summary.smoothed_ate_ratio
    if summary.lagged_ate_rmse_m is not None:
        note = "SE(2)-aligned, a pose every 10 cm as known 2 m later"
        rows.append(("lagged ATE", mm_text(summary.lagged_ate_rmse_m), note))
    if share is not None:
        note = f"{share:.2f} of odometry's, SE(2)-aligned, all states solved for at the end"
        rows.append(("smoothed ATE", mm_text(summary.smoothed_ate_rmse_m), note))
    return rows


def _landmark_rows(landmarks: LandmarkScore) -> list[ResultRow]:
    if landmarks.true is None:
        return [("landmarks", str(landmarks.estimated), "the true ones are unknown")]
    return [
        (
            "landmarks",
            f"{landmarks.estimated} for {landmarks.true} true",
            f"precision {share_text(landmarks.precision)}, {landmarks.duplicates} duplicates, "
            f"rmse {mm_text(landmarks.rmse_m)}",
        ),
        (
            "observable",
            f"{landmarks.observable} of {landmarks.true} true",
            f"recall {share_text(landmarks.recall)} of those in view of a radar from "
            f"{MIN_POSES} poses or more",
        ),
    ]


def mm_text(length_m: float | None) -> str:
    return "-" if length_m is None else f"{1e3 * length_m:.1f} mm"


def share_text(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def run_rows(info: SessionInfo, record: RunRecord, lost_frames: int) -> list[ResultRow]:
    """Return what is known without the truth: time, way driven, last pose and landmarks."""
    duration_s = record.duration_ns / NS_PER_S
    speed = f"{record.n_frames} frames used, {lost_frames} lost between counters"
    rows = [("time", f"{duration_s:.1f} s", f"{speed}, {len(info.radars)} radars")]
    states, last = record.states, record.last
    if last is None:
        return [*rows, ("states", "0", "the robot did not move, or no scan could be used")]
    wheels_m = float(np.linalg.norm(np.diff(states.odometry[:, :2], axis=0), axis=1).sum())
    if (smoothed := record.whole_smoothed) is not None:
        apart_m = np.linalg.norm(smoothed.poses[:, :2] - states.estimate[:, :2], axis=1)
        placed_m = apart_m[~states.lost]
        rms_m = float(np.sqrt(np.mean(placed_m**2))) if len(placed_m) else None
        note = "RMS distance of the causal path from the one solved for at the end"
        if states.lost.any():
            note += ", where it was not lost"
        rows.append(("smoothed", mm_text(rms_m), note))
    sigma_m = float(np.sqrt(np.trace(last.pose_covariance[:2, :2])))
    spread = [float(np.sqrt(np.trace(each))) for each in last.landmark_covariances_m2]
    rows += [
        ("driven", f"{states.driven_m:.2f} m", f"{wheels_m:.2f} m by the wheels alone"),
        (
            "last pose",
            f"+-{1e3 * sigma_m:.1f} mm",
            "standard deviation that SLAM believes, map frame",
        ),
        (
            "landmarks",
            f"{len(spread)}",
            f"standard deviation {1e3 * min(spread):.1f} .. {1e3 * max(spread):.1f} mm"
            if spread
            else "none was seen often enough",
        ),
    ]
    return rows
