"""A recording played at an emulated module's port, message by message and byte-exact.

Playing begins anew for every host that opens the port: at once when it starts the radar (FPS > 0
or SETMODE RUN), else after half a second without a command, so that a host that only listens has
had time to flush its side. It ends when the last host has closed the port. Meanwhile the module
answers every command like any other; FPS, mode and geometry settings are acknowledged and change
nothing about what is played. Nothing is dropped: a host that reads slowly makes the recording
wait. A host that only asks something and leaves within half a second hears none of it.
"""

from __future__ import annotations

from collections.abc import Sequence
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
    messages: Sequence[Response], stamps_ns: Sequence[int | None], rate: float
) -> tuple[TimedMessage, ...]:
    """Return when each message of a recording is played.

    Parameters
    ----------
    messages
        The messages in order.
    stamps_ns
        The recording's own time of each, ns; None where it has none.
    rate
        Multiple of real time; 0 for as fast as the port takes them.

    Returns
    -------
    Times that never decrease: a stamp that runs backwards plays at once.

    Raises
    ------
    OverflowError
        When a rate near 0 puts a message beyond all time.

    Examples
    --------
    >>> from xethru_protocol.messages import Ack
    >>> [item.time_ns for item in schedule([Ack()] * 3, [5, 1005, 905], rate=2.0)]
    [0, 500, 500]
    """
    if rate == 0:
        return tuple(TimedMessage(time_ns=0, message=message) for message in messages)
    timed: list[TimedMessage] = []
    elapsed_ns = 0
    previous_ns: int | None = None
    for message, stamp_ns in zip(messages, stamps_ns, strict=True):
        if timed:
            if stamp_ns is None or previous_ns is None:
                elapsed_ns += NOMINAL_PERIOD_NS
            else:
                elapsed_ns += max(stamp_ns - previous_ns, 0)
        previous_ns = stamp_ns
        timed.append(TimedMessage(time_ns=round(elapsed_ns / rate), message=message))
    return tuple(timed)


class PlayStream:
    """The messages of a recording, due one after the other while a host has the port open.

    Where nobody tells who opens the port, a host's first command shows that it is there.

    Parameters
    ----------
    timed
        What to play, from `schedule`; not empty.
    loop_gap_ns
        Pause between the last message and the first when playing in a loop; None to play once.
    """

    def __init__(self, timed: Sequence[TimedMessage], *, loop_gap_ns: int | None = None) -> None:
        self._timed = timed
        self._loop_gap_ns = loop_gap_ns
        self._next = 0
        self._start_ns: int | None = None

    def next_due_ns(self) -> int | None:
        """Return when the next message is due; None with no host or at the end."""
        if self._start_ns is None or self._next >= len(self._timed):
            return None
        return self._start_ns + self._timed[self._next].time_ns

    def take(self) -> Response:
        """Return the next message."""
        message = self._timed[self._next].message
        self._next += 1
        if self._next == len(self._timed) and self._loop_gap_ns is not None:
            if self._start_ns is not None:
                self._start_ns += self._timed[-1].time_ns + self._loop_gap_ns
            self._next = 0
        return message

    def skip_due_before(self, time_ns: int) -> int:
        """Skip nothing: a recording is played whole."""
        del time_ns
        return 0

    def command_done(self, command: Command[Response], now_ns: int) -> None:
        """Begin when the host starts the radar; wait on while it asks and configures."""
        if self._next > 0:
            return
        if _starts_radar(command):
            self._start_ns = now_ns
        elif self._start_ns is None or self._start_ns > now_ns:
            self._start_ns = now_ns + QUIET_NS

    def port_opened(self, now_ns: int) -> None:
        """Play from the beginning, soon."""
        self._next = 0
        self._start_ns = now_ns + QUIET_NS

    def port_closed(self, now_ns: int) -> None:
        """Stop playing."""
        del now_ns
        self._start_ns = None
        self._next = 0


def _starts_radar(command: Command[Response]) -> bool:
    match command:
        case X4DriverSet(setting=X4Setting.FPS, value=float(fps)):
            return fps > 0
        case SetMode(mode=SensorMode.XTID_SM_RUN):
            return True
    return False
