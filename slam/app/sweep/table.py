"""The texts of a sweep: a line and a row of a table per group, and what each column shows."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from slam.app.run.output import mm_text, share_text
from slam.app.run.summary import ratio
from slam.app.sweep import CLEAN
from slam.app.sweep.outcomes import FOUND_WITHIN_S
from slam.app.sweep.statistics import HARMED, Group, in_band

PrintedTable = tuple[str, Sequence[str], Sequence[Sequence[str]]]
"""Title, header and rows, for `print_table`."""


def group_name(group: Group) -> str:
    """Return what a group is called: scene, preset, settings and stress if there are any."""
    variant = settings_text(group["settings"], group["stress"])
    return f"{group['scene']}, preset {group['preset']}{variant}"


def settings_text(settings: Mapping[str, str], stress: str = CLEAN) -> str:
    """Return what a name continues with, empty for clean runs of a preset as it is."""
    text = "".join(f", {key}={value}" for key, value in settings.items())
    return text if stress == CLEAN else f"{text}, stress {stress}"


def group_line(group: Group) -> str:
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


def outcomes_text(counts: Group) -> str:
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
            f"{carries_text(counts)} carries found within "
            f"{FOUND_WITHIN_S:g} s of the third landmark in view"
        )
    return ", ".join(parts)


def carries_text(counts: Group) -> str:
    """Return how many of the carries were found in time, for a cell of a table.

    >>> carries_text({"carries": 5, "carries_in_time": 4}), carries_text({"carries": 0})
    ('4 of 5', '-')
    """
    return f"{counts['carries_in_time']} of {counts['carries']}" if counts["carries"] else "-"


def in_band_text(group: Group | None) -> str:
    """Return how often the mean NEES is in its band, and that band, which is wide for few runs.

    >>> in_band_text({"anees_pose": [[1.0, 2.0], [2.0, 6.0]], "anees_band_95": [1.25, 5.5]})
    '1 of 2 in 1.2-5.5'
    """
    if group is None:
        return "-"
    low, high = group["anees_band_95"]
    return f"{in_band(group)} of {len(group['anees_pose'])} in {low:.2g}-{high:.2g}"


def times_clean(group: Group, clean: Group, statistic: str) -> float:
    """Return a statistic of the ATE, "median" or "p90", in units of the clean group's."""
    return ratio(group["ate_rmse_m"][statistic], clean["ate_rmse_m"][statistic])


def _median_of(path: str, key: str, text: Callable[[float], str]) -> Callable[[Group], str]:
    """Return the column of a median of "lagged" or "smoothed" paths."""
    return lambda group: "-" if group[path] is None else text(group[path][key]["median"])


_STRESS_COLUMNS: Mapping[str, Callable[[Group], str]] = {
    "stress": lambda group: str(group["stress"]),
    "SLAM": lambda group: mm_text(group["ate_rmse_m"]["median"]),
    "p90": lambda group: mm_text(group["ate_rmse_m"]["p90"]),
    "lagged": _median_of("lagged", "ate_rmse_m", mm_text),
    "smoothed": _median_of("smoothed", "ate_rmse_m", mm_text),
    "of wheels": lambda group: f"{group['ratio']['median']:.3f}",
    "smoothed, of wheels": _median_of("smoothed", "ratio", "{:.3f}".format),
    "worse": lambda group: str(group["runs_above_odometry"]),
    "lost": lambda group: str(group["runs_lost"]),
    "confidently wrong": lambda group: str(group["runs_confidently_wrong"]),
    "carries found": carries_text,
    "mean NEES": lambda group: f"{group['anees_mean']:.2f}",
    "ANEES in band": in_band_text,
    "no duplicate": lambda group: f"{group['without_duplicates']:.0%}",
    "recall": lambda group: share_text(group["landmark_medians"]["recall"]),
    "false per run": lambda group: f"{group['false_per_run']:.2f}",
    "confident": lambda group: str(group["confident_false"]),
}
"""What each column shows of a group; errors and recall are medians over the runs."""


def stress_tables(groups: Sequence[Group]) -> list[tuple[Group, list[Group]]]:
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


def stress_table(clean: Group, groups: Sequence[Group]) -> PrintedTable:
    """Return the table of one of `stress_tables`, with the ATE in units of the clean runs'."""
    title = (
        f"{group_name(clean)}, {clean['runs']} runs, with the same seeds in every row: simulated"
    )
    header, rows = list(_STRESS_COLUMNS), []
    for group in groups:
        stress, *cells = (of(group) for of in _STRESS_COLUMNS.values())
        rows.append([stress, f"{times_clean(group, clean, 'median'):.2f}", *cells])
    return title, [header[0], "x clean", *header[1:]], rows
