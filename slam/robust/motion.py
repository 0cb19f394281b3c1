"""Prediction: the robot moves by an odometry increment whose calibration errors are states.

With the reported increment (ux, uy, ua) and the state's (s, w, kappa)::

    d = (ux, uy) / (1 + s),   D = |d|,   a = (ua - kappa D) / (1 + w),
    p' = p + R d,   theta' = theta + a,

and to first order, with J = [0, -1; 1, 0], heading noise n_a and step noise n_d::

    q      = kappa D / ((1 + s)(1 + w)) e_s - a / (1 + w) e_w - D / (1 + w) e_kappa + n_a
    e_th  += q,   e_p += -J p' q - R d / (1 + s) e_s + R n_d,   e_l += -J l q,   e_phi -= q.

That is the identity, two rows and a change of rank two: O(m^2), in place.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from slam.geometry import wrap_angle
from slam.robust.parameters import WheelNoise
from slam.robust.state import CALIBRATION, HEADING, POSITION, State, quarter_turn, rotation
from slam.robust.symmetric import Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Motion:
    """One increment of the body frame before it, freed of the calibration errors.

    ``step_m`` has shape (2,), d above; ``covariance`` of (d, a), shape (3, 3).
    """

    step_m: Array
    turn_rad: float
    covariance: Array
    walk_variance: float

    @property
    def distance_m(self) -> float:
        """Return the length of the step."""
        return math.hypot(self.step_m[0], self.step_m[1])


def at_rest() -> Motion:
    """Return no motion at all."""
    return Motion(step_m=np.zeros(2), turn_rad=0.0, covariance=np.zeros((3, 3)), walk_variance=0.0)


def calibrated_motion(
    increment: Array, calibration: Array, wheels: WheelNoise, covariance: Array | None = None
) -> Motion:
    """Return the motion that a reported increment stands for.

    Parameters
    ----------
    increment
        shape (3,): ux, uy [m], ua [rad].
    calibration
        shape (3,): s, w, kappa.
    wheels
        Gives the noise of the step ...
    covariance
        ... unless it is known, shape (3, 3).
    """
    s, w, kappa = (float(value) for value in calibration)
    step = np.asarray(increment[:2]) / (1.0 + s)
    distance_m = math.hypot(step[0], step[1])
    turn_rad = (float(increment[2]) - kappa * distance_m) / (1.0 + w)
    if covariance is None:
        covariance = np.diag(wheels.step_variances(distance_m, turn_rad))
    return Motion(
        step_m=step,
        turn_rad=turn_rad,
        covariance=covariance,
        walk_variance=wheels.walk_variance(distance_m, turn_rad),
    )


def predict(state: State, motion: Motion, wheels: WheelNoise) -> None:
    """Move mean and covariance of the state by one motion, in place."""
    s, w, kappa = (float(value) for value in state.calibration)
    P, R = state.P, rotation(state.heading_rad)
    moved = R @ motion.step_m
    state.position_m = state.position_m + moved
    state.heading_rad = wrap_angle(state.heading_rad + motion.turn_rad)

    # e_p += -R d / (1 + s) e_s + R n_d
    head = P.columns(np.arange(1, 6))
    scale = head[:, 2]
    by_scale = -moved / (1.0 + s)
    position = head[:, :2] + np.outer(scale, by_scale)
    position[POSITION] += np.outer(by_scale, scale[POSITION] + by_scale * scale[CALIBRATION.start])
    position[POSITION] += R @ motion.covariance[:2, :2] @ R.T
    P.replace_columns(POSITION, position)

    # e += direction * q
    gains = np.array(
        [
            kappa * motion.distance_m / ((1.0 + s) * (1.0 + w)),
            -motion.turn_rad / (1.0 + w),
            -motion.distance_m / (1.0 + w),
        ]
    )
    direction = np.zeros(P.size)
    direction[HEADING] = 1.0
    direction[POSITION] = -quarter_turn(state.position_m)
    direction[state.offsets.stop :] = -state.turned_features().ravel()
    along = head[:, 2:] @ gains
    along[POSITION] += by_scale * along[CALIBRATION.start]
    variance = float(gains @ along[CALIBRATION]) + float(motion.covariance[2, 2])
    along += 0.5 * variance * direction
    along[POSITION] += R @ motion.covariance[:2, 2]
    P.add_products(direction, along)

    if motion.walk_variance > 0.0:
        walks = [motion.walk_variance * sigma**2 for sigma in wheels.calibration_sigmas]
        P.add_diagonal(CALIBRATION, walks)
