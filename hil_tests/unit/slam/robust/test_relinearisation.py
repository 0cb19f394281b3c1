"""When a solution over all poses may take the belief's place."""

import numpy as np

from hil_tests.unit.slam.robust.test_roundness import RODS, drive
from slam.robust.parameters import WheelNoise
from slam.robust.relinearisation import is_determined, relinearise
from slam.robust.state import State


def test_a_solution_that_knows_nothing_of_a_landmark_is_refused() -> None:
    """The ranges of one landmark weigh next to nothing, as if all were left out."""
    back_end, _ = drive(RODS, 0, WheelNoise())
    state, log = back_end.state, back_end._log
    assert relinearise(log, state, back_end.parameters)
    ranges = log._ranges
    victim = state.landmark_ids[-1]
    for row, id_ in enumerate(ranges.landmarks):
        if id_ == victim:
            ranges.sigmas_m[row] = 1e6
    assert _is_sane(state)
    assert not relinearise(log, state, back_end.parameters)
    assert _is_sane(state)


def test_information_of_rounding_alone_is_none() -> None:
    information = np.diag([1e4, 1e6, 4e2, 1e3])
    assert is_determined(information)
    information[3, 3] = 1e-9
    assert not is_determined(information)
    information[2:, 2:] = [[1.0, 1.0], [1.0, 1.0 - 1e-9]]
    assert not is_determined(information)


def _is_sane(state: State) -> bool:
    P = state.P.full()
    return bool(P.diagonal().max() < 1e4 and np.linalg.eigvalsh(P)[0] > -1e-9)
