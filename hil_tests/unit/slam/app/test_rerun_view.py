"""The Rerun file: every row is there, y is negated once, the blueprint is embedded."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.chunk import RrdReader

from hil_tests.unit.slam.app.sessions import feed, scan, session_info, snapshot
from slam.app.errors import AppError
from slam.app.rerun_view import RerunView, count_rows

N_SCANS = 150  # more than a block, and not a multiple of it


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("view") / "session.rrd"
    view = RerunView(path, session_info(), simulated=True)
    feed(view, N_SCANS)
    view.close()
    return path


def rows(path: Path, entity: str, component: str) -> Iterator[tuple[int | None, Any]]:
    """Yield (frame counter, value) of one component of one entity."""
    for chunk in RrdReader(path).stream():
        if str(chunk.entity_path) != entity:
            continue
        batch = chunk.to_record_batch()
        frames = batch["frame"].to_pylist() if "frame" in batch.schema.names else None
        if component in batch.schema.names:
            for index, value in enumerate(batch[component].to_pylist()):
                yield (None if frames is None else frames[index]), value


def test_every_frame_is_a_bar_chart_with_its_counter_and_samples(finished: Path) -> None:
    charts = dict(rows(finished, "/radar/radar1/frame", "BarChart:values"))
    assert sorted(charts) == list(range(N_SCANS))  # type: ignore[type-var]  # no None here
    for counter in (0, 127, 128, N_SCANS - 1):
        (tensor,) = charts[counter]
        assert tensor["shape"] == [1431]
        np.testing.assert_array_equal(
            np.array(tensor["buffer"], dtype=np.float32), scan(counter).frames[1].samples
        )


def test_a_bscan_picture_per_block(finished: Path) -> None:
    pictures = list(rows(finished, "/radar/radar0/bscan", "Tensor:data"))
    assert [frame for frame, _ in pictures] == [0, 128]
    shapes = [picture[0]["shape"] for _, picture in pictures]
    assert [shape[0] for shape in shapes] == [128, N_SCANS - 128]


def test_y_points_down_on_the_screen(finished: Path) -> None:
    frame, points = next(rows(finished, "/map/landmarks/estimated", "Points2D:positions"))
    assert frame == 0
    np.testing.assert_allclose(points, snapshot(0).landmarks_m * [1, -1], rtol=1e-6)
    _, (arrow,) = next(rows(finished, "/map/estimate/robot", "Arrows2D:vectors"))
    # heading 0.4 rad to the left is upwards for us, so negative for Rerun
    np.testing.assert_allclose(arrow, [0.25 * np.cos(0.4), -0.25 * np.sin(0.4)], rtol=1e-5)


def test_ellipses_are_rotated_polygons(finished: Path) -> None:
    _, strips = next(rows(finished, "/map/landmarks/ellipses", "LineStrips2D:strips"))
    assert [len(strip) for strip in strips] == [33, 33]
    tilted = np.array(strips[1]) - snapshot(0).landmarks_m[1] * [1, -1]
    # covariance [[2, 1], [1, 2]]: long axis at +45 degrees, so at -45 on a screen
    longest = tilted[np.argmax(np.linalg.norm(tilted, axis=1))]
    assert longest[0] * longest[1] < 0


def test_scalars_and_log(finished: Path) -> None:
    counted = count_rows(finished)
    assert counted["/error/pose_m"] == counted["/landmarks/count"] == N_SCANS
    assert counted["/consistency/nis_per_dof"] == N_SCANS // 2
    assert counted["/link/radar0"] == counted["/link/radar1"] == 1
    (_, error), *_ = rows(finished, "/error/pose_m", "Scalars:scalars")
    assert error == [pytest.approx(0.01)]


def test_a_blueprint_is_embedded(finished: Path) -> None:
    assert len(RrdReader(finished).blueprints()) == 1
    (recording,) = RrdReader(finished).recordings()
    assert recording.recording_id == "made_up-paper-7"


def test_wall_clock_is_nowhere_in_the_data(finished: Path) -> None:
    timelines = {
        name
        for chunk in RrdReader(finished).stream()
        for name in chunk.to_record_batch().schema.names
        if name in {"log_time", "log_tick"}
    }
    assert timelines == set()


def test_missing_rows_are_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    view = RerunView(tmp_path / "s.rrd", session_info(), simulated=True)
    feed(view, 3)
    monkeypatch.setattr("slam.app.rerun_view.count_rows", lambda path: {})
    with pytest.raises(AppError, match=r"s\.rrd: holds 0 of 3 rows"):
        view.close()
