"""The readers: what they make of the look-alikes, and what they say of damaged files."""

import math
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hil_tests.unit.slam.app.benchmarks import worlds
from slam.app.benchmarks import mrclam, plaza, uwb_indoor, victoria_park
from slam.app.benchmarks.data_set import (
    DataSet,
    LandmarkMeasurement,
    Positions,
    Run,
    increments_of,
    nanoseconds,
    positions_of,
    step_times,
)
from slam.geometry import between, compose
from slam.library.evaluation import ate_rmse_m
from slam.live.errors import AppError


def dead_reckoning_error_m(run: Run) -> float:
    path = Positions(t_ns=run.t_ns, xy_m=run.dead_reckoning()[:, :2])
    xy, known = path.at(run.truth.t_ns)
    return ate_rmse_m(xy[known], run.truth.xy_m[known])


def labels_of(run: Run) -> set[int | None]:
    return {seen.label for step in run.steps for seen in step.observations}


@pytest.fixture(autouse=True)
def _perfect_wheels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worlds, "SCALE", 1.0)


def test_mrclam_leaves_out_other_robots_and_names_landmarks_by_subject(tmp_path: Path) -> None:
    data = mrclam.read_data_set(worlds.write_mrclam(tmp_path, robots=2))
    assert [run.name for run in data.runs] == ["MRCLAM_Dataset1-Robot1", "MRCLAM_Dataset1-Robot2"]
    run = data.runs[0]
    assert run.left_out == 1
    assert labels_of(run) == {6, 7, 8, 9, 10}
    assert run.n_observations > 100
    assert run.t_ns[0] == 1248272272 * 10**9
    assert run.t_ns[-1] - run.t_ns[0] == 40 * 10**9
    assert np.diff(run.t_ns).max() <= 250_000_000
    # rounded to 0.1 mm/s and 0.1 mrad/s; the robot's circle has a radius of 2 m
    assert dead_reckoning_error_m(run) < 0.01


def test_mrclam_reads_one_data_set_folder_alone(tmp_path: Path) -> None:
    worlds.write_mrclam(tmp_path)
    data = mrclam.read_data_set(tmp_path / "MRCLAM_Dataset1")
    assert [run.name for run in data.runs] == ["MRCLAM_Dataset1-Robot1"]


def test_the_laser_of_the_car_goes_where_its_axle_and_its_place_say(tmp_path: Path) -> None:
    (run,) = victoria_park.read_data_set(worlds.write_victoria_park(tmp_path)).runs
    assert dead_reckoning_error_m(run) < 0.01
    # a tree seen from the true pose is where it is: straight ahead is pi/2 in the file
    seen = {step.t_ns: step.observations for step in run.steps if step.observations}
    t_ns = min(seen)
    heading = math.pi / 2 + 0.25 * t_ns / 1e9
    at = run.truth.xy_m[np.flatnonzero(run.truth.t_ns == t_ns)[0]]
    for one in seen[t_ns]:
        assert one.label is None
        assert one.bearing_rad is not None
        angle = heading + one.bearing_rad
        place = at + one.range_m * np.array([math.cos(angle), math.sin(angle)])
        # noise of 0.5 m in range, and 0.01 rad at up to 40 m
        assert np.linalg.norm(10.0 * worlds.LANDMARKS_M - place, axis=1).min() < 2.5


def test_a_fix_that_no_car_can_reach_is_left_out(tmp_path: Path) -> None:
    folder = worlds.write_victoria_park(tmp_path, duration_s=2.0)
    lines = (folder / "gps.dat").read_text(encoding="ascii").splitlines()
    time_s, x_m, y_m = lines[7].split()
    _damage(folder / "gps.dat", 8, f"{time_s} {float(x_m) + 3.0} {y_m}")  # 3 m in 0.1 s
    # with nothing behind it, a fix cannot be told from a fast car
    _damage(folder / "gps.dat", len(lines), f"{lines[-1].split()[0]} 500 500")
    (run,) = victoria_park.read_data_set(folder).runs
    kept = [float(line.split()[0]) for line in lines]
    del kept[7]
    np.testing.assert_allclose(run.truth.t_ns / 1e9, kept)


