"""Which directions of a map no sensor can tell, and whether the filters know that they cannot.

Moved and turned as a whole, robot and map look the same from the robot: three directions have no
information. A filter's observability matrix stacks ``H_k F_{k-1} ... F_0``, each factor at the
estimate the filter linearises about. Its null space has three dimensions where the errors are
chosen well (right-invariant, first-estimates Jacobians), and two in the standard EKF, which
believes to see a heading that it cannot see (Huang, Mourikis and Roumeliotis, IJRR 29(5), 2010).
F is read off the code under test: a block of dummy landmarks that no motion changes carries the
identity, and what the prediction makes of its covariance with the state is F.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from numpy.typing import NDArray

from hil_tests.property.ekf_oracles import random_belief
from hil_tests.property.robust_oracles import (
    N_RADARS,
    random_covariance,
    random_state,
    rows_of,
    seeds,
)
from slam.config import WheelNoise
from slam.geometry import paper_rig
from slam.paper import ekf as ekf_slam
from slam.results import Belief, landmark_slice
from slam.robust.association import antennas_of, view
from slam.robust.state import State, SymmetricMatrix, calibrated_motion, predict, quarter_turn

Array = NDArray[np.float64]

N_LANDMARKS = 3
UNSEEN = 1e-9
few = settings(max_examples=settings().max_examples // 5)


def nullity(blocks: list[Array]) -> int:
    """Return the dimension of the null space; a singular value is 0 or far from it."""
    singular = np.linalg.svd(np.vstack(blocks), compute_uv=False)
    null = singular < UNSEEN
    assert singular[~null].min() > 1e3 * UNSEEN
    return int(null.sum())


def stacked(H: list[Array], F: list[Array]) -> list[Array]:
    """Return H_0, H_1 F_0, H_2 F_1 F_0, ..."""
    through = np.eye(H[0].shape[1])
    blocks = [H[0]]
    for H_k, F_before in zip(H[1:], F, strict=True):
        through = F_before @ through
        blocks.append(H_k @ through)
    return blocks


# --- the paper's filter ---------------------------------------------------------------------------


def ekf_transition(belief: Belief, u: Array) -> Array:
    """Return F of the filter's own prediction, shape (m, m)."""
    m = len(belief.mean)
    n_dummies = (m + 1) // 2
    P = np.zeros((m + 2 * n_dummies, m + 2 * n_dummies))
    P[:m, m : 2 * m] = np.eye(m)
    carrier = Belief(
        mean=np.concatenate([belief.mean, np.zeros(2 * n_dummies)]),
        covariance=P + P.T,
        landmark_ids=tuple(range(len(belief.landmark_ids) + n_dummies)),
        next_id=99,
    )
    return ekf_slam.predict(carrier, u, np.zeros((3, 3))).covariance[:m, m : 2 * m]


def ekf_rows(pose: Array, landmarks: Array) -> Array:
    """Return H of all landmarks, shape (2 n, 3 + 2 n)."""
    H_pose, H_landmark = ekf_slam.observation_jacobians(pose, landmarks)
    H = np.zeros((len(landmarks), 2, 3 + 2 * len(landmarks)))
    H[:, :, :3] = H_pose
    for row in range(len(landmarks)):
        H[row, :, landmark_slice(row)] = H_landmark[row]
    return H.reshape(2 * len(landmarks), -1)


def drive_ekf(
    seed: int, noise: float, n_steps: int
) -> tuple[list[Array], list[Array], list[Array], list[Array]]:
    """Return H and F where the filter takes them, and the same at its first estimates."""
    rng = np.random.default_rng(seed)
    Q = np.diag([0.02**2, 0.03**2])
    belief = random_belief(rng, N_LANDMARKS, rng.uniform(-2, 2, 3))
    truth, first_landmarks = belief, belief.landmarks
    H, F, H_first, F_first = [], [], [], []
    for k in range(n_steps):
        H.append(ekf_rows(belief.pose, belief.landmarks))
        H_first.append(ekf_rows(belief.pose, first_landmarks))
        first_pose = belief.pose
        if k == n_steps - 1:
            break
        for row in range(N_LANDMARKS):
            z = ekf_slam.expected_observations(truth.pose, truth.landmarks)[row]
            z = z + noise * rng.standard_normal(2)
            belief = ekf_slam.update(belief, row, z, Q)
        u = rng.uniform([0.1, -0.1, -0.5], [0.3, 0.1, 0.5])
        F.append(ekf_transition(belief, u))
        belief = ekf_slam.predict(belief, u, 1e-4 * np.eye(3))
        truth = ekf_slam.predict(truth, u, np.zeros((3, 3)))
        # First estimates: the step between two predicted positions, in map axes.
        step = np.append(belief.pose[:2] - first_pose[:2], 0.0)
        G = np.eye(len(belief.mean))
        G[:3, :3] = ekf_slam.motion_jacobian(0.0, step)
        F_first.append(G)
    return H, F, H_first, F_first


@few
@given(seeds)
@pytest.mark.parametrize("n_steps", [2, 5])
def test_standard_ekf_believes_to_see_its_heading(n_steps: int, seed: int) -> None:
    H, F, H_first, F_first = drive_ekf(seed, 0.1, n_steps)
    assert nullity(stacked(H, F)) == 2
    # The same derivatives at first estimates keep all three, and so do those of a perfect filter.
    assert nullity(stacked(H_first, F_first)) == 3
    H, F, _, _ = drive_ekf(seed, 0.0, n_steps)
    assert nullity(stacked(H, F)) == 3


