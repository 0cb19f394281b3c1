"""What a driver knows of its module between two calls; no I/O, nothing that waits."""

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from xethru_protocol.conversation import FRAMES, Conversation, Observer
from xethru_protocol.frame_queue import FrameQueue
from xethru_protocol.messages import Command, Response
from xethru_protocol.raw_config import RawConfig

POWER_UP_BAUD = 115200  # a UART module's rate after every restart (Protocol reference 10)
_WARNINGS = 1000  # kept; a radar may run for months
_MESSAGES = 4096  # of a profile that wait unread: pulse-Doppler sends one per range bin


@dataclass(frozen=True, slots=True, kw_only=True)
class RawPlan:
    """Raw radar mode as the user wants it; ``fps`` None while stopped."""

    config: RawConfig
    fps: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class ProfilePlan:
    """A profile as the user wants it.

    ``loaded`` is False if it was found running. ``settings`` holds the last command for each
    setting, by what it sets; ``mode`` is None before the profile was run.
    """

    profile_id: int
    loaded: bool
    settings: Mapping[object, Command[Response]] = field(default_factory=dict)
    mode: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Identity:
    """How a module is told from others; ``serial_number`` None if it refuses to say."""

    serial_number: str | None


class RadarCore:
    """The state of one driver: the conversation, the frames, and what the module was set to.

    Parameters
    ----------
    path
        Of the line, as the user named it.
    clock
        Monotonic time [ns].
    observer
        Called with every command, answer, SYSTEM message, fault and warning; None: nobody.
    queue_frames
        Frames that may wait unread before the oldest is dropped.
    reconnect_s
        How long to look for a module that vanished; 0: not at all.
    candidates
        Finds the ports at which a module that vanished may have come back.

    Attributes
    ----------
    warnings
        What was asked of the module although it is likely to fail, and what went wrong quietly;
        the last 1000.
    messages
        Messages of the running profile that were not taken yet; None: nobody wants them.
    home
        The path the user named; ``path`` is where the module is now.
    plan
        What to restore after a reconnect; None: nothing was configured.
    identity
        Which module this is; None: not asked yet.
    baudrate
        Rate of a UART.
    bytes_per_s
        What the line carries at most; infinite if it has no known limit.
    generation
        Counts the lines: a changed number says that somebody reconnected.
    reconnects
        Times a module that vanished was found again.
    raw_mode
        Whether this driver put the module into raw radar mode.
    closed
        Whether the user closed the driver.
    """

    def __init__(
        self,
        path: str,
        *,
        clock: Callable[[], int],
        observer: Observer | None,
        queue_frames: int,
        reconnect_s: float,
        candidates: Callable[[], Sequence[str]],
    ) -> None:
        self.home = self.path = path
        self.clock = clock
        self.reconnect_s = reconnect_s
        self.candidates = candidates
        self.warnings: list[str] = []
        self.conversation = Conversation(path, clock, observer, self._take)
        self.statistics = self.conversation.statistics
        self.frames = FrameQueue(queue_frames, self.statistics, self.warn)
        self.messages: deque[Response] | None = None
        self.messages_dropped = 0
        self.plan: RawPlan | ProfilePlan | None = None
        self.identity: Identity | None = None
        self.baudrate = POWER_UP_BAUD
        self.bytes_per_s = math.inf
        self.generation = 0
        self.reconnects = 0
        self.raw_mode = False
        self.closed = False

    @property
    def unlimited(self) -> bool:
        """Whether the line has no rate of its own."""
        return math.isinf(self.bytes_per_s)

    def _take(self, message: Response, arrival_ns: int) -> None:
        if isinstance(message, FRAMES):
            self.frames.take(message, arrival_ns)
        elif self.messages is not None:
            if len(self.messages) >= _MESSAGES:
                self.messages.popleft()
                if not self.messages_dropped:
                    self.warn(f"{_MESSAGES} messages wait unread, so the oldest are dropped")
                self.messages_dropped += 1
            self.messages.append(message)

    def warn(self, text: str) -> None:
        """Note what the user should know although nothing failed."""
        if len(self.warnings) >= _WARNINGS:
            del self.warnings[0]
        self.warnings.append(text)
        self.conversation.tell("warning", text)

    def left_s(self, deadline_ns: int) -> float:
        """Time until a deadline [s], negative when it is over."""
        return (deadline_ns - self.clock()) * 1e-9
