"""The robust back end in the world of ranges: one run and its verdict.

Run as a module for Monte Carlo tables, ``--help`` tells how.
"""

import argparse
import json
import math
import time
from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from hil_tests.unit.slam.robust.range_world import (
    ROOMS,
    STRESSES,
    Array,
    Room,
    Run,
    Stress,
    odometry_path,
    parameters_for,
    simulate,
)
from slam.evaluation import align_se2, ate_rmse_m, landmark_metrics, nees_pose, observable_landmarks
from slam.geometry import Rig, paper_rig, transform
from slam.robust.back_end import RobustBackEnd


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """How one run went; NEES at the ten times."""

    seed: int
    ate_m: float
    odometry_ate_m: float
    nees: tuple[float, ...]
    duplicates: int
    false: int
    matched: int
    true: int
    landmark_rmse_m: float | None
    nis_per_dof: float
    relinearisations: int
    seconds: float


def drive(run: Run, back_end: RobustBackEnd, rig: Rig) -> tuple[Verdict, Array]:
    """Run the back end over a run; return the verdict and the causal path (k, 3)."""
    began = time.process_time()
    n = len(run.poses)
    checks = {
        round(share * (n - 1)) for share in (0.1, 0.25, 0.3, 0.4, 0.5, 0.6, 0.7, 0.75, 0.9, 1)
    }
    path = [np.zeros(3)]
    nees = []
    nis = dof = relinearised = 0.0
    for k, (increment, scans) in enumerate(zip(run.increments, run.scans, strict=True), start=1):
        back_end.predict(increment)
        report = back_end.update(scans)
        nis, dof = nis + report.nis, dof + report.dof
        relinearised += report.relinearised
        path.append(back_end.pose)
        if k in checks:
            truth = run.poses[k].copy()
            nees.append(nees_pose(back_end.pose, back_end.pose_covariance, truth))
    estimate = np.array(path)
    landmarks = np.array([mark.position_m for mark in back_end.landmarks()]).reshape(-1, 2)
    counted = run.landmarks[observable_landmarks(rig, run.poses, run.landmarks)]
    alignment = align_se2(estimate[:, :2], run.poses[:, :2])
    score = landmark_metrics(landmarks, counted, alignment)
    false = 0
    for point in transform(alignment, landmarks) if len(landmarks) else []:
        false += float(np.hypot(*(run.landmarks - point).T).min()) > 0.15
    odometry = odometry_path(run.increments)
    return (
        Verdict(
            seed=0,
            ate_m=ate_rmse_m(estimate[:, :2], run.poses[:, :2]),
            odometry_ate_m=ate_rmse_m(odometry[:, :2], run.poses[:, :2]),
            nees=tuple(nees),
            duplicates=score.duplicates,
            false=false,
            matched=score.matched,
            true=score.true,
            landmark_rmse_m=score.rmse_m,
            nis_per_dof=nis / max(dof, 1),
            relinearisations=int(relinearised),
            seconds=time.process_time() - began,
        ),
        estimate,
    )


def summary(verdicts: list[Verdict]) -> dict[str, object]:
    """Return the medians and counts of a cell."""
    ate = np.array([v.ate_m for v in verdicts]) * 1e3
    nees = np.array([v.nees for v in verdicts])
    n = len(verdicts)
    # chi-square of 3 n degrees of freedom over n, by Wilson and Hilferty; exact enough here.
    spread = math.sqrt(2.0 / (9.0 * 3 * n))
    low, high = (3.0 * (1 - spread**2 + z * spread) ** 3 for z in (-1.96, 1.96))
    anees = nees.mean(axis=0)
    rmse = [v.landmark_rmse_m for v in verdicts if v.landmark_rmse_m is not None]
    return {
        "n": n,
        "ate_median_mm": round(float(np.median(ate)), 2),
        "ate_p90_mm": round(float(np.percentile(ate, 90)), 2),
        "ate_max_mm": round(float(ate.max()), 1),
        "odometry_median_mm": round(
            float(np.median([v.odometry_ate_m for v in verdicts])) * 1e3, 1
        ),
        "anees_in_band": int(np.sum((anees >= low) & (anees <= high))),
        "anees": [round(float(x), 2) for x in anees],
        "no_duplicates_share": float(np.mean([v.duplicates == 0 for v in verdicts])),
        "duplicates_per_run": float(np.mean([v.duplicates for v in verdicts])),
        "false_per_run": float(np.mean([v.false for v in verdicts])),
        "matched": round(float(np.mean([v.matched for v in verdicts])), 2),
        "true": round(float(np.mean([v.true for v in verdicts])), 2),
        "landmark_rmse_mm": round(float(np.median(rmse)) * 1e3, 1) if rmse else None,
        "nis_per_dof": round(float(np.mean([v.nis_per_dof for v in verdicts])), 3),
        "relinearisations": float(np.mean([v.relinearisations for v in verdicts])),
        "seconds": round(float(np.mean([v.seconds for v in verdicts])), 2),
        "worst": [int(v.seed) for v in sorted(verdicts, key=lambda v: -v.ate_m)[:3]],
    }


def judge(
    room: Room,
    seed: int,
    sigma_m: float,
    stress: Stress,
    *,
    labelled: bool = False,
    walk_per_sqrt_m: float = 0.0,
) -> Verdict:
    """Simulate and drive one run."""
    run = simulate(room, seed, sigma_m, stress, labelled)
    parameters = parameters_for(room, sigma_m, stress, walk_per_sqrt_m)
    rig = paper_rig()
    verdict, _ = drive(run, RobustBackEnd(rig, parameters), rig)
    return replace(verdict, seed=seed)


def main() -> None:
    """Print one table row per cell as JSON."""
    parser = argparse.ArgumentParser(description="Monte Carlo of the robust back end on ranges")
    parser.add_argument("--room", nargs="+", choices=sorted(ROOMS), default=["lab", "classroom"])
    parser.add_argument("--sigma-mm", nargs="+", type=float, default=[7.4, 0.9])
    parser.add_argument("--stress", nargs="+", choices=sorted(STRESSES), default=["clean"])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--labelled", action="store_true", help="true associations are told")
    parser.add_argument("--walk-per-sqrt-m", type=float, default=0.0)
    parser.add_argument("--runs", action="store_true", help="also print each run")
    arguments = parser.parse_args()
    with threadpool_limits(1):
        for stress in arguments.stress:
            for room in arguments.room:
                for sigma_mm in arguments.sigma_mm:
                    verdicts = []
                    for seed in range(arguments.first, arguments.first + arguments.seeds):
                        verdict = judge(
                            ROOMS[room],
                            seed,
                            sigma_mm * 1e-3,
                            STRESSES[stress],
                            labelled=arguments.labelled,
                            walk_per_sqrt_m=arguments.walk_per_sqrt_m,
                        )
                        verdicts.append(verdict)
                        if arguments.runs:
                            print(  # noqa: T201 - a table is what this command is for
                                seed,
                                round(verdict.ate_m * 1e3, 2),
                                [round(x, 1) for x in verdict.nees],
                                verdict.duplicates,
                                verdict.false,
                                f"{verdict.matched}/{verdict.true}",
                                verdict.relinearisations,
                                round(verdict.seconds, 2),
                                flush=True,
                            )
                    cell = {"stress": stress, "room": room, "sigma_mm": sigma_mm}
                    print(json.dumps(cell | summary(verdicts)), flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
