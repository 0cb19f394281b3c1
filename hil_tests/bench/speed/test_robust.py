"""One step of the robust filter against the size of the map, and what it does now and then.

CPU time of the thread, so that a loaded machine changes little but the caches.
"""

import copy
import time

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture
from threadpoolctl import threadpool_limits

from hil_tests.unit.slam.robust.range_world import LAB, parameters_for, simulate
from slam.app.experiments.step_cost import mapped_state, stepper
from slam.geometry import paper_rig
from slam.robust.back_end import RobustBackEnd
from slam.robust.map import find_merge
from slam.robust.parameters import MapRule

SIGMA_M = 7.4e-3

# Large maps share passes over the covariance among 11 and 15 steps; this many hold whole cycles.
STEPS = 165


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
    assert np.isfinite(state.position_m).all()


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
            back_end.predict(increment)
            back_end.update(scans)
        benchmark.pedantic(  # type: ignore[no-untyped-call]  # no stubs
            lambda twin: twin.relinearise(),
            setup=lambda: ((copy.deepcopy(back_end),), {}),
            rounds=7,
        )
