"""Views in Rerun: pictures, tables and recordings of sessions."""

import io
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from rerun.chunk import RrdReader

from hil_tests.unit.slam.app.sessions import feed, scan, session_info, smoothed_run, snapshot
from slam.app.rig.echo_arcs import bscan_picture, wedge
from slam.app.view.rerun_recording import count_rows
from slam.app.view.session_view import RerunView
from slam.frames import Detection
from slam.geometry import compose, transform
from slam.imaging.back_projection import Grid
from slam.live.errors import AppError
from slam.live.session_records import LogLine, RadarImage, Scan, SessionInfo, Snapshot
from slam.paper.ekf import start
from slam.results import Fix, Observation, StepResult, UpdateReport

N_SCANS = 150  # more than a block, and not a multiple of it


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("view") / "session.rrd"
    with RerunView(path, session_info()) as view:
        feed(view, N_SCANS)
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


def stamps(path: Path, entity: str, timeline: str) -> list[int]:
    """Return an entity's stamps [ns] on a timeline; of `host_time` since 1970."""
    return [
        stamp.value
        for chunk in RrdReader(path).stream()
        if str(chunk.entity_path) == entity
        for batch in [chunk.to_record_batch()]
        if timeline in batch.schema.names
        for stamp in batch[timeline]
    ]


def drawn(
    path: Path,
    *events: Scan | Snapshot | LogLine,
    info: SessionInfo | None = None,
    time_of_day_ns: Callable[[], int] | None = None,
) -> Path:
    with RerunView(path / "s.rrd", info or session_info(), time_of_day_ns=time_of_day_ns) as view:
        for event in events:
            match event:
                case Scan():
                    view.on_scan(event)
                case Snapshot():
                    view.on_snapshot(event)
                case LogLine():
                    view.on_log(event)
    return path / "s.rrd"


def test_every_frame_is_a_bar_chart_with_its_counter_and_samples(finished: Path) -> None:
    charts = dict(rows(finished, "/radar/radar1/frame", "BarChart:values"))
    assert sorted(charts) == list(range(N_SCANS))  # type: ignore[type-var]  # no None here
    for counter in (0, 127, 128, N_SCANS - 1):
        (tensor,) = charts[counter]
        frame = scan(counter).frames[1]
        n_shown = int((3.0 - frame.range_start_m) / frame.bin_length_m)  # up to 3 m
        assert tensor["shape"] == [n_shown]
        np.testing.assert_array_equal(
            np.array(tensor["buffer"], dtype=np.float32), frame.samples[:n_shown]
        )


def test_a_bscan_picture_per_block(finished: Path) -> None:
    pictures = list(rows(finished, "/radar/radar0/bscan", "Tensor:data"))
    assert [frame for frame, _ in pictures] == [0, 128]
    shapes = [picture[0]["shape"] for _, picture in pictures]
    assert [shape[0] for shape in shapes] == [128, 128]  # the last one holds the newest frames


def test_y_points_down_on_the_screen(finished: Path) -> None:
    frame, points = next(rows(finished, "/map/landmarks/estimated", "Points2D:positions"))
    assert frame == 0
    np.testing.assert_allclose(points, snapshot(0).landmarks_m * [1, -1], rtol=1e-6)
    _, (turn,) = next(rows(finished, "/map/robot", "Transform3D:quaternion"))
    # heading 0.4 rad to the left is upwards for us, so a turn to the right for Rerun
    np.testing.assert_allclose(turn, [0.0, 0.0, -np.sin(0.2), np.cos(0.2)], atol=1e-6)
    _, (place,) = next(rows(finished, "/map/robot", "Transform3D:translation"))
    np.testing.assert_allclose(place, [0.0, -0.01, 0.0], atol=1e-6)


def test_ellipses_are_rotated_polygons(finished: Path) -> None:
    _, strips = next(rows(finished, "/map/landmarks/ellipses", "LineStrips2D:strips"))
    assert [len(strip) for strip in strips] == [33, 33]
    tilted = np.array(strips[1]) - snapshot(0).landmarks_m[1] * [1, -1]
    # covariance [[2, 1], [1, 2]]: long axis at +45 degrees, so at -45 on a screen
    longest = tilted[np.argmax(np.linalg.norm(tilted, axis=1))]
    assert longest[0] * longest[1] < 0


