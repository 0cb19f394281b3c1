"""Laws of the paper's EKF, and its numerical health.

They are those that existing filters break: a new landmark with P = I, the derivative of bearing by
heading divided by q, G^T P G, and angles that are not wrapped.
"""

import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from hil_tests.property.ekf_oracles import (
    Array,
    Q,
    angles,
    beliefs,
    complex_step,
    expected,
    increments,
    move,
    observation_matrix,
    observe,
    place,
    random_belief,
    relative_error,
    turn_between,
)
from hil_tests.property.examples import examples
from slam.config import Assignment, AssociationConfig
from slam.geometry import compose
from slam.paper import ekf as ekf_slam
from slam.paper.association import mahalanobis_sq, update_map
from slam.results import Belief, landmark_slice

# --- the laws -----------------------------------------------------------------------------------


@given(beliefs())
def test_observation_jacobians(belief: Belief) -> None:
    H_pose, H_landmark = ekf_slam.observation_jacobians(belief.pose, belief.landmarks)
    for row in range(len(belief.landmark_ids)):
        H = observation_matrix(belief, row)
        assert np.abs(H_pose[row] - H[:, :3]).max() <= 1e-10
        assert np.abs(H_landmark[row] - H[:, landmark_slice(row)]).max() <= 1e-10
        assert H_pose[row, 1, 2] == -1.0


@given(beliefs(min_landmarks=0), increments)
def test_predict(belief: Belief, u: Array) -> None:
    R = np.diag([1e-4, 2e-4, 3e-4])
    after = ekf_slam.predict(belief, u, R)
    size = len(belief.mean)
    G = np.eye(size)
    G[:3, :3] = complex_step(lambda p: move(p, u.astype(np.complex128)), belief.pose)
    wanted = G @ belief.covariance @ G.T
    wanted[:3, :3] += R
    assert np.abs(after.covariance - wanted).max() <= 1e-12
    pose = move(belief.pose.astype(np.complex128), u.astype(np.complex128)).real
    assert np.abs(after.pose[:2] - pose[:2]).max() <= 1e-12
    assert turn_between(after.pose[2], pose[2]) <= 1e-12
    assert -math.pi <= after.pose[2] < math.pi
    assert np.array_equal(after.mean[3:], belief.mean[3:])


@given(beliefs(), st.floats(-0.1, 0.1), st.floats(-0.2, 0.2), st.integers(-2, 2))
def test_update(belief: Belief, dr: float, dphi: float, turns: int) -> None:
    """Joseph form with the Kalman gain, and the information form of the covariance."""
    observed = expected(belief, 0) + np.array([dr, dphi])
    turned = observed + np.array([0.0, turns * math.tau])
    after = ekf_slam.update(belief, 0, turned, Q)
    P, H = belief.covariance, observation_matrix(belief, 0)
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + Q)
    rest = np.eye(len(P)) - K @ H
    assert relative_error(after.covariance, rest @ P @ rest.T + K @ Q @ K.T) <= 1e-9
    information = np.linalg.inv(P) + H.T @ np.linalg.inv(Q) @ H
    assert relative_error(after.covariance, np.linalg.inv(information)) <= 1e-9
    mean = belief.mean + K @ np.array([dr, dphi])
    assert turn_between(after.mean[2], mean[2]) <= 1e-10
    assert -math.pi <= after.mean[2] < math.pi
    assert np.delete(after.mean, 2) == pytest.approx(np.delete(mean, 2), abs=1e-10)


@given(beliefs(min_landmarks=0), st.floats(0.3, 2.0), angles)
def test_new_landmark_is_fully_correlated(belief: Belief, r: float, phi: float) -> None:
    observed = np.array([r, phi])
    after = ekf_slam.augment(belief, observed, Q)
    pose, z = belief.pose, observed.astype(np.complex128)
    G_pose = complex_step(lambda p: place(p, z), pose)
    G_obs = complex_step(lambda o: place(pose.astype(np.complex128), o), observed)
    P = belief.covariance
    wanted_cross = G_pose @ P[:3]
    wanted = G_pose @ P[:3, :3] @ G_pose.T + G_obs @ Q @ G_obs.T
    assert np.abs(after.covariance[-2:, :-2] - wanted_cross).max() <= 1e-10
    assert np.abs(after.covariance[-2:, -2:] - wanted).max() <= 1e-10
    assert np.array_equal(after.covariance[:-2, :-2], P)
    assert after.landmarks[-1] == pytest.approx(place(pose.astype(np.complex128), z).real)


