"""Numbers of runs whose errors are known in closed form, and the fields of summary.json."""

import cmath
import dataclasses
import json
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from hil_tests.unit.slam.app.sessions import (
    FRAME_NS,
    feed,
    odometry,
    record_of_steps,
    scan,
    session_info,
    snapshot,
    write_scans,
)
from slam.app.cli import main
from slam.app.commands.evaluate import Errors, evaluate, trajectory_at
from slam.app.run.output import summary_rows, table_text, write_json
from slam.app.run.runner import RunRecord
from slam.app.run.summary import NEES_AT, Summary, summarise
from slam.app.session.writer import SessionLog
from slam.config import BackEnd, DetectionConfig, RobustConfig, SlamConfig, TrilaterationConfig
from slam.geometry import Mount, Rig
from slam.library.evaluation import LandmarkScore, ate_rmse_m
from slam.live.errors import AppError
from slam.live.odometry_track import Trajectory, write_tum
from slam.live.session.description import settings_text
from slam.live.session_records import SessionInfo
from slam.results import Association, Belief, LaggedPose, Observation, SmoothedRun, StepResult
from xethru_protocol.operating_system import StopFlag

N = 201
PERIOD_NS = 200_000_000
LANDMARKS = np.array([[1.0, 1.0], [2.0, 1.1], [50.0, 50.0]])
INFO = dataclasses.replace(session_info(), true_landmarks_m=LANDMARKS)
RIG = Rig(
    mounts=(
        Mount(name="rear", x_m=-0.1, y_m=0.2, yaw_rad=np.pi / 2),
        Mount(name="front", x_m=0.1, y_m=0.2, yaw_rad=np.pi / 2),
    )
)


def record_of(
    results: Sequence[StepResult],
    truth: np.ndarray,
    world_from_map: np.ndarray,
    more_ns: int = 0,
    landmarks: np.ndarray = LANDMARKS,
) -> RunRecord:
    return dataclasses.replace(
        record_of_steps(results, truth, world_from_map, landmarks),
        n_frames=2 * N,
        duration_ns=(N - 1) * PERIOD_NS + more_ns,
        wall_s=0.5,
    )


def run(
    offset_m: float,
    drift: float,
    variance: float,
    info: SessionInfo = INFO,
    found: NDArray[np.float64] = LANDMARKS[:2],
) -> Summary:
    """Drive 3 m along x; the estimate is off by a constant and a share of the way in y."""
    truth = np.zeros((N, 3))
    truth[:, 0] = np.linspace(0, 3, N)
    found = found + np.array([0.0, 0.03])
    results = []
    for k in range(N):
        pose = truth[k] + np.array([0.0, offset_m, 0.0])
        mean = np.concatenate([pose, found.ravel()])
        results.append(
            StepResult(
                t_ns=k * PERIOD_NS,
                odometry_pose=truth[k] + np.array([0.0, drift * (k % 2 - 0.5), 0.0]),
                belief=Belief(
                    mean=mean,
                    covariance=np.eye(len(mean)) * variance,
                    landmark_ids=(0, 1),
                    next_id=2,
                ),
                detections=(),
            )
        )
    record = record_of(results, truth, np.zeros(3))
    summary = summarise(record, info, RIG)
    assert summary is not None
    return summary


def test_a_constant_offset_is_aligned_away_in_the_ate_and_counts_in_nees_and_final_error() -> None:
    summary = run(offset_m=0.05, drift=0.02, variance=0.01)
    assert summary.ate_rmse_m == pytest.approx(0.0, abs=1e-9)
    assert summary.odometry_ate_rmse_m == pytest.approx(0.01, rel=1e-2)
    assert summary.final_error_m == pytest.approx(0.05)
    # 0.05^2 / 0.01, at ten parts of 40 s
    expected = [(40.0 * part, 0.25) for part in NEES_AT]
    np.testing.assert_allclose(summary.nees_pose, expected)
    assert summary.realtime_factor == pytest.approx(80.0)
    assert summary.nis_mean is None


