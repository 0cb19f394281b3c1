"""The presence profile: settings read back, messages come once a second, baseband frames too.

Loading and setting up a profile changes nothing that outlives it; running it saves its settings in
the module's flash (Protocol reference 8.2), so those tests run on real modules with --allow-flash.
"""

import numpy as np
import pytest

from hil_tests.plugin.findings import Measure
from hil_tests.plugin.session_radars import RadarUnderTest
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import (
    LedMode,
    NoiseMapControl,
    OutputFeature,
    PresenceState,
    SensorMode,
)
from xethru_protocol.wire.errors import DeviceError, LocalProtocolError

pytestmark = [pytest.mark.requires("settings"), pytest.mark.requires("presence")]


def test_zone_limits(radar: X4M300) -> None:
    """Protocol reference 4.4: 0.40 ... 9.40 m on a grid of 5.14 cm."""
    radar.profile.load()
    limits = radar.profile.zone_limits()
    assert limits.min_m == pytest.approx(0.40, abs=0.06)
    assert limits.max_m == pytest.approx(9.40, abs=0.06)
    assert limits.step_m == pytest.approx(0.0514, abs=0.0001)


@pytest.mark.parametrize("zone_m", [(0.4, 5.0), (1.0, 2.0), (2.5, 9.4)])
def test_zones_are_snapped_outward(radar: X4M300, zone_m: tuple[float, float]) -> None:
    """Protocol reference 4.4: by less than a step of 5.14 cm on each side."""
    radar.profile.load()
    start_m, end_m = radar.profile.set_zone(*zone_m)
    assert zone_m[0] - 0.0515 < start_m <= zone_m[0] + 1e-4
    assert zone_m[1] - 1e-4 <= end_m < zone_m[1] + 0.0515
    assert radar.profile.zone() == (start_m, end_m)


def test_profile_settings_read_back(radar: X4M300) -> None:
    radar.profile.load()
    for sensitivity in range(10):
        radar.profile.set_sensitivity(sensitivity)
        assert radar.profile.sensitivity() == sensitivity
    for band in (4, 3):
        radar.profile.set_band(band)
        assert radar.profile.band() == band
    for mode in LedMode:
        radar.profile.set_led(mode)
        assert radar.profile.led() is mode
    for control in (2, 3, 6, 7):
        radar.profile.set_noise_map(NoiseMapControl(control))
        assert radar.profile.noise_map() == control


def test_outputs_read_back_and_exclude_each_other(radar: X4M300) -> None:
    """Protocol reference 4.7: baseband as I and Q, or as amplitude and phase."""
    radar.profile.load()
    iq, ap = OutputFeature.BASEBAND_IQ, OutputFeature.BASEBAND_AMPLITUDE_PHASE
    radar.profile.set_output(iq)
    assert (radar.profile.output(iq), radar.profile.output(ap)) == (1, 0)
    radar.profile.set_output(ap)
    assert (radar.profile.output(iq), radar.profile.output(ap)) == (0, 1)
    radar.profile.set_output(iq, 0)
    assert (radar.profile.output(iq), radar.profile.output(ap)) == (0, 0)


def test_zones_outside_the_limits_are_not_sent(radar: X4M300) -> None:
    radar.profile.load()
    with pytest.raises(LocalProtocolError):
        radar.profile.set_zone(0.1, 5.0)
    with pytest.raises(LocalProtocolError):
        radar.profile.set_zone(1.0, 1.1)


@pytest.mark.writes_flash
def test_settings_are_refused_while_it_runs(radar: X4M300) -> None:
    """Protocol reference 8.3."""
    radar.profile.load()
    radar.profile.run()
    with pytest.raises(DeviceError):
        radar.profile.set_sensitivity(3)
    assert radar.mode() is SensorMode.XTID_SM_RUN
    radar.profile.stop()


@pytest.mark.writes_flash
def test_it_reports_once_a_second_while_it_starts(
    radar: X4M300, radar_place: RadarUnderTest, measure: Measure
) -> None:
    """Protocol reference 7.3, 8.1: INITIALIZING for up to 20 s, at 1 Hz, judged in virtual time."""
    radar.profile.load()
    radar.profile.set_zone(0.4, 5.0)
    radar.profile.set_noise_map(NoiseMapControl(6))
    radar.profile.set_output(OutputFeature.PRESENCE_SINGLE)
    radar.profile.run()
    arrivals_ns: list[int] = []

    def hear(message: m.Response, arrival_ns: int) -> None:
        if isinstance(message, m.PresenceSingle):
            arrivals_ns.append(arrival_ns)

    radar.listener = hear
    messages = [message for message in radar.messages(3) if isinstance(message, m.PresenceSingle)]
    radar.profile.stop()
    assert {message.state for message in messages} == {PresenceState.INITIALIZING}
    counters = [message.counter for message in messages]
    assert counters == sorted(set(counters))
    interval_s = float(np.diff(arrivals_ns).mean()) * 1e-9
    limit = (0.95, 1.05) if radar_place.place.virtual else (None, None)
    measure("presence_interval_mean", interval_s, unit="s", limit=limit)