@given(beliefs(min_landmarks=0), st.floats(0.3, 2.0), angles)
def test_new_landmark_is_the_limit_of_a_vague_prior(belief: Belief, r: float, phi: float) -> None:
    observed = np.array([r, phi])
    born = ekf_slam.augment(belief, observed, Q)
    size = len(belief.mean)
    vague = np.zeros((size + 2, size + 2))
    vague[:size, :size] = belief.covariance
    vague[size:, size:] = 1e12 * np.eye(2)
    H = observation_matrix(born, len(belief.landmark_ids))
    # Information form: a prior of 1e12 m^2 plus one observation.
    information = np.zeros_like(vague)
    information[:size, :size] = np.linalg.inv(belief.covariance)
    information[size:, size:] = 1e-12 * np.eye(2)
    information += H.T @ np.linalg.inv(Q) @ H
    assert relative_error(born.covariance, np.linalg.inv(information)) <= 1e-5


@settings(max_examples=examples(20))
@given(st.integers(0, 2**32 - 1), st.integers(20, 40))
def test_landmark_never_surer_than_the_start(seed: int, n_steps: int) -> None:
    """Dissanayake 2001: no observation makes a landmark surer than the pose was at the start."""
    rng = np.random.default_rng(seed)
    start = np.diag([0.02**2, 0.03**2, 0.0])
    belief = Belief(mean=np.zeros(3), covariance=start)
    landmark = np.array([1.0, 0.5])
    for _ in range(n_steps):
        z = observe(belief.pose.astype(np.complex128), landmark.astype(np.complex128)).real
        z = z + rng.standard_normal(2) * 1e-4
        if not belief.landmark_ids:
            belief = ekf_slam.augment(belief, z, Q)
        else:
            before = belief.landmark_covariance(0)
            belief = ekf_slam.update(belief, 0, z, Q)
            after = belief.landmark_covariance(0)
            assert np.linalg.det(after) <= np.linalg.det(before) * (1 + 1e-9)
            assert np.trace(after) <= np.trace(before) * (1 + 1e-9)
        assert np.linalg.eigvalsh(belief.landmark_covariance(0) - start[:2, :2]).min() >= -1e-12


def test_jacobians_of_a_landmark_straight_behind() -> None:
    """Its bearing jumps by a turn, its derivatives do not (MRPT issue 909)."""
    for heading in (0.0, math.pi / 2, -math.pi, math.pi - 1e-9, 2.0):
        c, s = math.cos(heading), math.sin(heading)
        for aside in (-1e-12, 0.0, 1e-12):
            pose = np.array([0.3, -0.2, heading])
            landmark = pose[:2] - np.array([c + aside * s, s - aside * c])
            H_pose, H_landmark = ekf_slam.observation_jacobians(pose, landmark[None])
            fixed = pose.astype(np.complex128), landmark.astype(np.complex128)
            by_pose = complex_step(partial(observe, landmark=fixed[1]), pose)
            by_landmark = complex_step(partial(observe, fixed[0]), landmark)
            assert np.abs(H_pose[0] - by_pose).max() <= 1e-10
            assert np.abs(H_landmark[0] - by_landmark).max() <= 1e-10


@given(st.floats(-20, 20), st.floats(-20, 20), st.sampled_from([-2, -1, 0, 1, 2]))
@example(math.pi, 0.0, 0)
@example(0.0, math.pi, 0)
@example(math.pi - 1e-16, -math.pi, 0)
def test_angle_of_an_innovation_lies_in_one_turn(observed: float, wanted: float, n: int) -> None:
    observed += n * math.pi
    r, angle = ekf_slam.innovation(np.array([1.0, observed]), np.array([0.75, wanted]))
    assert r == 0.25
    assert -math.pi <= angle < math.pi
    assert turn_between(angle, observed - wanted) <= 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.rare)])
