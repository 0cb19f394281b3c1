"""The table of versions against the protocol reference, chapter 17."""

import itertools

import pytest

from xethru_protocol.wire import messages as m
from xethru_protocol.wire import versions
from xethru_protocol.wire.versions import FirmwareVersions, firmware_named

# Chapter 17: what an older version does not know, and the first that does.
SINCE: list[tuple[m.Message, str, str]] = [
    (m.NoiseMapSetControl(control=6), "sensor-1.1.4", "sensor-1.2.1"),
    (m.StoreNoiseMap(), "sensor-1.1.4", "sensor-1.2.1"),
    (m.OutputSetControl(feature=0x10, control=1), "sensor-1.1.4", "sensor-1.2.1"),
    (m.IoPinSetControl(pin_id=1, pin_setup=1, pin_feature=3), "sensor-1.3.1", "sensor-1.4.7"),
    (m.SystemTest(code=0x1A), "sensor-1.3.1", "sensor-1.4.7"),
    (m.SetMode(mode=0x50, param=0), "sensor-1.3.1", "sensor-1.4.7"),
    (m.OutputGetControl(feature=0x0C), "sensor-1.4.7", "sensor-1.5.10"),
    (m.AppGetLedControl(), "sensor-1.4.7", "sensor-1.5.10"),
    (m.IoPinGetControl(pin_id=1), "sensor-1.4.7", "sensor-1.5.10"),
    (m.GetSensitivity(), "sensor-1.4.7", "sensor-1.5.10"),
    (m.SetTxCenterFrequency(tx_center_frequency=4), "sensor-1.4.7", "sensor-1.5.10"),
    (m.DeleteNoiseMap(), "sensor-1.5.10", "sensor-1.6.6"),
    (m.LoadApp(profile_id=0x4AC5D074), "sensor-1.5.10", "sensor-1.6.6"),
    (m.IoPinSetControl(pin_id=1, pin_setup=1, pin_feature=6), "sensor-1.6.6", "sensor-1.6.8"),
    (m.SetBaudRate(baudrate=9600), "xep-1.0.5", "xep-1.0.7-beta"),
    (m.FindAllFiles(), "xep-1.0.7-beta", "xep-1.1.0-beta"),
    (m.FormatFilesystem(key=1), "xep-1.1.3", "xep-2.0.0"),
    (m.SystemGetInfo(item=8), "xep-3.0.0", "xep-3.3.0"),
    (m.SystemGetInfo(item=8), "sensor-1.4.7", "sensor-1.5.10"),
]


def knows(firmware: str, command: m.Message) -> bool:
    return all(row.is_in(firmware_named(firmware)) for row in versions.needed_by(command))


@pytest.mark.parametrize(("command", "old", "new"), SINCE)
def test_commands_are_known_since_the_version_of_the_reference(
    command: m.Message, old: str, new: str
) -> None:
    assert not knows(old, command)
    assert knows(new, command)


@pytest.mark.parametrize(
    "command",
    [
        m.Ping(),
        m.SetTxCenterFrequency(tx_center_frequency=3),
        m.OutputSetControl(feature=0x723BFA1E, control=1),
        m.SystemTest(code=0x19),
        m.LoadApp(profile_id=0x014D4AB8),
        m.SystemGetInfo(item=7),
    ],
)
def test_other_cases_of_them_are_as_old_as_the_module(command: m.Message) -> None:
    assert knows("sensor-1.0.5-rc.1", command)


def test_versions_count_with_their_pre_releases() -> None:
    """1.0.5-rc.2 lies before 1.0.5, and 1.5.10 behind 1.5.9."""
    texts = ["1.0.3-rc.1", "1.0.3-rc.2", "1.0.5", "1.0.7-beta", "1.0.7", "1.1.0-beta", "1.5.9"]
    keys = [versions.version_key(text) for text in [*texts, "1.5.10"]]
    assert all(a is not None and b is not None and a < b for a, b in itertools.pairwise(keys))


@pytest.mark.parametrize(
    "text", ["", "XEP", "a;b;c", ":::", "Annapurna:new;XEP:x", "1.6.8", "\x00:;\x7f"]
)
def test_a_version_list_that_says_nothing_leaves_everything_to_the_module(text: str) -> None:
    firmware = FirmwareVersions.of_list(text)
    assert versions.lacking(firmware) == ()


def test_the_newest_lack_nothing_and_1_6_6_has_its_known_fault() -> None:
    assert versions.lacking(firmware_named("sensor")) == ()
    assert versions.lacking(firmware_named("xep")) == ()
    rows = versions.lacking(firmware_named("sensor-1.6.6"))
    assert rows == (versions.DAC_STEP, versions.NO_PRESENCE_PIN)


@pytest.mark.parametrize("name", ["sensor-9.9.9", "xep-1.6.8", "x4", "", "sensor-"])
def test_an_unknown_version_lists_the_known_ones(name: str) -> None:
    with pytest.raises(ValueError, match=r"one of sensor, sensor-1\.0\.5-rc\.1, .*, xep-3\.4\.8 "):
        firmware_named(name)
