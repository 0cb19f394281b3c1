"""The command `experiment`: tables and pictures of a sweep's result."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator
from pydantic import BaseModel, Field, ValidationError

from slam.app.errors import AppError, naming
from slam.app.run.output import mm_text, print_table, share_text, write_json
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
from slam.app.sweep.statistics import (
    carries_text,
    group_name,
    in_band,
    in_band_text,
    nis_in_band,
    settings_text,
    stress_table,
    stress_tables,
    times_clean,
)
from xethru_protocol.system import StopFlag, read_bounded
from xethru_protocol.validation import problem_text

Group = dict[str, Any]

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


_Number = Annotated[float, Field(allow_inf_nan=False)]
_Error = Annotated[float, Field(ge=0, allow_inf_nan=False)]
_Nees = Annotated[float, Field(gt=0, allow_inf_nan=False)]
_Count = Annotated[int, Field(ge=0)]
_NisRow = tuple[_Number, _Nees, _Nees, _Nees] | tuple[_Number, None, None, None]


class _Spread(BaseModel):
    median: _Error
    p90: _Error


class _Medians(BaseModel):
    precision: _Number | None
    recall: _Number | None


class _Anees(BaseModel):
    anees_pose: Annotated[tuple[tuple[_Number, _Nees], ...], Field(min_length=1)]
    anees_band_95: tuple[_Nees, _Nees]


class _Smoothed(_Anees):
    ate_rmse_m: _Spread
    ratio: _Spread


class _Group(_Anees):
    """What is shown of a group of `slam.app.sweep.statistics.summarise_groups`."""

    scene: str
    preset: str
    settings: dict[str, str]
    stress: str
    runs: Annotated[int, Field(gt=0)]
    runs_below_odometry: _Count
    runs_above_odometry: _Count
    runs_lost: _Count
    runs_lost_at_end: _Count
    carries: _Count
    carries_in_time: _Count
    ratio: _Spread
    ate_rmse_m: _Spread
    odometry_ate_rmse_m: _Spread
    landmark_medians: _Medians
    without_duplicates: _Error
    false_per_run: _Error
    confident_false: _Count
    anees_mean: _Nees
    smoothed: _Smoothed | None
    nis_mean: _Number | None
    nis_times: tuple[_NisRow, ...]
    bound: _Anees | None


class _Sweep(BaseModel):
    groups: Annotated[tuple[_Group, ...], Field(min_length=1)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment:
    """What is shown of a sweep: NAME.json, NAME.png and tables on standard output."""

    numbers: Mapping[str, object]
    title: str  # of the picture
    size_in: tuple[float, float]  # its width and height
    draw: Callable[[Figure], None]
    tables: Sequence[tuple[str, Sequence[str], Sequence[Sequence[str]]]]  # title, header, rows


def run_experiment(stop: StopFlag, *, name: str, sweep: Path, out: Path) -> None:
    """Write NAME.json and NAME.png into ``out`` and print tables.

    Raises AppError if the folder or a file cannot be written, or `experiment_of` does.
    """
    with naming(out):
        out.mkdir(parents=True, exist_ok=True)
    shown = experiment_of(name, sweep, out)
    stop.check()
    write_json(out / f"{name}.json", shown.numbers)
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
    if result.resolve() == path.resolve():
        raise AppError(f"{path}: the result would replace the sweep; choose another --out")
    try:
        content = json.loads(read_bounded(path, _MOST_BYTES))
        _Sweep.model_validate(content)
    except OSError as error:
        raise AppError(
            f"{path}: cannot be read: {error.strerror or error}; `uwb-slam sweep --json` writes it"
        ) from None
    except ValidationError as error:
        raise AppError(
            f"{path}: is not a result of this version's `uwb-slam sweep --json`: "
            f"{problem_text(error.errors(), _Sweep)}"
        ) from None
    except (ValueError, RecursionError):
        raise AppError(f"{path}: is not a result of `uwb-slam sweep --json`, nor JSON") from None
    groups: list[Group] = content["groups"]
    return groups


def _consistency(groups: Sequence[Group]) -> Experiment:
    scenes = list(dict.fromkeys(group["scene"] for group in groups))
    rows = [
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
    ]
    cells = [
        (
            group_name(group),
            str(group["runs"]),
            in_band_text(group),
            "-" if group["bound"] is None else in_band_text(group["bound"]),
            str(nis_in_band(group)),
            "-" if group["nis_mean"] is None else f"{group['nis_mean']:.4g}",
        )
        for group in groups
    ]
    return Experiment(
        numbers={"simulated": True, "groups": rows},
        title="Mean over seeds against the 95 % band of a consistent filter (simulated)",
        size_in=(1.2 + 4.6 * len(scenes), 7.2),
        draw=lambda figure: _draw_consistency(figure, groups, scenes),
        tables=[
            (
                "times of ten in their 95 % band, and the band of the ANEES: simulated numbers",
                ("group", "seeds", "ANEES", "known association", "NIS", "NIS mean"),
                cells,
            )
        ],
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
    numbers = [
        {
            "name": group_name(group),
            "runs": group["runs"],
            "ate_rmse_m": group["ate_rmse_m"],
            "times_clean": {of: _finite(times_clean(group, clean, of)) for of in ("median", "p90")},
            **_common(group),
            "without_duplicates": group["without_duplicates"],
            "false_per_run": group["false_per_run"],
            "confident_false": group["confident_false"],
        }
        for clean, rows in tables
        for group in rows
    ]
    most_rows = max(len(groups) for _, groups in tables)

    def draw(figure: Figure) -> None:
        panels = figure.subplots(len(tables), 2, squeeze=False, sharex="col")
        for (errors, nees), (clean, groups) in zip(panels, tables, strict=True):
            names = [group["stress"] for group in groups]
            _draw_times_clean(errors, clean, groups, names)
            _draw_nees(nees, groups, names)
        _legend_below(figure, panels[0, 0], panels[0, 1])

    return Experiment(
        numbers={"simulated": True, "groups": numbers},
        title="What each hardship costs, on equal seeds (simulated)",
        size_in=(10.4, 0.9 + (1.1 + 0.3 * most_rows) * len(tables)),
        draw=draw,
        tables=[stress_table(clean, rows) for clean, rows in tables],
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
    rows = [
        {
            "name": group_name(group),
            "runs": group["runs"],
            **_common(group),
            "odometry_ate_rmse_m": group["odometry_ate_rmse_m"],
            "ate_rmse_m": group["ate_rmse_m"],
            "times": len(group["anees_pose"]),
            "nis_mean": group["nis_mean"],
            "landmark_medians": group["landmark_medians"],
            "without_duplicates": group["without_duplicates"],
            "confident_false": group["confident_false"],
        }
        for group in groups
    ]
    columns = {
        "group": [row["name"] for row in rows],
        "seeds": [str(row["runs"]) for row in rows],
        "wheels": [mm_text(row["odometry_ate_rmse_m"]["median"]) for row in rows],
        "SLAM": [mm_text(row["ate_rmse_m"]["median"]) for row in rows],
        "SLAM p90": [mm_text(row["ate_rmse_m"]["p90"]) for row in rows],
        "of wheels": [f"{row['ratio']['median']:.3f}" for row in rows],
        "smoothed": [
            "-" if row["smoothed_ratio"] is None else f"{row['smoothed_ratio']['median']:.3f}"
            for row in rows
        ],
        "worse than wheels": [f"{row['runs_above_odometry']} of {row['runs']}" for row in rows],
        "lost": [str(row["runs_lost"]) for row in rows],
        "carries found": [carries_text(row) for row in rows],
        "ANEES": [f"{row['anees_mean']:.1f}" for row in rows],
        "in band": [in_band_text(group) for group in groups],
        "NIS": ["-" if row["nis_mean"] is None else f"{row['nis_mean']:.2f}" for row in rows],
        "precision": [share_text(row["landmark_medians"]["precision"]) for row in rows],
        "recall": [share_text(row["landmark_medians"]["recall"]) for row in rows],
        "no duplicate": [f"{row['without_duplicates']:.0%}" for row in rows],
        "confident false": [str(row["confident_false"]) for row in rows],
    }

    def draw(figure: Figure) -> None:
        errors, nees = figure.subplots(1, 2)
        _draw_errors(errors, groups)
        _draw_nees(nees, groups, [""] * len(groups))
        _legend_below(figure, errors, nees)

    return Experiment(
        numbers={"simulated": True, "groups": rows},
        title="Clean runs, a row per scene and preset (simulated)",
        size_in=(10.4, 1.6 + 0.34 * len(groups)),
        draw=draw,
        tables=[
            (
                "clean runs by scene and preset; errors, precision, recall: medians over seeds; "
                "simulated",
                list(columns),
                list(zip(*columns.values(), strict=True)),
            )
        ],
    )


def _common(group: Group) -> Group:
    """Return the numbers of a group that both tables have; ratios are per run, to its wheels."""
    keys = ("ratio", "runs_below_odometry", "runs_above_odometry", "runs_lost", "runs_lost_at_end")
    smoothed = group["smoothed"]
    return {
        **{key: group[key] for key in (*keys, "carries", "carries_in_time")},
        "smoothed_ratio": None if smoothed is None else smoothed["ratio"],
        "anees_mean": group["anees_mean"],
        "anees_in_band": in_band(group),
        "anees_band_95": group["anees_band_95"],
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
    least = min(*lows, *(value for values in every for value in values))
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
