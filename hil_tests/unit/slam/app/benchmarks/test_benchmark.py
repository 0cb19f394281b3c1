"""`uwb-slam benchmark` on a look-alike of each data set, from files to numbers and pictures."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hil_tests.unit.slam.app.benchmarks import worlds
from slam.app.benchmarks import BENCHMARKS, plaza
from slam.app.benchmarks.back_end import grouped
from slam.app.benchmarks.data_set import LandmarkMeasurement, Positions, Run
from slam.app.benchmarks.path_errors import associated, score_run
from slam.app.cli import main
from slam.live.errors import AppError
from slam.live.odometry_track import Trajectory, read_tum
from xethru_protocol.operating_system import StopFlag


def write(name: str, folder: Path) -> Path:
    match name:
        case "mrclam":
            return worlds.write_mrclam(folder, robots=2)
        case "victoria-park":
            return worlds.write_victoria_park(folder, duration_s=60.0, with_graph=True)
        case "plaza":
            return worlds.write_pyfg_file(folder / "small.pyfg").parent
    return worlds.write_librsf(folder)


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=() if n == "plaza" else pytest.mark.rare) for n in BENCHMARKS],
)
def test_a_benchmark_is_better_than_dead_reckoning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    data, out = write(name, tmp_path / "data"), tmp_path / "out"
    assert main(["benchmark", name, "--data", str(data), "--out", str(out), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((out / f"{name}.json").read_text(encoding="ascii"))
    assert len(printed["runs"]) == (2 if name in ("mrclam", "victoria-park") else 1)
    for run in printed["runs"]:
        ate = run["ate_rmse_m"]
        ways = {"with_ids"}
        if name == "mrclam":
            ways = {"with_ids", "without_ids"}
        elif run["run"] == "victoria-park":
            ways = {"without_ids"}
        assert set(run["landmarks"]) == ways
        assert set(ate) == {"odometry", *ways, *(f"{way}_smoothed" for way in ways)}
        for way in ways:
            # wheels that err by 3 % are off by half a metre; what is seen is sure to centimetres
            assert ate[way] < 0.7 * ate["odometry"]
            assert ate[f"{way}_smoothed"] < 0.5 * ate["odometry"]
        folder = out / name / run["run"]
        files = {f"{path}.tum" for path in ate} | {"truth.tum"}
        assert {path.name for path in folder.iterdir()} == files
        truth = read_tum(folder / "truth.tum")
        for path, expected in ate.items():
            estimate = read_tum(folder / f"{path}.tum")
            assert len(estimate.stamps_ns) == run["steps"]
            assert _ate_m(estimate, truth) == pytest.approx(expected, rel=1e-6)
    means = printed["mean_ate_rmse_m"]
    assert means["odometry"] == pytest.approx(
        np.mean([run["ate_rmse_m"]["odometry"] for run in printed["runs"]])
    )
    with Image.open(out / f"{name}.png") as image:
        assert min(image.size) > 400


def _ate_m(estimate: Trajectory, truth: Trajectory) -> float:
    """Return the ATE with complex numbers: the best turn has a closed form there."""
    inside = (truth.stamps_ns >= estimate.stamps_ns[0]) & (
        truth.stamps_ns <= estimate.stamps_ns[-1]
    )
    stamps = truth.stamps_ns[inside] - estimate.stamps_ns[0]
    since = estimate.stamps_ns - estimate.stamps_ns[0]
    x, y = (np.interp(stamps, since, estimate.poses[:, axis]) for axis in (0, 1))
    a, b = x + 1j * y, truth.poses[inside, 0] + 1j * truth.poses[inside, 1]
    a, b = a - a.mean(), b - b.mean()
    turn = np.vdot(a, b)
    return float(np.sqrt(np.mean(np.abs(a * turn / abs(turn) - b) ** 2)))


def test_the_table_has_a_row_per_run_and_their_mean(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = tmp_path / "data"
    worlds.write_librsf(data, duration_s=5.0)
    for kind in ("Input", "GT"):
        text = (data / f"Small_{kind}.txt").read_text(encoding="ascii")
        (data / f"Other_{kind}.txt").write_text(text, encoding="ascii")
    code = main(["benchmark", "uwb-indoor", "--data", str(data), "--out", str(tmp_path / "out")])
    assert code == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    first = {row[0]: row for row in rows if row}
    assert first["Other"][1:5] == first["Small"][1:5]
    # dead reckoning, causal, smoothed
    assert first["mean"][1:] == first["Other"][2:5]


def test_truth_of_another_drive_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = worlds.write_librsf(tmp_path / "data", duration_s=2.0)
    (data / "Small_GT.txt").write_text("point2 99 0 0 0 0 0 0\npoint2 100 0 0 0 0 0 0\n")
    code = main(["benchmark", "uwb-indoor", "--data", str(data), "--out", str(tmp_path / "out")])
    assert code == 1
    assert capsys.readouterr().err.splitlines()[-1].startswith("uwb-slam: Small: ")


def test_detections_nearer_than_a_landmark_is_wide_are_one() -> None:
    def seen(x_m: float, y_m: float) -> LandmarkMeasurement:
        return LandmarkMeasurement(
            range_m=math.hypot(x_m, y_m),
            range_sigma_m=0.3,
            bearing_rad=math.atan2(y_m, x_m),
            bearing_sigma_rad=0.03,
            label=7,
        )

    # A chain of three, 0.4 m apart, and one alone: a disc of 0.8 m has a standard deviation of 0.2
    groups = grouped([seen(4.0, 2.6), seen(0.0, -5.0), seen(4.0, 3.0), seen(4.0, 3.4)], 0.8)
    chain, alone = sorted(groups, key=lambda one: -(one.bearing_rad or 0.0))
    assert (chain.range_m, chain.bearing_rad) == pytest.approx((5.0, math.atan2(3.0, 4.0)))
    assert (alone.range_m, alone.bearing_rad) == pytest.approx((5.0, -math.pi / 2))
    for one in groups:
        assert one.label is None
        assert one.range_sigma_m == pytest.approx(math.sqrt(0.3**2 + 0.2**2))
        assert one.bearing_sigma_rad == pytest.approx(math.sqrt(0.03**2 + 0.04**2))
    (single,) = grouped([seen(3.0, 0.0)], 0.8)
    assert single.range_m == pytest.approx(3.0)


def test_a_drive_is_compared_at_its_own_poses_however_far_apart(tmp_path: Path) -> None:
    worlds.write_pyfg_file(tmp_path / "small.pyfg", duration_s=20.0)
    (run,) = plaza.read_data_set(tmp_path).runs
    step = round(2.0 / worlds.PERIOD_S)  # poses are two seconds apart
    truth = Positions(t_ns=run.truth.t_ns[::step], xy_m=run.truth.xy_m[::step])
    sparse = Run(name="sparse", steps=run.steps[::step], truth=truth)
    xy, there = associated(sparse, np.column_stack([truth.xy_m, np.zeros(len(truth.t_ns))]))
    assert len(xy) == len(truth.t_ns) >= 10
    np.testing.assert_allclose(xy, there, atol=1e-12)


def test_a_truth_between_steps_far_apart_is_not_of_another_drive(tmp_path: Path) -> None:
    worlds.write_pyfg_file(tmp_path / "small.pyfg", duration_s=20.0)
    data = plaza.read_data_set(tmp_path)
    (run,) = data.runs
    step = round(2.0 / worlds.PERIOD_S)
    between_ns = run.truth.t_ns[step // 2 :: step]
    truth = Positions(t_ns=between_ns, xy_m=np.zeros((len(between_ns), 2)))
    sparse = Run(name="sparse", steps=run.steps[::step], truth=truth)
    inside = np.count_nonzero(between_ns <= sparse.t_ns[-1])
    with pytest.raises(AppError, match=f"sparse: {inside} positions .* and 0 of them at a step"):
        score_run(data, sparse, StopFlag(), lambda text: None)


def test_how_densely_a_path_is_sampled_does_not_count(tmp_path: Path) -> None:
    worlds.write_pyfg_file(tmp_path / "small.pyfg", duration_s=5.0)
    (run,) = plaza.read_data_set(tmp_path).runs
    half = Run(name="half", steps=run.steps[::2], truth=run.truth)
    straight = np.column_stack([np.arange(len(run.steps)), *np.zeros((2, len(run.steps)))])
    dense, _ = associated(run, straight)
    sparse, _ = associated(half, straight[::2])
    np.testing.assert_allclose(sparse, dense, atol=1e-9)
