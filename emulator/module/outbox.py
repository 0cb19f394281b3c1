"""What waits to be sent: the queue between a module and its line, and what fills it.

A `MessageStream` makes what a module sends unasked: messages and times in, messages out.

Source: protocol reference 8.4.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass
from enum import Enum, auto
from typing import NamedTuple

from emulator.chip.chip import NS_PER_S
from xethru_protocol.wire import messages as m


class MessageKind(Enum):
    """What a queued message is, because overflow treats kinds differently."""

    REPLY = auto()
    """ACK, ERROR, PONG, REPLY or SYSTEM."""
    FRAME = auto()
    """Radar frame or profile output."""
    DEBUG = auto()
    """DATA STRING and generic byte or float messages: the first to go."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamBegin:
    """Where in scene time a stream of radar frames begins.

    Attributes
    ----------
    number
        From 0; INIT, a reset and a power cut end a stream, a pause does not.
    scene_time_ns
        Of its frame with counter 1, without the radar's start skew and clock error.
    """

    number: int
    scene_time_ns: int


class MessageStream(ABC):
    """Unsolicited messages of a module, made in steps that fall due one after the other."""

    @abstractmethod
    def next_due_ns(self) -> int | None:
        """Return when the next step is due; None while nothing streams."""

    @abstractmethod
    def take(self) -> m.Response | None:
        """Take the next step, at most the work of one frame; return its message if it has one."""

    @abstractmethod
    def skip_due_before(self, time_ns: int) -> None:
        """Give up every message due before a time; frame counters run on.

        Steps without a message may remain due.
        """

    @abstractmethod
    def command_done(self, command: m.Command[m.Response], now_ns: int) -> None:
        """Note that the module carried out, or refused, a command."""

    @property
    def begin(self) -> StreamBegin | None:
        """The newest stream of radar frames that began; None before the first, or if unknown."""
        return None

    # A recording goes on through a reset; a radar streams whether a host listens or not.
    def restarted(self, ready_ns: int) -> None:  # noqa: B027 - see above
        """Note that the module restarts, and when it will be ready; until then it is silent."""

    def port_opened(self, now_ns: int) -> None:  # noqa: B027 - see above
        """Note that a host opened the port."""

    def port_closed(self, now_ns: int) -> None:  # noqa: B027 - see above
        """Note that the last host closed the port."""


class _Queued(NamedTuple):
    kind: MessageKind
    message: m.Response


class Outbox(ABC):
    """The queue between a module and its line."""

    def __init__(self) -> None:
        self._queue: deque[_Queued] = deque()

    @property
    @abstractmethod
    def takes_replies(self) -> bool:
        """Whether there is room for the reply to another command; if not, none should be read."""

    @abstractmethod
    def put(self, kind: MessageKind, message: m.Response, now_ns: int) -> None:
        """Queue one message, or lose one, as the queue's rule demands."""

    def refill_on_time(self, stream: MessageStream, now_ns: int) -> None:  # noqa: B027 - optional
        """Fetch what fell due, because time passed."""

    def refill_on_demand(self, stream: MessageStream, now_ns: int) -> None:  # noqa: B027 - likewise
        """Fetch what is due, because the line takes more."""

    @abstractmethod
    def wake_ns(self, stream: MessageStream, now_ns: int) -> int | None:
        """Return when time alone brings the next message; None when only the line's room does."""

    def take(self, now_ns: int) -> m.Response | None:
        """Return the oldest message."""
        return self._queue.popleft().message if self._queue else None

    def clear(self) -> None:
        self._queue.clear()

    def __len__(self) -> int:
        return len(self._queue)


