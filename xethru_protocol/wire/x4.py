"""X4 arithmetic: frame area, frame rate, normalisation. Pure functions.

Source: Protocol reference 9. All ranges are *module metres*: the firmware computes with a
propagation speed of exactly 3.0e8 m/s. Converting to true metres is the application's business.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from xethru_protocol.wire.codes import X4Setting
from xethru_protocol.wire.errors import LocalProtocolError

MODULE_SPEED_MPS = 3.0e8  # what the firmware uses for light
SPEED_OF_LIGHT_MPS = 299_792_458.0
TRUE_PER_MODULE_METRE = SPEED_OF_LIGHT_MPS / MODULE_SPEED_MPS
SAMPLING_RATE_HZ = 23.328e9
SAMPLE_M = 1.5e8 / SAMPLING_RATE_HZ  # from one sample to the next
# The firmware's own constant for it is a float32; its other lengths are multiples in double (9.4).
RF_BIN_M = float(np.float32(SAMPLE_M))
BASEBAND_DECIMATION = 8
BASEBAND_BIN_M = BASEBAND_DECIMATION * RF_BIN_M
COARSE_STEP_SAMPLES = 96
COARSE_STEP_M = COARSE_STEP_SAMPLES * RF_BIN_M  # one step of the receive delay
MOST_COARSE_STEPS = 255  # the chip keeps one more than them in 8 bits (9.4)
FRAME_SAMPLES = 1536  # RF samples the chip captures per frame
BASEBAND_DISCARDED_LINES = 4  # filter fill at the start of a downconverted frame
COMMON_PLL_HZ = 243e6
DEFAULT_PRF_DIV = 16
DEFAULT_OFFSET_M = 0.18  # frame area offset of a board that stores none (9.3)
CARRIER_HZ = {3: 7.290e9, 4: 8.748e9}  # by TXCENTERFREQUENCY
FULL_AREA_M = (0.0, 9.8765432)  # requested area after INIT
LIMITS: Mapping[X4Setting, tuple[int, int]] = {
    X4Setting.PULSESPERSTEP: (1, 65535),
    X4Setting.ITERATIONS: (1, 255),
    X4Setting.DOWNCONVERSION: (0, 1),
    X4Setting.DACSTEP: (0, 3),
    X4Setting.DACMIN: (0, 2047),
    X4Setting.DACMAX: (0, 2047),
    X4Setting.TXCENTERFREQUENCY: (3, 4),
    X4Setting.TXPOWER: (0, 3),
    X4Setting.PRFDIV: (4, 255),
}
"""Smallest and largest useful value of whole-number settings. Protocol reference 4.9.

