"""The statistics of a sweep, from runs whose numbers are chosen so that no two statistics agree."""

import dataclasses

import pytest

from slam.app.summary import LandmarkSummary, Summary
from slam.app.sweep import summarise_groups

RUN = Summary(
    scene="a",
    preset="paper",
    seed=0,
    frames=100,
    duration_s=10.0,
    realtime_factor=50.0,
    ate_rmse_m=0.01,
    ate_icp_rmse_m=0.005,
    odometry_ate_rmse_m=0.04,
    final_error_m=0.02,
    landmarks=LandmarkSummary(
        true=4, estimated=4, precision=1.0, recall=1.0, duplicates=0, rmse_m=0.01
    ),
    nees_pose=((1.0, 2.0), (9.9, 1.0)),
    nis_mean=0.5,
)


def other(seed: int, ate_m: float, nees: float, nis: float | None, recall: float) -> Summary:
    return dataclasses.replace(
        RUN,
        seed=seed,
        ate_rmse_m=ate_m,
        nees_pose=((1.2, nees), (9.6, 4.0)),
        nis_mean=nis,
        landmarks=dataclasses.replace(RUN.landmarks, precision=None, recall=recall, rmse_m=None),
    )


def test_a_group_counts_averages_and_takes_medians() -> None:
    # one of three is worse than odometry
    runs = [RUN, other(1, 0.05, 3.0, 1.7, 0.5), other(2, 0.02, 7.0, None, 0.75)]
    (group,) = summarise_groups(runs)
    assert (group["scene"], group["preset"], group["runs"]) == ("a", "paper", 3)
    assert group["runs_below_odometry"] == 2
    assert group["ate_rmse_m"]["median"] == 0.02
    # 80 % of the way from the second to the third of three
    assert group["ate_rmse_m"]["p90"] == pytest.approx(0.044)
    (first_s, first), (last_s, last) = group["anees_pose"]
    assert (first_s, first) == (pytest.approx(3.4 / 3), pytest.approx(4.0))
    assert (last_s, last) == (pytest.approx(29.1 / 3), pytest.approx(3.0))
    assert group["nis_mean"] == pytest.approx(1.1)
    assert group["landmark_medians"] == {"precision": 1.0, "recall": 0.75, "rmse_m": 0.01}


def test_scenes_and_presets_are_groups_of_their_own_in_order() -> None:
    runs = [
        RUN,
        dataclasses.replace(RUN, scene="b", nis_mean=None),
        dataclasses.replace(RUN, preset="robust"),
        dataclasses.replace(RUN, seed=1),
    ]
    groups = summarise_groups(runs)
    names = [(group["scene"], group["preset"], group["runs"]) for group in groups]
    assert names == [("a", "paper", 2), ("b", "paper", 1), ("a", "robust", 1)]
    assert groups[1]["nis_mean"] is None
