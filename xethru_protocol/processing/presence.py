"""Whether somebody is there: movement that stands out of noise and of what stands still.

With ``P[f, m]`` the power of frequency f in bin m (`doppler.range_doppler`), the noise at f is the
median of ``P[f, :]`` over range, divided by ln 2: one person fills few bins, and the median of an
exponential variable is ln 2 of its mean. So slow noise, which differs by frequency, is allowed for.
In noise ``q = P[f, m] / noise[f]`` is exponential of mean 1.

Noise
    The mean of q over the K frequencies of a band is a Gamma variable of mean 1 and shape ``L = K /
    1.94``; the Hann window correlates neighbouring frequencies (squared correlations 4/9 and 1/36,
    on either side). Its quantile at ``1 - rate / (2 n_bins)`` is the threshold (Wilson and
    Hilferty, Proc. Nat. Acad. Sci. 17 (1931) 684): ``(1 - 1/(9 L) + z / (3 sqrt(L)))**3``, with z
    that of the normal distribution. The rate is divided among the bins and two bands: slow, as
    breathing, and all.

    So ``false_alarm_rate`` is nominal, no bound: it assumes noise that is complex Gaussian, equal
    and independent in all bins, and whose power is known. That power is estimated, and the fewer
    bins there are, the more false alarms this adds. Of windows of white noise, 10 s at 17 frames/s
    and a nominal rate of 5 %, somebody was found in 11.0 % with 16 bins, 9.1 % with 32, 6.5 % with
    90 (4000 windows each) and 6.5 % with 181 (2000 windows); with 90 bins and the true power of the
    noise in 5.1 % (4000), and at the nominal rate of 0.1 % in 0.135 % (20 000).
What stands still
    A jitter of the carrier's phase moves every echo. Power of movement in a bin must also exceed
    ``LEAST_PHASE_RAD**2`` of the power that stands still in it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike

from xethru_protocol.processing.doppler import CARRIER_HZ, SPEED_OF_LIGHT_MPS, range_doppler
from xethru_protocol.processing.monitor import Monitor, checked

LEAST_PHASE_RAD = 0.1
"""Three times the phase's deviation of a strong reflector in a recording of a real module."""

_SLOW_HZ = 0.7
_FAST_MPS = 0.05
_FAST_SHARE = 0.05
_CORRELATION = 1 + 2 * (4 / 9 + 1 / 36)
_HANN_NOISE = 1.5
"""Power of white noise under a Hann window, in that of one without: n sum w^2 / (sum w)^2."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Presence:
    """Whether somebody is there.

    Attributes
    ----------
    range_m
        Where the most movement is; None if nobody is there.
    moving
        Whether much of it is faster than breathing: 5 cm/s.
    """

    present: bool
    range_m: float | None = None
    moving: bool = False


def presence(
    iq: ArrayLike,
    ranges_m: ArrayLike,
    frame_rate_hz: float,
    *,
    false_alarm_rate: float = 1e-3,
    carrier_hz: float = CARRIER_HZ,
) -> Presence:
    """Return whether somebody is there, and where the most movement is.

    Parameters
    ----------
    iq
        Shape (n_frames, n_bins), complex, clutter included; 10 s are usual and hold one breath, 5 s
        the least. At least 16 bins, of which a person fills less than half.
    ranges_m
        Shape (n_bins,).
    false_alarm_rate
        Nominal share of windows of noise alone in which somebody is found, between 0 and 1. The
        measured share is greater, the more so with few bins: see the module's docstring.
    carrier_hz
        For velocities.

    Raises
    ------
    ValueError
        For arrays that do not fit each other, too few frames or bins, or frames with a NaN.

    The module's docstring has the formulas.
    """
    frames, ranges = checked(iq, ranges_m)
    if len(ranges) < 16 or len(frames) < 5 * frame_rate_hz:
        raise ValueError(
            f"{len(frames)} frames of {len(ranges)} bins at {frame_rate_hz:g} frames/s: "
            "presence needs 5 s and 16 bins"
        )
    if not 0 < false_alarm_rate < 1:
        raise ValueError(f"false_alarm_rate {false_alarm_rate:g}: must be between 0 and 1")
    standing = frames.mean(axis=0)
    found = range_doppler(frames - standing, frame_rate_hz, carrier_hz=carrier_hz)
    speed_hz = np.abs(found.frequencies_hz)
    moves = speed_hz > 1.5 * frame_rate_hz / len(frames)  # not what the mean took away
    power, speed_hz = found.power[moves], speed_hz[moves]
    noise = np.median(power, axis=1) / math.log(2)
    ratio = power / np.maximum(noise, np.finfo(np.float64).tiny)[:, np.newaxis]
    stands_out = np.zeros(len(ranges), dtype=np.bool_)
    for band in (speed_hz < _SLOW_HZ, np.full(len(speed_hz), fill_value=True)):
        level = _threshold(int(band.sum()), false_alarm_rate / (2 * len(ranges)))
        stands_out |= ratio[band].mean(axis=0) > level
    total = power.sum(axis=0) / _HANN_NOISE
    stands_out &= total > LEAST_PHASE_RAD**2 * np.abs(standing) ** 2
    if not stands_out.any():
        return Presence(present=False)
    there = int(np.argmax(np.where(stands_out, total, 0.0)))
    fast = speed_hz > 2 * _FAST_MPS * carrier_hz / SPEED_OF_LIGHT_MPS
    excess = np.maximum(power[:, there] - noise, 0.0)
    return Presence(
        present=True,
        range_m=float(ranges[there]),
        moving=bool(excess[fast].sum() > _FAST_SHARE * excess.sum()),
    )


def _threshold(frequencies: int, probability: float) -> float:
    """Return what the mean of q over so many frequencies exceeds with a probability, in noise."""
    shape = frequencies / _CORRELATION
    z = NormalDist().inv_cdf(1 - probability)
    return (1 - 1 / (9 * shape) + z / (3 * math.sqrt(shape))) ** 3


class PresenceMonitor(Monitor[Presence]):
    """Presence from frames as they come: `presence` of the newest window.

    Parameters
    ----------
    ranges_m, frame_rate_hz, false_alarm_rate, carrier_hz
        As of `presence`.
    window_s
        Seconds that are looked back on.
    every_s
        Seconds from one answer to the next.
    """

    def __init__(
        self,
        ranges_m: ArrayLike,
        frame_rate_hz: float,
        *,
        window_s: float = 10.0,
        every_s: float = 1.0,
        false_alarm_rate: float = 1e-3,
        carrier_hz: float = CARRIER_HZ,
    ) -> None:
        compute = partial(presence, false_alarm_rate=false_alarm_rate, carrier_hz=carrier_hz)
        super().__init__(compute, ranges_m, frame_rate_hz, window_s=window_s, every_s=every_s)

    @property
    def presence(self) -> Presence | None:
        """The latest answer; None until the window is full."""
        return self.newest
