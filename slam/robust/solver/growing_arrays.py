"""Arrays that grow by one row at a time: a run keeps numbers of every state, and no objects."""

from __future__ import annotations

import copy
from array import array
from bisect import bisect_left
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

Number = TypeVar("Number", bound=np.generic)

_FIRST_ROWS = 64


class PackedRows(Generic[Number]):
    """Rows of one shape and type in one buffer, whose size is doubled when it is full.

    A type with fields makes a table: a row is a tuple then. A deep copy shares the buffer until
    either writes to a row that both have; the copy takes one of its own with its first new row.

    >>> poses = PackedRows(np.dtype(np.float64), 3)
    >>> poses.append([1.0, 2.0, 0.5])
    >>> poses.rows
    array([[1. , 2. , 0.5]])
    """

    def __init__(self, kind: np.dtype[Number], *shape: int) -> None:
        self._buffer: NDArray[Number] = np.empty((_FIRST_ROWS, *shape), dtype=kind)
        self._n_rows = 0
        self._n_shared = 0  # rows that copies may have, too
        self._is_copy = False  # then the buffer beyond the rows is another's

    def __deepcopy__(self, memo: dict[int, Any]) -> PackedRows[Number]:
        """Return a copy that shares the buffer for as long as that is possible."""
        self._n_shared = self._n_rows
        copied = copy.copy(self)
        copied._is_copy = True
        memo[id(self)] = copied
        return copied

    def __len__(self) -> int:
        return self._n_rows

    @property
    def rows(self) -> NDArray[Number]:
        """Return the rows so far, shape (n, ...): a view that is not to be written to.

        Its values stay as they are when rows are appended.
        """
        view = self._buffer[: self._n_rows]
        view.flags.writeable = False
        return view

    def rows_to_write(self, first: int = 0) -> NDArray[Number]:
        """Return a view of the rows from one on, to be written to before the next append."""
        if first < self._n_shared:
            self._take_buffer(len(self._buffer))
        return self._buffer[first : self._n_rows]

    def append(self, row: ArrayLike) -> None:
        """Add one row of the shape that was given at first."""
        if self._n_rows == len(self._buffer):
            self._take_buffer(2 * self._n_rows)
        elif self._is_copy:
            self._take_buffer(len(self._buffer))
        self._buffer[self._n_rows] = row
        self._n_rows += 1

    def _take_buffer(self, size: int) -> None:
        """Move the rows to a buffer that is this object's alone."""
        own = np.empty_like(self._buffer, shape=(size, *self._buffer.shape[1:]))
        own[: self._n_rows] = self._buffer[: self._n_rows]
        self._buffer, self._n_shared, self._is_copy = own, 0, False


class RowsByTime(Generic[Number]):
    """Packed rows by the times [ns] they are of; the last one of a time counts.

    Times may come in any order, but need a dictionary once one is not later than all before it.

    >>> counters = RowsByTime(np.dtype(np.int64))
    >>> counters.put(200, 1)
    >>> int(counters.at(200)), counters.at(201)
    (1, None)
    """

    def __init__(self, kind: np.dtype[Number], *shape: int) -> None:
        self._stamps_ns = array("q")
        self._rows = PackedRows(kind, *shape)
        self._places: dict[int, int] | None = None

    def __len__(self) -> int:
        return len(self._rows)

    @property
    def rows(self) -> NDArray[Number]:
        """Return the rows in the order in which their times came first."""
        return self._rows.rows

    def put(self, t_ns: int, row: ArrayLike) -> None:
        if self._stamps_ns and t_ns <= self._stamps_ns[-1] and self._places is None:
            self._places = {stamp_ns: place for place, stamp_ns in enumerate(self._stamps_ns)}
        if self._places is not None:
            place = self._places.setdefault(t_ns, len(self))
            if place < len(self):
                self._rows.rows_to_write(place)[0] = row
                return
        self._stamps_ns.append(t_ns)
        self._rows.append(row)

    def at(self, t_ns: int) -> Any:  # noqa: ANN401 - a scalar or an array, as the rows are
        """Return the row of a time, None if there is none; one with fields can be written to."""
        if self._places is not None:
            place = self._places.get(t_ns)
            return None if place is None else self._rows.rows_to_write(place)[0]
        place = bisect_left(self._stamps_ns, t_ns)
        is_there = place < len(self._stamps_ns) and self._stamps_ns[place] == t_ns
        return self._rows.rows_to_write(place)[0] if is_there else None
