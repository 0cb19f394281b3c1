"""The state of the robust back end, its covariance, and its prediction from odometry.

The map frame is the body frame at the start. The state holds the heading theta, the position p,
the calibration errors (s, w, kappa) of the wheels, per radar a range offset b and how far its
antenna is from where the rig has it (m, body frame), and landmarks: axis l and radius rho.
Errors, in the order of the covariance P::

    [e_th, e_p (2), e_s, e_w, e_kappa, e_b (one per radar), e_m (two per radar),
     e_l0 (2), e_rho0, e_l1 (2), e_rho1, ..., e_w0 (2), ..., e_q0 (2), e_psi0, ...]
    theta = theta^ + e_th,   p = Rot(e_th) p^ + V(e_th) e_p,   l = Rot(e_th) l^ + V(e_th) e_l,
    phi = phi^ + e_th + e_phi,   d = d^ + e_d,
    q = Rot(e_th) q^ + V(e_th) e_q,   psi = psi^ + e_th + e_psi,

all others additive; (phi, d) is a wall, the line n . x = d with n = [cos phi, sin phi] away from
the robot. A past pose is a point q, as a landmark is, and a direction psi, as that of a wall is:
what is measured later corrects it, too, which makes the filter a fixed-lag smoother (Simon,
"Optimal State Estimation", 2006, section 9.3). Where the mounts, or the radii, are known, P has no
rows for them. An error of the heading thus turns the whole map with the robot, which ranges cannot
see: the linearised filter keeps the three unobservable directions of SLAM whatever the estimate
does. Sources: Barrau and Bonnabel, "An EKF-SLAM algorithm with consistency properties", 2015 (arXiv
1510.06263); Zhang, Wu, Song, Huang, Dissanayake, IEEE RA-L 2(2), 2017.

With the reported increment (ux, uy, ua) and the state's (s, w, kappa)::

    d = (ux, uy) / (1 + s),   D = |d|,   a = (ua - kappa D) / (1 + w),
    p' = p + R d,   theta' = theta + a,

and to first order, with J = [0, -1; 1, 0], heading noise n_a and step noise n_d::

    q      = kappa D / ((1 + s)(1 + w)) e_s - a / (1 + w) e_w - D / (1 + w) e_kappa + n_a
    e_th  += q,   e_p += -J p' q - R d / (1 + s) e_s + R n_d,   e_l += -J l q,   e_phi -= q.

That is the identity, two rows and a change of rank two: O(m^2), in place.

A change of low rank reads and writes the whole triangle, so in a large map memory is what it costs.
Changes of large matrices are therefore kept as factors,

    P = L + A B^T + B A^T - G G^T,

L the stored triangle, and carried out together. Columns and blocks, which are all that a step of
the filter reads, come out as if that had been done.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dsyr2, dsyr2k, dsyrk

from slam.config import WheelNoise
from slam.geometry import wrap_angle

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

# Up to this size the triangle lies in a core's cache: a pass is cheaper than putting it off.
_PROMPT_SIZE = 500
# How much is put off of either kind: so little that carrying it out takes no longer than a step
# may (n = 1000).
_MOST_GRAMS, _MOST_PAIRS = 44, 15
# Large matrices grow within spare rows. Not a power of two, columns would share cache sets.
_SPARE, _ODD = 128, 8

HEADING = 0
POSITION = slice(1, 3)
CALIBRATION = slice(3, 6)
HEAD_SIZE = 6
# Keeps the covariance of a pose that is exact regular [m^2, rad^2]
LEAST_VARIANCE = 1e-12
_SMALL_RAD = 1e-4


class SymmetricMatrix:
    """A symmetric matrix of which the lower triangle is stored, columns first."""

    __slots__ = ("_first", "_grams", "_lower", "_n_grams", "_n_pairs", "_second", "_size")

    def __init__(self, full: Array) -> None:
        self._store(np.asarray(full, dtype=np.float64), len(full))

    def _store(self, part: Array, size: int) -> None:
        """Store a square part as the first rows and columns of ``size`` ones."""
        room = size if size <= _PROMPT_SIZE else _SPARE * (size // _SPARE + 1) + _ODD
        self._lower: Array = np.zeros((room, room), order="F")
        self._lower[: len(part), : len(part)] = part
        self._size = size
        most_grams, most_pairs = (0, 0) if self._is_prompt else (_MOST_GRAMS, _MOST_PAIRS)
        self._grams: Array = np.zeros((room, most_grams), order="F")
        self._first: Array = np.zeros((room, most_pairs), order="F")
        self._second: Array = np.zeros((room, most_pairs), order="F")
        self._n_grams = self._n_pairs = 0

    @property
    def _is_prompt(self) -> bool:
        return len(self._lower) <= _PROMPT_SIZE

    @property
    def size(self) -> int:
        return self._size

    def columns(self, at: Indices) -> Array:
        """Return columns of the full matrix, shape (m, k)."""
        m, lower = self._size, self._lower
        # Rows together: small maps keep their bits, whatever is put off for large ones.
        result: Array = np.ascontiguousarray(lower[:m, at])
        for place, column in enumerate(at.tolist()):
            result[:column, place] = lower[column, :column]
        if self._n_grams or self._n_pairs:
            result += self._put_off(slice(0, m), at)
        return result

    def block(self, at: Indices) -> Array:
        """Return the principal submatrix of some indices, shape (k, k)."""
        part = self._lower[np.ix_(at, at)]
        result = np.where(at[:, None] < at[None, :], part.T, part)
        if self._n_grams or self._n_pairs:
            result += self._put_off(at, at)
        return result

    def full(self) -> Array:
        """Return a full copy, shape (m, m), symmetric bit for bit."""
        self._carry_out()
        lower = np.tril(self._lower[: self._size, : self._size])
        return np.asarray(lower + np.tril(lower, -1).T)

    def add_products(self, a: Array, b: Array) -> None:
        """Add ``a b^T + b a^T``; a and b have shape (m,)."""
        if self._is_prompt:
            self._lower = dsyr2(1.0, a, b, a=self._lower, lower=1, overwrite_a=1)
        else:
            self._put_off_pairs(a, b)

    def subtract_gram(self, W: Array) -> None:
        k = W.shape[1]
        if self._is_prompt:
            self._subtract_now(np.asfortranarray(W))
            return
        if self._n_grams + k > _MOST_GRAMS:
            self._carry_out_grams()
        if k > _MOST_GRAMS:
            tall = np.zeros((len(self._lower), k), order="F")
            tall[: self._size] = W
            self._subtract_now(tall)
            return
        self._grams[: self._size, self._n_grams : self._n_grams + k] = W
        self._n_grams += k

    def subtract_gains(self, K: Array, PHt: Array, S: Array) -> None:
        """Subtract ``K H P + P H^T K^T - K S K^T``: an update in Joseph's form.

        K has shape (m, k), PHt = P H^T too, S = H P H^T + R shape (k, k). An error of the gain
        enters squared, so nearly noiseless updates keep the matrix positive.
        """
        other = PHt - 0.5 * (K @ S)
        if self._is_prompt:
            self._add_pairs_now(np.asfortranarray(-K), np.asfortranarray(other))
        else:
            for column in range(K.shape[1]):
                self._put_off_pairs(-K[:, column], other[:, column])

    def add_diagonal(self, at: slice, values: Sequence[float]) -> None:
        for index, value in zip(range(at.start, at.stop), values, strict=True):
            self._lower[index, index] += value

    def replace_columns(self, at: slice, columns: Array) -> None:
        """Set neighbouring columns, and so their rows; shape (m, k), its own block symmetric."""
        for factors in (self._grams, self._first, self._second):
            factors[at] = 0.0
        begin, end, m = at.start, at.stop, self._size
        self._lower[at, :begin] = columns[:begin].T
        for index in range(begin, end):
            self._lower[index:m, index] = columns[index:, index - begin]

    def grow(self, cross: Array, corner: Array) -> None:
        """Append k rows: ``cross`` (m, k) is their covariance with the rest, ``corner`` (k, k)."""
        m, k = cross.shape
        if self._is_prompt or m + k > len(self._lower):
            self._carry_out()
            self._store(self._lower[:m, :m], m + k)
        self._lower[m : m + k, :m] = cross.T
        self._lower[m : m + k, m : m + k] = corner
        self._size = m + k

    def keep(self, at: Indices) -> None:
        """Marginalise all but some indices, which must increase; what stays, stays bit for bit."""
        self._carry_out()
        self._store(self._lower[np.ix_(at, at)], len(at))

    def _put_off(self, rows: Indices | slice, at: Indices) -> Array:
        """Return rows and columns of the changes not yet carried out."""
        first, second = self._first[:, : self._n_pairs], self._second[:, : self._n_pairs]
        grams = self._grams[:, : self._n_grams]
        products = first[rows] @ second[at].T + second[rows] @ first[at].T
        return np.asarray(products - grams[rows] @ grams[at].T)

    def _put_off_pairs(self, a: Array, b: Array) -> None:
        if self._n_pairs == _MOST_PAIRS:
            self._carry_out_pairs()
        self._first[: self._size, self._n_pairs] = a
        self._second[: self._size, self._n_pairs] = b
        self._n_pairs += 1

    def _carry_out(self) -> None:
        self._carry_out_grams()
        self._carry_out_pairs()

    def _carry_out_grams(self) -> None:
        if self._n_grams:
            self._subtract_now(self._grams[:, : self._n_grams])
        self._n_grams = 0

    def _carry_out_pairs(self) -> None:
        if self._n_pairs:
            self._add_pairs_now(self._first[:, : self._n_pairs], self._second[:, : self._n_pairs])
        self._n_pairs = 0

    def _subtract_now(self, W: Array) -> None:
        self._lower = dsyrk(-1.0, W, beta=1.0, c=self._lower, lower=1, overwrite_c=1)

    def _add_pairs_now(self, a: Array, b: Array) -> None:
        self._lower = dsyr2k(1.0, a, b, beta=1.0, c=self._lower, lower=1, overwrite_c=1)


@cache
def _normal_rule() -> tuple[Array, Array]:
    """Return nodes and weights (9,) of an integral over a normal number."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(9)
    return nodes, weights / math.sqrt(math.tau)


