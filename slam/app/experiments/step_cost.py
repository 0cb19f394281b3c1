"""What one step of the robust filter costs against the size of the map.

Time is CPU time of this thread with one BLAS thread, so that a loaded machine changes little but
the caches. Every step of a cycle is timed again and again and its least counts; the mean over the
cycle is the cost of a step, the passes over the covariance that many steps share among them.
"""

from __future__ import annotations

import argparse
import math
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np
import scipy
from matplotlib.figure import Figure
from scipy.linalg.blas import dsyr2, dsyrk
from threadpoolctl import threadpool_limits

from slam.app.errors import UsageError
from slam.app.experiments import Result, table
from slam.app.run.pictures import ESTIMATE, INK, LANDMARK, ODOMETRY, PALE_INK, TRUTH, label, note
from slam.config import WheelNoise
from slam.geometry import paper_rig
from slam.robust.association import RangeScan, antennas_of, find_known, view
from slam.robust.parameters import BackEndParameters, RangeNoise
from slam.robust.state import State, SymmetricMatrix, calibrated_motion, predict
from xethru_protocol.system import StopFlag

N_UPDATES = 4
BAR_MS, BAR_LANDMARKS = 4.0, 1000
SLOPE_FROM = 200
QUOTED_MS = (
    ("PythonRobotics, one update", 1604.0, 1604.0),
    ("naive numpy, one update", 29.0, 29.0),
    ("in-place dsyrk, one update", 0.4, 0.7),
)
"""What other code takes at 1000 landmarks, as quoted: name, low and high."""

_CYCLE = 165
"""A large covariance is passed over every 11th step for the updates, every 15th for the motions."""
_DENSITY_PER_M2 = 1.0
_FEWEST = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class StepCost:
    """What a step costs at one size of the map, CPU time."""

    n_landmarks: int
    size: int  # rows of the covariance
    step_ms: float  # mean over a cycle
    slowest_ms: float  # of the cycle: the step that carries out what others put off
    # dsyr2 and dsyrk of rank 4 in place: what a step passes if it puts nothing off
    at_once_ms: float
    triangle_ms: float  # as many bytes as the triangle has, read and written: what memory allows
    triangle_gb_per_s: float


def mapped_state(n: int) -> State:
    """Return a state amid n landmarks, one per square metre, known to millimetres, correlated.

    The first two lie abreast of the robot, one on each side, in view of both radars there.
    """
    rng = np.random.default_rng(n)
    wheels = WheelNoise()
    state = State(wheels.calibration_sigmas, (0.0,) * len(paper_rig().mounts))
    size = state.P.size + 2 * n
    root = 1e-3 * rng.standard_normal((size, 40)) / math.sqrt(40)
    state.P = SymmetricMatrix(root @ root.T + 1e-7 * np.eye(size))
    half = 0.5 * math.sqrt(n / _DENSITY_PER_M2)
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


def study(sizes: Sequence[int], repetitions: int, stop: StopFlag) -> list[StepCost]:
    """Return the cost of a step at each number of landmarks."""
    costs = []
    with threadpool_limits(1):
        for n in sizes:
            state = mapped_state(n)
            step = stepper(state)
            for _ in range(_CYCLE):  # warm, and at the beginning of a cycle
                step()
            per_step = np.full(_CYCLE, np.inf)
            for _ in range(repetitions):
                stop.check()
                per_step = np.minimum(per_step, [_cpu_ms(step) for _ in range(_CYCLE)])
            size = state.P.size
            stop.check()
            triangle_ms = _triangle_ms(size, repetitions)
            n_bytes = 2 * 8 * size * (size + 1) / 2
            costs.append(
                StepCost(
                    n_landmarks=n,
                    size=size,
                    step_ms=float(np.mean(per_step)),
                    slowest_ms=float(np.max(per_step)),
                    at_once_ms=_passes_ms(size, repetitions),
                    triangle_ms=triangle_ms,
                    triangle_gb_per_s=n_bytes / (1e6 * triangle_ms),
                )
            )
    return costs


def slope_of(step_ms: Mapping[int, float]) -> float | None:
    """Return d ln(step) / d ln(n) from 200 landmarks on, by least squares; None for one size."""
    large = [n for n in step_ms if n >= SLOPE_FROM]
    if len(large) < 2:
        return None
    return float(np.polyfit(np.log(large), np.log([step_ms[n] for n in large]), 1)[0])


def _passes_ms(size: int, repetitions: int) -> float:
    P = np.asfortranarray(np.eye(size))
    a, W = np.full(size, 1e-9), np.full((size, N_UPDATES), 1e-9, order="F")

    def passes() -> None:
        dsyr2(1.0, a, a, a=P, lower=1, overwrite_a=1)
        dsyrk(-1.0, W, beta=1.0, c=P, lower=1, overwrite_c=1)

    return _least_ms(passes, repetitions)


