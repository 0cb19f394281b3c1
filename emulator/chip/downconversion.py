"""Digital downconversion of the X4: RF counters to complex baseband lines, in exact integers.

Two signed 6-bit tap sets multiply every window of 32 RF samples and every 8th result is kept.
Eight samples are 2.5 carrier cycles at 7.29 GHz, so every other line is negated; they are 3 cycles
at 8.748 GHz, so no line is. Either way the carrier's phase reference is continuous from line to
line.

The taps are ours: a Hamming window of 30 (28) samples times the carrier at 45 degrees, rounded to
integers whose sum is zero (no DC) and whose absolute sum is the chip's 306 (316). The Q taps are
the I taps reversed, which makes them the quadrature carrier.

Compensation chosen: line L is centred on the RF sample that carries its range label, sample 8 L
(window 8 L - 16 ... 8 L + 15, centre half a sample or 3.2 mm early), so a target appears at its
labelled range. Whether hardware compensates the filter delay is not known.

Source: protocol reference 9.7 and 9.8.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xethru_protocol.wire.x4 import BASEBAND_DECIMATION

TAP_COUNT = 32
LEAD_SAMPLES = 16
"""RF samples that the window of line L reaches before sample 8 L."""

# fmt: off
_I_TAPS_7290_MHZ = (
    0, -2, 2, 1, -5, 4, 5, -12, 3, 16, -18, -4, 26, -16, -16, 30,
    -6, -25, 24, 5, -24, 12, 11, -15, 2, 8, -6, -1, 4, -2, -1, 0,
)
_I_TAPS_8748_MHZ = (
    0, 0, 2, -3, 1, 2, -8, 11, -6, -7, 21, -24, 11, 12, -30, 30,
    -13, -12, 28, -26, 9, 9, -17, 14, -5, -3, 6, -4, 1, 1, 0, 0,
)
# fmt: on


@dataclass(frozen=True, slots=True, kw_only=True)
class ChannelTaps:
    """Filter of one transmitter centre frequency.

    Attributes
    ----------
    i_taps
        32 signed 6-bit integers of the I channel; Q uses them reversed.
    line_sign
        Factor between the taps of one line and the next, +1 or -1.
    """

    i_taps: tuple[int, ...]
    line_sign: int

    @property
    def absolute_sum(self) -> int:
        """The S of protocol reference 9.7, by which baseband values are divided."""
        return sum(abs(tap) for tap in self.i_taps)


CHANNELS = {
    3: ChannelTaps(i_taps=_I_TAPS_7290_MHZ, line_sign=-1),
    4: ChannelTaps(i_taps=_I_TAPS_8748_MHZ, line_sign=+1),
}
"""Taps by TXCENTERFREQUENCY setting."""


def downconvert(
    rf_counters: NDArray[np.int64], taps: ChannelTaps, first_line: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Filter and decimate RF counters into raw I and Q lines.

    Parameters
    ----------
    rf_counters
        Shape (n_frames, 8 * (n_lines - 1) + 32), int64; sample 0 lies
        ``LEAD_SAMPLES`` before the RF sample of the first line.
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
    lines = windows @ np.array([taps.i_taps, taps.i_taps[::-1]], dtype=np.int64).T
    signs = np.array([taps.line_sign**parity for parity in (0, 1)], dtype=np.int64)
    lines *= signs[(first_line + np.arange(lines.shape[1])) % 2][:, np.newaxis]
    return lines[:, :, 0], lines[:, :, 1]
