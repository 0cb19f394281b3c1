"""When a solution over all poses may take the belief's place."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest

from hil_tests.unit.slam.robust.test_roundness import RODS, SIGMA_M, drive
from slam.config import WheelNoise
from slam.robust.parameters import RelinearisationRule
from slam.robust.run_log import _keep, start_prior
from slam.robust.smoother import is_determined, relinearise
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


def test_a_range_beyond_the_limit_is_no_part_of_what_is_condensed() -> None:
    """One range of the first poses is 50 standard deviations off, or was never measured."""
    back_end, _ = drive(RODS, 0, WheelNoise())
    rule = RelinearisationRule(most_poses=60)
    parameters = replace(back_end.parameters, relinearisation=rule)
    priors = []
    for is_measured in (True, False):
        state, log = deepcopy((back_end.state, back_end._log))
        ranges = log._ranges
        assert ranges.poses[5] < 100
        if is_measured:
            ranges.ranges_m[5] += 50 * SIGMA_M
        else:
            _keep(ranges, [row for row in range(len(ranges.poses)) if row != 5])
        assert relinearise(log, state, parameters)
        assert log.n_kept < 60
        unused = start_prior((1.0,) * 3, (1.0,) * 4, len(state.feature_ids))
        priors.append(log.problem(state, unused).prior)
    largest = np.abs(priors[1].gradient).max()
    assert priors[0].gradient / largest == pytest.approx(priors[1].gradient / largest, abs=1e-5)


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
