"""The one table a person reads after a run."""

from __future__ import annotations

from typing import TextIO

from slam.app.summary import Summary


def print_table(summary: Summary, *, wall_s: float, lost_frames: int, stream: TextIO) -> None:
    """Write the table of one simulated run."""
    stream.write(table_text(summary, wall_s=wall_s, lost_frames=lost_frames))
    stream.flush()


def table_text(summary: Summary, *, wall_s: float, lost_frames: int) -> str:
    """Return the table: errors in mm with their ratio to odometry's, landmarks, speed."""
    landmarks = summary.landmarks
    rows = [
        ("odometry ATE", _mm(summary.odometry_ate_rmse_m), "wheels alone, SE(2)-aligned"),
        (
            "SLAM ATE",
            _mm(summary.ate_rmse_m),
            f"{summary.ate_ratio:.2f} of odometry's, SE(2)-aligned, causal",
        ),
        (
            "SLAM ATE, ICP",
            _mm(summary.ate_icp_rmse_m),
            "the paper's metric: nearest point of the path, no time",
        ),
        ("final error", _mm(summary.final_error_m), "at the end of the run, not aligned"),
        (
            "landmarks",
            f"{landmarks.estimated} of {landmarks.true}",
            f"precision {_share(landmarks.precision)}, recall {_share(landmarks.recall)}, "
            f"{landmarks.duplicates} duplicates, rmse {_mm(landmarks.rmse_m)}",
        ),
        (
            "speed",
            f"{summary.realtime_factor:.0f} x real time",
            f"{summary.frames} frames in {wall_s:.1f} s, {lost_frames} lost",
        ),
    ]
    title = f"{summary.scene}, preset {summary.preset}, seed {summary.seed}: simulated numbers"
    widths = [max(len(row[column]) for row in rows) for column in (0, 1)]
    rule = "-" * max(len(title), *(sum(widths) + 4 + len(row[2]) for row in rows))
    lines = [f"{name:<{widths[0]}}  {value:>{widths[1]}}  {note}" for name, value, note in rows]
    return "\n".join([title, rule, *lines, rule]) + "\n"


def _mm(length_m: float | None) -> str:
    return "-" if length_m is None else f"{1e3 * length_m:.1f} mm"


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
