"""Numerical health of the filter over long runs, and laws of whole steps."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from hil_tests.property.ekf_oracles import (
    Array,
    Q,
    angles,
    beliefs,
    expected,
    increments,
    random_belief,
    relative_error,
    turn_between,
)
from slam.config import Assignment, AssociationConfig
from slam.geometry import compose
from slam.paper import ekf as ekf_slam
from slam.paper.association import mahalanobis_sq, update_map
from slam.results import Belief, landmark_slice


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
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
def test_observing_a_new_landmark_again_without_noise_surprises_nobody(
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
