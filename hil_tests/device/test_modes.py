"""Sensor modes: which one leads where, and what is refused without a profile."""

import pytest

from xethru_protocol.driver.radar import X4M300
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import ProfileId, SensorMode
from xethru_protocol.wire.errors import DeviceError

pytestmark = [pytest.mark.requires("settings"), pytest.mark.requires("profiles")]


def test_manual_and_back(radar: X4M300) -> None:
    for wanted in (SensorMode.XTID_SM_MANUAL, SensorMode.XTID_SM_STOP) * 3:
        radar.set_mode(wanted)
        assert radar.mode() is wanted


def test_stop_is_taken_twice(radar: X4M300) -> None:
    """Protocol reference 8.3: ACK also with no profile."""
    radar.set_mode(SensorMode.XTID_SM_STOP)
    radar.set_mode(SensorMode.XTID_SM_STOP)
    assert radar.mode() is SensorMode.XTID_SM_STOP


@pytest.mark.parametrize("wanted", [SensorMode.XTID_SM_RUN, SensorMode.XTID_SM_IDLE])
def test_nothing_runs_without_a_profile(radar: X4M300, wanted: SensorMode) -> None:
    with pytest.raises(DeviceError):
        radar.set_mode(wanted)
    assert radar.mode() is SensorMode.XTID_SM_STOP


def test_unknown_modes_are_refused(radar: X4M300) -> None:
    with pytest.raises(DeviceError):
        radar.request(m.SetMode(mode=0x77))
    assert radar.mode() is SensorMode.XTID_SM_STOP


@pytest.mark.requires("presence")
def test_a_loaded_profile_does_not_run_yet(radar: X4M300) -> None:
    """Protocol reference 8.3: STOP unloads it again."""
    radar.profile.load(ProfileId.XTS_ID_APP_PRESENCE_2)
    assert radar.profile.profile_id() == ProfileId.XTS_ID_APP_PRESENCE_2
    assert radar.profile.sensitivity() in range(10)
    radar.set_mode(SensorMode.XTID_SM_STOP)
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
    assert radar.mode() is SensorMode.XTID_SM_MANUAL


def test_x4_settings_work_without_a_profile(radar: X4M300) -> None:
    """Protocol reference 8.3: in STOP and in MANUAL."""
    for wanted in (SensorMode.XTID_SM_STOP, SensorMode.XTID_SM_MANUAL):
        radar.set_mode(wanted)
        radar.x4.iterations = 12
        assert radar.x4.iterations == 12
