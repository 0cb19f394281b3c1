"""A small ``python -m hil_tests.bench.hostile_client``, and the same at real ports."""

from __future__ import annotations

import pytest

from emulator.pace import Pace
from hil_tests.bench.hostile_client import MOST_OBJECTS_GROWN, run


@pytest.mark.parametrize("pace", list(Pace))
@pytest.mark.parametrize("seed", [1, 2])
def test_a_hostile_client_disturbs_nobody(seed: int, pace: Pace) -> None:
    outcome = run(1.0, seed, pace)
    assert outcome.answers
    assert (outcome.gaps, outcome.in_order) == (0, True)
    assert outcome.frames_due - 2 <= outcome.frames <= outcome.frames_due + 1
    assert outcome.objects_grown <= MOST_OBJECTS_GROWN
    assert outcome.sent_bytes > 50_000
    assert outcome.faults_seen > 20
    assert min(outcome.actions.values()) > 5
