"""The map in Rerun: paths, the robot with its echoes, landmarks, and the ground below them."""

from __future__ import annotations

import io
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from slam.app.rig.echo_arcs import arcs, wedge
from slam.app.run.pictures import (
    ellipse_95,
    ellipse_text,
    enlargement,
    extent_m,
    rotate_covariances,
)
from slam.app.view.rerun_recording import (
    ESTIMATE_RGB,
    FIX_RGB,
    GRID_RGB,
    KEPT_RGB,
    LANDMARK_RGB,
    ODOMETRY_RGB,
    REJECTED_RGB,
    ROBOT_RGB,
    SMOOTHED_RGB,
    TICK_RGB,
    TRUTH_RGB,
    UNUSED_RGB,
    USED_RGB,
    WALL_RGB,
    WEDGE_RGB,
    RerunRecording,
    Rgb,
    RowTimes,
    part,
    rr,
    screen,
    strips_column,
)
from slam.geometry import compose, transform
from slam.live.odometry_track import NS_PER_S
from slam.live.session_records import RadarImage, RadarInfo, SessionInfo, Snapshot
from slam.results import Fix, Observation, SmoothedRun, StepResult
from slam.robust.solver.growing_arrays import PackedRows

Array = NDArray[np.float64]

_MAP_PERIOD_NS = NS_PER_S
_PATH_PERIOD_NS = 2 * NS_PER_S
_ROBOT_PART, _ROBOT_M = 0.025, 0.08
"""Radius of the robot on the map: the larger one of a part of the map's size, and of metres."""
_LINE_POINTS = rr.Radius.ui_points(0.8)

_PATH_STEP = 5
"""One point per five states is 5 cm of path: no corner is lost."""

_MARGIN_M, _MARGIN_PART = 0.6, 0.1
"""Free border of the map, in which the numbers of its axes are: metres, or a part of its size."""

_TICKS = 6
"""About so many lines of the grid cross the longer side of the map."""

TRAIL_STATES = 40
"""Of so many states trilaterated points stay on the map: the clouds that clusters are made of."""

# Name, colour, half line width, draw order: the truth lies below, wide enough to be seen.
_PATHS: tuple[tuple[str, Rgb, float, float], ...] = (
    ("truth", TRUTH_RGB, 0.02, 10.0),
    ("odometry", ODOMETRY_RGB, 0.008, 20.0),
    ("estimate", ESTIMATE_RGB, 0.01, 30.0),
)

# Name, colour, radius [m], draw order.
_POINTS: tuple[tuple[str, Rgb, float, float], ...] = (
    ("clusters/kept", KEPT_RGB, 0.022, 41.0),
    ("fixes/found", FIX_RGB, 0.012, 42.0),
    ("fixes/rejected", REJECTED_RGB, 0.015, 43.0),
)


def used_detections(step: StepResult) -> tuple[bool, ...]:
    """Return for each detection of a state whether it moved the estimate.

    Under the robust back end: it continued the track of a landmark. Under the paper's: it is part
    of a fix of an observation that the outlier filter let through.
    """
    if step.report is None:
        inside = {
            id(detection)
            for observation in step.observations
            for fix in observation.fixes
            for detection in fix.detections
        }
        return tuple(id(detection) in inside for detection in step.detections)
    continued = {(radar, index) for radar, index, _ in step.report.continued}
    given = dict.fromkeys((detection.radar for detection in step.detections), 0)
    flags = []
    for detection, sigma_m in zip(step.detections, step.range_sigmas_m, strict=True):
        if not math.isfinite(sigma_m):  # the back end was not given this one, so does not count it
            flags.append(False)
            continue
        flags.append((detection.radar, given[detection.radar]) in continued)
        given[detection.radar] += 1
    return tuple(flags)


