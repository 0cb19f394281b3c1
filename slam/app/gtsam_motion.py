"""A step of wheels with calibration errors as a factor for GTSAM, which has none.

Between poses 0 and 1, with d = (ux, uy) / (1 + s), D = |d| and a = (ua - kappa D) / (1 + w)::

    r = [R0^T (p1 - p0) - d, theta1 - theta0 - a]

Derivatives are by body-frame changes of the poses (GTSAM's) and by (s, w, kappa). Plain floats:
the function runs once per step and linearisation, and arrays of three cost more than they do.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Pose = tuple[float, float, float]


def wheel_residual(before: Pose, after: Pose, calibration: Pose, increment: Pose) -> Array:
    """Return r, shape (3,): [m, m, rad]; poses (x, y, heading), calibration (s, w, kappa)."""
    s, w, kappa = calibration
    ux, uy, ua = increment
    cosine, sine = math.cos(before[2]), math.sin(before[2])
    dx, dy = after[0] - before[0], after[1] - before[1]
    distance = math.hypot(ux, uy) / (1.0 + s)
    turn = (ua - kappa * distance) / (1.0 + w)
    return np.array(
        [
            cosine * dx + sine * dy - ux / (1.0 + s),
            -sine * dx + cosine * dy - uy / (1.0 + s),
            math.remainder(after[2] - before[2] - turn, math.tau),
        ]
    )


def wheel_derivatives(
    before: Pose, after: Pose, calibration: Pose, increment: Pose
) -> tuple[Array, Array, Array]:
    """Return dr / d(before), dr / d(after), dr / d(calibration), shape (3, 3) each."""
    s, w, kappa = calibration
    ux, uy, ua = increment
    cosine, sine = math.cos(before[2]), math.sin(before[2])
    dx, dy = after[0] - before[0], after[1] - before[1]
    along, across = cosine * dx + sine * dy, -sine * dx + cosine * dy
    gain, turn_gain = 1.0 / (1.0 + s), 1.0 / (1.0 + w)
    distance = math.hypot(ux, uy) * gain
    turn = (ua - kappa * distance) * turn_gain
    c, sn = math.cos(after[2] - before[2]), math.sin(after[2] - before[2])
    return (
        np.array([[-1.0, 0.0, across], [0.0, -1.0, -along], [0.0, 0.0, -1.0]]),
        np.array([[c, -sn, 0.0], [sn, c, 0.0], [0.0, 0.0, 1.0]]),
        np.array(
            [
                [ux * gain**2, 0.0, 0.0],
                [uy * gain**2, 0.0, 0.0],
                [-kappa * distance * gain * turn_gain, turn * turn_gain, distance * turn_gain],
            ]
        ),
    )


def wheel_factor(
    gtsam: Any,  # noqa: ANN401 - GTSAM's own types, see gtsam_door
    keys: tuple[int, int, int],
    increment: Array,
    sigmas: Array,
) -> Any:  # noqa: ANN401
    """Return the factor.

    Parameters
    ----------
    gtsam
        The module.
    keys
        Of the pose before, the pose after, and (s, w, kappa).
    increment
        Shape (3,), as reported: ux, uy [m], ua [rad].
    sigmas
        Shape (3,), standard deviations of r.
    """
    ux, uy, ua = (float(value) for value in increment)
    before_key, after_key, calibration_key = keys

    def error(_: object, values: Any, jacobians: Any) -> Array:  # noqa: ANN401
        first, second = values.atPose2(before_key), values.atPose2(after_key)
        before = (first.x(), first.y(), first.theta())
        after = (second.x(), second.y(), second.theta())
        s, w, kappa = values.atVector(calibration_key).tolist()
        if jacobians is not None:
            found = wheel_derivatives(before, after, (s, w, kappa), (ux, uy, ua))
            for row, derivative in enumerate(found):
                jacobians[row] = derivative
        return wheel_residual(before, after, (s, w, kappa), (ux, uy, ua))

    return gtsam.CustomFactor(gtsam.noiseModel.Diagonal.Sigmas(sigmas), list(keys), error)
