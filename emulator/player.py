"""A recording played at an emulated module's port, message by message and byte-exact.

Playing begins anew for every host that opens the port: at once when it starts the radar (FPS > 0
or SETMODE RUN), else after half a second without a command, so that a host that only listens has
had time to flush its side. It ends when the last host has closed the port. Meanwhile the module
answers every command like any other; FPS, mode and geometry settings are acknowledged and change
nothing about what is played. Nothing is dropped: a host that reads slowly makes the recording
wait. A host that only asks something and leaves within half a second hears none of it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from xethru_protocol.codes import SensorMode, X4Setting
from xethru_protocol.messages import Command, Response, SetMode, X4DriverSet

__all__ = ["PlayStream", "TimedMessage", "schedule"]

NS_PER_S = 1_000_000_000
QUIET_NS = NS_PER_S // 2
NOMINAL_PERIOD_NS = NS_PER_S // 17
"""Spacing of records that carry no time: the profile's nominal 17 messages per second."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TimedMessage:
    """A message and its time since the first one of the recording, ns."""

    time_ns: int
    message: Response


def schedule(
    messages: Iterable[tuple[Response, int | None]], rate: float
) -> Iterator[TimedMessage]:
    """Tell when each message of a recording is played.

    Parameters
    ----------
    messages
        The messages in order, each with the recording's own time of it, ns; None where it has
        none.
    rate
        Multiple of real time; 0 for as fast as the port takes them.

    Yields
    ------
    Times that never decrease: a stamp that runs backwards plays at once.

    Raises
    ------
    OverflowError
        When a rate near 0 puts a message beyond all time.

    Examples
    --------
    >>> from xethru_protocol.messages import Ack
    >>> [item.time_ns for item in schedule([(Ack(), 5), (Ack(), 1005), (Ack(), 905)], rate=2.0)]
    [0, 500, 500]
    """
    elapsed_ns = 0
    previous_ns: int | None = None
    for index, (message, stamp_ns) in enumerate(messages):
        if index:
            if stamp_ns is None or previous_ns is None:
                elapsed_ns += NOMINAL_PERIOD_NS
            else:
                elapsed_ns += max(stamp_ns - previous_ns, 0)
        previous_ns = stamp_ns
        yield TimedMessage(time_ns=round(elapsed_ns / rate) if rate else 0, message=message)


class PlayStream:
    """The messages of a recording, due one after the other while a host has the port open.

    Where nobody tells who opens the port, a host's first command shows that it is there.

    Parameters
    ----------
    timed
        What to play, as from `schedule`; gone through anew for every host and round, one message
        ahead, so that it need not lie in memory.
    loop_gap_ns
        Pause between the last message and the first when playing in a loop; None to play once.
    """

    def __init__(self, timed: Iterable[TimedMessage], *, loop_gap_ns: int | None = None) -> None:
        self._timed = timed
        self._loop_gap_ns = loop_gap_ns
        self._coming: Iterator[TimedMessage] = iter(())
        self._next: TimedMessage | None = None
        self._begun = False
        self._start_ns: int | None = None

    def next_due_ns(self) -> int | None:
        """Return when the next message is due; None with no host or at the end."""
        if self._start_ns is None or self._next is None:
            return None
        return self._start_ns + self._next.time_ns

    def take(self) -> Response:
        """Return the next message; there must be one."""
        taken = self._next
        assert taken is not None
        self._begun = True
        self._next = next(self._coming, None)
        if self._next is None and self._loop_gap_ns is not None:
            if self._start_ns is not None:
                self._start_ns += taken.time_ns + self._loop_gap_ns
            self._rewind()
        return taken.message

    def skip_due_before(self, time_ns: int) -> int:
        """Skip nothing: a recording is played whole."""
        del time_ns
        return 0

    def command_done(self, command: Command[Response], now_ns: int) -> None:
        """Begin when the host starts the radar; wait on while it asks and configures."""
        if self._begun:
            return
        if self._start_ns is None:
            self._rewind()
        if _starts_radar(command):
            self._start_ns = now_ns
        elif self._start_ns is None or self._start_ns > now_ns:
            self._start_ns = now_ns + QUIET_NS

    def port_opened(self, now_ns: int) -> None:
        """Play from the beginning, soon."""
        self._begun = False
        self._rewind()
        self._start_ns = now_ns + QUIET_NS

    def port_closed(self, now_ns: int) -> None:
        """Stop playing."""
        del now_ns
        self._begun = False
        self._start_ns = None
        self._coming = iter(())
        self._next = None

    def _rewind(self) -> None:
        self._coming = iter(self._timed)
        self._next = next(self._coming, None)


def _starts_radar(command: Command[Response]) -> bool:
    match command:
        case X4DriverSet(setting=X4Setting.FPS, value=float(fps)):
            return fps > 0
        case SetMode(mode=SensorMode.XTID_SM_RUN):
            return True
    return False
