"""Every X4 setting reads back as the chip keeps it, whatever bytes it is made of."""

import numpy as np
import pytest

from xethru_protocol.driver.link import RawConfig
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import PongCode, X4Setting
from xethru_protocol.wire.errors import DeviceError, LocalProtocolError

pytestmark = pytest.mark.requires("settings")


def read(radar: X4M300, setting: X4Setting) -> object:
    values = radar.request(m.X4DriverGet(setting=setting)).values
    return tuple(values) if len(values) > 1 else values[0]


def area(start_m: float, end_m: float, offset_m: float, downconversion: bool) -> RawConfig:
    return RawConfig(
        frame_area_m=(start_m, end_m), offset_m=offset_m, downconversion=downconversion
    )


def test_defaults_after_init(radar: X4M300) -> None:
    """Protocol reference 9.3."""
    radar.configure_raw()
    radar.x4.init()
    settings = radar.x4.settings()
    assert settings[X4Setting.FPS] == 0
    assert settings[X4Setting.PULSESPERSTEP] == 10
    assert settings[X4Setting.ITERATIONS] == 8
    assert settings[X4Setting.DOWNCONVERSION] == 0
    assert (settings[X4Setting.DACMIN], settings[X4Setting.DACMAX]) == (0, 2047)
    assert settings[X4Setting.DACSTEP] == 0
    assert settings[X4Setting.FRAMEAREAOFFSET] == pytest.approx(0.18)
    assert settings[X4Setting.TXPOWER] == 2
    assert settings[X4Setting.TXCENTERFREQUENCY] == 3
    assert settings[X4Setting.PRFDIV] == 16
    assert settings[X4Setting.FRAMEAREA] == pytest.approx((-0.0000411, 9.4328289), abs=1e-6)
    assert settings[X4Setting.FRAMEBINCOUNT] == 1467


def test_the_working_point_reads_back(radar: X4M300) -> None:
    radar.configure_raw()
    settings = radar.x4.settings()
    assert settings[X4Setting.DACMIN] == 949
    assert settings[X4Setting.DACMAX] == 1100
    assert settings[X4Setting.ITERATIONS] == 16
    assert settings[X4Setting.PULSESPERSTEP] == 300
    assert settings[X4Setting.DACSTEP] == 0
    assert settings[X4Setting.PRFDIV] == 16
    assert settings[X4Setting.FRAMEAREA] == pytest.approx((0.199290, 9.400679), abs=1e-6)


@pytest.mark.parametrize(
    ("setting", "values"),
    [
        # 0x7D, 0x7E and 0x7F are the special bytes of the framing, alone, doubled, and both
        (X4Setting.PULSESPERSTEP, (1, 0x7D, 0x7E, 0x7F, 300, 0x7D7E, 0x7F7F, 65535)),
        (X4Setting.DACMIN, (0, 0x7D, 0x7E, 0x7F, 949, 2047)),
        (X4Setting.DACMAX, (0, 0x7D, 0x7E, 0x7F, 1100, 2047)),
        (X4Setting.DACSTEP, (0, 1, 2, 3)),
        (X4Setting.DOWNCONVERSION, (0, 1)),
        (X4Setting.TXCENTERFREQUENCY, (3, 4)),
        (X4Setting.TXPOWER, (0, 1, 2, 3)),
        (X4Setting.PRFDIV, (4, 16, 0x7D, 0x7E, 0x7F, 255)),
    ],
    ids=lambda value: value.name if isinstance(value, X4Setting) else "",
)
def test_whole_numbers_read_back(
    radar: X4M300, setting: X4Setting, values: tuple[int, ...]
) -> None:
    """Protocol reference 4.9; bytes 7Dh, 7Eh, 7Fh travel escaped (1.1)."""
    radar.x4.init()
    for value in values:
        radar.request(m.X4DriverSet(setting=setting, value=value))
        assert read(radar, setting) == value
    assert radar.statistics.clean


def test_every_byte_reads_back(radar: X4M300) -> None:
    """All of 1 ... 255: among them, value or checksum is every special byte, in both directions."""
    radar.x4.init()
    for value in range(1, 256):
        radar.request(m.X4DriverSet(setting=X4Setting.ITERATIONS, value=value))
        assert read(radar, X4Setting.ITERATIONS) == value
    assert (radar.fault_count, radar.stray_count) == (0, 0)
    assert radar.statistics.clean


@pytest.mark.parametrize("offset_m", [0.0, 0.18, 0.2, 0.0312423706])  # the last is 3CFFF7F3h
def test_offsets_read_back_as_float32(radar: X4M300, offset_m: float) -> None:
    radar.x4.init()
    radar.request(m.X4DriverSet(setting=X4Setting.FRAMEAREAOFFSET, value=offset_m))
    assert read(radar, X4Setting.FRAMEAREAOFFSET) == np.float32(offset_m)


