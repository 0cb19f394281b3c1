"""Factor graphs survive writing and reading, and runs become graphs with the same numbers."""

import math
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil_tests.unit.slam.app.experiments.benchmarks import worlds
from slam.app.experiments.benchmarks import mrclam, pyfg
from slam.app.experiments.benchmarks.pyfg import Edge, FactorGraph, Landmark, Pose

NUMBERS = st.floats(allow_nan=False, allow_infinity=False, width=64)
STAMPS = st.integers(-(2**62), 2**62)
SIZES = {"EDGE_SE2": 3, "EDGE_SE2_XY": 2, "EDGE_RANGE": 1}


@st.composite
def covariances(draw: st.DrawFn, size: int) -> tuple[float, ...]:
    """Draw the triangle of a matrix whose diagonal outweighs the rest: it is positive."""
    small = st.floats(-1.0, 1.0)
    matrix = np.zeros((size, size))
    matrix[np.triu_indices(size)] = draw(st.tuples(*[small] * (size * (size + 1) // 2)))
    matrix += np.diag(4.0 + np.abs(matrix).sum(axis=1))
    return tuple(matrix[np.triu_indices(size)].tolist())


@st.composite
def graphs(draw: st.DrawFn) -> FactorGraph:
    pose_names = [f"A{n}" for n in range(draw(st.integers(1, 5)))]
    landmark_names = [f"L{n}" for n in range(draw(st.integers(1, 4)))]
    edges = {}
    for kind, size in SIZES.items():
        if not draw(st.booleans()):
            continue
        seconds = st.sampled_from(pose_names if kind == "EDGE_SE2" else landmark_names)
        edge = st.builds(
            Edge,
            t_ns=STAMPS,
            first=st.sampled_from(pose_names),
            second=seconds,
            values=st.tuples(*[NUMBERS] * size),
            covariance=covariances(size),
        )
        edges[kind] = tuple(draw(st.lists(edge, min_size=1, max_size=4)))
    return FactorGraph(
        poses=tuple(
            Pose(
                t_ns=draw(STAMPS),
                name=name,
                x_m=draw(NUMBERS),
                y_m=draw(NUMBERS),
                heading_rad=draw(NUMBERS),
            )
            for name in pose_names
        ),
        landmarks=tuple(
            Landmark(name=name, x_m=draw(NUMBERS), y_m=draw(NUMBERS)) for name in landmark_names
        ),
        edges=edges,
    )


@settings(max_examples=50)
@given(graphs())
def test_a_graph_written_and_read_is_the_same_to_the_last_bit(graph: FactorGraph) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "graph.pyfg"
        pyfg.write_pyfg(path, graph)
        read = pyfg.read_pyfg(path)
        assert repr(read) == repr(graph)  # also the sign of zero
        again = Path(folder) / "again.pyfg"
        pyfg.write_pyfg(again, read)
        assert again.read_bytes() == path.read_bytes()


@pytest.mark.parametrize("triangle", [(2.0,), (1.0, 0.5, 3.0), (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)])
def test_triangles_are_read_row_by_row(triangle: tuple[float, ...]) -> None:
    matrix = pyfg.matrix_of(triangle)
    np.testing.assert_array_equal(matrix, matrix.T)
    assert matrix[np.triu_indices(len(matrix))].tolist() == list(triangle)


def test_a_run_with_ranges_is_the_same_run_as_a_graph(tmp_path: Path) -> None:
    worlds.write_pyfg_file(tmp_path / "small.pyfg", duration_s=5.0)
    data = pyfg.read_data_set(tmp_path)
    graph = pyfg.graph_of(data.runs[0], data.sensor)
    back = pyfg.run_of(tmp_path / "small.pyfg", graph)
    assert back.beacons_m == data.runs[0].beacons_m
    for new, old in zip(back.steps, data.runs[0].steps, strict=True):
        assert new.t_ns == old.t_ns
        np.testing.assert_array_equal(new.increment, old.increment)
        assert [(one.label, one.range_m) for one in new.observations] == [
            (one.label, one.range_m) for one in old.observations
        ]
    np.testing.assert_array_equal(back.truth.xy_m, data.runs[0].truth.xy_m)


def test_range_and_bearing_become_a_place_with_the_same_noise_and_back(tmp_path: Path) -> None:
    data = mrclam.read_data_set(worlds.write_mrclam(tmp_path, duration_s=10.0))
    run = data.runs[0]
    path = tmp_path / "graph.pyfg"
    pyfg.write_pyfg(path, pyfg.graph_of(run, data.sensor))
    back = pyfg.run_of(path, pyfg.read_pyfg(path))
    assert back.n_observations == run.n_observations > 10
    for new, old in zip(back.steps, run.steps, strict=True):
        for one, other in zip(new.observations, old.observations, strict=True):
            assert one.label == other.label
            assert one.range_m == pytest.approx(other.range_m, rel=1e-12)
            assert one.bearing_rad == pytest.approx(other.bearing_rad, abs=1e-12)
            assert one.range_sigma_m == pytest.approx(other.range_sigma_m, rel=1e-9)
            assert one.bearing_sigma_rad == pytest.approx(other.bearing_sigma_rad, rel=1e-9)
            assert math.isfinite(one.range_m)