def test_the_walls_of_a_map_are_lines(tmp_path: Path) -> None:
    spans = np.array([[[0.0, 1.0], [2.0, 1.5]], [[np.nan, 0.0], [1.0, 0.0]]])
    path = drawn(tmp_path, replace(snapshot(0), wall_spans_m=spans))
    _, (strip,) = next(rows(path, "/map/landmarks/walls", "LineStrips2D:strips"))
    np.testing.assert_allclose(strip, [[0.0, -1.0], [2.0, -1.5]], rtol=1e-6)


def test_ellipses_are_enlarged_as_the_map_says(tmp_path: Path) -> None:
    small = np.array([np.diag([4e-6, 1e-6])] * 2)
    state = replace(snapshot(0), landmark_covariances_m2=small, pose_covariance=1e-6 * np.eye(3))
    path = drawn(tmp_path, state)
    (text,) = next(rows(path, "/map/landmarks/legend", "Points2D:labels"))[1]
    times = float(text.removeprefix("95 % ellipse, enlarged ").removesuffix(" x"))
    assert times > 1
    _, strips = next(rows(path, "/map/landmarks/ellipses", "LineStrips2D:strips"))
    half_axes = np.ptp(np.array(strips[0]), axis=0) / 2
    # deviations of 2 and 1 mm, and the quantile of chi2(2) in closed form
    expected = times * np.sqrt(-2.0 * np.log(0.05)) * np.array([0.002, 0.001])
    np.testing.assert_allclose(half_axes, expected, rtol=1e-4)
    _, ((pose),) = next(rows(path, "/map/estimate/ellipse", "LineStrips2D:strips"))
    np.testing.assert_allclose(np.ptp(np.array(pose), axis=0) / 2, expected[1], rtol=1e-4)


def test_scalars_and_log(finished: Path) -> None:
    counted = count_rows(finished)
    assert counted["/error/slam"] == counted["/landmarks/count"] == N_SCANS
    assert counted["/consistency/nis/value"] == N_SCANS // 2
    assert counted["/link/log/radar0"] == counted["/link/log/radar1"] == 1
    errors = dict(rows(finished, "/error/slam", "Scalars:scalars"))
    assert errors[0] == [pytest.approx(0.01)]
    odometry = dict(rows(finished, "/error/odometry", "Scalars:scalars"))
    assert odometry[0] == [pytest.approx(0.01)]  # it begins elsewhere, so is placed at SLAM's start


def band(path: Path, entity: str) -> np.ndarray:
    """Return the edges of the first band that Rerun shades: one deviation around the value."""
    ((value,),) = [v for _, v in rows(path, entity, "Measurements:values") if v][:1]
    ((variance,),) = [v for _, v in rows(path, entity, "Measurements:variances") if v][:1]
    return np.array([value - np.sqrt(variance), value + np.sqrt(variance)])


def test_nees_has_its_band(finished: Path) -> None:
    values = dict(rows(finished, "/consistency/nees/value", "Scalars:scalars"))
    # 0.01 m in y with a deviation of 0.01 m, 0.3 rad with one of sqrt(1e-5): 1 + 9000 over 3
    assert values[0] == [pytest.approx((1.0 + 0.3**2 / 1e-5) / 3.0)]
    # tables of chi2(3)
    np.testing.assert_allclose(
        band(finished, "/consistency/nees/band"), [0.0719, 3.1161], atol=1e-4
    )
    counted = count_rows(finished)
    assert counted["/consistency/nees/band"] == counted["/consistency/nees/value"] == N_SCANS


def test_nis_has_the_band_of_its_degrees_of_freedom(tmp_path: Path) -> None:
    path = drawn(tmp_path, replace(snapshot(1), step=step(robust=True)))
    # tables of chi2(1)
    np.testing.assert_allclose(band(path, "/consistency/nis/band"), [0.00098, 5.0239], atol=1e-4)


def test_the_error_is_shown_with_what_slam_believes_of_it(finished: Path) -> None:
    # both deviations are 0.01 m: 95 % of a planar Gaussian are within sqrt(-2 ln 0.05) of them
    expected = [0.0, 0.01 * np.sqrt(-2.0 * np.log(0.05))]
    np.testing.assert_allclose(band(finished, "/error/believed"), expected, atol=1e-9)
    # Rerun's axis leaves out what is only shaded, so that the band needs a line on its edge
    edges = dict(rows(finished, "/error/believed/edge", "Scalars:scalars"))
    assert len(edges) == N_SCANS
    assert edges[0] == [pytest.approx(expected[1])]


