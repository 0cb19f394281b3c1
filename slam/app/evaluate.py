"""`uwb-slam evaluate`: the error of one trajectory file against another."""

from __future__ import annotations

import json
import sys
from pathlib import Path

from slam.app.errors import AppError
from slam.app.tum import NS_PER_S, read_tum
from slam.metrics import associate_times, ate_rmse_m

_TOLERANCE_NS = NS_PER_S // 100
"""Stamps further apart than 10 ms do not belong together, as in evo."""


def evaluate(estimate: Path, reference: Path) -> dict[str, float | int | str]:
    """Return the ATE of one TUM file against another, with what it rests on.

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
        "ate_rmse_m": ate_rmse_m(est.poses[est_rows, :2], ref.poses[ref_rows, :2]),
        "pairs": len(est_rows),
        "estimate_poses": len(est.stamps_ns),
        "reference_poses": len(ref.stamps_ns),
        "alignment": "SE(2), no scale",
    }


def run_evaluate(estimate: Path, reference: Path, *, as_json: bool) -> None:
    """Print the ATE as a line, or as one JSON object."""
    result = evaluate(estimate, reference)
    if as_json:
        sys.stdout.write(json.dumps(result) + "\n")
        return
    sys.stdout.write(
        f"ATE {1e3 * float(result['ate_rmse_m']):.1f} mm "
        f"(RMS, {result['alignment']}, {result['pairs']} of {result['estimate_poses']} poses)\n"
    )
