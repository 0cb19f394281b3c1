"""The table a person reads after a run in the real world, where nothing true is known."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TextIO

import numpy as np

from slam.app.runner import RunRecord
from slam.app.session import SessionInfo
from slam.app.tum import NS_PER_S

Row = tuple[str, str, str]


def print_run_table(
    info: SessionInfo,
    record: RunRecord,
    *,
    lost_frames: int,
    stream: TextIO,
    also: Sequence[Row] = (),
) -> None:
    """Write what was driven, mapped and lost; `also` are more rows of name, value, note."""
    rows = [*run_rows(info, record, lost_frames), *also]
    what = "emulated radars" if info.simulated else "a real drive"
    title = f"{info.scene}, preset {info.preset}: {what}, with no truth to compare with"
    widths = [max(len(row[column]) for row in rows) for column in (0, 1)]
    rule = "-" * max(len(title), *(sum(widths) + 4 + len(row[2]) for row in rows))
    lines = [f"{name:<{widths[0]}}  {value:>{widths[1]}}  {note}" for name, value, note in rows]
    stream.write("\n".join([title, rule, *(line.rstrip() for line in lines), rule]) + "\n")
    stream.flush()


def run_rows(info: SessionInfo, record: RunRecord, lost_frames: int) -> list[Row]:
    """Return the rows of a run: name, value, note."""
    duration_s = record.duration_ns / NS_PER_S
    speed = f"{record.n_frames} frames used, {lost_frames} lost between counters"
    rows = [("time", f"{duration_s:.1f} s", f"{speed}, {len(info.radars)} radars")]
    if not record.results:
        return [*rows, ("states", "0", "the robot did not move, or no scan could be used")]
    estimate = np.array([result.belief.pose[:2] for result in record.results])
    odometry = np.array([result.odometry_pose[:2] for result in record.results])
    lengths_m = [
        float(np.linalg.norm(np.diff(p, axis=0), axis=1).sum()) for p in (estimate, odometry)
    ]
    belief = record.results[-1].belief
    sigma_m = float(np.sqrt(np.trace(belief.pose_covariance[:2, :2])))
    ids = belief.landmark_ids
    spread = [float(np.sqrt(np.trace(belief.landmark_covariance(row)))) for row in range(len(ids))]
    rows += [
        ("driven", f"{lengths_m[0]:.2f} m", f"{lengths_m[1]:.2f} m by the wheels alone"),
        (
            "last pose",
            f"+-{1e3 * sigma_m:.1f} mm",
            "standard deviation that SLAM believes, map frame",
        ),
        (
            "landmarks",
            f"{len(ids)}",
            f"standard deviation {1e3 * min(spread):.1f} .. {1e3 * max(spread):.1f} mm"
            if spread
            else "none was seen often enough",
        ),
    ]
    return rows
