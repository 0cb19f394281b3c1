"""The chip's clock: which frame counter belongs to which scene time, in segments of one rate."""

from __future__ import annotations

from dataclasses import dataclass

from xethru_protocol.x4 import frame_time_ns

__all__ = ["Timeline"]

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
