"""What waits inside the module for the host: the firmware's 50-slot queue, and a lossless one.

Both are pure: messages and times in, messages out. A message is encoded when it is taken.

Source: protocol reference 8.4.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from enum import Enum, auto
from typing import NamedTuple

from xethru_protocol.wire.messages import Command, Response

NS_PER_S = 1_000_000_000


class MessageKind(Enum):
    """What a queued message is, because overflow treats kinds differently."""

    REPLY = auto()
    """ACK, ERROR, PONG, REPLY or SYSTEM."""
    FRAME = auto()
    """Radar frame or profile output."""
    DEBUG = auto()
    """DATA STRING and generic byte or float messages: the first to go."""


class MessageStream(ABC):
    """Unsolicited messages of a module, each with the time it falls due."""

    @abstractmethod
    def next_due_ns(self) -> int | None:
        """Return when the next message is due; None while nothing streams."""

    @abstractmethod
    def take(self) -> Response:
        """Return the next message and move on."""

    @abstractmethod
    def skip_due_before(self, time_ns: int) -> int:
        """Give up every message due before a time; return how many (frame counters run on)."""

    @abstractmethod
    def command_done(self, command: Command[Response], now_ns: int) -> None:
        """Note that the module carried out, or refused, a command."""

    # A recording goes on through a reset; a radar streams whether a host listens or not.
    def restarted(self, ready_ns: int) -> None:  # noqa: B027 - see above
        """Note that the module restarts, and when it will be ready; until then it is silent."""

    def port_opened(self, now_ns: int) -> None:  # noqa: B027 - see above
        """Note that a host opened the port."""

    def port_closed(self, now_ns: int) -> None:  # noqa: B027 - see above
        """Note that the last host closed the port."""


class _Queued(NamedTuple):
    kind: MessageKind
    message: Response


class Outbox(ABC):
    """The queue between a module and its line."""

    def __init__(self) -> None:
        self._queue: deque[_Queued] = deque()

    @property
    @abstractmethod
    def takes_replies(self) -> bool:
        """Whether there is room for the reply to another command; if not, none should be read."""

    @abstractmethod
    def put(self, kind: MessageKind, message: Response, now_ns: int) -> None:
        """Queue one message, or lose one, as the queue's rule demands."""

    def refill_on_time(self, stream: MessageStream, now_ns: int) -> None:  # noqa: B027
        """Fetch what fell due, because time passed."""

    def refill_on_demand(self, stream: MessageStream, now_ns: int) -> None:  # noqa: B027
        """Fetch what is due, because the line takes more."""

    @abstractmethod
    def wake_ns(self, stream: MessageStream, now_ns: int) -> int | None:
        """Return when time alone brings the next message; None when only the line's room does."""

    def take(self, now_ns: int) -> Response | None:
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

    @property
    def takes_replies(self) -> bool:
        return len(self._queue) < self.MOST_REPLIES

    def put(self, kind: MessageKind, message: Response, now_ns: int) -> None:
        self._queue.append(_Queued(kind, message))

    def refill_on_demand(self, stream: MessageStream, now_ns: int) -> None:
        """Fetch one due message if nothing waits."""
        if not self._queue:
            due_ns = stream.next_due_ns()
            if due_ns is not None and due_ns <= now_ns:
                self._queue.append(_Queued(MessageKind.FRAME, stream.take()))

    def wake_ns(self, stream: MessageStream, now_ns: int) -> int | None:
        """Return the next due time if it lies ahead; what is already due waits for the line."""
        due_ns = stream.next_due_ns()
        return due_ns if due_ns is not None and due_ns > now_ns else None


class FirmwareOutbox(Outbox):
    """The firmware's message queue: 50 slots, and a rule for a host that stops reading.

    A host counts as stalled when messages have waited for a second and none was taken. Then every
    further message first costs the queued debug messages, and after them the oldest of any kind
    until a quarter of the slots is free. A full queue whose host still reads has no slot for
    another frame: it is lost, and the gap in the counters shows it. A reply displaces the oldest
    message instead, so a command is always answered (an assumption; the reference is silent).

    Attributes
    ----------
    frames_lost
        Frames dropped so far, by any rule.

    Source: protocol reference 8.4.
    """

    SLOTS = 50
    FREE_AFTER_PURGE = SLOTS // 4
    STALL_NS = NS_PER_S
    # One visit synthesises no more than this, so that one fast radar cannot hold up the others.
    FRAMES_PER_REFILL = 8

    def __init__(self) -> None:
        super().__init__()
        self._waiting_since_ns = 0
        self.frames_lost = 0

    @property
    def takes_replies(self) -> bool:
        """Whether another reply displaces a frame at worst, and not an unread reply."""
        if len(self._queue) < self.SLOTS:
            return True
        return any(queued.kind is not MessageKind.REPLY for queued in self._queue)

    def put(self, kind: MessageKind, message: Response, now_ns: int) -> None:
        if self._queue and now_ns - self._waiting_since_ns >= self.STALL_NS:
            self._purge()
        if len(self._queue) >= self.SLOTS:
            if kind is not MessageKind.REPLY:
                self.frames_lost += kind is MessageKind.FRAME
                return
            self._drop_oldest()
        if not self._queue:
            self._waiting_since_ns = now_ns
        self._queue.append(_Queued(kind, message))

    def refill_on_time(self, stream: MessageStream, now_ns: int) -> None:
        """Queue every frame due by now; without a free slot, lose it unsynthesised."""
        # A module that fell more than a second behind its own clock lost those frames.
        self.frames_lost += stream.skip_due_before(now_ns - self.STALL_NS)
        for _ in range(self.FRAMES_PER_REFILL):
            due_ns = stream.next_due_ns()
            if due_ns is None or due_ns > now_ns:
                return
            stalled = now_ns - self._waiting_since_ns >= self.STALL_NS
            if len(self._queue) >= self.SLOTS and not stalled:
                self.frames_lost += stream.skip_due_before(now_ns + 1)
                return
            self.put(MessageKind.FRAME, stream.take(), now_ns)

    def take(self, now_ns: int) -> Response | None:
        """Return the oldest message; the host has proved that it reads."""
        if self._queue:
            self._waiting_since_ns = now_ns
        return super().take(now_ns)

    def wake_ns(self, stream: MessageStream, now_ns: int) -> int | None:
        """Return the next due time, which may be past when a refill was cut short."""
        return stream.next_due_ns()

    def _purge(self) -> None:
        kept = (queued for queued in self._queue if queued.kind is not MessageKind.DEBUG)
        self._queue = deque(kept)
        while self.SLOTS - len(self._queue) < self.FREE_AFTER_PURGE:
            self._drop_oldest()

    def _drop_oldest(self) -> None:
        self.frames_lost += self._queue.popleft().kind is MessageKind.FRAME
