"""Frames of radars on real ports: read in threads, and put together into scans by ticks.

Threads put events into one queue; the main loop reads that queue only. A radar that falls silent
or vanishes is looked for until it is back or the run ends. The queue holds `MOST_EVENTS`; when it
is full, the threads wait, and what sources and modules cannot hold meanwhile is lost and counted.

Ticks are frame periods of session time. A tick is complete when every radar that is not lost has
sent a frame of it or a later one, and odometry has come past it; or when waiting longer would not
make it more complete. `TickAssembler` reads no clock: time is an argument, so tests run it in
virtual time.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from queue import Full, Queue
from typing import Literal, NamedTuple, Protocol, TypeAlias

from slam.frames import RadarFrame
from slam.live.frame_sources import RadarLink
from slam.live.odometry_track import NS_PER_S
from slam.live.session_records import Scan
from xethru_protocol.driver.frames import Frame
from xethru_protocol.driver.matching import ProtocolRecord
from xethru_protocol.validation import reason_of
from xethru_protocol.wire.errors import ResponseTimeout, XeThruError

SourceEvent: TypeAlias = (
    tuple[Literal["frame"], int, Frame]
    | tuple[Literal["lost", "back"], int, str]
    | tuple[Literal["link"], str, ProtocolRecord]
    | tuple[Literal["wire"], str, Literal["rx", "tx"], bytes, int]
    | tuple[Literal["odometry line"], str, int]
    | tuple[Literal["odometry end"], str]
)
"""What threads hand to the main loop, by its first item.

- "frame": the radar's index in the rig, and the frame;
- "lost", "back": the radar's index, and why it is lost, or its new port;
- "link": the radar's name, and a line of its protocol log;
- "wire": the radar's name, way, bytes and host time of what went over its port;
- "odometry line": its text, and the host's monotonic time of its arrival;
- "odometry end": why no more lines will come, "" if the source just ended.
"""

MOST_EVENTS = 20_000
"""At 5 frames/s of four radars half an hour of frames, 0.1 GB: no step of SLAM takes so long."""


class Inbox(Queue[SourceEvent]):
    """What waits for the main loop, `MOST_EVENTS` at most.

    Attributes
    ----------
    n_refused
        Events of `offer` that found no room.
    """

    def __init__(self, most: int = MOST_EVENTS) -> None:
        super().__init__(most)
        self.n_refused = 0

    def hand_over(self, event: SourceEvent, stopped: threading.Event) -> None:
        """Put an event, waiting for room; drop it if the reading is stopped meanwhile."""
        while not stopped.is_set():
            try:
                self.put(event, timeout=_POLL_S)
            except Full:
                continue
            return

    def offer(self, event: SourceEvent) -> None:
        """Put an event if there is room; from a driver's callback, which must not wait."""
        try:
            self.put_nowait(event)
        except Full:
            self.n_refused += 1


Reader: TypeAlias = Callable[[Inbox, threading.Event], None]
"""Puts what it reads into the inbox until the event is set."""

SETTLE_S = 2.0
"""How long frames are read before the first scan, so that clocks are known."""
SILENT_RIG_S = 10.0
"""Without any radar for so long, a run ends."""
SILENCE_S = 3.0
"""Many frame periods; a module that sends nothing for so long has stopped streaming."""
_POLL_S = 0.2
_LOOK_S = 2.0
_LOOK_AGAIN_S = 1.0
_JOIN_S = 10.0
"""More than a look for a module takes; a thread that still reads then hangs in the system."""


@contextmanager
def reading(
    links: Sequence[RadarLink], inbox: Inbox, **others: Reader
) -> Iterator[Callable[[], None]]:
    """Read every radar, in the order of the rig, and others by name, each in a thread of its own.

    The drivers belong to the threads, which close them at their end. Yields what ends the threads
    early: stopping four modules one by one, or one that does not answer, takes seconds.
    """
    stopped = threading.Event()
    threads = [
        threading.Thread(
            target=_read_radar,
            args=(index, link, inbox, stopped),
            name=f"radar {link.mount.name}",
            daemon=True,
        )
        for index, link in enumerate(links)
    ]
    threads += [
        threading.Thread(target=read, args=(inbox, stopped), name=name, daemon=True)
        for name, read in others.items()
    ]
    for thread in threads:
        thread.start()
    try:
        yield stopped.set
    finally:
        stopped.set()
        give_up = time.monotonic() + _JOIN_S
        for thread in threads:
            thread.join(max(give_up - time.monotonic(), 0.0))