def test_a_fault_is_a_marker_and_a_state_of_its_lane(finished: Path) -> None:
    marks = [mark for _, mark in rows(finished, "/link/faults/radar1", "Scalars:scalars") if mark]
    assert marks == [[1.0]]
    states = [s[0] for _, s in rows(finished, "/link/state/radar1", "StateChange:state") if s]
    assert states == ["streaming", "fault", "ended"]
    states = [s[0] for _, s in rows(finished, "/link/state/radar0", "StateChange:state") if s]
    assert states == ["setting up", "streaming", "ended"]


@pytest.mark.parametrize("is_known", [True, False])
def test_the_guide_speaks_of_truth_only_where_there_is_one(tmp_path: Path, is_known: bool) -> None:
    info = session_info()
    known = info if is_known else replace(info, true_landmarks_m=np.empty((0, 2)))
    (_, (text,)) = next(rows(drawn(tmp_path, info=known), "/about", "TextDocument:text"))
    assert ("*true* path" in text) is is_known
    assert ("distance to the truth" in text) is is_known
    assert ("*Error* and *NEES* are empty" in text) is not is_known
    assert "2 short-range radars" in text


def blueprint_values(path: Path, component: str) -> list[Any]:
    reader = RrdReader(path)
    return [
        value
        for blueprint in reader.blueprints()
        for chunk in reader.stream(store=blueprint)
        for batch in [chunk.to_record_batch()]
        if component in batch.schema.names
        for row in batch[component].to_pylist()
        for value in row or ()
    ]


def test_a_blueprint_is_embedded(finished: Path) -> None:
    names = blueprint_values(finished, "ViewBlueprint:display_name")
    assert {"Map [m]", "Error [m]", "SLAM [m]", "NEES", "NIS", "Landmarks"} <= set(names)
    assert "Frame radar1: amplitude over range [m]" in names
    (recording,) = RrdReader(finished).recordings()
    assert recording.recording_id == "made_up-paper-7"


def test_the_map_has_a_grid_with_metres_inside_of_what_is_visible(tmp_path: Path) -> None:
    path = drawn(tmp_path, snapshot(0))
    *_, texts = [t for _, t in rows(path, "/map/grid/numbers", "Points2D:labels") if t]
    *_, places = [p for _, p in rows(path, "/map/grid/numbers", "Points2D:positions") if p]
    # of the layout at the beginning, and of that which holds all
    ranges = blueprint_values(path, "VisualBounds2D:range")
    bounds = max(ranges, key=lambda found: np.ptp(found["x_range"]) + np.ptp(found["y_range"]))
    (left, right), (top, bottom) = bounds["x_range"], bounds["y_range"]
    # around landmarks and robot are 0.6 m, around what the radars see from its place 0.3 m; up is
    # negative on the screen
    info, state = session_info(), snapshot(0)
    pose = compose(state.world_from_map, state.estimate)
    outlines = [wedge(info.field_of_view, radar) for radar in info.radars]
    fans = transform(pose, np.concatenate(outlines))
    found = transform(state.world_from_map, state.landmarks_m)
    known = np.concatenate([info.true_landmarks_m, found, pose[None, :2]])
    low = np.minimum(known.min(axis=0) - 0.6, fans.min(axis=0) - 0.3)
    high = np.maximum(known.max(axis=0) + 0.6, fans.max(axis=0) + 0.3)
    np.testing.assert_allclose(
        [left, right, top, bottom], [low[0], high[0], -high[1], -low[1]], atol=1e-6
    )
    at = dict(zip(texts, places, strict=True))
    assert {"x 0 m", "x 1 m", "y 1 m"} <= set(at)
    of_x, of_y = ([place for text, place in at.items() if text[0] == axis] for axis in "xy")
    apart_m = np.abs(np.array(of_x)[:, None] - np.array(of_y))
    assert apart_m.min() > 0.29
    for text, (x, y) in at.items():
        axis, value, unit = text.split()
        assert unit == "m"
        assert float(value) == pytest.approx(x if axis == "x" else -y)
        assert left < x < right
        assert top < y < bottom


