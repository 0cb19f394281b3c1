"""Sensor modes: which one leads where, and what is refused without a profile."""

import pytest

from xethru_protocol.driver.radar import X4M300
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import ProfileId, SensorMode, X4Setting
from xethru_protocol.wire.errors import DeviceError

pytestmark = [pytest.mark.requires("settings"), pytest.mark.requires("profiles")]


def mode(radar: X4M300) -> SensorMode:
    return SensorMode(radar.request(m.GetMode()).values[0])


def set_mode(radar: X4M300, wanted: SensorMode) -> None:
    radar.request(m.SetMode(mode=wanted), 10.0)


def test_manual_and_back(radar: X4M300) -> None:
    for wanted in (SensorMode.XTID_SM_MANUAL, SensorMode.XTID_SM_STOP) * 3:
        set_mode(radar, wanted)
        assert mode(radar) is wanted


def test_stop_is_taken_twice(radar: X4M300) -> None:
    """Protocol reference 8.3: ACK also with no profile."""
    set_mode(radar, SensorMode.XTID_SM_STOP)
    set_mode(radar, SensorMode.XTID_SM_STOP)
    assert mode(radar) is SensorMode.XTID_SM_STOP


@pytest.mark.parametrize("wanted", [SensorMode.XTID_SM_RUN, SensorMode.XTID_SM_IDLE])
def test_nothing_runs_without_a_profile(radar: X4M300, wanted: SensorMode) -> None:
    with pytest.raises(DeviceError):
        set_mode(radar, wanted)
    assert mode(radar) is SensorMode.XTID_SM_STOP


def test_unknown_modes_are_refused(radar: X4M300) -> None:
    with pytest.raises(DeviceError):
        radar.request(m.SetMode(mode=0x77))
    assert mode(radar) is SensorMode.XTID_SM_STOP


def test_a_loaded_profile_does_not_run_yet(radar: X4M300) -> None:
    """Protocol reference 8.3: STOP unloads it again."""
    radar.request(m.LoadApp(profile_id=ProfileId.XTS_ID_APP_PRESENCE_2), 10.0)
    assert radar.profile.profile_id() == ProfileId.XTS_ID_APP_PRESENCE_2
    assert radar.profile.sensitivity() in range(10)
    set_mode(radar, SensorMode.XTID_SM_STOP)
    assert radar.profile.profile_id() == 0
    with pytest.raises(DeviceError):
        radar.request(m.GetSensitivity())


def test_profiles_of_other_products_are_refused(radar: X4M300) -> None:
    """Protocol reference 4.3."""
    with pytest.raises(DeviceError):
        radar.request(m.LoadApp(profile_id=0x12345678), 10.0)
    assert radar.profile.profile_id() == 0


def test_frames_that_stop_leave_it_in_manual(radar: X4M300, frame_rate_hz: float) -> None:
    radar.configure_raw()
    radar.start(frame_rate_hz)
    radar.read_frame()
    radar.stop()
    assert mode(radar) is SensorMode.XTID_SM_MANUAL


def test_x4_settings_work_without_a_profile(radar: X4M300) -> None:
    """Protocol reference 8.3: in STOP and in MANUAL."""
    for wanted in (SensorMode.XTID_SM_STOP, SensorMode.XTID_SM_MANUAL):
        set_mode(radar, wanted)
        radar.request(m.X4DriverSet(setting=X4Setting.ITERATIONS, value=12))
        assert radar.request(m.X4DriverGet(setting=X4Setting.ITERATIONS)).values[0] == 12
