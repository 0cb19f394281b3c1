"""What any X4M300 does, emulated or real: one body for all."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest

from xethru_protocol import messages as m
from xethru_protocol.codes import PongCode, SensorMode, X4Setting
from xethru_protocol.driver import X4M300, RawConfig
from xethru_protocol.errors import DeviceError, ResponseTimeout


def test_it_answers_and_says_what_it_is(radar: X4M300) -> None:
    assert radar.ping() is PongCode.XTS_SPRP_READY
    info = radar.info()
    assert info.order_code == "X4M300"
    assert info.serial_number is not None
    assert info.serial_number.isdigit()
    assert len(info.serial_number) == 12


@pytest.mark.parametrize(("downconversion", "bins"), [(False, 1431), (True, 181)])
def test_raw_frames(radar: X4M300, downconversion: bool, bins: int) -> None:
    geometry = radar.configure_raw(RawConfig(downconversion=downconversion))
    assert geometry.n_bins == bins
    rate = radar.start(17.0)
    assert rate == pytest.approx(17.049379, abs=1e-5)
    frames = list(radar.frames(8))
    radar.stop()
    counters = [frame.counter for frame in frames]
    assert counters == list(range(counters[0], counters[0] + 8))
    assert {frame.samples.shape for frame in frames} == {(bins,)}
    assert all(np.isfinite(frame.samples).all() for frame in frames)
    assert (radar.frames_lost, radar.fault_count) == (0, 0)
    assert radar.statistics.off_lattice_samples == 0


def test_samples_lie_on_the_quantisation_grid(radar: X4M300) -> None:
    """Protocol reference 9.7: RF values are counter * 2.03450526e-07 - 0.07421875."""
    radar.configure_raw()
    radar.start(17.0)
    values = radar.read_frame().samples.astype(np.float64)
    counters = (values + 0.07421875) / 2.03450526e-07
    assert np.abs(counters - np.rint(counters)).max() < 0.1
    assert counters.min() >= 0
    assert counters.max() <= 16 * 300 * 152


def test_settings_read_back(radar: X4M300) -> None:
    radar.configure_raw()
    settings = radar.x4_settings()
    assert settings[X4Setting.DACMIN] == 949
    assert settings[X4Setting.DACMAX] == 1100
    assert settings[X4Setting.ITERATIONS] == 16
    assert settings[X4Setting.PULSESPERSTEP] == 300
    assert settings[X4Setting.DACSTEP] == 0
    assert settings[X4Setting.PRFDIV] == 16
    assert settings[X4Setting.FRAMEAREA] == pytest.approx((0.199290, 9.400679), abs=1e-6)


def test_it_is_ready_again_after_a_reset(radar: X4M300) -> None:
    """Protocol reference 8.1: ready again after 2 ... 9 s, X4 settings gone."""
    radar.configure_raw(RawConfig(iterations=8))
    radar.reset(wait=True)
    assert radar.ping() is PongCode.XTS_SPRP_READY
    radar.configure_raw()
    assert radar.x4_settings()[X4Setting.ITERATIONS] == 16


@pytest.mark.parametrize(
    ("setting", "value", "code"),
    [
        (X4Setting.TXCENTERFREQUENCY, 5, 20),
        (X4Setting.TXPOWER, 4, 21),
        (X4Setting.DACSTEP, 4, 12),
        (X4Setting.FRAMEAREA, (5.0, 0.4), 17),
        (X4Setting.PRFDIV, 3, 18),
        (X4Setting.DACMAX, 2048, 1),
    ],
)
def test_bad_settings_are_refused(
    radar: X4M300, setting: X4Setting, value: m.X4Value, code: int
) -> None:
    radar.configure_raw()
    with pytest.raises(DeviceError) as refusal:
        radar.request(m.X4DriverSet(setting=setting, value=value))
    assert refusal.value.code == code
    assert radar.ping() is PongCode.XTS_SPRP_READY


def test_at_most_one_frame_comes_after_the_stop(radar: X4M300) -> None:
    """Protocol reference 8.4: one may be in the pipeline; one may have come before the ACK."""
    radar.configure_raw()
    radar.start(17.0)
    radar.read_frame()
    radar.stop()
    late = 0
    with contextlib.suppress(ResponseTimeout):
        while late < 10:
            radar.read_frame(timeout_s=0.3)
            late += 1
    assert late <= 2
    assert radar.request(m.GetMode()).values == bytes([SensorMode.XTID_SM_MANUAL])
