"""MATLAB files of detections: the authors' layout as we generate it, there and back."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import loadmat, savemat

from hil_tests.unit.slam.app.sessions import run, scan, session_info, write_scans
from slam.app.cli import main
from slam.app.convert.matlab import MAT_RIG, MatDrive, read_mat, write_mat
from slam.config import SlamConfig, load_preset
from slam.frames import Detection
from slam.live.errors import AppError
from slam.live.odometry_track import OdometryTrack, format_tum_line
from slam.live.session.description import settings_text
from slam.live.session.reader import open_session
from slam.live.session_records import SessionInfo
from slam.paper.trilateration import Trilaterator

N_STATES = 6


def authors_table() -> dict[str, Any]:
    """Return what the authors' program saves: two targets to the left of state 2, one right."""
    odometry = np.zeros((N_STATES, 3), dtype=np.float32)
    odometry[:, 0] = 5.0 * np.arange(N_STATES)
    odometry[:, 2] = 0.01 * np.arange(N_STATES)
    left, right = np.zeros((N_STATES, 5, 2)), np.zeros((N_STATES, 5, 2))
    left[2, 0] = 1000.0, math.pi / 2
    left[2, 1] = math.hypot(100.0, 700.0), math.atan2(700.0, 100.0)
    # as of a robot turned by pi, to which pi is added: at (0.2, -0.9) m from ours
    right[2, 0] = math.hypot(200.0, 900.0), math.pi + math.atan2(900.0, -200.0)
    frames = {f"R{k}": np.zeros((N_STATES, 500), dtype=np.float32) for k in range(1, 5)}
    frames["R3"][4] = np.linspace(-1e-3, 1e-3, 500)
    return {"odom": odometry, "obsLHS": left, "obsRHS": right} | frames


@pytest.fixture
def authors_file(tmp_path: Path) -> Path:
    path = tmp_path / "dataset_mph6_mpp5.mat"
    savemat(path, authors_table())
    return path


def test_the_authors_fixes_are_points_in_the_body_frame(authors_file: Path) -> None:
    drive = read_mat(authors_file)
    np.testing.assert_allclose(drive.left[2], [[0.0, 1.0], [0.1, 0.7]], atol=1e-12)
    np.testing.assert_allclose(drive.right[2], [[0.2, -0.9]], atol=1e-12)
    assert [len(points) for points in drive.left] == [0, 0, 2, 0, 0, 0]
    np.testing.assert_allclose(drive.odometry[3], [0.015, 0.0, 0.03], atol=1e-8)
    assert drive.frames[3][4, -1] == np.float32(1e-3)
    assert drive.stamps_s is None