class LosslessOutbox(Outbox):
    """Queue of a device whose clock waits for the line: nothing is dropped.

    A stream message is fetched only when nothing else waits and it is due, so a reply stands
    behind at most the one message the line is already sending.
    """

    MOST_REPLIES = 50

    def __init__(self) -> None:
        super().__init__()
        self._wants_step = False  # the line takes more, and the last step brought nothing

    @property
    def takes_replies(self) -> bool:
        return len(self._queue) < self.MOST_REPLIES

    def put(self, kind: MessageKind, message: m.Response, now_ns: int) -> None:
        self._queue.append(_Queued(kind, message))

    def refill_on_demand(self, stream: MessageStream, now_ns: int) -> None:
        self._wants_step = False
        due_ns = None if self._queue else stream.next_due_ns()
        if due_ns is None or due_ns > now_ns:
            return
        message = stream.take()
        if message is None:
            self._wants_step = True
        else:
            self._queue.append(_Queued(MessageKind.FRAME, message))

    def refill_on_time(self, stream: MessageStream, now_ns: int) -> None:
        """Fetch nothing; the device asks for a packet if the line takes one."""
        self._wants_step = False

    def wake_ns(self, stream: MessageStream, now_ns: int) -> int | None:
        """Return when the next step is due; a message that is due already waits for the line."""
        due_ns = stream.next_due_ns()
        waits_for_line = due_ns is not None and due_ns <= now_ns and not self._wants_step
        return None if waits_for_line else due_ns


class FirmwareOutbox(Outbox):
    """The firmware's message queue: 50 slots, and a rule for a host that stops reading.

    A host counts as stalled when messages have waited for a second and none was taken. Then every
    further message first costs the queued debug messages, and after them the oldest of any kind
    until a quarter of the slots is free. A full queue whose host still reads has no slot for
    another frame: it is lost, and the gap in the counters shows it. A reply displaces the oldest
    message instead, so a command is always answered (an assumption; the reference is silent).
    Radar frames need blocks of the message pool, too, of which there may be fewer than slots.

    Source: protocol reference 1.1 and 8.4.
    """

    SLOTS = 50
    FREE_AFTER_PURGE = SLOTS // 4
    STALL_NS = NS_PER_S
    # One visit takes no more steps than this, so that one fast radar cannot hold up the others.
    STEPS_PER_REFILL = 8

    def __init__(self, most_frames: int = SLOTS) -> None:
        super().__init__()
        self._most_frames = most_frames
        self._waiting_since_ns = 0

    @property
    def takes_replies(self) -> bool:
        """Whether another reply displaces a frame at worst, and not an unread reply."""
        if len(self._queue) < self.SLOTS:
            return True
        return any(queued.kind is not MessageKind.REPLY for queued in self._queue)

    def put(self, kind: MessageKind, message: m.Response, now_ns: int) -> None:
        if self._queue and now_ns - self._waiting_since_ns >= self.STALL_NS:
            self._purge()
        if len(self._queue) >= self.SLOTS:
            if kind is not MessageKind.REPLY:
                return
            self._queue.popleft()
        if not self._queue:
            self._waiting_since_ns = now_ns
        self._queue.append(_Queued(kind, message))

    def refill_on_time(self, stream: MessageStream, now_ns: int) -> None:
        """Queue every frame due by now; without a free slot, lose it unsynthesised."""
        # A module that fell more than a second behind its own clock lost those frames.
        stream.skip_due_before(now_ns - self.STALL_NS)
        for _ in range(self.STEPS_PER_REFILL):
            stalled = now_ns - self._waiting_since_ns >= self.STALL_NS
            if (len(self._queue) >= self.SLOTS and not stalled) or not self._takes_frames:
                stream.skip_due_before(now_ns + 1)
            due_ns = stream.next_due_ns()
            if due_ns is None or due_ns > now_ns:
                return
            message = stream.take()
            if message is not None:
                self.put(MessageKind.FRAME, message, now_ns)

    def take(self, now_ns: int) -> m.Response | None:
        """Return the oldest message; the host has proved that it reads."""
        if self._queue:
            self._waiting_since_ns = now_ns
        return super().take(now_ns)

    @property
    def _takes_frames(self) -> bool:
        if len(self._queue) < self._most_frames or self._most_frames >= self.SLOTS:
            return True
        frames = sum(isinstance(queued.message, m.DataFloat) for queued in self._queue)
        return frames < self._most_frames

    def wake_ns(self, stream: MessageStream, now_ns: int) -> int | None:
        """Return the next due time, which may be past when a refill was cut short."""
        return stream.next_due_ns()

    def _purge(self) -> None:
        kept = [queued for queued in self._queue if queued.kind is not MessageKind.DEBUG]
        most = self.SLOTS - self.FREE_AFTER_PURGE
        self._queue = deque(kept[-most:])
