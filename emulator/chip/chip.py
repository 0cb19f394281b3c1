"""The X4 chip and its driver: settings with the firmware's checks, registers, time, frames.

A frame is a pure function of the source, the counter and the settings: raw RF counters come from
an `EchoSource` as integers; the chip turns them into the float32 values the firmware sends.
Frames are synthesised in blocks because that is faster, and a block is discarded whenever a
setting changes; block size never changes a value.

A coupled register is computed from the chip's settings when read and changes them when written,
so PIF 35h *is* the number of iterations. All others keep what was written until INIT.

The frame timer and the sampler run from one crystal. A clock that is ``ppm`` millionths fast
counts 1 + ppm 1e-6 of its seconds in a true one, so what it takes for an interval T is over after
``T / (1 + ppm 1e-6)``: its frames come early, and its bins are short. The error is constant:
temperature and ageing are left out.

Source: protocol reference 4.9 (with its tables of X4 registers and of chip reset values), 5.1, 8.4
and chapter 9.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from emulator.chip.downconversion import CHANNELS, LEAD_SAMPLES, TAP_COUNT, downconvert
from xethru_protocol.wire import x4
from xethru_protocol.wire.codes import ErrorCode, X4Error, X4Setting
from xethru_protocol.wire.messages import REGISTERS, DataFloat, X4Value
from xethru_protocol.wire.x4 import frame_time_ns

NS_PER_S = 1_000_000_000
MAX_TIMER_HZ = 65535.0
"""The firmware's frame rate is a 16-bit integer."""
GUARD_FRAMES = 100
"""All-zero frames after which the module switches its transmitter off."""
DEFAULT_LARGEST_BLOCK = 32
DAC_LEVELS = 2048


class Timeline:
    """Frame counters (unbounded, on the wire 32 bits) and their scene times since INIT.

    INIT makes counter 0 scene time 0. Within a segment of constant rate, counter k lies at
    ``start + frame_time_ns(k - first, rate)``; another rate begins a new segment at the next
    counter. A pause changes nothing: the counter goes on where it was.

    Examples
    --------
    >>> timeline = Timeline()
    >>> timeline.set_rate(100.0)
    >>> timeline.next_counter = 50
    >>> timeline.set_rate(40.0)
    >>> timeline.scene_time_ns(50), timeline.scene_time_ns(54)
    (500000000, 600000000)
    """

    def __init__(self) -> None:
        self.next_counter = 0
        self._first_counter = 0
        self._start_ns = 0
        self._rate_hz: float | None = None

    def set_rate(self, rate_hz: float) -> None:
        """Run at another real frame rate (> 0) from the next counter on."""
        if rate_hz != self._rate_hz:
            self._start_ns = self.scene_time_ns(self.next_counter)
            self._first_counter = self.next_counter
            self._rate_hz = rate_hz

    def scene_time_ns(self, counter: int) -> int:
        """Return the scene time of a counter of the current segment; 0 without a rate."""
        if self._rate_hz is None:
            return 0
        return self._start_ns + frame_time_ns(counter - self._first_counter, self._rate_hz)

    def skip_before(self, scene_time_ns: int) -> None:
        """Move on to the first counter not before a scene time."""
        if self._rate_hz is None or self.scene_time_ns(self.next_counter) >= scene_time_ns:
            return
        elapsed_ns = scene_time_ns - self._start_ns
        counter = self._first_counter + int(elapsed_ns * self._rate_hz / NS_PER_S) - 1
        self.next_counter = max(counter, self.next_counter)
        while self.scene_time_ns(self.next_counter) < scene_time_ns:
            self.next_counter += 1


