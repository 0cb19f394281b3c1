"""Raw radar mode: from any state to frames of one geometry, and back. Protocol reference 13."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from xethru_protocol.driver.frames import FrameGeometry
from xethru_protocol.driver.link import CONFIG_SETTINGS, SLOW_TIMEOUT_S, Link, RawConfig, Steps
from xethru_protocol.wire import x4
from xethru_protocol.wire.codes import ErrorCode, PongCode, SensorMode, TxPower, X4Setting
from xethru_protocol.wire.errors import DeviceError, LocalProtocolError, RemoteProtocolError
from xethru_protocol.wire.messages import X4DriverInit, X4DriverSet, X4Value
from xethru_protocol.wire.versions import X4_GETS

_QUANTISATION_M = 1e-5  # far below a bin, far above a float32 rounding
_STOP = X4DriverSet(setting=X4Setting.FPS, value=0.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class RawPlan:
    """Raw radar mode as the user wants it; ``fps`` None while stopped."""

    config: RawConfig
    fps: float | None = None

    def restore(self, link: Link) -> Steps[None]:
        """Configure and start again, or attach again; frames that wait stay in the queue."""
        if link.attached:
            link.frames.interrupt()
            yield from attach(link)
            return
        yield from _apply(link, self.config)
        # setting up took its time, too
        link.frames.interrupt(x4.real_frame_rate(self.fps or 0.0))
        if self.fps is not None:
            yield from run_at(link, self.fps)


def configure_raw(link: Link, config: RawConfig | None = None) -> Steps[FrameGeometry]:
    config = config or RawConfig()
    # before anything is sent; the exact bins depend on the module's own offset
    if config.offset_m is None:
        x4.frame_area(*config.frame_area_m, downconversion=config.downconversion)
    else:
        config.area(config.offset_m)
    geometry = yield from _apply(link, config)
    link.frames.clear()  # those that wait are of older settings
    return geometry


def _apply(link: Link, config: RawConfig) -> Steps[FrameGeometry]:
    """As `configure_raw`, but keep the frames that wait."""
    if (yield from link.wait_until_ready()) is PongCode.XTS_SPRP_SAFEMODE:
        link.warn("the module is in safe mode after repeated faults; reset it")
    link.raw_mode, link.attached = True, False
    yield from link.set_mode_if_known(SensorMode.XTID_SM_STOP)
    yield from link.set_mode_if_known(SensorMode.XTID_SM_MANUAL)
    try:
        yield from link.request(X4DriverInit(), SLOW_TIMEOUT_S)
    except DeviceError as error:
        link.raw_mode = error.code != ErrorCode.XTS_SPRE_BUSY  # another program's, to leave alone
        raise
    offset_m = yield from _offset_m(link, config)
    predicted = None if offset_m is None else config.area(offset_m)
    for setting, value in config.settings():
        yield from link.request(X4DriverSet(setting=setting, value=value))
    for setting, value in config.settings():
        if setting is not X4Setting.FRAMEAREA:
            found = yield from _read_back(link, setting)
            if found is not None:
                _check(link, setting, value, found)
    geometry = yield from read_geometry(link, config.downconversion)
    if predicted is not None:
        _check_geometry(link, geometry, config, predicted)
    link.plan = RawPlan(config=config)
    link.frames.geometry = geometry
    link.frames.lattice = config.lattice
    return geometry


def _check(link: Link, setting: X4Setting, wanted: X4Value, found: X4Value) -> None:
    if isinstance(wanted, float) and isinstance(found, float):
        same = bool(np.float32(wanted) == np.float32(found))
    else:
        same = wanted == found
    if not same:
        raise RemoteProtocolError(
            f"{link.name} reads back {setting.name} as {found} after {wanted} was set"
        )


def _read_back(link: Link, setting: X4Setting) -> Steps[X4Value | None]:
    """Return a setting as the module has it; None from old firmware that has no GET for it."""
    try:
        return (yield from link.x4_get(setting))
    except DeviceError as error:
        firmware = yield from link.firmware()
        if error.code != ErrorCode.XTS_SPRE_NOT_RECOGNIZED or X4_GETS.is_in(firmware):
            raise
    link.warn(f"{firmware.name} cannot read back {setting.name}; {X4_GETS.since} can")
    return None


def _offset_m(link: Link, config: RawConfig) -> Steps[float | None]:
    """Return the offset that will hold; what INIT restored is of the module's own antenna (9.3)."""
    if config.offset_m is not None:
        return config.offset_m
    offset_m = yield from _read_back(link, X4Setting.FRAMEAREAOFFSET)
    if offset_m is None:
        return None
    if not isinstance(offset_m, float) or not math.isfinite(offset_m):
        raise RemoteProtocolError(f"{link.name} reads back FRAMEAREAOFFSET as {offset_m}")
    return offset_m


