"""A world at the level of ranges for the robust back end.

A robot drives a square four times with turns on the spot, among point landmarks beside the path.
Radars detect with a probability and see clutter; wheels have calibration errors per run, which
may walk. Geometry is written out again here, so that the back end is judged by another hand.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.config import WheelNoise
from slam.geometry import Mount, paper_rig
from slam.robust.association import RangeScan
from slam.robust.parameters import BackEndParameters, RangeNoise

Array = NDArray[np.float64]

STEP_M = 0.01
TURN_STEPS = 16
LAPS = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class Room:
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


def odometry_path(increments: Array) -> Array:
    """Return where the reported increments lead, shape (k, 3)."""
    heading = np.concatenate([[0.0], np.cumsum(increments[:, 2])])
    c, s = np.cos(heading[:-1]), np.sin(heading[:-1])
    x = np.concatenate([[0.0], np.cumsum(c * increments[:, 0] - s * increments[:, 1])])
    y = np.concatenate([[0.0], np.cumsum(s * increments[:, 0] + c * increments[:, 1])])
    return np.column_stack([x, y, heading])


STRESSES = {"clean": Stress(), "offsets20": Stress(offset_m=0.02)}
