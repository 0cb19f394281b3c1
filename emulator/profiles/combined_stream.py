"""One line for two sources of messages: the raw radar of MANUAL and the profile of RUN."""

from __future__ import annotations

from emulator.chip_stream import ChipStream
from emulator.outbox import MessageStream
from emulator.profiles.stream import ProfileStream
from xethru_protocol.messages import Command, Response

__all__ = ["CombinedStream"]


class CombinedStream(MessageStream):
    """Messages of a module in any mode; at most one of its two streams has any.

    Parameters
    ----------
    raw
        Radar frames, in MANUAL.
    profile
        Output of the profile, in RUN.
    """

    def __init__(self, raw: ChipStream, profile: ProfileStream) -> None:
        self._raw = raw
        self._profile = profile
        self._active = self._choice()

    @property
    def profile(self) -> ProfileStream:
        """The running profile, for inspection."""
        return self._profile

    def next_due_ns(self) -> int | None:
        """Return when the next message is due; None while nothing streams."""
        return self._active.next_due_ns()

    def take(self) -> Response:
        """Return the next message; there must be one."""
        message = self._active.take()
        self._active = self._choice()  # a transmitter that saw nothing for long is off now
        return message

    def skip_due_before(self, time_ns: int) -> int:
        """Give up every message due before a time; return how many."""
        return self._active.skip_due_before(time_ns)

    def command_done(self, command: Command[Response], now_ns: int) -> None:
        """Let both see the command: it may have ended the one and begun the other."""
        self._raw.command_done(command, now_ns)
        self._profile.command_done(command, now_ns)
        self._active = self._choice()

    def restarted(self, ready_ns: int) -> None:
        """Let both start anew."""
        self._raw.restarted(ready_ns)
        self._profile.restarted(ready_ns)
        self._active = self._choice()

    def _choice(self) -> ChipStream | ProfileStream:
        """Return who speaks until a message, a command or a restart changes it."""
        return self._raw if self._raw.streaming else self._profile