def description(link: Link) -> dict[str, Any]:
    """Return what is known of the frames, as `RadarState.description`."""
    geometry = link.frames.geometry
    if geometry is None:
        return {}
    settings: dict[str, Any] = {}
    if isinstance(link.plan, RawPlan):
        settings = {setting.name: value for setting, value in link.plan.config.settings()}
    return {
        "range_start_m": geometry.range_start_m,
        "bin_length_m": geometry.bin_length_m,
        "n_bins": geometry.n_bins,
        "rate_hz": link.frames.rate_hz or None,
        "settings": settings
        | {
            X4Setting.FRAMEAREA.name: geometry.area_m,
            X4Setting.FRAMEBINCOUNT.name: geometry.n_bins,
        },
    }


def read_geometry(link: Link, downconversion: bool) -> Steps[FrameGeometry]:
    """Ask where the bins of the frames lie that come from now on."""
    area = yield from link.x4_get(X4Setting.FRAMEAREA)
    n_bins = yield from link.x4_get(X4Setting.FRAMEBINCOUNT)
    if (
        not (isinstance(area, tuple) and all(map(math.isfinite, area)))
        or not isinstance(n_bins, int)
        or n_bins <= 0
    ):
        raise RemoteProtocolError(f"{link.name} reads back frame area {area} with {n_bins} bins")
    return FrameGeometry.from_read_back(
        area_m=(float(area[0]), float(area[1])), n_bins=n_bins, downconversion=downconversion
    )


def _check_geometry(
    link: Link, geometry: FrameGeometry, config: RawConfig, predicted: x4.FrameArea
) -> None:
    """Warn if the bins do not lie where the frame area that was asked for puts them."""
    (start_m, end_m), n_bins = geometry.area_m, geometry.n_bins
    if end_m < config.frame_area_m[1] - _QUANTISATION_M:
        link.warn(f"the module's frame ends at {end_m:.4f} m, not at {config.frame_area_m[1]:g} m")
    if n_bins != predicted.n_bins or not np.allclose(
        (start_m, end_m), (predicted.start_m, predicted.end_m), rtol=0.0, atol=_QUANTISATION_M
    ):
        link.warn(
            f"the module made {n_bins} bins over {start_m:.4f} ... {end_m:.4f} m of the frame "
            f"area, where {predicted.n_bins} over {predicted.start_m:.4f} ... "
            f"{predicted.end_m:.4f} m were expected; its own values are used"
        )


def start(link: Link, fps: float) -> Steps[float]:
    x4.check_setting(X4Setting.FPS, "a frame rate", fps)
    if not x4.timer_rate(fps):
        raise LocalProtocolError(
            f"a frame rate must be positive, not {fps:g}, at which the module stops; stop() stops"
        )
    if link.frames.geometry is None:
        yield from _take_over(link)
    if isinstance(link.plan, RawPlan):
        check_start(link, link.plan.config, fps)
    _warn_of_line(link, fps)
    yield from link.take_stale_input()
    link.frames.clear()  # a late frame of before would make a false gap
    return (yield from run_at(link, fps))