The module checks only some of them: of others it keeps the low bits.
"""

_MAX_LENGTH_M = (float(np.float32(9.8765432)), float(np.float32(9.6707819)))
# Of a bin: how close a request must be to a bin to be taken as that bin.
_SNAP = float(np.float32(1e-4))

_STANDSTILL_FPS = float(np.finfo(np.float32).eps)  # a request not above it stops the timer
# What the chip's timer really does when asked for 1 ... 34 frames per second, measured (9.6).
_REAL_RATES_HZ = (
    *(1.0041081, 2.0080154, 3.0120232, 4.015228, 5.018533, 6.024046, 7.0273514),
    *(8.0272455, 9.030652, 10.032053, 11.035257, 12.040869, 13.041668, 14.044873),
    *(15.055598, 16.041668, 17.04938, 18.061302, 19.055187, 20.044079, 21.052588),
    *(22.070515, 23.085253, 24.08174, 25.042606, 26.083338, 27.067616, 28.050518),
    *(29.107494, 30.066124, 31.090048, 32.08334, 33.033176, 34.040966),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameArea:
    """A frame area as the module quantises it. Protocol reference 9.4.

    ``start_m`` and ``end_m`` are what GET FRAMEAREA answers (float32 values). In RF the end is
    the range of the bin *after* the last one; in baseband it is the range of the last bin.
    ``base_m`` is the range of the first sample of the captured frame and ``first_index`` the
    bin's index in that capture (baseband: without the discarded lines). ``requested_*`` is what
    the chip remembers as requested: float32, shortened if it was longer than a frame.
    """

    start_m: float
    end_m: float
    n_bins: int
    bin_length_m: float
    base_m: float
    first_index: int
    rx_wait: int
    requested_start_m: float
    requested_end_m: float


def frame_area(
    start_m: float,
    end_m: float,
    offset_m: float = DEFAULT_OFFSET_M,
    downconversion: bool = False,
) -> FrameArea:
    """Quantise a requested frame area exactly as the firmware does. Protocol reference 9.4.

    Parameters
    ----------
    start_m, end_m
        Requested area [m], rounded to float32 like on the wire.
    offset_m
        FRAMEAREAOFFSET [m], rounded to float32.
    downconversion
        False: RF bins of 6.43 mm; True: baseband bins of 51.4 mm.

    Raises
    ------
    LocalProtocolError
        If the start lies behind the end (the module answers ERROR 17), or a limit is not finite.

    >>> frame_area(0.2, 9.4).n_bins, frame_area(0.2, 9.4, downconversion=True).n_bins
    (1431, 181)
    """
    start, end, offset = _f32(start_m), _f32(end_m), _f32(offset_m)
    if not (math.isfinite(start) and math.isfinite(end) and math.isfinite(offset)):
        raise LocalProtocolError("a frame area must have finite limits; give metres")
    check_setting(X4Setting.FRAMEAREA, "frame area", (start, end))
    return quantised_area(start, end, offset, downconversion)


def quantised_area(
    start_m: float, end_m: float, offset_m: float, downconversion: bool = False
) -> FrameArea:
    """Return what the firmware makes of any area, also one that `frame_area` refuses.

    An end that is not a number is as far as the chip samples. Where the start or the offset is not
    finite there are no RF bins, or one baseband bin, and such limits are read back.

    >>> quantised_area(0.4, math.inf, 0.18).n_bins, quantised_area(0.4, 5.0, math.nan).n_bins
    (1501, 0)
    """
    start, end, offset = _f32(start_m), _f32(end_m), _f32(offset_m)
    longest = _MAX_LENGTH_M[downconversion]
    if end - start > longest:
        end = _f32(start + longest)

    discarded, decimation, bin_m = 0, 1, RF_BIN_M
    if downconversion:
        discarded, decimation = BASEBAND_DISCARDED_LINES, BASEBAND_DECIMATION
        bin_m = BASEBAND_BIN_M
    lines = FRAME_SAMPLES // decimation
    delay_steps = float(np.floor((start - offset) / COARSE_STEP_M))
    delay_steps = -1.0 if delay_steps < -1 else delay_steps
    base = delay_steps * COARSE_STEP_M + offset
    # what is not a number gives way to the other one, as in C
    first_m = float(np.fmax(start, base))
    last_m = float(np.fmax(np.fmin(end, bin_m * (lines - discarded - 1) + base), first_m))
    first = _snap_down((first_m - base) / bin_m)
    last = _snap_up((last_m - base) / bin_m)
    return FrameArea(
        start_m=_f32(first * bin_m + base),
        end_m=_f32(last * bin_m + base),
        n_bins=last - first + (1 if downconversion else 0),
        bin_length_m=bin_m,
        base_m=base,
        first_index=first,
        rx_wait=int(1 + delay_steps) % 256 if math.isfinite(delay_steps) else 0,
        requested_start_m=start,
        requested_end_m=end,
    )


def check_setting(setting: X4Setting, name: str, value: int | float | tuple[float, float]) -> None:
    """Raise `LocalProtocolError` if a setting cannot have this value. Protocol reference 4.9.

    >>> check_setting(X4Setting.DACSTEP, "dac_step", 4)
    Traceback (most recent call last):
    xethru_protocol.wire.errors.LocalProtocolError: dac_step must be 0 ... 3, not 4
    """
    if not all(map(math.isfinite, value if isinstance(value, tuple) else (value,))):
        raise LocalProtocolError(f"{name} must be finite, not {value}")
    if isinstance(value, tuple):
        start_m, end_m = value
        if start_m > end_m:
            raise LocalProtocolError(
                f"{name} {start_m:g} ... {end_m:g} m starts behind its end; swap the limits"
            )
    elif setting in LIMITS:
        smallest, largest = LIMITS[setting]
        if not smallest <= value <= largest:
            raise LocalProtocolError(f"{name} must be {smallest} ... {largest}, not {value}")


def timer_rate(requested_hz: float) -> int:
    """Whole number the chip's timer is set to when asked for ``requested_hz``; 0 stops it.

    It has the low 16 bits of the integer part, which is at least 1. Protocol reference 9.6.

    >>> timer_rate(17.9), timer_rate(0.5), timer_rate(1e-8), timer_rate(65552)
    (17, 1, 0, 16)
    """
    return _whole_rate(requested_hz) & 0xFFFF


def real_frame_rate(requested_hz: float) -> float:
    """Frame rate [Hz] the chip's timer runs at when asked for ``requested_hz``; 0 if it stops.

    A request and its read-back give the same, so that a host finds from GET FPS the identical
    number the module computes with. Protocol reference 9.6.

    >>> round(real_frame_rate(17.9), 5), real_frame_rate(200.5), real_frame_rate(1e-8)
    (17.04938, 200.0, 0.0)
    """
    whole = timer_rate(requested_hz)
    return _f32(_REAL_RATES_HZ[whole - 1]) if 0 < whole <= len(_REAL_RATES_HZ) else float(whole)


def frame_rate_read_back(requested_hz: float) -> float:
    """Answer to GET FPS [Hz], a float32 value, when ``requested_hz`` was set.

    It is the real rate below 35, else the request with its fraction, which the timer does not
    have. A request that stops the timer reads back as it is, NaN too. Protocol reference 9.6.

    >>> round(frame_rate_read_back(17.9), 5), frame_rate_read_back(200.5)
    (17.04938, 200.5)
    """
    measured = 0 < _whole_rate(requested_hz) <= len(_REAL_RATES_HZ)
    return real_frame_rate(requested_hz) if measured else _f32(requested_hz)


@lru_cache(16)  # asked for every frame
def _whole_rate(requested_hz: float) -> int:
    """Integer part of a request as the driver takes it, 32 bits, at least 1; 0 if it stops."""
    requested = _f32(requested_hz)
    if not requested > _STANDSTILL_FPS:
        return 0
    return max(int(min(requested, float((1 << 32) - 1))), 1)


FIRST_COUNTER = 1
"""The chip's counter of the first frame after INIT, a reset or power-up. Protocol reference 6.1."""


