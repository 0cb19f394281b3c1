"""Wheel odometry that drifts, from exact increments of the true path, and its TUM lines.

Per run three constants are drawn: translation scale s (mean wheel radius), turn scale w (track
width) and curvature kappa (difference of the radii). A step whose true increment in the body
frame at its start is (dx, dy) and a, with D = hypot(dx, dy), is reported as

    ux = (1 + s) dx + white(along sqrt(D)),  uy = (1 + s) dy + white(across sqrt(D)),
    ua = (1 + w) a + kappa D + white(per_metre sqrt(D) + per_radian |a|),

and the reported pose is the composition of the reported increments, starting at zero. White noise
of a leg composes over steps (variance proportional to length), so it does not depend on the step;
that of a turn is proportional to each step's angle, so it belongs to the scene's step rate. Where
the scene has it, the three constants perform independent random walks from there. While the robot
is carried its wheels stand still and report so. Source: the project's odometry model for this robot
class; the scene holds its standard deviations.

Slip
    Where the scene has it, wheels slip at each sample with the probability slips_per_s / rate_hz:
    they report |N(0, slip_sigma_m)| forward and a turn of N(0, slip_sigma_deg) more than the robot
    did. Wheels that hang in the air do not slip. Assumed: the law is the project's, not measured.

The TUM lines are canonical: every reader, live or later, computes with the same floats.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from emulator.scene.philox import counter_normals, standard_normals, uniforms
from emulator.scene.scene import OdometrySpec, Scene

ODOMETRY_STREAM = 1 << 63
"""Noise stream of the wheels; the radars' streams are their serial numbers, below 10**12."""
_SLIPS_STREAM = ODOMETRY_STREAM + 1
_SLIP_SIZES_STREAM = ODOMETRY_STREAM + 2


def odometry_times_ns(duration_ns: int, rate_hz: float) -> NDArray[np.int64]:
    """Return the sample times 0, 1/rate, ... up to the first at or after the end; shape (n,)."""
    period_ns = 1e9 / rate_hz
    last = int(duration_ns / period_ns)
    if round(last * period_ns) < duration_ns:
        last += 1
    return np.array([round(k * period_ns) for k in range(last + 1)], dtype=np.int64)


def drift(
    true_poses: NDArray[np.float64],
    model: OdometrySpec,
    *,
    seed: int,
    unseen: NDArray[np.bool_] | None = None,
) -> NDArray[np.float64]:
    """Return what the wheels report for a true path.

    Parameters
    ----------
    true_poses
        Shape (n, 3), float64: x [m], y [m], heading [rad, continuous], any frame.
    unseen
        Shape (n - 1,): steps during which the wheels stood, whatever the robot did.

    Returns
    -------
    Shape (n, 3), float64: reported poses, the first all zero, heading [rad, continuous].
    """
    n_steps = len(true_poses) - 1
    # The normals of the walk lie behind all others, so it changes no other value.
    n_white = 3 + 3 * n_steps
    walks = model.walk_per_sqrt_s > 0
    normals = standard_normals(n_white + 3 * n_steps * walks, seed=seed, stream=ODOMETRY_STREAM)
    units = np.repeat(normals[np.newaxis, :3], n_steps, axis=0)
    if walks:
        per_step = model.walk_per_sqrt_s / math.sqrt(model.rate_hz)
        units[1:] += per_step * np.cumsum(normals[n_white:-3].reshape(-1, 3), axis=0)
    sigmas = (model.scale_sigma, model.turn_scale_sigma, model.curvature_sigma_rad_per_m)
    errors = (units * np.array(sigmas)).tolist()
    # Python floats and math: the loop is short, and libm does not change with NumPy's dispatch.
    x, y, heading = 0.0, 0.0, 0.0
    reported = [(x, y, heading)]
    true_steps = np.diff(true_poses, axis=0)
    slips = _slips(n_steps, model, seed=seed)
    if unseen is not None:
        true_steps[unseen] = 0.0
        slips[unseen] = 0.0
    steps = true_steps.tolist()
    headings = true_poses[:, 2].tolist()
    white = normals[3:n_white].reshape(n_steps, 3).tolist()
    for (step_x, step_y, turn), true_heading, (scale, turn_scale, curvature), noise, slip in zip(
        steps, headings[:-1], errors, white, slips.tolist(), strict=True
    ):
        n_along, n_across, n_turn = noise
        cosine, sine = math.cos(true_heading), math.sin(true_heading)
        distance = math.hypot(step_x, step_y)
        root = math.sqrt(distance)
        along = (1 + scale) * (cosine * step_x + sine * step_y)
        across = (1 + scale) * (cosine * step_y - sine * step_x)
        along += model.along_sigma_m_per_sqrt_m * root * n_along
        across += model.across_sigma_m_per_sqrt_m * root * n_across
        turn_sigma = (
            model.heading_sigma_rad_per_sqrt_m * root + model.heading_sigma_rad_per_rad * abs(turn)
        )
        along += slip[0]
        cosine, sine = math.cos(heading), math.sin(heading)
        x += cosine * along - sine * across
        y += sine * along + cosine * across
        heading += (1 + turn_scale) * turn + curvature * distance + turn_sigma * n_turn + slip[1]
        reported.append((x, y, heading))
    return np.array(reported, dtype=np.float64)


def _slips(n_steps: int, model: OdometrySpec, *, seed: int) -> NDArray[np.float64]:
    """Return what wheels report too much at each step, shape (n_steps, 2): [m forward, rad]."""
    slips = np.zeros((n_steps, 2))
    chances = uniforms(n_steps, seed=seed, stream=_SLIPS_STREAM)
    steps = np.flatnonzero(chances < model.slips_per_s / model.rate_hz)
    for kind, sigma in enumerate((model.slip_sigma_m, math.radians(model.slip_sigma_deg))):
        sizes = counter_normals(2 * steps + kind, seed=seed, stream=_SLIP_SIZES_STREAM)
        slips[steps, kind] = sigma * sizes
    slips[:, 0] = np.abs(slips[:, 0])
    return slips


def tum_line(t_ns: int, pose: Sequence[float]) -> str:
    """Return one TUM line: seconds as exact decimals, position, quaternion, as ``repr`` floats.

    >>> tum_line(200_000_000, (0.25, -1.0, 0.0))
    '0.200000000 0.25 -1.0 0 0 0 0.0 1.0'
    """
    seconds, nanoseconds = divmod(t_ns, 1_000_000_000)
    x, y, heading = (float(value) for value in pose)
    qz, qw = math.sin(heading / 2), math.cos(heading / 2)
    return f"{seconds}.{nanoseconds:09d} {x!r} {y!r} 0 0 0 {qz!r} {qw!r}"


def scene_odometry(scene: Scene, seed: int) -> tuple[str, ...]:
    """Return the run's wheel odometry as TUM lines, in time order from scene time 0.

    The frame is the robot's start pose, which is the world frame; only drift separates the two.
    """
    trajectory = scene.trajectory()
    times = odometry_times_ns(trajectory.duration_ns, scene.odometry.rate_hz)
    unseen = None
    if trajectory.carried_ns is not None:
        lifted_ns, down_ns = trajectory.carried_ns
        unseen = (times[1:] > lifted_ns) & (times[:-1] < down_ns)
    poses = drift(trajectory.poses(times), scene.odometry, seed=seed, unseen=unseen)
    return tuple(map(tum_line, times.tolist(), poses.tolist()))
