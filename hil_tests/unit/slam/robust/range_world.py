"""A world at the level of ranges for the robust back end, and the judge of its runs.

A robot drives a square four times with turns on the spot, among point landmarks beside the path.
Radars detect with a probability and see clutter; wheels have calibration errors per run, which
may walk. Geometry is written out again here, so that the back end is judged by another hand.

Run as a module for Monte Carlo tables, ``--help`` tells how.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from slam.geometry import Mount, Rig, paper_rig, transform
from slam.metrics import align_se2, ate_rmse_m, landmark_metrics, nees_pose
from slam.robust.back_end import RobustBackEnd
from slam.robust.parameters import (
    BackEndParameters,
    MapRule,
    RangeNoise,
    WheelNoise,
)
from slam.robust.ranges import RangeScan
from slam.visibility import observable_landmarks

Array = NDArray[np.float64]

STEP_M = 0.01
TURN_STEPS = 16
LAPS = 4
NEES_BAND_100 = (2.54, 3.50)


@dataclass(frozen=True, slots=True, kw_only=True)
class Room:
    """What differs between the two rooms."""

    side_m: float
    n_landmarks: int
    min_spacing_m: float
    scale_sigma: float
    curvature_sigma: float


LAB = Room(
    side_m=2.0, n_landmarks=14, min_spacing_m=0.35, scale_sigma=0.007, curvature_sigma=0.0042
)
CLASSROOM = Room(
    side_m=3.0, n_landmarks=10, min_spacing_m=1.0, scale_sigma=0.023, curvature_sigma=0.0139
)
ROOMS = {"lab": LAB, "classroom": CLASSROOM}


@dataclass(frozen=True, slots=True, kw_only=True)
class Stress:
    """What makes a run hard.

    ``random_share`` of the ranges are replaced by uniform ones; ``dropped_share`` of the frames
    are lost, radar by radar; ``sampled_after`` gives each radar's sample time in steps after the
    pose; ``offset_m`` is the standard deviation of each radar's constant offset; ``dead`` radars
    send nothing; ``silent_share`` of the run, in one piece, no radar does; ``walk`` is how far the
    calibration errors wander over the whole run, in their own standard deviations; after a share
    ``carried_at`` of the run the robot is carried on by ``carried_laps``, unknown to the wheels.
    """

    random_share: float = 0.0
    dropped_share: float = 0.0
    sampled_after: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    offset_m: float = 0.0
    dead: tuple[int, ...] = ()
    silent_share: float = 0.0
    walk: float = 0.0
    carried_at: float = 1.0
    carried_laps: float = 0.37


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Run:
    """One run: true poses (k, 3), landmarks (n, 2), reported increments (k - 1, 3), scans."""

    poses: Array
    landmarks: Array
    increments: Array
    scans: list[list[RangeScan]]


def true_path(room: Room) -> Array:
    """Return the poses of four laps, shape (k, 3), heading not wrapped."""
    n_side = round(room.side_m / STEP_M)
    x = y = heading = 0.0
    poses = [(x, y, heading)]
    for _ in range(4 * LAPS):
        for _ in range(n_side):
            x, y = x + STEP_M * math.cos(heading), y + STEP_M * math.sin(heading)
            poses.append((x, y, heading))
        for _ in range(TURN_STEPS):
            heading += math.pi / 2 / TURN_STEPS
            poses.append((x, y, heading))
    return np.array(poses)


def place_landmarks(room: Room, rng: np.random.Generator) -> Array:
    """Return landmarks 0.4 to 1.2 m off the path, well apart."""
    placed: list[Array] = []
    while len(placed) < room.n_landmarks:
        point = rng.uniform(-1.2, room.side_m + 1.2, 2)
        nearest = np.clip(point, 0.0, room.side_m)
        outside = float(np.hypot(*(point - nearest)))
        inside = float(min(point.min(), (room.side_m - point).min()))
        off = outside if outside > 0.0 else inside
        if not 0.4 <= off <= 1.2:
            continue
        if all(np.hypot(*(point - other)) >= room.min_spacing_m for other in placed):
            placed.append(point)
    return np.array(placed)


def simulate(
    room: Room, seed: int, sigma_m: float, stress: Stress | None = None, labelled: bool = False
) -> Run:
    """Return one run; ``labelled`` ranges tell which landmark they are of, clutter left out."""
    stress = stress or Stress()
    rng = np.random.default_rng(seed)
    poses = true_path(room)
    landmarks = place_landmarks(room, rng)
    cut = round(stress.carried_at * len(poses))
    if cut < len(poses):
        poses = np.delete(poses, np.s_[cut : cut + carried_steps(room, stress)], axis=0)
    increments = reported(poses, room, rng, stress.walk, unaware=cut)
    return Run(
        poses=poses,
        landmarks=landmarks,
        increments=increments,
        scans=list(scans_of(poses, landmarks, rng, sigma_m, stress, labelled=labelled)),
    )


def carried_steps(room: Room, stress: Stress) -> int:
    """Return how many steps of the path a carried robot leaves out."""
    return round(stress.carried_laps * 4 * (room.side_m / STEP_M + TURN_STEPS))


def reported(
    poses: Array, room: Room, rng: np.random.Generator, walk: float, unaware: int | None = None
) -> Array:
    """Return what the wheels report of each step, shape (k - 1, 3).

    They do not notice the step that leads to pose ``unaware``.
    """
    n = len(poses) - 1
    sigmas = np.array([room.scale_sigma, room.scale_sigma, room.curvature_sigma])
    biases = sigmas * rng.standard_normal(3)
    wandered = np.cumsum(rng.standard_normal((n, 3)), axis=0) * (walk / math.sqrt(n))
    s, w, kappa = (biases + sigmas * wandered).T
    heading = poses[:-1, 2]
    gone = np.diff(poses, axis=0)
    if unaware is not None and unaware < len(poses):
        gone[unaware - 1] = 0.0
    dx = np.cos(heading) * gone[:, 0] + np.sin(heading) * gone[:, 1]
    dy = -np.sin(heading) * gone[:, 0] + np.cos(heading) * gone[:, 1]
    a, D = gone[:, 2], np.hypot(dx, dy)
    white = rng.standard_normal((n, 3))
    return np.column_stack(
        [
            (1 + s) * dx + 2e-3 * np.sqrt(D) * white[:, 0],
            (1 + s) * dy + 6e-4 * np.sqrt(D) * white[:, 1],
            (1 + w) * a
            + kappa * D
            + (room.curvature_sigma * np.sqrt(D) + 0.01 * np.abs(a)) * white[:, 2],
        ]
    )


def scans_of(
    poses: Array,
    landmarks: Array,
    rng: np.random.Generator,
    sigma_m: float,
    stress: Stress,
    *,
    labelled: bool,
) -> Iterator[list[RangeScan]]:
    """Yield what the radars detect at each pose but the first."""
    mounts = paper_rig().mounts
    n = len(poses)
    offsets = stress.offset_m * rng.standard_normal(len(mounts))
    silent_from = int(rng.uniform(0.1, 0.8) * n)
    silent = range(silent_from, silent_from + int(stress.silent_share * n))
    ranges = np.empty((len(mounts), n, len(landmarks)))
    seen = np.empty((len(mounts), n, len(landmarks)), dtype=bool)
    for radar, mount in enumerate(mounts):
        at = sampled_poses(poses, stress.sampled_after[radar])
        ranges[radar], off = polar(at, mount, landmarks)
        seen[radar] = (off <= math.radians(32.5)) & (ranges[radar] >= 0.2) & (ranges[radar] <= 1.5)
    seen &= rng.random(seen.shape) < 0.92
    ranges += sigma_m * rng.standard_normal(ranges.shape) + offsets[:, None, None]
    random = rng.random(ranges.shape) < stress.random_share
    ranges[random] = rng.uniform(0.2, 1.5, int(random.sum()))
    n_clutter = rng.poisson(0.15, (len(mounts), n))
    dropped = rng.random((len(mounts), n)) < stress.dropped_share
    for k in range(1, n):
        scans = []
        for radar in range(len(mounts)):
            clutter = rng.uniform(0.2, 1.5, n_clutter[radar, k])
            if radar in stress.dead or dropped[radar, k] or k in silent:
                continue
            ids = np.flatnonzero(seen[radar, k])
            own = ranges[radar, k, ids].tolist()
            labels: tuple[int, ...] | None = None
            if labelled:
                true = ~random[radar, k, ids]
                own, labels = ranges[radar, k, ids[true]].tolist(), tuple(ids[true].tolist())
            else:
                own += clutter.tolist()
            scans.append(
                RangeScan(
                    radar=radar,
                    ranges_m=tuple(own),
                    sampled_after=stress.sampled_after[radar],
                    labels=labels,
                )
            )
        yield scans


def sampled_poses(poses: Array, f: float) -> Array:
    """Return the poses a fraction of a step later; on the spot and straight ahead exactly."""
    if f == 0.0:
        return poses
    after = np.vstack([poses[1:], poses[-1:]]) if f > 0 else np.vstack([poses[:1], poses[:-1]])
    return poses + abs(f) * (after - poses)


def polar(poses: Array, mount: Mount, landmarks: Array) -> tuple[Array, Array]:
    """Return range and angle off boresight of all landmarks, shapes (k, n)."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x = poses[:, 0] + c * mount.x_m - s * mount.y_m
    y = poses[:, 1] + s * mount.x_m + c * mount.y_m
    dx, dy = landmarks[:, 0] - x[:, None], landmarks[:, 1] - y[:, None]
    off = np.arctan2(dy, dx) - poses[:, 2, None] - mount.yaw_rad
    return np.hypot(dx, dy), np.abs((off + math.pi) % math.tau - math.pi)


