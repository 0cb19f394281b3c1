"""Error bands of single laps: `python -m` this writes them into fixtures/baselines, then commit.

A lap is the first of a scene, through the whole echo chain. The bands span seeds 0 ... 29; the
suite runs three of them. Whole drives over a hundred seeds are `make sweep`.
"""

import tomllib
from dataclasses import dataclass, replace

import numpy as np

from hil_tests.paths import FIXTURES
from slam.app.sweep.run import SweepRun, first_laps, make_case, run_case

BANDS = FIXTURES / "baselines" / "lap_bands.toml"
N_SEEDS = 30
CASES = (("lab", "robust"), ("classroom", "robust"))
_HEAD = """\
# Errors of the first lap of a scene over seeds 0 ... 29, simulated, written by
# `python -m hil_tests.golden.lap_bands`. A change of them is a change of SLAM or of the emulated
# world: say why in CHANGELOG.md.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Band:
    """What the laps of one scene under one preset reach.

    Attributes
    ----------
    ate_median_mm, ate_most_mm
        Of the absolute trajectory error.
    landmark_rmse_most_mm
        Of the landmarks that stand for true ones.
    recall_least, precision_least
        Of the map.
    duplicates_most
        Second landmarks of one target.
    """

    scene: str
    preset: str
    ate_median_mm: float
    ate_most_mm: float
    landmark_rmse_most_mm: float
    recall_least: float
    precision_least: float
    duplicates_most: int


def run_lap(scene: str, preset: str, seed: int) -> SweepRun:
    """Run SLAM on the first lap of a scene."""
    case = make_case(scene, preset, seed)
    return run_case(replace(case, scene=first_laps(case.scene, 1)))


def stored_bands() -> tuple[Band, ...]:
    return tuple(Band(**row) for row in tomllib.loads(BANDS.read_text())["band"])


def band_of(scene: str, preset: str) -> Band:
    runs = [run_lap(scene, preset, seed) for seed in range(N_SEEDS)]
    errors_mm = [1e3 * run.ate_rmse_m for run in runs]
    maps = [run.landmarks for run in runs]
    return Band(
        scene=scene,
        preset=preset,
        ate_median_mm=round(float(np.median(errors_mm)), 3),
        ate_most_mm=round(max(errors_mm), 3),
        landmark_rmse_most_mm=round(1e3 * max(each.rmse_m or 0.0 for each in maps), 3),
        recall_least=round(min(each.recall or 0.0 for each in maps), 4),
        precision_least=round(min(each.precision or 0.0 for each in maps), 4),
        duplicates_most=max(each.duplicates for each in maps),
    )


def _as_toml(band: Band) -> str:
    rows = [f"{name} = {getattr(band, name)!r}" for name in Band.__slots__]
    return "\n[[band]]\n" + "\n".join(rows).replace("'", '"') + "\n"


if __name__ == "__main__":
    BANDS.write_text(_HEAD + "".join(_as_toml(band_of(*case)) for case in CASES))
