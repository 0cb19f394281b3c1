"""Outlier filter of the paper: DBSCAN over the fixes of a window of poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from slam.config import ClusterCount, ClusteringConfig, Emission, Evidence
from slam.frames import Detection
from slam.geometry import between, transform
from slam.results import Fix, Observation

Array = NDArray[np.float64]

NOISE = -1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CollectedState:
    """One entry of Odom[] and Obs[] of Algorithm 1."""

    t_ns: int  # session time
    odometry_pose: Array  # shape (3,), [x m, y m, heading rad], odometry frame
    detections: tuple[Detection, ...]  # ranges of all radars at this pose
    fixes: tuple[Fix, ...]  # trilaterated points, body frame of this pose


@dataclass(frozen=True, slots=True, kw_only=True)
class FilteredWindow:
    """What DBSCAN makes of one window."""

    observations: tuple[Observation, ...]  # one per emitted cluster, by first appearance
    rejected: tuple[Fix, ...]  # fixes of the window's first pose that belong to no cluster


def cluster_labels(points: Array, config: ClusteringConfig) -> NDArray[np.int64]:
    """Return the DBSCAN cluster of each point, shape (n,), by first appearance; -1 is noise.

    ``min_observations`` points within ``search_radius_m``, the point itself among them, make a core
    point (scikit-learn's convention). ``points`` has shape (n, 2) [m]; memory grows with n^2.
    """
    # Here, since it takes a second, for which every command would wait.
    from sklearn import config_context
    from sklearn.cluster import DBSCAN

    if len(points) < config.min_observations:
        return np.full(len(points), NOISE, dtype=np.int64)
    # Distances of tens of points are quicker computed here than by a tree, and without the thread
    # pool that the library's own brute force starts for every window.
    model = DBSCAN(
        eps=config.search_radius_m, min_samples=config.min_observations, metric="precomputed"
    )
    # The parameters were checked once, with the configuration.
    with config_context(skip_parameter_validation=True, assume_finite=True):
        labels: NDArray[np.int64] = model.fit(cdist(points, points)).labels_.astype(np.int64)
    return labels


def filter_window(window: Sequence[CollectedState], config: ClusteringConfig) -> FilteredWindow:
    """Return the observations of the window's first pose, confirmed by the poses after it.

    All fixes are clustered in the body frame of the first pose, to which odometry brings them. A
    cluster that holds a fix of that pose becomes one observation. ``window`` is in time order.
    """
    fixes = [fix for state in window for fix in state.fixes]
    state_of_fix = np.repeat(np.arange(len(window)), [len(state.fixes) for state in window])
    origin = window[0].odometry_pose
    parts = [
        transform(
            between(origin, state.odometry_pose),
            np.array([(fix.x_m, fix.y_m) for fix in state.fixes]),
        )
        for state in window
        if state.fixes
    ]
    points = np.concatenate(parts) if parts else np.empty((0, 2))
    labels = cluster_labels(points, config)

    observations = []
    confirmed = np.zeros(len(fixes), dtype=bool)
    for label in range(labels.max(initial=NOISE) + 1):
        members = labels == label
        n_poses = len(np.unique(state_of_fix[members]))
        if config.count is ClusterCount.DISTINCT_POSES and n_poses < config.min_observations:
            continue
        confirmed |= members
        current = members & (state_of_fix == 0)
        if config.emission is Emission.HOLDING_CURRENT_POSE and not current.any():
            continue
        used = current if config.evidence is Evidence.SINGLE_USE else members
        if not used.any():
            continue
        x_m, y_m = points[used].mean(axis=0).tolist()
        observations.append(
            Observation(
                x_m=x_m,
                y_m=y_m,
                n_poses=n_poses,
                fixes=tuple(fixes[i] for i in np.flatnonzero(used)),
            )
        )
    n_current = len(window[0].fixes)
    return FilteredWindow(
        observations=tuple(observations),
        rejected=tuple(fixes[i] for i in np.flatnonzero(~confirmed[:n_current])),
    )
