"""Statistics of a sweep: the numbers of each group of runs."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.special import gammaincinv

from slam.app.sweep.run import LARGEST, SweepRun

Group = Mapping[str, Any]
"""The numbers of a group by the names that they have in the result of a sweep."""

_POSE_DOF = 3
HARMED = 1.2
"""Ratio to the error of the wheels from which on a run is harmed."""


def summarise_groups(runs: Sequence[SweepRun]) -> list[Group]:
    """Return the statistics of each cell but its seeds, in the order they first appear.

    A cell is scene or family of random rooms, preset, settings and stress. Every group has its
    number of runs, how many beat odometry, `median` and `p90` of the errors, medians of the
    landmarks' scores, the share of runs without a duplicate, false landmarks (per run, and how many
    were claimed to be known), the mean NEES over runs (ANEES) and the mean NIS per degree of
    freedom at each of the ten times with their 95 % bands, ATE of the `lagged` and ATE and mean
    NEES of the `smoothed` paths where there are any, and the same errors of the known-association
    bound where it was computed. `ratio` is the spread of each run's ATE over its own odometry's;
    the counts are those of `outcomes`.
    """
    groups = dict.fromkeys(run.group for run in runs)
    return [_group([run for run in runs if run.group == group]) for group in groups]


def _group(runs: Sequence[SweepRun]) -> Group:
    first = runs[0]
    nis = [run.nis_mean for run in runs if run.nis_mean is not None]
    return {
        "scene": first.group[0],
        "preset": first.preset,
        "settings": first.settings,
        "stress": first.stress,
        **outcomes(runs),
        "ratio": spread([min(run.ate_ratio, LARGEST) for run in runs]),
        **{
            name: spread([getattr(run, name) for run in runs])
            for name in ("ate_rmse_m", "ate_icp_rmse_m", "odometry_ate_rmse_m", "final_error_m")
        },
        "landmark_medians": {
            name: _median_of_known([getattr(run.landmarks, name) for run in runs])
            for name in ("precision", "recall", "rmse_m")
        },
        "without_duplicates": statistics.fmean(run.landmarks.duplicates == 0 for run in runs),
        "false_per_run": statistics.fmean(run.false for run in runs),
        "confident_false": sum(run.confident_false for run in runs),
        "realtime_factor": spread([run.realtime_factor for run in runs]),
        **_anees([run.nees_pose for run in runs]),
        "lagged": _lagged(runs),
        "smoothed": _smoothed(runs),
        "nis_mean": statistics.fmean(nis) if nis else None,
        "nis_times": _nis_times(runs),
        "bound": _bound(runs),
    }


def outcomes(runs: Sequence[SweepRun]) -> dict[str, Any]:
    """Return the number of runs, and how many failed in each way.

    ``runs_harmed`` counts those whose causal path is worse than `HARMED` times the wheels, and
    ``runs_lost`` runs without a carry in which SLAM reported the robot as lost; ``carries`` those
    with a carry and three landmarks in view after it, ``carries_in_time`` those of them that were
    found in time. ``confidently_wrong_share`` is that of all states, ``runs_confidently_wrong``
    counts runs with any such state.
    """
    carries = [run.carry.in_time for run in runs if run.carry and run.carry.in_time is not None]
    return {
        "runs": len(runs),
        "runs_below_odometry": sum(run.ate_ratio < 1.0 for run in runs),
        "runs_above_odometry": sum(run.ate_ratio > 1.0 for run in runs),
        "runs_harmed": sum(run.ate_ratio > HARMED for run in runs),
        "runs_lost": sum(run.carry is None and run.lost_share > 0.0 for run in runs),
        "runs_lost_at_end": sum(run.lost_at_end for run in runs),
        "runs_confidently_wrong": sum(run.confidently_wrong_share > 0.0 for run in runs),
        "confidently_wrong_share": sum(run.confidently_wrong_share for run in runs)
        / max(len(runs), 1),
        "carries": len(carries),
        "carries_in_time": sum(carries),
    }


def _anees(values: Sequence[tuple[tuple[float, float], ...]]) -> dict[str, Any]:
    """Return [time, mean over runs] at each of the ten times, and where 95 % of them belong."""
    anees = [
        [statistics.fmean(pair[0] for pair in pairs), statistics.fmean(pair[1] for pair in pairs)]
        for pairs in zip(*values, strict=True)
    ]
    return {
        "anees_pose": anees,
        "anees_mean": statistics.fmean(nees for _, nees in anees),
        "anees_band_95": _band(_POSE_DOF * len(values), len(values)),
    }


def _nis_times(runs: Sequence[SweepRun]) -> list[list[float | None]]:
    """Return [time, NIS per degree of freedom over runs, its band] at each of the ten times.

    None where no run associated anything truly until then.
    """
    rows: list[list[float | None]] = []
    judged = [run.nis_times for run in runs if run.nis_times]
    for cells in zip(*judged, strict=True):
        time_s = statistics.fmean(cell[0] for cell in cells)
        dof = sum(cell[2] for cell in cells)
        if dof:
            total = sum(cell[1] for cell in cells)
            rows.append([time_s, total / dof, *_band(dof, dof)])
        else:
            rows.append([time_s, None, None, None])
    return rows


def _smoothed(runs: Sequence[SweepRun]) -> dict[str, Any] | None:
    """Return the numbers of the smoothed paths; None where no run has one.

    `ratio` is the spread of each run's ATE over its own odometry's.
    """
    ates = [run.smoothed_ate_rmse_m for run in runs if run.smoothed_ate_rmse_m is not None]
    if not ates:
        return None
    ratios = [share for run in runs if (share := run.smoothed_ate_ratio) is not None]
    return {
        "runs": len(ates),
        "ate_rmse_m": spread(ates),
        "ratio": spread([min(share, LARGEST) for share in ratios]),
        **_anees([run.smoothed_nees_pose for run in runs if run.smoothed_nees_pose is not None]),
    }


def _lagged(runs: Sequence[SweepRun]) -> dict[str, Any] | None:
    """Return the numbers of the lagged poses; None where no run has them."""
    ates = [run.lagged_ate_rmse_m for run in runs if run.lagged_ate_rmse_m is not None]
    return {"runs": len(ates), "ate_rmse_m": spread(ates)} if ates else None


def _bound(runs: Sequence[SweepRun]) -> dict[str, Any] | None:
    bounds = [run.bound for run in runs if run.bound is not None]
    if not bounds:
        return None
    return {
        "filtered_ate_rmse_m": spread([bound.filtered_ate_rmse_m for bound in bounds]),
        "smoothed_ate_rmse_m": spread([bound.smoothed_ate_rmse_m for bound in bounds]),
        **_anees([bound.nees_pose for bound in bounds]),
    }


def spread(values: Sequence[float]) -> dict[str, float]:
    return {"median": float(np.median(values)), "p90": float(np.quantile(values, 0.9))}


def _band(dof: int, parts: int) -> list[float]:
    """Return where 95 % of the means over ``parts`` of a chi-square of ``dof`` in all lie.

    The quantile is that of a gamma distribution; scipy.stats would take a second to import.
    """
    return [2.0 * float(gammaincinv(dof / 2, tail)) / parts for tail in (0.025, 0.975)]


def _median_of_known(values: Sequence[float | None]) -> float | None:
    """Return the median of the runs that have the number; None where no run has it."""
    known = [value for value in values if value is not None]
    return statistics.median(known) if known else None


def in_band(group: Group) -> int:
    """Return at how many of the ten times the mean NEES lies in its 95 % band."""
    low, high = group["anees_band_95"]
    return sum(low <= value <= high for _, value in group["anees_pose"])
