"""A world at the level of ranges, to judge back ends without echoes.

A robot drives a square with turns on the spot, among point landmarks beside the path. Radars detect
with a probability and see clutter; wheels have calibration errors per run, which may walk. Geometry
is written out again here: no product code takes part.
"""

import math
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.config import WheelNoise
from slam.geometry import Mount, paper_rig
from slam.results import UpdateReport
from slam.robust.association import RangeScan
from slam.robust.back_end import RobustBackEnd
from slam.robust.branches import Branches
from slam.robust.parameters import BackEndParameters, RangeNoise
from slam.robust.state import Motion, calibrated_motion

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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Run:
    """One run: true poses (k, 3), landmarks (n, 2), reported increments (k - 1, 3), scans."""

    poses: Array
    landmarks: Array
    increments: Array
    scans: list[list[RangeScan]]


def true_path(room: Room, laps: int = LAPS) -> Array:
    """Return the poses of some laps, shape (k, 3), heading not wrapped."""
    straight = [(STEP_M, 0.0, 0.0)] * round(room.side_m / STEP_M)
    turn = [(0.0, 0.0, math.pi / 2 / TURN_STEPS)] * TURN_STEPS
    return odometry_path(np.array((straight + turn) * (4 * laps)))


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
    room: Room,
    seed: int,
    sigma_m: float,
    offset_m: float = 0.0,
    *,
    laps: int = LAPS,
    clutter: bool = True,
) -> Run:
    """Return one run; ``offset_m`` is the standard deviation of each radar's constant offset."""
    rng = np.random.default_rng(seed)
    poses = true_path(room, laps)
    landmarks = place_landmarks(room, rng)
    return Run(
        poses=poses,
        landmarks=landmarks,
        increments=reported(poses, room, rng, 0.0),
        scans=list(scans_of(poses, landmarks, rng, sigma_m, offset_m, clutter=clutter)),
    )


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
    offset_m: float = 0.0,
    *,
    radars: Collection[int] = range(4),
    clutter: bool = True,
) -> Iterator[list[RangeScan]]:
    """Yield what some radars detect at each pose but the first."""
    ranges, seen = echoes_of(poses, landmarks, rng, sigma_m, offset_m)
    n_clutter = rng.poisson(0.15, seen.shape[:2])
    for k in range(1, len(poses)):
        scans = []
        for radar in radars:
            own = ranges[radar, k, seen[radar, k]].tolist()
            if clutter:
                own += rng.uniform(0.2, 1.5, n_clutter[radar, k]).tolist()
            scans.append(RangeScan(radar=radar, ranges_m=tuple(own)))
        yield scans


def echoes_of(
    poses: Array, landmarks: Array, rng: np.random.Generator, sigma_m: float, offset_m: float
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the range of each landmark and whether it is detected, shapes (radars, poses, n)."""
    mounts, n = paper_rig().mounts, len(poses)
    offsets = offset_m * rng.standard_normal(len(mounts))
    ranges = np.empty((len(mounts), n, len(landmarks)))
    seen = np.empty((len(mounts), n, len(landmarks)), dtype=bool)
    for radar, mount in enumerate(mounts):
        ranges[radar], off = polar(poses, mount, landmarks)
        seen[radar] = (off <= math.radians(32.5)) & (ranges[radar] >= 0.2) & (ranges[radar] <= 1.5)
    seen &= rng.random(seen.shape) < 0.92
    ranges += sigma_m * rng.standard_normal(ranges.shape) + offsets[:, None, None]
    return ranges, seen


def polar(poses: Array, mount: Mount, landmarks: Array) -> tuple[Array, Array]:
    """Return range and angle off boresight of all landmarks, shapes (k, n)."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x = poses[:, 0] + c * mount.x_m - s * mount.y_m
    y = poses[:, 1] + s * mount.x_m + c * mount.y_m
    dx, dy = landmarks[:, 0] - x[:, None], landmarks[:, 1] - y[:, None]
    off = np.arctan2(dy, dx) - poses[:, 2, None] - mount.yaw_rad
    return np.hypot(dx, dy), np.abs((off + math.pi) % math.tau - math.pi)


def parameters_for(room: Room, sigma_m: float, walk_per_sqrt_m: float = 0.0) -> BackEndParameters:
    """Return the matched parameters: noise as specified, rules as they are."""
    wheels = WheelNoise(
        heading_rad_per_sqrt_m=room.curvature_sigma,
        scale_sigma=room.scale_sigma,
        turn_scale_sigma=room.scale_sigma,
        curvature_sigma_rad_per_m=room.curvature_sigma,
        walk_per_sqrt_m=walk_per_sqrt_m,
    )
    return BackEndParameters(wheels=wheels, ranges=RangeNoise(sigma_m=sigma_m))


def follow(
    back_end: RobustBackEnd | Branches,
    increments: Iterable[Array],
    scans: Iterable[list[RangeScan]],
    stop: int | None = None,
) -> Iterator[UpdateReport]:
    """Give a back end steps and what the radars saw at their ends; yield its reports.

    Before the step that leads to pose ``stop`` the wheels stood for three seconds.
    """
    for k, (increment, of_pose) in enumerate(zip(increments, scans, strict=True), start=1):
        if isinstance(back_end, Branches) and k == stop:
            back_end.predict(increment, elapsed_s=3.2, stood_s=3.0)
        else:
            back_end.predict(increment)
        yield back_end.update(of_pose)


def step_of(increment: Sequence[float] | Array, variance: float) -> tuple[Array, Motion]:
    """Return a step of perfect wheels as reported, and the motion with a noise of its own."""
    reported_step = np.array(increment, dtype=np.float64)
    noise = variance * np.eye(3)
    return reported_step, calibrated_motion(reported_step, np.zeros(3), WheelNoise(), noise)


def odometry_path(increments: Array) -> Array:
    """Return where the reported increments lead, shape (k, 3)."""
    heading = np.concatenate([[0.0], np.cumsum(increments[:, 2])])
    c, s = np.cos(heading[:-1]), np.sin(heading[:-1])
    x = np.concatenate([[0.0], np.cumsum(c * increments[:, 0] - s * increments[:, 1])])
    y = np.concatenate([[0.0], np.cumsum(s * increments[:, 0] + c * increments[:, 1])])
    return np.column_stack([x, y, heading])
