"""The emulator plays old firmware as the protocol reference's chapter 17 describes it."""

import numpy as np
import pytest

from emulator.chip import Pace
from emulator.module.settings import DeviceOptions
from emulator.x4m300 import radar_device
from hil_tests.unit.emulator.doubles import IDENTITY, BareHost, RampSource, host_of
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import SensorMode, X4Setting

RUN, STOP, MANUAL = SensorMode.XTID_SM_RUN, SensorMode.XTID_SM_STOP, SensorMode.XTID_SM_MANUAL
SECOND = 1_000_000_000


def host_with(firmware: str, **options: float) -> BareHost:
    return host_of(DeviceOptions(firmware=firmware, **options))


def text(host: BareHost, item: int) -> str:
    reply = host.ask(m.SystemGetInfo(item=item))
    assert isinstance(reply, m.ReplyString)
    return reply.text


def test_a_version_names_itself() -> None:
    host = host_with("sensor-1.2.1")
    assert (text(host, 2), text(host, 3)) == ("X4M300", "1.2.1")
    assert text(host, 7).startswith("X4M300:1.2.1;XEP:")
    assert text(host_with("sensor-1.3.1"), 2) == "Annapurna"
    assert text(host_with("xep-3.3.0"), 7) == "XEP:3.3.0;X4C51:2.1.0"


def test_settings_of_a_running_profile_were_acknowledged_without_effect() -> None:
    command = m.SetSensitivity(sensitivity=9)
    host = host_with("sensor-1.0.5-rc.1")
    assert host.ask(command) == m.Ack()
    assert host.device.module.profile.sensitivity == 5
    assert host_with("sensor-1.0.5-rc.2").ask(command) == m.Error(code=0x21)


def test_stop_without_profile_was_not_acknowledged() -> None:
    for firmware, answers in (("sensor-1.0.7", []), ("sensor-1.1.4", [m.Ack()])):
        host = host_with(firmware)
        host.command(m.SetMode(mode=STOP))
        host.send(m.SetMode(mode=STOP))
        assert host.hear() == answers


@pytest.mark.parametrize(
    ("firmware", "key"),
    [
        ("sensor-1.0.7", 0xA2B95EF0),
        ("sensor-1.1.4", 0xA2B96EF1),
        ("xep-1.0.5", 0xA2B95EF0),
        ("xep-1.1.3", 0xA2B96EF1),
    ],
)
def test_the_bootloader_has_the_key_of_its_time(firmware: str, key: int) -> None:
    host = host_with(firmware)
    other = 0xA2B95EF0 ^ 0xA2B96EF1 ^ key
    host.send(m.StartBootloader(key=other))
    assert host.hear(2)[-1] == m.Error(code=1)
    assert host.ask(m.StartBootloader(key=key)) == m.Ack()


@pytest.mark.parametrize(
    ("firmware", "command"),
    [
        ("sensor-1.4.7", m.GetSensitivity()),
        ("sensor-1.5.10", m.DeleteNoiseMap()),
        ("xep-1.0.7-beta", m.FindAllFiles()),
        ("xep-3.0.0", m.SystemGetInfo(item=8)),
        ("xep-3.0.0", m.X4DriverGet(setting=X4Setting.ITERATIONS)),
    ],
)
def test_what_a_version_lacks_is_not_recognised(
    firmware: str, command: m.Command[m.Response]
) -> None:
    assert host_with(firmware).ask(command) == m.Error(code=1)
    newest = firmware.partition("-")[0]
    host = host_with(newest)
    if newest == "sensor":
        host.command(m.SetMode(mode=STOP), m.LoadApp(profile_id=0x014D4AB8))
    assert not isinstance(host.ask(command), m.Error)


def baseband(firmware: str) -> tuple[bytes, m.DataFloat]:
    options = DeviceOptions(firmware=firmware)
    host = BareHost(radar_device(IDENTITY, RampSource(), Pace.ASAP, options=options))
    host.set(X4Setting.DOWNCONVERSION, 1)
    host.set(X4Setting.FRAMEAREA, (0.2, 9.4))
    host.set(X4Setting.FPS, 17.0)
    packet = host.device.next_packet(0)
    assert packet is not None
    (frame,) = host.frames(1)
    return packet, frame


def test_q_was_not_negated_and_baseband_not_in_noescape() -> None:
    (old_packet, old), (new_packet, new) = baseband("xep-1.0.5"), baseband("xep-2.1.0")
    assert (old_packet[0], new_packet[:4]) == (0x7D, b"\x7c" * 4)
    n_bins = len(new.values) // 2
    np.testing.assert_array_equal(old.values[:n_bins], new.values[:n_bins])
    np.testing.assert_array_equal(old.values[n_bins:], -new.values[n_bins:])
    assert new.values[n_bins:].any()


def test_boards_kept_no_offset_before_2_2_0() -> None:
    for firmware, offset_m in (("xep-2.1.8", 0.18), ("xep-3.3.0", 0.25)):
        reply = host_with(firmware, board_offset_m=0.25).ask(
            m.X4DriverGet(setting=X4Setting.FRAMEAREAOFFSET)
        )
        known = firmware == "xep-3.3.0"
        assert (reply == m.ReplyFloat(content_id=0x18, values=(offset_m,))) is known
    host = host_with("xep-2.1.8", board_offset_m=0.25)
    assert host.device.module.chip.get(X4Setting.FRAMEAREAOFFSET) == np.float32(0.18)


def test_an_unknown_version_is_no_option() -> None:
    with pytest.raises(ValueError, match='"sensor-2" is not known; it is one of sensor, '):
        DeviceOptions(firmware="sensor-2")
