"""Laws of association: gates, nearest neighbour, and the joint assignment by brute force."""

import math
from collections.abc import Iterator, Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from numpy.typing import NDArray
from scipy.stats import chi2

from slam.config import Assignment, AssociationConfig, GateRule
from slam.paper.association import mahalanobis_sq, nearest, one_to_one, update_map
from slam.paper.ekf import augment, expected_observations, start
from slam.results import Belief

Array = NDArray[np.float64]
Q = np.diag([0.02**2, 0.03**2])


def belief_with(landmarks: list[tuple[float, float]], sigma_m: float = 0.05) -> Belief:
    """Return a certain pose at the origin and independent landmarks."""
    n = len(landmarks)
    variances = [0.0] * 3 + [sigma_m**2] * (2 * n)
    return Belief(
        mean=np.concatenate([np.zeros(3), np.array(landmarks).ravel()]),
        covariance=np.diag(variances),
        landmark_ids=tuple(range(10, 10 + n)),
        next_id=99,
    )


def seen(belief: Belief, row: int) -> Array:
    observed: Array = expected_observations(belief.pose, belief.landmarks)[row]
    return observed


@pytest.mark.parametrize(
    ("rule", "gate", "threshold"),
    [
        (GateRule.MAHALANOBIS_SQ, 0.6, 0.6),
        (GateRule.MAHALANOBIS, 1.6, 2.56),
        (GateRule.CHI_SQUARE, 0.99, 9.210340371976184),  # chi-square table, 2 dof
        (GateRule.CHI_SQUARE, 0.2591817793, 0.6),  # alpha 0.6 passes 26 % of true matches
    ],
)
def test_gate_rules(rule: GateRule, gate: float, threshold: float) -> None:
    config = AssociationConfig(gate_rule=rule, gate=gate)
    assert config.gate_threshold == pytest.approx(threshold, rel=1e-8)


def test_true_matches_pass_a_chi_square_gate_as_often_as_it_says() -> None:
    rng = np.random.default_rng(11)
    config = AssociationConfig(gate_rule=GateRule.CHI_SQUARE, gate=0.99)
    belief = belief_with([(0.6, 0.8)], sigma_m=1e-6)
    z = seen(belief, 0)
    noisy = z + rng.standard_normal((10_000, 2)) * np.sqrt(np.diag(Q))
    passed = [nearest(mahalanobis_sq(belief, one, Q), config.gate_threshold) for one in noisy]
    assert passed.count(0) / 10_000 == pytest.approx(0.99, abs=0.003)


def test_distance_is_chi_square_distributed_over_the_whole_uncertainty() -> None:
    rng = np.random.default_rng(12)
    belief = belief_with([(0.6, 1.8)], sigma_m=0.01)
    truths = belief.landmarks[0] + 0.01 * rng.standard_normal((4000, 2))
    observed = np.column_stack(
        [np.hypot(truths[:, 0], truths[:, 1]), np.arctan2(truths[:, 1], truths[:, 0])]
    ) + rng.standard_normal((4000, 2)) * np.sqrt(np.diag(Q))
    distances = np.array([mahalanobis_sq(belief, z, Q)[0] for z in observed])
    for probability in (0.1, 0.5, 0.9):
        inside = np.mean(distances < chi2.ppf(probability, 2))
        assert inside == pytest.approx(probability, abs=0.03)


