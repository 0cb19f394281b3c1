"""Slow time: the frames of the last seconds, and their power by range and Doppler frequency.

| Matrix | Frames averaged | Pulses F | Window | Frequencies | Sent |
|---|---|---|---|---|---|
| slow | 4 | 85 | 340 frames, 19.94 s | +-2.1 Hz, step 0.050 Hz | every 85 frames, 4.99 s |
| fast | 1 | 34 | 34 frames, 1.99 s | +-8.5 Hz, step 0.501 Hz | every 17 frames, 0.997 s |

The slow window is the 20 s which a profile needs to start; all other numbers are ours, because the
reference gives none. Power is that of a complex tone: amplitude A at one of the frequencies reads
A**2, in the normalised units of baseband. What stands still is at 0 Hz and, through the Hann
window, at one step on either side. Approaching is positive, as the phase falls with range.

Source: protocol reference 4.6 and 7.2.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emulator.profiles.sweep import FRAME_RATE_HZ
from xethru_protocol.codes import MatrixInstance

__all__ = ["FAST", "MATRICES", "SLOW", "Matrix", "SlowTime"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Matrix:
    """One of the two pulse-Doppler matrices.

    Attributes
    ----------
    instance
        Its number on the wire.
    decimation
        Frames averaged to one pulse.
    pulses
        Pulses per transform, and frequencies.
    period
        Frames from one matrix sent to the next.
    notch
        Frequencies on either side of 0 Hz that detection leaves out.
    """

    instance: MatrixInstance
    decimation: int
    pulses: int
    period: int
    notch: int

    @property
    def frames(self) -> int:
        """Frames that fill it."""
        return self.decimation * self.pulses

    @property
    def rate_hz(self) -> float:
        """Rate of the pulses."""
        return FRAME_RATE_HZ / self.decimation

    @property
    def step_hz(self) -> float:
        """Step from one frequency to the next."""
        return self.rate_hz / self.pulses

    @property
    def start_hz(self) -> float:
        """Lowest frequency."""
        return -(self.pulses // 2) * self.step_hz

    @property
    def window(self) -> NDArray[np.float64]:
        """Hann window, shape (pulses,)."""
        angle = 2 * np.pi * np.arange(self.pulses) / self.pulses
        return np.asarray(0.5 - 0.5 * np.cos(angle), dtype=np.float64)

    @property
    def moving(self) -> NDArray[np.bool_]:
        """Which frequencies are movement, shape (pulses,)."""
        return np.abs(np.arange(self.pulses) - self.pulses // 2) > self.notch


SLOW = Matrix(instance=MatrixInstance.SLOW, decimation=4, pulses=85, period=85, notch=1)
FAST = Matrix(instance=MatrixInstance.FAST, decimation=1, pulses=34, period=17, notch=2)
MATRICES = (SLOW, FAST)


class SlowTime:
    """The newest pulses of one matrix."""

    def __init__(self, matrix: Matrix) -> None:
        self._matrix = matrix
        self._window = matrix.window[:, np.newaxis] / matrix.window.sum()
        self.clear()

    def clear(self) -> None:
        """Forget all frames."""
        self._pulses: deque[NDArray[np.complex128]] = deque(maxlen=self._matrix.pulses)
        self._sum: NDArray[np.complex128] | None = None
        self._summed = 0

    @property
    def full(self) -> bool:
        """Whether as many frames have come as the matrix needs."""
        return len(self._pulses) == self._matrix.pulses

    def add(self, iq: NDArray[np.complex128]) -> None:
        """Take one frame, shape (n_bins,)."""
        self._sum = iq if self._sum is None else self._sum + iq
        self._summed += 1
        if self._summed == self._matrix.decimation:
            self._pulses.append(self._sum / self._matrix.decimation)
            self._sum, self._summed = None, 0

    def pulses(self) -> NDArray[np.complex128]:
        """Return what is there, oldest first, shape (at most matrix.pulses, n_bins)."""
        return np.array(self._pulses)

    def power(self) -> NDArray[np.float64]:
        """Return the matrix, shape (n_bins, matrix.pulses), lowest frequency first."""
        spectrum = np.fft.fft(self.pulses() * self._window, axis=0)
        power = spectrum.real**2 + spectrum.imag**2
        return np.ascontiguousarray(np.fft.fftshift(power, axes=0).T)
