"""One step of the robust filter against the size of the map, and what it does now and then.

CPU time of the thread, so that a loaded machine changes little but the caches.
"""

import copy
import math
import time
from collections.abc import Callable

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture
from threadpoolctl import threadpool_limits

from hil_tests.unit.slam.robust.range_world import LAB, parameters_for, simulate
from slam.config import WheelNoise
from slam.geometry import paper_rig
from slam.robust.association import RangeScan, antennas_of, find_known, view
from slam.robust.back_end import RobustBackEnd
from slam.robust.map import find_merge
from slam.robust.parameters import BackEndParameters, MapRule, RangeNoise
from slam.robust.state import State, SymmetricMatrix, calibrated_motion, predict

SIGMA_M = 7.4e-3

# Large maps share passes over the covariance among 11 and 15 steps; this many hold whole cycles.
STEPS = 165

N_UPDATES = 4
LANDMARKS_PER_M2 = 1.0


def mapped_state(n: int) -> State:
    """Return a state amid n landmarks, known to millimetres, with a dense covariance.

    The first two lie abreast of the robot, one on each side, in view of both radars there.
    """
    rng = np.random.default_rng(n)
    state = State(WheelNoise().calibration_sigmas, (0.0,) * len(paper_rig().mounts))
    size = state.P.size + 2 * n
    root = 1e-3 * rng.standard_normal((size, 40)) / math.sqrt(40)
    state.P = SymmetricMatrix(root @ root.T + 1e-7 * np.eye(size))
    half = 0.5 * math.sqrt(n / LANDMARKS_PER_M2)
    state.landmarks_m = rng.uniform(-half, half, (n, 2))
    state.landmarks_m[:2] = [[0.0, 1.0], [0.0, -1.0]]
    state.landmark_ids = list(range(n))
    state.next_id = n
    return state


def stepper(state: State) -> Callable[[], None]:
    """Return a function that takes one step: predict, view, gate, update with four ranges.

    The robot goes to and fro, so that what it sees stays the same.
    """
    rig, wheels, noise = paper_rig(), WheelNoise(), RangeNoise()
    parameters, sides = BackEndParameters(ranges=noise), rig.sides()
    side_of = np.repeat(np.arange(len(sides)), [len(side) for side in sides])
    R = np.full(N_UPDATES, noise.sigma_m**2)
    mounts = antennas_of(rig, (), np.zeros(3))
    seen = view(state, mounts)
    nearest = [int(np.argmin(ranges_m)) for ranges_m in seen.ranges_m[:, :2]]
    taken = 0

    def step() -> None:
        nonlocal taken
        taken += 1
        increment = np.array([0.01 if taken % 2 else -0.01, 0.0, 0.0])
        predict(state, calibrated_motion(increment, state.calibration, wheels), wheels)
        seen = view(state, mounts)
        scans = [
            RangeScan(radar=radar, ranges_m=(float(seen.ranges_m[radar, landmark]),))
            for radar, landmark in enumerate(nearest)
        ]
        known = find_known(state, seen, scans, side_of, parameters)
        state.update(known.at, known.H, np.zeros(N_UPDATES), R)

    return step


@pytest.mark.slow
@pytest.mark.parametrize("n", [10, 100, 300, 1000, 2000])
@pytest.mark.benchmark(
    group=f"{STEPS} robust SLAM steps: predict, view, gate, 4 range updates",
    timer=time.thread_time,
)
def test_robust_steps(benchmark: BenchmarkFixture, n: int) -> None:
    state = mapped_state(n)
    step = stepper(state)

    def steps() -> None:
        for _ in range(STEPS):
            step()

    with threadpool_limits(1):
        benchmark.pedantic(steps, rounds=4, warmup_rounds=1)  # type: ignore[no-untyped-call]  # no stubs
    benchmark.extra_info["frames"] = STEPS
    # To and fro: a finite place near the beginning
    assert np.abs(state.position_m).max() < 0.02


@pytest.mark.parametrize("n", [14, 100, 1000])
@pytest.mark.benchmark(group="search for merges, one in five steps", timer=time.thread_time)
def test_merge_search(benchmark: BenchmarkFixture, n: int) -> None:
    state, rule = mapped_state(n), MapRule()
    with threadpool_limits(1):
        benchmark(find_merge, state, rule)


@pytest.mark.slow
@pytest.mark.benchmark(group="solution over the poses kept", timer=time.thread_time)
def test_relinearisation_of_3000_poses(benchmark: BenchmarkFixture) -> None:
    """As many poses as are ever kept, the lab's map in them."""
    back_end = RobustBackEnd(paper_rig(), parameters_for(LAB, SIGMA_M))
    run = simulate(LAB, 0, SIGMA_M, clutter=False)
    with threadpool_limits(1):
        for increment, scans in zip(run.increments[:2990], run.scans[:2990], strict=True):
            back_end.predict(increment, elapsed_s=0.2)
            back_end.update(scans)
        benchmark.pedantic(  # type: ignore[no-untyped-call]  # no stubs
            lambda twin: twin.relinearise(),
            setup=lambda: ((copy.deepcopy(back_end),), {}),
            rounds=7,
        )
