"""Frames of unsynchronised radars, stamped one by one, as scans of one tick each.

Ticks are frame periods of session time. A tick is complete when every radar that is alive has
sent a frame of it or a later one, and odometry has come past it; or when waiting longer would
help nobody. No clock is read here: time is an argument, so all of it runs in virtual time, too.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from slam.app.odometry_live import LiveOdometry
from slam.app.session import Scan
from slam.app.tum import NS_PER_S
from slam.frames import RadarFrame

GRACE_NS = NS_PER_S // 2
"""How long a tick waits for a radar that has not sent its frame yet."""
ODOMETRY_PATIENCE_NS = NS_PER_S
"""How long a tick waits for odometry; then its frames are recorded and not used."""
MOST_LAG_NS = 10 * NS_PER_S
"""When SLAM is later than that, scans are recorded and not used until it has caught up."""
CAUGHT_UP_NS = NS_PER_S


@dataclass(frozen=True, slots=True, kw_only=True)
class ReceivedFrame:
    """A frame with session time, and when it arrived, nanoseconds since 1970."""

    frame: RadarFrame
    host_ns: int


class TickAssembler:
    """Gives out scans in the order of time.

    Parameters
    ----------
    n_radars
        Radars of the rig.
    period_ns
        Of their frames.
    odometry
        Asked how far it has come.

    Attributes
    ----------
    start_ns
        Session time of tick 0; None before `begin`.
    lag_ns
        How long ago the newest tick given out was over.
    n_unused, n_late
        Scans given out that SLAM must not use; those among them for which it was too late.
    n_left_out
        Frames that came too late for SLAM, given out in scans that it must not use.
    ended
        Whether odometry ended, and the ticks have come there.
    """

    def __init__(self, n_radars: int, period_ns: int, odometry: LiveOdometry) -> None:
        self._odometry = odometry
        self._period_ns = period_ns
        self._waiting: list[deque[ReceivedFrame]] = [deque() for _ in range(n_radars)]
        self._alive = set(range(n_radars))
        self._tick = 0
        self._is_late = False
        self.start_ns: int | None = None
        self.lag_ns = 0
        self.n_unused = self.n_late = self.n_left_out = 0
        self.ended = False

    @property
    def alive(self) -> frozenset[int]:
        """Radars that are not lost."""
        return frozenset(self._alive)

    def begin(self, start_ns: int) -> None:
        """Let tick 0 begin at a session time; frames before it are forgotten."""
        self.start_ns = start_ns
        for queue in self._waiting:
            while queue and queue[0].frame.t_ns < start_ns:
                queue.popleft()

    def take(self, received: ReceivedFrame) -> None:
        """Take a frame; those of one radar come in the order of time."""
        self._waiting[received.frame.radar].append(received)

    def lost(self, radar: int) -> None:
        """Wait for this radar no more."""
        self._alive.discard(radar)

    def back(self, radar: int) -> None:
        """Wait for it again."""
        self._alive.add(radar)

    def next_scan(self, now_ns: int) -> Scan | None:
        """Return the next scan that is complete at a session time, None if none is yet."""
        if self.start_ns is None:
            return None
        while True:
            begin_ns = self.start_ns + self._tick * self._period_ns
            end_ns = begin_ns + self._period_ns
            late = self._late(begin_ns, end_ns)
            if late:
                self.n_left_out += len(late)
                return self._scan(late, begin_ns, used=False)
            self.ended = self._odometry.ended and not self._odometry.covers(begin_ns)
            received = self._of_tick(end_ns)
            stamps_ns = [begin_ns, *(row.frame.t_ns for row in received)]
            if self.ended or self._may_get_more(received, max(stamps_ns), end_ns, now_ns):
                return None
            if received:
                break
            self._tick = max(self._tick + 1, self._next_with_something(now_ns))
        for row in received:
            self._waiting[row.frame.radar].popleft()
        self._note_lag(now_ns - end_ns)
        used = not self._is_late and all(map(self._odometry.is_known, stamps_ns))
        self.n_late += self._is_late
        scan = self._scan(received, begin_ns, used=used)
        self._tick += 1
        return scan

    def _next_with_something(self, now_ns: int) -> int:
        """Return the tick of the oldest frame, or the first one that may still get some.

        Those before it are empty; there are billions where odometry's clock was set from 1970.
        """
        assert self.start_ns is not None
        heads_ns = [queue[0].frame.t_ns for queue in self._waiting if queue]
        return (min([now_ns - GRACE_NS, *heads_ns]) - self.start_ns) // self._period_ns

    def _may_get_more(
        self, received: Sequence[ReceivedFrame], needed_ns: int, end_ns: int, now_ns: int
    ) -> bool:
        """Return whether waiting makes a tick more complete: by a radar, or by odometry."""
        missing = not self._alive or any(not self._waiting[radar] for radar in self._alive)
        if missing and now_ns < end_ns + GRACE_NS:
            return True
        if not received:
            return now_ns < end_ns
        if self._odometry.covers(needed_ns) or self._odometry.ended:
            return False
        return now_ns < needed_ns + ODOMETRY_PATIENCE_NS

    def _scan(self, received: Sequence[ReceivedFrame], t_ns: int, *, used: bool) -> Scan:
        self.n_unused += not used
        return Scan(
            counter=self._tick,
            t_ns=t_ns,
            frames=tuple(row.frame for row in received),
            host_ns=tuple(row.host_ns for row in received),
            used=used,
        )

    def _late(self, begin_ns: int, end_ns: int) -> Sequence[ReceivedFrame]:
        """Take the oldest frame of every radar that is too old for a tick.

        It is, if it is older than a whole period, or than a quarter of one where a newer one of
        the tick is there: after a stall of a line, or once in hours where a module's clock is
        fast. By less, jitter about a tick's bounds makes frames old; they count.
        """
        late = []
        for queue in self._waiting:
            age_ns = begin_ns - queue[0].frame.t_ns if queue else 0
            has_newer = len(queue) > 1 and queue[1].frame.t_ns < end_ns
            if age_ns > (self._period_ns // 4 if has_newer else self._period_ns):
                late.append(queue.popleft())
        return late

    def _of_tick(self, end_ns: int) -> Sequence[ReceivedFrame]:
        """Return the oldest frame of every radar, if it was taken before the tick's end."""
        return [q[0] for q in self._waiting if q and q[0].frame.t_ns < end_ns]

    def _note_lag(self, lag_ns: int) -> None:
        self.lag_ns = lag_ns
        if self._is_late:
            self._is_late = lag_ns > CAUGHT_UP_NS
        else:
            self._is_late = lag_ns > MOST_LAG_NS
