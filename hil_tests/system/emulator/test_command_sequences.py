"""A few random command sequences; `python -m ...command_sequences` runs a thousand."""

import pytest

from hil_tests.system.emulator.command_sequences import COMMANDS, run

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("count", [2, pytest.param(4, marks=pytest.mark.rare)])
def test_a_module_is_never_silent_for_long_and_ends_at_once(count: int) -> None:
    findings = run(count=count, seed=1, exits=2)
    assert findings.problems == []
    assert len(findings.waits_s) > count * COMMANDS
    assert len(findings.exits_s) == 3