def _read_radar(radar: int, link: RadarLink, inbox: Inbox, stopped: threading.Event) -> None:
    received_s = time.monotonic()
    try:
        while not stopped.is_set():
            trouble = ""
            try:
                inbox.hand_over(("frame", radar, link.driver.read_frame(_POLL_S)), stopped)
                received_s = time.monotonic()
            except ResponseTimeout:
                if time.monotonic() - received_s > SILENCE_S:
                    trouble = f"no frame for {SILENCE_S:g} s"
            except XeThruError as error:
                trouble = str(error)
            if trouble:
                inbox.hand_over(("lost", radar, trouble), stopped)
                if _found_again(link, stopped):
                    inbox.hand_over(("back", radar, link.driver.port), stopped)
                received_s = time.monotonic()
    except Exception as error:  # a bug: reported, so that no radar is lost silently
        inbox.hand_over(("lost", radar, f"its reader failed: {reason_of(error)}"), stopped)
        raise
    finally:
        with suppress(XeThruError):  # what is wrong with it was reported
            link.driver.close()


def _found_again(link: RadarLink, stopped: threading.Event) -> bool:
    while not stopped.is_set():
        try:
            link.driver.reconnect(_LOOK_S)
        except XeThruError:
            stopped.wait(_LOOK_AGAIN_S)
        else:
            return True
    return False


GRACE_NS = NS_PER_S // 2
"""How long a tick waits for a radar that has not sent its frame yet."""
ODOMETRY_WAIT_NS = NS_PER_S
"""How long a tick waits for odometry; then its frames are recorded and not used."""
MOST_WAIT_NS = 2 * NS_PER_S
"""A scan that waited for SLAM longer, since its period was over and its last frame had come, is
recorded and not used. A second of it may be the wait for odometry."""
EARLY_NS = NS_PER_S
"""So much of the newest frames is kept before the first tick."""


class _WaitingFrame(NamedTuple):
    """A frame that waits; it came at `host_ns` since 1970, and `came_ns` by session time."""

    frame: RadarFrame
    host_ns: int
    came_ns: int


class Coverage(Protocol):
    """Until when the poses of the wheels are known, by session time [ns]."""

    ended: bool

    def covers(self, t_ns: int) -> bool: ...

    def is_known(self, t_ns: int) -> bool: ...


