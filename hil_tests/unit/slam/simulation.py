"""A world at the level of ranges, to judge the back end without echoes.

Square path on a floor, point landmarks beside it, detection probability, clutter, Gaussian range
noise, and a wheel odometry with per-run biases. No product code takes part: geometry is written
out again here, so the pipeline is judged by an independent world.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hil_tests.unit.slam.robust.range_world import STEP_M, TURN_STEPS, Room
from slam.frames import Detection
from slam.geometry import Rig
from slam.results import PoseAt

Array = NDArray[np.float64]

FRAME_NS = 200_000_000
HALF_VIEW_RAD = math.radians(32.5)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class World:
    """One simulated run: truth and odometry poses (n, 3), landmarks (m, 2), ranges per frame."""

    truth: Array
    odometry: Array
    landmarks: Array
    detections: list[tuple[Detection, ...]]

    def stamps(self) -> list[int]:
        return [k * FRAME_NS for k in range(len(self.truth))]


def simulate(
    room: Room,
    rig: Rig,
    seed: int,
    *,
    laps: int = 4,
    range_sigma_m: float = 7.4e-3,
    detection_probability: float = 0.92,
    clutter_per_frame: float = 0.15,
    odometry_noise: float = 1.0,
) -> World:
    rng = np.random.default_rng(seed)
    landmarks = _landmarks(room, rng)
    increments = _increments(room, laps)
    truth = integrate(increments)
    odometry = integrate(_wheels(increments, room, rng, odometry_noise))
    detections = []
    for k, pose in enumerate(truth):
        frame: list[Detection] = []
        for radar, mount in enumerate(rig.mounts):
            c, s = math.cos(pose[2]), math.sin(pose[2])
            antenna = pose[:2] + np.array(
                [c * mount.x_m - s * mount.y_m, s * mount.x_m + c * mount.y_m]
            )
            offset = landmarks - antenna
            ranges = np.hypot(offset[:, 0], offset[:, 1])
            off = np.arctan2(offset[:, 1], offset[:, 0]) - pose[2] - mount.yaw_rad
            off = np.abs((off + math.pi) % math.tau - math.pi)
            seen = (off < HALF_VIEW_RAD) & (ranges > 0.2) & (ranges < 1.5)
            seen &= rng.random(len(landmarks)) < detection_probability
            echoes = ranges[seen] + range_sigma_m * rng.standard_normal(int(seen.sum()))
            clutter = rng.uniform(0.2, 1.5, rng.poisson(clutter_per_frame))
            frame.extend(
                Detection(radar=radar, t_ns=k * FRAME_NS, range_m=float(r), amplitude=0.01)
                for r in np.sort(np.concatenate([echoes, clutter]))
            )
        detections.append(tuple(frame))
    return World(truth=truth, odometry=odometry, landmarks=landmarks, detections=detections)


def integrate(increments: Array) -> Array:
    poses = np.zeros((len(increments) + 1, 3))
    for k, (ux, uy, ua) in enumerate(increments):
        x, y, a = poses[k]
        c, s = math.cos(a), math.sin(a)
        poses[k + 1] = x + c * ux - s * uy, y + s * ux + c * uy, a + ua
    return poses


def _increments(room: Room, laps: int) -> Array:
    """Half the laps one way, a left turn, the other half back round the same square."""
    straight = [(STEP_M, 0.0, 0.0)] * round(room.side_m / STEP_M)
    turn = math.pi / 2 / TURN_STEPS
    left, right = [(0.0, 0.0, turn)] * TURN_STEPS, [(0.0, 0.0, -turn)] * TURN_STEPS
    forth = (laps + 1) // 2
    steps = (straight + left) * (4 * forth)
    if laps > forth:
        steps += left + (straight + right) * (4 * (laps - forth))
    return np.array(steps)


def _landmarks(room: Room, rng: np.random.Generator) -> Array:
    found: list[Array] = []
    half = room.side_m / 2
    while len(found) < room.n_landmarks:
        point = rng.uniform(-half - 1.2, half + 1.2, 2)
        outside = np.maximum(np.abs(point) - half, 0)
        to_path = np.hypot(*outside) if outside.any() else half - np.abs(point).max()
        if 0.4 <= to_path <= 1.2 and all(
            np.hypot(*(point - other)) >= room.min_spacing_m for other in found
        ):
            found.append(point)
    return np.array(found) + half  # the path starts in the corner (0, 0)


def _wheels(increments: Array, room: Room, rng: np.random.Generator, amount: float) -> Array:
    scale, turn_scale = room.scale_sigma * amount * rng.standard_normal(2)
    curvature = room.curvature_sigma * amount * rng.standard_normal()
    distance = np.hypot(increments[:, 0], increments[:, 1])
    root = np.sqrt(distance)
    noise = amount * rng.standard_normal(increments.shape)
    measured = increments.copy()
    measured[:, 0] = increments[:, 0] * (1 + scale) + 2e-3 * root * noise[:, 0]
    measured[:, 1] = increments[:, 1] * (1 + scale) + 6e-4 * root * noise[:, 1]
    heading_sigma = room.curvature_sigma * root + 0.01 * np.abs(increments[:, 2])
    measured[:, 2] = (
        increments[:, 2] * (1 + turn_scale) + curvature * distance + heading_sigma * noise[:, 2]
    )
    return measured


def at_rest(pose: Array) -> PoseAt:
    """Return odometry that gives one pose, whatever the time: all radars sample at once."""
    return lambda t_ns: pose
