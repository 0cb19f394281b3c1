"""A few random command sequences; `python -m ...command_sequences` runs a thousand."""

import pytest

from hil_tests.system.emulator.command_sequences import COMMANDS, run

pytestmark = [pytest.mark.slow, pytest.mark.rare]  # test_extreme_commands.py has more commands


def test_a_module_is_never_silent_for_long_and_ends_at_once() -> None:
    findings = run(count=4, seed=1, exits=2)
    assert findings.problems == []
    assert len(findings.waits_s) > 4 * COMMANDS
    assert len(findings.exits_s) == 3
