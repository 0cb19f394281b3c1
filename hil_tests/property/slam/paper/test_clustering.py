"""Laws of the DBSCAN outlier filter, against a DBSCAN written out from its definition."""

import math
from collections.abc import Sequence
from random import Random

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from hil_tests.property.examples import examples
from hil_tests.unit.slam.simulation import at_rest
from slam.config import (
    ClusterCount,
    ClusteringConfig,
    Emission,
    EndOfRun,
    Evidence,
    SlamConfig,
    WindowConfig,
)
from slam.frames import Detection
from slam.geometry import between, compose, paper_rig, transform
from slam.paper.clustering import NOISE, CollectedState, cluster_labels, filter_window
from slam.paper.pipeline import UwbRadarSlam
from slam.results import Fix, Observation, StepResult

Array = NDArray[np.float64]
PAPER = ClusteringConfig()

# Positions on a 1 cm lattice: distances then lie at least 1e-5 m off the 0.2 m radius or on it.
coordinates = st.integers(-60, 60).map(lambda k: k * 0.01 + 1e-4 * (k % 7))
clouds = st.integers(0, 45).flatmap(lambda n: npst.arrays(np.float64, (n, 2), elements=coordinates))


def fix_at(x_m: float, y_m: float, t_ns: int = 0) -> Fix:
    ranges = tuple(Detection(radar=k, t_ns=t_ns, range_m=1.0, amplitude=0.01) for k in (0, 1))
    return Fix(pair=0, t_ns=t_ns, x_m=x_m, y_m=y_m, detections=(ranges[0], ranges[1]))


def state(pose: Array, points: Sequence[Sequence[float]], t_ns: int = 0) -> CollectedState:
    fixes = tuple(fix_at(float(x), float(y), t_ns) for x, y in points)
    return CollectedState(t_ns=t_ns, odometry_pose=pose, detections=(), fixes=fixes)


def dbscan_by_definition(points: Array, config: ClusteringConfig) -> tuple[Array, list[set[int]]]:
    """Return which points are noise, and the partition of the core points (Ester 1996)."""
    if len(points) == 0:
        return np.zeros(0, dtype=bool), []
    offsets = points[:, None, :] - points[None, :, :]
    near = np.hypot(offsets[..., 0], offsets[..., 1]) <= config.search_radius_m
    core = near.sum(axis=1) >= config.min_observations
    noise = ~core & ~(near & core[None, :]).any(axis=1)
    _, component = connected_components(near & core[:, None] & core[None, :], directed=False)
    groups: dict[int, set[int]] = {}
    for k in np.flatnonzero(core):
        groups.setdefault(int(component[k]), set()).add(int(k))
    return noise, sorted(groups.values(), key=min)


def partition(labels: NDArray[np.int64], core: Sequence[int]) -> list[set[int]]:
    groups: dict[int, set[int]] = {}
    for k in core:
        groups.setdefault(int(labels[k]), set()).add(k)
    return sorted(groups.values(), key=min)


@settings(max_examples=examples(100, 300))
@given(clouds, st.integers(1, 10))
def test_labels_follow_the_definition_on_core_points_and_noise(points: Array, count: int) -> None:
    config = ClusteringConfig(min_observations=count)
    labels = cluster_labels(points, config)
    noise, groups = dbscan_by_definition(points, config)
    assert np.array_equal(labels == NOISE, noise)
    assert partition(labels, sorted(set().union(*groups))) == groups


@given(clouds, st.randoms(use_true_random=False))
def test_order_of_points_does_not_matter(points: Array, shuffler: Random) -> None:
    order = list(range(len(points)))
    shuffler.shuffle(order)
    noise, groups = dbscan_by_definition(points, PAPER)
    labels = np.full(len(points), NOISE)
    labels[order] = cluster_labels(points[order], PAPER)
    assert np.array_equal(labels == NOISE, noise)
    assert partition(labels, sorted(set().union(*groups))) == groups


def assert_border_points_belong_to_a_core_neighbour(points: Array, config: ClusteringConfig) -> int:
    """Return the number of border points (Ester 1996, definition 5)."""
    labels = cluster_labels(points, config)
    near = distances(points) <= config.search_radius_m
    core = near.sum(axis=1) >= config.min_observations
    border = np.flatnonzero(~core & (near & core[None, :]).any(axis=1))
    for k in border:
        assert labels[k] in labels[near[k] & core]
    return len(border)


def distances(points: Array) -> Array:
    offsets = points[:, None, :] - points[None, :, :]
    return np.hypot(offsets[..., 0], offsets[..., 1])


@settings(max_examples=examples(100, 300))
@given(clouds, st.integers(2, 10))
def test_a_border_point_is_in_the_cluster_of_a_core_neighbour(points: Array, count: int) -> None:
    assert_border_points_belong_to_a_core_neighbour(
        points, ClusteringConfig(min_observations=count)
    )