def test_covariance_stays_symmetric_and_positive_over_ten_thousand_random_steps(seed: int) -> None:
    rng = np.random.default_rng(seed)
    belief = random_belief(rng, 3, np.zeros(3))
    done = dict.fromkeys(["predict", "update", "augment"], 0)
    for step in range(10_000):
        n = len(belief.landmark_ids)
        action = rng.choice(list(done), p=[0.45, 0.45, 0.1])
        if action == "augment" and n >= 12:
            action = "predict"
        if action == "predict":
            u = rng.uniform(-1, 1, 3) * [0.05, 0.05, 0.2]
            belief = ekf_slam.predict(belief, u, np.diag([1e-6, 1e-6, 1e-5]))
        elif action == "update":
            row = int(rng.integers(n))
            z = expected(belief, row) + rng.standard_normal(2) * np.sqrt(np.diag(Q))
            belief = ekf_slam.update(belief, row, z, Q)
        else:
            z = np.array([rng.uniform(0.3, 2), rng.uniform(-math.pi, math.pi)])
            belief = ekf_slam.augment(belief, z, Q)
        done[action] += 1
        P = belief.covariance
        assert np.abs(P - P.T).max() <= 1e-12 * np.abs(P).max()
        if step % 50 == 0 or step == 9_999:
            assert np.linalg.eigvalsh(P).min() >= -1e-12 * np.trace(P)
    assert min(done["predict"], done["update"]) > 1000
    assert len(belief.landmark_ids) == 12


@given(beliefs(), st.integers(1, 15))
def test_repeating_an_exact_observation_equals_one_of_smaller_noise(belief: Belief, k: int) -> None:
    # A zero innovation keeps the mean, so the Jacobian too: the linear case.
    z = expected(belief, 0)
    once = ekf_slam.update(belief, 0, z, Q / k)
    many = belief
    for _ in range(k):
        many = ekf_slam.update(many, 0, z, Q)
    assert relative_error(many.covariance, once.covariance) <= 1e-9
    assert turn_between(many.mean[2], once.mean[2]) <= 1e-9
    assert np.delete(many.mean, 2) == pytest.approx(np.delete(once.mean, 2), abs=1e-9)


@given(beliefs(min_landmarks=2))
def test_order_of_independent_observations_does_not_matter(belief: Belief) -> None:
    z = [expected(belief, row) for row in (0, 1)]
    one = ekf_slam.update(ekf_slam.update(belief, 0, z[0], Q), 1, z[1], Q)
    two = ekf_slam.update(ekf_slam.update(belief, 1, z[1], Q), 0, z[0], Q)
    assert relative_error(one.covariance, two.covariance) <= 1e-9
    # With surprises the difference is of second order: a tenth of them leaves a hundredth.
    surprise = np.array([[0.7, -0.4], [-0.9, 0.5]])

    def difference(size: float) -> float:
        first, second = np.array(z) + size * surprise
        there = ekf_slam.update(ekf_slam.update(belief, 0, first, Q), 1, second, Q)
        back = ekf_slam.update(ekf_slam.update(belief, 1, second, Q), 0, first, Q)
        apart = np.abs(there.mean - back.mean)
        return float(max(np.delete(apart, 2).max(), turn_between(there.mean[2], back.mean[2])))

    assert difference(0.0) <= 1e-12
    assert difference(1e-4) <= 0.02 * difference(1e-3) + 1e-13


@given(beliefs(min_landmarks=2), st.floats(-0.3, 0.3))
def test_landmark_without_correlation_is_not_touched(belief: Belief, surprise: float) -> None:
    P, far = belief.covariance.copy(), slice(5, 7)
    P[far, :] = 0.0
    P[:, far] = 0.0
    P[far, far] = np.eye(2)
    before = replace(belief, covariance=P)
    after = ekf_slam.update(before, 0, expected(before, 0) + surprise, Q)
    after = ekf_slam.predict(after, np.array([0.1, 0.0, surprise]), 1e-4 * np.eye(3))
    assert np.array_equal(after.landmarks[1], before.landmarks[1])
    assert np.array_equal(after.covariance[far], P[far])


@given(beliefs())
def test_observation_without_information_changes_nothing(belief: Belief) -> None:
    after = ekf_slam.update(belief, 0, expected(belief, 0) + 0.1, 1e15 * Q)
    assert turn_between(after.mean[2], belief.mean[2]) <= 1e-9
    assert np.delete(after.mean, 2) == pytest.approx(np.delete(belief.mean, 2), abs=1e-9)
    assert relative_error(after.covariance, belief.covariance) <= 1e-9


@given(beliefs(), increments)
def test_motion_without_noise_leaves_landmarks_alone(belief: Belief, u: Array) -> None:
    after = ekf_slam.predict(belief, u, np.zeros((3, 3)))
    assert np.array_equal(after.covariance[3:, 3:], belief.covariance[3:, 3:])
    assert np.array_equal(after.landmarks, belief.landmarks)


