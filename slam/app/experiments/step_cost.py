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
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

import numpy as np
import scipy
from matplotlib.figure import Figure
from scipy.linalg.blas import dsyr2, dsyrk
from threadpoolctl import threadpool_limits

from slam.app.errors import UsageError
from slam.app.experiments import Result
from slam.app.run.pictures import ESTIMATE, INK, LANDMARK, ODOMETRY, PALE_INK, TRUTH, label
from slam.config import WheelNoise
from slam.geometry import paper_rig
from slam.robust.association import antennas_of, rows_of, sides_of, sure_landmarks, view
from slam.robust.parameters import ContinuationRule, RangeNoise
from slam.robust.state import State, SymmetricMatrix, at_rest, calibrated_motion, predict
from xethru_protocol.system import StopFlag

N_UPDATES = 4
BAR_MS, BAR_LANDMARKS = 4.0, 1000
SLOPE_FROM = 200

# A large covariance is passed over every 11th step for the updates, every 15th for the motions.
_CYCLE = 165
_DENSITY_PER_M2 = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Reference:
    """What other code takes at 1000 landmarks, as quoted: low and high [ms]."""

    name: str
    low_ms: float
    high_ms: float


REFERENCES = (
    Reference(name="PythonRobotics, one update", low_ms=1604.0, high_ms=1604.0),
    Reference(name="naive numpy, one update", low_ms=29.0, high_ms=29.0),
    Reference(name="in-place dsyrk, one update", low_ms=0.4, high_ms=0.7),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class StepCost:
    """What a step costs at one size of the map, CPU time in milliseconds.

    Attributes
    ----------
    n_landmarks, size
        Landmarks, and rows of the covariance.
    step_ms, slowest_ms
        Mean over a cycle, and the slowest of it: one that carries out what others put off.
    at_once_ms
        The two passes that a step would make if it put nothing off: ``dsyr2`` and ``dsyrk`` of
        rank 4, in place, nothing else.
    triangle_ms, triangle_gb_per_s
        Reading and writing as many bytes as the triangle has, in order: what memory allows.
    """

    n_landmarks: int
    size: int
    step_ms: float
    slowest_ms: float
    at_once_ms: float
    triangle_ms: float
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
    rig, wheels, noise, rule = paper_rig(), WheelNoise(), RangeNoise(), ContinuationRule()
    sides = sides_of(rig)
    radars = np.array([radar for side in sides for radar in side], dtype=np.intp)
    R = np.full(N_UPDATES, noise.sigma_m**2)
    mounts = antennas_of(rig, (), at_rest())
    seen = view(state, mounts)
    nearest = [int(np.argmin(seen.ranges_m[radar, :2])) for radar in radars]
    landmarks = np.array(nearest, dtype=np.intp)
    taken = 0

    def step() -> None:
        nonlocal taken
        taken += 1
        increment = np.array([0.01 if taken % 2 else -0.01, 0.0, 0.0])
        predict(state, calibrated_motion(increment, state.calibration, wheels), wheels)
        seen = view(state, mounts)
        for side in sides:
            sure_landmarks(state, seen, side, noise, rule)
        rows = rows_of(state, seen, radars, landmarks)
        state.update(rows.at, rows.H, np.zeros(N_UPDATES), R)

    return step


def study(
    sizes: Sequence[int], *, repetitions: int, check: Callable[[], None]
) -> tuple[StepCost, ...]:
    """Return the cost of a step at each number of landmarks; ``check`` may raise in between."""
    costs = []
    with threadpool_limits(1):
        for n in sizes:
            check()
            state = mapped_state(n)
            per_step = _least_of_cycle(stepper(state), repetitions, check)
            size = state.P.size
            check()
            at_once_ms = _passes_ms(size, repetitions)
            triangle_ms = _triangle_ms(size, repetitions)
            n_bytes = 2 * 8 * size * (size + 1) / 2
            costs.append(
                StepCost(
                    n_landmarks=n,
                    size=size,
                    step_ms=float(np.mean(per_step)),
                    slowest_ms=float(np.max(per_step)),
                    at_once_ms=at_once_ms,
                    triangle_ms=triangle_ms,
                    triangle_gb_per_s=n_bytes / (1e6 * triangle_ms),
                )
            )
    return tuple(costs)


def slope_of(costs: Sequence[StepCost]) -> float | None:
    """Return d ln(step) / d ln(n) from 200 landmarks on, by least squares; None for one size."""
    large = [cost for cost in costs if cost.n_landmarks >= SLOPE_FROM]
    if len(large) < 2:
        return None
    n = np.log([cost.n_landmarks for cost in large])
    ms = np.log([cost.step_ms for cost in large])
    return float(np.polyfit(n, ms, 1)[0])


def numbers_of(costs: Sequence[StepCost], *, repetitions: int) -> dict[str, object]:
    return {
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
        "slope": slope_of(costs),
        "slope_from_landmarks": SLOPE_FROM,
        "steps": [asdict(cost) for cost in costs],
        "quoted": [{"landmarks": BAR_LANDMARKS} | asdict(row) for row in REFERENCES],
    }


def _least_of_cycle(
    step: Callable[[], None], repetitions: int, check: Callable[[], None]
) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Return the least time [ms] of each step of a cycle, shape (steps,)."""
    least = np.full(_CYCLE, np.inf)
    for _ in range(_CYCLE):  # warm, and at the beginning of a cycle
        step()
    for _ in range(repetitions):
        check()
        for place in range(_CYCLE):
            began = time.thread_time_ns()
            step()
            least[place] = min(least[place], 1e-6 * (time.thread_time_ns() - began))
    return least


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
    least = math.inf
    for _ in range(2 + repetitions):
        began = time.thread_time_ns()
        work()
        least = min(least, 1e-6 * (time.thread_time_ns() - began))
    return least


def _draw(figure: Figure, costs: Sequence[StepCost]) -> None:
    n = np.array([cost.n_landmarks for cost in costs])
    slope = slope_of(costs)
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
    left = float(n.min())
    for reference in REFERENCES:
        for quoted in {reference.low_ms, reference.high_ms}:
            axes.axhline(quoted, color=PALE_INK, linewidth=0.9, linestyle=(0, (6, 3)))
        text = f"{reference.low_ms:g}"
        if reference.high_ms > reference.low_ms:
            text += f" - {reference.high_ms:g}"
        axes.annotate(
            f"{reference.name}, n = {BAR_LANDMARKS}: {text} ms (quoted)",
            (left, reference.low_ms),
            xytext=(0, -4),
            textcoords="offset points",
            va="top",
            fontsize=8,
            color=PALE_INK,
        )
    axes.plot([BAR_LANDMARKS], [BAR_MS], marker="_", markersize=26, markeredgewidth=2.2, color=INK)
    axes.annotate(
        f"bar: {BAR_MS:g} ms",
        (BAR_LANDMARKS, BAR_MS),
        xytext=(16, 0),
        textcoords="offset points",
        va="center",
        fontsize=8,
        color=INK,
    )
    ticks = [10, 20, 50, 100, 200, 500, 1000, 2000]
    axes.set_xticks(ticks, [str(tick) for tick in ticks])
    axes.minorticks_off()
    label(axes, "", "landmarks n", "time [ms]")
    figure.legend(loc="outside lower center", ncols=1, frameon=False, fontsize=9)


_FEWEST = 2


def run(arguments: argparse.Namespace, stop: StopFlag) -> Result:
    """Time a step at every size.

    Raises
    ------
    UsageError
        A map of one landmark was asked for: each side of the robot needs its own.
    """
    if min(arguments.landmarks) < _FEWEST:
        raise UsageError(
            f"--landmarks {min(arguments.landmarks)}: a step sees one landmark on each side, "
            f"give at least {_FEWEST}"
        )
    costs = study(
        sorted(set(arguments.landmarks)), repetitions=arguments.repetitions, check=stop.check
    )
    title = (
        "One step of the robust filter: predict, view, gate, 4 range updates; CPU time, one BLAS "
        f"thread, least of {arguments.repetitions}"
    )
    header = (
        "landmarks",
        "step",
        "slowest step",
        "every change at once",
        "triangle read and written",
    )
    rows = [
        (
            str(cost.n_landmarks),
            f"{cost.step_ms:.3f} ms",
            f"{cost.slowest_ms:.3f} ms",
            f"{cost.at_once_ms:.3f} ms",
            f"{cost.triangle_ms:.3f} ms",
        )
        for cost in costs
    ]
    return Result(
        numbers=numbers_of(costs, repetitions=arguments.repetitions),
        title="One step of the robust filter against the size of the map (CPU time, one BLAS "
        "thread)",
        size_in=(8.6, 6.2),
        draw=lambda figure: _draw(figure, costs),
        tables=[(title, header, rows)],
    )
