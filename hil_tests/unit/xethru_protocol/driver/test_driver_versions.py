"""What the drivers do not ask of old firmware. Protocol reference 17."""

from contextlib import nullcontext

import pytest

from hil_tests.unit.xethru_protocol.both_drivers import DriverOn
from hil_tests.unit.xethru_protocol.scripted import PlainModule
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import SensorMode, X4Setting
from xethru_protocol.wire.errors import DeviceError, OldFirmwareError, ResponseTimeout

LIST = m.SystemGetInfo(item=7)


def module_with(version_list: str, *refuses: m.X4DriverGet) -> PlainModule:
    instead: dict[m.Message | type[m.Message], list[m.Message | bytes]] = {
        LIST: [m.ReplyString(content_id=0x58, info=7, text=version_list)],
        m.GetSensitivity: [m.ReplyInt(content_id=0x10A5112B, values=(5,))],
    }
    for command in refuses:
        instead[command] = [m.Error(code=1)]
    return PlainModule(instead=instead)


def test_a_command_that_the_firmware_lacks_is_not_sent(driver_on: DriverOn) -> None:
    radar, line = driver_on(module_with("Annapurna:1.4.7;XEP:3.0.0;X4C51:2.1.0"))
    message = r"needs sensor firmware 1\.5\.10 or newer .*; .* has sensor firmware 1\.4\.7: update"
    for _ in range(2):
        with pytest.raises(OldFirmwareError, match=message):
            radar.request(m.GetSensitivity())
    assert line.received == [LIST], "the version is asked for once"


def test_firmware_that_has_it_is_asked_for_its_version_once(driver_on: DriverOn) -> None:
    radar, line = driver_on(module_with("Annapurna:1.5.10;XEP:3.3.0"))
    for _ in range(2):
        assert radar.request(m.GetSensitivity()).values == (5,)
    assert line.received == [LIST, m.GetSensitivity(), m.GetSensitivity()]


def test_a_module_that_tells_no_version_is_asked_anything(driver_on: DriverOn) -> None:
    module = PlainModule(instead={m.GetSensitivity: [m.Error(code=1)]})
    radar, _ = driver_on(module)
    with pytest.raises(DeviceError, match="error 1"):
        radar.request(m.GetSensitivity())


@pytest.mark.parametrize(
    "version_list",
    [
        "Annapurna:1.5.10-rc.1;XEP:3.3.0",  # before the release that is the first with it
        "Annapurna:1.5.3;XEP:3.1.0",
        "Annapurna:1.4.7-dev;XEP:3.0.0",
        "Annapurna:1.4.7;XEP:3.1.0",
        "Annapurna:9.0.0;XEP:9.0.0",
        "Annapurna:new;XEP:old",
        "Lidar:0.1.0;XEP:3.4.8",  # an application on XEP that is not the vendor's
        "DSP:1.0.0;XEP:3.4.8",
    ],
)
def test_firmware_that_is_no_release_answers_for_itself(
    driver_on: DriverOn, version_list: str
) -> None:
    radar, _ = driver_on(module_with(version_list))
    assert radar.request(m.GetSensitivity()).values == (5,)


@pytest.mark.parametrize(
    ("version_list", "goes_on"),
    [("X4M300:1.0.7;XEP:1.0.5", True), ("X4M300:1.1.4;XEP:1.1.3", False)],
)
def test_stop_without_a_profile_has_no_answer_of_old_firmware(
    driver_on: DriverOn, version_list: str, goes_on: bool
) -> None:
    """17: sensor 1.1.4 is the first that acknowledges it."""
    instead: dict[m.Message | type[m.Message], list[m.Message | bytes]] = {
        LIST: [m.ReplyString(content_id=0x58, info=7, text=version_list)],
        m.SetMode(mode=SensorMode.XTID_SM_STOP): [],
        m.LoadApp: [m.Ack()],
    }
    radar, line = driver_on(PlainModule(instead=instead))
    with nullcontext() if goes_on else pytest.raises(ResponseTimeout, match="answer to SETMODE"):
        radar.profile.load()
        radar.profile.stop()
    assert any(isinstance(command, m.LoadApp) for command in line.received) is goes_on


def test_files_need_an_xep_that_has_them(driver_on: DriverOn) -> None:
    radar, _ = driver_on(module_with("X4M300:1.0.7;XEP:1.0.5"))
    with pytest.raises(OldFirmwareError, match=r"needs XEP 1\.1\.0-beta or newer \(files\)"):
        radar.files.find_all()


def test_settings_that_old_firmware_cannot_tell_are_not_checked(driver_on: DriverOn) -> None:
    """17: several GETs are missing before XEP 3.3.0, the offset's perhaps among them."""
    missing = (X4Setting.ITERATIONS, X4Setting.FRAMEAREAOFFSET)
    gets = [m.X4DriverGet(setting=setting) for setting in missing]
    radar, _ = driver_on(module_with("XEP:3.0.0;X4C51:2.1.0", *gets))
    assert radar.configure_raw(RawConfig()).n_bins == 1431
    assert radar.warnings == [
        "XEP 3.0.0 cannot read back FRAMEAREAOFFSET; XEP 3.3.0 can",
        "XEP 3.0.0 cannot read back ITERATIONS; XEP 3.3.0 can",
    ]
    radar, _ = driver_on(module_with("XEP:3.3.0;X4C51:2.1.0", *gets))
    with pytest.raises(DeviceError, match="FRAMEAREAOFFSET"):
        radar.configure_raw(RawConfig())
