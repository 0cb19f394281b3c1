"""`uwb-slam benchmark`: the robust back end on public data sets."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from importlib import import_module
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from slam.app.benchmarks import IMAGE_BENCHMARKS
from slam.app.benchmarks.data_set import DataSet
from slam.app.benchmarks.path_errors import (
    ODOMETRY,
    WITH_IDS,
    WITHOUT_IDS,
    ScoredRun,
    mean_ate_m,
    score_run,
    write_run,
)
from slam.app.run.output import print_progress, print_table, print_text, write_json
from slam.app.run.pictures import (
    ESTIMATE,
    LANDMARK,
    SMOOTHED,
    TRUTH,
    label,
    picture,
)
from slam.app.run.pictures import ODOMETRY as ODOMETRY_COLOUR
from slam.app.run.result_files import made_folder
from xethru_protocol.operating_system import StopFlag

_PANELS = 4
_PANEL_IN = 3.4
_ALONE_IN = 7.5
_STYLES = {
    ODOMETRY: ("dead reckoning", ODOMETRY_COLOUR, 0.8),
    WITHOUT_IDS: ("causal, without ids", LANDMARK, 1.0),
    WITH_IDS: ("causal, with ids", ESTIMATE, 1.0),
    f"{WITHOUT_IDS}_smoothed": ("smoothed, without ids", "#e599b7", 1.0),
    f"{WITH_IDS}_smoothed": ("smoothed, with ids", SMOOTHED, 1.0),
}
"""Of each path its name, and the colour and width of its line."""


def run_benchmark(stop: StopFlag, *, name: str, data: Path, out: Path, as_json: bool) -> None:
    """Run all drives of a data set; write paths, picture and numbers, print a table or JSON.

    Raises AppError if a file is missing, is not what it should be, or cannot be written.
    """
    module = import_module(f"slam.app.benchmarks.{name.replace('-', '_')}")
    if name in IMAGE_BENCHMARKS:
        module.run_trials(stop, data=data, out=out, as_json=as_json)
        return
    data_set: DataSet = module.read_data_set(data)
    runs = []
    with made_folder(out):  # what cannot be written ends the command before any run
        for run in data_set.runs:
            stop.check()
            runs.append(scored := score_run(data_set, run, stop, print_progress))
            write_run(out / name / run.name, scored)
    width_in, height_in = _size_in(len(runs))
    path, title = out / f"{name}.png", f"{data_set.title} (real data)"
    with picture(path, width_in=width_in, height_in=height_in, title=title) as figure:
        _draw(figure, runs)
    numbers: dict[str, object] = {
        "benchmark": name,
        "runs": [scored.numbers() for scored in runs],
        "mean_ate_rmse_m": mean_ate_m(runs),
        "sensor": asdict(data_set.sensor),
    }
    write_json(out / f"{name}.json", numbers)
    if as_json:
        print_text(json.dumps(numbers, allow_nan=False))
    else:
        print_table(*_table(data_set, runs))


def _table(data: DataSet, runs: Sequence[ScoredRun]) -> tuple[str, Sequence[str], list[list[str]]]:
    names = [name for name in _STYLES if any(name in one.ate_rmse_m for one in runs)]
    rows = [
        [
            one.run.name,
            str(one.run.n_observations),
            *(_metres(one.ate_rmse_m.get(name)) for name in names),
            f"{sum(each.seconds for each in one.solutions.values()):.1f} s",
        ]
        for one in runs
    ]
    mean = mean_ate_m(runs)
    if len(runs) > 1 and len(mean) > 1:  # more than dead reckoning
        rows.append(["mean", "", *(_metres(mean.get(name)) for name in names), ""])
    title = f"{data.title}: ATE [m], time-associated, SE(2)-aligned (real data)"
    header = ["run", "observations", *(_STYLES[name][0] for name in names), "CPU time"]
    return title, header, rows


def _metres(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _size_in(n_runs: int) -> tuple[float, float]:
    """Return width and height of the picture of so many runs."""
    columns = min(n_runs, _PANELS)
    panel_in = _ALONE_IN if n_runs == 1 else _PANEL_IN * (1.6 if n_runs <= 2 else 1.0)
    return columns * panel_in, math.ceil(n_runs / columns) * panel_in + 0.9


def _draw(figure: Figure, runs: Sequence[ScoredRun]) -> None:
    """Draw the truth of each run, and its paths after the alignment that the ATE uses."""
    columns = min(len(runs), _PANELS)
    rows = math.ceil(len(runs) / columns)
    for number, scored in enumerate(runs, start=1):
        _draw_map(figure.add_subplot(rows, columns, number), scored, small=len(runs) > 1)
    used = [name for name in _STYLES if any(name in one.paths for one in runs)]
    handles = [Line2D([], [], color=TRUTH, linewidth=3.0, alpha=0.6)]
    handles += [Line2D([], [], color=_STYLES[name][1], linewidth=1.6) for name in used]
    names = ["truth", *(_STYLES[name][0] for name in used)]
    figure.legend(handles, names, loc="outside lower left", ncols=3, frameon=False, fontsize=9)


def _draw_map(axes: Axes, scored: ScoredRun, *, small: bool) -> None:
    axes.set_aspect("equal", adjustable="box")
    truth = scored.run.truth.xy_m
    axes.plot(*truth.T, ".", markersize=2.5, color=TRUTH, alpha=0.6)
    for name, (_, colour, width) in _STYLES.items():
        if name in scored.paths:
            axes.plot(*scored.aligned_m(name).T, color=colour, linewidth=width, alpha=0.85)
    # Dead reckoning may leave the picture: what is compared with it shall be seen.
    low, high = truth.min(axis=0), truth.max(axis=0)
    margin = 0.12 * float(max(high - low))
    axes.set_xlim(low[0] - margin, high[0] + margin)
    axes.set_ylim(low[1] - margin, high[1] + margin)
    best = min(scored.ate_rmse_m.items(), key=lambda pair: pair[1])
    reckoned = scored.ate_rmse_m[ODOMETRY]
    separator = "\n" if small else ": "
    comma = "\n" if small else ", "
    text = f"{_STYLES[best[0]][0]} {best[1]:.2f} m{comma}dead reckoning {reckoned:.2f} m"
    title = f"{scored.run.name}{separator}{text}"
    label(axes, title, "x [m]", "y [m]", fontsize=8 if small else 10)