def test_a_map_of_an_unknown_world_grows_with_what_is_found(tmp_path: Path) -> None:
    unknown = replace(session_info(), true_landmarks_m=np.empty((0, 2)))
    far = replace(snapshot(9), landmarks_m=np.array([[7.0, 0.5], [-0.5, 2.02]]))
    path = drawn(tmp_path, snapshot(0), far, info=unknown)
    texts = [t for _, t in rows(path, "/map/grid/numbers", "Points2D:labels") if t]
    assert len(texts) > 1
    assert "x 6 m" in texts[-1]


@pytest.mark.parametrize("far_m", [4e5, 1e8, float("nan")])
def test_a_robot_that_is_very_far_away_or_nowhere_ends_no_view(
    far_m: float, tmp_path: Path
) -> None:
    """As after a jump of its odometry, of which a live run warns and then goes on."""
    info = replace(session_info(), true_landmarks_m=np.empty((0, 2)))
    far = replace(snapshot(9), estimate=np.array([far_m, 0.0, 0.0]))
    path = drawn(tmp_path, snapshot(0), far, info=info)
    texts = [t for _, t in rows(path, "/map/grid/numbers", "Points2D:labels") if t]
    assert 3 <= len([text for text in texts[-1] if text.startswith("x ")]) <= 14


def test_the_robot_lies_above_its_path_and_is_larger(finished: Path) -> None:
    orders = {
        name: next(v for _, v in rows(finished, entity, f"{kind}:draw_order") if v)[0]
        for name, entity, kind in (
            ("path", "/map/estimate/path", "LineStrips2D"),
            ("rim", "/map/robot/rim", "Points2D"),
            ("body", "/map/robot/body", "Points2D"),
            ("arrow", "/map/robot", "Arrows2D"),
        )
    }
    assert orders["path"] < orders["rim"] < orders["body"] < orders["arrow"]
    radius = next(v for _, v in rows(finished, "/map/robot/rim", "Points2D:radii") if v)[0]
    line = next(v for _, v in rows(finished, "/map/estimate/path", "LineStrips2D:radii") if v)[0]
    assert radius > 5 * line
    (forwards,) = next(v for _, v in rows(finished, "/map/robot", "Arrows2D:vectors") if v)
    assert forwards[0] > radius
    assert forwards[1] == 0.0


def test_the_smoothed_path_is_drawn_at_the_last_state(tmp_path: Path) -> None:
    view, made = RerunView(tmp_path / "s.rrd", session_info()), smoothed_run(12)
    feed(view, 12)
    view.on_smoothed(made)
    view.close()
    (line,) = (
        v for _, v in rows(tmp_path / "s.rrd", "/map/smoothed/path", "LineStrips2D:strips") if v
    )
    (points,) = line
    np.testing.assert_allclose(points[0], made.poses[0, :2] * [1, -1], rtol=1e-6)
    np.testing.assert_allclose(points[-1], made.poses[-1, :2] * [1, -1], rtol=1e-6)
    dots = rows(tmp_path / "s.rrd", "/map/smoothed/landmarks", "Points2D:positions")
    (places,) = (v for _, v in dots if v)
    np.testing.assert_allclose(places, made.landmarks_m * [1, -1], rtol=1e-6)
    errors = dict(rows(tmp_path / "s.rrd", "/error/smoothed", "Scalars:scalars"))
    nees = dict(rows(tmp_path / "s.rrd", "/consistency/nees/smoothed", "Scalars:scalars"))
    assert list(errors) == list(nees) == list(range(12))
    away = made.poses[7] - snapshot(7).truth  # the map is the world there
    assert errors[7] == pytest.approx([float(np.hypot(*away[:2]))])
    wanted = away @ np.linalg.solve(made.pose_covariances[7], away) / 3
    assert nees[7] == pytest.approx([wanted])


