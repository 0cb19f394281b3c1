"""A session in Rerun: map, echoes, numbers and links.

The recording can be made again from the session log and is never the only copy: Rerun reads files
of adjacent versions only.
"""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.app.run.pictures import LINK_COLOURS, half_axes_95_m
from slam.app.run.runner import LinkChange, LinkStates
from slam.app.run.summary import (
    POSE_DOF,
    StateNumbers,
    bands_95,
    smoothed_errors,
    state_numbers,
    world_from_odom,
)
from slam.app.view.frames import BLOCK_FRAMES, FrameLayer
from slam.app.view.map import TRAIL_STATES, Ground, MapLayer, known_world_m
from slam.app.view.rerun_recording import (
    BAND_RGB,
    DEVICE_TIME,
    ESTIMATE_RGB,
    FAULT_RGB,
    LANDMARK_RGB,
    ODOMETRY_RGB,
    RADAR_RGB,
    SMOOTHED_RGB,
    RerunRecording,
    Rgb,
    RowTimes,
    part,
    rr,
    rrb,
    screen,
)
from slam.live.errors import AppError
from slam.live.odometry_track import NS_PER_S
from slam.live.session_records import (
    LogLine,
    RadarImage,
    RadarInfo,
    Scan,
    SessionInfo,
    SessionObserver,
    Snapshot,
)
from slam.results import SmoothedRun
from slam.robust.solver.growing_arrays import PackedRows

_ABOUT = """\
# What you see

A robot drives through a room and maps it with {n_radars} short-range radars, which tell distances
only. {data}

* **Map** (left, metres, y up). {truth}Orange: where its *wheels* alone say it went. Blue: where
  *radar SLAM* says, with the robot as a disk with an arrow. Red: *landmarks* and walls it found,
  with 95 % ellipses, enlarged as the map says. {smoothed} The glow below is the *radar image*: what
  the raw frames show, summed along 25 cm of each radar's way.
* **Around the robot**: a grey wedge is what one radar can see. An echo has a distance but no
  direction, so it is an arc: **green** if it moved the estimate, **dim** if not. {points}
* **B-scan** (middle, a tab per radar): echoes of up to {block} frames, constant part removed. A
  landmark that the robot passes is a curved line.
* **Frame**: the newest raw frame, up to 3 m; red bars are detections.
{numbers}
* **Links** (right, below): the state of each serial link; losses and faults in the next tab,
  every command and answer under *Log*.

Move the cursor of the time line below. `device_time` is the radars' own time, `frame` counts frame
periods, `host_time`, if there, is when frames arrived.
"""

_ERRORS = """\
* **Error** (below the map): distance to the truth, which SLAM never sees. **SLAM**: the same, with
  the grey band that should hold it in 95 % of cases. **NEES**, **NIS**: errors of the pose over 3,
  and of predicted echoes over their number, by their own covariance; inside the grey 95 % band
  most of the time if consistent, below if the covariance is too large."""
_NO_ERRORS = """\
* **SLAM** (below the map): the grey band should hold its error in 95 % of cases; the truth is not
  known, so *Error* and *NEES* are empty. **NIS**: errors of predicted echoes over their number, by
  their own covariance; inside the grey 95 % band most of the time if consistent, below if the
  covariance is too large."""
_TRUTH = "Grey: the *true* path, and crosses where the landmarks truly are. "
_SMOOTHED = "Pale yellow, at the end: path and landmarks *smoothed*, all states solved for at once."
_POINTS = (
    "Yellow points are where two arcs cross (trilateration), of the last {states} states; red "
    "those that no cluster confirmed, large green ones what the clusters pass on."
)


def about(info: SessionInfo) -> str:
    """Return the text about a run."""
    is_robust = info.settings.get("back_end") == "robust"
    return _ABOUT.format(
        n_radars=len(info.radars),
        block=BLOCK_FRAMES,
        data="**All data here are simulated.**" if info.simulated else "All data are measured.",
        truth=_TRUTH if info.is_world_known else "",
        numbers=_ERRORS if info.is_world_known else _NO_ERRORS,
        points="" if is_robust else _POINTS.format(states=TRAIL_STATES),
        smoothed=_SMOOTHED if is_robust else "",
    )


