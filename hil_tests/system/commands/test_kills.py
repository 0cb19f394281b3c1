"""A few kills; `python -m hil_tests.system.commands.kills` does a hundred."""

from pathlib import Path

import pytest

from hil_tests.system.commands.kills import Kind, run_trials

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="needs /proc (Linux)"),
]


def test_a_killed_recording_is_kept_and_nothing_is_left() -> None:
    findings = run_trials(2, 5, names=["record"], kinds=[Kind.KILL, Kind.HANG_UP])
    assert findings.problems == []
    assert findings.ended.total() == 2


@pytest.mark.thorough
@pytest.mark.timeout(2000)
@pytest.mark.parametrize("kind", [Kind.KILL, Kind.TERM, Kind.HANG_UP, Kind.FULL_DISK])
def test_commands_can_be_killed_at_any_time(kind: Kind) -> None:
    findings = run_trials(7, 6, kinds=[kind])
    assert findings.problems == []