def known_world_m(info: SessionInfo) -> Array:
    """Return the points known before a run, shape (n, 2), world frame: landmarks and outlines."""
    return np.concatenate([info.true_landmarks_m.reshape(-1, 2), *info.outlines_m])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Ground:
    """What the map is drawn on, world frame.

    `low_m` and `high_m`, shape (2,), are its corners, `margin_m` of it a free border.
    """

    low_m: Array
    high_m: Array
    margin_m: float

    @classmethod
    def around(cls, points_m: Array) -> Ground:
        """Return the ground that holds points, shape (n, 2), n > 0, with a border."""
        margin_m = max(_MARGIN_M, _MARGIN_PART * extent_m(points_m))
        low_m, high_m = points_m.min(axis=0) - margin_m, points_m.max(axis=0) + margin_m
        return cls(low_m=low_m, high_m=high_m, margin_m=margin_m)

    @property
    def size_m(self) -> float:
        """The longer side, without the border."""
        return max(extent_m(np.array([self.low_m, self.high_m])) - 2 * self.margin_m, 1.0)

    @property
    def inner_corners_m(self) -> Array:
        """Two corners of it without the border, shape (2, 2)."""
        return np.array([self.low_m + self.margin_m, self.high_m - self.margin_m])

    def holds(self, points_m: Array) -> bool:
        """Return whether points, shape (n, 2), lie on it, at most half in its border."""
        border = self.margin_m / 2
        return bool(
            np.all(points_m >= self.low_m + border) and np.all(points_m <= self.high_m - border)
        )

    def grid(self) -> tuple[list[Array], Array, list[str]]:
        """Return lines, shape (2, 2) each, and the places (n, 2) and texts of their numbers."""
        least_m = self.size_m / _TICKS
        power = 10.0 ** math.floor(math.log10(least_m))
        step_m = next(
            (digit * power for digit in (1, 2, 5) if digit * power >= least_m), 10 * power
        )
        lines, places, texts = [], [], []
        for axis, name in enumerate("xy"):
            first, last = np.ceil(self.low_m[axis] / step_m), np.floor(self.high_m[axis] / step_m)
            in_corner_m = self.low_m[axis] + 0.99 * self.margin_m  # where numbers of both axes meet
            for tick in np.arange(first, last + 1) * step_m + 0.0:  # no -0
                ends = np.array([self.low_m, self.high_m])
                ends[:, axis] = tick
                lines.append(ends)
                if tick < in_corner_m:
                    continue
                # a number lies in the border, outside of what is drawn
                place = self.low_m + 0.5 * self.margin_m
                place[axis] = tick
                places.append(place)
                texts.append(f"{name} {tick:g} m")
        return lines, np.array(places), texts


