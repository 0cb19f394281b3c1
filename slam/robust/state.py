"""The state of the filter and its right-invariant error.

The map frame is the body frame at the start. The state holds the heading theta, the position p,
the calibration errors (s, w, kappa) of the wheels, one range offset b per radar, and landmarks l.
Errors, in the order of the covariance P::

    [e_th, e_p (2), e_s, e_w, e_kappa, e_b (one per radar), e_l0 (2), e_l1 (2), ..., e_w0 (2), ...]
    theta = theta^ + e_th,   p = Rot(e_th) p^ + V(e_th) e_p,   l = Rot(e_th) l^ + V(e_th) e_l,
    phi = phi^ + e_th + e_phi,   d = d^ + e_d,

all others additive; (phi, d) is a wall, the line n . x = d with n = [cos phi, sin phi] away from
the robot. An error of the heading thus turns the whole map with the robot, which ranges
cannot see: the linearised filter keeps the three unobservable directions of SLAM whatever the
estimate does. Sources: Barrau and Bonnabel, "An EKF-SLAM algorithm with consistency properties",
2015 (arXiv 1510.06263); Zhang, Wu, Song, Huang, Dissanayake, IEEE RA-L 2(2), 2017.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from slam.geometry import wrap_angle
from slam.robust.symmetric import Array, Indices, SymmetricMatrix

HEADING = 0
POSITION = slice(1, 3)
CALIBRATION = slice(3, 6)
HEAD_SIZE = 6
_SMALL_RAD = 1e-4


def rotation(angle_rad: float) -> Array:
    """Return the matrix that turns the plane counter-clockwise, shape (2, 2)."""
    cosine, sine = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[cosine, -sine], [sine, cosine]])


def left_jacobian(angle_rad: float) -> Array:
    """Return V(a) = [sin a, cos a - 1; 1 - cos a, sin a] / a, shape (2, 2)."""
    a = angle_rad
    if abs(a) < _SMALL_RAD:
        along, across = 1.0 - a * a / 6.0, a / 2.0 - a**3 / 24.0
    else:
        # 1 - cos a = 2 sin^2(a / 2), without the cancellation.
        along, across = math.sin(a) / a, 2.0 * math.sin(a / 2.0) ** 2 / a
    return np.array([[along, -across], [across, along]])


def quarter_turn(points: Array) -> Array:
    """Return J x for points x of shape (..., 2), J = [0, -1; 1, 0]."""
    return np.stack([-points[..., 1], points[..., 0]], axis=-1)


class State:
    """Mean and covariance of the filter; changed in place by the functions of this package.

    Parameters
    ----------
    calibration_sigmas
        Of s, w and kappa.
    offset_sigmas_m
        Of each radar's range offset, one per radar.

    Attributes
    ----------
    heading_rad, position_m
        Pose in the map frame; shape (2,).
    calibration
        shape (3,): s, w [1], kappa [rad/m].
    offsets_m
        shape (r,), what each radar measures too long.
    landmarks_m
        shape (n, 2), map frame.
    landmark_ids
        n ids in row order; an id is never used twice.
    walls
        shape (w, 2): phi [rad], not wrapped, and d [m], map frame.
    wall_ids
        w ids in row order, of the same numbers as the landmarks'.
    radii_m, range_doubts_m
        Radius of each landmark known to be round, by id, whose axis is the landmark; and what is
        added in squares to the ranges of a feature: not knowing its radius better, a wall's
        roughness.
    P
        Covariance of the errors, size 6 + r + 2 (n + w).
    """

    __slots__ = (
        "P",
        "calibration",
        "heading_rad",
        "landmark_ids",
        "landmarks_m",
        "next_id",
        "offsets_m",
        "position_m",
        "radii_m",
        "range_doubts_m",
        "wall_ids",
        "walls",
    )

    def __init__(
        self, calibration_sigmas: tuple[float, float, float], offset_sigmas_m: tuple[float, ...]
    ) -> None:
        self.heading_rad = 0.0
        self.position_m: Array = np.zeros(2)
        self.calibration: Array = np.zeros(3)
        self.offsets_m: Array = np.zeros(len(offset_sigmas_m))
        self.landmarks_m: Array = np.zeros((0, 2))
        self.landmark_ids: list[int] = []
        self.walls: Array = np.zeros((0, 2))
        self.wall_ids: list[int] = []
        self.radii_m: dict[int, float] = {}
        self.range_doubts_m: dict[int, float] = {}
        self.next_id = 0
        sigmas = [0.0, 0.0, 0.0, *calibration_sigmas, *offset_sigmas_m]
        self.P = SymmetricMatrix(np.diag(np.square(sigmas)))

    @property
    def pose(self) -> Array:
        """Return [x m, y m, heading rad], map frame, shape (3,)."""
        return np.array([self.position_m[0], self.position_m[1], self.heading_rad])

    @property
    def offsets(self) -> slice:
        """Return where the range offsets lie in the error."""
        return slice(HEAD_SIZE, HEAD_SIZE + len(self.offsets_m))

    @property
    def feature_ids(self) -> list[int]:
        """Return the ids of landmarks and walls in the order of their columns."""
        return self.landmark_ids + self.wall_ids

    @property
    def features(self) -> Array:
        """Return landmarks and walls in the order of their columns, shape (n + w, 2)."""
        return np.vstack([self.landmarks_m, self.walls])

    @property
    def feature_radii_m(self) -> Array:
        """Return the radii of landmarks and walls in the order of their columns, (n + w,)."""
        return np.array([self.radii_m.get(id_, 0.0) for id_ in self.feature_ids])

    @property
    def feature_doubts_m(self) -> Array:
        """Return what doubt adds to the ranges of landmarks and walls, (n + w,)."""
        return np.array([self.range_doubts_m.get(id_, 0.0) for id_ in self.feature_ids])

    def landmark_columns(self, rows: NDArray[np.intp]) -> Indices:
        """Return where landmarks lie in the error, shape (2 k,); walls are the rows from n on."""
        first = self.offsets.stop + 2 * rows
        return np.stack([first, first + 1], axis=-1).ravel()

    def correct(self, error: Array) -> None:
        """Move the mean by an error, by the exact formulas above; shape (m,)."""
        angle = float(error[HEADING])
        turn, V = rotation(angle), left_jacobian(angle)
        self.heading_rad = wrap_angle(self.heading_rad + angle)
        self.position_m = turn @ self.position_m + V @ error[POSITION]
        self.calibration = self.calibration + error[CALIBRATION]
        self.offsets_m = self.offsets_m + error[self.offsets]
        shifts = error[self.offsets.stop :].reshape(-1, 2)
        n = len(self.landmarks_m)
        self.landmarks_m = self.landmarks_m @ turn.T + shifts[:n] @ V.T
        self.walls = self.walls + shifts[n:] + [angle, 0.0]

    def update(self, at: Indices, H: Array, residual: Array, R: Array) -> tuple[float, Array]:
        """Correct mean and covariance with k measurements, ``residual = z - h``.

        With S = H P H^T + R = L L^T and W = P H^T L^-T: ``error = W L^-1 residual``,
        ``P -= W W^T``, one pass over the triangle.

        Parameters
        ----------
        at
            Columns of the error that H has entries for, shape (c,).
        H
            shape (k, c).
        residual
            shape (k,).
        R
            Measurement noise, shape (k, k) or its diagonal, shape (k,).

        Returns
        -------
        nis, S
            Normalised innovation squared (k degrees of freedom), and S, shape (k, k).
        """
        PHt = self.P.columns(at) @ H.T
        S = H @ PHt[at]
        S = (S + S.T) / 2 + (np.diag(R) if R.ndim == 1 else R)
        L = np.linalg.cholesky(S)
        L_inverse = np.linalg.inv(L)
        W = PHt @ L_inverse.T
        whitened = L_inverse @ residual
        self.P.subtract_gram(W)
        self.correct(W @ whitened)
        return float(whitened @ whitened), S

    def augment(self, point_m: Array, cross: Array, corner: Array) -> int:
        """Append a landmark and return its id; ``cross`` (m, 2), ``corner`` (2, 2)."""
        self.P.grow(cross, corner)
        if self.wall_ids:
            self._move_last_before_walls()
        self.landmarks_m = np.vstack([self.landmarks_m, point_m])
        landmark_id = self.next_id
        self.landmark_ids.append(landmark_id)
        self.next_id += 1
        return landmark_id

    def augment_wall(self, wall: Array, cross: Array, corner: Array) -> int:
        """Append a wall (phi, d) and return its id; ``cross`` (m, 2), ``corner`` (2, 2)."""
        self.P.grow(cross, corner)
        self.walls = np.vstack([self.walls, wall])
        wall_id = self.next_id
        self.wall_ids.append(wall_id)
        self.next_id += 1
        return wall_id

    def _move_last_before_walls(self) -> None:
        m, n_walls = self.P.size, 2 * len(self.wall_ids)
        order = np.arange(m)
        order[m - n_walls - 2 :] = np.roll(order[m - n_walls - 2 :], 2)
        self.P = SymmetricMatrix(self.P.full()[np.ix_(order, order)])

    def remove(self, row: int) -> None:
        """Marginalise a landmark, or a wall; the covariance of the rest stays bit for bit."""
        first = self.offsets.stop + 2 * row
        self.P.keep(np.delete(np.arange(self.P.size), [first, first + 1]))
        n = len(self.landmark_ids)
        self.radii_m.pop(self.feature_ids[row], None)
        self.range_doubts_m.pop(self.feature_ids[row], None)
        if row < n:
            self.landmarks_m = np.delete(self.landmarks_m, row, axis=0)
            del self.landmark_ids[row]
        else:
            self.walls = np.delete(self.walls, row - n, axis=0)
            del self.wall_ids[row - n]

    def pose_covariance(self) -> Array:
        """Return the covariance of [x, y, heading] with additive errors, shape (3, 3).

        To first order e_add,p = e_p + J p e_th.
        """
        P = self.P.block(np.array([1, 2, 0]))
        T = np.eye(3)
        T[:2, 2] = quarter_turn(self.position_m)
        return np.asarray(T @ P @ T.T)

    def landmark_covariance(self, row: int) -> Array:
        """Return the covariance of one landmark's position in the map frame, shape (2, 2)."""
        first = self.offsets.stop + 2 * row
        P = self.P.block(np.array([0, first, first + 1]))
        T = np.column_stack([quarter_turn(self.landmarks_m[row]), np.eye(2)])
        return np.asarray(T @ P @ T.T)

    def additive_transform(self) -> Array:
        """Return T with e_additive = T e, shape (m, m), at the present mean."""
        T = np.eye(self.P.size)
        T[POSITION, HEADING] = quarter_turn(self.position_m)
        T[self.offsets.stop :, HEADING] = self.turned_features().ravel()
        return T

    def turned_features(self) -> Array:
        """Return d(landmark, wall) / d(heading) as the whole map turns, shape (n + w, 2)."""
        walls = np.zeros_like(self.walls)
        walls[:, 0] = 1.0
        return np.vstack([quarter_turn(self.landmarks_m), walls])
