"""The seam between the X4 chip model and the echo physics: settings in, integer chip counters out.

The chip (``emulator.chip``) knows settings, counters and time; a source knows the world.
Neither imports the other: both import this file.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = ["CaptureSettings", "EchoSource"]


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
    iterations
        Sweeps summed per frame.
    pulses_per_step
        Pulses per DAC step.
    dac_min
        Lowest DAC level of the sweep, 0...2047.
    dac_max
        Highest DAC level of the sweep, 0...2047.
    dac_step
        Exponent of the DAC step size, 2**dac_step.
    tx_power
        Transmitter power setting, 0 (off)...3.
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

        The result depends on the arguments and the source's own scene and seed alone: never on
        the block size, the order of calls or the wall clock.

        Parameters
        ----------
        capture
            Settings the frames are sampled with.
        frame_counters
            Shape (n_frames,), the frames' counters; they select the noise.
        scene_times_ns
            Shape (n_frames,), int64, [ns]: nominal scene time of each counter, without the
            radar's start skew and clock error (which the source adds itself).

        Returns
        -------
        Shape (n_frames, n_samples), int64, clipped to [0, largest counter].
        """
        ...
