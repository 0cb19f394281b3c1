"""Scans from drivers: true metres, time by the counter, gaps, silence, and the real driver."""

import dataclasses
import signal
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.scene.scene import PathSpec, Scene, load_scene
from hil_tests.system.short_scene import write_short_scene
from slam.app.rig.emulated import RAW_CONFIG, end_tick, open_loopback, rig_of
from slam.geometry import Mount
from slam.live import frame_sources
from slam.live.errors import AppError, RadarSilentError
from slam.live.frame_sources import RadarLink, RigSource, radar_frame
from xethru_protocol.driver.frames import Frame, FrameGeometry
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.operating_system import StopFlag, StopRequestedError
from xethru_protocol.wire.errors import DeviceError, Disconnected, ResponseTimeout

MS = 1_000_000
GEOMETRY = FrameGeometry(range_start_m=0.3, bin_length_m=0.0064, n_bins=4, downconversion=False)


def frame(counter: int, stream: int = 0) -> Frame:
    samples = np.full(4, counter, dtype=np.float32)
    return Frame(counter=counter, samples=samples, geometry=GEOMETRY, arrival_ns=0, stream=stream)


class Canned:
    """A driver that gives prepared sweeps, 0 is the first, then what a dead radar gives."""

    def __init__(self, sweeps: Sequence[int], end: type[Exception] = ResponseTimeout) -> None:
        self._sweeps = list(sweeps)
        self._end = end
        self._stream = 0
        self.closed = 0

    def configure_raw(self, config: RawConfig) -> FrameGeometry:
        if self._end is DeviceError:
            raise DeviceError(5, "X4DRIVER_SET FRAMEAREA")
        return GEOMETRY

    def start(self, fps: float) -> float:
        return 5.0

    def read_frame(self, timeout_s: float) -> Frame:
        if not self._sweeps:
            raise self._end("the port is gone")
        # protocol reference 6.1: the first carries 1
        return frame(self._sweeps.pop(0) + 1, self._stream)

    def close(self) -> None:
        self.closed += 1


class Restarting(Canned):
    """Goes on with other sweeps after it was set up again."""

    def __init__(self, sweeps: Sequence[int], later: Sequence[int]) -> None:
        super().__init__(sweeps, Disconnected)
        self._later = list(later)

    def reconnect(self) -> str:
        if not self._later:
            raise Disconnected("it does not come back")
        self._sweeps, self._later = self._later, []
        self._stream += 1
        return "port"


def rig_source(
    *drivers: Canned,
    skews_ns: Sequence[int] = (),
    begins: Callable[[str], int] | None = None,
) -> RigSource:
    skews_ns = skews_ns or [0] * len(drivers)
    return RigSource(
        [
            RadarLink(
                mount=Mount(name=f"radar{index}", x_m=0.0, y_m=0.0, yaw_rad=0.0),
                port=f"port{index}",
                serial="000000000001",
                driver=cast(X4M300, driver),
                start_skew_ns=skew_ns,
            )
            for index, (driver, skew_ns) in enumerate(zip(drivers, skews_ns, strict=True))
        ],
        begins,
    )


