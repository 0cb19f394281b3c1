"""Frame rates that a line carries."""

from __future__ import annotations

import math

__all__ = ["carried_rate_hz"]

RF_FRAME_BYTES = 5747  # 1431 bins (Protocol reference 9.5)
_SHARE = 0.8  # of a UART; the rest is for answers


def carried_rate_hz(wanted_hz: float, bytes_per_s: float) -> float:
    """Return the frame rate that a test asks for, or what a UART carries of 1431 bins, whole Hz.

    >>> carried_rate_hz(17.0, math.inf), carried_rate_hz(17.0, 11520.0)
    (17.0, 1.0)
    """
    if math.isinf(bytes_per_s):
        return wanted_hz
    return min(wanted_hz, float(max(math.floor(bytes_per_s * _SHARE / RF_FRAME_BYTES), 1)))
