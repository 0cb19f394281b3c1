"""Laws of the filter, each a check on any implementation, so that mutants can fail them.

Oracles: Jacobians by complex step on formulas written out again, the Joseph form, the information
form, and the limit of a boundless prior; none of them is the code under test.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest
from hypothesis import Phase, example, given, settings
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
    relative_error,
    turn_between,
)
from slam.paper import ekf as ekf_slam
from slam.results import Belief, landmark_slice

Check = Callable[..., None]

# One failure is enough to condemn a mutant, and nobody needs its simplest form.
thorough = settings(report_multiple_bugs=False)
condemning = settings(thorough, phases=(Phase.generate,))


@dataclass(frozen=True, slots=True, kw_only=True)
class Filter:
    """The functions under test, so that one of them can be swapped for a mutant."""

    predict: Callable[[Belief, Array, Array], Belief] = ekf_slam.predict
    update: Callable[[Belief, int, Array, Array], Belief] = ekf_slam.update
    augment: Callable[[Belief, Array, Array], Belief] = ekf_slam.augment
    observation_jacobians: Callable[[Array, Array], tuple[Array, Array]] = (
        ekf_slam.observation_jacobians
    )


# --- the laws -----------------------------------------------------------------------------------


def check_observation_jacobians(filter_: Filter, law: settings = thorough) -> None:
    @law
    @given(beliefs())
    def jacobians(belief: Belief) -> None:
        H_pose, H_landmark = filter_.observation_jacobians(belief.pose, belief.landmarks)
        for row in range(len(belief.landmark_ids)):
            H = observation_matrix(belief, row)
            assert np.abs(H_pose[row] - H[:, :3]).max() <= 1e-10
            assert np.abs(H_landmark[row] - H[:, landmark_slice(row)]).max() <= 1e-10
            assert H_pose[row, 1, 2] == -1.0

    jacobians()


def check_predict(filter_: Filter, law: settings = thorough) -> None:
    @law
    @given(beliefs(min_landmarks=0), increments)
    def moves(belief: Belief, u: Array) -> None:
        R = np.diag([1e-4, 2e-4, 3e-4])
        after = filter_.predict(belief, u, R)
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

    moves()


def check_update(filter_: Filter, law: settings = thorough) -> None:
    """Joseph form with the Kalman gain, and the information form of the covariance."""

    @law
    @given(beliefs(), st.floats(-0.1, 0.1), st.floats(-0.2, 0.2), st.integers(-2, 2))
    def corrects(belief: Belief, dr: float, dphi: float, turns: int) -> None:
        observed = expected(belief, 0) + np.array([dr, dphi])
        turned = observed + np.array([0.0, turns * math.tau])
        after = filter_.update(belief, 0, turned, Q)
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

    corrects()


def check_new_landmark_is_fully_correlated(filter_: Filter, law: settings = thorough) -> None:
    @law
    @given(beliefs(min_landmarks=0), st.floats(0.3, 2.0), angles)
    def born(belief: Belief, r: float, phi: float) -> None:
        observed = np.array([r, phi])
        after = filter_.augment(belief, observed, Q)
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

    born()


def check_new_landmark_is_the_limit_of_a_vague_prior(
    filter_: Filter, law: settings = thorough
) -> None:
    @law
    @given(beliefs(min_landmarks=0), st.floats(0.3, 2.0), angles)
    def limit(belief: Belief, r: float, phi: float) -> None:
        observed = np.array([r, phi])
        born = filter_.augment(belief, observed, Q)
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

    limit()


def check_landmark_never_surer_than_the_start(filter_: Filter, law: settings = thorough) -> None:
    """Dissanayake 2001: no observation makes a landmark surer than the pose was at the start."""

    @settings(law, max_examples=20)
    @given(st.integers(0, 2**32 - 1), st.integers(20, 40))
    def bounded(seed: int, n_steps: int) -> None:
        rng = np.random.default_rng(seed)
        start = np.diag([0.02**2, 0.03**2, 0.0])
        belief = Belief(mean=np.zeros(3), covariance=start)
        landmark = np.array([1.0, 0.5])
        for _ in range(n_steps):
            z = observe(belief.pose.astype(np.complex128), landmark.astype(np.complex128)).real
            z = z + rng.standard_normal(2) * 1e-4
            if not belief.landmark_ids:
                belief = filter_.augment(belief, z, Q)
            else:
                before = belief.landmark_covariance(0)
                belief = filter_.update(belief, 0, z, Q)
                after = belief.landmark_covariance(0)
                assert np.linalg.det(after) <= np.linalg.det(before) * (1 + 1e-9)
                assert np.trace(after) <= np.trace(before) * (1 + 1e-9)
            assert np.linalg.eigvalsh(belief.landmark_covariance(0) - start[:2, :2]).min() >= -1e-12

    bounded()


LAWS = (
    check_observation_jacobians,
    check_predict,
    check_update,
    check_new_landmark_is_fully_correlated,
    check_new_landmark_is_the_limit_of_a_vague_prior,
    check_landmark_never_surer_than_the_start,
)


@pytest.mark.parametrize("check", LAWS)
def test_law_holds(check: Check) -> None:
    check(Filter())


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


@given(st.one_of(angles, st.sampled_from([-math.pi, math.pi - 1e-9, math.pi])), increments)
def test_motion_jacobian_is_the_complex_step_derivative(heading: float, u: Array) -> None:
    pose = np.array([1.0, -2.0, heading])
    wanted = complex_step(lambda p: move(p, u.astype(np.complex128)), pose)
    assert np.abs(ekf_slam.motion_jacobian(heading, u) - wanted).max() <= 1e-10


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


# --- mutants: what existing filters get wrong ----------------------------------------------------


def identity_birth(belief: Belief, observed: Array, noise: Array) -> Belief:
    """Give a new landmark P = I and no correlation with anything."""
    born = ekf_slam.augment(belief, observed, noise)
    covariance = np.eye(len(born.mean))
    covariance[:-2, :-2] = belief.covariance
    return Belief(
        mean=born.mean,
        covariance=covariance,
        landmark_ids=born.landmark_ids,
        next_id=born.next_id,
    )


TRUE_JACOBIANS = ekf_slam.observation_jacobians


def inverse_q_jacobians(pose: Array, landmarks: Array) -> tuple[Array, Array]:
    """Divide the derivative of bearing by heading by q, as code that factors 1/q out too far."""
    H_pose, H_landmark = TRUE_JACOBIANS(pose, landmarks)
    H_pose[:, 1, 2] = -1.0 / np.sum((landmarks - pose[:2]) ** 2, axis=1)
    return H_pose, H_landmark


def inverse_q_update(belief: Belief, row: int, observed: Array, noise: Array) -> Belief:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ekf_slam, "observation_jacobians", inverse_q_jacobians)
        return ekf_slam.update(belief, row, observed, noise)


def transposed_predict(belief: Belief, increment: Array, R: Array) -> Belief:
    """Use G^T P G instead of G P G^T."""
    good = ekf_slam.predict(belief, increment, R)
    size = len(belief.mean)
    G = np.eye(size)
    G[:3, :3] = ekf_slam.motion_jacobian(float(belief.mean[2]), increment)
    covariance = G.T @ belief.covariance @ G
    covariance[:3, :3] += R
    return Belief(
        mean=good.mean,
        covariance=covariance,
        landmark_ids=belief.landmark_ids,
        next_id=belief.next_id,
    )


def unwrapped_update(belief: Belief, row: int, observed: Array, noise: Array) -> Belief:
    """Subtract bearings without wrapping the difference."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ekf_slam, "innovation", lambda observed, wanted: observed - wanted)
        return ekf_slam.update(belief, row, observed, noise)


def overflowing_update(belief: Belief, row: int, observed: Array, noise: Array) -> Belief:
    """Leave the heading where the correction puts it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ekf_slam, "wrap_angle", lambda angle: angle)
        return ekf_slam.update(belief, row, observed, noise)


@pytest.mark.parametrize(
    ("mutant", "check"),
    [
        (Filter(augment=identity_birth), check_new_landmark_is_fully_correlated),
        (Filter(augment=identity_birth), check_new_landmark_is_the_limit_of_a_vague_prior),
        (Filter(observation_jacobians=inverse_q_jacobians), check_observation_jacobians),
        (Filter(update=inverse_q_update), check_update),
        (Filter(predict=transposed_predict), check_predict),
        (Filter(update=unwrapped_update), check_update),
        (Filter(update=overflowing_update), check_update),
    ],
)
def test_mutant_fails(mutant: Filter, check: Check) -> None:
    with pytest.raises(AssertionError):
        check(mutant, condemning)
