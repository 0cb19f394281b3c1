"""A small ``python -m hil_tests.bench.corrupted_traffic``: nothing is lost unexplained."""

import pytest

from hil_tests.bench.corrupted_traffic import (
    SWALLOWED_BULK,
    SWALLOWED_MERGED,
    SWALLOWED_NORMAL,
    Outcome,
    run,
    run_command,
)


def check(outcome: Outcome) -> None:
    """Every packet that no damage touched was found, or is known to be inside another."""
    statistics = outcome.statistics
    assert statistics.bytes == outcome.bytes
    assert outcome.found + outcome.missed.total() == outcome.untouched
    assert set(outcome.missed) <= {SWALLOWED_NORMAL, SWALLOWED_MERGED, SWALLOWED_BULK}
    assert outcome.missed.total() <= 1e-3 * outcome.untouched + 1


@pytest.mark.parametrize("rate", [1e-5, 1e-3])
def test_mixed_traffic(rate: float) -> None:
    outcome = run(1_000_000, rate, 1, short=False)
    check(outcome)
    assert outcome.untouched > (0.4 if rate == 1e-3 else 0.9) * outcome.packets
    assert outcome.damaged_bytes > 0


def test_short_packets_with_a_hundredth_of_all_bytes_damaged() -> None:
    outcome = run(200_000, 1e-2, 1, short=True)
    check(outcome)
    assert outcome.untouched > 0.8 * outcome.packets
    assert outcome.statistics.checksum_failures > 100


def test_undamaged_traffic_is_found_whole() -> None:
    outcome = run(1_000_000, 0.0, 1, short=False)
    assert outcome.found == outcome.untouched == outcome.packets == outcome.statistics.packets
    assert outcome.statistics.clean


def test_the_command_finds_the_same() -> None:
    outcome = run(300_000, 1e-3, 2, short=False)
    command = run_command(300_000, 1e-3, 2, short=False)
    assert command.exit_code == 0
    assert command.statistics == outcome.statistics.summary()
    assert command.faults == outcome.statistics.faults.total()
    assert command.lines - command.faults == outcome.statistics.packets
