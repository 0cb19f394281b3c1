"""summary.json and the table: exact fields, no NaN, every ATE with its ratio."""

import dataclasses
import json

import pytest

from slam.app.run.evaluation import LandmarkSummary, Summary
from slam.app.run.output import summary_rows, table_text

SUMMARY = Summary(
    scene="lab",
    preset="paper",
    seed=3,
    frames=13876,
    duration_s=691.2,
    realtime_factor=70.0,
    ate_rmse_m=0.0141,
    ate_icp_rmse_m=0.0089,
    odometry_ate_rmse_m=0.0564,
    final_error_m=0.02,
    landmarks=LandmarkSummary(
        true=14, estimated=15, precision=14 / 15, recall=1.0, duplicates=1, rmse_m=0.012
    ),
    nees_pose=((69.12, 2.5), (691.2, 3.25)),
    nis_mean=1.1,
)


def test_the_fields_are_those_of_the_contract() -> None:
    data = json.loads(SUMMARY.to_json())
    assert list(data) == [
        "scene",
        "preset",
        "seed",
        "frames",
        "duration_s",
        "realtime_factor",
        "ate_rmse_m",
        "ate_icp_rmse_m",
        "odometry_ate_rmse_m",
        "final_error_m",
        "landmarks",
        "nees_pose",
        "nis_mean",
    ]
    assert list(data["landmarks"]) == [
        "true",
        "estimated",
        "precision",
        "recall",
        "duplicates",
        "rmse_m",
    ]
    assert data["nees_pose"] == [[69.12, 2.5], [691.2, 3.25]]


def test_nan_is_refused() -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        dataclasses.replace(SUMMARY, ate_rmse_m=float("nan")).to_json()


def test_the_table_gives_the_ratio() -> None:
    rows = summary_rows(SUMMARY, lag_states=14, wall_s=9.9, lost_frames=0)
    text = table_text("title", None, rows)
    assert "14.1 mm" in text
    assert "0.25 of odometry's, SE(2)-aligned, filtered, 14 states late" in text
    # 8.9 / 56.4
    assert "0.16 of odometry's ATE" in text
    assert "70 x real time" in text
    assert "0 lost" in text
    assert max(map(len, text.splitlines())) <= 100


def test_a_map_without_a_match_has_dashes() -> None:
    nothing = LandmarkSummary(
        true=14, estimated=0, precision=None, recall=0.0, duplicates=0, rmse_m=None
    )
    rows = summary_rows(
        dataclasses.replace(SUMMARY, landmarks=nothing), lag_states=0, wall_s=1.0, lost_frames=2
    )
    text = table_text("title", None, rows)
    assert "SE(2)-aligned, causal" in text
    assert "precision -, recall 0.00, 0 duplicates, rmse -" in text
