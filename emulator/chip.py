"""The X4 chip and its driver: settings with the firmware's checks, and the frames they produce.

A frame is a pure function of the source, the counter and the settings: raw RF counters come from
an `EchoSource` as integers; this module turns them into the float32 values the firmware sends.
Frames are synthesised in blocks because that is faster, and a block is thrown away whenever a
setting changes; block size never changes a value.

Source: protocol reference 4.9, 5.1, 8.4 and chapter 9.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from emulator.downconversion import CHANNELS, DECIMATION, LEAD_SAMPLES, TAP_COUNT, downconvert
from emulator.echo_source import CaptureSettings, EchoSource
from emulator.refusal import Refusal
from emulator.registers import Registers
from emulator.settings import SETTERS, ChipSettings
from emulator.timeline import Timeline
from xethru_protocol import x4
from xethru_protocol.codes import ErrorCode, X4Error, X4Setting
from xethru_protocol.messages import REGISTERS, X4Value

__all__ = ["Chip", "ChipFrame"]

MAX_TIMER_HZ = 65535.0
"""The firmware's frame rate is a 16-bit integer."""
GUARD_FRAMES = 100
"""All-zero frames after which the module switches its transmitter off."""
DEFAULT_LARGEST_BLOCK = 32


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

    Parameters
    ----------
    source
        What its sampler sees.
    largest_block
        Most frames synthesised at once: many are cheap each, few disturb nobody's deadline.
    block_phase
        Blocks end with counters congruent to it modulo `largest_block`, so that of many radars
        in step only some synthesise at a time; None: each block is as long as it may be.

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

    def __init__(
        self,
        source: EchoSource,
        largest_block: int = DEFAULT_LARGEST_BLOCK,
        block_phase: int | None = None,
    ) -> None:
        self._source = source
        self._largest_block = largest_block
        self._block_phase = block_phase
        self._block: _Block | None = None
        self._block_frames = 1
        self.init()

    def init(self) -> None:
        """Restart the chip: default settings, FPS 0, counter 0 at scene time 0."""
        self.timeline = Timeline()
        self._registers = Registers()
        self.powered = True
        self._zero_frames = 0
        self._apply(ChipSettings())

    @property
    def running(self) -> bool:
        """Whether the chip's timer makes frames."""
        return self.powered and self.settings.fps > 0

    def set(self, setting: X4Setting, value: X4Value) -> None:
        """Change one setting at once, or raise `Refusal` and change nothing."""
        if setting is X4Setting.ENABLE:
            self.powered = self.powered and value != 0
        elif setting in REGISTERS and isinstance(value, tuple):
            address, byte = value
            self.write_register(setting, int(address), int(byte))
        elif setting in SETTERS:
            changed = SETTERS[setting](self.settings, value)
            self._check_powered()
            self._apply(changed)
        else:
            raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)

    def get(self, setting: X4Setting) -> X4Value:
        """Return what GET answers, or raise `Refusal` for a setting without getter."""
        getter = _GETTERS.get(setting)
        if getter is None:
            raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
        return getter(self)

    def read_register(self, space: X4Setting, address: int) -> int:
        """Return one register's byte; `Refusal` when the chip is off."""
        self._check_powered()
        return self._registers.read(space, address & 0xFF, self.settings)

    def write_register(self, space: X4Setting, address: int, value: int) -> None:
        """Write one register's byte; `Refusal` when the chip is off."""
        self._check_powered()
        changed = self._registers.write(space, address & 0xFF, value, self.settings)
        if changed is not self.settings:
            self._apply(changed)

    def next_frame(self) -> ChipFrame:
        """Take the next frame; its counter moves on."""
        counter = self.timeline.next_counter
        block = self._block
        if block is None or not 0 <= counter - block.first_counter < len(block.values):
            block = self._block = self._synthesise(counter, self._frames_from(counter))
            self._block_frames = min(2 * self._block_frames, self._largest_block)
        index = counter - block.first_counter
        self.timeline.next_counter = counter + 1
        self._guard_transmitter(bool(block.all_zero[index]))
        return ChipFrame(counter=counter & 0xFFFFFFFF, values=block.values[index])

    def _frames_from(self, counter: int) -> int:
        """Return how many frames the block that begins with a counter shall have."""
        if self._block_phase is None:
            return self._block_frames
        return min(self._block_frames, 1 + (self._block_phase - counter) % self._largest_block)

    def _check_powered(self) -> None:
        if not self.powered:
            raise Refusal(X4Error.REGISTER_TIMEOUT)

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


_GETTERS: dict[X4Setting, Callable[[Chip], X4Value]] = {
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
    return x4.frame_rate_read_back(fps)