def blueprint(info: SessionInfo, ground: Ground | None) -> rrb.Blueprint:
    """Return the layout; the cursor follows the newest data, so a file opens with its whole map.

    The map shows the ground; None: what is drawn.
    """
    names = [radar.name for radar in info.radars]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(_map_view(ground), _numbers(info), row_shares=[5, 2]),
            _echoes(names),
            rrb.Vertical(
                rrb.Tabs(
                    rrb.TextDocumentView(name="What you see", origin="/about"),
                    rrb.TextLogView(name="Log", origin="/link/log"),
                    rrb.TextDocumentView(name="Radars", origin="/radars"),
                ),
                rrb.Tabs(
                    rrb.StateTimelineView(
                        name="Links", origin="/link/state", time_view=_whole_run()
                    ),
                    rrb.TimeSeriesView(
                        name="Lost frames, faults",
                        origin="/link",
                        contents=["$origin/lost/**", "$origin/faults/**"],
                        axis_x=_whole_run(),
                    ),
                ),
                row_shares=[5, 2],
            ),
            column_shares=[4, 3, 3],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=DEVICE_TIME, play_state="following"),
        auto_views=False,
    )


def _map_view(ground: Ground | None) -> rrb.Spatial2DView:
    bounds = None
    if ground is not None:
        low, high = np.sort(screen(np.array([ground.low_m, ground.high_m])), axis=0)
        bounds = rrb.VisualBounds2D(
            x_range=[float(low[0]), float(high[0])], y_range=[float(low[1]), float(high[1])]
        )
    return rrb.Spatial2DView(name="Map [m]", origin="/map", visual_bounds=bounds)


def _echoes(names: Sequence[str]) -> rrb.Tabs:
    mapping = rrb.TensorScalarMapping(colormap="viridis")
    return rrb.Tabs(
        *(
            rrb.Vertical(
                rrb.TensorView(
                    name=f"B-scan {name}",
                    origin=f"/radar/{part(name)}/bscan",
                    view_fit="fill",
                    scalar_mapping=mapping,
                ),
                rrb.BarChartView(
                    name=f"Frame {name}: amplitude over range [m]",
                    origin=f"/radar/{part(name)}",
                    contents=["$origin/frame", "$origin/detections"],
                ),
                name=name,
            )
            for name in names
        )
    )


def _numbers(info: SessionInfo) -> rrb.Tabs:
    """Lay out the curves; without truth, errors and NEES stay empty."""
    contents = {
        "Error [m]": ("/error", ["$origin/slam", "$origin/odometry", "$origin/smoothed"]),
        "SLAM [m]": ("/error", ["$origin/slam", "$origin/believed/**"]),
        "NEES": ("/consistency/nees", ["$origin/**"]),
        "NIS": ("/consistency/nis", ["$origin/**"]),
        "Landmarks": ("/landmarks", ["$origin/**"]),
    }
    corner = rrb.Corner2D.LeftTop  # errors grow, so that there is room
    views = [
        rrb.TimeSeriesView(
            name=name, origin=origin, contents=shown, axis_x=_whole_run(), plot_legend=corner
        )
        for name, (origin, shown) in contents.items()
    ]
    return rrb.Tabs(*views, active_tab=0 if info.is_world_known else 1)


def _whole_run() -> rrb.TimeAxis:
    """Return an axis over the whole run; the default is one minute."""
    everything = rrb.TimeRange(
        start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.infinite()
    )
    return rrb.TimeAxis(view_range=everything)


