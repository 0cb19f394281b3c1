"""`uwb-slam evaluate`: trajectories against a reference: numbers as evo has them, and a picture."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from slam.app.run.output import print_table, print_text
from slam.geometry import align_se2, transform
from slam.library.evaluation import (
    associate_times,
    ate_rmse_m,
    ate_rotation_rmse_rad,
    relative_pose_errors,
)
from slam.live.errors import AppError
from slam.live.odometry_track import NS_PER_S, Trajectory, read_tum
from slam.live.session.reader import begins_with, open_session
from slam.live.session_records import Scan, Snapshot
from xethru_protocol.operating_system import StopFlag
from xethru_protocol.recordings.mcap import MAGIC
from xethru_protocol.validation import recording_at

Array = NDArray[np.float64]
Errors = dict[str, float | int | str | None]

_TOLERANCE_NS = NS_PER_S // 100
"""Stamps further apart than 10 ms are not associated, as in evo."""
_COLUMNS = {
    "ate_rmse_m": ("ATE [m]", ".4f"),
    "ate_rotation_rmse_deg": ("heading [deg]", ".2f"),
    "rpe_rmse_m": ("RPE [m]", ".4f"),
    "rpe_rotation_rmse_deg": ("RPE [deg]", ".2f"),
    "pairs": ("poses", "d"),
}
"""Of each column of the table its heading, and the format of its numbers."""


def trajectory_at(
    path: Path, stop: StopFlag, wanted: Literal["estimate", "truth"] = "estimate"
) -> Trajectory:
    """Return the poses of a TUM file, or what is wanted of a session or of a run's folder.

    Raises AppError if the file cannot be read, or does not hold them.
    """
    source = Path(recording_at(str(path)))
    if source.is_dir() and (source / f"{wanted}.tum").is_file():  # as replay leaves it
        source /= f"{wanted}.tum"
    if not (source.is_dir() or begins_with(source, MAGIC)):
        return read_tum(source)
    rows: dict[int, Array] = {}
    for record in open_session(source, stop).played():
        if isinstance(record, Snapshot) and wanted == "estimate":
            rows[record.t_ns] = record.estimate
        elif isinstance(record, Scan) and wanted == "truth" and record.truth is not None:
            rows[record.t_ns] = record.truth
    known = {t_ns: pose for t_ns, pose in sorted(rows.items()) if np.isfinite(pose).all()}
    if not known:
        remedy = "`uwb-slam replay` makes one" if wanted == "estimate" else "give a TUM file of it"
        raise AppError(f"{path}: holds no {wanted}; {remedy}")
    return Trajectory(
        stamps_ns=np.array(list(known), dtype=np.int64), poses=np.array(list(known.values()))
    )


def associated(
    estimate: Trajectory, reference: Trajectory
) -> tuple[NDArray[np.int64], Array, Array]:
    """Return the stamps of the estimate that both have, (k,), and both poses there, (k, 3) each."""
    rows, of_reference = associate_times(estimate.stamps_ns, reference.stamps_ns, _TOLERANCE_NS)
    if len(rows) < 2:
        raise AppError(
            f"it shares {len(rows)} stamps within 10 ms with the reference; both must be in the "
            "same time base"
        )
    return estimate.stamps_ns[rows], estimate.poses[rows], reference.poses[of_reference]


def evaluate(estimate: Trajectory, reference: Trajectory, delta_m: float = 1.0) -> Errors:
    """Return the errors of one trajectory against another, with the numbers of poses.

    The RPE is over ``delta_m`` of the reference's way. An error is None where positions are so
    large that it overflows, or where no two poses are so far apart. Fewer than two stamps in common
    raise AppError.
    """
    _, poses, truth = associated(estimate, reference)
    with np.errstate(over="ignore", invalid="ignore"):
        relative = relative_pose_errors(poses, truth, delta_m)
        errors = {
            "ate_rmse_m": ate_rmse_m(poses[:, :2], truth[:, :2]),
            "ate_rotation_rmse_deg": math.degrees(ate_rotation_rmse_rad(poses, truth)),
            "rpe_rmse_m": _rms(relative[:, :2]),
            "rpe_rotation_rmse_deg": math.degrees(_rms(relative[:, 2:])),
        }
    return {
        **{name: value if math.isfinite(value) else None for name, value in errors.items()},
        "rpe_delta_m": delta_m,
        "rpe_pairs": len(relative),
        "pairs": len(poses),
        "estimate_poses": len(estimate.stamps_ns),
        "reference_poses": len(reference.stamps_ns),
        "alignment": "SE(2), no scale",
    }


def _rms(rows: Array) -> float:
    return math.sqrt(np.mean(np.sum(rows**2, axis=1))) if len(rows) else math.nan


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
    truth = trajectory_at(reference, stop, "truth")
    paths = {str(path): trajectory_at(path, stop) for path in estimates}
    results: dict[str, Errors] = {}
    for name, path in paths.items():
        try:
            results[name] = evaluate(path, truth, delta_m)
        except AppError as error:
            raise AppError(f"{name}: {error}") from None
    if out is not None:
        _draw(out, paths, truth)
    if as_json:
        rows = [{"estimate": name, **errors} for name, errors in results.items()]
        several = {"reference": str(reference), "estimates": rows}
        found = several if len(rows) > 1 else next(iter(results.values()))
        print_text(json.dumps(found, allow_nan=False))
        return
    header = ["estimate", *(heading for heading, _ in _COLUMNS.values())]
    table = [
        [
            name,
            *(
                "-" if errors[key] is None else f"{errors[key]:{form}}"
                for key, (_, form) in _COLUMNS.items()
            ),
        ]
        for name, errors in results.items()
    ]
    title = f"Root mean squares after alignment by SE(2), no scale; RPE over {delta_m:g} m"
    print_table(title, header, table)


def _draw(out: Path, paths: Mapping[str, Trajectory], reference: Trajectory) -> None:
    """Draw the aligned paths on the reference, and how far each is from it over time."""
    from matplotlib import colormaps  # half a second, loaded only if needed

    from slam.app.run.pictures import TRUTH, label, picture

    with picture(out, width_in=10.0, height_in=5.0) as figure:
        map_axes, error_axes = figure.subplots(1, 2)
        map_axes.set_aspect("equal", adjustable="datalim")
        map_axes.plot(*reference.poses[:, :2].T, color=TRUTH, linewidth=3.0, label="reference")
        for number, (name, path) in enumerate(paths.items()):
            stamps_ns, poses, truth = associated(path, reference)
            aligned = transform(align_se2(poses[:, :2], truth[:, :2]), poses[:, :2])
            colour = colormaps["tab10"](number % 10)
            map_axes.plot(*aligned.T, color=colour, linewidth=1.0, label=name)
            error_mm = 1e3 * np.linalg.norm(aligned - truth[:, :2], axis=1)
            error_axes.plot((stamps_ns - reference.stamps_ns[0]) / NS_PER_S, error_mm, color=colour)
        label(map_axes, "paths, aligned to the reference", "x [m]", "y [m]")
        label(error_axes, "distance from the reference", "time [s]", "error [mm]")
        figure.legend(loc="outside lower left", frameon=False, fontsize=9)
