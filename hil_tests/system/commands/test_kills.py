"""A few kills; `python -m hil_tests.system.commands.kills` does a hundred."""

from pathlib import Path

import pytest

from hil_tests.system.commands.kills import Kind, run_trials

pytestmark = [
    pytest.mark.slow,
    pytest.mark.thorough,
    pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="needs /proc (Linux)"),
]


def test_a_killed_conversion_leaves_nothing_half() -> None:
    findings = run_trials(1, 5, names=["convert"], kinds=[Kind.KILL])
    assert findings.problems == []
    assert findings.ended.total() == 1


@pytest.mark.timeout(2000)
@pytest.mark.parametrize("kind", [Kind.KILL, Kind.TERM, Kind.HANG_UP, Kind.FULL_DISK])
def test_commands_can_be_killed_at_any_time(kind: Kind) -> None:
    findings = run_trials(7, 6, kinds=[kind])
    assert findings.problems == []