@pytest.mark.writes_flash
@pytest.mark.slow
@pytest.mark.slow_hw(seconds=30)
def test_it_says_within_20_s_whether_somebody_is_there(radar: X4M300, measure: Measure) -> None:
    """Protocol reference 4.6, 8.1: with the default noise map, start-up takes 20 s."""
    radar.profile.load()
    radar.profile.set_noise_map(NoiseMapControl(6))
    radar.profile.set_output(OutputFeature.PRESENCE_SINGLE)
    seconds = 0

    def count(message: m.Response, arrival_ns: int) -> None:
        nonlocal seconds
        seconds += isinstance(message, m.PresenceSingle)

    radar.listener = count
    radar.profile.run()
    message = radar.profile.wait_until_initialized(timeout_s=30.0)
    radar.profile.stop()
    assert isinstance(message, m.PresenceSingle | m.PresenceMovingList)
    assert message.state in {PresenceState.NO_PRESENCE, PresenceState.PRESENCE}
    measure("presence_messages_until_initialized", seconds, limit=(15, 25))


@pytest.mark.writes_flash
def test_baseband_frames_of_the_profile(
    radar: X4M300, radar_place: RadarUnderTest, measure: Measure
) -> None:
    """Protocol reference 7.1: 17 per second, bins of 5.14 cm, one more at both ends of the zone.

    The rate is judged in virtual time: a busy host sees frames late and then in a bunch.
    """
    radar.profile.load()
    radar.profile.set_zone(0.4, 2.0)
    radar.profile.set_noise_map(NoiseMapControl(6))
    heard: list[m.BasebandIq] = []
    arrivals_ns: list[int] = []

    def hear(message: m.Response, arrival_ns: int) -> None:
        if isinstance(message, m.BasebandIq):
            heard.append(message)
            arrivals_ns.append(arrival_ns)

    radar.listener = hear
    radar.profile.set_output(OutputFeature.BASEBAND_IQ)
    radar.profile.run()
    list(radar.frames(20, timeout_s=10.0))
    radar.profile.stop()
    first = heard[0]
    assert first.bin_length_m == pytest.approx(0.0514403, abs=1e-6)
    assert first.carrier_frequency_hz == pytest.approx(7.29e9)
    assert first.range_offset_m == pytest.approx(0.35, abs=0.06)
    assert {(one.i.size, one.q.size) for one in heard} == {(first.num_bins, first.num_bins)}
    assert first.range_offset_m + first.bin_length_m * first.num_bins > 2.0
    counters = [one.counter for one in heard]
    assert counters == list(range(counters[0], counters[0] + len(counters)))
    rate_hz = (len(heard) - 1) / ((arrivals_ns[-1] - arrivals_ns[0]) * 1e-9)
    limit = (16.5, 17.5) if radar_place.place.virtual else (None, None)
    measure("baseband_rate", rate_hz, unit="Hz", limit=limit)


@pytest.mark.writes_flash
def test_idle_pauses_and_run_goes_on(radar: X4M300) -> None:
    """Protocol reference 8.3."""
    radar.profile.load()
    radar.profile.set_noise_map(NoiseMapControl(6))
    radar.profile.set_output(OutputFeature.PRESENCE_SINGLE)
    radar.profile.run()
    list(radar.messages(1))
    radar.profile.idle()
    assert radar.mode() is SensorMode.XTID_SM_IDLE
    radar.profile.run()
    assert isinstance(next(iter(radar.messages(1))), m.PresenceSingle)
    radar.profile.stop()


@pytest.mark.writes_flash
@pytest.mark.writes_factory_settings
def test_factory_preset_restores_the_defaults(radar: X4M300) -> None:
    """Protocol reference 4.4: sensitivity 5, zone 0.40 ... 9.40 m."""
    radar.profile.load()
    radar.profile.set_sensitivity(8)
    radar.profile.factory_preset()
    assert radar.profile.sensitivity() == 5
