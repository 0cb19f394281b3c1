"""The tables of results on `docs/results.md` and in README are those of the recorded sweeps."""

from typing import Any

import pytest

from hil_tests.architecture.pages.results import (
    PAGE,
    README,
    groups_table,
    page,
    readme_with_table,
)

in_the_source_tree = pytest.mark.skipif(
    not README.exists(), reason="documents are in the source tree"
)


@in_the_source_tree
def test_the_page_is_that_of_the_baselines() -> None:
    """Else: python -m hil_tests.architecture.pages.results."""
    assert PAGE.read_text() == page()


@in_the_source_tree
def test_the_table_of_the_readme_is_that_of_the_baselines() -> None:
    readme = README.read_text()
    assert readme_with_table(readme) == readme


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
    robust = paper | {"preset": "robust", "smoothed": smoothed, "carries": 4, "carries_in_time": 3}
    numbers = "4 | 50.6 (100.0) | 25.0 (31.2) | 0.50"
    rest = "2.8 (1 of 2 in 1.2-5.5) | 1.00, - | 1 | 0"
    assert groups_table([paper, robust]).splitlines()[2:] == [
        f"| `paper` | {numbers} | - | - | {rest} | - |",
        f"| `robust` | {numbers} | 2.0 (3.0) | 0.04 | {rest} | 3 of 4 |",
    ]
