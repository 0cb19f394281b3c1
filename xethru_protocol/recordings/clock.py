"""Times of a recording that do not fall, whatever the recorder's clock did.

Clocks of recorders restart, are set back and are stored in damaged bytes, while the frame counter
goes on. A time that falls is put right, and reported, unless it is only that of another kind of
message, which was stored less than a second too late:

* one time that lies outside of its neighbours' is taken from between them, by the counter;
* else the clock was set back. What passed meanwhile is the counter's step times the usual time of
  a step, and all later times follow. Without a counter they go on where the clock was set back.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from statistics import median
from typing import Generic, TypeVar

import numpy as np
import numpy.typing as npt

from xethru_protocol.recordings.recorded_messages import (
    NO_TIME_NS,
    FaultHandler,
    RecordingError,
    RecordingFault,
    report,
)
from xethru_protocol.wire.messages import DataFloat

Item = TypeVar("Item")
_REMEMBERED = 64  # times that show how long a step of the counter lasts
_COUNTERS = 2**32
_LATE_NS = 1_000_000_000
_MOST_NS = 2**63 - 1


@dataclass(slots=True)
class _Row(Generic[Item]):
    number: int  # from 1
    item: Item
    t_ns: int


class _Clock(Generic[Item]):
    """Puts times right. ``count`` gives an item's counter with what it is a counter of."""

    def __init__(
        self,
        count: Callable[[Item], tuple[str, int] | None],
        note: Callable[[int, str], None],
    ) -> None:
        self._count, self._note = count, note
        self._recent: deque[_Row[Item]] = deque(maxlen=_REMEMBERED)
        self._later_ns = 0

    def right(self, rows: Iterable[tuple[Item, int | None]]) -> Iterator[tuple[Item, int | None]]:
        """Yield the rows; an error of theirs comes behind what they gave before it."""
        held: list[_Row[Item]] = []  # what the next time may put right: if two, the second fell
        newest_ns: dict[type, int] = {}  # of each kind of item
        numbered = enumerate(rows, start=1)
        while True:
            try:
                number, (item, t_ns) = next(numbered)
            except StopIteration:
                yield from self._released(held)
                return
            except RecordingError:
                yield from self._released(held)
                raise
            if t_ns is None:
                yield from self._released(held)
                held = []
                yield item, None
                continue
            row = _Row(number, item, t_ns + self._later_ns)
            if len(held) == 2:
                self._settle(held[0], held[1], row)
                yield from self._released(held[:1])
                del held[0]
            last = held[-1] if held else self._recent[-1] if self._recent else row
            own_ns = newest_ns.get(type(item), row.t_ns)
            newest_ns[type(item)] = row.t_ns
            if own_ns <= row.t_ns < last.t_ns < row.t_ns + _LATE_NS:
                yield item, row.t_ns
                continue
            if row.t_ns >= last.t_ns:
                yield from self._released(held)
                held = [row]
            elif held:
                held.append(row)
            else:
                self._settle(last, row, None)
                held = [row]

    def _released(self, held: list[_Row[Item]]) -> Iterator[tuple[Item, int | None]]:
        if len(held) == 2:
            self._settle(held[0], held[1], None)
        self._recent.extend(held)
        return ((row.item, min(row.t_ns, _MOST_NS)) for row in held)

    def _settle(self, last: _Row[Item], fallen: _Row[Item], following: _Row[Item] | None) -> None:
        """Put right what made the time of ``fallen`` less than that of ``last``."""
        before = self._recent[-1] if self._recent else None
        if following is not None and following.t_ns >= last.t_ns:
            self._put_between(last, fallen, following)
        elif before is not None and before.t_ns <= fallen.t_ns:
            self._put_between(before, last, fallen)
        elif before is None and following is not None and following.t_ns >= fallen.t_ns:
            self._note(last.number, "its time is not that of those behind it")
            last.t_ns = 2 * fallen.t_ns - following.t_ns
        else:
            self._set_back(last, fallen, following)

    def _put_between(self, before: _Row[Item], row: _Row[Item], behind: _Row[Item]) -> None:
        steps, all_steps = self._steps(before, row), self._steps(before, behind)
        part = steps / all_steps if 0 < steps < all_steps else 0.5
        right_ns = before.t_ns + round(part * (behind.t_ns - before.t_ns))
        self._note(row.number, f"its time is {_seconds(row.t_ns - right_ns)} s off")
        row.t_ns = right_ns

    def _set_back(self, last: _Row[Item], fallen: _Row[Item], following: _Row[Item] | None) -> None:
        right_ns = self._right_ns([*self._recent, last], fallen)
        told = "their order tells no more"
        if right_ns is None or right_ns < last.t_ns:
            right_ns = last.t_ns
        else:
            told = f"by the counter {_seconds(right_ns - last.t_ns)} s passed"
        later_ns = right_ns - fallen.t_ns
        self._note(
            fallen.number,
            f"the clock of the recorder was set back by {_seconds(last.t_ns - fallen.t_ns)} s; "
            f"{told}, so times from here on are {_seconds(later_ns)} s later than recorded",
        )
        self._later_ns += later_ns
        for row in (fallen, following):
            if row is not None:
                row.t_ns += later_ns

    def _right_ns(self, recent: list[_Row[Item]], row: _Row[Item]) -> int | None:
        """Return when an item came by its counter and earlier ones; None if they do not tell."""
        counted = [one for one in recent if self._steps(one, row) > 0]
        periods_ns = [
            (later.t_ns - one.t_ns) / steps
            for one, later in pairwise(counted)
            if (steps := self._steps(one, later)) > 0
        ]
        if not periods_ns:
            return None
        return counted[-1].t_ns + round(self._steps(counted[-1], row) * median(periods_ns))

    def _steps(self, one: _Row[Item], later: _Row[Item]) -> int:
        """Return by how much a counter has risen; 0 if it has not, or they have none in common."""
        before, behind = self._count(one.item), self._count(later.item)
        if before is None or behind is None or before[0] != behind[0]:
            return 0
        steps = (behind[1] - before[1]) % _COUNTERS
        return steps if steps < _COUNTERS // 2 else 0


