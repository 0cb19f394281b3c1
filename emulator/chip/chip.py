"""The X4 chip and its driver: settings with the firmware's checks, registers, time, frames.

What a frame holds is a pure function of the source, the frame's place in scene time and the
settings: raw RF counts come from an `EchoSource` as integers; the chip turns them into the float32
values the firmware sends. The frame counter says nothing of scene time: see `Timeline`.
Frames are synthesised in blocks because that is faster, and a block is discarded whenever a
setting changes; block size never changes a value.

As on the module there are two sides. The chip does what its registers say. The driver keeps its own
copy of what was SET, and makes frame length, downconversion and normalisation from that; writing a
register leaves the copy alone. Registers keep what was written until INIT.

The frame timer and the sampler run from one crystal. A clock that is ``ppm`` millionths fast
counts 1 + ppm 1e-6 of its seconds in a true one, so what it takes for an interval T is over after
``T / (1 + ppm 1e-6)``: its frames come early, and its bins are short. The error is constant:
temperature and ageing are left out.

Source: protocol reference 4.9 (with its tables of X4 registers and of chip reset values), 5.1, 8.4
and chapter 9.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from xethru_protocol.processing.downconversion import CHANNELS, TAP_COUNT, ChannelTaps
from xethru_protocol.wire import x4
from xethru_protocol.wire.codes import ErrorCode, X4Error, X4Setting
from xethru_protocol.wire.messages import REGISTERS, DataFloat, X4Value
from xethru_protocol.wire.x4 import frame_time_ns

NS_PER_S = 1_000_000_000
GUARD_FRAMES = 100
"""Zero frames after which the module switches its transmitter off."""
ZERO_BELOW = np.finfo(np.float32).eps
"""A frame is zero if no normalised value reaches this."""
SPI_BUFFER = 6176
"""Bytes of the driver's SPI buffer: a burst, if written with its address, must be shorter."""
LARGEST_BURST = 1 << 20
"""Bytes of a READ for which the module has memory; assumed."""
DEFAULT_LARGEST_BLOCK = 32
DAC_LEVELS = 2048


class Timeline:
    """Since INIT: the chip's counter of frames, and where in scene time each frame lies.

    A frame's index counts frame periods of scene time from 0 and selects what the frame holds.
    Within a segment of constant rate, index k lies at ``start + frame_time_ns(k - first, rate)``;
    another rate begins a new segment at the next index.

    The counter counts the sweeps of the chip: that of the first after INIT is 1, and it stands
    still while the timer does, however much scene time passes (protocol reference 6.1).

    Attributes
    ----------
    next_index, next_counter
        Of the next frame; both unbounded, the counter has 32 bits on the wire.

    Examples
    --------
    >>> timeline = Timeline()
    >>> timeline.set_rate(100.0)
    >>> timeline.skip_before(500_000_000)
    >>> timeline.next_index, timeline.next_counter
    (50, 51)
    >>> timeline.set_rate(40.0)
    >>> timeline.scene_time_ns(50), timeline.scene_time_ns(54)
    (500000000, 600000000)
    >>> timeline.pause_until(600_000_000)
    >>> timeline.next_index, timeline.next_counter
    (54, 51)
    """

    def __init__(self) -> None:
        self.next_index = 0
        self.next_counter = x4.FIRST_COUNTER
        self._first_index = 0
        self._start_ns = 0
        self._rate_hz: float | None = None

    def set_rate(self, rate_hz: float) -> None:
        """Run at another real frame rate (> 0) from the next index on."""
        if rate_hz != self._rate_hz:
            self._start_ns = self.scene_time_ns(self.next_index)
            self._first_index = self.next_index
            self._rate_hz = rate_hz

    def scene_time_ns(self, index: int) -> int:
        """Return the scene time of an index of the current segment; 0 without a rate."""
        if self._rate_hz is None:
            return 0
        return self._start_ns + frame_time_ns(index - self._first_index, self._rate_hz)

    def step(self) -> None:
        """Move on by one sweep."""
        self.next_index += 1
        self.next_counter += 1

    def skip_before(self, scene_time_ns: int) -> None:
        """Let the sweeps before a scene time pass: the counter runs on."""
        before = self.next_index
        self.pause_until(scene_time_ns)
        self.next_counter += self.next_index - before

    def pause_until(self, scene_time_ns: int) -> None:
        """Move on to the first index not before a scene time, while the chip does not sweep."""
        if self._rate_hz is None or self.scene_time_ns(self.next_index) >= scene_time_ns:
            return
        elapsed_ns = scene_time_ns - self._start_ns
        index = self._first_index + int(elapsed_ns * self._rate_hz / NS_PER_S) - 1
        self.next_index = max(index, self.next_index)
        while self.scene_time_ns(self.next_index) < scene_time_ns:
            self.next_index += 1


