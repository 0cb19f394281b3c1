"""Victoria Park: the reader, the conversion to range and bearing, and both back ends on it."""

import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest

from slam.app.cli import main
from slam.app.errors import AppError
from slam.app.experiments.victoria_park import (
    PERFECT_WHEELS,
    batch_reference,
    drive_back_end,
    range_bearing,
    read_drive,
    right_share,
    shipped_file,
)
from xethru_protocol.system import StopFlag

LINES = """\
ODOMETRY 0 1 0.5 0.01 0.1 0.0001 0 0 4e-06 1e-06 9e-06
LANDMARK 1 2 3.0 -4.0 0.4 0.1 0.3
ODOMETRY 1 3 0.2 0 -0.1 0.0001 0 0 4e-06 0 4e-06
LANDMARK 3 2 2.8 -4.1 0.4 0 0.4
LANDMARK 3 4 6 1 0.4 0 0.4
"""


def test_the_reader_numbers_poses_anew_and_keeps_ids(tmp_path: Path) -> None:
    path = tmp_path / "park.txt"
    path.write_text(LINES, encoding="ascii")
    drive = read_drive(path)
    np.testing.assert_array_equal(drive.increments, [[0.5, 0.01, 0.1], [0.2, 0.0, -0.1]])
    np.testing.assert_array_equal(
        drive.covariances[0], [[1e-4, 0, 0], [0, 4e-6, 1e-6], [0, 1e-6, 9e-6]]
    )
    assert [[point.label for point in points] for points in drive.seen] == [[], [2], [2, 4]]
    assert drive.seen[1][0].range_m == 5.0
    assert (drive.n_observations, sorted(drive.labels)) == (3, [2, 4])
    assert drive.first(1).seen == drive.seen[:2]


@pytest.mark.parametrize(
    "line",
    ["VERTEX 0 1", "LANDMARK 9 2 1 1 1 0 1", "LANDMARK 1 2 0 0 1 0 1", "ODOMETRY 1 2 1", "x",
     "ODOMETRY 0 5 1 0 0 1 0 0 1 0 1", "LANDMARK 1 2 nan 1 1 0 1"],
)  # fmt: skip
def test_a_line_that_is_none_is_named(tmp_path: Path, line: str) -> None:
    path = tmp_path / "park.txt"
    path.write_text(LINES.splitlines()[0] + f"\n{line}\n", encoding="ascii")
    with pytest.raises(AppError, match=r"park\.txt, line 2: no line of a Victoria Park file$"):
        read_drive(path)


@pytest.mark.parametrize(("x", "y"), [(3.0, -4.0), (-2.0, 0.1), (0.01, 7.0)])
def test_range_and_bearing_are_the_same_point_with_the_same_covariance(x: float, y: float) -> None:
    covariance = np.array([[0.4, 0.1], [0.1, 0.2]])
    seen = range_bearing(x, y, covariance, label=3)
    assert seen.bearing_rad == pytest.approx(math.atan2(y, x), abs=1e-15)
    back = seen.body_point(0)
    np.testing.assert_allclose(back.point_m, [x, y], atol=1e-12)
    np.testing.assert_allclose(back.covariance, covariance, atol=1e-12)
    # and by chance: small errors, so that first order holds
    rng = np.random.default_rng(1)
    points = rng.multivariate_normal([x, y], 1e-8 * covariance, 20_000)
    polar = np.column_stack(
        [np.hypot(*points.T), np.unwrap(np.arctan2(points[:, 1], points[:, 0]))]
    )
    np.testing.assert_allclose(np.cov(polar.T) * 1e8, seen.covariance, rtol=0.05, atol=2e-3)


def test_both_back_ends_solve_the_same_park() -> None:
    pytest.importorskip("gtsam")
    drive = read_drive(shipped_file())
    assert (len(drive.increments), drive.n_observations, len(drive.labels)) == (6968, 3640, 151)
    drive = drive.first(200)
    reference = batch_reference(drive, StopFlag())
    assert reference.chi_square < 1.2 * reference.dof
    known = drive_back_end(drive, PERFECT_WHEELS, StopFlag(), with_ids=True)
    assert len(known.landmarks_m) == len(reference.landmarks_m) == len(drive.labels)
    away = np.hypot(*(known.poses - reference.poses)[:, :2].T)
    assert math.sqrt(np.mean(away**2)) < 1.0
    assert away[-1] < 0.2  # there the batch knows nothing more
    unknown = drive_back_end(drive, PERFECT_WHEELS, StopFlag(), with_ids=False)
    share = right_share(unknown.given)
    assert share is not None
    assert share > 0.6
    assert known.given[0] == (min(drive.labels), 0)


def test_the_experiment_draws_and_counts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("gtsam")
    assert main(["experiment", "victoria-park", "--steps", "30", "--out", str(tmp_path)]) == 0
    numbers = json.loads((tmp_path / "victoria-park.json").read_text(encoding="ascii"))
    assert not numbers["simulated"]
    assert [row["name"] for row in numbers["paths"]] == [
        "odometry",
        "ISAM2, true ids",
        "robust, true ids, wheels as in the reference",
        "robust, true ids",
        "robust, unknown ids",
    ]
    assert (tmp_path / "victoria-park.png").stat().st_size > 10_000
    assert "real data" in capsys.readouterr().out


def test_without_gtsam_one_line_says_what_to_do(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "gtsam", None)
    assert main(["experiment", "victoria-park", "--out", str(tmp_path)]) == 1
    assert capsys.readouterr().err.count("\n") == 1
