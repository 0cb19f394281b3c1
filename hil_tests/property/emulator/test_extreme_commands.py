"""Some commands with extreme fields; ``python -m ...extreme_commands`` sends a hundred thousand."""

import pytest

from hil_tests.property.emulator.extreme_commands import COMMANDS_PER_MODULE, run


@pytest.mark.parametrize(
    "count",
    [
        12 * COMMANDS_PER_MODULE,  # both paces, both firmwares, with faults, a recording
        pytest.param(100_000, marks=[pytest.mark.rare, pytest.mark.timeout(0)]),
    ],
)
def test_no_command_ends_a_module_or_makes_it_hang(count: int) -> None:
    findings = run(count, seed=1)
    assert findings.deaths == []
    assert findings.hangs == []
    assert findings.commands == count
