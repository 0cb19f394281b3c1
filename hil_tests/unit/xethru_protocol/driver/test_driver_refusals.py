"""What the drivers, sync and async, refuse or warn of before a module is asked for it."""

import pytest

from hil_tests.unit.xethru_protocol.both_drivers import DriverOn, Scripted
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import X4Setting
from xethru_protocol.wire.errors import LocalProtocolError


def test_impossible_area_is_refused_before_anything_is_sent(driver_on: DriverOn) -> None:
    radar, line = driver_on()
    with pytest.raises(LocalProtocolError):
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
    radar.configure_raw(RawConfig(iterations=1, pulses_per_step=1))
    radar.start(fps)
    warned = [text for text in radar.warnings if "whole numbers" in text]
    assert [text.rpartition(" ")[2] for text in warned] == ([] if made is None else [made])


@pytest.mark.parametrize(
    ("config", "possible", "impossible"),
    [
        (RawConfig(), 20, 21),  # sweeps of 16 x 300 x 152 pulses at 15.1875 MHz: 20.8/s
        (RawConfig(iterations=64, pulses_per_step=87), 17, 18),  # 17.95/s
        (RawConfig(iterations=64, pulses_per_step=5), 312, 313),
        (RawConfig(dac_min=0, dac_max=2047, iterations=8, pulses_per_step=10), 92, 93),
        (RawConfig(dac_step=3), 166, 167),
        (RawConfig(prf_div=4), 83, 84),
        (RawConfig(pulses_per_step=65535), 0, 1),
    ],
)
def test_rate_at_which_a_sweep_does_not_end_is_refused(
    driver_on: DriverOn, config: RawConfig, possible: int, impossible: int
) -> None:
    """Highest rates of Protocol reference 9.6, D = 1."""
    radar, line = driver_on()
    radar.configure_raw(config)
    line.received.clear()
    with pytest.raises(LocalProtocolError, match=rf"{impossible} frames/s .* at most {possible}\."):
        radar.start(impossible)
    assert line.received == []
    if possible:
        radar.start(possible)


@pytest.mark.parametrize(
    ("name", "value"),
    [("iterations", 32), ("pulses_per_step", 400), ("dac_min", 800), ("dac_max", 2047)],
)
def test_setting_that_the_running_rate_has_no_time_for_is_refused(
    raw: Scripted, name: str, value: int
) -> None:
    radar, line = raw
    radar.start(17)
    line.received.clear()
    with pytest.raises(LocalProtocolError, match="17 frames/s cannot be"):
        setattr(radar.x4, name, value)
    assert line.received == []
    radar.stop()
    setattr(radar.x4, name, value)
    with pytest.raises(LocalProtocolError, match="17 frames/s cannot be"):
        radar.start(17)


def test_thresholds_in_the_wrong_order_are_refused(raw: Scripted) -> None:
    radar, line = raw
    line.received.clear()
    with pytest.raises(LocalProtocolError, match="dac_min 1101 is above dac_max 1100"):
        RawConfig(dac_min=1101)
    for name, value in (("dac_min", 1101), ("dac_max", 948)):
        with pytest.raises(LocalProtocolError, match="is above dac_max"):
            setattr(radar.x4, name, value)
    assert line.received == []
    radar.x4.dac_max, radar.x4.dac_min = 1300, 1200
    radar.x4.dac_min = 1300  # one threshold is a sweep


@pytest.mark.parametrize("name", ["configured", "set", "set while it runs"])
def test_transmitter_that_is_off_is_warned_of(raw: Scripted, name: str) -> None:
    radar, _ = raw
    if name == "configured":
        radar.configure_raw(RawConfig(tx_power=0))
    elif name == "set":
        radar.x4.tx_power = 0
    assert radar.warnings == []
    radar.start(17)
    if name == "set while it runs":
        radar.x4.tx_power = 0
    assert [text for text in radar.warnings if "transmitter is off" in text]


def test_frame_area_behind_the_longest_delay_is_refused(driver_on: DriverOn) -> None:
    """The chip keeps its receive delay, 0.6173 m a step, in eight bits. Protocol reference 9.4."""
    radar, line = driver_on()
    for start_m in (157.6, 200.0):
        with pytest.raises(LocalProtocolError, match=r"begins behind 157\.6 m"):
            radar.configure_raw(RawConfig(frame_area_m=(start_m, start_m + 5.0), offset_m=0.18))
    assert line.received == []
    assert RawConfig(frame_area_m=(157.5, 160.0)).area(0.18).rx_wait == 255


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
