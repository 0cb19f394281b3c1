"""`uwb-slam evaluate`: the error of one trajectory file against another."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slam.app.errors import AppError
from slam.app.tum import NS_PER_S, read_tum
from slam.metrics import associate_times, ate_rmse_m

Array = NDArray[np.float64]

_TOLERANCE_NS = NS_PER_S // 100
"""Stamps further apart than 10 ms do not belong together, as in evo."""


def evaluate(estimate: Path, reference: Path) -> dict[str, float | int | str | None]:
    """Return the ATE of one TUM file against another, with what it rests on.

    The ATE is None where positions are so large that it overflows.

    Raises
    ------
    AppError
        A file cannot be read, or the two have fewer than two stamps in common.
    """
    est, ref = read_tum(estimate), read_tum(reference)
    est_rows, ref_rows = associate_times(est.stamps_ns, ref.stamps_ns, _TOLERANCE_NS)
    if len(est_rows) < 2:
        raise AppError(
            f"{estimate} and {reference} share {len(est_rows)} stamps within 10 ms; "
            "both must be in the same time base"
        )
    return {
        "ate_rmse_m": _finite_ate_m(est.poses[est_rows, :2], ref.poses[ref_rows, :2]),
        "pairs": len(est_rows),
        "estimate_poses": len(est.stamps_ns),
        "reference_poses": len(ref.stamps_ns),
        "alignment": "SE(2), no scale",
    }


def _finite_ate_m(estimate_xy: Array, reference_xy: Array) -> float | None:
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            ate_m = ate_rmse_m(estimate_xy, reference_xy)
    except np.linalg.LinAlgError:  # the alignment met what had overflowed
        return None
    return ate_m if math.isfinite(ate_m) else None


def run_evaluate(estimate: Path, reference: Path, *, as_json: bool) -> None:
    """Print the ATE as a line, or as one JSON object."""
    result = evaluate(estimate, reference)
    if as_json:
        sys.stdout.write(json.dumps(result, allow_nan=False) + "\n")
        return
    ate_m = result["ate_rmse_m"]
    size = "beyond floating point" if ate_m is None else f"{1e3 * float(ate_m):.1f} mm"
    sys.stdout.write(
        f"ATE {size} (RMS, {result['alignment']}, "
        f"{result['pairs']} of {result['estimate_poses']} poses)\n"
    )