def test_the_radar_image_lies_on_the_map_where_its_cells_are(tmp_path: Path) -> None:
    place = np.array([3.0, -1.0, 0.7])  # of the map frame in the world
    levels = np.full((4, 6), -1, dtype=np.int8)
    levels[1, 4], levels[2, 0] = 100, 30
    grid = Grid(x_m=0.5, y_m=-2.0, cell_m=0.25, rows=4, columns=6)
    view = RerunView(tmp_path / "s.rrd", session_info())
    view.on_image(RadarImage(t_ns=0, grid=grid, levels=levels))  # before any state: not shown
    view.on_scan(scan(0))
    view.on_snapshot(replace(snapshot(0), world_from_map=place))
    view.on_image(RadarImage(t_ns=0, grid=grid, levels=levels))
    view.close()
    entity = "/map/image"
    (moved,) = (v for _, v in rows(tmp_path / "s.rrd", entity, "Transform3D:translation") if v)
    (turned,) = (
        v for _, v in rows(tmp_path / "s.rrd", entity, "Transform3D:rotation_axis_angle") if v
    )
    (scaled,) = (v for _, v in rows(tmp_path / "s.rrd", entity, "Transform3D:scale") if v)
    (blob,) = (v for _, v in rows(tmp_path / "s.rrd", f"{entity}/cells", "EncodedImage:blob") if v)
    with Image.open(io.BytesIO(bytes(blob[0]))) as picture:
        pixels = np.asarray(picture.convert("RGBA"))
    assert pixels.shape == (4, 6, 4)
    assert (pixels[..., 3] > 0).sum() == 2
    brightest = np.argmax(pixels[..., :3].sum(axis=-1) * (pixels[..., 3] > 0))
    row, column = np.unravel_index(brightest, (4, 6))
    # Rerun: pixels go right and down from the corner, then scale, rotation and translation
    x, y = scaled[0][0] * (column + 0.5), scaled[0][1] * (row + 0.5)
    angle = turned[0]["angle"] * turned[0]["axis"][2]
    shown = np.array(
        [x * np.cos(angle) - y * np.sin(angle), x * np.sin(angle) + y * np.cos(angle)]
    ) + np.array(moved[0][:2])
    cell_m = transform(place, np.array([0.5 + 4.5 * 0.25, -2.0 + 1.5 * 0.25]))
    np.testing.assert_allclose(shown, cell_m * [1, -1], atol=1e-5)


def test_wall_clock_is_nowhere_in_the_data(finished: Path) -> None:
    timelines = {
        name
        for chunk in RrdReader(finished).stream()
        for name in chunk.to_record_batch().schema.names
        if name in {"log_time", "log_tick"}
    }
    assert timelines == set()


def test_one_missing_row_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    view = RerunView(tmp_path / "s.rrd", session_info())
    feed(view, 3)

    def one_less(path: Path) -> dict[str, int]:
        rows = count_rows(path)
        rows["/radar/radar1/frame"] -= 1
        return rows

    monkeypatch.setattr("slam.app.view.rerun_recording.count_rows", one_less)
    with pytest.raises(AppError, match=r"s\.rrd: holds 2 of 3 rows of /radar/radar1/frame"):
        view.close()


@pytest.mark.parametrize(
    ("count", "period_s", "expected"),
    [
        # sent at 0.5 s with six frames, and at the end with all ten, each from its own first frame
        (10, 0.1, [(0, 6), (6, 10)]),
        # full blocks of a fast radar, though 0.5 s passed
        (300, 0.0025, [(0, 128), (128, 128), (256, 128)]),
    ],
)
def test_a_followed_view_sends_what_waited_too_long(
    tmp_path: Path, count: int, period_s: float, expected: list[tuple[int, int]]
) -> None:
    now_s = 0.0
    view = RerunView(tmp_path / "s.rrd", session_info(), flush_s=0.5, clock_s=lambda: now_s)
    for counter in range(count):
        now_s = period_s * counter
        one, t_ns = scan(counter), round(1e9 * now_s)
        frames = tuple(replace(frame, t_ns=t_ns) for frame in one.frames)
        view.on_scan(replace(one, t_ns=t_ns, frames=frames))
    view.close()
    pictures = rows(tmp_path / "s.rrd", "/radar/radar0/bscan", "Tensor:data")
    assert [(frame, picture[0]["shape"][0]) for frame, picture in pictures] == expected


DAY_NS = 1_790_000_000_000_000_000


def test_host_time_is_a_timeline_where_arrival_is_known(tmp_path: Path) -> None:
    came = [replace(scan(k), host_ns=(DAY_NS + k, DAY_NS + 10 + k)) for k in range(3)]
    path = drawn(tmp_path, *came)
    expected = [DAY_NS + 10, DAY_NS + 11, DAY_NS + 12]
    assert stamps(path, "/radar/radar1/frame", "host_time") == expected


def test_a_live_view_notes_arrival_itself(tmp_path: Path) -> None:
    now_ns = iter(range(DAY_NS, DAY_NS + 10))
    path = drawn(tmp_path, scan(0), scan(1), time_of_day_ns=lambda: next(now_ns))
    for name in ("radar0", "radar1"):  # one arrival per scan
        assert stamps(path, f"/radar/{name}/frame", "host_time") == [DAY_NS, DAY_NS + 1]


