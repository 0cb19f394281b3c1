"""One step of the robust filter against the size of the map."""

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture
from threadpoolctl import threadpool_limits

from slam.robust.motion import calibrated_motion, predict
from slam.robust.parameters import WheelNoise
from slam.robust.ranges import Antennas, rows_of, view
from slam.robust.state import State
from slam.robust.symmetric import SymmetricMatrix

N_RADARS = 4
SIGMA_M = 7.4e-3


def large_state(n: int) -> State:
    """Return n landmarks around the pose with a full covariance."""
    rng = np.random.default_rng(n)
    state = State((0.007, 0.007, 0.0042), (0.0,) * N_RADARS)
    size = state.P.size + 2 * n
    root = 0.1 * rng.standard_normal((size, 40)) / np.sqrt(40)
    state.P = SymmetricMatrix(root @ root.T + 1e-3 * np.eye(size))
    state.landmarks_m = rng.uniform(-20, 20, (n, 2))
    state.landmark_ids = list(range(n))
    return state


@pytest.mark.parametrize("n", [10, 100, 300, 1000, 2000])
@pytest.mark.benchmark(group="robust SLAM step: predict, view of all, 4 range updates")
def test_robust_step(benchmark: BenchmarkFixture, n: int) -> None:
    state, wheels = large_state(n), WheelNoise()
    antennas = Antennas(
        position_m=np.array([[-0.1, 0.2], [0.1, 0.2], [0.1, -0.2], [-0.1, -0.2]]),
        yaw_rad=np.zeros(N_RADARS),
        heard=np.ones(N_RADARS, dtype=bool),
    )
    increment = np.array([0.01, 0.0, 0.01])

    def step() -> State:
        predict(state, calibrated_motion(increment, state.calibration, wheels), wheels)
        rows = rows_of(state, view(state, antennas), np.arange(4), np.array([0, 0, 1, 1]))
        state.update(rows.at, rows.H, np.full(4, 1e-3), np.full(4, SIGMA_M**2))
        return state

    with threadpool_limits(1):
        assert np.isfinite(benchmark(step).position_m).all()
