"""The X4 chip and its driver: settings with the firmware's checks, and the frames they produce.

A frame is a pure function of the source, the counter and the settings: raw RF counters come from
an `EchoSource` as integers; this module turns them into the float32 values the firmware sends.
Frames are synthesised in blocks because that is faster, and a block is thrown away whenever a
setting changes; block size never changes a value.

Source: protocol reference 4.9, 5.1, 8.4 and chapter 9.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from emulator.downconversion import CHANNELS, DECIMATION, LEAD_SAMPLES, TAP_COUNT, downconvert
from emulator.echo_source import CaptureSettings, EchoSource
from emulator.refusal import Refusal
from emulator.timeline import Timeline
from xethru_protocol import x4
from xethru_protocol.codes import ErrorCode, X4Error, X4Setting

__all__ = ["Chip", "ChipFrame", "ChipSettings"]

DAC_LEVELS = 2048
MAX_TIMER_HZ = 65535.0
"""The firmware's frame rate is a 16-bit integer."""
GUARD_FRAMES = 100
"""All-zero frames after which the module switches its transmitter off."""
LARGEST_BLOCK = 32

Value = int | float | tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class ChipSettings:
    """Settings of the X4 as its driver keeps them after INIT. Source: protocol reference 9.3.

    Attributes
    ----------
    fps
        Requested frame rate, float32 value.
    pulses_per_step
        Low 16 bits of what was set.
    iterations
        Low 8 bits of what was set.
    downconversion
        0 for RF frames, anything else for baseband.
    start_m
        Requested frame area start, float32 value, module metres.
    end_m
        Requested frame area end, after shortening to the chip's maximum.
    offset_m
        Frame area offset, float32 value, module metres.
    dac_step
        Exponent of the DAC step, 0...3.
    dac_min
        Lowest DAC level.
    dac_max
        Highest DAC level; may lie below `dac_min`, as in the firmware.
    tx_center_frequency
        3 or 4.
    tx_power
        0 (off)...3.
    prf_div
        Divider of the 243 MHz clock, 4...255.
    """

    fps: float = 0.0
    pulses_per_step: int = 10
    iterations: int = 8
    downconversion: int = 0
    start_m: float = x4.FULL_AREA_M[0]
    end_m: float = x4.FULL_AREA_M[1]
    offset_m: float = float(np.float32(x4.DEFAULT_OFFSET_M))
    dac_step: int = 0
    dac_min: int = 0
    dac_max: int = 2047
    tx_center_frequency: int = 3
    tx_power: int = 2
    prf_div: int = 16


@dataclass(frozen=True, slots=True, kw_only=True)
class ChipFrame:
    """One frame as the firmware sends it.

    Attributes
    ----------
    counter
        Frame counter, 32 bits.
    values
        RF amplitudes, shape (n_bins,); or all I, then all Q, shape (2 * n_bins,); float32.
    """

    counter: int
    values: NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Block:
    first_counter: int
    values: NDArray[np.float32]
    all_zero: NDArray[np.bool_]