def _seconds(t_ns: int) -> str:
    return f"{t_ns * 1e-9:.3f}"


def counter_of(message: object) -> tuple[str, int] | None:
    """Return the frame counter of a message with its type; None if it has none."""
    if isinstance(message, DataFloat):
        return ("DataFloat", message.info) if message.content_id == 0 else None
    counter = getattr(message, "counter", None)
    return None if counter is None else (type(message).__name__, counter)


def steady(
    rows: Iterable[tuple[Item, int | None]],
    file: str,
    on_fault: FaultHandler | None,
    count: Callable[[Item], tuple[str, int] | None] = counter_of,
) -> Iterator[tuple[Item, int | None]]:
    """Yield what a recorder stored with times that do not fall; what was put right is reported.

    ``count`` gives the counter of an item that is no message. What has no time stays without one.
    """

    def note(number: int, text: str) -> None:
        reason = f"message {number}: {text}"
        report(RecordingFault(file=file, offset=0, reason=reason, minor=True), on_fault)

    return _Clock(count, note).right(rows)


def steady_times(
    t_ns: npt.NDArray[np.int64],
    counters: Iterable[tuple[str, int] | None],
    note: Callable[[int, str], None] = lambda number, text: None,
) -> npt.NDArray[np.int64]:
    """Return the times of frames so that they do not fall, both of shape (n,).

    ``counters`` are as `counter_of` gives them; they are read only where a time falls.
    """
    known = t_ns != NO_TIME_NS
    if (t_ns[known][1:] >= t_ns[known][:-1]).all():
        return t_ns
    rows = (row for row in zip(counters, t_ns.tolist(), strict=False) if row[1] != NO_TIME_NS)
    right = t_ns.copy()
    right[known] = [time_ns or 0 for _, time_ns in _Clock(lambda count: count, note).right(rows)]
    return right
