"""The radar of a running profile: which frames it takes, and their geometry.

The profile drives the X4 with the sensor's working point: 17 frames/s of baseband over the
detection zone and one bin more at either end. The profile's chip is a model of its own, so the
X4 commands of a host neither see nor disturb it (assumed; on hardware they would disturb it).

Source: protocol reference 7.1, 8.3 and 9.3.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from emulator.chip import Chip
from emulator.echo_source import EchoSource
from xethru_protocol import x4
from xethru_protocol.codes import X4Setting
from xethru_protocol.messages import X4Value

__all__ = ["FRAMES_PER_TICK", "FRAME_RATE_HZ", "ProfileSweep"]

REQUESTED_FPS = 17.0
FRAME_RATE_HZ = x4.real_frame_rate(REQUESTED_FPS)
"""What the chip's timer makes of 17 frames per second: 17.049 Hz."""
FRAMES_PER_TICK = 17
"""Frames from one presence message to the next: 0.997 s."""

_WORKING_POINT: dict[X4Setting, X4Value] = {
    X4Setting.DACMIN: 949,
    X4Setting.DACMAX: 1100,
    X4Setting.ITERATIONS: 16,
    X4Setting.PULSESPERSTEP: 300,
    X4Setting.TXPOWER: 2,
    X4Setting.DOWNCONVERSION: 1,
    X4Setting.FPS: REQUESTED_FPS,
}


class ProfileSweep:
    """Baseband frames of one zone, each selected by its counter.

    Parameters
    ----------
    source
        What the radar sees.
    zone_m
        Detection zone, start and end, on the grid of the bins [module metres].
    tx_center_frequency
        Band, 3 or 4.
    largest_block
        Most frames synthesised at once.

    Attributes
    ----------
    range_m
        Shape (n_bins,), float64: range of each bin [module metres].
    in_zone
        Shape (n_bins,), bool: the bins inside the zone.
    carrier_hz
        Centre frequency of the band.
    """

    def __init__(
        self,
        source: EchoSource,
        *,
        zone_m: tuple[float, float],
        tx_center_frequency: int,
        largest_block: int,
    ) -> None:
        self._chip = Chip(source, largest_block)
        start_m, end_m = zone_m
        margin_m = x4.BASEBAND_BIN_M
        for setting, value in _WORKING_POINT.items():
            self._chip.set(setting, value)
        self._chip.set(X4Setting.TXCENTERFREQUENCY, tx_center_frequency)
        self._chip.set(X4Setting.FRAMEAREA, (start_m - margin_m, end_m + margin_m))
        area = self._chip.area
        bins = np.arange(area.n_bins, dtype=np.float64)
        self.range_m: NDArray[np.float64] = area.start_m + bins * x4.BASEBAND_BIN_M
        tolerance_m = x4.BASEBAND_BIN_M / 2
        self.in_zone: NDArray[np.bool_] = (self.range_m > start_m - tolerance_m) & (
            self.range_m < end_m + tolerance_m
        )
        self.tx_center_frequency = tx_center_frequency
        self.carrier_hz = x4.CARRIER_HZ[tx_center_frequency]

    @property
    def n_bins(self) -> int:
        """Bins per frame."""
        return len(self.range_m)

    def scene_time_ns(self, counter: int) -> int:
        """Return the scene time of a frame, ns."""
        return self._chip.timeline.scene_time_ns(counter)

    def first_counter_from(self, scene_time_ns: int) -> int:
        """Return the first counter that does not lie before a scene time."""
        timeline = self._chip.timeline
        timeline.next_counter = 0
        timeline.skip_before(scene_time_ns)
        return timeline.next_counter

    def frame(self, counter: int) -> NDArray[np.complex128]:
        """Return I + jQ of one frame, shape (n_bins,); float32 values, exactly."""
        self._chip.timeline.next_counter = counter
        values = self._chip.next_frame().values.astype(np.float64)
        iq: NDArray[np.complex128] = values[: self.n_bins] + 1j * values[self.n_bins :]
        return iq
