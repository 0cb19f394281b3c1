"""Digital downconversion of the X4: RF counters to complex baseband lines, in exact integers.

The vendor's driver loads two sets of signed 6-bit taps; the chip multiplies every window of 32 RF
samples by them, uses the sets in turn, and keeps every 8th result. Eight samples are 2.5 carrier
cycles at 7.29 GHz, so the second set is the first one negated; they are 3 cycles at 8.748 GHz, so
both sets are equal. Either way the carrier's phase reference is continuous from line to line.

Compensation chosen: line L is centred on the RF sample that carries its range label, sample 8 L,
but for half a sample or 3.2 mm, so a target appears at its labelled range. Whether hardware
compensates the filter's delay, and which of the sets it begins with, is not known.

Source: protocol reference 9.7 and 9.8.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xethru_protocol.wire.x4 import BASEBAND_DECIMATION

TAP_COUNT = 32


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
    rf_counters: NDArray[np.int64], taps: ChannelTaps, first_line: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Filter and decimate RF counters into raw I and Q lines.

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
    (n_frames, n_lines), int64.
    """
    windows = np.lib.stride_tricks.sliding_window_view(rf_counters, TAP_COUNT, axis=1)
    windows = windows[:, ::BASEBAND_DECIMATION]
    # integer matrix products never reach BLAS: exact and the same on every machine
    lines = windows @ np.array([taps.i_taps, taps.q_taps], dtype=np.int64).T
    signs = np.array([taps.line_sign**parity for parity in (0, 1)], dtype=np.int64)
    lines *= signs[(first_line + np.arange(lines.shape[1])) % 2][:, np.newaxis]
    return lines[:, :, 0], lines[:, :, 1]