@given(st.integers(0, 2**32 - 1), st.integers(1, 6))
def test_distances_equal_the_formula_with_full_matrices(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    size = 3 + 2 * n
    root = 0.1 * rng.standard_normal((size, size))
    belief = Belief(
        mean=rng.uniform(-2, 2, size),
        covariance=root @ root.T,
        landmark_ids=tuple(range(n)),
        next_id=n,
    )
    z = np.array([rng.uniform(0.3, 2), rng.uniform(-math.pi, math.pi)])
    distances = mahalanobis_sq(belief, z, Q)
    for row, landmark in enumerate(belief.landmarks):
        dx, dy = landmark - belief.pose[:2]
        r = math.hypot(dx, dy)
        H = np.zeros((2, size))
        H[:, :3] = [[-dx / r, -dy / r, 0], [dy / r**2, -dx / r**2, -1]]
        H[:, 3 + 2 * row : 5 + 2 * row] = -H[:, :2]
        S = H @ belief.covariance @ H.T + Q
        bearing = math.remainder(z[1] - math.atan2(dy, dx) + belief.pose[2], math.tau)
        nu = np.array([z[0] - r, bearing])
        assert distances[row] == pytest.approx(nu @ np.linalg.inv(S) @ nu, rel=1e-6)


tables = st.tuples(st.integers(1, 5), st.integers(0, 5)).flatmap(
    lambda shape: npst.arrays(np.float64, shape, elements=st.floats(0, 5))
)


def total(table: Array, gate: float, choice: Sequence[int | None]) -> float:
    return sum(gate if k is None else float(table[row, k]) for row, k in enumerate(choice))


def all_choices(table: Array, gate: float, row: int = 0) -> Iterator[tuple[int | None, ...]]:
    """Yield every assignment of the rows from one on that uses no column twice."""
    if row == len(table):
        yield ()
        return
    for rest in all_choices(table, gate, row + 1):
        yield (None, *rest)
        for k in range(table.shape[1]):
            if k not in rest and table[row, k] < gate:
                yield (k, *rest)


@given(tables, st.floats(0.1, 4))
def test_joint_assignment_equals_brute_force(table: Array, gate: float) -> None:
    found = one_to_one(table, gate)
    best = min(total(table, gate, choice) for choice in all_choices(table, gate))
    assert total(table, gate, found) == pytest.approx(best, abs=1e-9)
    used = [k for k in found if k is not None]
    assert len(used) == len(set(used))
    assert all(k is None or table[row, k] < gate for row, k in enumerate(found))


@given(tables, st.floats(0.1, 4))
def test_joint_assignment_is_never_worse_than_one_after_the_other(
    table: Array, gate: float
) -> None:
    """Nearest neighbours, each landmark to whom it comes first, then to nobody else."""
    one_by_one: list[int | None] = []
    for distances in table:
        free = distances.copy()
        free[[k for k in one_by_one if k is not None]] = math.inf
        one_by_one.append(nearest(free, gate))
    assert total(table, gate, one_to_one(table, gate)) <= total(table, gate, one_by_one) + 1e-9


@given(tables, st.floats(0.1, 4), st.integers(0, 99))
def test_joint_assignment_does_not_depend_on_the_order(
    table: Array, gate: float, seed: int
) -> None:
    order = np.random.default_rng(seed).permutation(len(table))
    here, there = one_to_one(table, gate), one_to_one(table[order], gate)
    assert total(table, gate, here) == pytest.approx(total(table[order], gate, there), abs=1e-9)
    costs = sorted(total(table, gate, choice) for choice in all_choices(table, gate))
    if len(costs) == 1 or costs[1] - costs[0] > 1e-9:  # no tie
        assert there == [here[row] for row in order]


def test_two_looks_at_one_landmark_share_it_only_as_printed() -> None:
    belief = belief_with([(0.0, 1.0), (0.0, 3.0)])
    looks = [seen(belief, 0), seen(belief, 0) + np.array([0.01, 0.0])]
    printed, shared = update_map(belief, looks, Q, AssociationConfig())
    assert [a.landmark_id for a in shared] == [10, 10]
    assert printed.landmark_ids == (10, 11)
    joint = AssociationConfig(assignment=Assignment.ONE_TO_ONE)
    after, apart = update_map(belief, looks, Q, joint)
    assert [a.landmark_id for a in apart] == [10, 99]
    assert after.landmark_ids == (10, 11, 99)
    assert after.next_id == 100


@pytest.mark.parametrize("assignment", list(Assignment))
def test_observation_beyond_every_gate_becomes_a_landmark_and_alters_no_other(
    assignment: Assignment,
) -> None:
    belief = belief_with([(0.0, 1.0), (0.0, 3.0)])
    config = AssociationConfig(assignment=assignment)
    after, (association,) = update_map(belief, [np.array([2.0, 0.0])], Q, config)
    assert association.is_new
    assert association.nis is None
    assert association.landmark_id == 99
    assert association.candidate_ids == (10, 11)
    assert after.landmarks[-1] == pytest.approx([2.0, 0.0])
    assert np.array_equal(after.mean[:-2], belief.mean)
    assert np.array_equal(after.covariance[:-2, :-2], belief.covariance)


def test_nis_of_a_match_is_its_distance_before_the_update() -> None:
    belief = belief_with([(0.0, 1.0)])
    z = seen(belief, 0) + np.array([0.02, 0.01])
    _, (association,) = update_map(belief, [z], Q, AssociationConfig())
    # S = diag(0.05^2 + 0.02^2, 0.05^2 / 1 m^2 + 0.03^2): the pose is certain, the range 1 m.
    wanted = 0.02**2 / (0.05**2 + 0.02**2) + 0.01**2 / (0.05**2 + 0.03**2)
    assert association.nis == pytest.approx(wanted, rel=1e-9)


def test_first_observation_of_a_run_is_a_birth() -> None:
    z = np.array([1.0, math.pi / 2])
    after, (association,) = update_map(start(), [z], Q, AssociationConfig())
    assert association.is_new
    assert np.array_equal(after.mean, augment(start(), z, Q).mean)


def test_landmark_under_the_robot_is_never_matched() -> None:
    belief = belief_with([(0.0, 0.0), (0.0, 1.0)])
    distances = mahalanobis_sq(belief, np.array([1.0, math.pi / 2]), Q)
    assert distances[0] == math.inf
    assert nearest(distances, 0.6) == 1
    assert nearest(mahalanobis_sq(belief_with([(0.0, 0.0)]), seen(belief, 1), Q), 0.6) is None
