"""`uwb-slam sweep`: the same run over scenes, presets and seeds, in process, on joblib."""

from __future__ import annotations

import json
import statistics
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from emulator.odometry import scene_odometry
from emulator.path_lock import PathInUseError, locked
from slam.app.emulated_rig import (
    FRAME_RATE_HZ,
    RAW_CONFIG,
    end_counter,
    open_loopback,
    rig_of,
    scene_and_config,
    true_landmarks_m,
)
from slam.app.errors import AppError, UsageError, naming
from slam.app.evaluation import summarise
from slam.app.odometry import OdometryTrack
from slam.app.report_table import mm_text, share_text
from slam.app.runner import RunRecord, run_slam
from slam.app.stop import StopFlag, StopRequestedError
from slam.app.summary import Summary, ratio
from slam.app.workers import worker_results
from slam.pipeline import UwbRadarSlam

_POSE_DOF = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepOptions:
    """What the command line of `uwb-slam sweep` says."""

    scenes: tuple[str, ...]
    presets: tuple[str, ...]
    n_seeds: int
    jobs: int
    out: Path


def _never() -> None:
    """Do not stop."""


def run_in_process(
    scene: str, preset: str, seed: int, *, check: Callable[[], None] = _never
) -> RunRecord:
    """Do what the demo does without ports and processes: same driver, device, odometry text."""
    loaded, config = scene_and_config(scene, preset)
    trajectory = loaded.trajectory()
    odometry = OdometryTrack.from_lines(scene_odometry(loaded, seed))
    with open_loopback(loaded, seed) as source:
        source.start(RAW_CONFIG, FRAME_RATE_HZ)
        scans = source.scans(end_counter(trajectory.duration_ns), check)
        slam = UwbRadarSlam(config, rig_of(loaded))
        return run_slam(scans, odometry, slam, trajectory.poses)


def run_one(scene: str, preset: str, seed: int, *, check: Callable[[], None] = _never) -> Summary:
    """Run one cell of a sweep and return its numbers.

    Raises
    ------
    AppError
        The scene is too short for a single state.
    """
    loaded, _ = scene_and_config(scene, preset)
    summary = summarise(
        run_in_process(scene, preset, seed, check=check),
        scene=loaded.name,
        preset=preset,
        seed=seed,
        rig=rig_of(loaded),
        true_landmarks_m=true_landmarks_m(loaded),
    )
    if summary is None:
        raise AppError(f"{scene}: too short for SLAM, no state was estimated")
    return summary


def run_sweep(options: SweepOptions, stop: StopFlag) -> None:
    """Run all cells, write `{"runs": [...], "groups": [...]}`, print one line per group.

    OUT.part holds the same for the runs done so far, and becomes OUT at the end.

    Raises
    ------
    AppError
        A wrong name or a file that cannot be written, before the first run; a scene too short; a
        worker process that died.
    StopRequestedError
        A signal arrived; OUT.part stays if it holds a run.
    """
    names = {
        # a wrong name ends the command before any run
        scene_and_config(scene, preset)[0].name
        for scene, preset in product(options.scenes, options.presets)
    }
    if len(names) < len(options.scenes):
        raise UsageError("--scene: two of the scenes have the same name; give each its own")
    if options.out.is_dir():
        raise AppError(f"{options.out}: is a folder, must be a file")
    if options.out.exists() and not options.out.is_file():
        # it would be replaced: as root, even a device for everybody
        raise AppError(f"{options.out}: is no regular file, must be one")
    part = options.out.with_name(f"{options.out.name}.part")
    with ExitStack() as held:
        with naming(part):  # what cannot be written ends the command before any run, too
            part.parent.mkdir(parents=True, exist_ok=True)
            part.touch()
            try:
                held.enter_context(locked(part))
            except PathInUseError:
                raise AppError(
                    f"{part}: another sweep is writing there; choose another --json"
                ) from None
        _run(options, part, stop)


def _run(options: SweepOptions, part: Path, stop: StopFlag) -> None:
    cells = list(product(options.scenes, options.presets, range(options.n_seeds)))
    runs: list[Summary] = []

    def left() -> str:
        return f"; {len(runs)} of {len(cells)} runs are in {part}" if runs else ""

    try:
        _write(part, [])
        for summary in _results(cells, options.jobs, stop):
            runs.append(summary)
            groups = _write(part, runs)
            sys.stderr.write(f"{len(runs)} of {len(cells)}: {_run_line(summary)}\n")
            stop.check()
    except StopRequestedError as stopped:
        raise StopRequestedError(stopped.received, left()) from None
    except BrokenExecutor:
        raise AppError(f"a worker process died; did memory run out?{left()}") from None
    finally:
        if not runs:
            part.unlink()
    part.replace(options.out)
    for group in groups:
        sys.stdout.write(f"{_group_line(group)}\n")