@pytest.mark.parametrize("day_ns", [DAY_NS, 37_310_000_000_000])
def test_time_is_counted_from_the_first_scan(tmp_path: Path, day_ns: int) -> None:
    early = LogLine(t_ns=0, radar="radar0", warning=False, text="tx Ping")
    events = [replace(one, t_ns=day_ns + k) for k in range(3) for one in (scan(k), snapshot(k))]
    path = drawn(tmp_path, early, *events)
    assert stamps(path, "/error/slam", "device_time") == [0, 1, 2]
    assert stamps(path, "/link/log/radar0", "device_time") == [0]


def test_without_truth_there_is_no_error_to_show(tmp_path: Path) -> None:
    unknown = [replace(snapshot(k), truth=np.full(3, np.nan)) for k in range(3)]
    counted = count_rows(drawn(tmp_path, scan(0), *unknown))
    assert {"/error/slam", "/consistency/nees/value", "/map/truth/path"}.isdisjoint(counted)
    assert counted["/map/estimate/path"] == 2  # first state, and last


def test_odometry_that_began_with_slam_is_shown_as_it_is(tmp_path: Path) -> None:
    state = snapshot(0)
    begun = replace(state, odometry=state.estimate + np.array([0.03, 0.0, 0.01]))
    path = drawn(tmp_path, begun)
    (_, (error_m,)) = next(rows(path, "/error/odometry", "Scalars:scalars"))
    assert error_m == pytest.approx(np.hypot(0.03, 0.01))  # the estimate itself is 0.01 m off


def test_odometry_that_began_elsewhere_begins_where_slam_does(tmp_path: Path) -> None:
    elsewhere = np.array([40.0, -7.0, 2.0])
    driven = [compose(elsewhere, np.array([0.1 * k, 0.0, 0.0])) for k in range(3)]
    path = drawn(tmp_path, *(replace(snapshot(k), odometry=driven[k]) for k in range(3)))
    (strip,) = [s for _, s in rows(path, "/map/odometry/path", "LineStrips2D:strips")][-1]
    start = snapshot(0).estimate
    expected = transform(start, np.array([[0.0, 0.0], [0.2, 0.0]])) * [1, -1]
    np.testing.assert_allclose(strip, expected, atol=1e-5)


def test_names_may_hold_any_character(tmp_path: Path) -> None:
    # closing compares the rows of every entity by its name
    name = "left/rear 1.ä"
    info = session_info()
    radars = (replace(info.radars[0], name=name), info.radars[1])
    path = drawn(
        tmp_path,
        LogLine(t_ns=0, radar=name, warning=True, text="fault CRC"),
        LogLine(t_ns=0, radar="tcp://127.0.0.1:3000", warning=False, text="tx Ping"),
        *map(scan, range(3)),
        *(replace(snapshot(k), step=step(robust=True)) for k in range(3)),
        info=replace(info, radars=radars),
    )
    counted = count_rows(path)
    assert counted["/radar/left\\/rear\\ 1.ä/frame"] == 3
    assert counted["/link/faults/left\\/rear\\ 1.ä"] == 1
    assert counted["/link/log/tcp\\:\\/\\/127.0.0.1\\:3000"] == 1


def step(*, robust: bool) -> StepResult:
    """Return a state with two detections of radar 0, the second of which counted."""
    seen = tuple(
        Detection(radar=0, t_ns=0, range_m=range_m, amplitude=0.01, sigma_m=0.001)
        for range_m in (0.5, 1.0)
    )
    fix = Fix(pair=0, t_ns=0, x_m=0.3, y_m=0.9, detections=(seen[1], seen[1]))
    stray = Fix(pair=0, t_ns=0, x_m=0.1, y_m=0.4, detections=(seen[0], seen[0]))
    observation = Observation(x_m=0.3, y_m=0.9, n_poses=5, fixes=(fix,))
    report = UpdateReport(
        continued=((0, 0, 7),),  # the first of those given: the other one was unfit
        nis=1.0,
        dof=1,
    )
    return StepResult(
        t_ns=0,
        odometry_pose=np.zeros(3),
        belief=start(),
        detections=seen,
        fixes=() if robust else (fix, stray),
        observations=() if robust else (observation,),
        rejected=() if robust else (stray,),
        report=report if robust else None,
        range_sigmas_m=(np.inf, 0.001) if robust else (),
    )


