"""A look-alike of a P440 trial: a radar that rolls before two corners, written by the format."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

CARRIER_HZ, BANDWIDTH_HZ = 3.95e9, 1.7e9
HALF_WAVE_M = 299_792_458.0 / (2 * CARRIER_HZ)
# exp(-(2 pi f s_t)**2) is 0.1 at half the bandwidth; a range is a time times c / 2.
SIGMA_M = math.sqrt(math.log(10.0)) / (math.pi * BANDWIDTH_HZ) * 299_792_458.0 / 2
BIN_M, START_M, OFFSET_M = 0.00914894, 1.0, 0.31
LEVER_M = np.array([0.05, -0.1, 0.2])
TURN = Rotation.from_euler("zyx", [0.7, 0.1, -0.2])
CORNERS_M = {"left": np.array([3.0, 1.6, 0.1]), "right": np.array([3.4, -0.9, 0.3])}
CLOCK_NS = 3_200_000_000
_SCANS, _PERIOD_NS, _POSES_HZ = 300, 20_000_000, 200


def _track(t_s: NDArray[np.floating]) -> Array:
    """Return antennas: still, then along y with a speed that swells twice, 2.4 m, then still."""
    share = np.clip((t_s - 0.5) / 5.0, 0.0, 1.0)
    swell = share - np.sin(4 * math.pi * share) / (5 * math.pi)
    return np.column_stack([0.02 * np.sin(3 * t_s), 2.4 * swell - 0.6, np.full(t_s.size, 1.5)])


def arrays_of(*, seed: int = 0, path: float = 1.0) -> dict[str, Any]:
    """Return the arrays of a trial; ``path`` below 1 is a part of the scans, from the first."""
    rng = np.random.default_rng(seed)
    t_ns = _PERIOD_NS * np.arange(round(path * _SCANS), dtype=np.int64)
    antennas_m = _track(t_ns * 1e-9)
    ranges_m = START_M - OFFSET_M + BIN_M * np.arange(600)
    samples = np.zeros((len(t_ns), ranges_m.size))
    # What is around, so that scans change with speed, not with the bearings of two corners
    others_m = rng.uniform([1.0, -4.0, 0.0], [4.5, 4.5, 2.0], (40, 3))
    echoes = [(each_m, 3e4) for each_m in CORNERS_M.values()] + [(one, 4e3) for one in others_m]
    for place_m, amplitude in echoes:
        x = ranges_m - np.linalg.norm(place_m - antennas_m, axis=1)[:, None]
        pulse = np.exp(-0.5 * (x / SIGMA_M) ** 2) * np.cos(math.tau * x / HALF_WAVE_M)
        samples += amplitude * pulse
    still = 1e5 * np.cos(0.4 * np.arange(ranges_m.size)) * np.exp(-0.02 * np.arange(ranges_m.size))
    samples += still + rng.normal(scale=500.0, size=samples.shape)
    begin_s, end_s = -0.8, t_ns[-1] * 1e-9 + 0.8
    pose_s = np.arange(begin_s, end_s, 1 / _POSES_HZ)
    markers = np.array(list(CORNERS_M.values()))
    return {
        "samples": np.round(samples).astype(np.int32),
        "t_ns": t_ns,
        "range_start_m": np.array(START_M),
        "bin_length_m": np.array(BIN_M),
        "pose_t_ns": np.round(pose_s * 1e9).astype(np.int64) + CLOCK_NS,
        "pose_m": (_track(pose_s) - TURN.apply(LEVER_M)).astype(np.float32),
        "pose_xyzw": np.tile(TURN.as_quat(), (pose_s.size, 1)).astype(np.float32),
        "reflector_marker_m": markers + np.array([-0.1, 0.02, 0.0]),
        "reflector_apex_m": markers,
        "meta": meta_of(),
    }


def meta_of(**changed: object) -> NDArray[np.str_]:
    meta = {
        "clock_offset_ns": CLOCK_NS,
        "range_offset_m": OFFSET_M,
        "lever_m": LEVER_M.tolist(),
        "reflectors": [{"name": name} for name in CORNERS_M],
        "use": use_of(4.5),
    }
    kept = {name: value for name, value in (meta | changed).items() if value is not None}
    return np.array(json.dumps(kept))


def use_of(right_m: float) -> dict[str, Any]:
    return {"least_speed_mps": 0.05, "background_box_m": [[1.5, right_m], [-2.0, 2.5]]}


def write_trial(folder: Path, name: str, arrays: Mapping[str, Any]) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"p440_rail_{name}.npz"
    np.savez_compressed(path, **arrays)
    return path
