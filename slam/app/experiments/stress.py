"""How much worse each hardship of the stress table makes a run, on equal seeds."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from slam.app.errors import AppError
from slam.app.experiments import Result
from slam.app.run.pictures import ESTIMATE, GRID, LANDMARK, PALE_INK, label
from slam.app.sweep.statistics import (
    group_name,
    in_band,
    stress_table,
    stress_tables,
    times_clean,
)
from slam.app.sweep.stress import CLEAN
from xethru_protocol.system import StopFlag, read_bounded

_MOST_BYTES = 1 << 28
_NEEDED = {"scene", "preset", "settings", "stress", "ate_rmse_m", "anees_pose", "nis_times"}


def read_groups(path: Path, result: Path) -> list[dict[str, Any]]:
    """Return the groups of a sweep's result file, in its order.

    Raises
    ------
    AppError
        It cannot be read, no sweep wrote it, or `result`, which is about to be written, would
        replace it; one line.
    """
    if result.resolve() == path.resolve():
        raise AppError(f"{path}: the result would replace the sweep; choose another --out")
    try:
        groups: list[dict[str, Any]] = json.loads(read_bounded(path, _MOST_BYTES))["groups"]
        complete = all(group.keys() >= _NEEDED for group in groups)
    except OSError as error:
        raise AppError(
            f"{path}: cannot be read: {error.strerror or error}; `uwb-slam sweep --json` writes it"
        ) from None
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
        complete, groups = False, []
    if not groups or not complete:
        raise AppError(f"{path}: is not a result of this version's `uwb-slam sweep --json`")
    return groups


def clean_groups(path: Path, result: Path) -> list[dict[str, Any]]:
    """Return the groups without stress, see `read_groups`."""
    return [group for group in read_groups(path, result) if group["stress"] == CLEAN]


TARGETS = {
    **dict.fromkeys(("outliers", "dropped", "skew", "walk", "silent"), 1.5),
    "all": 2.5,
    "dead": 2.0,
    "offsets": 2.0,
}
"""How many times the clean error each hardship may cost."""

_MOST_NEES = 100.0
"""What is above is an arrow at the edge."""


_Tables = Sequence[tuple[dict[str, Any], Sequence[dict[str, Any]]]]


def _draw(figure: Figure, tables: _Tables) -> None:
    panels = figure.subplots(len(tables), 2, squeeze=False, sharex="col")
    for (errors, consistency), (clean, groups) in zip(panels, tables, strict=True):
        _draw_errors(errors, clean, groups)
        draw_consistency(consistency, groups, [group["stress"] for group in groups])
    legend_below(figure, panels[0, 0], panels[0, 1])


def _draw_errors(axes: Axes, clean: dict[str, Any], groups: Sequence[dict[str, Any]]) -> None:
    places = range(len(groups))
    for statistic, marker, colour in (("median", "o", ESTIMATE), ("p90", "D", LANDMARK)):
        axes.plot(
            [times_clean(group, clean, statistic) for group in groups],
            places,
            linestyle="none",
            marker=marker,
            markersize=6,
            color=colour,
            label=statistic,
        )
    limits = [
        (TARGETS[g["stress"]], y)
        for y, g in zip(places, groups, strict=True)
        if g["stress"] in TARGETS
    ]
    axes.plot(
        [x for x, _ in limits],
        [y for _, y in limits],
        linestyle="none",
        marker="|",
        markersize=16,
        markeredgewidth=1.6,
        color=PALE_INK,
        label="target of the median",
    )
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 1.5, 2.0, 3.0, 5.0)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_locator(NullLocator())
    median = 1e3 * clean["ate_rmse_m"]["median"]
    label(
        axes,
        f"{group_name(clean)}, {clean['runs']} seeds: clean median {median:.1f} mm",
        "ATE in units of the clean runs'",
        "",
    )
    axes.set_yticks(places, [group["stress"] for group in groups])
    axes.set_ylim(len(groups) - 0.5, -0.5)


def draw_consistency(axes: Axes, groups: Sequence[dict[str, Any]], names: Sequence[str]) -> None:
    """Draw the ten ANEES of each group in a row of its own, over the band of its seeds."""
    bands = [group["anees_band_95"] for group in groups]
    lows = [low for low, _ in bands]
    widths = [high - low for low, high in bands]
    axes.barh(range(len(groups)), widths, left=lows, color=GRID, zorder=0, label="95 % band")
    for place, group in enumerate(groups):
        values = [value for _, value in group["anees_pose"]]
        for marker, shown in (
            ("o", [value for value in values if value <= _MOST_NEES]),
            (">", [_MOST_NEES for value in values if value > _MOST_NEES]),
        ):
            axes.plot(
                shown,
                [place] * len(shown),
                linestyle="none",
                marker=marker,
                markersize=4,
                alpha=0.7,
                color=ESTIMATE,
                label="ANEES at one of ten times" if place == 0 and marker == "o" else None,
            )
    every = [value for group in groups for _, value in group["anees_pose"]]
    axes.set_xlim(0.7 * min(*lows, *every), 1.2 * _MOST_NEES)
    axes.set_xscale("log")
    label(axes, "consistency", "mean NEES of the pose (3 dof)", "")
    axes.set_yticks(range(len(groups)), names)
    axes.set_ylim(len(groups) - 0.5, -0.5)


def legend_below(figure: Figure, *panels: Axes) -> None:
    """Put what the panels show below all of them."""
    handles = [handle for axes in panels for handle in axes.get_legend_handles_labels()[0]]
    names = [name for axes in panels for name in axes.get_legend_handles_labels()[1]]
    figure.legend(handles, names, loc="outside lower center", ncols=5, frameon=False)


def run(arguments: argparse.Namespace, stop: StopFlag) -> Result:
    tables = stress_tables(read_groups(arguments.sweep, arguments.out / "stress.json"))
    if not tables:
        raise AppError(f"{arguments.sweep}: has no stressed runs; `uwb-slam sweep --stress` does")
    stop.check()
    numbers = [
        {
            "name": group_name(group),
            "runs": group["runs"],
            "ate_rmse_m": group["ate_rmse_m"],
            "times_clean": {of: times_clean(group, clean, of) for of in ("median", "p90")},
            "anees_in_band": in_band(group),
            "without_duplicates": group["without_duplicates"],
            "false_per_run": group["false_per_run"],
            "confident_false": group["confident_false"],
        }
        for clean, rows in tables
        for group in rows
    ]
    most_rows = max(len(groups) for _, groups in tables)
    return Result(
        numbers={"simulated": True, "groups": numbers},
        title="What each hardship costs, on equal seeds (simulated)",
        size_in=(10.4, 0.9 + (1.1 + 0.3 * most_rows) * len(tables)),
        draw=lambda figure: _draw(figure, tables),
        tables=[stress_table(clean, rows) for clean, rows in tables],
    )