class LinkLayer:
    """Collects lines and changes of state, and sends them in blocks.

    Lines come at any time, also from the threads that read the ports.
    """

    def __init__(self, recording: RerunRecording, radars: Sequence[RadarInfo]) -> None:
        self._recording = recording
        self._states = LinkStates(tuple(radars))
        self._lines: deque[LogLine] = deque()
        # of each kind of row and name
        self._rows: dict[tuple[str, str], tuple[RowTimes, list[Any]]] = {}
        self._counter = self._t_ns = 0
        self._host_ns: int | None = None
        for index, radar in enumerate(radars):
            states = rr.StateConfiguration(
                values=[str(state) for state in LINK_COLOURS],
                colors=[int(f"{colour[1:]}ff", 16) for colour in LINK_COLOURS.values()],
            )
            recording.static(f"link/state/{part(radar.name)}", states)
            line = rr.SeriesLines(
                colors=RADAR_RGB[index % len(RADAR_RGB)],
                names=f"{radar.name}: lost",
                widths=1.5,
                interpolation_mode=rr.components.InterpolationMode.StepAfter,
            )
            recording.static(f"link/lost/{part(radar.name)}", line)
            marker = rr.SeriesPoints(
                colors=FAULT_RGB, markers="cross", names=f"{radar.name}: fault", marker_sizes=5.0
            )
            recording.static(f"link/faults/{part(radar.name)}", marker)

    def on_scan(self, scan: Scan, host_ns: int | None) -> None:
        self._follow_log()
        self._counter, self._t_ns, self._host_ns = scan.counter, scan.t_ns, host_ns
        before = {name: count.lost for name, count in self._states.counts.items()}
        self._add_changes(self._states.on_scan(scan))
        for name, count in self._states.counts.items():
            # A step, so also where it starts; a line that never moves needs its ends only.
            if count.lost != before[name] or count.frames == 1:
                self._add("lost", name, scan.t_ns, count.lost)

    def on_log(self, line: LogLine) -> None:
        self._lines.append(line)

    def send(self) -> None:
        self._follow_log()
        self._send("state", lambda states: rr.StateChange.columns(state=states))
        self._send("lost", _scalars)

    def finish(self) -> None:
        """Send what waits, and end every link."""
        self._follow_log()
        self._add_changes(self._states.end(self._t_ns))
        for name, count in self._states.counts.items():
            self._add("lost", name, self._t_ns, count.lost)
        self.send()

    def _add(self, kind: str, name: str, t_ns: int, value: object) -> None:
        """Add a row of the newest scan to those that wait."""
        stamps, values = self._rows.setdefault((kind, name), (RowTimes(), []))
        stamps.add(t_ns, self._counter, self._host_ns)
        values.append(value)

    def _add_changes(self, changes: Iterable[LinkChange]) -> None:
        for change in changes:
            self._add("state", change.radar, change.t_ns, str(change.state))

    def _follow_log(self) -> None:
        """Send the lines that came meanwhile, and update the states."""
        while self._lines:  # not a swap: another thread may add while this runs
            line = self._lines.popleft()
            self._add_changes(self._states.on_log(line))
            self._add("log", line.radar, line.t_ns, line)
            if line.warning and line.radar in self._states.counts:
                # The number of the fault, so that a burst of them is a steep stair.
                count = self._states.counts[line.radar].faults
                self._add("faults", line.radar, line.t_ns, count)
        self._send("log", _log_columns)
        self._send("faults", _scalars)

    def _send(self, kind: str, columns_of: Callable[[list[Any]], rr.ComponentColumnList]) -> None:
        """Send the rows of one kind that wait."""
        for key in [key for key in self._rows if key[0] == kind]:
            stamps, values = self._rows.pop(key)
            self._recording.rows(f"link/{kind}/{part(key[1])}", stamps, columns_of(values))


def _scalars(values: Sequence[float] | NDArray[np.float64]) -> rr.ComponentColumnList:
    return rr.Scalars.columns(scalars=np.array(values, dtype=np.float64))


def _log_columns(lines: Sequence[LogLine]) -> rr.ComponentColumnList:
    return rr.TextLog.columns(
        text=[line.text for line in lines],
        level=["WARN" if line.warning else "INFO" for line in lines],
    )


# Entity, name in the legend, colour, line width in points.
_SERIES: tuple[tuple[str, str, Rgb, float], ...] = (
    ("error/slam", "SLAM [m]", ESTIMATE_RGB, 2.0),
    ("error/smoothed", "smoothed [m]", SMOOTHED_RGB, 1.5),
    ("error/odometry", "wheels [m]", ODOMETRY_RGB, 1.5),
    ("consistency/nis/value", "NIS / dof", ESTIMATE_RGB, 1.5),
    ("consistency/nees/value", "NEES / 3", ESTIMATE_RGB, 1.5),
    ("consistency/nees/smoothed", "NEES / 3, smoothed", SMOOTHED_RGB, 1.5),
    ("landmarks/count", "landmarks", LANDMARK_RGB, 2.0),
)

# Entity, name in the legend, unit.
_BANDS: tuple[tuple[str, str, str], ...] = (
    ("error/believed", "95 % by SLAM's own covariance", "m"),
    ("consistency/nis/band", "95 % band", "1"),
    ("consistency/nees/band", "95 % band", "1"),
)


