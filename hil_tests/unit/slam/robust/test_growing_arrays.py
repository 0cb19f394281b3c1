"""Packed rows: a copy is independent, whichever side writes or appends first."""

import copy

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam.robust.solver.growing_arrays import PackedRows

INT = np.dtype(np.int64)
# Which of several copies does what: append, write to a row, or be copied
ACTIONS = st.lists(
    st.tuples(st.integers(0, 5), st.sampled_from(["append", "write", "copy"]), st.integers(0, 200)),
    max_size=60,
)


@given(st.integers(0, 130), ACTIONS)
def test_copies_are_independent_as_lists_are(n: int, actions: list[tuple[int, str, int]]) -> None:
    packed, lists = [PackedRows(INT)], [list(range(n))]
    for value in range(n):
        packed[0].append(value)
    for k, (which, action, value) in enumerate(actions):
        place = which % len(packed)
        rows, wanted = packed[place], lists[place]
        if action == "copy":
            packed.append(copy.deepcopy(rows))
            lists.append(wanted.copy())
        elif action == "append":
            rows.append(-k)
            wanted.append(-k)
        elif wanted:
            first = value % len(wanted)
            rows.rows_to_write(first)[:] = k
            wanted[first:] = [k] * (len(wanted) - first)
    for rows, wanted in zip(packed, lists, strict=True):
        assert rows.rows.tolist() == wanted


def test_a_copy_shares_memory_until_one_of_them_writes() -> None:
    rows = PackedRows(INT)
    for value in range(10):
        rows.append(value)
    copied = copy.deepcopy(rows)
    rows.append(10)  # behind what the copy has
    assert np.shares_memory(rows.rows, copied.rows)
    rows.rows_to_write(10)[0] = 11
    assert np.shares_memory(rows.rows, copied.rows)
    copied.append(12)
    assert not np.shares_memory(rows.rows, copied.rows)
    assert (rows.rows[-1], copied.rows[-1]) == (11, 12)


def test_rows_cannot_be_written_to_by_accident() -> None:
    rows = PackedRows(INT)
    rows.append(1)
    with pytest.raises(ValueError, match="read-only"):
        rows.rows[0] = 2