def rotation(angle_rad: float) -> Array:
    cosine, sine = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[cosine, -sine], [sine, cosine]])


def turned_covariance(covariance: Array, angle_rad: float) -> Array:
    """Return a covariance (3, 3) of x, y [m] and heading [rad] in another frame.

    Its own frame is turned in the other by the angle, as a body frame is in the map by its heading.
    """
    turn = np.eye(3)
    turn[:2, :2] = rotation(angle_rad)
    return np.asarray(turn @ covariance @ turn.T)


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


@dataclass(frozen=True, slots=True)
class RangeErrors:
    """Errors of ranges as the residuals of a solution show them."""

    added_m: float = 0.0  # what is added in squares to the sigmas of ranges of no known landmark
    # By how much the variance of a range must be larger where many are averaged: those of one
    # passage err alike. Below 1, errors are smaller than their standard deviations
    variance_share: float = 1.0


@dataclass(frozen=True, slots=True)
class Layout:
    """Where everything lies in the error."""

    n_radars: int
    n_landmarks: int = 0
    n_walls: int = 0
    has_mounts: bool = False
    has_radii: bool = False
    n_past: int = 0

    @property
    def offsets(self) -> slice:
        return slice(HEAD_SIZE, HEAD_SIZE + self.n_radars)

    @property
    def mounts(self) -> slice:
        """Return where the mounts are, an empty slice if they are known."""
        first = HEAD_SIZE + self.n_radars
        return slice(first, first + 2 * self.n_radars * self.has_mounts)

    def ranges_by_radars(self, directions: Array, headings_rad: Array, radars: Indices) -> Array:
        """Return d(range) / d(unknowns of the radars), (k, q), of k ranges.

        Given are the directions to what was ranged, (k, 2), the robot's headings in their frame
        (k,), and of which radar each is (k,).
        """
        is_of = np.equal.outer(radars, np.arange(self.n_radars)).astype(np.float64)
        if not self.has_mounts:
            return is_of
        c, s = np.cos(headings_rad), np.sin(headings_rad)
        x, y = directions.T
        by_place = -np.column_stack([c * x + s * y, c * y - s * x])
        by_mounts = is_of[:, :, None] * by_place[:, None, :]
        return np.hstack([is_of, by_mounts.reshape(len(radars), 2 * self.n_radars)])

    @property
    def landmark_size(self) -> int:
        return 3 if self.has_radii else 2

    @property
    def landmarks(self) -> slice:
        first = self.mounts.stop
        return slice(first, first + self.landmark_size * self.n_landmarks)

    @property
    def radii(self) -> slice:
        """Return where the radii are, if they are unknown."""
        return slice(self.landmarks.start + 2, self.landmarks.stop, 3)

    @property
    def walls(self) -> slice:
        first = self.landmarks.stop
        return slice(first, first + 2 * self.n_walls)

    @property
    def past(self) -> slice:
        """Return where the past poses are: x, y, and heading of each."""
        first = self.walls.stop
        return slice(first, first + 3 * self.n_past)

    @property
    def size(self) -> int:
        return int(self.past.stop)

    def first_columns(self, rows: Indices) -> Indices:
        """Return where features begin; walls are the rows from ``n_landmarks`` on."""
        of_landmark: Indices = self.mounts.stop + self.landmark_size * rows
        if not (self.n_walls and self.has_radii):
            return of_landmark
        of_wall = self.walls.start + 2 * (rows - self.n_landmarks)
        return np.asarray(np.where(rows < self.n_landmarks, of_landmark, of_wall))

    def columns(self, rows: Indices) -> Indices:
        """Return all columns of some features."""
        first = self.first_columns(rows)
        places = np.column_stack([first, first + 1, first + 2])
        of_feature = np.full(len(rows), self.landmark_size)
        of_feature[rows >= self.n_landmarks] = 2
        return np.asarray(places[np.arange(3) < of_feature[:, None]])


