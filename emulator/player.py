"""A recording played at an emulated module's port, message by message and byte-exact.

Playing begins anew for every host that opens the port: at once when it starts the radar (FPS > 0
or SETMODE RUN), else after half a second without a command, so that a host that only listens has
had time to flush its side. It ends when the last host has closed the port. Meanwhile the module
answers every command like any other; FPS, mode and geometry settings are acknowledged and change
nothing about what is played. Nothing is dropped: a host that reads slowly makes the recording
wait. A host that only asks something and leaves within half a second hears none of it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from emulator.outbox import MessageStream
from emulator.playback_control import SLOWEST_RATE, KindSteps, PlayClock, PlayState
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


class PlayStream(MessageStream):
    """The messages of a recording, due one after the other while a host has the port open.

    Where nobody tells who opens the port, a host's first command shows that it is there.

    What is being played can be controlled meanwhile. No control brings a message twice or out of
    order, or loses one, but for what a seek leaves out and a filter passes over; a message that
    the line has begun to take is sent whole. Pause, rate, loop and filter outlast the host.

    Parameters
    ----------
    timed
        What to play, as from `schedule` at rate 1; gone through anew for every host and round,
        one message ahead, so that it need not lie in memory. A seek and a new filter go through
        it from the beginning, too, up to where it stands.
    loop_gap_ns
        Time of the recording between the last message and the first when playing in a loop; None
        to play once.
    rate
        Multiple of real time; 0 for as fast as the line takes it.
    from_ns
        Where every host and round begins, ns since the first message.
    kinds
        What to play, as from `kinds`; None for all. What is left out takes its time all the same.
    """

    def __init__(
        self,
        timed: Iterable[TimedMessage],
        *,
        loop_gap_ns: int | None = None,
        rate: float = 1.0,
        from_ns: int = 0,
        kinds: frozenset[str] | None = None,
    ) -> None:
        self._timed = timed
        self._loop = loop_gap_ns is not None
        self._gap_ns = NOMINAL_PERIOD_NS if loop_gap_ns is None else loop_gap_ns
        self._from_ns = from_ns
        self._clock = PlayClock(rate)
        self._kinds = KindSteps(kinds)
        self._coming: Iterator[tuple[int, TimedMessage]] = iter(())
        self._first = (0, 0)  # least index and time of what is still to be played of this round
        self._next: TimedMessage | None = None
        self._next_index = 0
        self._last_ns = 0  # time of the last message gone through
        self._round_waits = False  # whether a further round was entered and none of it is played
        self._listening = False
        self._begun = False
        self._sought_ns: int | None = None

    def next_due_ns(self) -> int | None:
        """Return when the next message is due; None with no host, paused or at the end."""
        if not self._listening or self._next is None:
            return None
        return self._clock.due_ns(self._next.time_ns)

    def take(self) -> Response:
        """Return the next message; there must be one."""
        taken = self._next
        assert taken is not None
        self._begun = True
        self._round_waits = False
        self._first = (self._next_index + 1, 0)
        self._clock.reached(taken.time_ns)
        self._kinds.forget_before(taken.time_ns)
        self._advance()
        if self._next is None and self._loop:
            self._next_round()
        return taken.message

    def skip_due_before(self, time_ns: int) -> int:
        """Skip nothing: a recording is played whole."""
        del time_ns
        return 0

    def command_done(self, command: Command[Response], now_ns: int) -> None:
        """Begin when the host starts the radar; wait on while it asks and configures."""
        if self._begun:
            return
        if not self._listening:
            self.port_opened(now_ns)
        if self._clock.begins_ns > now_ns:
            self._clock.begin_at(now_ns if _starts_radar(command) else now_ns + QUIET_NS)

    def port_opened(self, now_ns: int) -> None:
        """Play from the beginning, or from where a seek without a host went, soon."""
        self._begun = False
        self._listening = True
        self._go(self._from_ns if self._sought_ns is None else self._sought_ns, now_ns + QUIET_NS)
        self._sought_ns = None

    def port_closed(self, now_ns: int) -> None:
        """Stop playing."""
        del now_ns
        self._begun = self._listening = self._round_waits = False
        self._coming = iter(())
        self._next = None

    def state(self, now_ns: int) -> PlayState:
        """Return what the playback is doing."""
        return PlayState(
            playing=self._listening and self._next is not None,
            paused=self._clock.paused,
            position_ns=self._clock.position_ns(now_ns),
            rate=self._clock.rate,
            loop=self._loop,
            kinds=self._kinds.newest,
        )

    def pause(self, now_ns: int) -> None:
        """Stand still: no message becomes due until `resume`, not even one the line made wait."""
        self._clock.pause(now_ns)

    def resume(self, now_ns: int) -> None:
        """Go on where `pause` stopped; the time between two messages is that of the recording."""
        self._clock.resume(now_ns)

    def set_rate(self, rate: float, now_ns: int) -> None:
        """Go on at another multiple of real time; 0 for as fast as the line takes it.

        Raises
        ------
        ValueError
            When it is neither 0 nor a finite number of at least `SLOWEST_RATE`.
        """
        if rate and not SLOWEST_RATE <= rate < math.inf:
            raise ValueError(f"rate {rate:g} is neither 0 nor a number from {SLOWEST_RATE:g} on")
        self._clock.set_rate(rate, now_ns)

    def seek(self, position_ns: int, now_ns: int) -> None:
        """Go on at once with the first message at or after a time of the recording.

        Past the end there is none: it ends, or in a loop the next round follows. Without a host,
        the next one begins there.

        Raises
        ------
        ValueError
            When the time lies before the first message.
        """
        if position_ns < 0:
            raise ValueError("a recording begins at 0 s")
        if not self._listening:
            self._sought_ns = position_ns
            return
        self._go(position_ns, max(now_ns, self._clock.begins_ns))

    def set_loop(self, loop: bool, now_ns: int) -> None:
        """Begin again at the end, or not; at the end already, begin again at once."""
        self._loop = loop
        if not self._listening:
            return
        if loop and self._next is None:
            self._go(self._from_ns, now_ns)
        elif not loop and self._round_waits:
            self._next = None

    def set_filter(self, kinds: frozenset[str] | None, now_ns: int) -> None:
        """Play other kinds, as from `kinds`, None for all, from the position of now on.

        The kinds in force when the recording's clock passes a message decide about it, even where
        a slow host has made it wait since. Where a loop had nothing to play, it begins again.
        """
        over = self._next is None
        self._kinds.change(kinds, self._clock.position_ns(now_ns))
        if not self._listening:
            return
        if over and self._loop:
            self._go(self._from_ns, now_ns)
            return
        self._open()
        if self._next is None and self._loop:
            self._next_round()

    def _go(self, position_ns: int, at_ns: int) -> None:
        """Be at a position of the recording at a time of the device."""
        self._kinds.forget()
        self._first = (0, position_ns)
        self._round_waits = False
        self._open()
        past_the_end = self._next is None and self._last_ns < position_ns
        self._clock.start(self._last_ns if past_the_end else position_ns, at_ns)
        if self._next is None and self._loop:
            self._next_round()

    def _next_round(self) -> None:
        self._clock.wrap(self._last_ns + self._gap_ns - self._from_ns)
        self._kinds.forget()
        self._first = (0, self._from_ns)
        self._round_waits = True
        self._open()

    def _open(self) -> None:
        """Go through the recording up to the next message to play."""
        self._coming = enumerate(self._timed)
        self._last_ns = 0
        self._advance()

    def _advance(self) -> None:
        first_index, first_ns = self._first
        for index, item in self._coming:
            self._last_ns = item.time_ns
            if index < first_index or item.time_ns < first_ns:
                continue
            if self._kinds.passes(item.time_ns, item.message):
                self._next, self._next_index = item, index
                return
        self._next = None


def _starts_radar(command: Command[Response]) -> bool:
    match command:
        case X4DriverSet(setting=X4Setting.FPS, value=float(fps)):
            return fps > 0
        case SetMode(mode=SensorMode.XTID_SM_RUN):
            return True
    return False