def frame_time_ns(counter: int, rate_hz: float) -> int:
    """Time of frame ``counter`` after frame 0 at a constant rate: the nearest ns, exactly.

    >>> frame_time_ns(5, 2.0)
    2500000000
    """
    frames, seconds = rate_hz.as_integer_ratio()
    whole, rest = divmod(counter * 1_000_000_000 * seconds, frames)
    return whole + (2 * rest + whole % 2 > frames)


SWEEP_SHARE = 0.95
"""Share of a frame period that the chip sweeps at the highest rate; the rest is a reserve."""


def fps_max(
    *,
    iterations: int,
    pulses_per_step: int,
    dac_min: int,
    dac_max: int,
    dac_step: int = 0,
    prf_div: int = DEFAULT_PRF_DIV,
) -> float:
    """Highest frame rate [Hz] at which the chip sweeps 95 % of the time. Protocol reference 9.6.

    The vendor recommends this reserve. ``dac_step`` is the setting 0 ... 3 (steps of 1, 2, 4, 8).

    >>> round(fps_max(iterations=16, pulses_per_step=300, dac_min=949, dac_max=1100), 1)
    19.8
    """
    steps = (dac_max - dac_min + 1) / 2**dac_step
    sweep = iterations * pulses_per_step * steps
    if sweep <= 0:
        raise LocalProtocolError(
            "no frame rate without a sweep: iterations, pulses per step and "
            "dac_max - dac_min must be positive"
        )
    return float(SWEEP_SHARE * COMMON_PLL_HZ / prf_div / sweep)


@dataclass(frozen=True, slots=True, kw_only=True)
class Normalisation:
    """How chip counters become the float32 values on the wire. Protocol reference 9.7.

    An RF sample is ``counter * quantum - dac_offset`` in float32 arithmetic.
    """

    quantum: float
    dac_offset: float
    max_counter: int

    @classmethod
    def of(
        cls, *, iterations: int, pulses_per_step: int, dac_min: int, dac_max: int, dac_step: int = 0
    ) -> "Normalisation":
        """Normalisation for the given settings; ``quantum`` and ``dac_offset`` are float32 values.

        >>> Normalisation.of(iterations=16, pulses_per_step=300, dac_min=949, dac_max=1100)
        Normalisation(quantum=2.0345052575976297e-07, dac_offset=0.07421875, max_counter=729600)
        """
        levels = dac_max - dac_min + 1
        pulses = np.float32(iterations * pulses_per_step)
        quantum = np.float32(2**dac_step) / pulses / np.float32(1024)
        return cls(
            quantum=float(quantum),
            dac_offset=float(np.float32(levels) / np.float32(2048)),
            max_counter=iterations * pulses_per_step * levels // 2**dac_step,
        )


def _f32(value: float) -> float:
    with np.errstate(over="ignore"):  # beyond float32 is infinite, which the callers refuse
        return float(np.float32(value))


def _snap_down(x: float) -> int:
    if math.isnan(x):  # as the microcontroller converts it
        return 0
    return math.ceil(x) if abs(x - math.ceil(x)) < _SNAP else math.floor(x)


def _snap_up(x: float) -> int:
    if math.isnan(x):
        return 0
    return math.floor(x) if abs(x - math.floor(x)) < _SNAP else math.ceil(x)