class State:
    """Mean and covariance of the filter, map frame; changed in place."""

    __slots__ = (
        "P",
        "added_sigmas_m",
        "calibration",
        "heading_rad",
        "landmark_ids",
        "landmarks_m",
        "mount_sigma_m",
        "mounts_m",
        "next_id",
        "offsets_m",
        "past",
        "past_numbers",
        "position_m",
        "radii_m",
        "radius_sigma_m",
        "range_errors",
        "wall_ids",
        "walls",
    )

    def __init__(
        self,
        calibration_sigmas: tuple[float, float, float],
        offset_sigmas_m: tuple[float, ...],
        mount_sigma_m: float = 0.0,
        radius_sigma_m: float = 0.0,
    ) -> None:
        self.heading_rad = 0.0
        self.position_m: Array = np.zeros(2)
        self.calibration: Array = np.zeros(3)  # s, w [1], kappa [rad/m]
        self.offsets_m: Array = np.zeros(len(offset_sigmas_m))  # what each radar measures too long
        # How far each antenna is from where the rig has it, body frame
        self.mounts_m: Array = np.zeros((len(offset_sigmas_m), 2))
        # Of the prior; zero: what it is about is known to be zero
        self.mount_sigma_m, self.radius_sigma_m = mount_sigma_m, radius_sigma_m
        self.landmarks_m: Array = np.zeros((0, 2))
        self.radii_m: Array = np.zeros(0)  # one per landmark; none where they are known
        self.landmark_ids: list[int] = []  # in row order; an id is never used twice
        self.walls: Array = np.zeros((0, 2))  # phi [rad], not wrapped, and d [m]
        self.wall_ids: list[int] = []  # from the same sequence as the landmarks'
        self.past: Array = np.zeros((0, 3))  # past poses: x [m], y [m] and heading, map frame
        self.past_numbers: list[int] = []  # which poses of the run they are, increasing
        # By id: what is added in squares to the sigmas of a feature's ranges
        self.added_sigmas_m: dict[int, float] = {}
        self.range_errors = RangeErrors()
        self.next_id = 0
        sigmas = [0.0, 0.0, 0.0, *calibration_sigmas, *offset_sigmas_m]
        if mount_sigma_m:
            sigmas += [mount_sigma_m] * (2 * len(offset_sigmas_m))
        # Covariance of the errors
        self.P = SymmetricMatrix(np.diag(np.square(sigmas)))

    @property
    def pose(self) -> Array:
        """Return [x m, y m, heading rad], map frame."""
        return np.array([self.position_m[0], self.position_m[1], self.heading_rad])

    @property
    def layout(self) -> Layout:
        return Layout(
            len(self.offsets_m),
            len(self.landmark_ids),
            len(self.wall_ids),
            self.mount_sigma_m > 0.0,
            self.radius_sigma_m > 0.0,
            len(self.past),
        )

    @property
    def n_fixed(self) -> int:
        """Return how many rows of the error come before those of the features."""
        return int(self.layout.landmarks.start)

    @property
    def radar_columns(self) -> Indices:
        """Return where the unknowns of the radars lie in the error."""
        return np.arange(HEAD_SIZE, self.n_fixed)

    @property
    def feature_ids(self) -> list[int]:
        return self.landmark_ids + self.wall_ids

    @property
    def feature_radii_m(self) -> Array:
        n, n_walls = len(self.landmark_ids), len(self.wall_ids)
        radii_m = self.radii_m if self.radius_sigma_m else np.zeros(n)
        return np.concatenate([radii_m, np.zeros(n_walls)])

    @property
    def feature_added_sigmas_m(self) -> Array:
        return np.array([self.added_sigmas_m.get(id_, 0.0) for id_ in self.feature_ids])

    def landmark_columns(self, rows: Indices) -> Indices:
        """Return where (x, y), or (phi, d), lie in the error, (2 k,); walls are rows from n on."""
        first = self.layout.first_columns(rows)
        return np.stack([first, first + 1], axis=-1).ravel()

    def correct(self, error: Array) -> None:
        """Move the mean by an error, by the exact formulas above; shape (m,)."""
        angle = float(error[HEADING])
        turn, V = rotation(angle), left_jacobian(angle)
        self.heading_rad = wrap_angle(self.heading_rad + angle)
        self.position_m = turn @ self.position_m + V @ error[POSITION]
        self.calibration = self.calibration + error[CALIBRATION]
        layout = self.layout
        self.offsets_m = self.offsets_m + error[layout.offsets]
        if layout.has_mounts:
            self.mounts_m = self.mounts_m + error[layout.mounts].reshape(-1, 2)
        shifts = error[layout.landmarks].reshape(-1, layout.landmark_size)
        self.landmarks_m = self.landmarks_m @ turn.T + shifts[:, :2] @ V.T
        if layout.has_radii:
            self.radii_m = self.radii_m + shifts[:, 2]
        self.walls = self.walls + error[layout.walls].reshape(-1, 2) + [angle, 0.0]
        shifts = error[layout.past].reshape(-1, 3)
        places = self.past[:, :2] @ turn.T + shifts[:, :2] @ V.T
        self.past = np.column_stack([places, self.past[:, 2] + angle + shifts[:, 2]])

    def update(self, at: Indices, H: Array, residual: Array, R: Array) -> float:
        """Correct mean and covariance with k measurements, ``residual = z - h``.

        With S = H P H^T + R = L L^T and W = P H^T L^-T: ``error = W L^-1 residual``, ``P -= W
        W^T``, one pass over the triangle. H has shape (k, c), entries for the columns ``at`` (c,)
        of the error; R (k, k) or its diagonal (k,). Returns the normalised innovation squared (k
        dof).
        """
        PHt = self.P.columns(at) @ H.T
        S = H @ PHt[at]
        S = (S + S.T) / 2 + (np.diag(R) if R.ndim == 1 else R)
        L = np.linalg.cholesky(S)
        L_inverse = np.linalg.inv(L)
        W = PHt @ L_inverse.T
        whitened = L_inverse @ residual
        self.apply(W, whitened)
        return float(whitened @ whitened)

    def apply(self, W: Array, whitened: Array) -> None:
        """Move the mean by ``W whitened`` and take ``W W^T`` off the covariance."""
        self.P.subtract_gram(W)
        self.correct(W @ whitened)

    def augment(self, point_m: Array, cross: Array, corner: Array, radius_m: float = 0.0) -> int:
        """Append a landmark and return its id.

        ``cross`` (m, k) is the covariance with the rest, ``corner`` (k, k) its own, k = 3 with the
        radius and 2 without.
        """
        self._insert(self.layout.landmarks.stop, cross, corner)
        self.landmarks_m = np.vstack([self.landmarks_m, point_m])
        if self.radius_sigma_m:
            self.radii_m = np.append(self.radii_m, radius_m)
        self.landmark_ids.append(self.next_id)
        self.next_id += 1
        return self.landmark_ids[-1]

    def augment_wall(self, wall: Array, cross: Array, corner: Array) -> int:
        """Append a wall (phi, d) and return its id; ``cross`` (m, 2), ``corner`` (2, 2)."""
        self._insert(self.layout.walls.stop, cross, corner)
        self.walls = np.vstack([self.walls, wall])
        self.wall_ids.append(self.next_id)
        self.next_id += 1
        return self.wall_ids[-1]

    def _insert(self, at: int, cross: Array, corner: Array) -> None:
        """Let P have rows of something new, the first of them at an index."""
        behind, k = self.P.size - at, len(corner)
        self.P.grow(cross, corner)
        if behind:
            order = np.arange(self.P.size)
            order[at:] = np.roll(order[at:], k)
            self.P = SymmetricMatrix(self.P.full()[np.ix_(order, order)])

    def keep_pose(self, number: int) -> None:
        """Append the pose to the past ones; ``number`` says which pose of the run it is."""
        cross, at = np.zeros((self.P.size, 3)), np.array([1, 2])
        cross[:, :2] = self.P.columns(at)
        corner = np.zeros((3, 3))
        corner[:2, :2] = self.P.block(at)
        self.P.grow(cross, corner)
        self.past = np.vstack([self.past, self.pose])
        self.past_numbers.append(number)

    def marginalise_past(self, places: slice) -> None:
        """Marginalise some of the past poses, which are in the order of the run."""
        gone = np.arange(len(self.past))[places]
        columns = self.layout.past.start + 3 * gone[:, None] + np.arange(3)
        self.P.keep(np.delete(np.arange(self.P.size), columns.ravel()))
        self.past = np.delete(self.past, gone, axis=0)
        del self.past_numbers[places]

    def remove(self, row: int) -> None:
        """Marginalise a landmark, or a wall; the covariance of the rest stays bit for bit."""
        gone = self.layout.columns(np.array([row]))
        self.P.keep(np.delete(np.arange(self.P.size), gone))
        n = len(self.landmark_ids)
        self.added_sigmas_m.pop(self.feature_ids[row], None)
        if row < n:
            self.landmarks_m = np.delete(self.landmarks_m, row, axis=0)
            if self.radius_sigma_m:
                self.radii_m = np.delete(self.radii_m, row)
            del self.landmark_ids[row]
        else:
            self.walls = np.delete(self.walls, row - n, axis=0)
            del self.wall_ids[row - n]

    def pose_covariance(self) -> Array:
        """Return the covariance of [x, y, heading], shape (3, 3): e_add,p = e_p + J p e_th."""
        P = self.P.block(np.array([1, 2, 0]))
        T = np.eye(3)
        T[:2, 2] = quarter_turn(self.position_m)
        return np.asarray(T @ P @ T.T)

    def past_pose(self, k: int) -> PastPose:
        """Return the k-th oldest past pose, with the same covariance."""
        first, place = self.layout.past.start + 3 * k, self.past[k, :2]
        P = self.P.block(np.array([HEADING, first, first + 1, first + 2]))
        T = np.column_stack([[*quarter_turn(place), 1.0], np.eye(3)])
        return PastPose(
            number=self.past_numbers[k],
            pose=np.append(place, wrap_angle(float(self.past[k, 2]))),
            covariance=T @ P @ T.T,
        )

    def curved_covariance(self) -> Array:
        """Return what large errors of the heading add to the position's covariance (2, 2) [m^2].

        The position p = Rot(e_th) p^ + V(e_th) e_p lies on an arc about the start, which no ellipse
        of additive errors covers. The second moment of its error, e_p given e_th being normal, is
        integrated over e_th by Gauss and Hermite's rule; what exceeds the linear covariance in any
        direction is returned.
        """
        P = self.P.block(np.array([0, 1, 2]))
        variance = float(P[0, 0])
        if variance <= 0.0:
            return np.zeros((2, 2))
        along = P[1:, 0] / variance
        given = P[1:, 1:] - np.outer(along, P[0, 1:])
        nodes, weights = _normal_rule()
        angles = math.sqrt(variance) * nodes
        # V(a) = f I + g J
        f, g = np.sinc(angles / math.pi), angles / 2.0 * np.sinc(angles / math.tau) ** 2
        x, y = self.position_m.tolist()
        moved = np.outer(angles * f, along) + np.outer(angles * g, quarter_turn(along))
        moved[:, 0] += (np.cos(angles) - 1.0) * x - np.sin(angles) * y
        moved[:, 1] += np.sin(angles) * x + (np.cos(angles) - 1.0) * y
        turned = quarter_turn(given.T).T  # J given
        both = turned + turned.T
        opposite = quarter_turn(turned)  # J given J^T
        curved = (moved.T * weights) @ moved
        curved += float(weights @ f**2) * given + float(weights @ (f * g)) * both
        curved += float(weights @ g**2) * opposite
        linear = self.pose_covariance()[:2, :2]
        values, vectors = np.linalg.eigh(curved - linear)
        return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)

    def set_pose(self, pose: Array, covariance: Array) -> None:
        """Set the pose, x [m], y [m] and heading, and the (3, 3) covariance of its additive error.

        That is independent of all others'; theirs stay what they were.
        """
        T = self.additive_transform()
        P = T @ self.P.full() @ T.T
        P[:3, :], P[:, :3] = 0.0, 0.0
        order = np.array([2, 0, 1])
        P[:3, :3] = covariance[np.ix_(order, order)]
        self.position_m, self.heading_rad = np.array(pose[:2]), float(pose[2])
        self.set_additive_covariance(P)

    def set_additive_covariance(self, covariance: Array) -> None:
        """Set the covariance from that of additive errors at the present mean, (m, m)."""
        # e_p = e_add,p - J p e_th, landmarks likewise
        T = self.additive_transform()
        T[1:, HEADING] *= -1.0
        P = T @ covariance @ T.T
        self.P = SymmetricMatrix((P + P.T) / 2)

    def take_calibration(self, other: State) -> None:
        """Take over all of a state that is no pose or landmark, in a state without landmarks."""
        self.calibration, self.offsets_m = other.calibration.copy(), other.offsets_m.copy()
        self.mounts_m, self.range_errors = other.mounts_m.copy(), other.range_errors
        known = np.arange(CALIBRATION.start, self.n_fixed)
        P = self.P.full()
        P[np.ix_(known, known)] = other.P.block(known)
        self.P = SymmetricMatrix(P)

    def additive_transform(self) -> Array:
        """Return T with e_additive = T e, shape (m, m), at the present mean."""
        T = np.eye(self.P.size)
        T[POSITION, HEADING] = quarter_turn(self.position_m)
        T[self.n_fixed :, HEADING] = self.turned_features()
        return T

    def turned_features(self) -> Array:
        """Return d(features, past poses) / d(heading) as the whole map turns, by columns."""
        landmarks = quarter_turn(self.landmarks_m)
        if self.radius_sigma_m:
            landmarks = np.column_stack([landmarks, np.zeros(len(landmarks))])
        walls = np.zeros_like(self.walls)
        walls[:, 0] = 1.0
        past = np.column_stack([quarter_turn(self.past[:, :2]), np.ones(len(self.past))])
        return np.concatenate([landmarks.ravel(), walls.ravel(), past.ravel()])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PastPose:
    """A past pose of the state, and which one of the run it is."""

    number: int
    pose: Array  # shape (3,)
    covariance: Array  # shape (3, 3), of the additive error


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Motion:
    """One increment of the body frame before it, corrected for the calibration errors."""

    step_m: Array  # shape (2,), d above
    turn_rad: float
    covariance: Array  # of (d, a), shape (3, 3)
    walk_variance: float

    @property
    def distance_m(self) -> float:
        return math.hypot(self.step_m[0], self.step_m[1])