def test_border_points_of_two_clusters_are_told_apart() -> None:
    """Seven points and two ends: the seven have nine points within the radius, an end has eight."""
    heap = [(0.0, 0.0)] * 7 + [(-0.19, 0.0), (0.19, 0.0)]
    points = np.array([*heap, *((x + 2.0, y) for x, y in heap)])
    labels = cluster_labels(points, PAPER)
    assert labels.tolist() == [0] * 9 + [1] * 9
    assert assert_border_points_belong_to_a_core_neighbour(points, PAPER) == 4


@pytest.mark.parametrize("place", [0, 9, 18])
def test_a_border_point_of_two_clusters_does_not_join_them(place: int) -> None:
    """It is near one core point of each, and may be in either cluster."""
    left = [(-0.3, 0.0)] * 8 + [(-0.19, 0.0)]
    right = [(0.3, 0.0)] * 8 + [(0.19, 0.0)]
    points = np.insert(np.array([*left, *right]), place, (0.0, 0.0), axis=0)
    labels = cluster_labels(points, PAPER)
    assert np.delete(labels, place).tolist() == [0] * 9 + [1] * 9
    assert assert_border_points_belong_to_a_core_neighbour(points, PAPER) == 1


@pytest.mark.parametrize("radius_m", [1e-3, 0.2, 1e3])
def test_the_radius_is_exact_at_every_scale(radius_m: float) -> None:
    """Two heaps of five: ten points within the radius, or five."""
    config = ClusteringConfig(search_radius_m=radius_m, min_observations=9)
    for factor, label in ((1 - 1e-9, 0), (1 + 1e-9, NOISE)):
        points = np.repeat([[0.0, 0.0], [factor * radius_m, 0.0]], 5, axis=0)
        assert set(cluster_labels(points, config).tolist()) == {label}


@given(
    clouds,
    st.integers(1, 10),
    st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(-math.pi, math.pi)).map(np.array),
    st.floats(0.1, 10.0),
)
def test_motion_and_scale_change_no_label(
    points: Array, count: int, motion: Array, scale: float
) -> None:
    """Distances to each other, in radii, are all that counts."""
    radius_m = PAPER.search_radius_m + 3.47e-6  # between the distances of the lattice
    assume(np.all(np.abs(distances(points) - radius_m) > 1e-9))
    here = ClusteringConfig(min_observations=count, search_radius_m=radius_m)
    there = ClusteringConfig(min_observations=count, search_radius_m=scale * radius_m)
    labels = cluster_labels(points, here)
    moved = np.reshape(transform(motion, points), (-1, 2))
    assert np.array_equal(cluster_labels(moved, here), labels)
    assert np.array_equal(cluster_labels(scale * moved, there), labels)


@given(clouds, st.floats(0.05, 0.4), st.floats(1.0, 3.0))
def test_larger_radius_never_makes_noise_of_a_clustered_point(
    points: Array, radius_m: float, factor: float
) -> None:
    small = cluster_labels(points, ClusteringConfig(search_radius_m=radius_m))
    large = cluster_labels(points, ClusteringConfig(search_radius_m=radius_m * factor))
    assert not np.any((small != NOISE) & (large == NOISE))


@pytest.mark.parametrize(("n", "clusters"), [(8, 0), (9, 1), (10, 1)])
def test_min_observations_counts_the_point_itself(n: int, clusters: int) -> None:
    labels = cluster_labels(np.full((n, 2), 0.7), PAPER)
    assert len(set(labels.tolist()) - {NOISE}) == clusters


# --- windows --------------------------------------------------------------------------------------

poses = st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(-math.pi, math.pi)).map(np.array)


