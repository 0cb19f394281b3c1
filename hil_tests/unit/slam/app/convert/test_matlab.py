"""MATLAB files of detections, in the authors' layout as we generate it."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from hil_tests.property.examples import examples
from hil_tests.unit.slam.app.convert.authors_mat import write_fixes
from hil_tests.unit.slam.app.sessions import run, session_info
from slam.app.cli import main
from slam.app.convert.matlab import MAT_RIG, read_mat
from slam.app.session.writer import SessionLog
from slam.config import SlamConfig, load_preset
from slam.frames import Detection
from slam.live.errors import AppError
from slam.live.session.description import settings_text
from slam.live.session.reader import open_session
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
    frames = {f"R{k}": np.ones((N_STATES, 500), dtype=np.float32) for k in range(1, 5)}
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
    assert [one.frames for one in session.scans()] == [()] * N_STATES  # raw ones are left out


def test_it_is_replayed(
    authors_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(capsys, "convert", authors_file, tmp_path / "s.mcap")
    assert main(["replay", str(tmp_path / "s.mcap"), "--out", str(tmp_path / "out")]) == 0
    assert "Traceback" not in capsys.readouterr().err


# Both antennas of the pair, 10.5 cm ahead and behind, see these within 32.5 degrees.
LEFT = st.tuples(st.floats(-0.1, 0.1), st.floats(0.51, 1.5))


@settings(max_examples=examples(60), deadline=None)
@given(left=st.lists(LEFT, min_size=1, max_size=3), right=st.lists(LEFT, max_size=3))
def test_ranges_pair_to_the_fixes_they_came_from(
    tmp_path_factory: pytest.TempPathFactory,
    left: list[tuple[float, float]],
    right: list[tuple[float, float]],
) -> None:
    folder = tmp_path_factory.mktemp("mat")
    here, there = np.array(left).reshape(-1, 2), -np.array(right).reshape(-1, 2)
    write_fixes(folder / "a.mat", np.zeros((1, 3)), [here], [there])
    assert main(["convert", str(folder / "a.mat"), str(folder / "s.mcap")]) == 0
    session = open_session(folder / "s.mcap")
    assert session.rig.mounts == MAT_RIG.mounts
    trilaterator = Trilaterator(load_preset("paper").trilateration, session.rig)
    found: tuple[Detection, ...] = session.detections()[0]
    points = [(fix.x_m, fix.y_m) for fix in trilaterator.locate(found, 0)]
    for point in [*here, *there]:
        # ranges closer than 0.1 mm are one, and 0.1 mm of range are 0.3 mm of place here
        assert min(math.dist(point, other) for other in points) < 1.5e-3


@pytest.mark.parametrize(("sigma_m", "is_known"), [(0.0, True), (1e-3, False)])
def test_a_removed_setting_of_a_session_is_read_at_its_default_only(
    tmp_path: Path, sigma_m: float, is_known: bool
) -> None:
    stored = json.loads(settings_text(SlamConfig()))
    stored["robust"]["calibrated_offset_sigma_m"] = sigma_m
    info = replace(session_info(), config_json=json.dumps(stored))
    SessionLog(tmp_path / "s.mcap", info, None).close()
    session = open_session(tmp_path / "s.mcap")
    if is_known:
        assert session.config == SlamConfig()
    else:
        with pytest.raises(AppError, match="calibrated_offset_sigma_m"):
            _ = session.config


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