def test_a_session_gets_the_ranges_that_the_fixes_are_made_of(
    authors_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "s.mcap"
    code, said, err = run(capsys, "convert", authors_file, out, "--rate", 10)
    assert (code, err) == (0, "")
    assert "6 states with 3 fixes, made of 6 ranges" in said
    assert "no stamps, 10 states/s are assumed" in said
    session = open_session(out)
    assert session.info.has_detections
    assert [sample.t_ns for sample in session.odometry()] == [
        k * 100_000_000 for k in range(N_STATES)
    ]
    found = session.detections()
    assert {t_ns: len(rows) for t_ns, rows in found.items() if rows} == {200_000_000: 6}
    # mounts of the authors' later robot: 10.5 cm ahead or behind, 18 cm to the side
    expected = {
        0: [math.hypot(0.2 - 0.105, -0.9 + 0.18)],
        1: sorted([math.hypot(0.105, 1.0 - 0.18), math.hypot(0.1 + 0.105, 0.7 - 0.18)]),
        2: [math.hypot(0.2 + 0.105, -0.9 + 0.18)],
        3: sorted([math.hypot(0.105, 1.0 - 0.18), math.hypot(0.1 - 0.105, 0.7 - 0.18)]),
    }
    of_radar: dict[int, list[float]] = {}
    for row in found[200_000_000]:
        of_radar.setdefault(row.radar, []).append(row.range_m)
    assert set(of_radar) == set(expected)
    for radar, ranges in expected.items():
        np.testing.assert_allclose(of_radar[radar], ranges, atol=1e-12)
    frames = [frame for one in session.scans() for frame in one.frames]
    assert [(frame.radar, frame.counter, len(frame.samples)) for frame in frames] == [(2, 4, 500)]


def test_it_is_replayed(
    authors_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(capsys, "convert", authors_file, tmp_path / "s.mcap")
    assert main(["replay", str(tmp_path / "s.mcap"), "--out", str(tmp_path / "out")]) == 0
    assert "Traceback" not in capsys.readouterr().err


# Both antennas of the pair, 10.5 cm ahead and behind, see these within 32.5 degrees.
LEFT = st.tuples(st.floats(-0.1, 0.1), st.floats(0.51, 1.5))


@settings(max_examples=60, deadline=None)
@given(left=st.lists(LEFT, min_size=1, max_size=3), right=st.lists(LEFT, max_size=3))
def test_ranges_pair_to_the_fixes_they_came_from(
    tmp_path_factory: pytest.TempPathFactory,
    left: list[tuple[float, float]],
    right: list[tuple[float, float]],
) -> None:
    folder = tmp_path_factory.mktemp("mat")
    here, there = np.array(left).reshape(-1, 2), -np.array(right).reshape(-1, 2)
    drive = MatDrive(odometry=np.zeros((1, 3)), left=(here,), right=(there,), frames={})
    write_mat(folder / "a.mat", drive)
    assert main(["convert", str(folder / "a.mat"), str(folder / "s.mcap")]) == 0
    session = open_session(folder / "s.mcap")
    assert session.rig.mounts == MAT_RIG.mounts
    trilaterator = Trilaterator(load_preset("paper").trilateration, session.rig)
    found: tuple[Detection, ...] = session.detections()[0]
    points = [(fix.x_m, fix.y_m) for fix in trilaterator.locate(found, 0)]
    for point in [*here, *there]:
        # ranges closer than 0.1 mm are one, and 0.1 mm of range are 0.3 mm of place here
        assert min(math.dist(point, other) for other in points) < 1.5e-3


def test_a_written_file_comes_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    sent = MatDrive(
        odometry=rng.normal(size=(3, 3)),
        left=(np.zeros((0, 2)), rng.normal(size=(7, 2)), np.array([[0.3, 0.9]])),
        right=(np.array([[0.1, -0.9]]), np.zeros((0, 2)), np.zeros((0, 2))),
        frames={2: rng.normal(size=(3, 40)).astype(np.float32)},
        stamps_s=np.array([0.0, 0.25, 1.5]),
        mounts=rng.normal(size=(4, 3)),
    )
    write_mat(tmp_path / "a.mat", sent)
    found = read_mat(tmp_path / "a.mat")
    np.testing.assert_allclose(found.odometry, sent.odometry, atol=1e-12)
    for one, other in zip((*found.left, *found.right), (*sent.left, *sent.right), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)
    assert found.frames[2].tolist() == sent.frames[2].tolist()
    assert found.stamps_s is not None
    assert found.mounts is not None
    assert sent.mounts is not None
    np.testing.assert_allclose(found.stamps_s, [0.0, 0.25, 1.5])
    np.testing.assert_allclose(found.mounts, sent.mounts, atol=1e-12)
    raw = loadmat(tmp_path / "a.mat")
    assert raw["obsLHS"].shape == (3, 7, 2)
    # the right side's bearings run on from pi, as the authors'
    assert raw["obsRHS"][0, 0].tolist() == pytest.approx(
        [1e3 * math.hypot(0.1, 0.9), math.tau - math.atan2(0.9, 0.1)]
    )


def four_radars() -> SessionInfo:
    info = session_info(4)
    radars = tuple(
        replace(radar, x_m=mount.x_m, y_m=mount.y_m, yaw_rad=mount.yaw_rad)
        for radar, mount in zip(info.radars, MAT_RIG.mounts, strict=True)
    )
    return replace(info, radars=radars)


def test_a_session_as_such_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """States are collected after 4.5 mm or 2 mrad; noise alone gives no fixes."""
    steps = [(0.0, 0.0), (0.001, 0.0), (0.0046, 0.0), (0.005, 0.001), (0.005, 0.003), (0.02, 0.0)]
    lines = [
        format_tum_line(scan(k).t_ns, np.array([x_m, 0.0, turn]))
        for k, (x_m, turn) in enumerate(steps)
    ]
    scans = [scan(counter, 4) for counter in range(6)]
    scans[4] = replace(scans[4], frames=scans[4].frames[1:])
    track = OdometryTrack.from_lines(lines)
    session = write_scans(tmp_path / "s.mcap", scans, track, four_radars())
    code, said, err = run(capsys, "convert", session, tmp_path / "a.mat", "--preset", "paper")
    assert (code, err) == (0, "")
    assert said == f"{tmp_path / 'a.mat'}: 4 states with 0 fixes\n"
    drive = read_mat(tmp_path / "a.mat")
    collected = (0, 2, 4, 5)
    np.testing.assert_allclose(
        drive.odometry, [(steps[k][0], 0.0, steps[k][1]) for k in collected], atol=1e-12
    )
    assert drive.stamps_s is not None
    assert drive.stamps_s.tolist() == [scan(k).t_ns / 1e9 for k in collected]
    assert not drive.frames[1][2].any()  # that frame was lost
    for row, counter in enumerate(collected):
        assert drive.frames[2][row].tolist() == scan(counter, 4).frames[1].samples.tolist()


def test_frames_come_back_at_their_ranges(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    info = four_radars()
    radars = [replace(each, range_offset_m=0.01 * k) for k, each in enumerate(info.radars)]
    known = replace(info, radars=tuple(radars))
    track = OdometryTrack.from_lines([format_tum_line(scan(0).t_ns, np.zeros(3))])
    session = write_scans(tmp_path / "s.mcap", [scan(0, 4)], track, known)
    assert run(capsys, "convert", session, tmp_path / "a.mat")[0] == 0
    assert run(capsys, "convert", tmp_path / "a.mat", tmp_path / "again.mcap")[0] == 0
    before, after = (open_session(tmp_path / name) for name in ("s.mcap", "again.mcap"))
    for one, other in zip(before.frames(), after.frames(), strict=True):
        offset_m = 0.01 * one.radar  # the mounts of a file have none
        assert other.range_start_m == pytest.approx(one.range_start_m - offset_m, abs=1e-12)
        assert other.bin_length_m == pytest.approx(one.bin_length_m, abs=1e-15)


def test_a_file_that_cannot_be_written_says_why(tmp_path: Path) -> None:
    savemat(tmp_path / "a.mat", authors_table())
    drive = read_mat(tmp_path / "a.mat")
    with pytest.raises(AppError):
        write_mat(tmp_path / "no folder" / "b.mat", drive)


@pytest.mark.parametrize(("sigma_m", "code"), [(0.0, 0), (1e-3, 1)])
def test_a_removed_setting_of_a_session_is_read_at_its_default_only(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], sigma_m: float, code: int
) -> None:
    stored = json.loads(settings_text(SlamConfig()))
    stored["robust"]["calibrated_offset_sigma_m"] = sigma_m
    info = replace(four_radars(), config_json=json.dumps(stored), wheels={"scale_sigma": 0.1})
    track = OdometryTrack.from_lines([format_tum_line(scan(0).t_ns, np.zeros(3))])
    write_scans(tmp_path / "s.mcap", [scan(0, 4)], track, info)
    ended, _, err = run(capsys, "convert", tmp_path / "s.mcap", tmp_path / "a.mat")
    assert ended == code
    assert err.count("\n") == code


def test_a_file_that_was_begun_is_removed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, *_: object, **__: object) -> None:
        path.write_bytes(b"begun")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("slam.app.convert.matlab.savemat", full)
    lines = [format_tum_line(scan(k).t_ns, np.zeros(3)) for k in range(2)]
    track = OdometryTrack.from_lines(lines)
    write_scans(tmp_path / "s.mcap", [scan(0, 4), scan(1, 4)], track, four_radars())
    out = tmp_path / "a.mat"
    code, _, err = run(capsys, "convert", tmp_path / "s.mcap", out, "--preset", "paper")
    assert code == 1
    assert "No space left on device" in err
    assert not out.exists()


def test_a_cut_file_is_one_line(
    authors_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = tmp_path / "x.mat", tmp_path / "s.mcap"
    content = authors_file.read_bytes()
    for share in (0.0, 0.1, 0.5, 0.9):
        path.write_bytes(content[: round(share * len(content))])
        code, said, err = run(capsys, "convert", path, out)
        assert (code, said, err.count("\n")) == (1, "", 1)
        assert not out.exists()
