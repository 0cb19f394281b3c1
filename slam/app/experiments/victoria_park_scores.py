"""How far each path of Victoria Park is from the batch solution, and how right its ids are."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from slam.app.victoria_park import Drive
from slam.app.victoria_park_runs import ParkRun, Reference
from slam.geometry import compose
from slam.metrics import ate_rmse_m

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class PathScore:
    """One path against the batch solution.

    Attributes
    ----------
    ate_m
        Time-associated, SE(2)-aligned.
    rmse_m, max_m
        Root mean square and largest distance, both paths from the same start, not aligned.
    n_landmarks
        Landmarks in the map.
    right_share
        Share of the observations taken in whose landmark is the one that its tree is mostly
        called, and is mostly called so for its tree; None where the ids were told.
    left_out
        Observations that were in doubt and not taken in.
    seconds
        Processor time.
    """

    name: str
    ate_m: float
    rmse_m: float
    max_m: float
    n_landmarks: int | None = None
    right_share: float | None = None
    left_out: int | None = None
    seconds: float | None = None

    def numbers(self) -> dict[str, object]:
        """Return the fields for a JSON file."""
        return asdict(self)


def scores(drive: Drive, reference: Reference, runs: Mapping[str, ParkRun]) -> list[PathScore]:
    """Return the scores of odometry, of ISAM2's causal path, and of our runs."""
    rows = [
        _score("odometry", odometry_path(drive), reference),
        _score("ISAM2, true ids", reference.causal, reference),
    ]
    for name, run in runs.items():
        told = name.startswith("true ids")
        rows.append(
            _score(
                f"robust, {name}",
                run.poses,
                reference,
                n_landmarks=len(run.landmarks_m),
                right_share=None if told else right_share(run.given),
                left_out=sum(given is None for _, given in run.given),
                seconds=run.seconds,
            )
        )
    return rows


def odometry_path(drive: Drive) -> Array:
    """Return where the increments alone lead, shape (k + 1, 3)."""
    poses = [np.zeros(3)]
    for increment in drive.increments:
        poses.append(compose(poses[-1], increment))
    return np.array(poses)


def right_share(given: Sequence[tuple[int, int | None]]) -> float | None:
    """Return how many observations that were taken in have the right landmark, of all of them.

    A tree and a landmark belong together if each is mostly the other's.

    >>> right_share([(7, 0), (7, 0), (7, 1), (8, 1), (8, 1), (9, None)])
    0.8
    """
    taken = Counter(pair for pair in given if pair[1] is not None)
    if not taken:
        return None
    landmark_of: dict[int, tuple[int, int | None]] = {}
    tree_of: dict[int | None, tuple[int, int]] = {}
    for (tree, landmark), n in taken.items():
        landmark_of[tree] = max(landmark_of.get(tree, (0, None)), (n, landmark), key=_count)
        tree_of[landmark] = max(tree_of.get(landmark, (0, -1)), (n, tree), key=_count)
    right = sum(
        n
        for (tree, landmark), n in taken.items()
        if landmark_of[tree][1] == landmark and tree_of[landmark][1] == tree
    )
    return right / taken.total()


def _count(pair: tuple[int, int | None] | tuple[int, int]) -> int:
    return pair[0]


def _score(name: str, poses: Array, reference: Reference, **more: object) -> PathScore:
    away = np.hypot(*(poses - reference.poses)[:, :2].T)
    return PathScore(
        name=name,
        ate_m=ate_rmse_m(poses[:, :2], reference.poses[:, :2]),
        rmse_m=float(np.sqrt(np.mean(away**2))),
        max_m=float(away.max()),
        **more,  # type: ignore[arg-type] # the caller's keywords are the fields' own
    )
