"""`uwb-slam benchmark`: the robust back end on public data sets."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from importlib import import_module
from pathlib import Path

from slam.app.errors import naming
from slam.app.experiments.benchmarks import BENCHMARKS
from slam.app.experiments.benchmarks.data_set import DataSet
from slam.app.experiments.benchmarks.evaluation import (
    ODOMETRY,
    WITH_IDS,
    WITHOUT_IDS,
    ScoredRun,
    mean_ate_m,
    score_run,
    write_run,
)
from slam.app.experiments.benchmarks.picture import draw, size_in
from slam.app.run.output import print_progress, print_table, print_text, write_json
from slam.app.run.pictures import picture
from xethru_protocol.system import StopFlag

_COLUMNS = {
    ODOMETRY: "dead reckoning",
    WITH_IDS: "ids: causal",
    f"{WITH_IDS}_smoothed": "smoothed",
    WITHOUT_IDS: "no ids: causal",
    f"{WITHOUT_IDS}_smoothed": "smoothed",
}


def run_benchmark(stop: StopFlag, *, name: str, data: Path, out: Path, as_json: bool) -> None:
    """Run all drives of a data set; write paths, picture and numbers, print a table or JSON.

    Raises AppError if a file is missing, is not what it should be, or cannot be written.
    """
    read = import_module(f"slam.app.experiments.benchmarks.{BENCHMARKS[name].module}").read_data_set
    data_set: DataSet = read(data)
    with naming(out):
        out.mkdir(parents=True, exist_ok=True)
    runs = []
    for run in data_set.runs:
        stop.check()
        runs.append(scored := score_run(data_set, run, stop, print_progress))
        write_run(out / name / run.name, data_set, scored)
    width_in, height_in = size_in(len(runs))
    with picture(out / f"{name}.png", width_in=width_in, height_in=height_in) as figure:
        draw(figure, f"{data_set.title} (real data)", runs)
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
    names = [name for name in _COLUMNS if any(name in one.ate_rmse_m for one in runs)]
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
    if len(runs) > 1:
        rows.append(["mean", "", *(_metres(mean.get(name)) for name in names), ""])
    title = f"{data.title}: ATE [m], time-associated, SE(2)-aligned (real data)"
    header = ["run", "observations", *(_COLUMNS[name] for name in names), "CPU time"]
    return title, header, rows


def _metres(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
