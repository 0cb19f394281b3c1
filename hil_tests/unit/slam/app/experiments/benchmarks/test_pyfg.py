"""What is read from the text of a factor graph."""

import math
from pathlib import Path

import numpy as np
import pytest

from slam.app.experiments.benchmarks import pyfg
from slam.app.experiments.benchmarks.data_set import Observation

# The covariance of L7 is 0.04 along the line of sight, (3, 4), and 0.25 across
GRAPH = """\
VERTEX_SE2 10.000000001 A0 1.0 2.0 0.5
VERTEX_SE2 10.5 A1 1.5 2.0 0.5
VERTEX_SE2 -0.25 A9 0.5 2.0 0.5
VERTEX_XY L3 4.0 6.0
VERTEX_XY L7 -1.0 1e1
EDGE_SE2 9.0 A9 A0 0.5 -0.0 0.125 1.0 0.0 0.0 1.0 0.0 1.0
EDGE_SE2 9.0 A0 A1 0.25 0.1 -0.5 1.0 0.5 0.0 1.0 0.0 1.0
EDGE_RANGE 10.4 A1 L3 4.5 0.09
EDGE_SE2_XY 10.4 A1 L7 3.0 4.0 0.1744 -0.1008 0.1156
"""


def test_a_graph_is_a_drive_along_its_odometry(tmp_path: Path) -> None:
    (tmp_path / "small.pyfg").write_text(GRAPH, encoding="ascii")
    (run,) = pyfg.read_data_set(tmp_path).runs
    assert run.name == "small"
    assert run.t_ns.tolist() == [-250_000_000, 10_000_000_001, 10_500_000_000]
    assert run.truth.t_ns.tolist() == run.t_ns.tolist()
    assert run.truth.xy_m.tolist() == [[0.5, 2.0], [1.0, 2.0], [1.5, 2.0]]
    increments = [[0.0, 0.0, 0.0], [0.5, -0.0, 0.125], [0.25, 0.1, -0.5]]
    assert [step.increment.tolist() for step in run.steps] == increments
    before, between, (range_only, place) = (step.observations for step in run.steps)
    assert (before, between) == ((), ())
    assert range_only == Observation(range_m=4.5, range_sigma_m=0.3, label=3)
    assert (place.range_m, place.label) == (5.0, 7)
    assert place.bearing_rad == pytest.approx(math.atan2(4.0, 3.0))
    assert place.range_sigma_m == pytest.approx(0.2)
    assert place.bearing_sigma_rad == pytest.approx(0.1)


@pytest.mark.parametrize("triangle", [(2.0,), (1.0, 0.5, 3.0), (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)])
def test_triangles_are_read_row_by_row(triangle: tuple[float, ...]) -> None:
    matrix = pyfg.matrix_of(triangle)
    np.testing.assert_array_equal(matrix, matrix.T)
    assert matrix[np.triu_indices(len(matrix))].tolist() == list(triangle)
