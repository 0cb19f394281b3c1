"""Statistics of a sweep, and its tables."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.special import gammaincinv

from slam.app.run.evaluation import ratio
from slam.app.run.output import mm_text, share_text
from slam.app.sweep import CLEAN
from slam.app.sweep.places import FOUND_WITHIN_S
from slam.app.sweep.run import LARGEST, SweepRun

_POSE_DOF = 3
HARMED = 1.2
"""Ratio to the error of the wheels from which on a run is harmed."""


def summarise_groups(runs: Sequence[SweepRun]) -> list[dict[str, Any]]:
    """Return the statistics of each cell but its seeds, in the order they first appear.

    A cell is scene or family of random rooms, preset, settings and stress. Every group has its
    number of runs, how many beat odometry, `median` and `p90` of the errors, medians of the
    landmarks' scores, the share of runs without a duplicate, false landmarks (per run, and how many
    were claimed to be known), the mean NEES over runs (ANEES) and the mean NIS per degree of
    freedom at each of the ten times with their 95 % bands, ATE and mean NEES of the `smoothed`
    paths where there are any, and the same errors of the known-association bound where it was
    computed. `ratio` is the spread of each run's ATE over its own odometry's; the counts are those
    of `outcomes`.
    """
    groups = dict.fromkeys(run.group for run in runs)
    return [_group([run for run in runs if run.group == group]) for group in groups]


def group_name(group: dict[str, Any]) -> str:
    """Return what a group is called: scene, preset, settings and stress if there are any."""
    variant = settings_text(group["settings"], group["stress"])
    return f"{group['scene']}, preset {group['preset']}{variant}"


def settings_text(settings: Mapping[str, str], stress: str = CLEAN) -> str:
    """Return what a name continues with, empty for clean runs of a preset as it is."""
    text = "".join(f", {key}={value}" for key, value in settings.items())
    return text if stress == CLEAN else f"{text}, stress {stress}"


def group_line(group: dict[str, Any]) -> str:
    """Return a group in one line of text."""
    estimate, wheels, found = (
        group[key] for key in ("ate_rmse_m", "odometry_ate_rmse_m", "landmark_medians")
    )
    beside = ""
    if group["bound"] is not None:
        filtered, smoothed = (
            mm_text(group["bound"][f"{path}_ate_rmse_m"]["median"])
            for path in ("filtered", "smoothed")
        )
        beside = f"; known association: filtered median {filtered}, smoothed {smoothed}"
    at_the_end = ""
    if group["smoothed"] is not None:
        ate, share = group["smoothed"]["ate_rmse_m"], group["smoothed"]["ratio"]
        at_the_end = (
            f", smoothed median {mm_text(ate['median'])} ({share['median']:.2f} of odometry's), "
            f"p90 {mm_text(ate['p90'])}"
        )
    return (
        f"{group_name(group)}, {group['runs']} runs (simulated): "
        f"SLAM ATE median {mm_text(estimate['median'])} "
        f"({group['ratio']['median']:.2f} of odometry's), "
        f"p90 {mm_text(estimate['p90'])}{at_the_end}; "
        f"odometry median {mm_text(wheels['median'])}{beside}; "
        f"landmark medians: precision {share_text(found['precision'])}, "
        f"recall {share_text(found['recall'])}, rmse {mm_text(found['rmse_m'])}; "
        f"no duplicate in {group['without_duplicates']:.0%}, "
        f"{group['confident_false']} confident false landmarks; "
        f"{outcomes_text(group)}; "
        f"mean NEES {group['anees_mean']:.2f}, its means over runs {in_band_text(group)}"
    )


def outcomes_text(counts: Mapping[str, Any]) -> str:
    """Return in words how many runs failed, of a group or of `outcomes`."""
    n_runs = counts["runs"]
    parts = [
        f"{counts[key]} of {n_runs} runs {what}"
        for key, what in (
            ("runs_above_odometry", "worse than their wheels"),
            ("runs_harmed", f"worse than {HARMED:g} x their wheels"),
            ("runs_lost", "lost without a carry"),
            ("runs_lost_at_end", "lost at the end"),
            ("runs_confidently_wrong", "confidently wrong"),
        )
    ]
    parts[-1] += f" ({counts['confidently_wrong_share']:.2%} of the time)"
    if counts["carries"]:
        parts.append(
            f"{counts['carries_in_time']} of {counts['carries']} carries found within "
            f"{FOUND_WITHIN_S:g} s of the third landmark in view"
        )
    return ", ".join(parts)


def carries_text(counts: Mapping[str, Any]) -> str:
    """Return how many of the carries were found in time, for a cell of a table.

    >>> carries_text({"carries": 5, "carries_in_time": 4}), carries_text({"carries": 0})
    ('4 of 5', '-')
    """
    return f"{counts['carries_in_time']} of {counts['carries']}" if counts["carries"] else "-"


def in_band_text(group: Mapping[str, Any]) -> str:
    """Return how often the mean NEES is in its band, and that band, which is wide for few runs.

    >>> in_band_text({"anees_pose": [[1.0, 2.0], [2.0, 6.0]], "anees_band_95": [1.25, 5.5]})
    '1 of 2 in 1.2-5.5'
    """
    low, high = group["anees_band_95"]
    return f"{in_band(group)} of {len(group['anees_pose'])} in {low:.2g}-{high:.2g}"


def _group(runs: Sequence[SweepRun]) -> dict[str, Any]:
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


def stress_tables(groups: Sequence[dict[str, Any]]) -> list[tuple[dict[str, Any], list[Any]]]:
    """Return each clean group and all groups that differ from it by stress alone, itself first."""
    tables = []
    for clean in groups:
        if clean["stress"] == CLEAN:
            alike = [
                group
                for group in groups
                if all(group[key] == clean[key] for key in ("scene", "preset", "settings"))
            ]
            if len(alike) > 1:
                tables.append((clean, alike))
    return tables


def times_clean(group: dict[str, Any], clean: dict[str, Any], statistic: str) -> float:
    """Return a statistic of the ATE, "median" or "p90", in units of the clean group's."""
    return ratio(group["ate_rmse_m"][statistic], clean["ate_rmse_m"][statistic])


