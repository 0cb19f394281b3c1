"""Rows of a run that are found by their time."""

from __future__ import annotations

from array import array
from bisect import bisect_left
from typing import Any, Generic

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slam.robust.solver.growing_arrays import Number, PackedRows


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
