"""Arrays that grow by one row at a time: a run keeps numbers of every state, and no objects."""

from __future__ import annotations

from typing import Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

Number = TypeVar("Number", bound=np.generic)

_FIRST_ROWS = 64


class PackedRows(Generic[Number]):
    """Rows of one shape and type in one buffer, whose size is doubled when it is full.

    >>> poses = PackedRows(np.float64, 3)
    >>> poses.append([1.0, 2.0, 0.5])
    >>> poses.rows
    array([[1. , 2. , 0.5]])
    """

    def __init__(self, kind: type[Number], *shape: int) -> None:
        self._buffer: NDArray[Number] = np.empty((_FIRST_ROWS, *shape), dtype=kind)
        self._n_rows = 0

    def __len__(self) -> int:
        return self._n_rows

    @property
    def rows(self) -> NDArray[Number]:
        """Return the rows so far, shape (n, ...); a view, which later rows do not change."""
        return self._buffer[: self._n_rows]

    def append(self, row: ArrayLike) -> None:
        """Add one row of the shape that was given at first."""
        if self._n_rows == len(self._buffer):
            more = np.empty_like(self._buffer, shape=(2 * self._n_rows, *self._buffer.shape[1:]))
            more[: self._n_rows] = self._buffer
            self._buffer = more
        self._buffer[self._n_rows] = row
        self._n_rows += 1
