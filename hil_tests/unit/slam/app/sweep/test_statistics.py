"""What is counted of a sweep's runs: groups and bands."""

from dataclasses import replace

import pytest

from hil_tests.unit.slam.app.sweep.sweep_runs import run_of
from slam.app.errors import UsageError
from slam.app.sweep.bound import BoundSummary
from slam.app.sweep.run import SweepRun, make_case
from slam.app.sweep.statistics import in_band, summarise_groups
from slam.app.sweep.sweep import rooms_named
from slam.app.sweep.table import group_line, stress_table, stress_tables, times_clean
from slam.library.evaluation import LandmarkScore

RUN = replace(
    run_of(make_case("lab", "paper", 0)),
    scene="a",
    ate_rmse_m=0.01,
    smoothed_ate_rmse_m=None,
    smoothed_nees_pose=None,
    landmarks=LandmarkScore(
        true=4, observable=4, estimated=4, precision=1.0, recall=1.0, duplicates=0, rmse_m=0.01
    ),
    nis_mean=0.5,
    nis_times=(),
    false=0,
    confident_false=0,
    bound=None,
)


def other(seed: int, ate_m: float, nees: float, nis: float | None, recall: float) -> SweepRun:
    return replace(
        RUN,
        seed=seed,
        ate_rmse_m=ate_m,
        nees_pose=((1.2, nees), (9.6, 4.0)),
        nis_mean=nis,
        landmarks=replace(RUN.landmarks, precision=None, recall=recall, rmse_m=None),
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
        replace(RUN, scene="b", nis_mean=None),
        replace(RUN, preset="robust"),
        replace(RUN, seed=1),
    ]
    groups = summarise_groups(runs)
    names = [(group["scene"], group["preset"], group["runs"]) for group in groups]
    assert names == [("a", "paper", 2), ("b", "paper", 1), ("a", "robust", 1)]
    assert groups[1]["nis_mean"] is None


def stressed(stress: str, seed: int, ate_m: float) -> SweepRun:
    return replace(RUN, stress=stress, seed=seed, ate_rmse_m=ate_m)


def test_rooms_of_a_family_are_one_group() -> None:
    cases = [
        case
        for name in rooms_named(["rig:3-4"])
        for case in make_case(name, "paper", 0).with_seeds(2)
    ]
    assert [(case.scene.name, case.seed) for case in cases] == [
        ("rig_3", 3),
        ("rig_3", 10_003),
        ("rig_4", 4),
        ("rig_4", 10_004),
    ]
    runs = [replace(run_of(case), family="rig") for case in cases]
    (group,) = summarise_groups([*runs])
    assert (group["scene"], group["runs"]) == ("rig", 4)
    lab = make_case("lab", "paper", 0, laps=2)
    assert [case.seed for case in lab.with_seeds(3, 1000)] == [1000, 1001, 1002]
    assert lab.scene.path.laps == ("forward", "forward")
    with pytest.raises(UsageError):
        make_case("lab", "paper", 0, laps=5)
    with pytest.raises(UsageError):
        rooms_named(["rig:4-3"])


def test_settings_and_stresses_are_groups_named_by_them() -> None:
    runs = [RUN, replace(RUN, settings={"a.b": "1"}), stressed("skew", 0, 0.02)]
    lines = [group_line(group) for group in summarise_groups(runs)]
    assert [line.partition(", 1 runs")[0] for line in lines] == [
        "a, preset paper",
        "a, preset paper, a.b=1",
        "a, preset paper, stress skew",
    ]


def test_a_group_says_how_good_its_maps_are() -> None:
    twice = replace(RUN.landmarks, duplicates=2)
    runs = [
        replace(RUN, seed=1, landmarks=twice),
        *(replace(RUN, seed=seed, false=seed, confident_false=1) for seed in (2, 3, 4)),
    ]
    (group,) = summarise_groups(runs)
    assert group["without_duplicates"] == 0.75
    assert (group["false_per_run"], group["confident_false"]) == (2.25, 3)


