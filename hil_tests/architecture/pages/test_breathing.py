"""The tables of `docs/breathing.md` are those of the measured windows."""

import json
from typing import Any

import pytest

from hil_tests.architecture.pages.breathing import (
    BASELINE,
    NOBODY,
    PAGE,
    nobody_table,
    page_with_tables,
    rest_table,
)


@pytest.mark.skipif(not PAGE.exists(), reason="documents are in the source tree")
def test_the_tables_are_those_of_the_baseline() -> None:
    """Else: python -m hil_tests.architecture.pages.breathing."""
    page = PAGE.read_text()
    assert page_with_tables(page, json.loads(BASELINE.read_text())) == page


def cell(row: str, column: str, range_m: float | None, *counts: int) -> dict[str, Any]:
    right, wrong, none = counts
    place = {"row": row, "column": column, "range_m": range_m}
    return place | {"right": right, "wrong": wrong, "none": none}


def test_a_cell_is_its_counts() -> None:
    postures = ("facing", "side", "back", "supine", "on a side")
    cells = [
        *(cell("rest", posture, 2.0, 17, 1, 2) for posture in postures),
        cell("rf", "facing", 2.0, 20, 0, 0),
        cell("fidgets", "facing", 2.0, 3, 0, 17),
        *(cell("nobody", column, None, 0, 3, 197) for column, _ in NOBODY),
    ]
    rows = rest_table({"cells": cells}).splitlines()
    assert rows[0] == "| somebody who | 2 m |"
    assert rows[2] == "| faces the radar | 17 of 20, 1 wrong |"
    assert rows[-1].endswith("| 3 of 20 |")
    assert nobody_table({"cells": cells}).splitlines()[2] == "| nobody | 200 | 3 | 1.5 % |"
