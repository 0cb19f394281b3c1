"""One map of two: where the second lies on the first, and all that both know together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from slam.geometry import Mount, Rig
from slam.results import OF_MOUNT, SavedMap
from slam.robust.back_end import RobustBackEnd
from slam.robust.parameters import MARGIN_NATS, BackEndParameters, BranchRule
from slam.robust.proposals.constellation import (
    Constellation,
    Placement,
    find_placements,
    stands_out,
)

_MOST = 30  # landmarks of the second map that are searched for: those that were hit most often
_FREE_M, _FREE_RAD = 1.0, 1.0  # far more than is left to know of where the maps lie on each other


def find_place(first: SavedMap, second: SavedMap, rule: BranchRule) -> Placement:
    """Return the motion that lays the second map on the first; pairs are ids of landmarks.

    It must stand out as a place must on which a carried robot is set down (`slam.robust.branches`).
    Raises ValueError, with numbers, if it does not.
    """
    often = sorted(range(len(second.landmarks)), key=lambda row: -second.landmarks[row].hits)
    here = _constellation(second, sorted(often[:_MOST]), rule)
    there = _constellation(first, range(len(first.landmarks)), rule)
    found = find_placements(here, there, rule)
    least = rule.likeness_nats + MARGIN_NATS
    ways = [f"{len(one.pairs)} landmarks with {one.evidence:.1f} nats" for one in found]
    of = f"of {len(first.landmarks)} and {len(second.landmarks)} landmarks"
    if not found:
        raise ValueError(f"{of} no {rule.least_landmarks} lie on each other")
    if len(found) > 1 or found[0].evidence < least:
        raise ValueError(
            f"{of} these lie on each other: {', or '.join(ways)}; one way must have {least:.1f} "
            f"nats, and {rule.placement_nats:g} more than any other"
        )
    nats = np.zeros(len(first.landmarks))
    nats[[row for row, _ in found[0].pairs]] = rule.most_for
    if not stands_out(nats, there, rule, lambda one: one.evidence > rule.likeness_nats):
        raise ValueError(f"{of} {ways[0]} lie on each other, and would on others of the first, too")
    pairs = tuple((there.ids[row], here.ids[at]) for row, at in found[0].pairs)
    return replace(found[0], pairs=pairs)


def _constellation(saved: SavedMap, rows: Sequence[int], rule: BranchRule) -> Constellation:
    at = np.array(rows, dtype=np.intp)
    columns = np.stack([2 * at, 2 * at + 1], axis=-1).ravel()
    covariance = saved.landmarks_covariance()[np.ix_(columns, columns)]
    return Constellation(
        ids=tuple(saved.landmarks[row].id for row in rows),
        points_m=saved.landmarks_m[at],
        covariance_m2=covariance + rule.model_sigma_m**2 * np.eye(len(columns)),
    )


def join(first: SavedMap, second: SavedMap, place: Placement) -> SavedMap:
    """Return the map of both, in the frame of the first, by `find_place` of them.

    What both have is fused by information; the errors of the maps are taken to be independent, also
    where the same radars made both.
    """
    rig = Rig(
        mounts=tuple(
            Mount(**{key: getattr(radar, key) for key in OF_MOUNT}) for radar in first.radars
        )
    )
    names = " ".join(first.unknowns)
    parameters = BackEndParameters()
    ranges = replace(
        parameters.ranges,
        radius_sigma_m=_FREE_M if "radius" in names else 0.0,
        mount_sigma_m=_FREE_M if "moved_x" in names else 0.0,
    )
    start = place.motion, np.array([_FREE_M, _FREE_M, _FREE_RAD])
    back_end = RobustBackEnd(rig, replace(parameters, ranges=ranges), first, start)
    back_end.join(second, place.pairs)
    return replace(back_end.map_now(), start=first.start)