def test_nis_is_averaged_over_seeds_by_degrees_of_freedom() -> None:
    """Bands by hand: chi-square with 10 dof has 3.247 and 20.483 at 2.5 and 97.5 %."""
    runs = [
        replace(RUN, nis_times=((1.0, 2.0, 2), (2.0, 0.0, 0))),
        replace(RUN, seed=1, nis_times=((3.0, 10.0, 8), (2.0, 0.0, 0))),
        replace(RUN, seed=2, nis_times=()),
    ]
    (group,) = summarise_groups(runs)
    first, second = group["nis_times"]
    assert first == pytest.approx([2.0, 1.2, 0.3247, 2.0483], rel=1e-4)
    assert second == [2.0, None, None, None]


def test_the_bound_has_the_same_statistics() -> None:
    bounds = [
        BoundSummary(filtered_ate_rmse_m=f, smoothed_ate_rmse_m=s, nees_pose=((1.0, n),))
        for f, s, n in ((0.01, 0.004, 2.0), (0.02, 0.006, 4.0), (0.03, 0.005, 6.0))
    ]
    runs = [replace(RUN, seed=i, bound=bound) for i, bound in enumerate(bounds)]
    (group,) = summarise_groups(runs)
    assert group["bound"]["filtered_ate_rmse_m"] == {
        "median": 0.02,
        "p90": pytest.approx(0.028),
    }
    assert group["bound"]["smoothed_ate_rmse_m"]["median"] == 0.005
    assert group["bound"]["anees_pose"] == [[1.0, pytest.approx(4.0)]]
    assert "known association: filtered median 20.0 mm, smoothed 5.0 mm" in group_line(group)
    assert summarise_groups([RUN])[0]["bound"] is None


def test_smoothed_paths_have_median_ratio_and_mean_nees() -> None:
    """Wheels of RUN, and ratios by hand."""
    wheels_m = RUN.odometry_ate_rmse_m
    runs = [
        replace(RUN, seed=i, smoothed_ate_rmse_m=share * wheels_m, smoothed_nees_pose=((1.0, n),))
        for i, (share, n) in enumerate(((0.1, 2.0), (0.2, 4.0), (0.3, 6.0)))
    ]
    (group,) = summarise_groups([*runs, replace(RUN, seed=9)])
    smoothed = group["smoothed"]
    assert smoothed["runs"] == 3
    assert smoothed["ate_rmse_m"]["median"] == pytest.approx(0.2 * wheels_m)
    assert smoothed["ratio"] == {"median": pytest.approx(0.2), "p90": pytest.approx(0.28)}
    assert smoothed["anees_pose"] == [[1.0, pytest.approx(4.0)]]
    text = group_line(group)
    assert f"smoothed median {200 * wheels_m:.1f} mm (0.20 of odometry's)" in text
    assert summarise_groups([RUN])[0]["smoothed"] is None


def test_a_stress_table_compares_with_its_own_clean_group() -> None:
    runs = [
        RUN,
        stressed("skew", 0, 0.015),
        replace(RUN, preset="robust", ate_rmse_m=0.001),
        replace(stressed("skew", 0, 0.004), preset="robust"),
        replace(RUN, scene="b"),
    ]
    groups = summarise_groups(runs)
    tables = stress_tables(groups)
    assert [(clean["scene"], clean["preset"]) for clean, _ in tables] == [
        ("a", "paper"),
        ("a", "robust"),
    ]
    times = [[times_clean(row, clean, "median") for row in rows] for clean, rows in tables]
    assert times == [[1.0, pytest.approx(1.5)], [1.0, pytest.approx(4.0)]]
    # one run of 3 dof: 0.216 to 9.35, and both of its times lie within
    assert in_band(groups[0]) == 2
    printed = [stress_table(*table) for table in stress_tables(groups)]
    assert [[row[0] for row in rows] for _, _, rows in printed] == [["clean", "skew"]] * 2
    assert "a, preset robust, 1 runs" in printed[1][0]
