"""Baseband frames of a profile as messages: in-phase and quadrature, or amplitude and phase.

Source: protocol reference 7.1; amplitude, not power, as 11 row 23 assumes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from emulator.profiles.sweep import ProfileSweep
from xethru_protocol import x4
from xethru_protocol.messages import BasebandAp, BasebandIq

__all__ = ["baseband_ap", "baseband_iq"]


def baseband_iq(
    sweep: ProfileSweep, counter: int, iq: NDArray[np.complex128], sampling_hz: float
) -> BasebandIq:
    """Return a frame as I and Q; ``sampling_hz`` fills the sampling frequency's field."""
    return BasebandIq(
        counter=counter & 0xFFFFFFFF,
        num_bins=sweep.n_bins,
        bin_length_m=x4.BASEBAND_BIN_M,
        sampling_frequency_hz=sampling_hz,
        carrier_frequency_hz=sweep.carrier_hz,
        range_offset_m=float(sweep.range_m[0]),
        i=iq.real.astype(np.float32),
        q=iq.imag.astype(np.float32),
    )


def baseband_ap(
    sweep: ProfileSweep, counter: int, iq: NDArray[np.complex128], sampling_hz: float
) -> BasebandAp:
    """Return a frame as amplitude and phase [rad, -pi ... pi]; see `baseband_iq`."""
    return BasebandAp(
        counter=counter & 0xFFFFFFFF,
        num_bins=sweep.n_bins,
        bin_length_m=x4.BASEBAND_BIN_M,
        sampling_frequency_hz=sampling_hz,
        carrier_frequency_hz=sweep.carrier_hz,
        range_offset_m=float(sweep.range_m[0]),
        amplitude=np.hypot(iq.real, iq.imag).astype(np.float32),
        phase=np.arctan2(iq.imag, iq.real).astype(np.float32),
    )
