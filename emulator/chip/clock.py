"""The chip's and the module's clocks.

Its frame timer and its sampler run from one crystal (protocol reference 9.1). A clock that is
``ppm`` millionths fast counts 1 + ppm 1e-6 of its seconds in a true one, so what it takes for an
interval T is over after ``T / (1 + ppm 1e-6)``: its frames come early, and its bins are short.
The error is constant: temperature and ageing are left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from xethru_protocol.wire.x4 import frame_time_ns

NS_PER_S = 1_000_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class _Segment:
    first_counter: int
    start_ns: int
    rate_hz: float

    def time_ns(self, counter: int) -> int:
        return self.start_ns + frame_time_ns(counter - self.first_counter, self.rate_hz)


class Timeline:
    """Frame counters and their scene times since the last INIT.

    INIT makes counter 0 scene time 0. Within a segment of constant rate, counter k lies at
    ``start + frame_time_ns(k - first, rate)``; another rate begins a new segment at the next
    counter. A pause changes nothing: the counter goes on where it was.

    Attributes
    ----------
    next_counter
        Counter of the next frame; unbounded here, 32 bits on the wire.

    Examples
    --------
    >>> timeline = Timeline()
    >>> timeline.set_rate(100.0)
    >>> timeline.next_counter = 50
    >>> timeline.set_rate(40.0)
    >>> timeline.scene_time_ns(50), timeline.scene_time_ns(54)
    (500000000, 600000000)
    """

    def __init__(self) -> None:
        self._segment: _Segment | None = None
        self.next_counter = 0

    def set_rate(self, rate_hz: float) -> None:
        """Run at another real frame rate (> 0) from the next counter on."""
        old = self._segment
        if old is not None and old.rate_hz == rate_hz:
            return
        start_ns = 0 if old is None else old.time_ns(self.next_counter)
        self._segment = _Segment(
            first_counter=self.next_counter, start_ns=start_ns, rate_hz=rate_hz
        )

    def scene_time_ns(self, counter: int) -> int:
        """Return the scene time of a counter of the current segment, in ns."""
        return 0 if self._segment is None else self._segment.time_ns(counter)

    def skip_before(self, scene_time_ns: int) -> int:
        """Move on to the first counter not before a scene time; return how many were skipped."""
        segment = self._segment
        if segment is None or segment.time_ns(self.next_counter) >= scene_time_ns:
            return 0
        elapsed_ns = scene_time_ns - segment.start_ns
        counter = segment.first_counter + int(elapsed_ns * segment.rate_hz / NS_PER_S) - 1
        counter = max(counter, self.next_counter)
        while segment.time_ns(counter) < scene_time_ns:
            counter += 1
        skipped = counter - self.next_counter
        self.next_counter = counter
        return skipped


@dataclass(frozen=True, slots=True, kw_only=True)
class ModuleClock:
    """Nominal time of a counter to scene time, and back.

    Attributes
    ----------
    skew_ns
        Scene time at which the module takes the frame of nominal time 0.
    ppm
        How fast its clock is, in millionths; negative: slow.

    >>> ModuleClock(skew_ns=5, ppm=100.0).scene_time_ns(10_001_000_000)
    10000000005
    """

    skew_ns: int = 0
    ppm: float = 0.0

    @property
    def rate(self) -> float:
        """Return the module's seconds per true second."""
        return 1.0 + self.ppm * 1e-6

    def scene_times_ns(self, nominal_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the true times of frames, shape (n,), int64, from the module's own."""
        early = np.rint(nominal_ns * self._lead).astype(np.int64)
        times: NDArray[np.int64] = nominal_ns - early + self.skew_ns
        return times

    def scene_time_ns(self, nominal_ns: int) -> int:
        return nominal_ns - round(nominal_ns * self._lead) + self.skew_ns

    def nominal_ns(self, scene_time_ns: int) -> int:
        """Return what the module's clock shows at a scene time, to within 1 ns."""
        elapsed_ns = scene_time_ns - self.skew_ns
        return elapsed_ns + round(elapsed_ns * (self.ppm * 1e-6))

    @property
    def _lead(self) -> float:
        """By how much a frame comes early, of its nominal time; a difference keeps 0 ppm exact."""
        return self.ppm * 1e-6 / self.rate
