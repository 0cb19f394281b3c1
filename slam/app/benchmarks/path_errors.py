"""How well the paths of a run fit its truth, and the files that say so."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slam.app.benchmarks.back_end import BenchmarkRun, solve
from slam.app.benchmarks.data_set import Array, DataSet, Positions, Run
from slam.app.errors import naming
from slam.app.run.result_files import write_path
from slam.geometry import align_se2, transform
from slam.library.evaluation import ate_rmse_m
from slam.live.errors import AppError
from slam.live.odometry_track import NS_PER_S
from xethru_protocol.operating_system import StopFlag

ODOMETRY = "odometry"
WITH_IDS, WITHOUT_IDS = "with_ids", "without_ids"
_FEWEST = 3
"""Positions that an alignment is not exact for."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScoredRun:
    """A run, the poses of each of its paths by name, (n, 3), and their ATE."""

    run: Run
    paths: Mapping[str, Array]  # odometry, with_ids, with_ids_smoothed and so on
    ate_rmse_m: Mapping[str, float]
    solutions: Mapping[str, BenchmarkRun]  # with_ids, without_ids
    n_positions: int  # of the truth, that were compared

    def aligned_m(self, name: str) -> Array:
        """Return the positions of a path, (n, 2), in the frame of the truth."""
        xy, truth = associated(self.run, self.paths[name])
        return transform(align_se2(xy, truth), self.paths[name][:, :2])

    def numbers(self) -> dict[str, object]:
        run, solutions = self.run, self.solutions
        return {
            "run": run.name,
            "steps": len(run.steps),
            "duration_s": float(run.t_ns[-1] - run.t_ns[0]) / NS_PER_S,
            "observations": run.n_observations,
            "left_out": run.left_out,
            "compared_positions": self.n_positions,
            "ate_rmse_m": dict(self.ate_rmse_m),
            "landmarks": {name: len(each.landmarks_m) for name, each in solutions.items()},
            "seconds": {name: each.seconds for name, each in solutions.items()},
        }


def associated(run: Run, poses: Array) -> tuple[Array, Array]:
    """Return the positions of a path at the stamps of the truth, and the truth, (k, 2) each.

    The path is interpolated between its steps, so that how densely it is sampled does not count.
    """
    path = Positions(t_ns=run.t_ns, xy_m=poses[:, :2])
    xy, known = path.at(run.truth.t_ns)
    return xy[known], run.truth.xy_m[known]


def score_run(
    data: DataSet, run: Run, stop: StopFlag, progress: Callable[[str], None]
) -> ScoredRun:
    """Run the back end with the ids of landmarks and without them, where there are such data.

    A range alone is only used with its id, which the sensor that asks for it knows. Raises
    AppError if truth and odometry do not share some time.
    """
    paths = {ODOMETRY: run.dead_reckoning()}
    n_positions = len(associated(run, paths[ODOMETRY])[0])
    if n_positions < _FEWEST:
        begin_ns, end_ns = run.t_ns[[0, -1]]
        n_meant = np.count_nonzero((run.truth.t_ns >= begin_ns) & (run.truth.t_ns <= end_ns))
        raise AppError(
            f"{run.name}: {n_meant} positions of its truth lie in the time of its odometry, and "
            f"{n_positions} of them at a step or between two that are at most a second apart; "
            f"{_FEWEST} are needed, and both must be of the same drive"
        )
    solutions = {}
    for name, with_labels in ((WITH_IDS, True), (WITHOUT_IDS, False)):
        if not (run.has_labels if with_labels else run.has_bearings and run.is_dense):
            continue
        progress(f"{run.name}, {name.replace('_', ' ')}: {len(run.steps)} steps")
        solution = solve(run, data.sensor, stop, with_labels=with_labels)
        solutions[name] = solution
        paths[name] = solution.causal
        if solution.smoothed is not None:
            paths[f"{name}_smoothed"] = solution.smoothed
    return ScoredRun(
        run=run,
        paths=paths,
        ate_rmse_m={name: ate_rmse_m(*associated(run, poses)) for name, poses in paths.items()},
        solutions=solutions,
        n_positions=n_positions,
    )


def mean_ate_m(runs: Sequence[ScoredRun]) -> dict[str, float]:
    """Return the mean ATE of each path that all runs have."""
    names = [name for name in runs[0].ate_rmse_m if all(name in one.ate_rmse_m for one in runs)]
    return {name: float(np.mean([one.ate_rmse_m[name] for one in runs])) for name in names}


def write_run(folder: Path, scored: ScoredRun) -> None:
    """Write the paths of a run as TUM files.

    The truth has no heading: its orientation is the identity.
    """
    run = scored.run
    with naming(folder):
        folder.mkdir(parents=True, exist_ok=True)
    for name, poses in scored.paths.items():
        write_path(folder / f"{name}.tum", run.t_ns, poses)
    truth = run.truth
    _, rows = np.unique(truth.t_ns, return_index=True)
    places = np.column_stack([truth.xy_m[rows], np.zeros(len(rows))])
    write_path(folder / "truth.tum", truth.t_ns[rows], places)
