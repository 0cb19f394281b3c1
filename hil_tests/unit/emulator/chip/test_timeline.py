"""Counters and scene times: segments of one rate, skipping, pausing."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from emulator.chip.chip import Timeline


def test_a_rate_change_continues_at_the_next_counter() -> None:
    timeline = Timeline()
    timeline.set_rate(10.0)
    timeline.next_counter = 25  # frames 0...24 were made: 25 lies at 2.5 s
    timeline.set_rate(4.0)
    assert timeline.scene_time_ns(25) == 2_500_000_000
    assert timeline.scene_time_ns(27) == 3_000_000_000


def test_the_same_rate_after_a_pause_continues_the_segment() -> None:
    timeline = Timeline()
    timeline.set_rate(10.0)
    timeline.next_counter = 7
    timeline.set_rate(10.0)
    assert timeline.scene_time_ns(7) == 700_000_000
    assert timeline.scene_time_ns(0) == 0


@given(
    rate_hz=st.floats(1.0, 65535.0),
    start=st.integers(0, 2**33),
    ahead_ns=st.integers(-(10**9), 10**11),
)
def test_skipping_finds_the_first_counter_not_before(
    rate_hz: float, start: int, ahead_ns: int
) -> None:
    timeline = Timeline()
    timeline.set_rate(rate_hz)
    timeline.next_counter = start
    target_ns = timeline.scene_time_ns(start) + ahead_ns
    timeline.skip_before(target_ns)
    assert timeline.next_counter >= start
    if timeline.next_counter > start:
        assert timeline.scene_time_ns(timeline.next_counter) >= target_ns
        assert timeline.scene_time_ns(timeline.next_counter - 1) < target_ns
    else:
        assert timeline.scene_time_ns(start) >= target_ns