def free_motion(sigma_m: float, sigma_rad: float) -> Motion:
    """Return a motion that is known by its standard deviations alone: along each axis, and turn."""
    covariance = np.diag(np.square([sigma_m, sigma_m, sigma_rad]))
    return Motion(step_m=np.zeros(2), turn_rad=0.0, covariance=covariance, walk_variance=0.0)


def calibrated_motion(
    increment: Array, calibration: Array, wheels: WheelNoise, covariance: Array | None = None
) -> Motion:
    """Return the motion that a reported increment (ux, uy [m], ua [rad]) stands for.

    ``calibration`` is (s, w, kappa); ``covariance`` (3, 3) replaces the noise of the wheels' model.
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
    direction[state.n_fixed :] = -state.turned_features()
    along = head[:, 2:] @ gains
    along[POSITION] += by_scale * along[CALIBRATION.start]
    variance = float(gains @ along[CALIBRATION]) + float(motion.covariance[2, 2])
    along += 0.5 * variance * direction
    along[POSITION] += R @ motion.covariance[:2, 2]
    P.add_products(direction, along)

    if motion.walk_variance > 0.0:
        walks = [motion.walk_variance * sigma**2 for sigma in wheels.calibration_sigmas]
        P.add_diagonal(CALIBRATION, walks)
