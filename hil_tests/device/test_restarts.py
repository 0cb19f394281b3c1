"""A module that restarts, is unplugged, or changes its baud rate."""

import contextlib

import pytest

from hil_tests.plugin.findings import Measure
from hil_tests.plugin.session_radars import RadarUnderTest
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import PongCode, SensorMode
from xethru_protocol.wire.errors import DeviceError, Disconnected, ResponseTimeout

pytestmark = pytest.mark.requires("settings")

SHORT = RawConfig(frame_area_m=(0.4, 1.0))


def test_it_is_ready_again_after_a_reset(
    radar: X4M300, radar_place: RadarUnderTest, measure: Measure
) -> None:
    """Protocol reference 8.1: ready again after 2 ... 9 s, X4 settings gone."""
    radar.configure_raw(RawConfig(iterations=8))
    serial = radar.info().serial_number
    begin_ns = radar_place.place.clock_ns()
    radar.reset(wait=True)
    ready_s = (radar_place.place.clock_ns() - begin_ns) * 1e-9
    assert radar.ping() is PongCode.XTS_SPRP_READY
    assert radar.info().serial_number == serial
    assert radar.x4.fps == 0.0
    radar.configure_raw()
    assert radar.x4.iterations == 16
    measure("reset_to_ready", ready_s, unit="s", limit=(2.0, None))


def test_frames_come_again_after_a_reset_in_a_stream(radar: X4M300, frame_rate_hz: float) -> None:
    """The module says nothing of the end of its stream: only who asked for the reset knows."""
    radar.configure_raw(SHORT)
    radar.start(frame_rate_hz)
    list(radar.frames(2))
    radar.reset(wait=True)
    radar.configure_raw(SHORT)
    radar.start(frame_rate_hz)
    counters = [frame.counter for frame in radar.frames(3)]
    assert counters == list(range(counters[0], counters[0] + 3))


@pytest.mark.requires("unplug")
def test_the_driver_goes_on_after_an_unplug(
    radar_place: RadarUnderTest, frame_rate_hz: float
) -> None:
    """It finds the module by its own serial number and restores what was set."""
    radar = radar_place.open(reconnect_s=15.0)
    geometry = radar.configure_raw(SHORT)
    radar.start(frame_rate_hz)
    before = radar.read_frame()
    radar_place.place.unplug(0.5)
    while (frame := radar.read_frame(timeout_s=15.0)).stream == before.stream:
        before = frame
    assert radar.reconnects == 1
    assert frame.geometry == geometry
    assert frame.samples.shape == (geometry.n_bins,)
    # the time without frames, less what rounding and late arrivals make of it
    missing = (frame.arrival_ns - before.arrival_ns) * 1e-9 * frame_rate_hz
    assert radar.frames_lost == pytest.approx(missing - 1, abs=1 + 0.02 * missing)


@pytest.mark.requires("unplug")
def test_an_unplugged_module_is_disconnected(radar: X4M300, radar_place: RadarUnderTest) -> None:
    radar.configure_raw(SHORT)
    radar.start(17.0)
    radar.read_frame()
    radar_place.place.unplug(0.5)
    with pytest.raises(Disconnected):
        list(radar.frames(timeout_s=5.0))


@pytest.mark.requires("power")
def test_a_power_cut_leaves_nothing_of_the_chips_settings(
    radar_place: RadarUnderTest, frame_rate_hz: float
) -> None:
    """Protocol reference 8.2, 9.3: X4 settings are never saved; 8 iterations, 0 frames/s."""
    radar = radar_place.open()
    serial = radar.info().serial_number
    radar.configure_raw(RawConfig(frame_area_m=(0.4, 1.0), iterations=12))
    radar.start(frame_rate_hz)
    list(radar.frames(3))
    radar = radar_place.power_cycle()
    assert radar.ping() is PongCode.XTS_SPRP_READY
    assert radar.info().serial_number == serial
    assert (radar.x4.fps, radar.x4.iterations) == (0.0, 8)


@pytest.mark.requires("power")
def test_the_counter_begins_at_1_after_a_power_cut(
    radar_place: RadarUnderTest, frame_rate_hz: float
) -> None:
    """Protocol reference 6.1: without an INIT, which clears it, too.

    The module stays stopped (8.2): a profile would count its sweeps.
    """
    radar = radar_place.open()
    geometry = radar.configure_raw(SHORT)
    radar.start(frame_rate_hz)
    assert [frame.counter for frame in radar.frames(3)] == [1, 2, 3]
    radar.stop()
    radar = radar_place.power_cycle()
    with contextlib.suppress(DeviceError):  # bare XEP firmware has no modes
        radar.set_mode(SensorMode.XTID_SM_STOP)
        radar.set_mode(SensorMode.XTID_SM_MANUAL)
    radar.x4.frame_area_m = SHORT.frame_area_m
    radar.geometry = geometry  # the driver discards frames whose bins it does not know
    radar.x4.fps = 5.0
    assert [frame.counter for frame in radar.frames(3)] == [1, 2, 3]


@pytest.mark.requires("uart")
@pytest.mark.parametrize("baudrate", [921600, 230400])
def test_baud_rates(radar: X4M300, baudrate: int) -> None:
    """Protocol reference 4.10, 10: answered at the old rate, then both sides change."""
    radar.set_baud_rate(baudrate)
    assert radar.ping() is PongCode.XTS_SPRP_READY
    radar.configure_raw(SHORT)
    radar.start(5.0)
    counters = [frame.counter for frame in radar.frames(5)]
    radar.stop()
    assert counters == list(range(counters[0], counters[0] + 5))
    radar.set_baud_rate(115200)
    assert radar.ping() is PongCode.XTS_SPRP_READY
    assert radar.fault_count == 0


@pytest.mark.requires("uart")
def test_a_reset_takes_the_baud_rate_back(radar: X4M300) -> None:
    """Protocol reference 10: it is not saved; the driver follows and sets it again."""
    radar.set_baud_rate(921600)
    radar.reset(wait=True)
    assert radar.ping() is PongCode.XTS_SPRP_READY
    radar.set_baud_rate(115200)


def test_rates_no_module_has_change_nothing(radar: X4M300) -> None:
    """Protocol reference 4.10: values outside 600 ... 10 000 000 are acknowledged and ignored."""
    radar.request(m.SetBaudRate(baudrate=300))
    try:
        assert radar.ping(5.0) is PongCode.XTS_SPRP_READY
    except ResponseTimeout:  # say what happened, not that something was slow
        pytest.fail("it changed its rate to one that it does not have")