@pytest.mark.parametrize("robust", [True, False])
def test_echoes_are_arcs_of_the_body_and_bars_of_the_frame(tmp_path: Path, robust: bool) -> None:
    path = drawn(tmp_path, scan(0), replace(snapshot(0), step=step(robust=robust)))
    antenna = np.array([0.1, -0.2])  # of radar0, on the screen
    for name, range_m in (("arcs_used", 1.0), ("arcs_unused", 0.5)):
        found = rows(path, f"/map/robot/radar0/{name}", "LineStrips2D:strips")
        ((arc,),) = [strips for _, strips in found if strips]
        np.testing.assert_allclose(np.linalg.norm(arc - antenna, axis=1), range_m, rtol=1e-6)
        middle = (arc[8] - antenna) / range_m
        np.testing.assert_allclose(middle, [np.cos(1.57), -np.sin(1.57)], atol=1e-6)
    ((bars,),) = [v for _, v in rows(path, "/radar/radar0/detections", "BarChart:abscissa") if v]
    assert bars["buffer"] == [0.5, 1.0]
    ((none,),) = [v for _, v in rows(path, "/radar/radar1/detections", "BarChart:values") if v]
    assert none["buffer"] == [0.0]


def test_fixes_and_clusters_lie_where_the_robot_saw_them(tmp_path: Path) -> None:
    states = (replace(snapshot(k), step=step(robust=False)) for k in range(50))
    path = drawn(tmp_path, *states)
    for name, places in (
        ("fixes/found", [(0.3, 0.9), (0.1, 0.4)]),
        ("fixes/rejected", [(0.1, 0.4)]),
        ("clusters/kept", [(0.3, 0.9)]),
    ):
        shown = [p for _, p in rows(path, f"/map/{name}", "Points2D:positions") if p]
        assert [len(points) // len(places) for points in shown] == [*range(1, 40), *[40] * 11]
        poses = [snapshot(counter).estimate for counter in range(10, 50)]
        expected = np.concatenate([transform(pose, np.array(places)) for pose in poses])
        np.testing.assert_allclose(shown[-1], expected * [1, -1], rtol=1e-5, atol=1e-6)


def test_rows_of_fixes_do_not_depend_on_when_blocks_are_sent(tmp_path: Path) -> None:
    """Without a fix nothing is drawn; from the first one on, every state has its row."""
    without = replace(step(robust=False), fixes=(), observations=(), rejected=())
    steps = [step(robust=False) if k in (4, 5) else without for k in range(10)]
    counted = []
    for name, flush_s in (("blocks", None), ("one by one", 0.0)):
        path = tmp_path / f"{name}.rrd"
        with RerunView(path, session_info(), flush_s=flush_s) as view:
            for k, of_state in enumerate(steps):
                view.on_snapshot(replace(snapshot(k), step=of_state))
                view.on_scan(scan(k))
        shown = rows(path, "/map/fixes/found", "Points2D:positions")
        counted.append([frame for frame, points in shown if points is not None])
    assert counted[0] == counted[1] == [snapshot(k).counter for k in range(4, 10)]


BIN_M = 0.0064255


def moving_tone(amplitude: float) -> np.ndarray:
    """Return a carrier in every second frame, so that its mean is half of it."""
    phase = 2 * np.pi * 7.29e9 * 2 * BIN_M * np.arange(400) / 299_792_458.0
    return np.array([amplitude * (row % 2) * np.cos(phase) for row in range(10)], dtype=np.float32)


def test_the_envelope_of_a_tone_is_flat_and_in_decibels() -> None:
    picture = bscan_picture(moving_tone(0.02), 0.2, BIN_M)
    # half of 0.02 is left after the mean is removed: -40 dB, so 22 of 32 dB of 255 levels
    np.testing.assert_allclose(picture, 255 * 22 / 32, atol=2)
    for amplitude, level in ((1.0, 255), (0.0, 0)):  # clipped
        assert set(bscan_picture(moving_tone(amplitude), 0.2, BIN_M).ravel()) == {level}


def test_it_shows_three_metres_at_most() -> None:
    frames = np.zeros((4, 1431), dtype=np.float32)
    assert bscan_picture(frames, 0.2, BIN_M).shape == (4, int((3.0 - 0.2) / BIN_M) - 2)
    assert bscan_picture(frames[:, :20], 0.2, BIN_M).shape == (4, 18)