def _triangle_ms(size: int, repetitions: int) -> float:
    entries = np.ones(size * (size + 1) // 2)
    return _least_ms(lambda: np.add(entries, 1e-9, out=entries), repetitions)


def _least_ms(work: Callable[[], object], repetitions: int) -> float:
    return min(_cpu_ms(work) for _ in range(2 + repetitions))


def _cpu_ms(work: Callable[[], object]) -> float:
    began = time.thread_time_ns()
    work()
    return 1e-6 * (time.thread_time_ns() - began)


def _draw(figure: Figure, costs: Sequence[StepCost]) -> None:
    n = np.array([cost.n_landmarks for cost in costs])
    slope = slope_of({cost.n_landmarks: cost.step_ms for cost in costs})
    fitted = "" if slope is None else f", slope {slope:.2f} from n = {SLOPE_FROM} on"
    axes = figure.subplots()
    axes.set_xscale("log")
    axes.set_yscale("log")
    series = (
        ("step_ms", ESTIMATE, "o-", f"measured: predict, view, gate, 4 updates{fitted}"),
        (
            "slowest_ms",
            LANDMARK,
            "v:",
            "measured: slowest step, which carries out what others put off",
        ),
        ("at_once_ms", ODOMETRY, "s--", "measured: dsyr2 + dsyrk, if nothing were put off"),
        ("triangle_ms", TRUTH, "-", "measured: triangle of P read and written once"),
    )
    for name, colour, style, what in series:
        ms = [getattr(cost, name) for cost in costs]
        axes.plot(n, ms, style, color=colour, linewidth=1.4, markersize=4, label=what)
    for name, low_ms, high_ms in QUOTED_MS:
        for quoted in {low_ms, high_ms}:
            axes.axhline(quoted, color=PALE_INK, linewidth=0.9, linestyle=(0, (6, 3)))
        text = f"{low_ms:g}" if low_ms == high_ms else f"{low_ms:g} - {high_ms:g}"
        text = f"{name}, n = {BAR_LANDMARKS}: {text} ms (quoted)"
        note(axes, text, (float(n.min()), low_ms), (0, -4), PALE_INK, va="top", fontsize=8)
    axes.plot([BAR_LANDMARKS], [BAR_MS], marker="_", markersize=26, markeredgewidth=2.2, color=INK)
    text = f"bar: {BAR_MS:g} ms"
    note(axes, text, (BAR_LANDMARKS, BAR_MS), (16, 0), INK, va="center", fontsize=8)
    ticks = [10, 20, 50, 100, 200, 500, 1000, 2000]
    axes.set_xticks(ticks, [str(tick) for tick in ticks])
    axes.minorticks_off()
    label(axes, "", "landmarks n", "time [ms]")
    figure.legend(loc="outside lower center", ncols=1, frameon=False, fontsize=9)


def run(arguments: argparse.Namespace, stop: StopFlag) -> Result:
    """Time a step at every size; a map of one landmark is a UsageError."""
    if min(arguments.landmarks) < _FEWEST:
        raise UsageError(
            f"--landmarks {min(arguments.landmarks)}: a step sees one landmark on each side, "
            f"give at least {_FEWEST}"
        )
    repetitions: int = arguments.repetitions
    costs = study(sorted(set(arguments.landmarks)), repetitions, stop)
    return Result(
        numbers={
            "measured": "CPU time of one thread, one BLAS thread, the least of the repetitions of "
            "every step; mean and slowest over a cycle of steps",
            "step": f"predict, view of all landmarks, gate, {N_UPDATES} range updates; P is dense",
            "repetitions": repetitions,
            "cycle_steps": _CYCLE,
            "machine": platform.machine(),
            "python": platform.python_version(),
            "numpy": np.__version__,
            "scipy": scipy.__version__,
            "bar": {"landmarks": BAR_LANDMARKS, "step_ms": BAR_MS, "slope": 2.0},
            "slope": slope_of({cost.n_landmarks: cost.step_ms for cost in costs}),
            "slope_from_landmarks": SLOPE_FROM,
            "steps": [asdict(cost) for cost in costs],
            "quoted": [
                {"landmarks": BAR_LANDMARKS, "name": name, "low_ms": low_ms, "high_ms": high_ms}
                for name, low_ms, high_ms in QUOTED_MS
            ],
        },
        title="One step of the robust filter against the size of the map (CPU time, one BLAS "
        "thread)",
        size_in=(8.6, 6.2),
        draw=lambda figure: _draw(figure, costs),
        tables=[
            table(
                "One step of the robust filter: predict, view, gate, 4 range updates; CPU time, "
                f"one BLAS thread, least of {repetitions}",
                {
                    "landmarks": [str(cost.n_landmarks) for cost in costs],
                    "step": [f"{cost.step_ms:.3f} ms" for cost in costs],
                    "slowest step": [f"{cost.slowest_ms:.3f} ms" for cost in costs],
                    "every change at once": [f"{cost.at_once_ms:.3f} ms" for cost in costs],
                    "triangle read and written": [f"{cost.triangle_ms:.3f} ms" for cost in costs],
                },
            )
        ],
    )