class Chip:
    """An X4 with its driver, initialised as the sensor firmware leaves it.

    Attributes
    ----------
    settings
        Current settings.
    timeline
        Which counter is next, and the scene time of each.
    area
        Quantised frame area.
    powered
        False after ENABLE 0, until INIT.
    """

    def __init__(self, source: EchoSource) -> None:
        self._source = source
        self._block: _Block | None = None
        self._block_frames = 1
        self.init()

    def init(self) -> None:
        """Restart the chip: default settings, FPS 0, counter 0 at scene time 0."""
        self.timeline = Timeline()
        self.powered = True
        self._zero_frames = 0
        self._apply(ChipSettings())

    @property
    def running(self) -> bool:
        """Whether the chip's timer makes frames."""
        return self.powered and self.settings.fps > 0

    def set(self, setting: X4Setting, value: Value) -> None:
        """Change one setting at once, or raise `Refusal` and change nothing."""
        if setting is X4Setting.ENABLE:
            self.powered = self.powered and value != 0
            return
        setter = _SETTERS.get(setting)
        if setter is None:
            raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
        changed = setter(self.settings, value)
        if not self.powered:
            raise Refusal(X4Error.REGISTER_TIMEOUT)
        self._apply(changed)

    def get(self, setting: X4Setting) -> Value:
        """Return what GET answers, or raise `Refusal` for a setting without getter."""
        getter = _GETTERS.get(setting)
        if getter is None:
            raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
        return getter(self)

    def next_frame(self) -> ChipFrame:
        """Take the next frame; its counter moves on."""
        counter = self.timeline.next_counter
        block = self._block
        if block is None or not 0 <= counter - block.first_counter < len(block.values):
            block = self._block = self._synthesise(counter, self._block_frames)
            self._block_frames = min(2 * self._block_frames, LARGEST_BLOCK)
        index = counter - block.first_counter
        self.timeline.next_counter = counter + 1
        self._guard_transmitter(bool(block.all_zero[index]))
        return ChipFrame(counter=counter & 0xFFFFFFFF, values=block.values[index])

    def _apply(self, settings: ChipSettings) -> None:
        self.area = x4.frame_area(
            settings.start_m,
            settings.end_m,
            settings.offset_m,
            downconversion=settings.downconversion != 0,
        )
        self.settings = replace(
            settings, start_m=self.area.requested_start_m, end_m=self.area.requested_end_m
        )
        if settings.fps > 0:
            self.timeline.set_rate(min(x4.real_frame_rate(settings.fps), MAX_TIMER_HZ))
        self._block = None
        self._block_frames = 1  # after a change a host rarely wants many frames of the first kind

    def _guard_transmitter(self, all_zero: bool) -> None:
        self._zero_frames = self._zero_frames + 1 if all_zero else 0
        if self._zero_frames >= GUARD_FRAMES:
            self._zero_frames = 0
            self._apply(replace(self.settings, tx_power=0, fps=0.0))

    def _synthesise(self, first_counter: int, n_frames: int) -> _Block:
        settings = self.settings
        counters = np.arange(first_counter, first_counter + n_frames, dtype=np.int64)
        scene_times_ns = np.array(
            [self.timeline.scene_time_ns(int(counter)) for counter in counters], dtype=np.int64
        )
        capture = _capture(settings, self.area)
        if capture.n_samples == 0 or _normalisation(settings).max_counter <= 0:
            raw = np.zeros((n_frames, capture.n_samples), dtype=np.int64)
        else:
            raw = self._source.rf_counters(capture, counters, scene_times_ns)
        all_zero = np.logical_not(raw.any(axis=1)) & (capture.n_samples > 0)
        convert = _baseband_values if settings.downconversion else _rf_values
        return _Block(
            first_counter=first_counter,
            values=convert(raw, settings, self.area),
            all_zero=all_zero,
        )


def _capture(settings: ChipSettings, area: x4.FrameArea) -> CaptureSettings:
    """Return which RF samples the frame needs, labelled as with the hardware's own offset."""
    delay_steps = area.rx_wait - 1  # the transmitter waits one step
    # an absurd offset can label bins far outside the 1536 samples there are
    first_index = min(area.first_index, x4.FRAME_SAMPLES - 1)
    if settings.downconversion:
        first_sample = DECIMATION * first_index - LEAD_SAMPLES
        n_samples = DECIMATION * (area.n_bins - 1) + TAP_COUNT
    else:
        first_sample = first_index
        n_samples = area.n_bins
    start_m = delay_steps * x4.COARSE_STEP_M + x4.DEFAULT_OFFSET_M
    return CaptureSettings(
        first_sample_m=start_m + first_sample * x4.RF_BIN_M,
        n_samples=n_samples,
        iterations=settings.iterations,
        pulses_per_step=settings.pulses_per_step,
        dac_min=settings.dac_min,
        dac_max=settings.dac_max,
        dac_step=settings.dac_step,
        tx_power=settings.tx_power,
        tx_center_frequency=settings.tx_center_frequency,
    )


def _normalisation(settings: ChipSettings) -> x4.Normalisation:
    """Return counts to values (protocol reference 9.7); without pulses nothing is counted."""
    if settings.iterations * settings.pulses_per_step == 0:
        return x4.Normalisation(quantum=0.0, dac_offset=0.0, max_counter=0)
    return x4.Normalisation.of(
        iterations=settings.iterations,
        pulses_per_step=settings.pulses_per_step,
        dac_min=settings.dac_min,
        dac_max=settings.dac_max,
        dac_step=settings.dac_step,
    )


def _rf_values(
    raw: NDArray[np.int64], settings: ChipSettings, area: x4.FrameArea
) -> NDArray[np.float32]:
    del area  # RF bins need no line signs
    normalisation = _normalisation(settings)
    quantum, middle = np.float32(normalisation.quantum), np.float32(normalisation.dac_offset)
    return raw.astype(np.float32) * quantum - middle


def _baseband_values(
    raw: NDArray[np.int64], settings: ChipSettings, area: x4.FrameArea
) -> NDArray[np.float32]:
    taps = CHANNELS[settings.tx_center_frequency]
    i_raw, q_raw = downconvert(raw, taps, area.first_index % 2)
    scale = np.float32(taps.absolute_sum)
    quantum = np.float32(_normalisation(settings).quantum)
    i_values = i_raw.astype(np.float32) * quantum / scale
    q_values = -(q_raw.astype(np.float32) * quantum / scale)
    return np.concatenate([i_values, q_values], axis=1)


# ---- setters: (settings, value) -> changed settings, or Refusal --------------------------------


