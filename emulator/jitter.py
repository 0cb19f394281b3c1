"""Jitter of the carrier's phase, common to all echoes of a frame: a white and a slow part.

The sampler's clock trembles against the transmitter's: every echo of a frame, and the leakage, are
turned by the same phase. White jitter is a new normal for every frame counter; slow jitter is a
stationary process of scene time (``emulator.slow_noise``) that falls to 1/e after the scene's
``slow_correlation_s``. At 7.29 GHz one radian is 3.3 mm of range; the envelope is not moved, which
for 0.03 rad would be 0.1 mm. Amplitude jitter, and jitter within a sweep, are left out.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from emulator.noise import Purpose, counter_normals, stream_of
from emulator.scene_tables import JitterSpec
from emulator.slow_noise import SPACINGS_PER_E_FOLD, KnotGrid, SlowNoise

__all__ = ["CarrierJitter"]

_INSTANTS_PER_KNOT = 16
_MOST_INSTANTS_KEPT = 64
_COUNTERS_AT_ONCE = 256


class CarrierJitter:
    """The jitter of one radar.

    Parameters
    ----------
    spec
        Standard deviations and correlation time.
    seed, serial
        The run's seed and the module's serial number: they select the jitter.
    """

    def __init__(self, spec: JitterSpec, *, seed: int, serial: int) -> None:
        self._spec = spec
        self._seed = seed
        self._white = stream_of(serial, Purpose.JITTER_WHITE)
        spacing_s = spec.slow_correlation_s / SPACINGS_PER_E_FOLD
        self._slow = SlowNoise(
            (KnotGrid(spacing_ns=round(spacing_s * 1e9), sigma=spec.slow_rad),),
            1,
            instants_per_knot=_INSTANTS_PER_KNOT,
            seed=seed,
            serial=serial,
            purpose=Purpose.JITTER_SLOW,
        )
        self._slow_rad: dict[int, float] = {}
        self._page = -1
        self._normals: list[float] = []

    def phases_rad(
        self, frame_counters: NDArray[np.int64], scene_times_ns: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Return what to add to the carrier's phase of every echo of each frame.

        Parameters
        ----------
        frame_counters
            Shape (n_frames,), int64; they select the white part.
        scene_times_ns
            Shape (n_frames,), int64: when this radar truly took each frame.

        Returns
        -------
        Shape (n_frames,), float64, rad.
        """
        white = [0.0] * len(frame_counters)
        if self._spec.white_rad > 0:
            white = [self._white_at(counter) for counter in frame_counters.tolist()]
        slow = [0.0] * len(frame_counters)
        if self._spec.slow_rad > 0:
            slow = [self._slow_at(time_ns) for time_ns in scene_times_ns.tolist()]
        phases_rad: NDArray[np.float64] = np.array(white) * self._spec.white_rad + np.array(slow)
        return phases_rad

    def _slow_at(self, time_ns: int) -> float:
        instant, fraction = self._slow.instant_before(time_ns)
        before = self._slow_rad_at(instant)
        return before + fraction * (self._slow_rad_at(instant + 1) - before)

    def _white_at(self, counter: int) -> float:
        """Return the normal of a counter; made for many at once, since frames come one by one."""
        page, place = divmod(counter, _COUNTERS_AT_ONCE)
        if page != self._page:
            counters = page * _COUNTERS_AT_ONCE + np.arange(_COUNTERS_AT_ONCE, dtype=np.int64)
            normals = counter_normals(counters, seed=self._seed, stream=self._white)
            self._page, self._normals = page, normals.tolist()
        return self._normals[place]

    def _slow_rad_at(self, instant: int) -> float:
        if instant not in self._slow_rad:
            if len(self._slow_rad) > _MOST_INSTANTS_KEPT:
                self._slow_rad.clear()
            self._slow_rad[instant] = float(self._slow.values_at(instant)[0])
        return self._slow_rad[instant]