def test_landmarks_are_judged_after_the_trajectorys_alignment_and_expected_only_if_seen() -> None:
    # the map is 30 mm off in y, the path 30 mm too: aligned, nothing is left
    score = run(offset_m=0.03, drift=0.0, variance=0.01).landmarks
    assert (score.true, score.observable, score.estimated) == (3, 2, 2)
    assert (score.precision, score.recall) == (1.0, 1.0)
    assert score.rmse_m == pytest.approx(0.0, abs=1e-9)
    # the path is right, the map is 30 mm off
    assert run(offset_m=0.0, drift=0.0, variance=0.01).landmarks.rmse_m == pytest.approx(0.03)


def test_a_corner_of_two_walls_may_be_a_landmark_and_is_none_that_must_be_found() -> None:
    walls = (np.array([[0.0, 2.0], LANDMARKS[1]]), np.array([LANDMARKS[1], [2.0, 4.0]]))
    info = dataclasses.replace(INFO, true_landmarks_m=LANDMARKS[:1])
    score = run(offset_m=0.03, drift=0.0, variance=0.01, info=info).landmarks
    assert (score.true, score.precision, score.recall) == (1, 0.5, 1.0)
    info = dataclasses.replace(info, outlines_m=walls)
    score = run(offset_m=0.03, drift=0.0, variance=0.01, info=info).landmarks
    assert (score.true, score.precision, score.recall) == (1, 1.0, 1.0)
    # It is one corner of both walls: of two landmarks there one is false.
    at_corner = dataclasses.replace(info, true_landmarks_m=np.array([[9.0, 9.0]]))
    twice = np.array([LANDMARKS[1], LANDMARKS[1]])
    score = run(offset_m=0.03, drift=0.0, variance=0.01, info=at_corner, found=twice).landmarks
    assert (score.precision, score.duplicates) == (0.5, 1)


def smoothed_of(record: RunRecord, poses: np.ndarray, sigma: float) -> SmoothedRun:
    n = len(poses)
    return SmoothedRun(
        t_ns=record.states.t_ns[:n],
        poses=poses,
        pose_covariances=np.tile(np.eye(3) * sigma**2, (n, 1, 1)),
        landmark_ids=(0, 1),
        landmarks_m=LANDMARKS[:2] + np.array([[0.0, 0.01], [0.0, -0.01]]),
        landmark_covariances_m2=np.tile(np.eye(2) * sigma**2, (2, 1, 1)),
    )


def test_the_lagged_error_is_of_the_poses_that_there_are_aligned_by_themselves() -> None:
    """Every second pose but those of the end, off by a constant and by 3 mm to either side."""
    truth = np.zeros((N, 3))
    truth[:, 0] = np.linspace(0, 3, N)
    belief = Belief(mean=np.zeros(3), covariance=np.eye(3))
    off = np.zeros((N, 3))
    off[:, 1] = 0.05 + 0.003 * np.where(np.arange(N) % 4, 1.0, -1.0)
    results = [
        StepResult(
            t_ns=k * PERIOD_NS,
            odometry_pose=pose,
            belief=belief,
            detections=(),
            lagged=tuple(
                LaggedPose(
                    t_ns=past * PERIOD_NS, pose=truth[past] + off[past], covariance=np.eye(3)
                )
                for past in [k - 10]
                if past >= 0 and past % 2 == 0
            ),
        )
        for k, pose in enumerate(truth)
    ]
    summary = summarise(record_of(results, truth, np.zeros(3)), INFO, RIG)
    few = summarise(record_of(results[:28], truth[:28], np.zeros(3)), INFO, RIG)
    assert summary is not None
    assert few is not None
    assert summary.lagged_ate_rmse_m == pytest.approx(0.003, rel=1e-2)
    assert few.lagged_ate_rmse_m is None