@dataclass(frozen=True, slots=True, kw_only=True)
class ModuleClock:
    """Nominal time of a frame to scene time, and back.

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
        indices: NDArray[np.int64],
        scene_times_ns: NDArray[np.int64],
    ) -> NDArray[np.int64]:
        """Return raw RF counts of a block of frames.

        The result depends on the arguments and the source's own scene and seed alone.

        Parameters
        ----------
        indices
            Shape (n_frames,): of the frames in scene time, see `Timeline`; they select the noise.
        scene_times_ns
            Shape (n_frames,), int64: nominal scene time of each frame, without the radar's
            start skew and clock error (which the source adds itself).

        Returns
        -------
        Shape (n_frames, n_samples), int64, clipped to [0, largest count].
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
    """The driver's own copy of the X4's settings after INIT. Source: protocol reference 9.3.

    Attributes
    ----------
    downconversion
        1 for baseband, anything else for RF frames.
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

    @property
    def is_baseband(self) -> bool:
        return self.downconversion == 1


def _number(value: X4Value) -> float:
    if isinstance(value, tuple):
        raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
    return value


def _integer(value: X4Value) -> int:
    return int(_number(value))


def _set_fps(settings: ChipSettings, value: X4Value) -> ChipSettings:
    return replace(settings, fps=float(_number(value)))


def _set_frame_area(settings: ChipSettings, value: X4Value) -> ChipSettings:
    if not isinstance(value, tuple):
        raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
    start_m, end_m = value
    if start_m > end_m:
        raise Refusal(X4Error.FRAME_AREA_END_OUT_OF_SCOPE)
    return replace(settings, start_m=start_m, end_m=end_m)


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
    X4Setting.FRAMEAREAOFFSET: lambda s, v: replace(s, offset_m=_number(v)),
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
    X4Setting.PIFREGISTER: {
        106: 96,
        115: 16,
        73: 8,
        15: 0,
        117: 80,
        101: 48,
        45: 16,
        67: 1,
        14: 128,
    },
    X4Setting.XIFREGISTER: {3: 63, 4: 15, 1: 0},
}
"""What the driver writes at INIT, without the settings that it writes then, too."""
READ_ONLY = frozenset({(X4Setting.SPIREGISTER, address) for address in range(4)})
"""Constants and chip ids."""


def _area(settings: ChipSettings) -> x4.FrameArea:
    return x4.quantised_area(
        settings.start_m, settings.end_m, settings.offset_m, settings.is_baseband
    )


RX_WAIT, TX_WAIT, SAMPLER_MODE, COUNTER_BYTES = 0x42, 0x43, 0x0F, 0x1B


@dataclass(frozen=True, slots=True)
class Bits:
    """Bits of a PIF register that hold part of a setting: ``count`` from ``low`` on.

    ``shift`` is the place of the lowest in the setting; ``alone``: a SET clears the others.
    """

    address: int
    low: int = 0
    count: int = 8
    shift: int = 0
    alone: bool = True

    def taken_from(self, byte: int) -> int:
        return (byte >> self.low & (1 << self.count) - 1) << self.shift

    def put_into(self, byte: int, value: int) -> int:
        mask = (1 << self.count) - 1
        kept = 0 if self.alone else byte & ~(mask << self.low)
        return kept | (value >> self.shift & mask) << self.low


FIELDS: dict[X4Setting, tuple[str, tuple[Bits, ...]]] = {
    X4Setting.PRFDIV: ("prf_div", (Bits(0x2C),)),
    X4Setting.PULSESPERSTEP: ("pulses_per_step", (Bits(0x2E, shift=8), Bits(0x2F))),
    X4Setting.DACMAX: ("dac_max", (Bits(0x30, shift=3), Bits(0x31, count=3))),
    X4Setting.DACMIN: ("dac_min", (Bits(0x32, shift=3), Bits(0x33, count=3))),
    X4Setting.DACSTEP: ("dac_step", (Bits(0x34, count=2, alone=False),)),
    X4Setting.ITERATIONS: ("iterations", (Bits(0x35),)),
    X4Setting.TXCENTERFREQUENCY: ("tx_center_frequency", (Bits(0x65, 4, 3, alone=False),)),
    X4Setting.TXPOWER: ("tx_power", (Bits(0x75, 5, 2, alone=False),)),
}
"""Settings that the chip keeps, which GET reads from it: the driver's name, and where they lie."""
_AREA_SETTINGS = frozenset(
    {X4Setting.FRAMEAREA, X4Setting.FRAMEAREAOFFSET, X4Setting.DOWNCONVERSION}
)
"""Those with which the driver sets up the frame area anew."""
_SET_WITHOUT_POWER = frozenset(
    {X4Setting.FRAMEAREA, X4Setting.FRAMEAREAOFFSET, X4Setting.TXPOWER, X4Setting.PRFDIV}
)
_READ_WITHOUT_POWER = frozenset({X4Setting.TXPOWER, X4Setting.PRFDIV, X4Setting.TXCENTERFREQUENCY})
"""Settings of which the driver drops the error of a chip that is off."""


