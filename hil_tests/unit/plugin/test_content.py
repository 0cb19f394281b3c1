"""The device suite sees what a module sends wrongly throughout, though no counter tells."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from hil_tests.device.test_content import CHECKS, range_errors_m
from hil_tests.plugin.radar_specs import parse_specs
from hil_tests.plugin.radar_targets import RadarTarget, target_of
from hil_tests.plugin.session_radars import RadarUnderTest
from xethru_protocol.driver.frames import Frame


@contextmanager
def frames_with(
    kind: str | None, count: int, *, n: int
) -> Iterator[tuple[list[Frame], RadarTarget]]:
    """Give frames of the lab with a fault, armed for so many firings, 0: for each frame."""
    (spec,) = parse_specs(["emu:lab"])
    under_test = RadarUnderTest(target_of(spec))
    under_test.begin_test()
    radar = under_test.open()
    radar.configure_raw()
    if kind is not None:
        under_test.place.inject(kind, {"count": count})
    radar.start(17.0)
    yield list(radar.frames(n)), under_test.place
    under_test.end_test()
    under_test.close()


@pytest.mark.parametrize(
    ("kind", "failing"),
    [
        (None, []),
        ("dead_bins", ["stuck"]),
        ("dc_step", ["constant_part"]),
        ("saturation", ["clipped"]),
        ("in_range_samples", ["isolated"]),
    ],
)
def test_each_fault_of_samples_fails_its_check_alone(kind: str | None, failing: list[str]) -> None:
    with frames_with(kind, count=0, n=25) as (frames, _):
        samples = np.array([frame.samples for frame in frames], dtype=np.float64)
    outside = []
    for name, check in CHECKS.items():
        low, high = check.limit
        value = check.value(samples)
        if not (low is None or value >= low) or not (high is None or value <= high):
            outside.append(name)
    assert outside == failing


@pytest.mark.parametrize(("kind", "drift_mm"), [(None, 0), ("range_offset_drift", 26)])
def test_a_drift_of_ranges_is_measured(kind: str | None, drift_mm: float) -> None:
    """Four bins of 6.43 mm in 10 s."""
    with frames_with(kind, count=1, n=200) as (frames, place):
        assert "known_range" in place.capabilities
        errors = range_errors_m(frames, place.known_ranges_m)
    late_mm = [1e3 * error for t_ns, error in errors if t_ns > frames[-34].arrival_ns]
    assert np.median(late_mm) == pytest.approx(drift_mm, abs=4)
