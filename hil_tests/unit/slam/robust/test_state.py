"""A large covariance puts changes off; whatever is read is as if they had been made at once."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg.blas import dsyrk

from slam.robust import state as symmetric
from slam.robust.state import State, SymmetricMatrix

Array = NDArray[np.float64]


@pytest.fixture(autouse=True)
def _small_is_large(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let matrices above 12 rows be large, their spare rows and what is put off few."""
    monkeypatch.setattr(symmetric, "_PROMPT_SIZE", 12)
    monkeypatch.setattr(symmetric, "_SPARE", 4)
    monkeypatch.setattr(symmetric, "_ODD", 1)
    monkeypatch.setattr(symmetric, "_MOST_GRAMS", 6)
    monkeypatch.setattr(symmetric, "_MOST_PAIRS", 3)


@pytest.mark.parametrize("seed", range(4))
def test_any_changes_in_any_order_are_what_a_full_matrix_does(seed: int) -> None:
    rng = np.random.default_rng(seed)
    size = int(rng.integers(9, 20))
    P: Array = np.eye(size)
    stored = SymmetricMatrix(P)
    for _ in range(400):
        P = change(P, stored, rng)
        at = rng.permutation(len(P))[: int(rng.integers(1, 6))]
        limit = 1e-10 * np.abs(P).max()
        assert stored.size == len(P)
        assert np.abs(stored.columns(at) - P[:, at]).max() <= limit
        assert np.abs(stored.block(at) - P[np.ix_(at, at)]).max() <= limit
        if rng.random() < 0.1:
            full = stored.full()
            assert np.array_equal(full, full.T)
            assert np.abs(full - P).max() <= limit


def change(P: Array, stored: SymmetricMatrix, rng: np.random.Generator) -> Array:
    """Change the stored matrix in one way; return what the full one becomes."""
    m = len(P)
    kind = int(rng.integers(7))
    result: Array = P.copy()
    if kind == 0:
        a, b = 0.3 * rng.standard_normal((2, m))
        stored.add_products(a, b)
        result += np.outer(a, b) + np.outer(b, a)
    elif kind == 1:
        W = 0.2 * rng.standard_normal((m, int(rng.integers(1, 9))))
        stored.subtract_gram(W)
        result -= W @ W.T
    elif kind == 2:
        K, PHt = 0.2 * rng.standard_normal((2, m, 4))
        S = np.diag(rng.random(4))
        stored.subtract_gains(K, PHt, S)
        result += K @ S @ K.T - K @ PHt.T - PHt @ K.T
    elif kind == 3:
        columns = rng.standard_normal((m, 2))
        columns[1:3] += columns[1:3].T
        stored.replace_columns(slice(1, 3), columns)
        result[:, 1:3], result[1:3] = columns, columns.T
    elif kind == 4:
        stored.add_diagonal(slice(3, 5), [0.5, 0.25])
        result += np.diag(np.bincount([3, 4], [0.5, 0.25], m))
    elif kind == 5 and m < 30:
        cross, corner = rng.standard_normal((m, 2)), np.eye(2)
        stored.grow(cross, corner)
        result = np.block([[P, cross], [cross.T, corner]])
    elif kind == 6 and m > 8:
        at = np.delete(np.arange(m), rng.integers(5, m, 2))
        stored.keep(at)
        result = P[np.ix_(at, at)]
    return result


def test_what_stays_of_a_large_matrix_stays_bit_for_bit() -> None:
    rng = np.random.default_rng(0)
    stored = SymmetricMatrix(np.eye(20))
    stored.subtract_gram(0.1 * rng.standard_normal((20, 4)))
    stored.add_products(*rng.standard_normal((2, 20)))
    keep = np.delete(np.arange(20), [6, 7])
    wanted = stored.full()[np.ix_(keep, keep)]
    stored.keep(keep)
    assert np.array_equal(stored.full(), wanted)


def test_many_changes_of_a_large_matrix_are_made_in_one_pass(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    passes = []

    def counted(*arguments: object, **options: object) -> object:
        passes.append(options)
        return dsyrk(*arguments, **options)

    monkeypatch.setattr(symmetric, "dsyrk", counted)
    stored = SymmetricMatrix(np.eye(30))
    for _ in range(12):
        stored.subtract_gram(0.01 * np.ones((30, 2)))
        stored.columns(np.arange(3))
    assert len(passes) == 3


def test_the_covariance_of_a_far_position_covers_its_arc() -> None:
    """Beside a million draws of the error: heading sigma 1 rad, 3.2 m from the start."""
    state = State((0.007, 0.007, 0.0042), (0.02,) * 4)
    of_pose = np.array([[1.0, 0.05, 0.1], [0.05, 0.02, 0.003], [0.1, 0.003, 0.05]])
    P = state.P.full()
    P[:3, :3] = of_pose
    state.P, state.position_m = SymmetricMatrix(P), np.array([3.0, 1.0])
    e_th, *e_p = np.random.default_rng(0).multivariate_normal(np.zeros(3), of_pose, 1_000_000).T
    c, s = np.cos(e_th), np.sin(e_th)
    f, g = s / e_th, (1 - c) / e_th
    x = (c - 1) * 3.0 - s * 1.0 + f * e_p[0] - g * e_p[1]
    y = s * 3.0 + (c - 1) * 1.0 + g * e_p[0] + f * e_p[1]
    moment = np.array([[np.mean(x * x), np.mean(x * y)], [np.mean(x * y), np.mean(y * y)]])
    linear = state.pose_covariance()[:2, :2]
    values, vectors = np.linalg.eigh(moment - linear)
    expected = (vectors * np.maximum(values, 0.0)) @ vectors.T
    np.testing.assert_allclose(state.curved_covariance(), expected, atol=0.02)
    # where the heading is known, nothing is added
    assert np.abs(State((0.0, 0.0, 0.0), (0.0,)).curved_covariance()).max() == 0.0
