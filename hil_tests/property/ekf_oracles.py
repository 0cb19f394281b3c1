"""Beliefs to try filters on, and the models once more, able to take a complex step."""

import math
from collections.abc import Callable

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from slam.results import Belief, landmark_slice

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

Q = np.diag([0.02**2, 0.03**2])

angles = st.floats(-math.pi, math.pi, exclude_max=True)
increments = st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-0.6, 0.6)).map(
    np.array
)


def random_belief(rng: np.random.Generator, n: int, pose: Array) -> Belief:
    """Return n landmarks 0.3 to 3 m off the pose and a full, well-conditioned covariance."""
    size = 3 + 2 * n
    direction, radius = rng.uniform(-math.pi, math.pi, n), rng.uniform(0.3, 3.0, n)
    landmarks = pose[:2] + radius[:, None] * np.column_stack([np.cos(direction), np.sin(direction)])
    root = 0.1 * rng.standard_normal((size, size)) / math.sqrt(size)
    covariance = root @ root.T + 1e-4 * np.eye(size)
    return Belief(
        mean=np.concatenate([pose, landmarks.ravel()]),
        covariance=(covariance + covariance.T) / 2,
        landmark_ids=tuple(range(n)),
        next_id=n,
    )


@st.composite
def beliefs(draw: st.DrawFn, min_landmarks: int = 1) -> Belief:
    """Draw a belief anywhere, headings next to plus and minus pi included."""
    n = draw(st.integers(min_landmarks, 4))
    heading = draw(st.one_of(angles, st.sampled_from([-math.pi, math.pi - 1e-9, -math.pi + 1e-9])))
    pose = np.array([draw(st.floats(-5, 5)), draw(st.floats(-5, 5)), heading])
    return random_belief(np.random.default_rng(draw(st.integers(0, 2**32 - 1))), n, pose)


# --- the models once more, able to take a complex step --------------------------------------------


def complex_atan2(y: np.complex128, x: np.complex128) -> np.complex128:
    """Return the angle of (x, y), analytic around real arguments."""
    if abs(x.real) >= abs(y.real):
        turn = 0.0 if x.real > 0 else math.copysign(math.pi, y.real)
        return np.complex128(np.arctan(y / x) + turn)
    return np.complex128(math.copysign(math.pi / 2, y.real) - np.arctan(x / y))


def observe(pose: Complex, landmark: Complex) -> Complex:
    dx, dy = landmark - pose[:2]
    bearing = complex_atan2(dy, dx) - pose[2]
    return np.array([np.sqrt(dx**2 + dy**2), bearing])


def move(pose: Complex, increment: Complex) -> Complex:
    c, s = np.cos(pose[2]), np.sin(pose[2])
    dx, dy, turn = increment
    return np.array([pose[0] + c * dx - s * dy, pose[1] + s * dx + c * dy, pose[2] + turn])


def place(pose: Complex, observed: Complex) -> Complex:
    direction = pose[2] + observed[1]
    placed: Complex = pose[:2] + observed[0] * np.array([np.cos(direction), np.sin(direction)])
    return placed


def complex_step(function: Callable[[Complex], Complex], at: Array) -> Array:
    """Return the Jacobian of an analytic function, ``Im f(x + i h) / h``, exact to rounding."""
    columns = []
    for k in range(len(at)):
        point = at.astype(np.complex128)
        point[k] += 1e-30j
        columns.append(function(point).imag / 1e-30)
    return np.array(columns).T


def expected(belief: Belief, row: int) -> Array:
    return observe(
        belief.pose.astype(np.complex128), belief.landmarks[row].astype(np.complex128)
    ).real


def observation_matrix(belief: Belief, row: int) -> Array:
    block = landmark_slice(row)
    H = np.zeros((2, len(belief.mean)))
    pose, landmark = belief.pose, belief.landmarks[row]
    H[:, :3] = complex_step(lambda p: observe(p, landmark.astype(np.complex128)), pose)
    H[:, block] = complex_step(lambda m: observe(pose.astype(np.complex128), m), landmark)
    return H


def relative_error(actual: NDArray[np.floating], wanted: NDArray[np.floating]) -> float:
    return float(np.abs(actual - wanted).max() / np.abs(wanted).max())


def turn_between(a: float, b: float) -> float:
    return abs(math.remainder(a - b, math.tau))
