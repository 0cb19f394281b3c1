"""What the robust filter must agree with: its error model written again in complex numbers.

And the derivatives of any range, of which the filter has those that it uses in a compiled loop.
"""

import math
from dataclasses import dataclass

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from slam.robust.association import View
from slam.robust.state import Indices, State, SymmetricMatrix

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

N_RADARS = 4


def turn(angle: complex) -> Complex:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def v_matrix(angle: complex) -> Complex:
    """Return V(a), by its series where 1 - cos a would lose digits."""
    if abs(angle) < 1e-2:
        along = 1 - angle**2 / 6 + angle**4 / 120
        across = angle / 2 - angle**3 / 24 + angle**5 / 720
    else:
        along, across = np.sin(angle) / angle, (1 - np.cos(angle)) / angle
    return np.array([[along, -across], [across, along]])


def values(state: State) -> Array:
    """Return [theta, p, s, w, kappa, b, l...] in the order of the errors."""
    return np.concatenate(
        [
            [state.heading_rad],
            state.position_m,
            state.calibration,
            state.offsets_m,
            state.landmarks_m.ravel(),
        ]
    )


def plus(mean: Complex, error: Complex) -> Complex:
    """Return the values that lie a right-invariant error off the mean."""
    result = mean + error
    R, V = turn(error[0]), v_matrix(error[0])
    for first in (1, *range(6 + N_RADARS, len(mean), 2)):
        at = slice(first, first + 2)
        result[at] = R @ mean[at] + V @ error[at]
    return result


def minus(true: Complex, mean: Complex) -> Complex:
    """Return the right-invariant error of a mean."""
    error = true - mean
    R, V = turn(error[0]), v_matrix(error[0])
    for first in (1, *range(6 + N_RADARS, len(mean), 2)):
        at = slice(first, first + 2)
        error[at] = np.linalg.solve(V, true[at] - R @ mean[at])
    return error


def moved(x: Complex, increment: Array, noise: Complex) -> Complex:
    """Return the values after a reported increment; noise (along, across, heading)."""
    s, w, kappa = x[3:6]
    d = increment[:2] / (1 + s)
    D = np.sqrt(d @ d)
    a = (increment[2] - kappa * D) / (1 + w)
    result = x.copy()
    result[1:3] = x[1:3] + turn(x[0]) @ (d + noise[:2])
    result[0] = x[0] + a + noise[2]
    return result


def range_to(x: Complex, landmark: int, radar: int, antenna: Array) -> complex:
    first = 6 + N_RADARS + 2 * landmark
    away = x[first : first + 2] - x[1:3] - turn(x[0]) @ antenna
    result: complex = np.sqrt(away @ away) + x[6 + radar]
    return result


def body_point(x: Complex, landmark: int) -> Complex:
    first = 6 + N_RADARS + 2 * landmark
    result: Complex = turn(x[0]).T @ (x[first : first + 2] - x[1:3])
    return result


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rows:
    """Range measurements that could be made: row i is of radar ``radars[i]``, one landmark each."""

    # shape (k,): index of the radar, row of the landmark; walls are the rows from n on
    radars: Indices
    landmarks: Indices
    at: Indices  # columns of the error that H has entries for, shape (c,)
    H: Array  # shape (k, c)
    predicted_m: Array  # shape (k,)


def rows_of(state: State, seen: View, radars: Indices, landmarks: Indices) -> Rows:
    """Return the ranges of some landmarks from some radars, and their derivatives."""
    known, place = np.unique(landmarks, return_inverse=True)
    layout = state.layout
    n_offsets = layout.n_radars
    at = np.concatenate(
        [np.array([1, 2]), np.arange(layout.offsets.start, state.n_fixed), layout.columns(known)]
    )
    k = np.arange(len(radars))
    u = seen.directions[radars, landmarks]
    H = np.zeros((len(radars), len(at)))
    H[:, :2] = -u
    H[k, 2 + radars] = 1.0
    if layout.has_mounts:
        by_mount = -np.einsum("ki,kij->kj", u, seen.turned[radars])
        H[k, 2 + n_offsets + 2 * radars] = by_mount[:, 0]
        H[k, 3 + n_offsets + 2 * radars] = by_mount[:, 1]
    first = 2 + state.n_fixed - layout.offsets.start + 2 * place
    if layout.has_radii:
        points = int(np.searchsorted(known, layout.n_landmarks))
        first = first + np.minimum(place, points)
        of_point = np.flatnonzero(landmarks < layout.n_landmarks)
        H[of_point, first[of_point] + 2] = -1.0
    by_feature = seen.by_feature[radars, landmarks]
    H[k, first] = by_feature[:, 0]
    H[k, first + 1] = by_feature[:, 1]
    return Rows(
        radars=radars,
        landmarks=landmarks,
        at=at,
        H=H,
        predicted_m=seen.ranges_m[radars, landmarks],
    )


def random_covariance(size: int, rng: np.random.Generator, scale: float = 0.05) -> Array:
    root = scale * rng.standard_normal((size, size)) / math.sqrt(size)
    return np.asarray(root @ root.T + 1e-6 * np.eye(size))


def random_state(seed: int, n_landmarks: int, heading_rad: float) -> State:
    """Return a state with everything unknown and correlated."""
    rng = np.random.default_rng(seed)
    state = State((0.02, 0.02, 0.01), (0.01,) * N_RADARS)
    state.heading_rad = heading_rad
    state.position_m = rng.uniform(-3, 3, 2)
    state.calibration = 0.02 * rng.standard_normal(3)
    state.offsets_m = 0.02 * rng.standard_normal(N_RADARS)
    state.landmarks_m = rng.uniform(-3, 3, (n_landmarks, 2))
    state.landmark_ids = list(range(n_landmarks))
    state.next_id = n_landmarks
    state.P = SymmetricMatrix(random_covariance(6 + N_RADARS + 2 * n_landmarks, rng))
    return state


def landmark_covariance(state: State, row: int) -> Array:
    """Return the covariance of one landmark's position, map frame, (2, 2)."""
    at, T = state.landmark_columns(np.array([row])), state.additive_transform()
    return (T @ state.P.full() @ T.T)[np.ix_(at, at)]


def near_a_half_turn() -> st.SearchStrategy[float]:
    return st.one_of(
        st.floats(-math.pi, math.pi),
        st.sampled_from([math.pi, -math.pi, math.pi - 1e-9, -math.pi + 1e-9, 0.0]),
    )


seeds = st.integers(0, 2**32 - 1)
increments = st.tuples(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(-0.5, 0.5)).map(
    lambda values: np.array(values) + 1e-6
)