def parameters_for(
    room: Room, sigma_m: float, stress: Stress | None = None, walk_per_sqrt_m: float = 0.0
) -> BackEndParameters:
    """Return the matched parameters: noise as specified, rules as they are."""
    stress = stress or Stress()
    wheels = WheelNoise(
        heading_rad_per_sqrt_m=room.curvature_sigma,
        scale_sigma=room.scale_sigma,
        turn_scale_sigma=room.scale_sigma,
        curvature_sigma_rad_per_m=room.curvature_sigma,
        walk_per_sqrt_m=walk_per_sqrt_m,
    )
    extra = stress.random_share * 0.92 * 1.5
    ranges = RangeNoise(
        sigma_m=sigma_m,
        offset_sigma_m=stress.offset_m,
        detection_probability=0.92 * (1.0 - stress.random_share),
        clutter_per_m=(0.15 + extra) / 1.3,
    )
    return BackEndParameters(wheels=wheels, ranges=ranges)


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


def odometry_path(increments: Array) -> Array:
    """Return where the reported increments lead, shape (k, 3)."""
    heading = np.concatenate([[0.0], np.cumsum(increments[:, 2])])
    c, s = np.cos(heading[:-1]), np.sin(heading[:-1])
    x = np.concatenate([[0.0], np.cumsum(c * increments[:, 0] - s * increments[:, 1])])
    y = np.concatenate([[0.0], np.cumsum(s * increments[:, 0] + c * increments[:, 1])])
    return np.column_stack([x, y, heading])


STRESSES = {
    "clean": Stress(),
    "random20": Stress(random_share=0.2),
    "dropped10": Stress(dropped_share=0.1),
    "skew": Stress(sampled_after=(0.0, -0.95, -0.5, -0.75)),
    "offsets20": Stress(offset_m=0.02),
    "dead": Stress(dead=(1,)),
    "silent10": Stress(silent_share=0.1),
    "walk": Stress(walk=1.0),
    "carried": Stress(carried_at=0.6),
    "all": Stress(
        random_share=0.2,
        dropped_share=0.1,
        sampled_after=(0.0, -0.95, -0.5, -0.75),
        silent_share=0.1,
        walk=1.0,
    ),
}


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
    ignore_skew: bool = False,
    map_rule: MapRule | None = None,
) -> Verdict:
    """Simulate and drive one run."""
    run = simulate(room, seed, sigma_m, stress, labelled)
    if ignore_skew:
        scans = [[replace(scan, sampled_after=0.0) for scan in scans] for scans in run.scans]
        run = replace(run, scans=scans)
    parameters = parameters_for(room, sigma_m, stress, walk_per_sqrt_m)
    if map_rule is not None:
        parameters = replace(parameters, map=map_rule)
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
