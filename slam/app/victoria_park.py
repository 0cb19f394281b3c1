"""Victoria Park: a real car among trees, as GTSAM ships it, with the landmarks' ids.

The file has one line per odometry step and one per tree seen::

    ODOMETRY before after dx dy turn  C11 C12 C13 C22 C23 C33
    LANDMARK pose landmark x y        C11 C12 C22

in metres and radians, body frame of the earlier pose, with covariances (upper triangles). Poses
and landmarks share one sequence of ids, so poses are numbered anew here. There is no ground
truth. Source: the data of Guivant and Nebot, University of Sydney, in iSAM's format.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slam.app.errors import AppError
from slam.app.gtsam_door import load_gtsam
from slam.robust.points import RangeBearing

Array = NDArray[np.float64]

FILE = "victoria_park.txt"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drive:
    """Odometry and landmarks seen.

    Attributes
    ----------
    increments, covariances
        shapes (k, 3) and (k, 3, 3): dx, dy [m], turn [rad] in the body frame before the step.
    seen
        One entry per pose, k + 1 of them: the points seen from there, labelled with their ids.
    """

    increments: Array
    covariances: Array
    seen: tuple[tuple[RangeBearing, ...], ...]

    @property
    def n_observations(self) -> int:
        """Return how often a landmark was seen."""
        return sum(len(points) for points in self.seen)

    @property
    def labels(self) -> frozenset[int]:
        """Return the ids of all landmarks."""
        return frozenset(
            point.label for points in self.seen for point in points if point.label is not None
        )

    def first(self, n_steps: int) -> Drive:
        """Return the drive up to a pose."""
        return Drive(
            increments=self.increments[:n_steps],
            covariances=self.covariances[:n_steps],
            seen=self.seen[: n_steps + 1],
        )


def shipped_file() -> Path:
    """Return where GTSAM keeps the data.

    Raises
    ------
    AppError
        GTSAM is not installed, or its wheel has no such file.
    """
    path = Path(load_gtsam("Victoria Park").__file__).parent / "Data" / FILE
    if not path.is_file():
        raise AppError(
            f"{path.name}: this installation of GTSAM has no such data; "
            "pip install 'gtsam>=4.3,<4.4' has"
        )
    return path


def read_drive(path: Path) -> Drive:
    """Read the file.

    Raises
    ------
    AppError
        It cannot be read, or a line is not as the module's text says; file and line are named.
    """
    increments: list[list[float]] = []
    covariances: list[Array] = []
    seen: list[list[RangeBearing]] = [[]]
    pose_of: dict[int, int] = {}
    try:
        lines = path.read_text(encoding="ascii").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise AppError(f"{path}: cannot be read: {error}") from None
    for number, line in enumerate(lines, start=1):
        try:
            kind, first, second, *rest = line.split()
            before, after, values = int(first), int(second), [float(word) for word in rest]
            if not all(math.isfinite(value) for value in values):
                raise ValueError
            if kind == "ODOMETRY":
                pose_of.setdefault(before, len(seen) - 1)
                if pose_of[before] != len(seen) - 1:
                    raise ValueError
                dx, dy, turn, c11, c12, c13, c22, c23, c33 = values
                increments.append([dx, dy, turn])
                covariances.append(np.array([[c11, c12, c13], [c12, c22, c23], [c13, c23, c33]]))
                pose_of[after] = len(seen)
                seen.append([])
            elif kind == "LANDMARK":
                x, y, c11, c12, c22 = values
                covariance = np.array([[c11, c12], [c12, c22]])
                seen[pose_of[before]].append(range_bearing(x, y, covariance, label=after))
            else:
                raise ValueError
        except (ValueError, KeyError):
            raise AppError(f"{path}, line {number}: no line of a Victoria Park file") from None
    return Drive(
        increments=np.array(increments).reshape(-1, 3),
        covariances=np.array(covariances).reshape(-1, 3, 3),
        seen=tuple(tuple(points) for points in seen),
    )


def range_bearing(x_m: float, y_m: float, covariance: Array, label: int | None) -> RangeBearing:
    """Return a relative position as range and bearing, its covariance to first order.

    With r = |(x, y)| and G = d(r, bearing) / d(x, y) = [[x/r, y/r], [-y/r^2, x/r^2]] the
    covariance is G C G^T.

    Raises
    ------
    ValueError
        The point is at the origin, where it has no bearing.
    """
    r = math.hypot(x_m, y_m)
    if r == 0.0:
        raise ValueError("a point at the origin has no bearing")
    G = np.array([[x_m / r, y_m / r], [-y_m / r**2, x_m / r**2]])
    return RangeBearing(
        range_m=r,
        bearing_rad=math.atan2(y_m, x_m),
        covariance=G @ covariance @ G.T,
        label=label,
    )