def style_numbers(recording: RerunRecording) -> None:
    """Send how the curves look."""
    for entity, name, colour, width in _SERIES:
        line = rr.SeriesLines(
            colors=colour,
            names=name,
            widths=width,
            interpolation_mode=rr.components.InterpolationMode.StepAfter
            if entity == "landmarks/count"
            else None,
        )
        recording.static(entity, line)
    for entity, name, unit in _BANDS:
        band = rr.Measurements.from_fields(colors=BAND_RGB, names=name, units=unit, widths=0.0)
        recording.static(entity, band)
        edge = rr.SeriesLines(colors=BAND_RGB, names="edge of the band", widths=1.0)
        recording.static(f"{entity}/edge", edge)


def send_numbers(
    recording: RerunRecording, rows: Sequence[Snapshot], stamps: RowTimes, odom: NDArray[np.float64]
) -> None:
    """Send the curves of some states, finite values only; `odom` is the first `world_from_odom`."""
    numbers = StateNumbers(*np.array([state_numbers(row, odom) for row in rows]).T)
    curves = {
        "error/slam": numbers.slam_error_m,
        "error/odometry": numbers.odometry_error_m,
        "landmarks/count": numbers.n_landmarks,
        "consistency/nis/value": numbers.nis_per_dof,
        "consistency/nees/value": numbers.nees_per_dof,
    }
    for entity, values in curves.items():
        send_curve(recording, entity, values, stamps)
    believed_m = half_axes_95_m(np.array([row.pose_covariance[:2, :2] for row in rows]))[:, 1]
    bands = {
        "error/believed": np.column_stack([np.zeros(len(rows)), believed_m]),
        "consistency/nis/band": bands_95(numbers.nis_dof),
        "consistency/nees/band": bands_95(
            np.where(np.isfinite(numbers.nees_per_dof), POSE_DOF, np.nan)
        ),
    }
    for entity, bounds in bands.items():
        (known,) = np.nonzero(np.isfinite(bounds[:, 1]))
        if len(known):
            low, high = bounds[known].T
            # Rerun shades one standard deviation on either side of a value
            columns = rr.Measurements.columns(
                values=(high + low) / 2, variances=((high - low) / 2) ** 2
            )
            recording.rows(entity, stamps.at(known.tolist()), columns)
            # the view's axis holds values only, and would cut the shade off
            send_curve(recording, f"{entity}/edge", bounds[:, 1], stamps)


def send_curve(
    recording: RerunRecording, entity: str, values: NDArray[np.float64], stamps: RowTimes
) -> None:
    """Send the finite ones of some values, shape (n,), at their stamps."""
    (known,) = np.nonzero(np.isfinite(values))
    if len(known):
        recording.rows(entity, stamps.at(known.tolist()), _scalars(values[known]))


_BLOCK_STATES = 128