class TickAssembler:
    """Gives out scans in the order of time; `odometry` limits which ticks are complete.

    Attributes
    ----------
    alive
        Indices of the radars that are not lost.
    start_ns
        Session time of tick 0; None before `begin`.
    wait_ns
        How long the newest scan given out had waited for SLAM.
    n_unused
        Scans given out that SLAM must not use.
    n_dropped
        Those of them that waited too long for SLAM.
    n_left_out
        Frames that came too late for SLAM, given out in scans that it must not use.
    ended
        Whether odometry ended, and the ticks have come there.
    """

    def __init__(self, n_radars: int, period_ns: int, odometry: Coverage) -> None:
        self._odometry = odometry
        self._period_ns = period_ns
        self._waiting: list[deque[_WaitingFrame]] = [deque() for _ in range(n_radars)]
        self._tick = 0
        self.alive = set(range(n_radars))
        self._all_lost_ns: int | None = None
        self.start_ns: int | None = None
        self.wait_ns = 0
        self.n_unused = self.n_dropped = self.n_left_out = 0
        self.ended = False

    def begin(self, start_ns: int) -> None:
        """Let tick 0 begin at a session time; frames before it are dropped."""
        self.start_ns = start_ns
        self._forget_before(start_ns)

    def take(self, frame: RadarFrame, host_ns: int, came_ns: int) -> None:
        """Take a frame; the frames of one radar come in the order of time.

        It came at `host_ns` since 1970, and `came_ns` by session time.
        """
        self._waiting[frame.radar].append(_WaitingFrame(frame, host_ns, came_ns))
        if self.start_ns is None:
            self._forget_before(frame.t_ns - EARLY_NS)

    def silence(self, now_ns: int) -> str:
        """Return why no more frames can be expected, "" if they can; host time, asked often."""
        if self.alive or self._all_lost_ns is None:
            self._all_lost_ns = None if self.alive else now_ns
        elif now_ns - self._all_lost_ns > SILENT_RIG_S * NS_PER_S:
            return f"no radar for {SILENT_RIG_S:g} s"
        return ""

    def _forget_before(self, t_ns: int) -> None:
        for queue in self._waiting:
            while queue and queue[0].frame.t_ns < t_ns:
                queue.popleft()

    def next_scan(self, now_ns: int, *, is_over: bool = False) -> Scan | None:
        """Return the next scan if it is complete at a session time, else None.

        When the run `is_over`, nothing more comes: what waits of the ticks before `now_ns` is given
        out, and SLAM must not use it.
        """
        if self.start_ns is None:
            return None
        while True:
            begin_ns = self.start_ns + self._tick * self._period_ns
            end_ns = begin_ns + self._period_ns
            late = self._late(begin_ns, end_ns)
            if late:
                self.n_left_out += len(late)
                return self._scan(late, begin_ns, used=False)
            received = [q[0] for q in self._waiting if q and q[0].frame.t_ns < end_ns]
            stamps_ns = [begin_ns, *(one.frame.t_ns for one in received)]
            if is_over:
                if end_ns > now_ns or not any(self._waiting):
                    return None
            else:
                self.ended = self._odometry.ended and not self._odometry.covers(begin_ns)
                if self.ended or self._may_get_more(bool(received), max(stamps_ns), end_ns, now_ns):
                    return None
            if received:
                break
            # to the oldest frame, or the first tick that may still get some: there are billions of
            # empty ones if odometry's clock is set from 1970
            heads_ns = [queue[0].frame.t_ns for queue in self._waiting if queue]
            next_ns = min([now_ns - GRACE_NS, *heads_ns])
            self._tick = max(self._tick + 1, (next_ns - self.start_ns) // self._period_ns)
        for one in received:
            self._waiting[one.frame.radar].popleft()
        self.wait_ns = now_ns - max([end_ns, *(one.came_ns for one in received)])
        used = not is_over and all(map(self._odometry.is_known, stamps_ns))
        if used and self.wait_ns > MOST_WAIT_NS:
            self.n_dropped += 1
            used = False
        scan = self._scan(received, begin_ns, used=used)
        self._tick += 1
        return scan

    def _may_get_more(self, has_frames: bool, needed_ns: int, end_ns: int, now_ns: int) -> bool:
        """Return whether a tick may get more frames, or odometry for them."""
        missing = not self.alive or any(not self._waiting[radar] for radar in self.alive)
        if missing and now_ns < end_ns + GRACE_NS:
            return True
        if not has_frames:
            return now_ns < end_ns
        if self._odometry.covers(needed_ns) or self._odometry.ended:
            return False
        return now_ns < needed_ns + ODOMETRY_WAIT_NS

    def _scan(self, received: Sequence[_WaitingFrame], t_ns: int, *, used: bool) -> Scan:
        self.n_unused += not used
        return Scan(
            counter=self._tick,
            t_ns=t_ns,
            frames=tuple(one.frame for one in received),
            host_ns=tuple(one.host_ns for one in received),
            used=used,
        )

    def _late(self, begin_ns: int, end_ns: int) -> Sequence[_WaitingFrame]:
        """Take the oldest frame of every radar that is too old for a tick.

        Too old is by more than a whole period, or by a quarter of one if a newer frame of the tick
        is there: after a stall of a line, or once in hours if a module's clock is fast. Frames that
        are late by less, from jitter about a tick's bounds, count.
        """
        late = []
        for queue in self._waiting:
            age_ns = begin_ns - queue[0].frame.t_ns if queue else 0
            has_newer = len(queue) > 1 and queue[1].frame.t_ns < end_ns
            if age_ns > (self._period_ns // 4 if has_newer else self._period_ns):
                late.append(queue.popleft())
        return late