def _parse(text: str) -> dict[int, int]:
    pairs = (item.split(":") for item in text.split())
    return {int(address, 16): int(value, 16) for address, value in pairs}


# --- frames


@dataclass(frozen=True, slots=True, kw_only=True)
class _SynthesisedFrames:
    first_index: int
    values: NDArray[np.float32]
    is_zero: NDArray[np.bool_]


class Chip:
    """An X4 with its driver, initialised as the sensor firmware leaves it.

    Parameters
    ----------
    largest_block
        Most frames synthesised at once: large blocks cost less per frame, small ones delay other
        radars less.
    block_phase
        Blocks end with indices congruent to it modulo `largest_block`, so that of many radars
        in step only some synthesise at a time; None: each block is as long as it may be.
    board_offset_m
        FRAMEAREAOFFSET that the board stores, which INIT restores [module metres].
    negates_q
        Whether the driver negates Q, as it does since XEP 2.1.0 (17).

    Attributes
    ----------
    timeline
        Which frame is next, and the scene time of each.
    powered
        False after ENABLE 0, until INIT.
    locked
        Whether the driver's lock is lost, after an SPI burst that is too long: no frames come
        until the module restarts.
    """

    def __init__(
        self,
        source: EchoSource,
        largest_block: int = DEFAULT_LARGEST_BLOCK,
        block_phase: int | None = None,
        board_offset_m: float = x4.DEFAULT_OFFSET_M,
        *,
        negates_q: bool = True,
    ) -> None:
        self._source = source
        self._largest_block = largest_block
        self._block_phase = block_phase
        self._block: _SynthesisedFrames | None = None
        self._block_frames = 1
        self._board_offset_m = float(np.float32(board_offset_m))
        self._negates_q = negates_q
        self.power_up()

    def power_up(self) -> None:
        """Start as with the module: nothing is left, not even a lost lock."""
        self.locked = False
        self.init()

    def init(self) -> None:
        """Restart the chip: default settings, FPS 0, a new `Timeline`."""
        self.timeline = Timeline()
        self._registers = {
            space: _parse(text) | _DRIVER_DEFAULTS[space] for space, text in _RESET.items()
        }
        self.powered = True
        self._zero_frames = 0
        settings = ChipSettings(offset_m=self._board_offset_m)
        for setting in (*FIELDS, X4Setting.DOWNCONVERSION):
            self._write_setting(setting, settings)
        self._apply(settings)

    @property
    def running(self) -> bool:
        return self.powered and not self.locked and x4.timer_rate(self.settings.fps) > 0

    def set(self, setting: X4Setting, value: X4Value) -> None:
        """Change one setting at once, or raise `Refusal` and change nothing."""
        if setting is X4Setting.ENABLE:
            self.powered = self.powered and value == 1
        elif setting in REGISTERS and isinstance(value, tuple):
            address, byte = value
            self.write_register(setting, int(address), int(byte))
        elif setting in SETTERS:
            changed = SETTERS[setting](self.settings, value)
            if self.powered:
                self._write_setting(setting, changed)
            elif setting not in _SET_WITHOUT_POWER:
                if setting is X4Setting.FPS:  # the driver notes it before it turns to the chip
                    self._apply(changed)
                raise Refusal(X4Error.REGISTER_TIMEOUT)
            self._apply(changed)
        else:
            raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)

    def get(self, setting: X4Setting) -> X4Value:
        """Return what GET answers, or raise `Refusal` for a setting without getter."""
        if setting in FIELDS:
            if not self.powered and setting in _READ_WITHOUT_POWER:
                return 0
            self._check_powered()
            return self._held(setting)
        getter = _GETTERS.get(setting)
        if getter is None:
            raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
        return getter(self)

    def read_register(self, space: X4Setting, address: int) -> int:
        """Return a register's byte, 0 where none is known.

        While the chip is off, SPI is a plain bus and reads 0 (assumed); others raise `Refusal`.
        """
        if space is X4Setting.SPIREGISTER and not self.powered:
            return 0
        self._check_powered()
        return self._registers[space].get(address & 0xFF, 0)

    def write_register(self, space: X4Setting, address: int, value: int) -> None:
        """Write a register's byte; lost on SPI while the chip is off, others raise `Refusal`."""
        if space is X4Setting.SPIREGISTER and not self.powered:
            return
        self._check_powered()
        address &= 0xFF
        if (space, address) not in READ_ONLY:
            self._registers[space][address] = value
            self._discard_frames()

    def read_burst(self, address: int, length: int) -> bytes:
        """Read an SPI register again and again, or raise `Refusal`.

        Zeros of the FIFO register 05h: a frame in it has been fetched by the driver already.
        """
        if length > LARGEST_BURST:
            raise Refusal(ErrorCode.XTS_SPRE_COMMAND_FAILED)
        self._check_burst(length)
        return bytes([self.read_register(X4Setting.SPIREGISTER, address)]) * length

    def write_burst(self, address: int, values: bytes) -> None:
        """Write bytes to one SPI register, one after the other, or raise `Refusal`."""
        self._check_burst(len(values) + 1)
        for value in values:
            self.write_register(X4Setting.SPIREGISTER, address, value)

    def _check_burst(self, length: int) -> None:
        if length >= SPI_BUFFER:
            self.locked = True
            raise Refusal(X4Error.BUFFER_TO_SMALL)

    def next_frame(self) -> DataFloat:
        """Take the next frame; its counter moves on.

        Its values are RF amplitudes, shape (n_bins,); or all I, then all Q, shape (2 * n_bins,).
        """
        index, counter = self.timeline.next_index, self.timeline.next_counter
        block = self._block
        if block is None or not 0 <= index - block.first_index < len(block.values):
            block = self._block = self._synthesise(index, self._frames_from(index))
            self._block_frames = min(2 * self._block_frames, self._largest_block)
        row = index - block.first_index
        self.timeline.step()
        self._guard_transmitter(bool(block.is_zero[row]))
        return DataFloat(info=counter & 0xFFFFFFFF, values=block.values[row])

    def pass_over(self, first_index: int) -> None:
        """Let the guard see the frames from an index to the next, which the host never gets.

        Assumed: frames of the same settings are all zero, or none is; so one is looked at where
        that is not known.
        """
        passed = self.timeline.next_index - first_index
        if passed <= 0 or (self._block is not None and not self._zero_frames):
            return
        self._block = self._synthesise(first_index, 1)
        is_zero = bool(self._block.is_zero[0])
        for _ in range(passed if is_zero else 1):
            self._guard_transmitter(is_zero)
            if not self.running:
                return

    def _frames_from(self, index: int) -> int:
        if self._block_phase is None:
            return self._block_frames
        return min(self._block_frames, 1 + (self._block_phase - index) % self._largest_block)

    def _check_powered(self) -> None:
        if not self.powered:
            raise Refusal(X4Error.REGISTER_TIMEOUT)

    def _apply(self, settings: ChipSettings) -> None:
        self.area = _area(settings)
        self.settings = replace(
            settings, start_m=self.area.requested_start_m, end_m=self.area.requested_end_m
        )
        if rate_hz := x4.real_frame_rate(settings.fps):
            self.timeline.set_rate(rate_hz)
        self._discard_frames()

    def _held(self, setting: X4Setting) -> int:
        """Return a setting as the chip's registers hold it."""
        registers = self._registers[X4Setting.PIFREGISTER]
        _, places = FIELDS[setting]
        return sum(bits.taken_from(registers.get(bits.address, 0)) for bits in places)

    def _write_setting(self, setting: X4Setting, settings: ChipSettings) -> None:
        """Write to the chip what the driver writes when one setting is SET."""
        registers = self._registers[X4Setting.PIFREGISTER]
        name, places = FIELDS.get(setting, ("", ()))
        for bits in places:
            byte = registers.get(bits.address, 0)
            registers[bits.address] = bits.put_into(byte, getattr(settings, name))
        if setting in _AREA_SETTINGS:
            registers[RX_WAIT] = (_area(settings).rx_wait - 1 + registers[TX_WAIT]) & 0xFF
        if setting is X4Setting.DOWNCONVERSION:
            # the driver masks what stays of the register, and not what it puts there
            kept = registers.get(SAMPLER_MODE, 0) & ~1
            registers[SAMPLER_MODE] = kept | settings.downconversion
            registers[COUNTER_BYTES] = 6 if settings.is_baseband else 3

    def _discard_frames(self) -> None:
        self._block = None
        self._block_frames = 1  # after a change a host rarely wants many frames of the first kind

    def _guard_transmitter(self, is_zero: bool) -> None:
        self._zero_frames = self._zero_frames + 1 if is_zero else 0
        if self._zero_frames >= GUARD_FRAMES:
            self._zero_frames = 0
            settings = replace(self.settings, tx_power=0, fps=0.0)
            self._write_setting(X4Setting.TXPOWER, settings)
            self._apply(settings)

    def _synthesise(self, first_index: int, n_frames: int) -> _SynthesisedFrames:
        settings = self.settings
        indices = np.arange(first_index, first_index + n_frames, dtype=np.int64)
        scene_times_ns = np.array(
            [self.timeline.scene_time_ns(int(index)) for index in indices], dtype=np.int64
        )
        capture = self._capture()
        if capture.n_samples == 0 or _largest_counter(capture) <= 0:
            raw = np.zeros((n_frames, capture.n_samples), dtype=np.int64)
        else:
            raw = self._source.rf_counters(capture, indices, scene_times_ns)
        convert = _baseband_values if settings.is_baseband else _rf_values
        values = convert(raw, settings, self.area)
        if settings.is_baseband and not self._negates_q:
            values[:, self.area.n_bins :] *= -1
        is_zero = np.array([_is_zero(frame) for frame in values], dtype=np.bool_)
        return _SynthesisedFrames(first_index=first_index, values=values, is_zero=is_zero)

    def _capture(self) -> CaptureSettings:
        """Return which RF samples the chip takes, labelled as with the hardware's own offset."""
        area, settings = self.area, self.settings
        held = {name: self._held(setting) for setting, (name, _) in FIELDS.items()}
        held.pop("prf_div")
        registers = self._registers[X4Setting.PIFREGISTER]
        delay_steps = registers[RX_WAIT] - registers[TX_WAIT]
        # an absurd offset can label bins far outside the 1536 samples there are
        first_sample = min(area.first_index, x4.FRAME_SAMPLES - 1)
        n_samples = area.n_bins
        if settings.is_baseband:
            lead = CHANNELS[settings.tx_center_frequency].lead_samples
            first_sample = x4.BASEBAND_DECIMATION * first_sample - lead
            n_samples = x4.BASEBAND_DECIMATION * (n_samples - 1) + TAP_COUNT
        # the hardware samples at 23.328 GHz, whatever the driver's float32 makes of it
        start_m = delay_steps * (x4.COARSE_STEP_SAMPLES * x4.SAMPLE_M) + x4.DEFAULT_OFFSET_M
        if held["tx_center_frequency"] not in CHANNELS:
            held["tx_center_frequency"] = min(CHANNELS)  # assumed
        return CaptureSettings(
            first_sample_m=start_m + first_sample * x4.SAMPLE_M,
            n_samples=n_samples,
            **held,
        )