@st.composite
def windows(draw: st.DrawFn) -> list[CollectedState]:
    """Draw states along a path, each with noisy sights of two landmarks and some clutter."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    pose = draw(poses)
    landmarks = transform(pose, np.array([[0.1, 0.9], [0.4, -0.7]]))
    states = []
    for k in range(draw(st.integers(9, 15))):
        seen = [transform(invert(pose), mark) for mark in landmarks if rng.random() < 0.95]
        points = [point + 0.01 * rng.standard_normal(2) for point in seen]
        points += list(rng.uniform(-1.5, 1.5, (int(rng.poisson(0.5)), 2)))
        states.append(state(pose, points, k))  # type: ignore[arg-type]  # rows of arrays
        pose = compose(pose, np.array([0.01, 0.0, rng.uniform(-0.05, 0.05)]))
    return states


def invert(pose: Array) -> Array:
    return between(pose, np.zeros(3))


@given(windows(), poses)
def test_moving_all_poses_rigidly_moves_nothing_in_the_body_frame(
    window: list[CollectedState], world: Array
) -> None:
    moved = [
        CollectedState(
            t_ns=s.t_ns,
            odometry_pose=compose(world, s.odometry_pose),
            detections=s.detections,
            fixes=s.fixes,
        )
        for s in window
    ]
    here, there = filter_window(window, PAPER), filter_window(moved, PAPER)
    assert [o.fixes for o in here.observations] == [o.fixes for o in there.observations]
    assert here.rejected == there.rejected
    for a, b in zip(here.observations, there.observations, strict=True):
        assert math.dist((a.x_m, a.y_m), (b.x_m, b.y_m)) <= 1e-9


@given(windows())
def test_every_fix_of_the_current_pose_is_either_confirmed_or_rejected(
    window: list[CollectedState],
) -> None:
    filtered = filter_window(window, PAPER)
    used = [fix for o in filtered.observations for fix in o.fixes if fix in window[0].fixes]
    assert sorted(map(id, [*used, *filtered.rejected])) == sorted(map(id, window[0].fixes))


def test_centroid_is_in_the_frame_of_the_first_pose() -> None:
    # Nine looks at one point while driving 1 cm per state and turning 90 degrees half-way.
    path = [np.array([0.01 * k, 0.0, 0.0 if k < 5 else math.pi / 2]) for k in range(9)]
    window = [state(p, [transform(invert(p), np.array([0.3, 0.9])).tolist()]) for p in path]
    (observation,) = filter_window(window, PAPER).observations
    assert (observation.x_m, observation.y_m) == pytest.approx((0.3, 0.9), abs=1e-12)
    assert observation.range_m == pytest.approx(math.hypot(0.3, 0.9))
    assert observation.bearing_rad == pytest.approx(math.atan2(0.9, 0.3))
    assert len(observation.fixes) == observation.n_poses == 9


def still(points_per_state: Sequence[Sequence[tuple[float, float]]]) -> list[CollectedState]:
    return [state(np.zeros(3), points) for points in points_per_state]


def observations(window: list[CollectedState], **options: object) -> tuple[Observation, ...]:
    return filter_window(window, ClusteringConfig.model_validate(options)).observations


def test_cluster_without_a_fix_of_the_current_pose_waits_unless_every_cluster_is_asked_for() -> (
    None
):
    window = still([[], *([(0.0, 1.0)] for _ in range(10))])
    assert observations(window) == ()
    assert len(observations(window, emission=Emission.EVERY_CLUSTER)) == 1


def test_looks_of_one_pose_confirm_each_other_only_when_fixes_are_counted() -> None:
    window = still([[(0.0, 1.0 + 0.001 * k) for k in range(9)], []])
    assert len(observations(window, count=ClusterCount.FIXES)) == 1
    assert observations(window, count=ClusterCount.DISTINCT_POSES) == ()
    assert filter_window(window, ClusteringConfig(count=ClusterCount.DISTINCT_POSES)).rejected == (
        window[0].fixes
    )


def test_single_use_sends_the_current_look_and_centroid_the_mean() -> None:
    window = still([[(0.1, 1.0)], *([(0.0, 1.0)] for _ in range(9))])
    (centroid,) = observations(window)
    assert (centroid.x_m, centroid.y_m) == pytest.approx((0.01, 1.0))
    (single,) = observations(window, evidence=Evidence.SINGLE_USE)
    assert (single.x_m, single.y_m) == (0.1, 1.0)
    assert single.fixes == window[0].fixes
    assert len(centroid.fixes) == 10


def run_along_a_wall(config: SlamConfig, n_states: int) -> list[StepResult]:
    """Drive past one point that both left radars see the whole way."""
    rig = paper_rig()
    slam = UwbRadarSlam(config, rig)
    results: list[StepResult] = []
    for k in range(n_states + 1):
        pose = np.array([0.01 * k, 0.0, 0.0])
        seen = [
            Detection(
                radar=radar,
                t_ns=k,
                range_m=math.dist((0.1, 1.1), (0.01 * k + rig.mounts[radar].x_m, 0.2)),
                amplitude=0.01,
            )
            for radar in (0, 1)
        ]
        results += slam.step_detections(seen, at_rest(pose), k)
    return results + list(slam.flush())


@pytest.mark.parametrize("n_states", [9, 20, 40])
def test_single_use_emits_each_fix_at_most_once_and_flush_loses_no_pose(n_states: int) -> None:
    config = SlamConfig(
        window=WindowConfig(end_of_run=EndOfRun.FLUSH),
        clustering=ClusteringConfig(evidence=Evidence.SINGLE_USE),
    )
    results = run_along_a_wall(config, n_states)
    assert [result.t_ns for result in results] == list(range(1, n_states + 1))
    sent = [id(fix) for r in results for o in r.observations for fix in o.fixes]
    assert len(sent) == len(set(sent)) == n_states - 8  # the last 8 windows hold fewer than 9


def test_centroids_send_a_fix_up_to_fifteen_times() -> None:
    results = run_along_a_wall(SlamConfig(), 40)
    sent = [id(fix) for r in results for o in r.observations for fix in o.fixes]
    assert max(sent.count(fix) for fix in set(sent)) == 15


def test_as_printed_the_last_window_is_never_estimated() -> None:
    results = run_along_a_wall(SlamConfig(), 40)
    assert [result.t_ns for result in results] == list(range(1, 27))