def test_the_smoothed_numbers_are_those_of_the_smoothed_run() -> None:
    """It zigzags by 4 mm about the truth, and its landmarks are 10 mm off on either side."""
    truth = np.zeros((N, 3))
    truth[:, 0] = np.linspace(0, 3, N)
    belief = Belief(mean=np.zeros(3), covariance=np.eye(3))
    results = [
        StepResult(t_ns=k * PERIOD_NS, odometry_pose=pose, belief=belief, detections=())
        for k, pose in enumerate(truth)
    ]
    record = record_of(results, truth, np.zeros(3))
    zigzag = np.zeros((N, 3))
    zigzag[:, 1] = 0.004 * np.where(np.arange(N) % 2, 1.0, -1.0)
    smoothed = smoothed_of(record, truth + zigzag, sigma=0.002)
    whole = dataclasses.replace(record, smoothed=smoothed)
    summary, without = (summarise(one, INFO, RIG) for one in (whole, record))
    assert summary is not None
    assert without is not None
    assert summary.smoothed_ate_rmse_m == pytest.approx(0.004, rel=1e-3)
    assert summary.smoothed_nees_pose is not None
    assert [value for _, value in summary.smoothed_nees_pose] == pytest.approx([4.0] * 10)
    assert summary.smoothed_landmarks is not None
    assert summary.smoothed_landmarks.rmse_m == pytest.approx(0.01, rel=1e-2)
    assert (summary.ate_rmse_m, summary.nees_pose) == (without.ate_rmse_m, without.nees_pose)
    # of a run that was killed after a request: not a number of the run
    early = dataclasses.replace(record, smoothed=smoothed_of(record, truth[:-1], sigma=0.002))
    assert summarise(early, INFO, RIG) == without
    assert without.smoothed_ate_rmse_m is None
    assert without.smoothed_nees_pose is None


@pytest.mark.parametrize(
    ("back_end", "opening_deg"), [(BackEnd.PAPER, 60.0), (BackEnd.ROBUST, 50.0)]
)
def test_the_field_of_view_is_that_of_the_settings(back_end: BackEnd, opening_deg: float) -> None:
    config = SlamConfig(
        back_end=back_end,
        trilateration=TrilaterationConfig(field_of_view_deg=60.0),
        robust=RobustConfig(field_of_view_deg=50.0),
        detection=DetectionConfig(min_range_m=0.3, max_range_m=5.0),
    )
    field = dataclasses.replace(INFO, config_json=settings_text(config)).field_of_view
    assert math.degrees(field.opening_rad) == pytest.approx(opening_deg)
    assert (field.min_range_m, field.max_range_m) == (0.3, 5.0)


def test_a_session_without_settings_has_the_papers_field_of_view() -> None:
    field = dataclasses.replace(INFO, config_json="").field_of_view
    assert math.degrees(field.opening_rad) == pytest.approx(65.0)
    assert (field.min_range_m, field.max_range_m) == (0.2, 1.5)


PLACE = np.array([5.0, -3.0, 0.8])
HEADING_RAD = 0.3
"""Of the robot in the map frame, while it moves along the map's x axis."""


def in_world(point: complex) -> complex:
    return complex(*PLACE[:2]) + cmath.rect(1.0, PLACE[2]) * point


def seen(landmark: complex, x_m: float) -> Observation:
    """Observe a landmark of the map frame without error, from x on the path."""
    body = (landmark - x_m) * cmath.rect(1.0, -HEADING_RAD)
    return Observation(x_m=body.real, y_m=body.imag, n_poses=4, fixes=())


def associated(landmark_id: int, *distances_sq: float, is_new: bool = False) -> Association:
    return Association(
        landmark_id=landmark_id,
        is_new=is_new,
        mahalanobis_sq=np.array(distances_sq),
        candidate_ids=tuple(range(len(distances_sq))),
    )