def _is_zero(frame: NDArray[np.float32]) -> bool:
    """Whether the driver takes a frame for one without signal; nearly always sample 0 decides."""
    return not (np.abs(frame[:1]) >= ZERO_BELOW).any() and not (np.abs(frame) >= ZERO_BELOW).any()


def _largest_counter(capture: CaptureSettings) -> int:
    pulses = capture.iterations * capture.pulses_per_step
    return pulses * (capture.dac_max - capture.dac_min + 1)


def normalisation(settings: ChipSettings | CaptureSettings) -> x4.Normalisation:
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
    unit = normalisation(settings)
    quantum, middle = np.float32(unit.quantum), np.float32(unit.dac_offset)
    return raw.astype(np.float32) * quantum - middle


def _baseband_values(
    raw: NDArray[np.int64], settings: ChipSettings, area: x4.FrameArea
) -> NDArray[np.float32]:
    taps = CHANNELS[settings.tx_center_frequency]
    i_raw, q_raw = downconvert(raw, taps, area.first_index % 2)
    # the driver multiplies both factors first, each step in float32
    per_sum = np.float32(1.0) / np.float32(taps.absolute_sum)
    factor = np.float32(normalisation(settings).quantum) * per_sum
    i_values = i_raw.astype(np.float32) * factor
    q_values = -(q_raw.astype(np.float32) * factor)
    return np.concatenate([i_values, q_values], axis=1)