def _take_over(link: Link) -> Steps[None]:
    """Take the settings that the module has for those the user wants."""
    try:
        mode = yield from link.mode()
    except DeviceError:  # bare XEP firmware has no modes: it is always as in MANUAL
        mode = SensorMode.XTID_SM_MANUAL
    if mode is not SensorMode.XTID_SM_MANUAL:
        raise LocalProtocolError(
            f"{link.name} is in mode {mode.label}, in which no radar frames come; "
            "call configure_raw() first, or start the program that does"
        )
    values: dict[str, X4Value] = {}
    for name, setting in CONFIG_SETTINGS.items():
        values[name] = yield from link.x4_get(setting)
    values["downconversion"] = values["downconversion"] == 1  # as `X4.downconversion`
    config = RawConfig(**values)  # type: ignore[arg-type] # by the answers' types
    link.frames.geometry = yield from read_geometry(link, config.downconversion)
    link.frames.lattice = config.lattice
    link.plan = RawPlan(config=config)


def attach(link: Link) -> Steps[FrameGeometry]:
    yield from link.ping()  # behind its answer no news come of earlier changes
    link.attached = True
    try:
        yield from _take_over(link)
        rate = yield from link.x4_get(X4Setting.FPS)
        geometry = link.frames.geometry
        if geometry is None or not isinstance(rate, float) or not 0 < rate < math.inf:
            raise LocalProtocolError(
                f"{link.name} sends no frames yet; start the program that commands it first, or "
                "configure it yourself"
            )
        if not link.attached:
            raise LocalProtocolError(f"{link.name} is just being set up; try again")
    except BaseException:
        link.attached = False
        link.frames.geometry = link.plan = None
        raise
    link.frames.rate_hz = x4.real_frame_rate(rate)
    return geometry


def run_at(link: Link, fps: float) -> Steps[float]:
    """Let frames come as part of the stream that there is."""
    link.raw_mode, link.attached = True, False
    yield from link.request(X4DriverSet(setting=X4Setting.FPS, value=fps))
    rate = yield from link.x4_get(X4Setting.FPS)
    if not isinstance(rate, float) or not 0 < rate < math.inf:
        raise RemoteProtocolError(f"{link.name} reads back frame rate {rate} after {fps:g} was set")
    if isinstance(link.plan, RawPlan):
        link.plan = replace(link.plan, fps=fps)
    return x4.real_frame_rate(rate)


def stop(link: Link) -> Steps[None]:
    yield from link.request(_STOP)
    if isinstance(link.plan, RawPlan):
        link.plan = replace(link.plan, fps=None)


def leave(link: Link) -> Steps[None]:
    """Stop the radar if it was configured by this driver."""
    if link.raw_mode:
        link.raw_mode = False
        link.conversation.wind_down()
        yield from link.request(_STOP)
        yield from link.set_mode_if_known(SensorMode.XTID_SM_STOP)


def check_start(link: Link, config: RawConfig, fps: float) -> None:
    """Refuse a rate at which these settings cannot work, and warn of what is hardly meant."""
    config.check_rate(fps)
    if fps > config.fps_max:
        link.warn(
            f"{fps:g} frames/s are more than the {config.fps_max:.1f} that "
            f"{config.iterations} iterations x {config.pulses_per_step} pulses "
            "leave time for; a real module may not keep up"
        )
    if config.tx_power == TxPower.OFF:
        link.warn("tx_power is 0: the transmitter is off, so frames hold noise only")


def _warn_of_line(link: Link, fps: float) -> None:
    whole = x4.timer_rate(fps)
    if fps != whole:
        link.warn(
            f"the module's timer takes whole numbers of 16 bits: {fps:g} frames/s will be {whole}"
        )
    geometry = link.frames.geometry
    if geometry is not None and fps > link.bytes_per_s / geometry.frame_bytes:
        link.warn(
            f"{fps:g} frames/s of {geometry.frame_bytes} bytes are more than the "
            f"{link.bytes_per_s / geometry.frame_bytes:.1f} that {link.baudrate} baud carry; "
            "frames will be lost; set_baud_rate() makes the line faster"
        )
