"""Minutes of device time in a second or less: every frame and every counter is there."""

import pytest

from hil_tests.bench.virtual_time import counters_of
from xethru_protocol.driver.link import RawConfig

TIMER_HZ_AT_17 = 17.049379
"""What the chip's timer makes of FPS 17, measured. Protocol reference 9.6."""


@pytest.mark.parametrize("downconversion", [False, True], ids=["rf", "baseband"])
def test_three_minutes_lack_no_frame(downconversion: bool) -> None:
    counters = counters_of(180.0, RawConfig(downconversion=downconversion))
    assert len(counters) == pytest.approx(180.0 * TIMER_HZ_AT_17, abs=1.5)
    assert counters == list(range(counters[0], counters[0] + len(counters)))
    assert counters[0] <= 1