def in_band(group: Mapping[str, Any]) -> int:
    """Return at how many of the ten times the mean NEES lies in its 95 % band."""
    low, high = group["anees_band_95"]
    return sum(low <= value <= high for _, value in group["anees_pose"])


def nis_in_band(group: dict[str, Any]) -> int:
    """Return at how many of the ten times the mean NIS lies in its 95 % band."""
    known = [row for row in group["nis_times"] if row[1] is not None]
    return sum(low <= mean <= high for _, mean, low, high in known)


def stress_table(
    clean: dict[str, Any], rows: Sequence[dict[str, Any]]
) -> tuple[str, Sequence[str], Sequence[Sequence[str]]]:
    """Return title, header and rows of a table of `stress_tables`, for `print_table`."""
    ates = [row["ate_rmse_m"] for row in rows]
    columns = {
        "stress": [row["stress"] for row in rows],
        "ATE median": [mm_text(ate["median"]) for ate in ates],
        "p90": [mm_text(ate["p90"]) for ate in ates],
        "smoothed": [
            mm_text(row["smoothed"]["ate_rmse_m"]["median"]) if row["smoothed"] else "-"
            for row in rows
        ],
        "x clean": [f"{times_clean(row, clean, 'median'):.2f}" for row in rows],
        "of odometry": [f"{row['ratio']['median']:.3f}" for row in rows],
        "smoothed, of odometry": [
            f"{row['smoothed']['ratio']['median']:.3f}" if row["smoothed"] else "-" for row in rows
        ],
        "worse": [str(row["runs_above_odometry"]) for row in rows],
        "lost": [str(row["runs_lost"]) for row in rows],
        "confidently wrong": [str(row.get("runs_confidently_wrong", "-")) for row in rows],
        "carries found": [carries_text(row) for row in rows],
        "mean NEES": [f"{row['anees_mean']:.2f}" for row in rows],
        "ANEES in band": [in_band_text(row) for row in rows],
        "no duplicate": [f"{row['without_duplicates']:.0%}" for row in rows],
        "recall": [share_text(row["landmark_medians"]["recall"]) for row in rows],
        "false per run": [f"{row['false_per_run']:.2f}" for row in rows],
        "confident": [str(row["confident_false"]) for row in rows],
    }
    title = (
        f"{group_name(clean)}, {clean['runs']} runs, with the same seeds in every row: simulated"
    )
    return title, list(columns), list(zip(*columns.values(), strict=True))