@pytest.fixture(scope="module")
def turned() -> Summary:
    """Drive from somewhere in the world; path, map and filter have unequal headings.

    The estimate is 50 mm to the side and 0.02 rad off; every second state of it also runs 60 mm
    ahead or behind, always onto a place where the robot was at another time.
    """
    x_m = np.linspace(0, 3, N)  # 15 mm per state
    places = [in_world(complex(x)) for x in x_m]
    truth = np.array([(p.real, p.imag, PLACE[2] + HEADING_RAD) for p in places])
    first, second = 1.0 + 1.0j, 2.0 + 1.1j
    # What was seen truly, and what the filter made of it.
    events = {
        10: (first, associated(0, is_new=True)),
        11: (first, associated(0, 3.0)),
        12: (first, associated(1, 25.0, is_new=True)),  # refused by the gate
        13: (second, associated(2, 70.0, 80.0, is_new=True)),
        14: (first, associated(0, 8.0, 1.0, 90.0)),
    }
    ahead = np.zeros(N, dtype=int)
    ahead[5:-5:4], ahead[7:-5:4] = 4, -4
    results = []
    for k in range(N):
        observed = [(seen(what, x_m[k]), how) for at, (what, how) in events.items() if at == k]
        results.append(
            StepResult(
                t_ns=k * PERIOD_NS,
                odometry_pose=np.array([x_m[k], 0.1 * (k % 2), HEADING_RAD]),
                belief=Belief(
                    mean=np.array([x_m[k + ahead[k]], 0.05, HEADING_RAD + 0.02]),
                    covariance=np.diag([0.04, 0.0025, 0.0004]),
                    landmark_ids=(),
                    next_id=0,
                ),
                detections=(),
                observations=tuple(observation for observation, _ in observed),
                associations=tuple(association for _, association in observed),
            )
        )
    true_m = np.array([(w.real, w.imag) for w in map(in_world, (first, second))])
    record = record_of(results, truth, PLACE, PERIOD_NS // 10, true_m)
    summary = summarise(record, dataclasses.replace(INFO, true_landmarks_m=true_m), RIG)
    assert summary is not None
    return summary


def test_icp_forgets_time_and_the_ate_does_not(turned: Summary) -> None:
    # 96 of 201 states are 60 mm along the path from where they belong
    assert turned.ate_rmse_m == pytest.approx(0.06 * np.sqrt(96 / 201), rel=0.01)
    assert turned.ate_icp_rmse_m == pytest.approx(0.0, abs=1e-9)


def test_nees_is_of_the_map_frame_and_carries_its_states_time(turned: Summary) -> None:
    times, values = np.array(turned.nees_pose).T
    # the run ends a little after its last state, and each time lies a little after a state
    np.testing.assert_allclose(times, [40.0 * part for part in NEES_AT])
    # 0.05^2 / 0.0025 + 0.02^2 / 0.0004
    np.testing.assert_allclose(values, 2.0)
    assert turned.final_error_m == pytest.approx(0.05)


def test_nis_is_of_true_associations_before_the_gate_per_degree_of_freedom(
    turned: Summary,
) -> None:
    assert turned.nis_mean == pytest.approx((3.0 + 25.0 + 8.0) / 3 / 2)


def test_a_run_without_a_state_has_no_summary() -> None:
    record = record_of([], np.zeros((0, 3)), np.zeros(3))
    assert summarise(record, INFO, RIG) is None


N_POSES = 200
STAMPS = np.arange(N_POSES, dtype=np.int64) * 199_261_498


def square_path() -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, N_POSES, endpoint=False)
    return np.stack([np.cos(angle), np.sin(angle), angle], axis=1)


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    reference = square_path()
    # radial error +-10 mm, alternating: mean zero and uncorrelated with position, so no alignment
    # can remove any of it; then moved rigidly, which alignment must remove wholly
    radial = 0.01 * np.where(np.arange(N_POSES) % 2, 1.0, -1.0)
    bent = reference[:, :2] * (1 + radial)[:, None]
    cosine, sine = math.cos(0.7), math.sin(0.7)
    moved = bent @ np.array([[cosine, sine], [-sine, cosine]]) + [3.0, -2.0]
    estimate = np.column_stack([moved, reference[:, 2] + 0.7])
    write_tum(tmp_path / "ref.tum", Trajectory(stamps_ns=STAMPS, poses=reference))
    write_tum(tmp_path / "est.tum", Trajectory(stamps_ns=STAMPS[3:] + 900_000, poses=estimate[3:]))
    return tmp_path / "est.tum", tmp_path / "ref.tum"


def judged(estimate: Path, reference: Path, delta_m: float = 1.0) -> Errors:
    truth = trajectory_at(reference, StopFlag(), "truth")
    return evaluate(trajectory_at(estimate, StopFlag()), truth, delta_m)