class RerunView(SessionObserver):
    """Draws a session, into an .rrd file in large blocks, or in a viewer as it happens.

    Parameters
    ----------
    flush_s
        Live: longest time that a row waits before it is sent; None for full blocks only.
    clock_s
        Monotonic, for `flush_s`.
    called
        What messages call the file, if it gets its name later.
    time_of_day_ns
        Live: the clock for scans that arrive without a time of arrival; None leaves it unknown.

    Raises
    ------
    AppError
        From `close`, when the finished file does not hold every row that was sent.
    """

    def __init__(
        self,
        target: Path | str,
        info: SessionInfo,
        *,
        called: str | None = None,
        flush_s: float | None = None,
        clock_s: Callable[[], float] = time.monotonic,
        time_of_day_ns: Callable[[], int] | None = None,
    ) -> None:
        self._clock_s, self._flush_s = clock_s, flush_s
        self._time_of_day_ns = time_of_day_ns
        self._flushed_s = clock_s()
        self._began = False
        self._waiting: list[Snapshot] = []
        # of all states
        self._stamps = RowTimes()
        self._truth = PackedRows(np.dtype(np.float64), 3)
        self._world_from_map = np.zeros(3)
        self._smoothed: SmoothedRun | None = None
        self._odom: NDArray[np.float64] | None = None
        self._host_ns: int | None = None
        self._info = info
        known_m = known_world_m(info)
        self._shown = Ground.around(known_m) if len(known_m) else None
        self._is_live = flush_s is not None
        seed, of_seed = ("", "") if info.seed is None else (f"-{info.seed}", f", seed {info.seed}")
        self._recording = RerunRecording(
            target,
            blueprint(info, self._shown),
            recording_id=f"{info.scene}-{info.preset}{seed}",
            name=f"{info.scene}, preset {info.preset}{of_seed}",
            start_ns=info.started_unix_ns or 0,
            called=called,
        )
        text = rr.TextDocument(about(info), media_type=rr.MediaType.MARKDOWN)
        self._recording.static("about", text)
        settings = json.dumps([asdict(radar) for radar in info.radars], indent=1)
        self._recording.static("radars", rr.TextDocument(settings))
        self._frames = FrameLayer(self._recording, info.radars)
        self._map = MapLayer(self._recording, info, self._shown)
        style_numbers(self._recording)
        self._link = LinkLayer(self._recording, info.radars)

    def on_scan(self, scan: Scan) -> None:
        if not self._began:
            # Session time is the odometry's: that of a robot's drive begins anywhere.
            self._began, self._recording.epoch_ns = True, scan.t_ns
        if not scan.host_ns and self._time_of_day_ns is not None:
            scan = replace(scan, host_ns=(self._time_of_day_ns(),) * len(scan.frames))
        self._host_ns = scan.host_ns[-1] if scan.host_ns else None
        self._frames.on_scan(scan)
        self._link.on_scan(scan, self._host_ns)
        if self._flush_s is not None and self._clock_s() - self._flushed_s >= self._flush_s:
            self._send(scan.t_ns - round(self._flush_s * NS_PER_S))

    def on_snapshot(self, snapshot: Snapshot) -> None:
        if self._odom is None:
            self._odom = world_from_odom(snapshot)
        self._map.on_snapshot(snapshot, self._host_ns, self._odom)
        self._waiting.append(snapshot)
        self._truth.append(snapshot.truth)
        self._world_from_map = snapshot.world_from_map
        self._stamps.add(snapshot.t_ns, snapshot.counter, self._host_ns)
        if len(self._waiting) == _BLOCK_STATES:
            self._send_states()
            self._link.send()

    def on_smoothed(self, smoothed: SmoothedRun) -> None:
        self._map.on_smoothed(smoothed)
        self._smoothed = smoothed

    def on_image(self, image: RadarImage) -> None:
        self._map.on_image(image)

    def on_log(self, line: LogLine) -> None:
        """Draw a line of the log; after `close` it is ignored."""
        self._link.on_log(line)

    def close(self) -> None:
        """Send what is left, finish, and count the rows of a file."""
        if self._recording.is_finished:
            return
        self._frames.send()
        self._send_states()
        self._map.send_last()
        self._send_smoothed_numbers()
        self._link.finish()
        self._show_ground()
        self._recording.finish()

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        """Close; an error of the run itself takes precedence over one of its view."""
        try:
            self.close()
        except AppError:
            if error is None:
                raise

    def _send(self, older_than_ns: int) -> None:
        self._flushed_s = self._clock_s()
        # Of fast radars the next full block is never far; parts of blocks would cost twice.
        self._frames.send_older(older_than_ns)
        self._link.send()
        self._send_states()
        self._link.send()

    def _show_ground(self) -> None:
        """Lay out all anew if the map has grown."""
        if self._shown is not self._map.ground:
            self._shown = self._map.ground
            self._recording.arrange(blueprint(self._info, self._shown))

    def _send_smoothed_numbers(self) -> None:
        """Send the curves of the whole run: those of a part of it would be there twice."""
        smoothed, stamps = self._smoothed, self._stamps
        if smoothed is None or not np.array_equal(smoothed.t_ns, stamps.t_ns):
            return
        errors_m, nees = smoothed_errors(smoothed, self._truth.rows, self._world_from_map)
        send_curve(self._recording, "error/smoothed", errors_m, stamps)
        send_curve(self._recording, "consistency/nees/smoothed", nees, stamps)

    def _send_states(self) -> None:
        rows, self._waiting = self._waiting, []
        n_states = len(self._stamps)
        stamps = self._stamps.at(range(n_states - len(rows), n_states))
        if rows and self._odom is not None:
            self._map.send(rows, stamps)
            if self._is_live and self._info.is_world_known:  # an unknown one grows all the time
                self._show_ground()
            send_numbers(self._recording, rows, stamps, self._odom)
            self._frames.send_detections(rows, stamps)
