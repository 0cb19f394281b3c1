"""The one table a person reads after a run."""

from __future__ import annotations

from typing import TextIO

from slam.app.summary import LandmarkSummary, Summary, ratio


def print_table(
    summary: Summary, *, lag_states: int, wall_s: float, lost_frames: int, stream: TextIO
) -> None:
    """Write the table of one simulated run."""
    text = table_text(summary, lag_states=lag_states, wall_s=wall_s, lost_frames=lost_frames)
    stream.write(text)
    stream.flush()


def table_text(summary: Summary, *, lag_states: int, wall_s: float, lost_frames: int) -> str:
    """Return the table of `summary_rows` under its title."""
    rows = summary_rows(summary, lag_states=lag_states, wall_s=wall_s, lost_frames=lost_frames)
    title = f"{summary.scene}, preset {summary.preset}"
    title += ": a drive" if summary.seed is None else f", seed {summary.seed}: simulated numbers"
    widths = [max(len(row[column]) for row in rows) for column in (0, 1)]
    rule = "-" * max(len(title), *(sum(widths) + 4 + len(row[2]) for row in rows))
    lines = [f"{name:<{widths[0]}}  {value:>{widths[1]}}  {note}" for name, value, note in rows]
    return "\n".join([title, rule, *lines, rule]) + "\n"


def summary_rows(
    summary: Summary, *, lag_states: int, wall_s: float, lost_frames: int
) -> list[tuple[str, str, str]]:
    """Return name, value and note: errors in mm with their ratio to odometry's, landmarks, speed.

    `lag_states` is how many newer states had been seen when a state was estimated.
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
        (
            "SLAM ATE, ICP",
            mm_text(summary.ate_icp_rmse_m),
            f"{icp_ratio:.2f} of odometry's ATE; paper's metric: nearest point, no time",
        ),
        ("final error", mm_text(summary.final_error_m), "at the last state, not aligned"),
        _landmark_row(summary.landmarks),
        (
            "speed",
            f"{summary.realtime_factor:.0f} x real time",
            f"{summary.frames} frames in {wall_s:.1f} s, {lost_frames} lost",
        ),
    ]


def _landmark_row(landmarks: LandmarkSummary) -> tuple[str, str, str]:
    if landmarks.true is None:
        return ("landmarks", str(landmarks.estimated), "nobody told what really stands there")
    return (
        "landmarks",
        f"{landmarks.estimated} for {landmarks.true} true",
        f"precision {share_text(landmarks.precision)}, recall {share_text(landmarks.recall)}, "
        f"{landmarks.duplicates} duplicates, rmse {mm_text(landmarks.rmse_m)}",
    )


def mm_text(length_m: float | None) -> str:
    """Return a length in millimetres, a dash where there is none."""
    return "-" if length_m is None else f"{1e3 * length_m:.1f} mm"


def share_text(value: float | None) -> str:
    """Return a share of one, a dash where there is none."""
    return "-" if value is None else f"{value:.2f}"
