"""What the drivers, sync and async, refuse or warn of before a module is asked for it."""

import pytest

from hil_tests.unit.xethru_protocol.both_drivers import DriverOn, Scripted
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import X4Setting
from xethru_protocol.wire.errors import LocalProtocolError


def test_impossible_area_is_refused_before_anything_is_sent(driver_on: DriverOn) -> None:
    radar, line = driver_on()
    with pytest.raises(LocalProtocolError, match="swap"):
        radar.configure_raw(RawConfig(frame_area_m=(5.0, 1.0)))
    assert line.received == []


def test_area_without_bins_is_refused_before_anything_is_sent(driver_on: DriverOn) -> None:
    radar, line = driver_on()
    with pytest.raises(
        LocalProtocolError, match=r"-3 \.\.\. -2 m has no bins; .* behind -0\.4309 m"
    ):
        radar.configure_raw(RawConfig(frame_area_m=(-3.0, -2.0), offset_m=0.18))
    cut = r"-1000 \.\.\. 1000 m, of which the module keeps 9\.8765 m, has no bins"
    with pytest.raises(LocalProtocolError, match=cut):
        radar.configure_raw(RawConfig(frame_area_m=(-1000.0, 1000.0), offset_m=0.18))
    assert line.received == []


def test_area_without_bins_at_the_modules_own_offset_is_refused_before_a_setting(
    driver_on: DriverOn,
) -> None:
    radar, line = driver_on()
    with pytest.raises(LocalProtocolError, match=r"-3 \.\.\. -2 m has no bins"):
        radar.configure_raw(RawConfig(frame_area_m=(-3.0, -2.0)))
    assert not any(isinstance(command, m.X4DriverSet) for command in line.received)


def test_frame_shorter_than_asked_for_is_warned_of(driver_on: DriverOn) -> None:
    radar, _ = driver_on()
    radar.configure_raw(RawConfig(frame_area_m=(0.2, 40.0)))
    (warning,) = [text for text in radar.warnings if "not at 40 m" in text]
    assert "ends at 9.4007 m" in warning  # where the scripted module ends


@pytest.mark.parametrize(
    ("fps", "made"), [(1e-6, "1"), (17.5, "17"), (70000.0, "4464"), (17.0, None)]
)
def test_rate_that_the_timer_cannot_make_is_warned_of(
    raw: Scripted, fps: float, made: str | None
) -> None:
    radar, _ = raw
    radar.start(fps)
    warned = [text for text in radar.warnings if "whole numbers" in text]
    assert [text.rpartition(" ")[2] for text in warned] == ([] if made is None else [made])


@pytest.mark.parametrize(("name", "largest"), [("iterations", 255), ("pulses_per_step", 65535)])
def test_numbers_the_chip_would_cut_are_refused(name: str, largest: int) -> None:
    for value in (1, largest):
        RawConfig(**{name: value})  # type: ignore[arg-type] # the two names are integer fields
    for value in (0, largest + 1):
        with pytest.raises(LocalProtocolError, match=rf"{name} must be 1 \.\.\. {largest}"):
            RawConfig(**{name: value})  # type: ignore[arg-type] # as above


@pytest.mark.parametrize(
    "command",
    [
        m.X4DriverGet(setting=X4Setting.PIFREGISTER),
        m.X4DriverSet(setting=X4Setting.FRAMEBINCOUNT, value=1),
        m.X4DriverSet(setting=0x99, value=1),  # type: ignore[arg-type] # that is the point
        m.X4DriverGet(setting=0x99),  # type: ignore[arg-type] # that is the point
    ],
    ids=["register without address", "no setter", "set unknown", "get unknown"],
)
def test_what_no_module_understands_is_not_sent(
    driver_on: DriverOn, command: m.Command[m.Ack]
) -> None:
    radar, line = driver_on()
    with pytest.raises(LocalProtocolError, match=r"X4DRIVER_[SG]ET cannot carry"):
        radar.request(command)
    assert line.received == []
