"""Text files of GTSAM: a drive as a graph of poses and landmarks, without times.

One item per line; ids are whole numbers that poses and landmarks share::

    ODOMETRY  pose  next pose  dx  dy [m]  turn [rad]   covariance (6)
    LANDMARK  pose  landmark   x   y [m]                covariance (3)

Each ODOMETRY goes on from the pose where the last one ended. The covariances are not used. Format:
`victoria_park.txt` among the examples of GTSAM.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path as FilePath

import numpy as np

from slam.app.errors import AppError
from slam.app.experiments.benchmarks.tables import REMEDY, Array, bad_line, number_of, rows_of

_ID = re.compile(r"[0-9]{1,18}")
_NUMBERS = {"ODOMETRY": 9, "LANDMARK": 5}
_WHAT = "a graph in lines ODOMETRY and LANDMARK"


@dataclass(frozen=True, slots=True, kw_only=True)
class Sighting:
    """A landmark seen from a pose, in the body frame."""

    pose: int  # along the drive, from 0
    landmark: int
    x_m: float
    y_m: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drive:
    """Motions (n, 3), dx, dy [m] and turn [rad] in the body frame before each, and sightings."""

    increments: Array
    sightings: tuple[Sighting, ...]


def read_gtsam(path: FilePath) -> Drive:
    """Read a drive.

    Raises AppError that names a line of another form, or one that does not continue the chain of
    poses.
    """
    increments: list[tuple[float, ...]] = []
    sightings: list[Sighting] = []
    place_of: dict[int, int] = {}
    last = -1
    for number, (kind, *words) in rows_of(path, _WHAT):
        if kind not in _NUMBERS:
            raise bad_line(path, number, f"{kind[:40]} is not one of {', '.join(_NUMBERS)}")
        try:
            first, second = (_id(word) for word in (*words[:2], *[""] * (2 - len(words))))
            if len(words) - 2 != _NUMBERS[kind]:
                raise ValueError(
                    f"{len(words) - 2} numbers behind the ids, {kind} has {_NUMBERS[kind]}"
                )
            numbers = [number_of(word) for word in words[2:]]
            if kind == "LANDMARK":
                if first not in place_of:
                    raise ValueError(f"no ODOMETRY before it leads to pose {first}")
                x_m, y_m, *_ = numbers
                if x_m == 0.0 and y_m == 0.0:
                    raise ValueError(f"pose {first} sees landmark {second} where it is itself")
                sightings.append(Sighting(pose=place_of[first], landmark=second, x_m=x_m, y_m=y_m))
                continue
            if not place_of:
                place_of[first] = 0
            elif first != last:
                raise ValueError(f"it begins at pose {first}, the last one ended at {last}")
            if second in place_of:
                raise ValueError(f"pose {second} has been there before")
            place_of[second], last = len(place_of), second
            increments.append(tuple(numbers[:3]))
        except ValueError as error:
            raise bad_line(path, number, error) from None
    if not increments:
        raise AppError(f"{path}: holds no ODOMETRY; it must be {_WHAT}; {REMEDY}")
    return Drive(increments=np.array(increments), sightings=tuple(sightings))


def _id(word: str) -> int:
    if not _ID.fullmatch(word):
        raise ValueError(f'"{word[:40]}" is no id: a whole number')
    return int(word)
