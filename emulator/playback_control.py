"""Where a playback stands: the clock of a recording, and which kinds of its messages are played.

Both are pure. A `PlayClock` maps times of the recording to times of the device, piece by piece:
within a piece ``due = anchor + (position - anchor position) / rate``, and every pause, seek and
change of rate begins a new piece. `KindSteps` remembers which kinds were asked for when.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from xethru_protocol.codes import ResponseCode
from xethru_protocol.messages import Response
from xethru_protocol.table import ROWS, UnknownMessage

__all__ = ["SLOWEST_RATE", "KindSteps", "PlayClock", "PlayState", "is_answer", "kind_of", "kinds"]

SLOWEST_RATE = 1e-6
"""Least rate above 0 that a playback in progress takes; a year for half a minute."""
_UNKNOWN = "unknown"
_ANSWERS = frozenset(
    (
        ResponseCode.XTS_SPR_ACK,
        ResponseCode.XTS_SPR_ERROR,
        ResponseCode.XTS_SPR_PONG,
        ResponseCode.XTS_SPR_REPLY,
        ResponseCode.XTS_SPR_HIL,
    )
)


@dataclass(frozen=True, slots=True, kw_only=True)
class PlayState:
    """What a playback is doing.

    Attributes
    ----------
    playing
        Whether a host has the port and something is left to play.
    paused
        Whether it was told to pause.
    position_ns
        Time of the recording that has been reached, ns since its first message; below its
        beginning in the gap between two rounds.
    rate
        Multiple of real time; 0 for as fast as the port takes it.
    loop
        Whether it begins again at the end.
    kinds
        Which kinds it plays, as from `kind_of`; None for all.
    """

    playing: bool
    paused: bool
    position_ns: int
    rate: float
    loop: bool
    kinds: frozenset[str] | None


class PlayClock:
    """The time of a recording on the clock of the device that plays it.

    Parameters
    ----------
    rate
        Multiple of real time; at 0 everything is due at once, and the position is that of the
        last message played.
    """

    def __init__(self, rate: float) -> None:
        self.rate = rate
        self.paused = False
        self._anchor_ns = 0
        self._anchor_position_ns = 0

    def start(self, position_ns: int, at_ns: int) -> None:
        """Be at a position of the recording at a time of the device, which may lie ahead."""
        self._anchor_position_ns = position_ns
        self._anchor_ns = at_ns

    @property
    def begins_ns(self) -> int:
        """When the piece in force begins, or began."""
        return self._anchor_ns

    def begin_at(self, at_ns: int) -> None:
        """Begin the piece in force, which has not begun, at another time."""
        self._anchor_ns = at_ns

    def due_ns(self, position_ns: int) -> int | None:
        """Return when the device's clock reaches a position; None while paused."""
        if self.paused:
            return None
        if not self.rate:
            return self._anchor_ns
        return self._anchor_ns + round((position_ns - self._anchor_position_ns) / self.rate)

    def position_ns(self, now_ns: int) -> int:
        """Return the position that a time of the device has reached."""
        if self.paused or not self.rate or now_ns <= self._anchor_ns:
            return self._anchor_position_ns
        return self._anchor_position_ns + math.floor((now_ns - self._anchor_ns) * self.rate)

    def reached(self, position_ns: int) -> None:
        """Note that a message was played; at rate 0 nothing else moves the position."""
        if not self.rate:
            self._anchor_position_ns = max(self._anchor_position_ns, position_ns)

    def wrap(self, round_ns: int) -> None:
        """Count positions from the next round on, which begins a round's length later."""
        self._anchor_position_ns -= round_ns

    def pause(self, now_ns: int) -> None:
        """Stand still."""
        self._settle(now_ns)
        self.paused = True

    def resume(self, now_ns: int) -> None:
        """Go on from where it stood still, if it does."""
        if self.paused:
            self.paused = False
            self._anchor_ns = max(self._anchor_ns, now_ns)

    def set_rate(self, rate: float, now_ns: int) -> None:
        """Go on from the position of now at another rate."""
        self._settle(now_ns)
        self.rate = rate

    def _settle(self, now_ns: int) -> None:
        if now_ns > self._anchor_ns:
            self._anchor_position_ns = self.position_ns(now_ns)
            self._anchor_ns = now_ns


class KindSteps:
    """Which kinds are played from which position of the recording on.

    The kinds in force when the clock passes a message decide about it, even where a slow host
    has made it wait since.
    """

    def __init__(self, kinds: frozenset[str] | None) -> None:
        self._steps: list[tuple[int, frozenset[str] | None]] = [(0, kinds)]

    @property
    def newest(self) -> frozenset[str] | None:
        """The kinds in force now; None for all."""
        return self._steps[-1][1]

    def change(self, kinds: frozenset[str] | None, position_ns: int) -> None:
        """Play other kinds from a position on."""
        while len(self._steps) > 1 and self._steps[-1][0] >= position_ns:
            self._steps.pop()
        self._steps.append((position_ns, kinds))

    def forget(self) -> None:
        """Have the newest kinds in force everywhere, as after a seek."""
        self._steps = [(0, self.newest)]

    def forget_before(self, position_ns: int) -> None:
        """Drop what only concerns messages before a position."""
        while len(self._steps) > 1 and self._steps[1][0] <= position_ns:
            del self._steps[0]

    def passes(self, position_ns: int, message: Response) -> bool:
        """Whether a message at a position is played."""
        _, kinds = self._steps[0]
        for begin_ns, later in self._steps[1:]:
            if begin_ns <= position_ns:
                kinds = later
        return kinds is None or kind_of(message) in kinds


def kind_of(message: Response) -> str:
    """Return the kind of a message, as filters name it.

    Examples
    --------
    >>> from xethru_protocol.messages import PresenceSingle
    >>> kind_of(PresenceSingle(counter=0, state=0, distance_m=0, direction=0, signal_quality=0))
    'presence-single'
    """
    return _UNKNOWN if isinstance(message, UnknownMessage) else _slug(ROWS[type(message)].name)


def kinds(names: Iterable[str]) -> frozenset[str]:
    """Return the kinds that names mean; case, spaces, ``-`` and ``_`` do not matter.

    Raises
    ------
    ValueError
        When a name is no kind that can be played; the message lists them.

    Examples
    --------
    >>> sorted(kinds(["DATA FLOAT", "baseband_iq"]))
    ['baseband-iq', 'data-float']
    """
    wanted = frozenset(map(_slug, names))
    for name in sorted(wanted - _KINDS):
        raise ValueError(f"{name!r} is no kind of message; known are {', '.join(sorted(_KINDS))}")
    return wanted


def is_answer(message: Response) -> bool:
    """Whether a message answers a command; nobody asks for recorded ones."""
    if isinstance(message, UnknownMessage):
        return message.code in _ANSWERS
    return ROWS[type(message)].prefix[0] in _ANSWERS


def _slug(name: str) -> str:
    return name.strip().lower().replace(" ", "-").replace("_", "-")


_KINDS = frozenset(
    _slug(row.name)
    for kind, row in ROWS.items()
    if issubclass(kind, Response) and row.prefix[0] not in _ANSWERS
) | {_UNKNOWN}
