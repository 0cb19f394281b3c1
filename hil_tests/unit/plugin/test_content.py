"""The device suite sees what a module sends wrongly throughout, though no counter tells."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from hil_tests.device.test_content import CHECKS, range_errors_m
from hil_tests.paths import FIXTURES
from hil_tests.plugin.radar_specs import parse_specs
from hil_tests.plugin.radar_targets import RadarTarget, target_of
from hil_tests.plugin.session_radars import RadarUnderTest
from xethru_protocol.driver.frames import Frame


@contextmanager
def frames_with(
    kind: str | None, count: int, *, n: int, scene: str | Path = "lab"
) -> Iterator[tuple[list[Frame], RadarTarget]]:
    """Give frames of a scene with a fault, armed for so many firings, 0: for each frame."""
    (spec,) = parse_specs([f"emu:{scene}"])
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


def test_a_random_room_is_a_scene_without_a_file() -> None:
    with frames_with(None, 0, n=1, scene="pillars:3") as (frames, place):
        assert len(frames) == 1
        assert place.scene_text is None


def test_a_module_has_the_clock_of_its_scene(tmp_path: Path) -> None:
    """A clock that is a thousandth fast: the same number of frames takes that much less."""
    lab = (FIXTURES / "scenes" / "lab.toml").read_text("utf-8")
    (tmp_path / "fast.toml").write_text(lab.replace("\nserial", "\nclock_ppm = 1000.0\nserial"))
    took_ns = []
    for scene in ("lab", tmp_path / "fast.toml"):
        with frames_with(None, 0, n=200, scene=scene) as (frames, _):
            took_ns.append(frames[-1].arrival_ns - frames[0].arrival_ns)
    assert took_ns[0] / took_ns[1] == pytest.approx(1.001, abs=1e-6)
