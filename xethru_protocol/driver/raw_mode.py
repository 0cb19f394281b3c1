"""Raw radar mode: from any state to frames of one geometry, and back. Protocol reference 13."""

import math
from dataclasses import replace

import numpy as np

from xethru_protocol.driver.frames import FrameGeometry
from xethru_protocol.driver.link import (
    SLOW_TIMEOUT_S,
    Procedure,
    RadarCore,
    RawConfig,
    RawPlan,
    real_rate,
    request,
    set_mode_if_known,
    stop,
    take_stale_input,
    wait_until_ready,
    x4_get,
)
from xethru_protocol.wire import x4
from xethru_protocol.wire.codes import PongCode, SensorMode, X4Setting
from xethru_protocol.wire.errors import LocalProtocolError, RemoteProtocolError
from xethru_protocol.wire.messages import SetMode, X4DriverInit, X4DriverSet, X4Value

_LARGEST_FPS = 65535  # 16 bits (Protocol reference 9.6)
_QUANTISATION_M = 1e-5  # far below a bin, far above a float32 rounding


def configure_raw(core: RadarCore, config: RawConfig | None = None) -> Procedure[FrameGeometry]:
    """Bring the module from any state to raw radar mode, stopped.

    Every setting is read back. Returns the geometry as the module quantised it.

    Raises
    ------
    LocalProtocolError
        If the settings make no sense.
    DeviceError
        If the module refuses one.
    RemoteProtocolError
        If it reads back another value than was set; names the setting.
    ResponseTimeout
        If the port is no radar.

    Notes
    -----
    Protocol reference 13.
    """
    config = config or RawConfig()
    config.check_area()
    geometry = yield from apply(core, config)
    core.frames.new_stream()  # those that wait are of older settings
    return geometry


def apply(core: RadarCore, config: RawConfig) -> Procedure[FrameGeometry]:
    """Do the same, but keep the frames that wait."""
    if (yield from wait_until_ready(core)) is PongCode.XTS_SPRP_SAFEMODE:
        core.warn("the module is in safe mode after repeated faults; reset it")
    core.raw_mode = True
    yield from set_mode_if_known(core, SensorMode.XTID_SM_STOP)
    yield from set_mode_if_known(core, SensorMode.XTID_SM_MANUAL)
    yield from request(core, X4DriverInit(), SLOW_TIMEOUT_S)
    for setting, value in config.settings():
        yield from request(core, X4DriverSet(setting=setting, value=value))
    for setting, value in config.settings():
        if setting is not X4Setting.FRAMEAREA:
            _check(core, setting, value, (yield from x4_get(core, setting)))
    geometry = yield from _read_geometry(core, config)
    core.plan = RawPlan(config=config)
    core.frames.break_off()
    core.frames.geometry = geometry
    core.frames.lattice = config.lattice
    return geometry


def _check(core: RadarCore, setting: X4Setting, wanted: X4Value, found: X4Value) -> None:
    if isinstance(wanted, float) and isinstance(found, float):
        same = bool(np.float32(wanted) == np.float32(found))
    else:
        same = wanted == found
    if not same:
        raise RemoteProtocolError(
            f"{core.conversation.name} reads back {setting.name} as {found} after {wanted} was set"
        )


def _read_geometry(core: RadarCore, config: RawConfig) -> Procedure[FrameGeometry]:
    area = yield from x4_get(core, X4Setting.FRAMEAREA)
    n_bins = yield from x4_get(core, X4Setting.FRAMEBINCOUNT)
    if not isinstance(area, tuple) or not isinstance(n_bins, int) or n_bins <= 0:
        raise RemoteProtocolError(
            f"{core.conversation.name} reads back frame area {area} with {n_bins} bins"
        )
    start_m, end_m = float(area[0]), float(area[1])
    if end_m < config.frame_area_m[1] - _QUANTISATION_M:
        core.warn(f"the module's frame ends at {end_m:.4f} m, not at {config.frame_area_m[1]:g} m")
    predicted = x4.frame_area(*config.frame_area_m, config.offset_m, config.downconversion)
    if n_bins != predicted.n_bins or not np.allclose(
        (start_m, end_m), (predicted.start_m, predicted.end_m), rtol=0.0, atol=_QUANTISATION_M
    ):
        core.warn(
            f"the module made {n_bins} bins over {start_m:.4f} ... {end_m:.4f} m of the frame "
            f"area, where {predicted.n_bins} over {predicted.start_m:.4f} ... "
            f"{predicted.end_m:.4f} m were expected; its own numbers count"
        )
    return FrameGeometry.from_read_back(
        area_m=(start_m, end_m), n_bins=n_bins, downconversion=config.downconversion
    )


def start(core: RadarCore, fps: float) -> Procedure[float]:
    """Start frames at ``fps`` [Hz]; returns the rate the chip really runs at.

    Frames of an earlier stream that were not read yet are dropped.

    A rate above what the settings allow or the line carries is tried, with a warning: the
    firmware does not refuse it (Protocol reference 9.6, 10).
    """
    if not fps > 0:
        raise LocalProtocolError(f"a frame rate must be positive, not {fps}; stop() stops")
    _warn_of_rate(core, fps)
    yield from take_stale_input()
    core.frames.new_stream()  # a late frame of the last stream would make a false gap
    return (yield from run_at(core, fps))


def run_at(core: RadarCore, fps: float) -> Procedure[float]:
    """Do the same, but keep the frames that wait, and without warnings."""
    core.raw_mode = True
    rate = yield from real_rate(core, fps)
    if isinstance(core.plan, RawPlan):
        core.plan = replace(core.plan, fps=fps)
    return rate


def stop_frames(core: RadarCore) -> Procedure[None]:
    """Stop frames. One that was already on its way may still come."""
    yield from stop(core)
    if isinstance(core.plan, RawPlan):
        core.plan = replace(core.plan, fps=None)


def leave(core: RadarCore) -> Procedure[None]:
    """Stop the radar if it was configured by this driver."""
    if core.raw_mode:
        core.raw_mode = False
        core.conversation.wind_down()
        yield from stop(core)
        yield from request(core, SetMode(mode=SensorMode.XTID_SM_STOP))


def _warn_of_rate(core: RadarCore, fps: float) -> None:
    whole = max(math.floor(fps), 1) if fps < _LARGEST_FPS else _LARGEST_FPS
    if fps != whole:
        core.warn(f"the module's timer takes whole numbers: {fps:g} frames/s will be {whole}")
    config = core.plan.config if isinstance(core.plan, RawPlan) else None
    if config is not None and fps > config.fps_max:
        core.warn(
            f"{fps:g} frames/s are more than the {config.fps_max:.1f} that "
            f"{config.iterations} iterations x {config.pulses_per_step} pulses "
            "leave time for; a real module may not keep up"
        )
    geometry = core.frames.geometry
    if geometry is not None and fps > core.bytes_per_s / geometry.frame_bytes:
        core.warn(
            f"{fps:g} frames/s of {geometry.frame_bytes} bytes are more than the "
            f"{core.bytes_per_s / geometry.frame_bytes:.1f} that {core.baudrate} baud carry; "
            "frames will be lost; set_baud_rate() makes the line faster"
        )