def test_the_graph_of_the_car_has_the_times_of_its_way(tmp_path: Path) -> None:
    folder = worlds.write_victoria_park(tmp_path, with_graph=True)
    plain, run = victoria_park.read_data_set(folder).runs
    assert (plain.has_labels, run.has_labels, run.is_dense) == (False, True, False)
    # every fifth of the inputs, which are 0.1 s apart
    np.testing.assert_allclose(run.t_ns / 1e9, 0.5 * np.arange(61), atol=0.01)
    assert dead_reckoning_error_m(run) < 0.05
    labels = set()
    for step in run.steps:
        heading = math.pi / 2 + 0.25 * step.t_ns / 1e9
        at, known = run.truth.at(np.array([step.t_ns]))
        for one in step.observations:
            assert one.label is not None
            assert one.bearing_rad is not None
            angle = heading + one.bearing_rad
            place = at[0] + one.range_m * np.array([math.cos(angle), math.sin(angle)])
            assert known[0]
            assert np.linalg.norm(10.0 * worlds.LANDMARKS_M[one.label] - place) < 2.5
            labels.add(one.label)
    assert labels == {0, 1, 2, 3, 4}


def test_a_graph_of_another_drive_is_named(tmp_path: Path) -> None:
    folder = worlds.write_victoria_park(tmp_path, duration_s=10.0, with_graph=True)
    lines = (folder / "victoria_park.txt").read_text(encoding="ascii").splitlines()
    half = "\n".join(lines[: len(lines) // 2])
    (folder / "victoria_park.txt").write_text(half + "\n", encoding="ascii")
    with pytest.raises(AppError, match=r"victoria_park\.txt"):
        victoria_park.read_data_set(folder)


def test_pyfg_gives_a_chain_of_poses_with_labelled_ranges(tmp_path: Path) -> None:
    worlds.write_pyfg_file(tmp_path / "small.pyfg")
    (run,) = plaza.read_data_set(tmp_path).runs
    assert (run.name, len(run.steps), run.n_observations) == ("small", 601, 601)
    assert labels_of(run) == {0, 1, 2, 3}
    assert (run.has_labels, run.has_bearings) == (True, False)
    assert run.steps[0].observations[0].range_sigma_m == pytest.approx(worlds.RANGE_SIGMA_M)
    assert dead_reckoning_error_m(run) < 1e-9


GRAPH = """\
VERTEX_SE2 10.000000001 A0 1.0 2.0 0.5
VERTEX_SE2 10.5 A1 1.5 2.0 0.5
VERTEX_SE2 -0.25 A9 0.5 2.0 0.5
VERTEX_XY L3 4.0 6.0
VERTEX_XY L7 -1.0 1e1
EDGE_SE2 9.0 A9 A0 0.5 -0.0 0.125 1.0 0.0 0.0 1.0 0.0 1.0
EDGE_SE2 9.0 A0 A1 0.25 0.1 -0.5 1.0 0.5 0.0 1.0 0.0 1.0
EDGE_RANGE 10.4 A1 L3 4.5 0.09
"""


def test_a_graph_is_a_drive_along_its_odometry(tmp_path: Path) -> None:
    (tmp_path / "small.pyfg").write_text(GRAPH, encoding="ascii")
    (run,) = plaza.read_data_set(tmp_path).runs
    assert run.name == "small"
    assert run.t_ns.tolist() == [-250_000_000, 10_000_000_001, 10_500_000_000]
    assert run.truth.t_ns.tolist() == run.t_ns.tolist()
    assert run.truth.xy_m.tolist() == [[0.5, 2.0], [1.0, 2.0], [1.5, 2.0]]
    increments = [[0.0, 0.0, 0.0], [0.5, -0.0, 0.125], [0.25, 0.1, -0.5]]
    assert [step.increment.tolist() for step in run.steps] == increments
    seen = LandmarkMeasurement(range_m=4.5, range_sigma_m=0.3, label=3)
    assert [step.observations for step in run.steps] == [(), (), (seen,)]


def test_librsf_turns_by_the_difference_of_right_and_left(tmp_path: Path) -> None:
    (run,) = uwb_indoor.read_data_set(worlds.write_librsf(tmp_path)).runs
    assert (run.name, len(run.steps), run.n_observations) == ("Small", 601, 601)
    assert labels_of(run) == {105, 106, 107, 108}
    assert dead_reckoning_error_m(run) < 1e-6


def _damage(path: Path, line: int, text: str) -> None:
    lines = path.read_text(encoding="ascii").split("\n")
    lines[line - 1] = text
    path.write_text("\n".join(lines), encoding="ascii")


WRITERS: dict[str, tuple[Callable[..., Path], Callable[[Path], DataSet]]] = {
    "mrclam": (worlds.write_mrclam, mrclam.read_data_set),
    "victoria-park": (
        lambda folder, **more: worlds.write_victoria_park(folder, with_graph=True, **more),
        victoria_park.read_data_set,
    ),
    "plaza": (
        lambda folder, **more: worlds.write_pyfg_file(folder / "a.pyfg", **more).parent,
        plaza.read_data_set,
    ),
    "uwb-indoor": (worlds.write_librsf, uwb_indoor.read_data_set),
}
SET = "MRCLAM_Dataset1"


@pytest.mark.parametrize(
    ("name", "file", "line", "text"),
    [
        ("mrclam", f"{SET}/Robot1_Odometry.dat", 5, "1 2"),
        ("mrclam", f"{SET}/Robot1_Odometry.dat", 5, "1 0 0"),  # a time before that of line 4
        ("mrclam", f"{SET}/Robot1_Measurement.dat", 3, "1248272273 60 x 0"),
        ("mrclam", f"{SET}/Robot1_Groundtruth.dat", 2, "1 nan 0 0"),
        ("mrclam", f"{SET}/Barcodes.dat", 2, "1 1_0"),
        ("victoria-park", "inputs.dat", 3, "0.2 5"),
        ("victoria-park", "inputs.dat", 3, "0.2 5 1.3"),  # no car steers so
        ("victoria-park", "measurements.dat", 1, "inf 1 1 1"),
        ("victoria-park", "gps.dat", 4, "a b c"),
        ("victoria-park", "victoria_park.txt", 1, "POSE 1 2"),
        ("victoria-park", "victoria_park.txt", 1, "ODOMETRY 1"),
        ("victoria-park", "victoria_park.txt", 1, "ODOMETRY 1 2 3"),
        ("victoria-park", "victoria_park.txt", 1, f"ODOMETRY a 2 {'1 ' * 9}"),
        ("victoria-park", "victoria_park.txt", 1, f"ODOMETRY 1 2 nan {'1 ' * 8}"),
        ("victoria-park", "victoria_park.txt", 1, f"ODOMETRY 1 1 {'1 ' * 9}"),
        ("victoria-park", "victoria_park.txt", 2, f"ODOMETRY 7 8 {'1 ' * 9}"),
        ("victoria-park", "victoria_park.txt", 1, f"LANDMARK 7 1 {'1 ' * 5}"),
        ("victoria-park", "victoria_park.txt", 2, f"LANDMARK 100 1 0 0 {'1 ' * 3}"),
        ("plaza", "a.pyfg", 2, "VERTEX_SE3:QUAT 1 A1 0 0 0 0 0 0 1"),
        ("plaza", "a.pyfg", 2, "VERTEX_SE2 1 A0 0 0 0"),  # is defined in line 1
        ("plaza", "a.pyfg", 2, "VERTEX_SE2 1 A1 0 0"),
        ("plaza", "a.pyfg", 2, "VERTEX_SE2 1 Aa 0 0 0"),
        ("plaza", "a.pyfg", 2, "EDGE_RANGE 1 A0 L0 1 0"),
        ("plaza", "a.pyfg", 2, "EDGE_RANGE 1 A0 L9 1 1"),
        ("plaza", "a.pyfg", 2, "EDGE_RANGE 1e300 A0 L0 1 1"),
        ("uwb-indoor", "Small_Input.txt", 4, "gnss2 1 2"),
        ("uwb-indoor", "Small_Input.txt", 4, "range2 1 2"),
        ("uwb-indoor", "Small_Input.txt", 4, "range2 1 2 0 0 0 1 0"),
        ("uwb-indoor", "Small_Input.txt", 3, "odom2diff 1 0 0 0 0 1 1 1"),
        ("uwb-indoor", "Small_Input.txt", 3, "odom2diff -1 0 0 0 1 1 1 1"),
        ("uwb-indoor", "Small_GT.txt", 2, "point2 0 0 0 0 0 0 x"),
    ],
)
def test_a_damaged_line_is_named_with_the_remedy(
    tmp_path: Path, name: str, file: str, line: int, text: str
) -> None:
    write, read = WRITERS[name]
    write(tmp_path, duration_s=2.0)
    _damage(tmp_path / file, line, text)
    with pytest.raises(AppError) as caught:
        read(tmp_path)
    message = str(caught.value)
    assert message.startswith(f"{tmp_path / file}, line {line}: ")
    assert message.endswith("delete the line if it is damaged, or get the file anew")


@pytest.mark.parametrize(
    ("name", "file"),
    [
        *(("mrclam", f"{SET}/{each}.dat") for each in ("Landmark_Groundtruth", "Robot1_Groundtruth",
                                                       "Robot1_Measurement")),
        *(("victoria-park", f"{each}.dat") for each in ("inputs", "measurements", "gps")),
        ("uwb-indoor", "Small_GT.txt"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("damage", ["missing", "empty", "binary"])
def test_a_file_that_is_missing_or_none_is_named(
    tmp_path: Path, name: str, file: str, damage: str
) -> None:
    write, read = WRITERS[name]
    write(tmp_path, duration_s=2.0)
    path = tmp_path / file
    if damage == "missing":
        path.unlink()
    else:
        path.write_bytes(b"" if damage == "empty" else b"1 2 3\n\xff\xd8\x00")
    with pytest.raises(AppError, match=re.escape(str(path))):
        read(tmp_path)


@pytest.mark.parametrize("name", WRITERS)
def test_a_folder_without_the_files_is_named(tmp_path: Path, name: str) -> None:
    _, read = WRITERS[name]
    with pytest.raises(AppError, match=r"docs/benchmarks\.md says"):
        read(tmp_path)
    with pytest.raises(AppError, match=r"docs/benchmarks\.md says"):
        read(tmp_path / "nowhere")


ONE_EDGE = ["VERTEX_SE2 1 A1 0 0 0", "EDGE_SE2 1 A0 A1 1 0 0 1 0 0 1 0 1"]


@pytest.mark.parametrize(
    "lines",
    [
        ["VERTEX_SE2 0 A0 0 0 0"],  # no odometry
        ["VERTEX_SE2 0 A0 0 0 0", "VERTEX_SE2 2 A2 0 0 0", *ONE_EDGE],  # A2 is not in the chain
        ["VERTEX_SE2 1 A0 0 0 0", *ONE_EDGE],  # two poses at one time
    ],
)
def test_a_graph_that_is_no_drive_is_refused(tmp_path: Path, lines: list[str]) -> None:
    (tmp_path / "a.pyfg").write_text("\n".join(lines), encoding="ascii")
    with pytest.raises(AppError, match=re.escape(str(tmp_path / "a.pyfg: "))):
        plaza.read_data_set(tmp_path)


def test_odometry_of_no_length_is_refused(tmp_path: Path) -> None:
    worlds.write_librsf(tmp_path, duration_s=2.0)
    path = tmp_path / "Small_Input.txt"
    lines = path.read_text(encoding="ascii").split("\n")
    ranges = [line for line in lines if line.startswith("range2")]
    path.write_text("\n".join([lines[0], *ranges]), encoding="ascii")
    with pytest.raises(AppError):
        uwb_indoor.read_data_set(tmp_path)


def test_dead_reckoning_of_a_constant_velocity_is_an_arc() -> None:
    at_s = np.array([0.0, 0.5, 2.0, 5.0])
    poses = positions_of(np.array([0.0]), np.array([1.0]), np.array([0.2]), np.array([0.4]), at_s)
    for t, pose in zip(at_s.tolist(), poses, strict=True):
        # Euler's method in steps of 0.1 ms
        n = round(t / 1e-4)
        headings = 0.4 * 1e-4 * (np.arange(n) + 0.5)
        x = np.sum(np.cos(headings) - 0.2 * np.sin(headings)) * 1e-4
        y = np.sum(np.sin(headings) + 0.2 * np.cos(headings)) * 1e-4
        np.testing.assert_allclose(pose, [x, y, 0.4 * t], atol=1e-8)


def test_velocities_hold_until_the_next_and_the_robot_stands_before_the_first() -> None:
    t_s = np.array([1.0, 2.0, 4.0])
    forward = np.array([1.0, 0.0, 2.0])
    poses = positions_of(t_s, forward, np.zeros(3), np.zeros(3), np.array([0.0, 1.5, 3.0, 5.0]))
    np.testing.assert_allclose(poses[:, 0], [0.0, 0.5, 1.0, 3.0])
    increments = increments_of(poses)
    np.testing.assert_array_equal(increments[0], np.zeros(3))
    np.testing.assert_allclose(compose(poses[1], increments[2]), poses[2])
    np.testing.assert_allclose(between(poses[2], poses[3]), increments[3])


def test_stamps_keep_the_decimals_that_a_float_has() -> None:
    seconds = np.array([0.1, 3857.05320191383, 1248444187.156, -1.5])
    expected = [100_000_000, 3_857_053_201_914, 1248444187156000000, -1_500_000_000]
    assert nanoseconds(seconds).tolist() == expected


def test_step_times_have_no_gap_and_keep_what_was_given() -> None:
    given = np.array([-1.0, 0.3, 0.35, 2.0, 9.0])
    times = step_times(given, 0.0, 2.1, 0.25)
    assert {0.0, 0.3, 0.35, 2.0, 2.1} <= set(times.tolist())
    assert times.min() == 0.0
    assert times.max() == 2.1
    assert np.diff(times).max() <= 0.25 + 1e-12


@pytest.mark.parametrize(
    ("edge", "end"),
    [
        ("EDGE_RANGE 1 A0 A1 1 1", "A1"),
        ("EDGE_RANGE 1 L0 L0 1 1", "L0"),
        ("EDGE_SE2 1 A0 L0 1 0 0 1 0 0 1 0 1", "L0"),
    ],
)
def test_a_measurement_between_two_of_a_kind_is_not_called_undefined(
    tmp_path: Path, edge: str, end: str
) -> None:
    """As a range between two robots is."""
    lines = ["VERTEX_SE2 0 A0 0 0 0", *ONE_EDGE, "VERTEX_XY L0 1 1"]
    (tmp_path / "a.pyfg").write_text("\n".join([*lines, edge]), encoding="ascii")
    with pytest.raises(AppError, match=rf"line {len(lines) + 1}: {end} is a ") as caught:
        plaza.read_data_set(tmp_path)
    assert "defines" not in str(caught.value)


def test_a_path_is_interpolated_between_positions_a_second_apart_at_most() -> None:
    t_ns = np.array([0, 10**9, 5 * 10**9], dtype=np.int64)
    path = Positions(t_ns=t_ns, xy_m=np.array([[0.0, 0.0], [1.0, 2.0], [5.0, 5.0]]))
    asked = [-1, 0, 250_000_000, 10**9, 2 * 10**9, 5 * 10**9, 6 * 10**9]
    xy, known = path.at(np.array(asked, dtype=np.int64))
    assert known.tolist() == [False, True, True, True, False, True, False]
    np.testing.assert_allclose(xy[known], [[0.0, 0.0], [0.25, 0.5], [1.0, 2.0], [5.0, 5.0]])
