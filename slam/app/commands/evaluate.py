"""`uwb-slam evaluate`: trajectories against a reference: numbers as evo has them, and a picture."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from numpy.typing import NDArray

from slam.app.errors import AppError, UsageError
from slam.app.odometry.track import NS_PER_S, Trajectory, read_tum
from slam.app.run.output import print_table, print_text
from slam.app.run.pictures import TRUTH, label, picture
from slam.app.session.reader import RecordedScan, open_session
from slam.app.session_records import Snapshot
from slam.evaluation import associate_times, ate_rmse_m, ate_rotation_rmse_rad, relative_pose_errors
from slam.geometry import align_se2, transform
from xethru_protocol.operating_system import StopFlag, one_line
from xethru_protocol.recordings.mcap import MAGIC
from xethru_protocol.validation import recording_at

Array = NDArray[np.float64]
Errors = dict[str, float | int | str | None]

_TOLERANCE_NS = NS_PER_S // 100
"""Stamps further apart than 10 ms are not associated, as in evo."""
_PICTURE_SUFFIX = ".png"
_COLUMNS = {
    "ate_rmse_m": ("ATE [mm]", 1e3),
    "ate_rotation_rmse_deg": ("heading [deg]", 1.0),
    "rpe_rmse_m": ("RPE [mm]", 1e3),
    "rpe_rotation_rmse_deg": ("RPE [deg]", 1.0),
}
"""Of each error its heading in a table, and what it is multiplied with there."""


def trajectory_at(path: Path, stop: StopFlag, *, is_reference: bool = False) -> Trajectory:
    """Return the poses of a TUM file; of a session or a run's folder its estimate, or its truth.

    Raises AppError if the file cannot be read, or does not hold them.
    """
    given, wanted = path, "truth" if is_reference else "estimate"
    path = Path(recording_at(str(path)))
    if path.is_dir() and (path / f"{wanted}.tum").is_file():  # as replay leaves it
        path /= f"{wanted}.tum"
    if not path.is_dir() and not _is_mcap(path):
        return read_tum(path)
    rows: dict[int, Array] = {}
    for record in open_session(path, stop).played():
        if isinstance(record, Snapshot) and not is_reference:
            rows[record.t_ns] = record.estimate
        elif isinstance(record, RecordedScan) and is_reference and record.truth is not None:
            rows[record.scan.t_ns] = record.truth
    known = {t_ns: pose for t_ns, pose in sorted(rows.items()) if np.isfinite(pose).all()}
    if not known:
        hint = "" if is_reference else "; `uwb-slam replay` runs SLAM on it"
        raise AppError(f"{given}: holds no {wanted}{hint}")
    return Trajectory(
        stamps_ns=np.array(list(known), dtype=np.int64), poses=np.array(list(known.values()))
    )


def _is_mcap(path: Path) -> bool:
    try:
        with path.open("rb") as stream:
            return stream.read(len(MAGIC)) == MAGIC
    except OSError:  # who reads it next reports that
        return False


def associated(
    estimate: Trajectory, reference: Trajectory
) -> tuple[NDArray[np.int64], Array, Array]:
    """Return the stamps that both have, (k,), and the poses of both there, (k, 3) each."""
    rows, of_reference = associate_times(estimate.stamps_ns, reference.stamps_ns, _TOLERANCE_NS)
    return estimate.stamps_ns[rows], estimate.poses[rows], reference.poses[of_reference]


def evaluate(
    estimate: Path, reference: Path, *, delta_m: float = 1.0, stop: StopFlag | None = None
) -> Errors:
    """Return the errors of one trajectory against another, with the numbers of poses.

    The RPE is over ``delta_m`` of the reference's way. An error is None where positions are so
    large that it overflows, or where there is no pair of poses so far apart. Two files with fewer
    than two stamps in common raise AppError.
    """
    stop = stop or StopFlag()
    est = trajectory_at(estimate, stop)
    ref = trajectory_at(reference, stop, is_reference=True)
    return _errors(estimate, est, reference, ref, delta_m)


def _errors(
    estimate: Path, est: Trajectory, reference: Path, ref: Trajectory, delta_m: float
) -> Errors:
    _, poses, truth = associated(est, ref)
    if len(poses) < 2:
        raise AppError(
            f"{estimate} and {reference} share {len(poses)} stamps within 10 ms; "
            "both must be in the same time base"
        )
    with np.errstate(over="ignore", invalid="ignore"):
        relative = relative_pose_errors(poses, truth, delta_m)
        ate_m = ate_rmse_m(poses[:, :2], truth[:, :2])
        ate_rad = ate_rotation_rmse_rad(poses, truth)
        rpe_m, rpe_rad = (
            math.sqrt(np.mean(np.sum(part**2, axis=1))) if len(part) else math.inf
            for part in (relative[:, :2], relative[:, 2:])
        )
    return {
        "ate_rmse_m": _finite(ate_m),
        "ate_rotation_rmse_deg": _finite(math.degrees(ate_rad)),
        "rpe_rmse_m": _finite(rpe_m),
        "rpe_rotation_rmse_deg": _finite(math.degrees(rpe_rad)),
        "rpe_delta_m": delta_m,
        "rpe_pairs": len(relative),
        "pairs": len(poses),
        "estimate_poses": len(est.stamps_ns),
        "reference_poses": len(ref.stamps_ns),
        "alignment": "SE(2), no scale",
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def run_evaluate(
    stop: StopFlag,
    *,
    estimates: Sequence[Path],
    reference: Path,
    delta_m: float,
    out: Path | None,
    as_json: bool,
) -> None:
    """Print the errors of each estimate against the reference, and draw them if asked for."""
    if out is not None and out.suffix != _PICTURE_SUFFIX:
        raise UsageError(f"--out {out}: a picture is written; give a name that ends in .png")
    ref = trajectory_at(reference, stop, is_reference=True)
    drawn = {path: trajectory_at(path, stop) for path in estimates}
    results = {path: _errors(path, est, reference, ref, delta_m) for path, est in drawn.items()}
    if out is not None:
        with picture(out, width_in=10.0, height_in=5.0) as figure:
            _draw(figure, drawn, ref)
    first = next(iter(results.values()))
    if as_json:
        rows = [{"estimate": str(path), **result} for path, result in results.items()]
        found = first if len(rows) == 1 else {"reference": str(reference), "estimates": rows}
        print_text(json.dumps(found, allow_nan=False))
        return
    about = f"RMS, {first['alignment']}"
    if len(results) > 1:
        header = ["estimate", *(name for name, _ in _COLUMNS.values()), "poses"]
        table = [
            [
                one_line(str(path)),
                *map(_text, _COLUMNS, [result] * len(_COLUMNS)),
                f"{result['pairs']}",
            ]
            for path, result in results.items()
        ]
        print_table(f"{about}; RPE over {delta_m:g} m", header, table)
        return
    ate, heading, rpe_m, rpe_deg = (_text(key, first) for key in _COLUMNS)
    ate = f"{ate} mm" if first["ate_rmse_m"] is not None else "beyond floating point"
    print_text(f"ATE {ate} ({about}, {first['pairs']} of {first['estimate_poses']} poses)")
    print_text(
        f"heading {heading} deg; RPE over {delta_m:g} m: {rpe_m} mm, {rpe_deg} deg "
        f"({first['rpe_pairs']} pairs)"
    )


def _text(key: str, result: Errors) -> str:
    value = result[key]
    return (
        "-"
        if value is None
        else f"{float(value) * _COLUMNS[key][1]:.{1 if key[-1] == 'm' else 2}f}"
    )


def _draw(figure: Figure, estimates: dict[Path, Trajectory], reference: Trajectory) -> None:
    """Draw the aligned paths on the reference, and how far each is from it over time."""
    paths, errors = figure.subplots(1, 2)
    paths.set_aspect("equal", adjustable="datalim")
    paths.plot(*reference.poses[:, :2].T, color=TRUTH, linewidth=3.0, alpha=0.6, label="reference")
    for number, (path, estimate) in enumerate(estimates.items()):
        stamps_ns, poses, truth = associated(estimate, reference)
        aligned = transform(align_se2(poses[:, :2], truth[:, :2]), poses[:, :2])
        colour = colormaps["tab10"](number % 10)
        paths.plot(*aligned.T, color=colour, linewidth=1.0, label=str(path))
        t_s = (stamps_ns - reference.stamps_ns[0]) / NS_PER_S
        error_mm = 1e3 * np.linalg.norm(aligned - truth[:, :2], axis=1)
        errors.plot(t_s, error_mm, color=colour, linewidth=1.0)
    label(paths, "paths, aligned to the reference", "x [m]", "y [m]")
    label(errors, "distance from the reference", "time [s]", "error [mm]")
    figure.legend(loc="outside lower left", frameon=False, fontsize=9)