@given(beliefs(min_landmarks=0), st.floats(0.3, 2.0), angles)
def test_observing_a_new_landmark_again_without_noise_changes_nothing(
    belief: Belief, r: float, phi: float
) -> None:
    z = np.array([r, phi])
    born = ekf_slam.augment(belief, z, Q)
    assert mahalanobis_sq(born, z, Q)[-1] <= 1e-20


@given(beliefs(), st.floats(-4, 4), st.floats(-4, 4), angles)
@example(random_belief(np.random.default_rng(0), 2, np.array([0.0, 0.0, -math.pi])), 1.0, 2.0, 3.0)
def test_turning_the_world_turns_the_estimate_and_keeps_the_innovations(
    belief: Belief, x: float, y: float, heading: float
) -> None:
    world = np.array([x, y, heading])
    c, s = math.cos(heading), math.sin(heading)
    rotation = np.array([[c, -s], [s, c]])

    def turned(b: Belief) -> Belief:
        n = len(b.landmark_ids)
        T = np.eye(len(b.mean))
        T[:2, :2] = rotation
        for row in range(n):
            block = landmark_slice(row)
            T[block, block] = rotation
        return Belief(
            mean=np.concatenate(
                [compose(world, b.pose), (b.landmarks @ rotation.T + world[:2]).ravel()]
            ),
            covariance=T @ b.covariance @ T.T,
            landmark_ids=b.landmark_ids,
            next_id=b.next_id,
        )

    rng = np.random.default_rng(3)
    here, there = belief, turned(belief)
    gate = AssociationConfig(gate=5.0)
    for _ in range(5):
        u = rng.uniform(-0.1, 0.1, 3)
        here = ekf_slam.predict(here, u, np.diag([1e-4, 1e-4, 1e-3]))
        there = ekf_slam.predict(there, u, np.diag([1e-4, 1e-4, 1e-3]))
        seen = [expected(here, 0) + rng.standard_normal(2) * 0.02]
        here, ours = update_map(here, seen, Q, gate)
        there, theirs = update_map(there, seen, Q, gate)
        assert [a.landmark_id for a in ours] == [a.landmark_id for a in theirs]
        for a, b in zip(ours, theirs, strict=True):
            assert a.mahalanobis_sq == pytest.approx(b.mahalanobis_sq, rel=1e-9, abs=1e-9)
    back = turned(here)
    assert np.delete(there.mean, 2) == pytest.approx(np.delete(back.mean, 2), abs=1e-9)
    assert turn_between(there.mean[2], back.mean[2]) <= 1e-9
    assert relative_error(there.covariance, back.covariance) <= 1e-9


@given(beliefs(min_landmarks=2), st.data())
def test_other_names_permute_the_state_and_nothing_else(
    belief: Belief, data: st.DataObject
) -> None:
    order = data.draw(st.permutations(range(len(belief.landmark_ids))))

    def renamed(b: Belief) -> Belief:
        later = range(len(order), len(b.landmark_ids))
        rows = [*order, *later]
        at = np.concatenate([np.arange(3), *(3 + 2 * row + np.arange(2) for row in rows)])
        return Belief(
            mean=b.mean[at],
            covariance=b.covariance[np.ix_(at, at)],
            landmark_ids=tuple(b.landmark_ids[row] for row in rows),
            next_id=b.next_id,
        )

    seen = [expected(belief, 1) + 0.01, expected(belief, 0) - 0.01, np.array([7.0, 1.0])]
    R = np.diag([1e-4, 1e-4, 1e-3])
    for config in (AssociationConfig(gate=5.0, assignment=rule) for rule in Assignment):
        here, there = belief, renamed(belief)
        u = np.array([0.01, -0.01, 0.02])
        here, ours = update_map(ekf_slam.predict(here, u, R), seen, Q, config)
        there, theirs = update_map(ekf_slam.predict(there, u, R), seen, Q, config)
        assert [a.landmark_id for a in ours] == [a.landmark_id for a in theirs]
        back = renamed(here)
        assert there.landmark_ids == back.landmark_ids
        assert there.mean == pytest.approx(back.mean, abs=1e-12)
        assert relative_error(there.covariance, back.covariance) <= 1e-12


def test_belief_leaves_its_callers_arrays_writable_and_is_itself_read_only() -> None:
    mean, covariance = np.zeros(3), np.eye(3)
    belief = Belief(mean=mean, covariance=covariance)
    assert mean.flags.writeable
    assert covariance.flags.writeable
    for array in (belief.mean, belief.covariance, belief.pose, belief.pose_covariance):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0
