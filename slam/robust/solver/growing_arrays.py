"""Arrays that grow by one row at a time: a run keeps numbers of every state, and no objects."""

from __future__ import annotations

import copy
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