def _write(path: Path, runs: Sequence[Summary]) -> list[dict[str, Any]]:
    """Write runs and the statistics of their groups; return the latter."""
    groups = summarise_groups(runs)
    result = {"runs": [asdict(run) for run in runs], "groups": groups}
    with naming(path):
        path.write_text(json.dumps(result, indent=2, allow_nan=False) + "\n", encoding="ascii")
    return groups


def _run_line(run: Summary) -> str:
    return (
        f"{run.scene}, {run.preset}, seed {run.seed}: ATE {1e3 * run.ate_rmse_m:.1f} mm "
        f"({run.ate_ratio:.2f} of odometry's {1e3 * run.odometry_ate_rmse_m:.1f} mm)"
    )


def _group_line(group: dict[str, Any]) -> str:
    slam, wheels, found = (
        group[key] for key in ("ate_rmse_m", "odometry_ate_rmse_m", "landmark_medians")
    )
    return (
        f"{group['scene']}, preset {group['preset']}, {group['runs']} seeds (simulated): "
        f"SLAM ATE median {1e3 * slam['median']:.1f} mm "
        f"({ratio(slam['median'], wheels['median']):.2f} of odometry's), "
        f"p90 {1e3 * slam['p90']:.1f} mm; odometry median {1e3 * wheels['median']:.1f} mm; "
        f"landmark medians: precision {share_text(found['precision'])}, "
        f"recall {share_text(found['recall'])}, rmse {mm_text(found['rmse_m'])}"
    )


def summarise_groups(runs: Sequence[Summary]) -> list[dict[str, Any]]:
    """Return the statistics of each scene and preset, in the order they first appear.

    Every group has its number of runs, how many beat odometry, `median` and `p90` of the errors,
    medians of the landmarks' scores, and the mean NEES over runs (ANEES) at each of the ten times
    with its 95 % band.
    """
    keys = list(dict.fromkeys((run.scene, run.preset) for run in runs))
    return [_group([run for run in runs if (run.scene, run.preset) == key]) for key in keys]


def _group(runs: Sequence[Summary]) -> dict[str, Any]:
    spread = {
        name: _spread([getattr(run, name) for run in runs])
        for name in ("ate_rmse_m", "ate_icp_rmse_m", "odometry_ate_rmse_m", "final_error_m")
    }
    band = [float(chi2.ppf(tail, _POSE_DOF * len(runs))) / len(runs) for tail in (0.025, 0.975)]
    anees = [
        [statistics.fmean(pair[0] for pair in pairs), statistics.fmean(pair[1] for pair in pairs)]
        for pairs in zip(*(run.nees_pose for run in runs), strict=True)
    ]
    nis = [run.nis_mean for run in runs if run.nis_mean is not None]
    return {
        "scene": runs[0].scene,
        "preset": runs[0].preset,
        "runs": len(runs),
        "runs_below_odometry": sum(run.ate_ratio < 1.0 for run in runs),
        **spread,
        "landmark_medians": {
            name: _median_of_known([getattr(run.landmarks, name) for run in runs])
            for name in ("precision", "recall", "rmse_m")
        },
        "realtime_factor": _spread([run.realtime_factor for run in runs]),
        "anees_pose": anees,
        "anees_band_95": band,
        "nis_mean": statistics.fmean(nis) if nis else None,
    }


def _spread(values: Sequence[float]) -> dict[str, float]:
    return {"median": float(np.median(values)), "p90": float(np.quantile(values, 0.9))}


def _median_of_known(values: Sequence[float | None]) -> float | None:
    """Return the median of the runs that have the number; None where no run has it."""
    known = [value for value in values if value is not None]
    return statistics.median(known) if known else None


def _results(cells: Sequence[tuple[str, str, int]], jobs: int, stop: StopFlag) -> Iterator[Summary]:
    """Run cells one after the other or on worker processes; results in the order of the cells."""
    if jobs == 1:
        for cell in cells:
            yield run_one(*cell, check=stop.check)
        return
    with worker_results(run_one, cells, jobs) as results:
        while True:
            # Nothing is half-written while we wait, so a signal may end the waiting at once.
            with stop.at_once():
                summary = next(results, None)
            if summary is None:
                return
            yield summary
