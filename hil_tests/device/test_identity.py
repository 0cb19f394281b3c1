"""What a module says of itself, and how it answers what it does not know."""

import re

import pytest

from xethru_protocol.driver.radar import X4M300
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import InfoItem, PongCode, SensorMode
from xethru_protocol.wire.errors import DeviceError

pytestmark = pytest.mark.requires("settings")


def test_it_answers_and_says_its_firmware(radar: X4M300) -> None:
    """Protocol reference 4.10; the base firmware says as much."""
    assert radar.ping() is PongCode.XTS_SPRP_READY
    info = radar.info()
    assert info.firmware_id
    assert info.version is not None
    assert re.match(r"[0-9]+\.[0-9]+\.[0-9]+", info.version)
    assert info.version_list is not None
    assert "XEP:" in info.version_list


@pytest.mark.requires("profiles")
def test_it_says_what_product_it_is(radar: X4M300) -> None:
    """Protocol reference 4.10."""
    info = radar.info()
    assert info.order_code in {"X4M200", "X4M210", "X4M300"}
    assert info.serial_number is not None
    assert re.fullmatch(r"[0-9]{12}", info.serial_number)
    assert info.item_number is not None
    assert re.fullmatch(r"[0-9]{6}-[0-9]{3}", info.item_number)


def test_it_says_the_same_every_time(radar: X4M300) -> None:
    assert radar.info() == radar.info()


@pytest.mark.parametrize("seed", [0, 0x7D7E7F7D, 0x7F7F7F7F, 0xFFFFFFFF])
def test_ping_takes_any_seed(radar: X4M300, seed: int) -> None:
    """Protocol reference 4.1: the seed is not checked. Special bytes must be escaped (1.1)."""
    assert radar.request(m.Ping(seed=seed)).value == PongCode.XTS_SPRP_READY


def test_unknown_items_are_refused(radar: X4M300) -> None:
    with pytest.raises(DeviceError) as refusal:
        radar.request(m.SystemGetInfo(item=0x55))
    assert refusal.value.code in {1, 33}
    assert radar.ping() is PongCode.XTS_SPRP_READY


def test_unknown_commands_are_refused(radar: X4M300) -> None:
    """Protocol reference 3: ERROR 1, and the next command is answered as ever."""
    with pytest.raises(DeviceError) as refusal:
        radar.request(m.SystemGetDebugData(item=0))
    assert refusal.value.code == 1
    assert radar.ping() is PongCode.XTS_SPRP_READY


@pytest.mark.requires("profiles")
def test_it_starts_a_test_stopped(radar: X4M300) -> None:
    """The fixture promises it: no profile is loaded and nothing comes of its own accord."""
    assert radar.mode() is SensorMode.XTID_SM_STOP
    assert radar.profile.profile_id() == 0
    assert radar.statistics.packets == 2
    assert radar.statistics.clean


def test_a_hundred_questions_are_answered_in_order(radar: X4M300) -> None:
    """No sequence numbers: replies are matched by order (Protocol reference 3)."""
    firmware = m.SystemGetInfo(item=InfoItem.XTID_SSIC_FIRMWAREID)
    version = m.SystemGetInfo(item=InfoItem.XTID_SSIC_VERSION)
    said = radar.request(firmware).text, radar.request(version).text
    for _ in range(25):
        assert radar.ping() is PongCode.XTS_SPRP_READY
        assert (radar.request(firmware).text, radar.request(version).text) == said
        with pytest.raises(DeviceError):
            radar.request(m.SystemGetInfo(item=0x55))
    assert radar.stray_count == 0
    assert radar.statistics.clean
