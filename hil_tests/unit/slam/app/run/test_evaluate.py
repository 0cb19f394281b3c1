"""`uwb-slam evaluate` against trajectories whose error is known in closed form."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from slam.app.cli import main
from slam.app.odometry.tum import Trajectory, write_tum
from slam.app.run.results import evaluate

N = 200
STAMPS = np.arange(N, dtype=np.int64) * 199_261_498


def square_path() -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, N, endpoint=False)
    return np.stack([np.cos(angle), np.sin(angle), angle], axis=1)


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    reference = square_path()
    # radial error +-10 mm, alternating: mean zero and uncorrelated with position, so no alignment
    # can remove any of it; then moved rigidly, which alignment must remove wholly
    radial = 0.01 * np.where(np.arange(N) % 2, 1.0, -1.0)
    bent = reference[:, :2] * (1 + radial)[:, None]
    cosine, sine = math.cos(0.7), math.sin(0.7)
    moved = bent @ np.array([[cosine, sine], [-sine, cosine]]) + [3.0, -2.0]
    estimate = np.column_stack([moved, reference[:, 2] + 0.7])
    write_tum(tmp_path / "ref.tum", Trajectory(stamps_ns=STAMPS, poses=reference))
    write_tum(tmp_path / "est.tum", Trajectory(stamps_ns=STAMPS[3:] + 900_000, poses=estimate[3:]))
    return tmp_path / "est.tum", tmp_path / "ref.tum"


def test_a_rigid_motion_costs_nothing_and_noise_counts(
    files: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", *map(str, files), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["ate_rmse_m"] == pytest.approx(0.01, rel=0.01)
    assert (result["pairs"], result["reference_poses"]) == (N - 3, N)


def test_the_line_states_the_alignment(
    files: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", *map(str, files)]) == 0
    assert capsys.readouterr().out == "ATE 10.0 mm (RMS, SE(2), no scale, 197 of 197 poses)\n"


@pytest.mark.parametrize("sign", [1, -1])
def test_stamps_belong_together_within_10_ms(tmp_path: Path, sign: int) -> None:
    reference, estimate = tmp_path / "ref.tum", tmp_path / "est.tum"
    write_tum(reference, Trajectory(stamps_ns=STAMPS, poses=square_path()))
    # 9 ms and 11 ms apart, in turns
    apart_ns = np.where(np.arange(N) % 2, 11_000_000, 9_000_000)
    write_tum(estimate, Trajectory(stamps_ns=STAMPS + sign * apart_ns, poses=square_path()))
    assert evaluate(estimate, reference)["pairs"] == N // 2


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
    assert capsys.readouterr().out.startswith("ATE beyond floating point (RMS, ")


def test_wrong_files_are_one_line_and_exit_1(
    files: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", str(tmp_path / "none.tum"), str(files[1])]) == 1
    assert "none.tum: cannot read: No such file" in capsys.readouterr().err
    late = tmp_path / "late.tum"
    write_tum(late, Trajectory(stamps_ns=STAMPS + 10**15, poses=square_path()))
    assert main(["evaluate", str(late), str(files[1])]) == 1
    said = capsys.readouterr().err
    assert "share 0 stamps" in said
    assert said.count("\n") == 1