def downconvert(
    rf_counters: NDArray[np.int64], taps: ChannelTaps, first_line: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Filter and decimate RF counters into raw I and Q lines, in exact integers.

    Parameters
    ----------
    rf_counters
        Shape (n_frames, 8 * (n_lines - 1) + 32), int64; sample 0 lies
        ``taps.lead_samples`` before the RF sample of the first line.
    first_line
        Index of the first line in the captured frame; its parity selects the sign.

    Returns
    -------
    Raw I and raw Q (before the sign change of protocol reference 9.7), each of shape
    (n_frames, n_lines), int64. `xethru_protocol.processing.downconversion` says what the chip does.

    Source: protocol reference 9.7 and 9.8.
    """
    windows = np.lib.stride_tricks.sliding_window_view(rf_counters, TAP_COUNT, axis=1)
    windows = windows[:, :: x4.BASEBAND_DECIMATION]
    # integer matrix products never reach BLAS: exact and the same on every machine
    lines = windows @ np.array([taps.i_taps, taps.q_taps], dtype=np.int64).T
    signs = np.array([taps.line_sign**parity for parity in (0, 1)], dtype=np.int64)
    lines *= signs[(first_line + np.arange(lines.shape[1])) % 2][:, np.newaxis]
    return lines[:, :, 0], lines[:, :, 1]


_GETTERS: dict[X4Setting, Callable[[Chip], X4Value]] = {
    X4Setting.FPS: lambda chip: x4.frame_rate_read_back(chip.settings.fps),
    X4Setting.DOWNCONVERSION: lambda chip: chip.settings.downconversion,
    X4Setting.FRAMEAREA: lambda chip: (chip.area.start_m, chip.area.end_m),
    X4Setting.FRAMEAREAOFFSET: lambda chip: chip.settings.offset_m,
    X4Setting.FRAMEBINCOUNT: lambda chip: chip.area.n_bins,
}