# --- the robust filter ----------------------------------------------------------------------------

WHEELS = WheelNoise()


def robust_transition(state: State, increment: Array) -> Array:
    """Return F of the filter's own prediction, shape (m, m)."""
    m = state.P.size
    carrier = State((0.0, 0.0, 0.0), (0.0,) * N_RADARS)
    carrier.heading_rad, carrier.position_m = state.heading_rad, state.position_m
    carrier.calibration, carrier.offsets_m = state.calibration, state.offsets_m
    carrier.landmarks_m = np.vstack([state.landmarks_m, np.zeros((m // 2, 2))])
    P = np.zeros((2 * m, 2 * m))
    P[m:, :m] = np.eye(m)
    carrier.P = SymmetricMatrix(P + P.T)
    motion = calibrated_motion(increment, state.calibration, WHEELS, np.zeros((3, 3)))
    predict(carrier, motion, WHEELS)
    return carrier.P.full()[:m, m:]


def drive_robust(seed: int, n_steps: int) -> tuple[list[Array], list[Array], list[Array]]:
    """Return H and F in the filter's own errors, and T of additive ones where each was taken.

    T alternates: at H_0, before F_0, after F_0 and so on.
    """
    rng = np.random.default_rng(seed)
    state = random_state(seed, N_LANDMARKS, float(rng.uniform(-3, 3)))
    # Each radar sees each landmark, at right angles or not, from within a metre or two.
    state.landmarks_m = state.position_m + rng.uniform(0.5, 2.0, (N_LANDMARKS, 2))
    antennas = antennas_of(paper_rig(), (), np.zeros(3))
    radars = np.repeat(np.arange(N_RADARS), N_LANDMARKS)
    landmarks = np.tile(np.arange(N_LANDMARKS), N_RADARS)
    H, F, T = [], [], []
    for k in range(n_steps):
        rows = rows_of(state, view(state, antennas), radars, landmarks)
        full = np.zeros((len(radars), state.P.size))
        full[:, rows.at] = rows.H
        H.append(full)
        T.append(state.additive_transform())
        if k == n_steps - 1:
            break
        noise = np.full(len(radars), 0.05**2)
        state.update(rows.at, rows.H, 0.05 * rng.standard_normal(len(radars)), noise)
        increment = rng.uniform([0.1, -0.1, -0.5], [0.3, 0.1, 0.5])
        T.append(state.additive_transform())
        F.append(robust_transition(state, increment))
        predict(state, calibrated_motion(increment, state.calibration, WHEELS), WHEELS)
    return H, F, T


@few
@given(seeds)
@pytest.mark.parametrize("n_steps", [2, 5])
def test_right_invariant_filter_knows_what_it_cannot_see(n_steps: int, seed: int) -> None:
    H, F, T = drive_robust(seed, n_steps)
    m = H[0].shape[1]
    # In right-invariant errors a turn about the origin of the map, and its shifts.
    N = np.zeros((m, 3))
    N[0, 0] = 1.0
    N[1:3, 1:] = np.eye(2)
    N[6 + N_RADARS :, 1:] = np.tile(np.eye(2), (N_LANDMARKS, 1))
    assert max(np.abs(block @ N).max() for block in stacked(H, F)) < UNSEEN
    # Calibration errors and offsets known: nothing else is unseen.
    kept = np.r_[0:3, 6 + N_RADARS : m]
    own = np.ix_(kept, kept)
    assert nullity(stacked([h[:, kept] for h in H], [f[own] for f in F])) == 3
    # The same rows and motions in additive errors are a standard EKF.
    back = [np.linalg.inv(t) for t in T]
    H_additive = [h @ back[2 * k] for k, h in enumerate(H)]
    F_additive = [T[2 * k + 2] @ f @ back[2 * k + 1] for k, f in enumerate(F)]
    blocks = stacked([h[:, kept] for h in H_additive], [f[own] for f in F_additive])
    assert nullity(blocks) == 2


@few
@given(seeds)
def test_transition_read_off_the_code_is_the_one_of_its_covariance(seed: int) -> None:
    """The reading above is right: P becomes F P F^T, with and without errors of calibration."""
    rng = np.random.default_rng(seed)
    state = random_state(seed, N_LANDMARKS, 1.0)
    increment = rng.uniform([0.1, -0.1, -0.5], [0.3, 0.1, 0.5])
    F = robust_transition(state, increment)
    P = random_covariance(state.P.size, rng)
    state.P = SymmetricMatrix(P)
    wanted = F @ state.P.full() @ F.T
    motion = calibrated_motion(increment, state.calibration, WHEELS, np.zeros((3, 3)))
    predict(state, motion, WHEELS)
    assert np.abs(state.P.full() - wanted).max() <= 1e-12
    # A turn q moves the additive position by J d q; in right-invariant errors, landmarks move.
    assert F[-2:, 4] == pytest.approx(
        quarter_turn(state.landmarks_m[-1]) * motion.turn_rad / (1 + state.calibration[1])
    )