def test_a_rigid_motion_costs_nothing_and_noise_counts(
    files: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", *map(str, files), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["ate_rmse_m"] == pytest.approx(0.01, rel=0.01)
    assert (result["pairs"], result["reference_poses"]) == (N_POSES - 3, N_POSES)

    assert main(["evaluate", *map(str, files)]) == 0
    *_, row, _ = capsys.readouterr().out.splitlines()
    assert row.split()[1] == "0.0100"
    assert row.split()[-1] == "197"


def test_the_errors_of_wheels_that_err_by_a_share(tmp_path: Path) -> None:
    """On a circle of 1 m, a radius 2 % too large and 1 degree of heading."""
    reference = square_path()
    wide = reference * [1.02, 1.02, 1.0] + [0.0, 0.0, math.radians(1.0)]
    write_tum(tmp_path / "ref.tum", Trajectory(stamps_ns=STAMPS, poses=reference))
    write_tum(tmp_path / "est.tum", Trajectory(stamps_ns=STAMPS, poses=wide))
    result = judged(tmp_path / "est.tum", tmp_path / "ref.tum")
    assert result["ate_rmse_m"] == pytest.approx(0.02, rel=1e-9)
    assert result["ate_rotation_rmse_deg"] == pytest.approx(1.0, rel=1e-9)
    # 32 chords of the polygon of 200 are the first that are a metre or more together
    chord_m, turned = 2.0 * math.sin(32 * math.pi / N_POSES), math.radians(1.0)
    off_m = chord_m * math.sqrt(1.02**2 + 1.0 - 2.0 * 1.02 * math.cos(turned))
    assert result["rpe_rmse_m"] == pytest.approx(off_m, rel=1e-9)
    assert result["rpe_rotation_rmse_deg"] == pytest.approx(0.0, abs=1e-9)
    assert result["rpe_pairs"] == (N_POSES - 1) // 32
    assert judged(tmp_path / "est.tum", tmp_path / "ref.tum", delta_m=9.0)["rpe_rmse_m"] is None


def test_several_estimates_beside_one_reference_and_a_picture(
    files: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    estimate, reference = map(str, files)
    picture = tmp_path / "errors.png"
    command = ["evaluate", estimate, reference, reference, "--out", str(picture)]
    assert main([*command, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["reference"] == reference
    assert [row["estimate"] for row in result["estimates"]] == [estimate, reference]
    errors_m = [row["ate_rmse_m"] for row in result["estimates"]]
    assert errors_m == [pytest.approx(0.01, rel=0.01), pytest.approx(0.0, abs=1e-12)]
    with Image.open(picture) as drawn:
        assert drawn.format == "PNG"
        assert len(drawn.getcolors() or ()) > 10
    assert main(command) == 0
    assert estimate in capsys.readouterr().out
    with pytest.raises(SystemExit, match="2"):
        main([*command[:-1], str(tmp_path / "errors.html")])
    assert not (tmp_path / "errors.html").exists()


def test_a_session_and_a_runs_folder_are_judged_like_their_trajectories(tmp_path: Path) -> None:
    """The estimate of a session against its truth, which may also be a file of TUM lines."""
    session = tmp_path / "session.mcap"
    states = [snapshot(counter) for counter in range(12)]
    stamps = np.array([state.t_ns for state in states])

    def truth_at(stamps_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        return np.array([snapshot(t_ns // FRAME_NS).truth for t_ns in stamps_ns.tolist()])

    log = SessionLog(session, session_info(), odometry(14), truth_at=truth_at)
    feed(log, len(states))
    log.close()
    truth, estimate = (
        np.array([getattr(state, name) for state in states]) for name in ("truth", "estimate")
    )
    expected = ate_rmse_m(estimate[:, :2], truth[:, :2])
    write_tum(tmp_path / "ref.tum", Trajectory(stamps_ns=stamps, poses=truth))
    folder = tmp_path / "replayed"
    folder.mkdir()
    for name, rows in (("estimate", estimate), ("truth", truth)):
        write_tum(folder / f"{name}.tum", Trajectory(stamps_ns=stamps, poses=rows))
    for est, ref in (
        (session, tmp_path / "ref.tum"),
        (tmp_path, tmp_path / "ref.tum"),
        (session, session),
        (tmp_path / "ref.tum", tmp_path),
        (folder, folder),
    ):
        result = judged(est, ref)
        wanted = 0.0 if est == tmp_path / "ref.tum" else expected
        assert result["ate_rmse_m"] == pytest.approx(wanted, abs=1e-12)
        assert result["pairs"] == len(states)


def test_a_session_without_poses_names_a_remedy_that_works(tmp_path: Path) -> None:
    """Replay makes estimates, but no truth."""
    session = write_scans(tmp_path / "session.mcap", [scan(0)])
    with pytest.raises(AppError, match="holds no estimate; `uwb-slam replay` makes one"):
        trajectory_at(session, StopFlag())
    with pytest.raises(AppError, match="holds no truth; give a TUM file of it"):
        trajectory_at(session, StopFlag(), "truth")


@pytest.mark.parametrize("sign", [1, -1])
def test_stamps_belong_together_within_10_ms(tmp_path: Path, sign: int) -> None:
    reference, estimate = tmp_path / "ref.tum", tmp_path / "est.tum"
    write_tum(reference, Trajectory(stamps_ns=STAMPS, poses=square_path()))
    # 9 ms and 11 ms apart, in turns
    apart_ns = np.where(np.arange(N_POSES) % 2, 11_000_000, 9_000_000)
    write_tum(estimate, Trajectory(stamps_ns=STAMPS + sign * apart_ns, poses=square_path()))
    assert judged(estimate, reference)["pairs"] == N_POSES // 2


@pytest.mark.parametrize("huge", [1e160, 1e308])
def test_an_error_beyond_all_floats_is_null(
    files: tuple[Path, Path], tmp_path: Path, huge: float, capsys: pytest.CaptureFixture[str]
) -> None:
    far = square_path()
    far[::2, 0] = huge
    write_tum(tmp_path / "far.tum", Trajectory(stamps_ns=STAMPS, poses=far))
    assert main(["evaluate", str(tmp_path / "far.tum"), str(files[1]), "--json"]) == 0
    text = capsys.readouterr()
    assert json.loads(text.out, parse_constant=pytest.fail)["ate_rmse_m"] is None
    assert text.err == ""
    assert main(["evaluate", str(tmp_path / "far.tum"), str(files[1])]) == 0
    assert capsys.readouterr().out.splitlines()[-2].split()[1] == "-"


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
    landmarks=LandmarkScore(
        true=14,
        observable=14,
        estimated=15,
        precision=14 / 15,
        recall=1.0,
        duplicates=1,
        rmse_m=0.012,
    ),
    nees_pose=((69.12, 2.5), (691.2, 3.25)),
    nis_mean=1.1,
)


def test_the_fields_are_those_of_the_contract() -> None:
    data = json.loads(json.dumps(SUMMARY.numbers()))
    assert " ".join(data) == (
        "scene preset seed frames duration_s realtime_factor ate_rmse_m lagged_ate_rmse_m "
        "smoothed_ate_rmse_m ate_icp_rmse_m odometry_ate_rmse_m final_error_m landmarks "
        "smoothed_landmarks nees_pose smoothed_nees_pose nis_mean"
    )
    assert (
        " ".join(data["landmarks"])
        == "true observable estimated precision recall duplicates rmse_m"
    )
    assert data["nees_pose"] == [[69.12, 2.5], [691.2, 3.25]]


def test_nan_is_refused(tmp_path: Path) -> None:
    numbers = dataclasses.replace(SUMMARY, ate_rmse_m=float("nan")).numbers()
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(tmp_path / "summary.json", numbers)


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
    assert "smoothed" not in text
    rows = summary_rows(
        dataclasses.replace(SUMMARY, smoothed_ate_rmse_m=5.64e-3),
        lag_states=0,
        wall_s=9.9,
        lost_frames=0,
    )
    (row,) = (row for row in rows if row[0] == "smoothed ATE")
    assert row[1:] == (
        "5.6 mm",
        "0.10 of odometry's, SE(2)-aligned, all states solved for at the end",
    )


def test_a_map_without_a_match_has_dashes() -> None:
    nothing = LandmarkScore(
        true=14, observable=13, estimated=0, precision=None, recall=0.0, duplicates=0, rmse_m=None
    )
    rows = summary_rows(
        dataclasses.replace(SUMMARY, landmarks=nothing), lag_states=0, wall_s=1.0, lost_frames=2
    )
    text = table_text("title", None, rows)
    assert "SE(2)-aligned, causal" in text
    assert "0 for 14 true  precision -, 0 duplicates, rmse -" in text
    assert "13 of 14 true  recall 0.00 of those in view" in text