@dataclass(frozen=True, slots=True, kw_only=True)
class ModuleClock:
    """Nominal time of a counter to scene time, and back.

    Attributes
    ----------
    skew_ns
        Scene time at which the module takes the frame of nominal time 0.
    ppm
        How fast its clock is, in millionths; negative: slow.

    >>> ModuleClock(skew_ns=5, ppm=100.0).scene_time_ns(10_001_000_000)
    10000000005
    """

    skew_ns: int = 0
    ppm: float = 0.0

    @property
    def rate(self) -> float:
        """The module's seconds per true second."""
        return 1.0 + self.ppm * 1e-6

    def scene_times_ns(self, nominal_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the true times of frames, shape (n,), int64, from the module's own."""
        early = np.rint(nominal_ns * self._lead).astype(np.int64)
        times: NDArray[np.int64] = nominal_ns - early + self.skew_ns
        return times

    def scene_time_ns(self, nominal_ns: int) -> int:
        return nominal_ns - round(nominal_ns * self._lead) + self.skew_ns

    def nominal_ns(self, scene_time_ns: int) -> int:
        """Return what the module's clock shows at a scene time, to within 1 ns."""
        elapsed_ns = scene_time_ns - self.skew_ns
        return elapsed_ns + round(elapsed_ns * (self.ppm * 1e-6))

    @property
    def _lead(self) -> float:
        """By how much a frame comes early, of its nominal time; a difference keeps 0 ppm exact."""
        return self.ppm * 1e-6 / self.rate


@dataclass(frozen=True, slots=True, kw_only=True)
class CaptureSettings:
    """What the chip samples: the part of its settings that changes the echo.

    Attributes
    ----------
    first_sample_m
        Range label of sample 0 in module metres (c = 3.0e8 m/s) as it would read
        if FRAMEAREAOFFSET were the hardware's own 0.18 m, so that a changed offset moves
        labels and not echoes.
    n_samples
        RF samples per frame at 23.328 GHz.
    dac_step
        Exponent of the DAC step size, 2**dac_step.
    tx_center_frequency
        3 (7.290 GHz) or 4 (8.748 GHz).

    Source: protocol reference 9.3, 9.4 and 9.7.
    """

    first_sample_m: float
    n_samples: int
    iterations: int
    pulses_per_step: int
    dac_min: int
    dac_max: int
    dac_step: int
    tx_power: int
    tx_center_frequency: int


class EchoSource(Protocol):
    """Anything that can fill a radar's sampler: a synthesised scene, later a recording."""

    def rf_counters(
        self,
        capture: CaptureSettings,
        frame_counters: NDArray[np.int64],
        scene_times_ns: NDArray[np.int64],
    ) -> NDArray[np.int64]:
        """Return raw RF chip counters of a block of frames.

        The result depends on the arguments and the source's own scene and seed alone.

        Parameters
        ----------
        frame_counters
            Shape (n_frames,); they select the noise.
        scene_times_ns
            Shape (n_frames,), int64: nominal scene time of each counter, without the radar's
            start skew and clock error (which the source adds itself).

        Returns
        -------
        Shape (n_frames, n_samples), int64, clipped to [0, largest counter].
        """
        ...


class Refusal(Exception):  # noqa: N818 - a refusal is an answer of the module, not an error of ours
    """A command the module answers with ERROR: an `ErrorCode` or `X4Error` (they overlap)."""

    def __init__(self, code: int) -> None:
        super().__init__(f"refused with ERROR {code}")
        self.code = code


class Silence(Exception):  # noqa: N818 - not an error of ours
    """A command the module does not answer."""


# --- settings


@dataclass(frozen=True, slots=True, kw_only=True)
class ChipSettings:
    """Settings of the X4 as its driver keeps them after INIT. Source: protocol reference 9.3.

    Attributes
    ----------
    downconversion
        0 for RF frames, anything else for baseband.
    start_m, end_m
        Requested frame area, shortened to the chip's maximum, module metres.
    dac_step
        Exponent of the DAC step, 0...3.
    dac_max
        Highest DAC level; may lie below `dac_min`, as in the firmware.
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


def _number(value: X4Value) -> float:
    if isinstance(value, tuple):
        raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
    return value


def _integer(value: X4Value) -> int:
    return int(_number(value))


def _set_fps(settings: ChipSettings, value: X4Value) -> ChipSettings:
    fps = _number(value)
    # the reference is silent on NaN and infinity; a timer cannot run at either
    return replace(settings, fps=fps if math.isfinite(fps) else 0.0)


def _set_frame_area(settings: ChipSettings, value: X4Value) -> ChipSettings:
    if not isinstance(value, tuple):
        raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
    start_m, end_m = value
    if not (math.isfinite(start_m) and math.isfinite(end_m)) or start_m > end_m:
        raise Refusal(X4Error.FRAME_AREA_END_OUT_OF_SCOPE)
    return replace(settings, start_m=start_m, end_m=end_m)


def _set_offset(settings: ChipSettings, value: X4Value) -> ChipSettings:
    offset_m = _number(value)
    if not math.isfinite(offset_m):
        raise Refusal(X4Error.GENERAL_FAILURE)
    return replace(settings, offset_m=offset_m)


def _set_dac_step(settings: ChipSettings, value: X4Value) -> ChipSettings:
    step = _integer(value) & 0xFF
    if step > 3:
        raise Refusal(X4Error.INVALID_DACSTEP_INPUT)
    return replace(settings, dac_step=step)


def _dac_level(value: X4Value) -> int:
    level = _integer(value) & 0xFFFF
    if level >= DAC_LEVELS:
        raise Refusal(X4Error.GENERAL_FAILURE)
    return level


def _set_tx_center_frequency(settings: ChipSettings, value: X4Value) -> ChipSettings:
    if value not in CHANNELS:
        raise Refusal(X4Error.INVALID_TX_CENTER_FREQUENCY)
    return replace(settings, tx_center_frequency=_integer(value))


def _set_tx_power(settings: ChipSettings, value: X4Value) -> ChipSettings:
    if value not in range(4):
        raise Refusal(X4Error.INVALID_TX_POWER)
    return replace(settings, tx_power=_integer(value))


def _set_prf_div(settings: ChipSettings, value: X4Value) -> ChipSettings:
    divider = _integer(value)
    if divider < 4:
        raise Refusal(X4Error.PRF_DIV_TOO_SMALL)
    return replace(settings, prf_div=divider)


SETTERS: dict[X4Setting, Callable[[ChipSettings, X4Value], ChipSettings]] = {
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


# --- registers

_RESET = {
    X4Setting.SPIREGISTER: "01:FF 02:01 03:02 04:AA 06:01 10:04 14:02 1A:01",
    X4Setting.PIFREGISTER: (
        "0E:80 0F:02 18:BF 19:01 1B:03 21:01 2A:01 2C:10 2D:10 2F:14 30:FF 31:07 34:20 35:0A "
        "37:01 3A:01 3B:C0 3E:19 4A:48 4C:0C 4D:66 4F:05 52:04 5A:03 5B:90 5D:01 5E:01 5F:60 "
        "61:07 62:01 64:80 65:30 66:07 67:01 69:80 6A:E0 6B:12 6C:41 6D:11 72:80 73:30 75:10 "
        "76:53 78:50 7A:53 7B:48"
    ),
    X4Setting.XIFREGISTER: "",
}
_DRIVER_DEFAULTS = {
    X4Setting.SPIREGISTER: {},
    X4Setting.PIFREGISTER: {106: 96, 115: 16, 73: 8, 45: 16, 67: 1, 14: 128},
    X4Setting.XIFREGISTER: {3: 63, 4: 15, 1: 0},
}
"""What the driver writes at INIT, without the registers coupled to settings."""
READ_ONLY = frozenset({(X4Setting.SPIREGISTER, address) for address in range(4)})
"""Constants and chip ids."""


def _with_high(value: int, byte: int) -> int:
    return byte << 8 | value & 0xFF


def _with_low(value: int, byte: int) -> int:
    return value & 0xFF00 | byte


def _with_low_3(value: int, byte: int) -> int:
    return value & 0x7F8 | byte & 7


def _ignored(settings: ChipSettings, byte: int) -> ChipSettings:
    """Leave alone what follows from other settings: bytes per counter, and the receive delay.

    Assumed: the reference gives what they hold, not what writing them does to the frames.
    """
    return settings


def _area(settings: ChipSettings) -> x4.FrameArea:
    return x4.frame_area(
        settings.start_m,
        settings.end_m,
        settings.offset_m,
        downconversion=settings.downconversion != 0,
    )


Reader = Callable[[ChipSettings], int]
Writer = Callable[[ChipSettings, int], ChipSettings]

COUPLED: dict[int, tuple[Reader, Writer]] = {
    0x2C: (lambda s: s.prf_div, lambda s, b: replace(s, prf_div=max(b, 4))),
    0x2E: (
        lambda s: s.pulses_per_step >> 8,
        lambda s, b: replace(s, pulses_per_step=_with_high(s.pulses_per_step, b)),
    ),
    0x2F: (
        lambda s: s.pulses_per_step & 0xFF,
        lambda s, b: replace(s, pulses_per_step=_with_low(s.pulses_per_step, b)),
    ),
    0x30: (lambda s: s.dac_max >> 3, lambda s, b: replace(s, dac_max=b << 3 | s.dac_max & 7)),
    0x31: (lambda s: s.dac_max & 7, lambda s, b: replace(s, dac_max=_with_low_3(s.dac_max, b))),
    0x32: (lambda s: s.dac_min >> 3, lambda s, b: replace(s, dac_min=b << 3 | s.dac_min & 7)),
    0x33: (lambda s: s.dac_min & 7, lambda s, b: replace(s, dac_min=_with_low_3(s.dac_min, b))),
    0x34: (lambda s: 0x20 | s.dac_step, lambda s, b: replace(s, dac_step=b & 3)),
    0x35: (lambda s: s.iterations, lambda s, b: replace(s, iterations=b)),
    0x65: (
        lambda s: s.tx_center_frequency << 4,
        lambda s, b: replace(s, tx_center_frequency=4 if b >> 4 & 7 == 4 else 3),
    ),
    0x75: (lambda s: 0x10 | s.tx_power << 5, lambda s, b: replace(s, tx_power=b >> 5 & 3)),
    0x0F: (lambda s: int(s.downconversion != 0), lambda s, b: replace(s, downconversion=b & 1)),
    0x1B: (lambda s: 6 if s.downconversion else 3, _ignored),
    0x42: (lambda s: _area(s).rx_wait, _ignored),
}
"""PIF registers that are settings, by address: its value, and the settings writing it leaves."""


def _parse(text: str) -> dict[int, int]:
    pairs = (item.split(":") for item in text.split())
    return {int(address, 16): int(value, 16) for address, value in pairs}


# --- frames


@dataclass(frozen=True, slots=True, kw_only=True)
class _Block:
    first_counter: int
    values: NDArray[np.float32]
    all_zero: NDArray[np.bool_]


class Chip:
    """An X4 with its driver, initialised as the sensor firmware leaves it.

    Parameters
    ----------
    largest_block
        Most frames synthesised at once: large blocks cost less per frame, small ones delay other
        radars less.
    block_phase
        Blocks end with counters congruent to it modulo `largest_block`, so that of many radars
        in step only some synthesise at a time; None: each block is as long as it may be.

    Attributes
    ----------
    timeline
        Which counter is next, and the scene time of each.
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
        self._registers = {
            space: _parse(text) | _DRIVER_DEFAULTS[space] for space, text in _RESET.items()
        }
        self.powered = True
        self._zero_frames = 0
        self._apply(ChipSettings())

    @property
    def running(self) -> bool:
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
        """Return a register's byte, 0 where none is known; raise `Refusal` if the chip is off."""
        self._check_powered()
        address &= 0xFF
        if space is X4Setting.PIFREGISTER and address in COUPLED:
            read, _ = COUPLED[address]
            return read(self.settings)
        return self._registers[space].get(address, 0)

    def write_register(self, space: X4Setting, address: int, value: int) -> None:
        """Write a register's byte, or raise `Refusal` if the chip is off."""
        self._check_powered()
        address &= 0xFF
        if space is X4Setting.PIFREGISTER and address in COUPLED:
            _, write = COUPLED[address]
            changed = write(self.settings, value)
            if changed is not self.settings:
                self._apply(changed)
        elif (space, address) not in READ_ONLY:
            self._registers[space][address] = value

    def next_frame(self) -> DataFloat:
        """Take the next frame; its counter moves on.

        Its values are RF amplitudes, shape (n_bins,); or all I, then all Q, shape (2 * n_bins,).
        """
        counter = self.timeline.next_counter
        block = self._block
        if block is None or not 0 <= counter - block.first_counter < len(block.values):
            block = self._block = self._synthesise(counter, self._frames_from(counter))
            self._block_frames = min(2 * self._block_frames, self._largest_block)
        index = counter - block.first_counter
        self.timeline.next_counter = counter + 1
        self._guard_transmitter(bool(block.all_zero[index]))
        return DataFloat(info=counter & 0xFFFFFFFF, values=block.values[index])

    def _frames_from(self, counter: int) -> int:
        if self._block_phase is None:
            return self._block_frames
        return min(self._block_frames, 1 + (self._block_phase - counter) % self._largest_block)

    def _check_powered(self) -> None:
        if not self.powered:
            raise Refusal(X4Error.REGISTER_TIMEOUT)

    def _apply(self, settings: ChipSettings) -> None:
        self.area = _area(settings)
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
        first_sample = x4.BASEBAND_DECIMATION * first_index - LEAD_SAMPLES
        n_samples = x4.BASEBAND_DECIMATION * (area.n_bins - 1) + TAP_COUNT
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
    X4Setting.FPS: lambda chip: x4.frame_rate_read_back(chip.settings.fps),
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