class MapLayer:
    """Sends poses and echoes in blocks, the map once per second.

    `ground` is a new one when the map or a fan has grown beyond it; it begins as the one that is
    given, if any.
    """

    def __init__(self, recording: RerunRecording, info: SessionInfo, ground: Ground | None) -> None:
        self._recording = recording
        self._radars = info.radars
        self._field = info.field_of_view
        self._paths = {name: PackedRows(np.dtype(np.float64), 2) for name, *_ in _PATHS}
        self._trails: dict[str, deque[Array]] = {
            name: deque(maxlen=TRAIL_STATES) for name, *_ in _POINTS
        }
        self._has_fixes = False
        self._first_ns: int | None = None
        self._next_map_ns = self._next_path_ns = 0
        self._last: tuple[Snapshot, RowTimes] | None = None
        self.ground = ground or Ground.around(np.zeros((1, 2)))
        self._wedges_m = np.concatenate([wedge(self._field, radar) for radar in info.radars])
        self._send_statics(info)

    def on_snapshot(self, snapshot: Snapshot, host_ns: int | None, odom: Array) -> None:
        """Add a state to the paths; `odom` is `world_from_odom` of the first one."""
        if self._first_ns is None:
            self._first_ns = snapshot.t_ns
        stamps = RowTimes.of(snapshot.t_ns, snapshot.counter, host_ns)
        self._last = snapshot, stamps
        place = snapshot.world_from_map
        self._paths["odometry"].append(transform(odom, snapshot.odometry[:2]))
        self._paths["estimate"].append(transform(place, snapshot.estimate[:2]))
        if np.isfinite(snapshot.truth).all():
            if not self._paths["truth"]:  # without truth its robot is not shown
                self._send_robot("map/truth/robot", TRUTH_RGB, TRUTH_RGB, 45.0)
            self._paths["truth"].append(snapshot.truth[:2])
        if snapshot.t_ns >= self._next_map_ns:
            self._next_map_ns = snapshot.t_ns + _MAP_PERIOD_NS
            self._send_landmarks(snapshot, stamps)
        if snapshot.t_ns >= self._next_path_ns:
            # Sent whole, as a view shows the newest row only; ever rarer, so the sum stays small.
            lasted_ns = snapshot.t_ns - self._first_ns
            self._next_path_ns = snapshot.t_ns + max(_PATH_PERIOD_NS, lasted_ns // 100)
            self._send_paths(stamps)

    def on_smoothed(self, smoothed: SmoothedRun) -> None:
        """Send the solution over all states so far, at the last one."""
        if self._last is None:
            return
        snapshot, stamps = self._last
        place = snapshot.world_from_map
        path = transform(place, smoothed.poses[:, :2])
        thinned = screen(np.concatenate([path[::_PATH_STEP], path[-1:]]))
        line = rr.LineStrips2D([thinned], colors=SMOOTHED_RGB, radii=0.007, draw_order=33.0)
        self._recording.row("map/smoothed/path", stamps, line)
        dots = rr.Points2D(
            screen(transform(place, smoothed.landmarks_m)),
            colors=SMOOTHED_RGB,
            radii=0.018,
            labels=[str(number) for number in smoothed.landmark_ids],
            show_labels=False,
            draw_order=36.0,
        )
        self._recording.row("map/smoothed/landmarks", stamps, dots)

    def on_image(self, image: RadarImage) -> None:
        """Send the radar image so far, below everything else, at the last state."""
        if self._last is None:
            return
        snapshot, stamps = self._last
        grid, place = image.grid, snapshot.world_from_map
        corner = transform(place, np.array([grid.x_m, grid.y_m + grid.rows * grid.cell_m]))
        turned = rr.RotationAxisAngle(axis=[0, 0, 1], radians=-float(place[2]))
        where = rr.Transform3D(
            translation=[*screen(corner), 0.0],
            rotation=turned,
            scale=[grid.cell_m, grid.cell_m, 1.0],
        )
        self._recording.row("map/image", stamps, where)
        cells = rr.EncodedImage(
            contents=_png(image.levels[::-1]), media_type="image/png", draw_order=-10.0
        )
        self._recording.row("map/image/cells", stamps, cells)

    def send(self, rows: Sequence[Snapshot], stamps: RowTimes) -> None:
        """Send poses and echoes of some states."""
        world = np.array([compose(row.world_from_map, row.estimate) for row in rows])
        self._send_poses("map/robot", stamps, world)
        known = [k for k, row in enumerate(rows) if np.isfinite(row.truth).all()]
        truth = np.array([rows[k].truth for k in known]).reshape(-1, 3)
        self._send_poses("map/truth/robot", stamps.at(known), truth)
        spread = [
            ellipse_95(pose[:2], rotated, enlarged=self._enlargement(row))
            for row, pose in zip(rows, world, strict=True)
            for rotated in rotate_covariances(
                row.world_from_map[2], row.pose_covariance[None, :2, :2]
            )
        ]
        ellipses = strips_column(screen(np.array(spread)))
        columns = [ellipses.partition([1] * len(rows))]
        self._recording.rows("map/estimate/ellipse", stamps, columns)
        known = [k for k, row in enumerate(rows) if row.step is not None]
        if known:
            self._send_echoes([rows[k] for k in known], stamps.at(known), world[known])

    def send_last(self) -> None:
        """Send the map of the last state."""
        if self._last is not None:
            snapshot, stamps = self._last
            self._send_landmarks(snapshot, stamps)
            self._send_paths(stamps)

    def _send_statics(self, info: SessionInfo) -> None:
        static = self._recording.static
        if info.outlines_m:
            walls = [screen(line) for line in info.outlines_m]
            static("map/walls", rr.LineStrips2D(walls, colors=WALL_RGB, radii=0.015))
        if len(info.true_landmarks_m):
            static("map/landmarks/true", _crosses(info.true_landmarks_m))
        self._send_ground()
        style = rr.LineStrips2D.from_fields(colors=ROBOT_RGB, radii=_LINE_POINTS, draw_order=59.0)
        static("map/estimate/ellipse", style)
        for index, radar in enumerate(info.radars):
            outline = [screen(wedge(self._field, radar))]
            static(
                f"map/robot/{part(radar.name)}/wedge",
                rr.LineStrips2D(outline, colors=WEDGE_RGB, radii=0.003, draw_order=5.0),
            )
            for name, colour, radius_m in (
                ("arcs_used", USED_RGB, 0.007),
                ("arcs_unused", UNUSED_RGB, 0.004),
            ):
                style = rr.LineStrips2D.from_fields(
                    colors=colour, radii=radius_m, draw_order=6.0 + index
                )
                static(f"map/robot/{part(radar.name)}/{name}", style)
        for name, colour, radius_m, order in _POINTS:
            points = rr.Points2D.from_fields(colors=colour, radii=radius_m, draw_order=order)
            static(f"map/{name}", points)

    def _send_ground(self) -> None:
        """Send the grid, and the robot, which is as large as the map needs it to be seen."""
        lines, places, texts = self.ground.grid()
        grid = rr.LineStrips2D(
            [screen(line) for line in lines], colors=GRID_RGB, radii=_LINE_POINTS, draw_order=1.0
        )
        self._recording.static("map/grid", grid)
        numbers = rr.Points2D(
            screen(places), labels=texts, show_labels=True, colors=TICK_RGB, radii=0.0
        )
        self._recording.static("map/grid/numbers", numbers)
        self._send_robot("map/robot", ESTIMATE_RGB, ROBOT_RGB, 60.0)
        if self._paths["truth"]:
            self._send_robot("map/truth/robot", TRUTH_RGB, TRUTH_RGB, 45.0)

    def _send_robot(self, entity: str, colour: Rgb, rim: Rgb, order: float) -> None:
        """Send a disk with an arrow forwards, in the body's frame."""
        radius_m = max(_ROBOT_PART * self.ground.size_m, _ROBOT_M)
        centre = np.zeros((1, 2), dtype=np.float32)
        for name, size_m, rgb, depth in (
            ("rim", radius_m, rim, 0.0),
            ("body", 0.8 * radius_m, colour, 1.0),
        ):
            disk = rr.Points2D(centre, colors=rgb, radii=size_m, draw_order=order + depth)
            self._recording.static(f"{entity}/{name}", disk)
        arrow = rr.Arrows2D(
            origins=centre,
            vectors=[[2.2 * radius_m, 0.0]],
            colors=rim,
            radii=0.2 * radius_m,
            draw_order=order + 2.0,
        )
        self._recording.static(entity, arrow)

    def _enlargement(self, snapshot: Snapshot) -> int:
        pose = snapshot.pose_covariance[None, :2, :2]
        every = np.concatenate([snapshot.landmark_covariances_m2, pose])
        return enlargement(every, self.ground.size_m)

    def _send_poses(self, entity: str, stamps: RowTimes, poses: Array) -> None:
        """Send poses (n, 3) of the world as the transform of an entity drawn in the body frame."""
        turned = -0.5 * poses[:, 2]  # a turn to the left is one to the right on the screen
        quaternions = np.zeros((len(poses), 4))
        quaternions[:, 2], quaternions[:, 3] = np.sin(turned), np.cos(turned)
        places = np.zeros((len(poses), 3))
        places[:, :2] = screen(poses[:, :2])
        if len(poses):
            columns = rr.Transform3D.columns(translation=places, quaternion=quaternions)
            self._recording.rows(entity, stamps, columns)

    def _send_echoes(self, rows: Sequence[Snapshot], stamps: RowTimes, world: Array) -> None:
        steps = [row.step for row in rows if row.step is not None]
        used = [used_detections(step) for step in steps]
        for index, radar in enumerate(self._radars):
            for name, wanted in (("arcs_used", True), ("arcs_unused", False)):
                ranges_m = [
                    [
                        detection.range_m
                        for detection, is_used in zip(step.detections, flags, strict=True)
                        if detection.radar == index and is_used is wanted
                    ]
                    for step, flags in zip(steps, used, strict=True)
                ]
                self._send_arcs(f"map/robot/{part(radar.name)}/{name}", stamps, radar, ranges_m)
        if not self._has_fixes:
            # Robust SLAM makes none; from the first one on every state has its row, so that the
            # rows do not depend on how the states are divided into blocks.
            found_at = [k for k, step in enumerate(steps) if step.fixes or step.observations]
            if not found_at:
                return
            self._has_fixes = True
            first = found_at[0]
            stamps = stamps.at(range(first, len(steps)))
            steps, world = steps[first:], world[first:]
        found: dict[str, list[Sequence[Fix | Observation]]] = {
            "fixes/found": [step.fixes for step in steps],
            "fixes/rejected": [step.rejected for step in steps],
            "clusters/kept": [step.observations for step in steps],
        }
        for name, points in found.items():
            shown = []
            for pose, row in zip(world, points, strict=True):
                own = np.array([(point.x_m, point.y_m) for point in row]).reshape(-1, 2)
                self._trails[name].append(transform(pose, own))
                shown.append(np.concatenate(self._trails[name]))
            columns = rr.Points2D.columns(positions=screen(np.concatenate(shown)))
            self._recording.rows(f"map/{name}", stamps, columns.partition([*map(len, shown)]))

    def _send_arcs(
        self, entity: str, stamps: RowTimes, radar: RadarInfo, ranges_m: Sequence[Sequence[float]]
    ) -> None:
        every_m = np.array([range_m for row in ranges_m for range_m in row], dtype=np.float64)
        strips = strips_column(screen(arcs(self._field, radar, every_m)))
        self._recording.rows(entity, stamps, [strips.partition([*map(len, ranges_m)])])

    def _send_landmarks(self, snapshot: Snapshot, stamps: RowTimes) -> None:
        points = transform(snapshot.world_from_map, snapshot.landmarks_m)
        covariances = rotate_covariances(
            snapshot.world_from_map[2], snapshot.landmark_covariances_m2
        )
        here = transform(snapshot.world_from_map, snapshot.estimate[:2])[None]
        pose = compose(snapshot.world_from_map, snapshot.estimate)
        wedges_m, half_m = transform(pose, self._wedges_m), 0.5 * self.ground.margin_m
        # fans reach to the edge of the border
        fans_m = np.array([wedges_m.min(axis=0) + half_m, wedges_m.max(axis=0) - half_m])
        seen = np.concatenate([points, here, fans_m])
        seen = seen[np.isfinite(seen).all(axis=1)]
        if not self.ground.holds(seen):
            self.ground = Ground.around(np.concatenate([seen, self.ground.inner_corners_m]))
            self._send_ground()
        enlarged = self._enlargement(snapshot)
        outlines = [
            screen(ellipse_95(*pair, enlarged=enlarged))
            for pair in zip(points, covariances, strict=True)
        ]
        dots = rr.Points2D(
            screen(points),
            colors=LANDMARK_RGB,
            radii=0.025,
            labels=[str(number) for number in snapshot.landmark_ids],
            show_labels=False,
        )
        ellipses = rr.LineStrips2D(
            outlines, colors=LANDMARK_RGB, radii=_LINE_POINTS, draw_order=35.0
        )
        self._recording.row("map/landmarks/estimated", stamps, dots)
        self._recording.row("map/landmarks/ellipses", stamps, ellipses)
        spans = [transform(snapshot.world_from_map, ends) for ends in snapshot.wall_spans_m]
        walls = [screen(ends) for ends in spans if np.isfinite(ends).all()]
        answered = rr.LineStrips2D(walls, colors=LANDMARK_RGB, radii=0.02, draw_order=34.0)
        self._recording.row("map/landmarks/walls", stamps, answered)
        ground = self.ground
        top = np.array([[(ground.low_m[0] + ground.high_m[0]) / 2, ground.high_m[1]]])
        legend = rr.Points2D(
            screen(top),
            labels=[ellipse_text(enlarged)],
            show_labels=True,
            colors=LANDMARK_RGB,
            radii=0.0,
        )
        self._recording.row("map/landmarks/legend", stamps, legend)

    def _send_paths(self, stamps: RowTimes) -> None:
        for name, colour, radius_m, order in _PATHS:
            points = self._paths[name]
            if not points:
                continue
            path = screen(np.concatenate([points.rows[::_PATH_STEP], points.rows[-1:]]))
            line = rr.LineStrips2D([path], colors=colour, radii=radius_m, draw_order=order)
            self._recording.row(f"map/{name}/path", stamps, line)


_SHADES = 255 * matplotlib.colormaps["inferno"](np.linspace(0.0, 0.85, 101))[:, :3]
"""Of the levels of a radar image."""
_OUT_OF_VIEW = len(_SHADES)


def _png(levels: NDArray[np.int8]) -> bytes:
    """Return levels as a PNG of few colours, clear where nothing was in view; row 0 is on top."""
    shown = Image.fromarray(np.where(levels < 0, _OUT_OF_VIEW, levels).astype(np.uint8))
    shown.putpalette(np.vstack([_SHADES, np.zeros(3)]).astype(np.uint8).tobytes())
    file = io.BytesIO()
    shown.save(file, format="png", transparency=_OUT_OF_VIEW)
    return file.getvalue()


def _crosses(points: Array) -> rr.LineStrips2D:
    """Draw a cross at each point, shape (n, 2)."""
    strips = [
        screen(np.array([point - arm, point + arm]))
        for point in points
        for arm in (np.array([0.04, 0.04]), np.array([0.04, -0.04]))
    ]
    return rr.LineStrips2D(strips, colors=TRUTH_RGB, radii=0.008, draw_order=32.0)