def times_of(source: RigSource, end: int) -> list[tuple[int, int, list[tuple[int, int, int]]]]:
    """Return tick and time [ms] of each scan, with radar, sweep and time [ms] of its frames."""
    source.start(RAW_CONFIG, 5)
    return [
        (
            scan.counter,
            scan.t_ns // MS,
            [(one.radar, one.counter - 1, one.t_ns // MS) for one in scan.frames],
        )
        for scan in source.scans(end, StopFlag())
    ]


def radars_of(source: RigSource, end: int) -> list[tuple[int, list[int]]]:
    return [(tick, [radar for radar, *_ in rows]) for tick, _, rows in times_of(source, end)]


def test_module_metres_become_true_metres() -> None:
    made = radar_frame(2, frame(10), 2_000_000_000)
    # light travels 299 792 458 m/s, the module reckons with 300 000 000
    assert made.range_start_m == pytest.approx(0.299792458, rel=1e-15)
    assert made.bin_length_m == pytest.approx(0.0064 * 0.99930819333, rel=1e-10)
    assert (made.radar, made.counter, made.t_ns) == (2, 10, 2_000_000_000)


@pytest.mark.parametrize(
    ("counters", "end", "scans", "lost"),
    [
        ((range(5), range(5)), 4, [(k, [0, 1]) for k in range(4)], 0),
        (
            ([0, 1, 4, 5], [0, 1, 2, 3, 4, 5]),
            5,
            [(0, [0, 1]), (1, [0, 1]), (2, [1]), (3, [1]), (4, [0, 1])],
            2,
        ),
        (([1, 2, 9], [1, 2, 9]), 5, [(1, [0, 1]), (2, [0, 1])], 6),
    ],
)
def test_frames_of_one_counter_are_a_scan_and_lost_ones_are_counted(
    counters: Sequence[Sequence[int]], end: int, scans: object, lost: int
) -> None:
    source = rig_source(*map(Canned, counters))
    assert radars_of(source, end) == scans
    assert source.lost_frames == lost


def test_frames_are_stamped_with_their_own_radars_time() -> None:
    drivers = [Canned(range(4)) for _ in range(4)]
    source = rig_source(*drivers, skews_ns=[0, 190 * MS, 100 * MS, 150 * MS])
    assert times_of(source, 2) == [
        (0, 0, [(0, 0, 0), (1, 0, 190), (2, 0, 100), (3, 0, 150)]),
        (1, 200, [(0, 1, 200), (1, 1, 390), (2, 1, 300), (3, 1, 350)]),
    ]
    assert source.lost_frames == 0


def test_a_scans_time_is_the_ticks_whichever_radars_answered() -> None:
    source = rig_source(Canned([0, 2, 3]), Canned([0, 1, 3]), skews_ns=[0, 190 * MS])
    assert times_of(source, 3) == [
        (0, 0, [(0, 0, 0), (1, 0, 190)]),
        (1, 200, [(1, 1, 390)]),
        (2, 400, [(0, 2, 400)]),
    ]
    assert source.lost_frames == 2


def test_a_radar_that_started_periods_late_joins_the_scans_of_its_time() -> None:
    """Its first frame at 500 ms, 5 frames/s: it lies in the tick that begins at 400 ms."""
    source = rig_source(Canned(range(9)), Canned([0, 2, 3, 4]), skews_ns=[0, 500 * MS])
    assert times_of(source, 5) == [
        (0, 0, [(0, 0, 0)]),
        (1, 200, [(0, 1, 200)]),
        (2, 400, [(0, 2, 400), (1, 0, 500)]),
        (3, 600, [(0, 3, 600)]),
        (4, 800, [(0, 4, 800), (1, 2, 900)]),
    ]
    assert source.lost_frames == 1


def test_a_radar_that_starts_after_the_end_loses_nothing() -> None:
    source = rig_source(Canned(range(9)), Canned([0, 1]), skews_ns=[0, 10_000 * MS])
    assert [scan[0] for scan in times_of(source, 3)] == [0, 1, 2]
    assert source.lost_frames == 0


def test_a_radar_that_restarts_goes_on_where_its_new_stream_begins() -> None:
    drivers = Canned(range(9)), Restarting([0, 1], [2, 3, 9])  # its first two are lost
    source = rig_source(*drivers, skews_ns=[0, 30 * MS], begins={"radar1": 400 * MS}.__getitem__)
    assert times_of(source, 6) == [
        (0, 0, [(0, 0, 0), (1, 0, 30)]),
        (1, 200, [(0, 1, 200), (1, 1, 230)]),
        (2, 400, [(0, 2, 400)]),
        (3, 600, [(0, 3, 600)]),
        (4, 800, [(0, 4, 800), (1, 2, 830)]),
        (5, 1000, [(0, 5, 1000), (1, 3, 1030)]),
    ]
    assert source.lost_frames == 2


def test_a_radar_that_does_not_come_back_ends_the_run() -> None:
    source = rig_source(Restarting([0, 1], []), begins={"radar0": 0}.__getitem__)
    with pytest.raises(RadarSilentError, match="radar0 at port0: the port is gone after frame 2"):
        times_of(source, 7)


@given(st.integers(0, 10**11), st.floats(1.0, 400.0))
def test_every_frame_lies_in_the_period_of_its_scan(start_skew_ns: int, rate_hz: float) -> None:
    period = Fraction(10**9) / Fraction(rate_hz)
    late_ns = start_skew_ns - frame_sources.whole_periods(start_skew_ns, rate_hz) * period
    assert -1 < late_ns < period + 1  # times are rounded to nanoseconds


@pytest.mark.parametrize(
    ("end", "error", "words"),
    [
        (ResponseTimeout, RadarSilentError, "radar1 at port1: no frame for 0 s after frame 3"),
        (Disconnected, RadarSilentError, "radar1 at port1: the port is gone after frame 3"),
        (DeviceError, AppError, "radar1 at port1: the module refused X4DRIVER_SET FRAME"),
    ],
)
def test_a_radar_that_fails_is_named(
    monkeypatch: pytest.MonkeyPatch, end: type[Exception], error: type[AppError], words: str
) -> None:
    monkeypatch.setattr(frame_sources, "SILENCE_S", 0.0)
    with pytest.raises(error, match=words):
        radars_of(rig_source(Canned(range(9)), Canned(range(3), end)), 9)


def test_stopping_is_asked_for_while_waiting() -> None:
    stop = StopFlag()
    stop.received = signal.SIGTERM
    source = rig_source(Canned([]))
    source.start(RAW_CONFIG, 5)
    with pytest.raises(StopRequestedError):
        next(source.scans(1, stop))


def test_drivers_are_closed_once() -> None:
    driver = Canned([])
    source = rig_source(driver)
    with source, source:
        pass
    assert driver.closed == 1


@pytest.mark.parametrize(
    ("settings", "limit"),
    [
        ({}, 152 / 2048),  # protocol reference 9.7: 949 ... 1100 are 152 levels
        ({"dac_min": 0, "dac_max": 2047}, 1.0),
        ({"iterations": 7, "pulses_per_step": 11, "dac_min": 900, "dac_max": 1110}, 211 / 2048),
        ({"iterations": 3, "pulses_per_step": 25, "dac_step": 2}, 152 / 2048),
        # 15 pulses over 151 levels in steps of 8: the counter ends at 283, not at 283.125
        ({"iterations": 3, "pulses_per_step": 5, "dac_max": 1099, "dac_step": 3}, 151 / 2048),
    ],
)
def test_limits_are_what_the_sampler_gives_at_its_ends(
    short_scene: Scene, settings: dict[str, Any], limit: float
) -> None:
    config = dataclasses.replace(RAW_CONFIG, **settings)
    # leakage that drives the sampler over both ends of its range
    leakage = short_scene.leakage.model_copy(update={"amplitude": 9.0, "range_m": 0.7})
    with open_loopback(short_scene.model_copy(update={"leakage": leakage}), 0) as source:
        source.start(config, 1)
        (scan,) = source.scans(1, StopFlag())
    for one in scan.frames:
        assert one.limits is not None
        assert one.limits == (one.samples.min(), one.samples.max())  # the same floats
        assert one.limits == pytest.approx((-limit, limit), rel=1e-3)


def test_the_counter_knows_a_radars_skew_but_not_its_clocks_rate(short_scene: Scene) -> None:
    standing = short_scene.model_copy(update={"path": PathSpec()})
    late = standing.radars[1].model_copy(update={"start_skew_ms": 190.0, "clock_ppm": 50.0})
    skewed = standing.model_copy(update={"radars": (standing.radars[0], late)})
    with open_loopback(skewed, 0) as source:
        source.start(RAW_CONFIG, 5)
        scans = list(source.scans(3, StopFlag()))
    assert source.radars[1].start_skew_ns == 190 * MS
    assert [[f.t_ns - scan.t_ns for f in scan.frames] for scan in scans] == [[0, 190 * MS]] * 3


@pytest.fixture
def short_scene(tmp_path: Path) -> Scene:
    return load_scene(write_short_scene(tmp_path))


def test_the_real_driver_in_process_gives_1431_bins_at_the_chips_rate(short_scene: Scene) -> None:
    with open_loopback(short_scene, 0) as source:
        source.start(RAW_CONFIG, 5)
        scans = list(source.scans(3, StopFlag()))
    assert [info.name for info in source.radars] == [m.name for m in rig_of(short_scene).mounts]
    for info in source.radars:
        assert info.n_bins == 1431
        assert info.rate_hz == pytest.approx(5.018533, abs=1e-6)
    # protocol reference 9.6: one frame takes 1 / 5.018533 s
    assert [scan.t_ns for scan in scans] == pytest.approx([0, 199261419, 398522835], abs=200)
    assert all(f.samples.shape == (1431,) for scan in scans for f in scan.frames)


def test_the_last_frame_is_the_last_one_within_the_scene() -> None:
    # 10 s at 5.018533 frames/s: counters 0 ... 50, as frame 50 comes at 9.963 s
    assert end_tick(10_000_000_000) == 51
    assert end_tick(0) == 1


def test_the_rig_is_nominal_whatever_the_modules_are_like(short_scene: Scene) -> None:
    skewed = short_scene.radars[0].model_copy(update={"range_offset_m": 0.02})
    scene = short_scene.model_copy(update={"radars": (skewed, *short_scene.radars[1:])})
    assert rig_of(scene).mounts[0].range_offset_m == 0.0
    assert rig_of(scene).mounts[0].yaw_rad == pytest.approx(np.pi / 2)
