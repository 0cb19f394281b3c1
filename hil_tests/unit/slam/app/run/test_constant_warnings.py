"""What is printed of constants of wheels and radars that are not what was stated."""

from dataclasses import replace

import numpy as np
import pytest

from hil_tests.unit.slam.app.sessions import odometry, record_of_steps, session_info
from hil_tests.unit.slam.robust import range_world
from hil_tests.unit.slam.simulation import FRAME_NS, at_rest
from slam.app.run.output import constant_warnings, print_result
from slam.app.run.runner import RunSource
from slam.config import WheelNoise, load_preset, override
from slam.frames import Detection
from slam.geometry import Rig, paper_rig
from slam.results import StartOnMap, StepResult
from slam.robust.pipeline import RobustSlam

N_STEPS = 300
SIGMA_M = 1e-3
EXACT = override(
    load_preset("robust"),
    {
        "robust.range_floor_m": 0.0,
        "robust.association_doubt_m": 0.0,
        "robust.range_variance_share": 1.0,
        "robust.mount_sigma_m": 0.0,
        "robust.radius_sigma_m": 0.0,
    },
)
"""Ranges of points, to a millimetre: a third of a lap is enough."""
EXACT_WHEELS = replace(range_world.LAB, scale_sigma=0.0, curvature_sigma=0.0)
STATED_OFFSETS_M = (0.0, 0.05, 0.0, 0.0)


def rig() -> Rig:
    mounts = zip(paper_rig().mounts, STATED_OFFSETS_M, strict=True)
    return Rig(mounts=tuple(replace(mount, range_offset_m=m) for mount, m in mounts))


def drive(
    slam: RobustSlam, n_steps: int = N_STEPS, *, scale: float = 1.0, too_long_m: float = 0.0
) -> list[StepResult]:
    """Drive with wheels that report so many times the way, and ranges of radar 1 that are off.

    `too_long_m` is what is left of them once the stated offset is taken off.
    """
    world = range_world.simulate(EXACT_WHEELS, 0, SIGMA_M, laps=1, clutter=False)
    path = range_world.odometry_path(world.increments) * np.array([scale, scale, 1.0])
    results = list[StepResult]()
    for k, scans in enumerate([[], *world.scans[:n_steps]]):
        t_ns = k * FRAME_NS
        detections = [
            Detection(
                radar=scan.radar,
                t_ns=t_ns,
                range_m=range_m + too_long_m * (scan.radar == 1),
                amplitude=0.01,
                sigma_m=SIGMA_M,
            )
            for scan in scans
            for range_m in scan.ranges_m
        ]
        results += slam.step_detections(detections, at_rest(path[k]), t_ns)
    return results


def lines_after_a_drive(
    capsys: pytest.CaptureFixture[str], *, scale: float = 1.0, too_long_m: float = 0.0
) -> list[str]:
    """Return what is printed beside the table of a drive."""
    slam = RobustSlam(EXACT, rig(), WheelNoise())
    results = drive(slam, scale=scale, too_long_m=too_long_m)
    truth = np.full((len(results), 3), np.nan)
    record = record_of_steps(results, truth, np.zeros(3), np.empty((0, 2)))
    source = RunSource(info=session_info(), rig=slam.rig, slam=slam, scans=(), odometry=odometry(2))
    capsys.readouterr()
    print_result(source, replace(record, smoothed=slam.smoothed()), None)
    return capsys.readouterr().err.splitlines()


def test_nothing_is_said_where_what_was_stated_is_right(capsys: pytest.CaptureFixture[str]) -> None:
    assert lines_after_a_drive(capsys) == []


def test_wheels_that_report_a_tenth_too_much_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    (line,) = lines_after_a_drive(capsys, scale=1.1)
    begin, _, rest = line.partition(" was found to be ")
    assert begin == "warning: odometry: its error of distances"
    assert float(rest.partition("%")[0]) == pytest.approx(10.0, abs=2.0)
    assert "from the stated 0% +- 0.7%" in line
    assert "scale_sigma under [wheels] of the rig file" in line


def test_ranges_that_are_10_cm_too_long_are_named(capsys: pytest.CaptureFixture[str]) -> None:
    (line,) = lines_after_a_drive(capsys, too_long_m=0.1)
    begin, _, rest = line.partition(" was found to be ")
    assert begin == f"warning: radar {paper_rig().mounts[1].name}: its range offset"
    # beyond the offset that was stated
    assert float(rest.partition(" m")[0]) == pytest.approx(0.15, abs=0.01)
    assert "from the stated 0.05 m +- 0.02 m" in line
    assert "set range_offset_m in the rig file" in line


def test_offsets_that_are_known_or_are_a_maps_are_not_judged() -> None:
    first = RobustSlam(EXACT, rig(), WheelNoise())
    drive(first, too_long_m=0.1)
    on_map = StartOnMap(map=first.saved_map(), pose=(0.0, 0.0, 0.0))
    calibrated = override(EXACT, {"robust.offset_sigma_m": 0.0})
    for slam in (
        RobustSlam(EXACT, rig(), WheelNoise(), on_map=on_map),
        RobustSlam(calibrated, rig(), WheelNoise()),
    ):
        drive(slam, 60, too_long_m=0.1)
        smoothed = slam.smoothed()
        assert smoothed is not None
        assert smoothed.constants is not None
        assert smoothed.constants[:3, 1].tolist() == list(WheelNoise().calibration_sigmas)
        assert np.isinf(smoothed.constants[3:, 1]).all()
        far = np.column_stack([np.full(7, 0.1), smoothed.constants[:, 1]])
        assert len(constant_warnings(rig(), far)) == 3
