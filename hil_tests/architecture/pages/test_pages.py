"""The documents that a program makes are those of the source and of the recorded results."""

from types import ModuleType
from typing import Any

import pytest

from hil_tests.architecture.pages import breathing, constants, protocol, results
from hil_tests.architecture.pages.breathing import NOBODY, nobody_table, rest_table
from hil_tests.architecture.pages.results import README, groups_table

in_the_source_tree = pytest.mark.skipif(
    not README.exists(), reason="documents are in the source tree"
)


@in_the_source_tree
@pytest.mark.parametrize("module", [breathing, constants, protocol, results])
def test_a_document_is_what_its_program_writes(module: ModuleType) -> None:
    """Else: python -m hil_tests.architecture.pages.MODULE."""
    for path, text in module.documents().items():
        assert path.read_text("utf-8") == text


@in_the_source_tree
def test_the_readme_is_short() -> None:
    assert len(README.read_bytes()) <= 10_000, "put what is not for everybody into docs/"


def test_a_group_is_a_row_of_its_numbers() -> None:
    """Errors in mm, ratios without a unit, no smoothed path for preset paper."""
    paper: dict[str, Any] = {
        "scene": "lab",
        "preset": "paper",
        "stress": "clean",
        "runs": 4,
        "odometry_ate_rmse_m": {"median": 0.0506, "p90": 0.1},
        "ate_rmse_m": {"median": 0.025, "p90": 0.03125},
        "ratio": {"median": 0.5, "p90": 1.5},
        "smoothed": None,
        "anees_mean": 2.75,
        "anees_pose": [[10.0, 1.0], [20.0, 3.0]],
        "anees_band_95": [1.25, 5.5],
        "landmark_medians": {"precision": 1.0, "recall": None},
        "runs_above_odometry": 1,
        "runs_lost": 0,
        "carries": 0,
        "carries_in_time": 0,
    }
    smoothed = {"ate_rmse_m": {"median": 0.002, "p90": 0.003}, "ratio": {"median": 0.04}}
    lagged = {"ate_rmse_m": {"median": 0.009, "p90": 0.0095}, "ratio": {"median": 0.18}}
    later = {"lagged": lagged, "smoothed": smoothed}
    robust = paper | later | {"preset": "robust", "carries": 4, "carries_in_time": 3}
    numbers = "4 | 50.6 (100.0) | 25.0 (31.2) | 0.50"
    rest = "2.8 (1 of 2 in 1.2-5.5) | 1.00, - | 1 | 0"
    assert groups_table([paper, robust]).splitlines()[2:] == [
        f"| `paper` | {numbers} | - | - | - | {rest} | - |",
        f"| `robust` | {numbers} | 9.0 (9.5) | 2.0 (3.0) | 0.04 | {rest} | 3 of 4 |",
    ]


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
