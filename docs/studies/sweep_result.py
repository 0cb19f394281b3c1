"""Draw the result of a sweep: `consistency`, `stress` or `scenes`.

`consistency.png` shows the mean NEES and NIS of the clean runs at ten times, beside their bands;
`stress.png` what each hardship costs, in units of the clean runs' errors, and whether the
covariance allows for it; `scenes.png` errors and consistency of the clean runs, a row per scene and
preset. All runs are simulated. The file is what `uwb-slam sweep --json` writes, or one of
`fixtures/baselines`, which have the same groups.
"""

import argparse
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from slam.app.run.output import print_table
from slam.app.run.pictures import (
    ESTIMATE,
    GRID,
    LANDMARK,
    ODOMETRY,
    PALE_INK,
    SMOOTHED,
    TRUTH,
    label,
    picture,
)
from slam.app.sweep import CLEAN
from slam.app.sweep.statistics import Group
from slam.app.sweep.table import group_name, in_band_text, settings_text, stress_tables, times_clean

TARGETS = {
    **dict.fromkeys(("outliers", "dropped", "skew", "walk", "silent"), 1.5),
    "all": 2.5,
    "dead": 2.0,
    "offsets_20": 2.0,
}
"""How many times the clean error each stress may cost."""

MOST_NEES = 100.0
"""What is above is an arrow at the edge."""

COLOURS = (ESTIMATE, ODOMETRY, LANDMARK, "#2b8a3e", "#7048b8")


def groups_of(sweep: Path) -> list[Group]:
    """Return the groups of a sweep."""
    try:
        groups: list[Group] = json.loads(sweep.read_text())["groups"]
    except OSError as error:
        raise SystemExit(f"{sweep}: cannot be read: {error.strerror}") from None
    except (ValueError, LookupError, TypeError):
        raise SystemExit(f"{sweep}: is not a result of `uwb-slam sweep --json`") from None
    return groups


def consistency(groups: Sequence[Group], path: Path) -> None:
    """Draw ANEES above NIS, a column per scene; print how often they are in their bands."""
    names = list(dict.fromkeys(group["scene"] for group in groups))
    width_in, height_in = 1.2 + 4.6 * len(names), 7.2
    title = "Mean over seeds against the 95 % band of a consistent filter (simulated)"
    with picture(path, width_in=width_in, height_in=height_in, title=title) as figure:
        panels = figure.subplots(2, len(names), squeeze=False, sharex="col", sharey="row")
        for (anees, nis), scene in zip(panels.T, names, strict=True):
            anees.set_yscale("log")
            nis.set_yscale("log")
            nis.axhline(1.0, color=TRUTH, linewidth=0.8)
            of_scene = [group for group in groups if group["scene"] == scene]
            for index, group in enumerate(of_scene):
                colour = COLOURS[index % len(COLOURS)]
                name = f"preset {group['preset']}{settings_text(group['settings'])}"
                anees.axhspan(*group["anees_band_95"], color=GRID, zorder=0)
                line(anees, group["anees_pose"], colour, name)
                known = [row for row in group["nis_times"] if row[1] is not None]
                times, _, lows, highs = zip(*known, strict=True) if known else ((), (), (), ())
                nis.fill_between(times, lows, highs, color=colour, alpha=0.15, linewidth=0)
                line(nis, known, colour, name)
            # the same data in every preset
            bound = next((group["bound"] for group in of_scene if group["bound"] is not None), None)
            if bound is not None:
                line(anees, bound["anees_pose"], TRUTH, "known association, ISAM2")
            seeds = "/".join(str(n) for n in dict.fromkeys(group["runs"] for group in of_scene))
            label(anees, f"{scene}, {seeds} seeds: NEES of the pose, 3 dof", "", "ANEES")
            label(nis, "NIS of true associations, per dof", "time [s]", "mean NIS / dof")
            anees.legend(frameon=False, fontsize=8)
    header = ("group", "ANEES in band", "known association", "NIS in band")
    rows = [
        (group_name(each), in_band_text(each), in_band_text(each["bound"]), nis_in_band(each))
        for each in groups
    ]
    print_table("times of ten in their 95 % band: simulated numbers", header, rows)


def nis_in_band(group: Group) -> str:
    """Return at how many of the ten times the mean NIS lies in its 95 % band."""
    known = [row for row in group["nis_times"] if row[1] is not None]
    return str(sum(low <= mean <= high for _, mean, low, high in known))


def line(axes: Axes, rows: Sequence[Sequence[float]], colour: str, name: str) -> None:
    times, values = ([row[column] for row in rows] for column in (0, 1))
    axes.plot(times, values, marker="o", markersize=4, linewidth=1.4, color=colour, label=name)


def stress(tables: Sequence[tuple[Group, Sequence[Group]]], path: Path) -> None:
    """Draw a row of panels per clean group and a line per stress."""
    title = "What each hardship costs, on equal seeds (simulated)"
    most_rows = max(len(rows) for _, rows in tables)
    height_in = 0.9 + (1.1 + 0.3 * most_rows) * len(tables)
    with picture(path, width_in=10.4, height_in=height_in, title=title) as figure:
        panels = figure.subplots(len(tables), 2, squeeze=False, sharex="col")
        for (errors, nees), (clean, groups) in zip(panels, tables, strict=True):
            names = [group["stress"] for group in groups]
            draw_times_clean(errors, clean, groups, names)
            draw_nees(nees, groups, names)
        legend_below(figure, panels[0, 0], panels[0, 1])


