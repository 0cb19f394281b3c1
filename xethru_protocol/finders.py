"""Where the next start or end of a packet stands; what was searched once is remembered.

All positions are offsets in the stream; a buffer is given with the offset ``base`` of its first
byte. No byte is searched twice by one finder, however the bytes arrive.
"""

import re
from bisect import bisect_right
from typing import Final

import numpy as np

from xethru_protocol.packets import ESCAPE, START, unescape

NEVER: Final = 1 << 62  # a stream offset that is not reached

_NEAR: Final = 256  # in which most packets end: looked at before more is marked
_WORTH_MARKING: Final = 2048  # fewer bytes are searched faster by a regular expression
_WINDOW: Final = 65536  # most bytes marked at once
# Greedy, but never tried again: what is in front of an unescaped 7D or 7E, or of a last 7F.
_CONTENT = re.compile(rb"[^\x7d-\x7f]*(?:\x7f.[^\x7d-\x7f]*)*", re.DOTALL)


class PatternFinder:
    """Where a byte pattern comes next."""

    __slots__ = ("_found", "_pattern", "_searched")

    def __init__(self, pattern: bytes) -> None:
        self._pattern = pattern
        self._found = -1
        self._searched = 0

    def next(self, buffer: bytes, base: int, here: int, stop: int = NEVER) -> int:
        """Find the first pattern at or after ``here``; NEVER if there is none before ``stop``.

        No pattern may lie across ``stop``.
        """
        if here <= self._found:
            return self._found if self._found < stop else NEVER
        begin = max(here, self._searched)
        if begin >= stop:
            return NEVER
        limit = base + len(buffer)
        at = buffer.find(self._pattern, begin - base, min(stop, limit) - base)
        if at >= 0:
            self._found = self._searched = base + at
            return self._found
        self._searched = stop if stop < limit else max(begin, limit - len(self._pattern) + 1)
        return NEVER


class TerminatorFinder:
    """Where the next 7D or 7E stands that is not escaped: it ends a Normal packet, well or badly.

    Escaped is a byte behind an odd number of 7F in a row. A start is no 7F, so that run lies
    behind the start whatever start is asked for: which bytes are terminators depends on none,
    and those of a whole window can be marked at once.

    ``searched`` is the offset up to which the bytes are known; the byte there is not escaped.
    """

    __slots__ = ("_found", "_next", "_window", "searched")

    def __init__(self) -> None:
        self._found: list[int] = []  # ascending
        self._next = 0  # index in it of the first behind the last start
        self._window = _Window(b"", 0, 0)  # where they were found, unless there is only one
        self.searched = 0

    def after(self, buffer: bytes, base: int, start: int, reach: int) -> int:
        """Find the first terminator behind the packet start at ``start``.

        -1 if it is not in the buffer, or farther than ``reach`` bytes behind the start.
        """
        while True:
            self._next = bisect_right(self._found, start, self._next)
            if self._next < len(self._found):
                return self._found[self._next]
            at = max(start + 1, self.searched) - base
            left = len(buffer) - at
            if left <= 0 or base + at > start + reach:
                return -1
            stop = at + (left if left < _WORTH_MARKING else _NEAR)
            content = _CONTENT.match(buffer, at, stop)
            at = content.end() if content else at  # it always matches
            self.searched = base + at
            if at < stop and buffer[at] != ESCAPE:
                self._found, self._next = [base + at], 0
                self.searched += 1
            elif stop == len(buffer):
                return -1
            else:
                self._window = window = _Window(buffer, base, at)
                self._found, self._next, self.searched = window.found, 0, window.end

    def content(self, buffer: bytes, base: int, start: int) -> bytes:
        """Unescape what lies between ``start`` and the terminator just found behind it."""
        if self._next and self._found[self._next - 1] == start:
            return self._window.content(self._next)
        return unescape(buffer[start + 1 - base : self._found[self._next] - base])


class _Window:
    """Bytes whose terminators were marked together; the first of them is not escaped.

    ``found`` are the offsets of the terminators, ``end`` is that of the first byte behind the
    window that is not escaped by it.
    """

    __slots__ = ("_bounds", "_bytes", "_drop", "_places", "_unescaped", "end", "found")

    def __init__(self, buffer: bytes, base: int, begin: int) -> None:
        piece = buffer[begin : begin + _WINDOW]  # a copy: the buffer may be large, and done with
        size = len(piece)
        self._bytes = np.frombuffer(piece, np.uint8)
        special = np.flatnonzero(self._bytes - np.uint8(START) < 3)  # 7D to 7F; less wraps around
        is_escape = self._bytes[special] == ESCAPE
        # A special byte is free if an even number of 7F stands right before it.
        order = np.arange(special.size)
        behind_escape = np.zeros(special.size, np.bool_)
        behind_escape[1:] = is_escape[:-1] & (special[1:] - special[:-1] == 1)
        free = (order - np.maximum.accumulate(np.where(behind_escape, 0, order))) & 1 == 0
        self._places = special[free & ~is_escape]  # of the terminators
        self._drop = special[free & is_escape]  # bytes that escape the next
        self._unescaped = b""  # the window without those, made when the first packet asks
        self._bounds: list[int] = []  # where the terminators lie in that
        self.found: list[int] = (self._places + (base + begin)).tolist()
        splits = self._drop.size and self._drop[-1] == size - 1
        self.end = base + begin + size - (1 if splits else 0)

    def content(self, index: int) -> bytes:
        """Unescape what lies between the terminator before the ``index``-th and that one."""
        if not self._unescaped:
            keep = np.ones(self._bytes.size, np.bool_)
            keep[self._drop] = False
            self._unescaped = self._bytes[keep].tobytes()
            self._bounds = (self._places - np.searchsorted(self._drop, self._places)).tolist()
        return self._unescaped[self._bounds[index - 1] + 1 : self._bounds[index]]