@pytest.mark.parametrize(
    ("asked", "bins", "read_back_m"),
    [
        (area(0.2, 9.4, 0.18, False), 1431, (0.199290, 9.400679)),
        (area(0.2, 9.4, 0.18, True), 181, (0.180000, 9.439260)),
        (area(0.2, 9.4, 0.0, False), 1431, (0.199331, 9.400720)),
        (area(0.2, 9.4, 0.2, True), 180, (0.200000, 9.407819)),
        (area(-0.5, 9.4, 0.18, False), 1527, (-0.437284, 9.381389)),
        (area(0.4, 5.0, 0.18, False), 716, (0.398621, 5.002531)),
        (area(0.4, 5.0, 0.0, True), 92, (0.360082, 5.041152)),
        (area(-0.5, 5.0, 0.18, False), 846, (-0.437284, 5.002531)),
        (area(0.0, 1.0, 0.18, True), 21, (-0.025761, 1.003045)),
        (area(0.18, 10.1, 0.18, False), 1535, (0.18, 10.050113)),
        (area(0.18, 10.1, 0.18, True), 188, (0.18, 9.799341)),
    ],
)
def test_frame_areas_are_quantised_as_the_vendor_does(
    radar: X4M300, asked: RawConfig, bins: int, read_back_m: tuple[float, float]
) -> None:
    """Protocol reference 9.4, computed by the vendor's own compiled driver."""
    geometry = radar.configure_raw(asked)
    assert geometry.n_bins == bins
    assert read(radar, X4Setting.FRAMEBINCOUNT) == bins
    assert read(radar, X4Setting.FRAMEAREA) == pytest.approx(read_back_m, abs=1e-6)


def test_the_order_of_settings_does_not_matter(radar: X4M300) -> None:
    """Protocol reference 9.4: offset and downconversion apply the requested area anew."""
    for order in ((0, 1, 2), (2, 1, 0), (1, 2, 0)):
        radar.x4.init()
        commands = (
            m.X4DriverSet(setting=X4Setting.FRAMEAREA, value=(0.2, 9.4)),
            m.X4DriverSet(setting=X4Setting.FRAMEAREAOFFSET, value=0.0),
            m.X4DriverSet(setting=X4Setting.DOWNCONVERSION, value=1),
        )
        for index in order:
            radar.request(commands[index])
        assert read(radar, X4Setting.FRAMEBINCOUNT) == 181
        assert read(radar, X4Setting.FRAMEAREA) == pytest.approx((0.154321, 9.413580), abs=1e-6)


@pytest.mark.parametrize(
    ("setting", "value", "code"),
    [
        (X4Setting.TXCENTERFREQUENCY, 5, 20),
        (X4Setting.TXPOWER, 4, 21),
        (X4Setting.DACSTEP, 4, 12),
        (X4Setting.FRAMEAREA, (5.0, 0.4), 17),
        (X4Setting.PRFDIV, 3, 18),
        (X4Setting.DACMAX, 2048, 1),
        (X4Setting.DACMIN, 2048, 1),
    ],
)
def test_bad_settings_are_refused_and_change_nothing(
    radar: X4M300, setting: X4Setting, value: m.X4Value, code: int
) -> None:
    """Protocol reference 4.9, 5.1."""
    radar.configure_raw()
    before = read(radar, setting)
    with pytest.raises(DeviceError) as refusal:
        radar.request(m.X4DriverSet(setting=setting, value=value))
    assert refusal.value.code == code
    assert read(radar, setting) == before
    assert radar.ping() is PongCode.XTS_SPRP_READY


def test_settings_without_getter_are_refused(radar: X4M300) -> None:
    with pytest.raises(DeviceError):
        radar.request(m.X4DriverGet(setting=X4Setting.ENABLE))


def test_registers_of_the_chip(radar: X4M300) -> None:
    """Protocol reference 4.9: constants of SPI 0 ... 3, the PRF divider in PIF 44."""
    radar.x4.init()
    assert [radar.registers.read("spi", at) for at in range(4)] == [0x00, 0xFF, 0x01, 0x02]
    assert radar.registers.read("pif", 44) == 16
    assert len(radar.registers.read_burst(0x05, 12)) == 12


def test_areas_without_bins_are_not_even_sent(radar: X4M300) -> None:
    with pytest.raises(LocalProtocolError):
        radar.configure_raw(RawConfig(frame_area_m=(-5.0, -4.9)))
