"""The command `experiment`: tables and pictures of a sweep's result."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator
from pydantic import BaseModel, Field, ValidationError

from slam.app.run.output import print_table, write_json
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
from slam.app.run.result_files import made_folder
from slam.app.sweep import CLEAN
from slam.app.sweep.run import SweepRun
from slam.app.sweep.statistics import Group, in_band, nis_in_band, summarise_groups
from slam.app.sweep.table import (
    CONSISTENCY_COLUMNS,
    SCENES_COLUMNS,
    PrintedTable,
    group_name,
    settings_text,
    stress_table,
    stress_tables,
    table_of,
    times_clean,
)
from slam.live.errors import AppError
from xethru_protocol.operating_system import StopFlag, read_bounded
from xethru_protocol.validation import problem_text

TARGETS = {
    **dict.fromkeys(("outliers", "dropped", "skew", "walk", "silent"), 1.5),
    "all": 2.5,
    "dead": 2.0,
    "offsets_20": 2.0,
}
"""How many times the clean error each stress may cost."""

_MOST_NEES = 100.0
"""What is above is an arrow at the edge."""

_LEAST_MM = 1e-3
"""A smaller error is drawn here: a logarithmic axis has no place for zero."""

_MOST_BYTES = 1 << 28
_COLOURS = (ESTIMATE, ODOMETRY, LANDMARK, "#2b8a3e", "#7048b8")


class _Sweep(BaseModel):
    runs: Annotated[list[SweepRun], Field(min_length=1)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment:
    """What is shown of a sweep: NAME.json, NAME.png and tables on standard output."""

    numbers: Sequence[Mapping[str, object]]  # of each group
    title: str  # of the picture
    size_in: tuple[float, float]  # its width and height
    draw: Callable[[Figure], None]
    tables: Sequence[PrintedTable]


def run_experiment(stop: StopFlag, *, name: str, sweep: Path, out: Path) -> None:
    """Write NAME.json and NAME.png into ``out`` and print tables.

    Raises AppError if the folder or a file cannot be written, or `experiment_of` does.
    """
    with made_folder(out):
        shown = experiment_of(name, sweep, out)
        stop.check()
        write_json(out / f"{name}.json", {"simulated": True, "groups": shown.numbers})
    width_in, height_in = shown.size_in
    path = out / f"{name}.png"
    with picture(path, width_in=width_in, height_in=height_in, title=shown.title) as figure:
        shown.draw(figure)
    for each in shown.tables:
        print_table(*each)


def experiment_of(name: str, sweep: Path, out: Path) -> Experiment:
    """Read the sweep and return the experiment of that name.

    Raises AppError if the file cannot be read, is not a sweep's, would be replaced by the result,
    or has no runs of those that are shown.
    """
    groups = _read_groups(sweep, out / f"{name}.json")
    if name == "stress":
        tables = stress_tables(groups)
        if not tables:
            raise AppError(f"{sweep}: has no stressed runs; `uwb-slam sweep --stress` does")
        return _stress(tables)
    clean = [group for group in groups if group["stress"] == CLEAN]
    if not clean:
        raise AppError(f"{sweep}: has no clean runs, and `experiment {name}` shows those")
    return _consistency(clean) if name == "consistency" else _scenes(clean)


def _read_groups(path: Path, result: Path) -> list[Group]:
    """Return the groups of the runs of a sweep; the groups in the file are not used."""
    if result.resolve() == path.resolve():
        raise AppError(f"{path}: the result would replace the sweep; choose another --out")
    try:
        sweep = _Sweep.model_validate(json.loads(read_bounded(path, _MOST_BYTES)))
        json.dumps([asdict(run) for run in sweep.runs], allow_nan=False)
        groups = summarise_groups(sweep.runs)
        json.dumps(groups, allow_nan=False)
    except OSError as error:
        raise AppError(
            f"{path}: cannot be read: {error.strerror or error}; `uwb-slam sweep --json` writes it"
        ) from None
    except ValidationError as error:
        raise AppError(
            f"{path}: is not a result of this version's `uwb-slam sweep --json`: "
            f"{problem_text(error.errors(), _Sweep)}"
        ) from None
    except (ValueError, ArithmeticError, RecursionError):
        raise AppError(f"{path}: is not a result of `uwb-slam sweep --json`, nor JSON") from None
    return groups


def _consistency(groups: Sequence[Group]) -> Experiment:
    scenes = list(dict.fromkeys(group["scene"] for group in groups))
    title = "times of ten in their 95 % band, and the band of the ANEES: simulated numbers"
    return Experiment(
        numbers=[
            {
                "name": group_name(group),
                "runs": group["runs"],
                "anees_in_band": in_band(group),
                "anees_band_95": group["anees_band_95"],
                "bound_anees_in_band": None if group["bound"] is None else in_band(group["bound"]),
                "nis_in_band": nis_in_band(group),
                "nis_mean": group["nis_mean"],
            }
            for group in groups
        ],
        title="Mean over seeds against the 95 % band of a consistent filter (simulated)",
        size_in=(1.2 + 4.6 * len(scenes), 7.2),
        draw=lambda figure: _draw_consistency(figure, groups, scenes),
        tables=[table_of(title, groups, CONSISTENCY_COLUMNS)],
    )


def _draw_consistency(figure: Figure, groups: Sequence[Group], scenes: Sequence[str]) -> None:
    """Draw ANEES above NIS, a column per scene and a line per preset and setting."""
    panels = figure.subplots(2, len(scenes), squeeze=False, sharex="col", sharey="row")
    for (anees, nis), scene in zip(panels.T, scenes, strict=True):
        anees.set_yscale("log")
        nis.set_yscale("log")
        nis.axhline(1.0, color=TRUTH, linewidth=0.8)
        of_scene = [group for group in groups if group["scene"] == scene]
        for index, group in enumerate(of_scene):
            colour = _COLOURS[index % len(_COLOURS)]
            name = f"preset {group['preset']}{settings_text(group['settings'])}"
            anees.axhspan(*group["anees_band_95"], color=GRID, zorder=0)
            _line(anees, group["anees_pose"], colour, name)
            known = [row for row in group["nis_times"] if row[1] is not None]
            times, _, lows, highs = zip(*known, strict=True) if known else ((), (), (), ())
            nis.fill_between(times, lows, highs, color=colour, alpha=0.15, linewidth=0)
            _line(nis, known, colour, name)
        # the same data in every preset
        bound = next((group["bound"] for group in of_scene if group["bound"] is not None), None)
        if bound is not None:
            _line(anees, bound["anees_pose"], TRUTH, "known association, ISAM2")
        seeds = "/".join(str(n) for n in dict.fromkeys(group["runs"] for group in of_scene))
        label(anees, f"{scene}, {seeds} seeds: NEES of the pose, 3 dof", "", "ANEES")
        label(nis, "NIS of true associations, per dof", "time [s]", "mean NIS / dof")
        anees.legend(frameon=False, fontsize=8)


def _line(axes: Axes, rows: Sequence[Sequence[float]], colour: str, name: str) -> None:
    times, values = ([row[column] for row in rows] for column in (0, 1))
    axes.plot(times, values, marker="o", markersize=4, linewidth=1.4, color=colour, label=name)


def _stress(tables: Sequence[tuple[Group, Sequence[Group]]]) -> Experiment:
    most_rows = max(len(groups) for _, groups in tables)

    def draw(figure: Figure) -> None:
        panels = figure.subplots(len(tables), 2, squeeze=False, sharex="col")
        for (errors, nees), (clean, groups) in zip(panels, tables, strict=True):
            names = [group["stress"] for group in groups]
            _draw_times_clean(errors, clean, groups, names)
            _draw_nees(nees, groups, names)
        _legend_below(figure, panels[0, 0], panels[0, 1])

    return Experiment(
        numbers=[
            {
                **_numbers(group, "false_per_run"),
                "times_clean": {
                    of: _finite(times_clean(group, clean, of)) for of in ("median", "p90")
                },
            }
            for clean, groups in tables
            for group in groups
        ],
        title="What each hardship costs, on equal seeds (simulated)",
        size_in=(10.4, 0.9 + (1.1 + 0.3 * most_rows) * len(tables)),
        draw=draw,
        tables=[stress_table(*each) for each in tables],
    )


def _draw_times_clean(
    axes: Axes, clean: Group, groups: Sequence[Group], names: Sequence[str]
) -> None:
    places = range(len(groups))
    for statistic, marker, colour in (("median", "o", ESTIMATE), ("p90", "D", LANDMARK)):
        values = [times_clean(group, clean, statistic) for group in groups]
        axes.plot(values, places, marker, markersize=6, color=colour, label=statistic)
    limited = [(TARGETS[name], y) for y, name in zip(places, names, strict=True) if name in TARGETS]
    axes.plot(
        [x for x, _ in limited],
        [y for _, y in limited],
        "|",
        markersize=16,
        markeredgewidth=1.6,
        color=PALE_INK,
        label="target of the median",
    )
    _log_scale(axes, (1.0, 1.5, 2.0, 3.0, 5.0))
    median_mm = 1e3 * clean["ate_rmse_m"]["median"]
    label(
        axes,
        f"{group_name(clean)}, {clean['runs']} seeds: clean median {median_mm:.1f} mm",
        "ATE in units of the clean runs'",
        "",
    )
    _name_rows(axes, names)


def _scenes(groups: Sequence[Group]) -> Experiment:
    def draw(figure: Figure) -> None:
        errors, nees = figure.subplots(1, 2)
        _draw_errors(errors, groups)
        _draw_nees(nees, groups, [""] * len(groups))
        _legend_below(figure, errors, nees)

    title = "clean runs by scene and preset; medians over seeds; simulated"
    return Experiment(
        numbers=[
            {
                **_numbers(group, "odometry_ate_rmse_m", "nis_mean", "landmark_medians"),
                "times": len(group["anees_pose"]),
            }
            for group in groups
        ],
        title="Clean runs, a row per scene and preset (simulated)",
        size_in=(10.4, 1.6 + 0.34 * len(groups)),
        draw=draw,
        tables=[table_of(title, groups, SCENES_COLUMNS)],
    )


_KEYS = (
    *("runs", "runs_below_odometry", "runs_above_odometry", "runs_lost", "runs_lost_at_end"),
    *("carries", "carries_in_time", "ratio", "ate_rmse_m", "anees_mean", "anees_band_95"),
    *("without_duplicates", "confident_false"),
)
"""Of the numbers of a group, those that NAME.json has."""


def _numbers(group: Group, *also: str) -> dict[str, object]:
    """Return the numbers of a group for NAME.json; ratios are per run, to its wheels."""
    smoothed = group["smoothed"]
    return {
        "name": group_name(group),
        **{key: group[key] for key in (*_KEYS, *also)},
        "smoothed_ratio": None if smoothed is None else smoothed["ratio"],
        "anees_in_band": in_band(group),
    }


def _finite(value: float) -> float | None:
    """Return a ratio, None where there is nothing to compare with: JSON has no infinity."""
    return value if math.isfinite(value) else None


def _draw_errors(axes: Axes, groups: Sequence[Group]) -> None:
    places = range(len(groups))
    odometry_mm, median_mm, p90_mm = (
        [max(1e3 * group[error][statistic], _LEAST_MM) for group in groups]
        for error, statistic in (
            ("odometry_ate_rmse_m", "median"),
            ("ate_rmse_m", "median"),
            ("ate_rmse_m", "p90"),
        )
    )
    axes.hlines(places, median_mm, odometry_mm, color=GRID, linewidth=3, zorder=1)
    axes.plot(odometry_mm, places, "s", markersize=6, color=ODOMETRY, label="wheels, median")
    axes.plot(median_mm, places, "o", markersize=6, color=ESTIMATE, label="SLAM, median")
    axes.plot(p90_mm, places, "D", markersize=6, color=LANDMARK, label="SLAM, p90")
    smoothed = [
        (max(1e3 * group["smoothed"]["ate_rmse_m"]["median"], _LEAST_MM), place)
        for place, group in zip(places, groups, strict=True)
        if group["smoothed"] is not None
    ]
    if smoothed:
        values_mm, rows = zip(*smoothed, strict=True)
        axes.plot(values_mm, rows, "^", markersize=6, color=SMOOTHED, label="smoothed, median")
    _log_scale(axes, (1.0, 2.0, 5.0))
    label(axes, "absolute trajectory error", "mm", "")
    _name_rows(axes, [group_name(group) for group in groups])


def _draw_nees(axes: Axes, groups: Sequence[Group], names: Sequence[str]) -> None:
    """Draw the ten ANEES of each group in a row of its own, over the band of its seeds."""
    bands = [group["anees_band_95"] for group in groups]
    lows = [low for low, _ in bands]
    widths = [high - low for low, high in bands]
    axes.barh(range(len(groups)), widths, left=lows, color=GRID, zorder=0, label="95 % band")
    every = [[value for _, value in group["anees_pose"]] for group in groups]
    for place, values in enumerate(every):
        inside = [value for value in values if value <= _MOST_NEES]
        beyond = [_MOST_NEES] * (len(values) - len(inside))
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
    axes.set_xlim(0.7 * least, 1.2 * _MOST_NEES)
    axes.set_xscale("log")
    label(axes, "consistency", "mean NEES of the pose (3 dof)", "")
    _name_rows(axes, names)


def _log_scale(axes: Axes, subs: Sequence[float]) -> None:
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=subs))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_locator(NullLocator())


def _name_rows(axes: Axes, names: Sequence[str]) -> None:
    """Name the rows of the groups, the first on top."""
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.5, -0.5)


def _legend_below(figure: Figure, *panels: Axes) -> None:
    handles = [handle for axes in panels for handle in axes.get_legend_handles_labels()[0]]
    names = [name for axes in panels for name in axes.get_legend_handles_labels()[1]]
    figure.legend(handles, names, loc="outside lower center", ncols=5, frameon=False)
