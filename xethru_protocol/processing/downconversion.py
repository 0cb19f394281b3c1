"""Radio-frequency frames to complex baseband, with the taps of the chip's own filters.

A module sends either raw samples at 23.328 GHz (RF) or what the chip makes of them: I + jQ of every
8th sample. `downconvert` does the same to RF frames afterwards. The vendor's driver loads two sets
of signed 6-bit taps, which the chip uses in turn. Eight samples are 2.5 carrier cycles at
7.29 GHz, so the second set is the first one negated; they are 3 cycles at 8.748 GHz, so both sets
are equal. Either way the carrier's phase reference is continuous from line to line.

Line L is centred on RF sample 8 L of the chip's frame, but for half a sample or 3.2 mm. Whether
hardware compensates the filter's delay, and with which set it begins, is not known.

Source: protocol reference 9.7 and 9.8.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

TAP_COUNT = 32
DECIMATION = 8
"""RF samples from one baseband line to the next."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ChannelTaps:
    """Filter of one transmitter centre frequency.

    Attributes
    ----------
    i_taps, q_taps
        32 signed 6-bit integers each, tap 0 for the nearest sample: the first set.
    line_sign
        Factor between the taps of one line and the next, +1 or -1.
    centre
        Where the filter pair is symmetric, samples after tap 0: its group delay.
    """

    i_taps: tuple[int, ...]
    q_taps: tuple[int, ...]
    line_sign: int
    centre: float

    @property
    def absolute_sum(self) -> int:
        """The S of protocol reference 9.7, by which baseband values are divided."""
        return sum(abs(tap) for tap in self.i_taps)

    @property
    def lead_samples(self) -> int:
        """RF samples that the window of line L reaches before sample 8 L."""
        return int(self.centre + 0.5)


# fmt: off
CHANNELS = {
    3: ChannelTaps(
        i_taps=(
            1, -1, -1, 5, -3, -6, 12, -2, -16, 18, 6, -27, 16, 17, -31, 6,
            25, -25, -5, 24, -13, -10, 16, -3, -7, 6, 0, -3, 1, 0, 0, 0,
        ),
        q_taps=(
            0, 1, -3, 0, 6, -7, -3, 16, -10, -13, 24, -5, -25, 25, 6, -31,
            17, 16, -27, 6, 18, -16, -2, 12, -6, -3, 5, -1, -1, 1, 0, 0,
        ),
        line_sign=-1,
        centre=14.5,
    ),
    4: ChannelTaps(
        i_taps=(
            1, -2, 1, 3, -8, 11, -5, -8, 21, -24, 10, 12, -30, 31, -13, -12,
            29, -27, 10, 8, -17, 15, -5, -3, 5, -4, 1, 0, 0, 0, 0, 0,
        ),
        q_taps=(
            0, 1, -4, 5, -3, -5, 15, -17, 8, 10, -27, 29, -12, -13, 31, -30,
            12, 10, -24, 21, -8, -5, 11, -8, 3, 1, -2, 1, 0, 0, 0, 0,
        ),
        line_sign=+1,
        centre=13.5,
    ),
}
# fmt: on
"""Taps by TXCENTERFREQUENCY setting."""


def downconvert(
    rf: ArrayLike, *, tx_center_frequency: int = 3, first_sample: int = 0
) -> NDArray[np.complex64]:
    """Return complex baseband of RF frames: what the module would send with downconversion on.

    With the taps i and q, their S, and s = ``line_sign``, line L is
    ``s**L sum_k (i[k] - j q[k]) rf[8 L - lead + k] / S``. Phase falls as range grows, by 4 pi per
    carrier wavelength. A tone of amplitude A at the carrier has the magnitude 0.782 A (setting 3)
    or 0.768 A (setting 4).

    Parameters
    ----------
    rf
        Shape (..., n_bins), normalised units: one frame or several. The taps sum to 0, so a
        constant that is added to all samples changes nothing.
    tx_center_frequency
        3 (7.29 GHz) or 4 (8.748 GHz), as the module is set.
    first_sample
        Where bin 0 lies in the chip's frame, (start - offset) / bin length modulo 96: 3 for the
        area from 0.2 m at the offset 0.18 m. With it lines and phases are the module's own. With 0,
        lines lie on bins 8 L, and all phases differ from the module's by the same constant.

    Returns
    -------
    Shape (..., n_lines). `line_bins` says which RF bins the lines lie on. Lines whose window does
    not lie inside the frame are left out: two at either end.

    Raises
    ------
    ValueError
        For an unknown setting, or frames too short for one line.

    Source: protocol reference 9.7 and 9.8.
    """
    samples = np.asarray(rf, dtype=np.float64)
    taps = _taps(tx_center_frequency)
    bins = line_bins(
        samples.shape[-1], tx_center_frequency=tx_center_frequency, first_sample=first_sample
    )
    start = int(bins[0]) - taps.lead_samples
    rows = len(bins) + TAP_COUNT // DECIMATION - 1
    # the windows overlap by three quarters: each is four neighbouring rows of eight samples
    eights = samples[..., start : start + rows * DECIMATION]
    eights = eights.reshape(*samples.shape[:-1], rows, DECIMATION)
    pair = (np.array(taps.i_taps) - 1j * np.array(taps.q_taps)) / taps.absolute_sum
    parts = pair.reshape(-1, DECIMATION)
    stacked = eights @ np.concatenate([parts.real, parts.imag]).T
    lines = np.zeros((*samples.shape[:-1], len(bins)), dtype=np.complex128)
    for row in range(len(parts)):
        part = stacked[..., row : row + len(bins), :]
        lines.real += part[..., row]
        lines.imag += part[..., row + len(parts)]
    if taps.line_sign < 0:
        first_line = (first_sample + int(bins[0])) // DECIMATION
        lines[..., 1 - first_line % 2 :: 2] *= -1
    return lines.astype(np.complex64)


def line_bins(
    n_bins: int, *, tx_center_frequency: int = 3, first_sample: int = 0
) -> NDArray[np.intp]:
    """Return the RF bins on which the lines of `downconvert` lie, shape (n_lines,).

    >>> line_bins(1431)[[0, 1, -1]].tolist()  # of 1431 RF bins: 175 lines
    [16, 24, 1408]
    """
    taps = _taps(tx_center_frequency)
    first = -(-(first_sample + taps.lead_samples) // DECIMATION) * DECIMATION - first_sample
    bins = np.arange(first, n_bins - (TAP_COUNT - taps.lead_samples) + 1, DECIMATION)
    if not len(bins):
        raise ValueError(f"{n_bins} bins: one line of baseband needs {TAP_COUNT} and more")
    return bins


def _taps(tx_center_frequency: int) -> ChannelTaps:
    if tx_center_frequency not in CHANNELS:
        raise ValueError(f"tx_center_frequency {tx_center_frequency}: must be 3 or 4")
    return CHANNELS[tx_center_frequency]
