"""What a run or a replay leaves in its folder: numbers, trajectories, a map."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from emulator.path_lock import PathInUseError, locked
from slam.app.errors import AppError, naming
from slam.app.evaluation import summarise
from slam.app.runner import RunRecord
from slam.app.session import SessionInfo
from slam.app.stop import StopRequestedError
from slam.app.summary import Summary
from slam.app.tum import NS_PER_S, Trajectory, write_tum
from slam.geometry import Rig

RESULTS = ("map.png", "summary.json", "estimate.tum", "truth.tum", "odometry.tum")


def has_truth(record: RunRecord) -> bool:
    """Return whether the true pose is known at every state, and there is a state."""
    return len(record.truth) > 0 and bool(np.isfinite(record.truth).all())


def write_results(out: Path, info: SessionInfo, record: RunRecord, rig: Rig) -> Summary | None:
    """Write trajectories, summary.json and map.png; return the numbers where truth is known.

    Parameters
    ----------
    out
        An existing folder.
    info, record, rig
        The run.
    """
    summary = None
    if has_truth(record):
        summary = summarise(
            record,
            scene=info.scene,
            preset=info.preset,
            seed=info.seed,
            rig=rig,
            true_landmarks_m=info.true_landmarks_m,
        )
        if summary is not None and not info.simulated and not len(info.true_landmarks_m):
            unknown = replace(summary.landmarks, true=None, precision=None, recall=None)
            summary = replace(summary, landmarks=unknown)
    text = summary.to_json() if summary else _summary_without_truth(info, record)
    with naming(path := out / "summary.json"):
        path.write_text(text + "\n", encoding="ascii")
    write_trajectories(out, record)
    if record.results:
        from slam.app.map_picture import draw_map  # half a second; nobody waits for it before

        with naming(path := out / "map.png"):
            draw_map(path, info, record, summary, info.outlines_m)
    return summary


def write_trajectories(out: Path, record: RunRecord) -> None:
    """Write estimate, odometry and, where it is known, truth at the stamps of SLAM's states."""
    stamps_ns = np.array([result.t_ns for result in record.results], dtype=np.int64)
    paths = {
        "estimate": np.array([result.belief.pose for result in record.results]),
        "odometry": np.array([result.odometry_pose for result in record.results]),
    }
    if has_truth(record):
        paths["truth"] = record.truth
    for name, poses in paths.items():
        with naming(path := out / f"{name}.tum"):
            write_tum(path, Trajectory(stamps_ns=stamps_ns, poses=poses.reshape(-1, 3)))


def _summary_without_truth(info: SessionInfo, record: RunRecord) -> str:
    """Return the text of summary.json with null for everything that needs the truth."""
    duration_s = record.duration_ns / NS_PER_S
    n_landmarks = len(record.results[-1].belief.landmark_ids) if record.results else 0
    fields = {
        "scene": info.scene,
        "preset": info.preset,
        "seed": info.seed,
        "frames": record.n_frames,
        "duration_s": duration_s,
        "realtime_factor": duration_s / record.wall_s,
        "ate_rmse_m": None,
        "ate_icp_rmse_m": None,
        "odometry_ate_rmse_m": None,
        "final_error_m": None,
        "landmarks": {
            "true": None,
            "estimated": n_landmarks,
            "precision": None,
            "recall": None,
            "duplicates": None,
            "rmse_m": None,
        },
        "nees_pose": None,
        "nis_mean": None,
    }
    return json.dumps(fields, indent=2, allow_nan=False)


def prepare_folder(out: Path, names: tuple[str, ...], held: ExitStack) -> None:
    """Make the folder, hold it, and remove an earlier run's files so that no two runs mix.

    Raises
    ------
    AppError
        It cannot be made, or another run writes there.
    """
    with naming(out):
        out.mkdir(parents=True, exist_ok=True)
        try:
            held.enter_context(locked(out))
        except PathInUseError:
            raise AppError(
                f"{out}: another run is writing there; wait for its end or choose another --out"
            ) from None
        for name in names:
            (out / name).unlink(missing_ok=True)


@contextmanager
def saying_what_is_left(kept: str) -> Iterator[None]:
    """Let a stop by a signal say what was recorded until then."""
    try:
        yield
    except StopRequestedError as stopped:
        raise StopRequestedError(stopped.received, kept) from None