def draw_times_clean(
    axes: Axes, clean: Group, groups: Sequence[Group], names: Sequence[str]
) -> None:
    places = range(len(groups))
    for statistic, marker, colour in (("median", "o", ESTIMATE), ("p90", "D", LANDMARK)):
        values = [times_clean(group, clean, statistic) for group in groups]
        axes.plot(values, places, marker, markersize=6, color=colour, label=statistic)
    targets = [TARGETS.get(name, math.nan) for name in names]
    look: dict[str, Any] = {"markersize": 16, "markeredgewidth": 1.6, "color": PALE_INK}
    axes.plot(targets, places, "|", label="target of the median", **look)
    log_scale(axes, (1.0, 1.5, 2.0, 3.0, 5.0))
    median_mm = 1e3 * clean["ate_rmse_m"]["median"]
    label(
        axes,
        f"{group_name(clean)}, {clean['runs']} seeds: clean median {median_mm:.1f} mm",
        "ATE in units of the clean runs'",
        "",
    )
    name_rows(axes, names)


def scenes(groups: Sequence[Group], path: Path) -> None:
    """Draw a line per scene, preset and setting."""
    title, height_in = (
        "Clean runs, a row per scene and preset (simulated)",
        1.6 + 0.34 * len(groups),
    )
    with picture(path, width_in=10.4, height_in=height_in, title=title) as figure:
        errors, nees = figure.subplots(1, 2)
        draw_errors(errors, groups)
        draw_nees(nees, groups, [""] * len(groups))
        legend_below(figure, errors, nees)


def drawn_mm(error_m: float) -> float:
    """Return where an error is drawn: a logarithmic axis has no place for zero."""
    return max(1e3 * error_m, 1e-3)


def draw_errors(axes: Axes, groups: Sequence[Group]) -> None:
    places = range(len(groups))
    odometry_mm = [drawn_mm(group["odometry_ate_rmse_m"]["median"]) for group in groups]
    median_mm = [drawn_mm(group["ate_rmse_m"]["median"]) for group in groups]
    p90_mm = [drawn_mm(group["ate_rmse_m"]["p90"]) for group in groups]
    axes.hlines(places, median_mm, odometry_mm, color=GRID, linewidth=3, zorder=1)
    axes.plot(odometry_mm, places, "s", markersize=6, color=ODOMETRY, label="wheels, median")
    axes.plot(median_mm, places, "o", markersize=6, color=ESTIMATE, label="SLAM, median")
    axes.plot(p90_mm, places, "D", markersize=6, color=LANDMARK, label="SLAM, p90")
    smoothed = [
        (drawn_mm(group["smoothed"]["ate_rmse_m"]["median"]), place)
        for place, group in zip(places, groups, strict=True)
        if group["smoothed"] is not None
    ]
    if smoothed:
        values_mm, rows = zip(*smoothed, strict=True)
        axes.plot(values_mm, rows, "^", markersize=6, color=SMOOTHED, label="smoothed, median")
    log_scale(axes, (1.0, 2.0, 5.0))
    label(axes, "absolute trajectory error", "mm", "")
    name_rows(axes, [group_name(group) for group in groups])


def draw_nees(axes: Axes, groups: Sequence[Group], names: Sequence[str]) -> None:
    """Draw the ten ANEES of each group in a row of its own, over the band of its seeds."""
    bands = [group["anees_band_95"] for group in groups]
    lows = [low for low, _ in bands]
    widths = [high - low for low, high in bands]
    axes.barh(range(len(groups)), widths, left=lows, color=GRID, zorder=0, label="95 % band")
    every = [[value for _, value in group["anees_pose"]] for group in groups]
    for place, values in enumerate(every):
        inside = [value for value in values if value <= MOST_NEES]
        beyond = [MOST_NEES] * (len(values) - len(inside))
        for marker, shown in (("o", inside), (">", beyond)):
            is_first = place == 0 and marker == "o"
            axes.plot(
                shown,
                [place] * len(shown),
                marker,
                markersize=4,
                alpha=0.7,
                color=ESTIMATE,
                label="ANEES at one of ten times" if is_first else None,
            )
    # A logarithmic axis has no place for zero.
    least = min([*lows, *(value for values in every for value in values if value > 0.0)])
    axes.set_xlim(0.7 * least, 1.2 * MOST_NEES)
    axes.set_xscale("log")
    label(axes, "consistency", "mean NEES of the pose (3 dof)", "")
    name_rows(axes, names)


def log_scale(axes: Axes, subs: Sequence[float]) -> None:
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=subs))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_locator(NullLocator())


def name_rows(axes: Axes, names: Sequence[str]) -> None:
    """Name the rows of the groups, the first on top."""
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.5, -0.5)


def legend_below(figure: Figure, *panels: Axes) -> None:
    handles = [handle for axes in panels for handle in axes.get_legend_handles_labels()[0]]
    names = [name for axes in panels for name in axes.get_legend_handles_labels()[1]]
    figure.legend(handles, names, loc="outside lower center", ncols=5, frameon=False)


def main() -> None:
    pictures: dict[str, Any] = {"consistency": consistency, "stress": stress, "scenes": scenes}
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name", choices=pictures)
    parser.add_argument("sweep", type=Path, metavar="JSON", help="result of a sweep")
    parser.add_argument("--out", type=Path, default=Path("out/studies"), help="folder to write to")
    given = parser.parse_args()
    groups = groups_of(given.sweep)
    clean = [group for group in groups if group["stress"] == CLEAN]
    shown: Any = stress_tables(groups) if given.name == "stress" else clean
    if not shown:
        raise SystemExit(f"{given.sweep}: has no runs that {given.name} shows")
    pictures[given.name](shown, given.out / f"{given.name}.png")


if __name__ == "__main__":
    main()