def _number(value: Value) -> float:
    if isinstance(value, tuple):
        raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
    return value


def _integer(value: Value) -> int:
    return int(_number(value))


def _set_fps(settings: ChipSettings, value: Value) -> ChipSettings:
    fps = _number(value)
    # the reference is silent on NaN and infinity; a timer cannot run at either
    return replace(settings, fps=fps if math.isfinite(fps) else 0.0)


def _set_frame_area(settings: ChipSettings, value: Value) -> ChipSettings:
    if not isinstance(value, tuple):
        raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
    start_m, end_m = value
    if not (math.isfinite(start_m) and math.isfinite(end_m)) or start_m > end_m:
        raise Refusal(X4Error.FRAME_AREA_END_OUT_OF_SCOPE)
    return replace(settings, start_m=start_m, end_m=end_m)


def _set_offset(settings: ChipSettings, value: Value) -> ChipSettings:
    offset_m = _number(value)
    if not math.isfinite(offset_m):
        raise Refusal(X4Error.GENERAL_FAILURE)
    return replace(settings, offset_m=offset_m)


def _set_dac_step(settings: ChipSettings, value: Value) -> ChipSettings:
    step = _integer(value) & 0xFF
    if step > 3:
        raise Refusal(X4Error.INVALID_DAC_STEP)
    return replace(settings, dac_step=step)


def _dac_level(value: Value) -> int:
    level = _integer(value) & 0xFFFF
    if level >= DAC_LEVELS:
        raise Refusal(X4Error.GENERAL_FAILURE)
    return level


def _set_tx_center_frequency(settings: ChipSettings, value: Value) -> ChipSettings:
    if value not in CHANNELS:
        raise Refusal(X4Error.INVALID_TX_CENTER_FREQUENCY)
    return replace(settings, tx_center_frequency=_integer(value))


def _set_tx_power(settings: ChipSettings, value: Value) -> ChipSettings:
    if value not in range(4):
        raise Refusal(X4Error.INVALID_TX_POWER)
    return replace(settings, tx_power=_integer(value))


def _set_prf_div(settings: ChipSettings, value: Value) -> ChipSettings:
    divider = _integer(value)
    if divider < 4:
        raise Refusal(X4Error.PRF_DIV_TOO_SMALL)
    return replace(settings, prf_div=divider)


_SETTERS: dict[X4Setting, Callable[[ChipSettings, Value], ChipSettings]] = {
    X4Setting.FPS: _set_fps,
    X4Setting.PULSESPERSTEP: lambda s, v: replace(s, pulses_per_step=_integer(v) & 0xFFFF),
    X4Setting.ITERATIONS: lambda s, v: replace(s, iterations=_integer(v) & 0xFF),
    X4Setting.DOWNCONVERSION: lambda s, v: replace(s, downconversion=_integer(v)),
    X4Setting.FRAMEAREA: _set_frame_area,
    X4Setting.DACSTEP: _set_dac_step,
    X4Setting.DACMIN: lambda s, v: replace(s, dac_min=_dac_level(v)),
    X4Setting.DACMAX: lambda s, v: replace(s, dac_max=_dac_level(v)),
    X4Setting.FRAMEAREAOFFSET: _set_offset,
    X4Setting.TXCENTERFREQUENCY: _set_tx_center_frequency,
    X4Setting.TXPOWER: _set_tx_power,
    X4Setting.PRFDIV: _set_prf_div,
}

_GETTERS: dict[X4Setting, Callable[[Chip], Value]] = {
    X4Setting.FPS: lambda chip: _fps_read_back(chip.settings.fps),
    X4Setting.PULSESPERSTEP: lambda chip: chip.settings.pulses_per_step,
    X4Setting.ITERATIONS: lambda chip: chip.settings.iterations,
    X4Setting.DOWNCONVERSION: lambda chip: chip.settings.downconversion,
    X4Setting.FRAMEAREA: lambda chip: (chip.area.start_m, chip.area.end_m),
    X4Setting.DACSTEP: lambda chip: chip.settings.dac_step,
    X4Setting.DACMIN: lambda chip: chip.settings.dac_min,
    X4Setting.DACMAX: lambda chip: chip.settings.dac_max,
    X4Setting.FRAMEAREAOFFSET: lambda chip: chip.settings.offset_m,
    X4Setting.TXCENTERFREQUENCY: lambda chip: chip.settings.tx_center_frequency,
    X4Setting.TXPOWER: lambda chip: chip.settings.tx_power,
    X4Setting.PRFDIV: lambda chip: chip.settings.prf_div,
    X4Setting.FRAMEBINCOUNT: lambda chip: chip.area.n_bins,
}


def _fps_read_back(fps: float) -> float:
    return x4.real_frame_rate(fps) if fps > 0 else fps
