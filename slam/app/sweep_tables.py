"""The stress table of a sweep: how much worse each hardship makes a run, on equal seeds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from slam.app.experiments.results import print_table
from slam.app.report_table import mm_text, share_text
from slam.app.stress import CLEAN
from slam.app.summary import ratio
from slam.app.sweep_groups import group_name

_HEADER = (
    "stress",
    "ATE median",
    "p90",
    "x clean",
    "p90 x clean",
    "of odometry",
    "ANEES in band",
    "no duplicate",
    "recall",
    "false per run",
    "confident",
)


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


def in_band(group: dict[str, Any]) -> int:
    """Return at how many of the ten times the mean NEES lies in its 95 % band."""
    low, high = group["anees_band_95"]
    return sum(low <= value <= high for _, value in group["anees_pose"])


def nis_in_band(group: dict[str, Any]) -> int:
    """Return at how many of the ten times the mean NIS lies in its 95 % band."""
    known = [row for row in group["nis_times"] if row[1] is not None]
    return sum(low <= mean <= high for _, mean, low, high in known)


def print_stress_tables(groups: Sequence[dict[str, Any]]) -> None:
    """Write a table for each scene and preset that has stressed runs; to stdout."""
    for clean, rows in stress_tables(groups):
        print_table(
            f"{group_name(clean)}, {clean['runs']} seeds, the same in every row: simulated",
            _HEADER,
            [_row(group, clean) for group in rows],
        )


def _row(group: dict[str, Any], clean: dict[str, Any]) -> tuple[str, ...]:
    ate, wheels = group["ate_rmse_m"], group["odometry_ate_rmse_m"]
    return (
        group["stress"],
        mm_text(ate["median"]),
        mm_text(ate["p90"]),
        f"{times_clean(group, clean, 'median'):.2f}",
        f"{times_clean(group, clean, 'p90'):.2f}",
        f"{ratio(ate['median'], wheels['median']):.3f}",
        f"{in_band(group)} of {len(group['anees_pose'])}",
        f"{group['without_duplicates']:.0%}",
        share_text(group["landmark_medians"]["recall"]),
        f"{group['false_per_run']:.2f}",
        str(group["confident_false"]),
    )
