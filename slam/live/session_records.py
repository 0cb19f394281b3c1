"""What a run of SLAM hands to its logs, viewer and reports: one small frozen type each.

Frames of reference: `world` is the scene's; `map` is the frame SLAM works in, which begins at the
robot's first pose; `odom` is the wheel odometry's own.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from types import TracebackType
from typing import Any, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from slam.frames import RadarFrame
from slam.geometry import PAPERS_FIELD, FieldOfView, Mount, ReceivedPulse
from slam.imaging.back_projection import Grid
from slam.live.errors import AppError
from slam.results import PoseAt, SmoothedRun, StepResult

TruthAt = Callable[[NDArray[np.int64]], NDArray[np.float64]]
"""True poses, shape (n, 3), world frame, at n session times [ns]; NaN if unknown."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RadarInfo:
    """One radar of a run: its identity, mount, and the range and time of its samples.

    `range_start_m` and `bin_length_m` are module metres, as FRAMEAREA was read back; the same in
    true metres are in every RadarFrame. `start_skew_ns` is the session time of its first frame.
    `pulse` is what the front end began with, None that of the data sheet.
    `gain_db` is its gain over the mean of the rig: SLAM gets samples without it, the session holds
    them as received.
    """

    name: str
    serial: str
    port: str
    x_m: float
    y_m: float
    yaw_rad: float
    range_offset_m: float
    range_start_m: float
    bin_length_m: float
    n_bins: int
    rate_hz: float
    settings: Mapping[str, object]
    start_skew_ns: int = 0
    phase_offset_rad: float = 0.0
    pulse: ReceivedPulse | None = None
    gain_db: float = 0.0

    @property
    def mount(self) -> Mount:
        return Mount(**{each.name: getattr(self, each.name) for each in fields(Mount)})


@dataclass(frozen=True, slots=True, kw_only=True)
class SessionInfo:
    """Describes a run: enough to name it, to repeat it and to read its frames.

    Attributes
    ----------
    seed
        None on real modules.
    radars
        In the order of the rig.
    true_landmarks_m
        Shape (n, 2), world frame; (0, 2) if unknown.
    versions
        Of what the numbers depend on.
    config_json
        SLAM's settings, by `slam.live.session.description.settings_text`; "" if not recorded.
    wheels
        Fields of `WheelNoise`: the wheel errors that SLAM assumes.
    outlines_m
        Lines of walls and boxes for pictures, shape (k, 2) each, world frame.
    time_base
        Source of the frames' stamps: "counter" or "arrival".
    has_detections
        Whether ranges were recorded that SLAM takes instead of what it finds in frames.
    started_unix_ns
        Time of day at session time 0, of a demo when it began; 0 where session time is the time of
        day; None if it has no meaning.
    odometry_clock
        Text of the option --odometry-clock of a live run, "" of any other.
    odometry_covariance
        Whether the noise of the wheels is the one that came with the odometry; `wheels` has their
        other errors.
    constants
        Every number SLAM ran with beyond its settings, by dotted name, as JSON has them; empty
        where they were not recorded.
    map_json
        The map that SLAM began with, and how, by `slam.app.run.maps.MapUse.text`; "" if it began
        with an empty one.
    """

    scene: str
    preset: str
    seed: int | None
    radars: tuple[RadarInfo, ...]
    true_landmarks_m: NDArray[np.float64]
    versions: Mapping[str, str]
    config_json: str = ""
    wheels: Mapping[str, float] = field(default_factory=dict)
    outlines_m: tuple[NDArray[np.float64], ...] = ()
    simulated: bool = True
    time_base: str = "counter"
    started_unix_ns: int | None = None
    has_detections: bool = False
    odometry_clock: str = ""
    odometry_covariance: bool = False
    constants: Mapping[str, object] = field(default_factory=dict)
    map_json: str = ""

    @property
    def field_of_view(self) -> FieldOfView:
        """Where SLAM takes every radar to see; the paper's, where its settings are not recorded.

        Read key by key: those of another version may have keys that this one does not have.
        """
        part = "robust" if self.settings.get("back_end") == "robust" else "trilateration"
        opening_deg = math.degrees(PAPERS_FIELD.opening_rad)
        return FieldOfView(
            opening_rad=math.radians(self.setting(part, "field_of_view_deg", opening_deg)),
            min_range_m=self.setting("detection", "min_range_m", PAPERS_FIELD.min_range_m),
            max_range_m=self.setting("detection", "max_range_m", PAPERS_FIELD.max_range_m),
        )

    @property
    def corners_m(self) -> NDArray[np.float64]:
        """Ends and corners of all outlines, each once, shape (k, 2) [m], world frame."""
        return np.unique(np.concatenate([np.zeros((0, 2)), *self.outlines_m]), axis=0)

    @property
    def is_world_known(self) -> bool:
        """Whether a true path may be expected: for a scene, not for a real drive."""
        return len(self.true_landmarks_m) > 0 or len(self.outlines_m) > 0

    @property
    def settings(self) -> dict[str, Any]:
        """SLAM's settings as recorded, of whatever version; {} where they cannot be read."""
        try:
            settings = json.loads(self.config_json)
        except ValueError:
            return {}
        return settings if isinstance(settings, dict) else {}

    def setting(self, part: str, key: str, default: float) -> float:
        """Return a number of the settings; the default where it was not recorded."""
        table = self.settings.get(part)
        value = table.get(key) if isinstance(table, dict) else None
        return float(value) if isinstance(value, int | float) else default


@dataclass(frozen=True, slots=True, kw_only=True)
class Scan:
    """The frames of one tick, at most one per radar; a missing radar lost its frame.

    A tick is one frame period; `counter` numbers them from session time 0, and `t_ns` is when a
    radar without start skew samples. Every frame has its own stamp, in the period that begins with
    `t_ns`, and the chip's counter, which begins anew with every stream. `host_ns` holds the arrival
    of each frame, nanoseconds since 1970; () if unknown. A scan that is not `used` is recorded
    only: SLAM was not stepped with it. Iterating gives the frames.

    Where they are known, `odometry` returns the wheels' pose at a time [ns], and `truth` is the
    true pose at `t_ns`; both of shape (3,), the latter in the world frame. `odom_frame`, shape
    (3,), is the frame in which the source of odometry has its poses then, in that of `odometry`:
    another one once the source was restarted (`slam.library.pose_track`).
    """

    counter: int
    t_ns: int
    frames: tuple[RadarFrame, ...]
    host_ns: tuple[int, ...] = ()
    used: bool = True
    odometry: PoseAt | None = None
    truth: NDArray[np.float64] | None = field(default=None, compare=False)
    odom_frame: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3), compare=False)

    def __iter__(self) -> Iterator[RadarFrame]:
        return iter(self.frames)

    @property
    def odometry_pose(self) -> NDArray[np.float64]:
        """Return the wheels' pose at `t_ns`, shape (3,); AppError if it is not known."""
        if self.odometry is None:
            raise AppError("modules know no odometry; it is the robot's own")
        return self.odometry(self.t_ns)


@dataclass(frozen=True, slots=True, kw_only=True)
class Snapshot:
    """The state of SLAM at one frame time.

    Attributes
    ----------
    counter, t_ns
        Frame counter and time of the state, which lags the newest frame by the paper's window.
    truth, odometry, estimate
        Shape (3,), [x m, y m, heading rad]; world, odom and map frame.
    world_from_map
        Shape (3,), the pose of the map frame in the world.
    pose_covariance
        Shape (3, 3), of `estimate`, map frame.
    landmark_ids
        Shape (m,), int64.
    landmarks_m, landmark_covariances_m2
        Shape (m, 2) and (m, 2, 2), map frame.
    nis_per_dof
        One value per observation that was associated with a landmark at this state.
    wall_spans_m
        Ends of the stretches of wall that answered until then, shape (k, 2, 2), map frame.
    step
        Everything that led to the state, for views; None if it was read from a file without it.
    """

    counter: int
    t_ns: int
    truth: NDArray[np.float64]
    odometry: NDArray[np.float64]
    estimate: NDArray[np.float64]
    world_from_map: NDArray[np.float64]
    pose_covariance: NDArray[np.float64]
    landmark_ids: NDArray[np.int64]
    landmarks_m: NDArray[np.float64]
    landmark_covariances_m2: NDArray[np.float64]
    nis_per_dof: tuple[float, ...]
    wall_spans_m: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 2, 2)))
    step: StepResult | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RadarImage:
    """The room as the radars saw it until a session time.

    Attributes
    ----------
    grid
        Its cells, map frame.
    levels
        Shape (rows, columns), int8: `slam.imaging.room.RoomImage.levels`.
    """

    t_ns: int
    grid: Grid
    levels: NDArray[np.int8]


@dataclass(frozen=True, slots=True, kw_only=True)
class LogLine:
    """One line about the link: a command, its answer, a fault. `t_ns` is session time."""

    t_ns: int
    radar: str
    warning: bool
    text: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Gap:
    """What damage took out of a session at one place of it, as far as it is known.

    Attributes
    ----------
    from_ns, to_ns
        Session times of the last message before it and the first one behind it; None: there is
        none.
    n_messages
        How many are lost; None if unknown.
    scans
        Counters of the first and the last scan that is lost, None if there is none in between.
    frames
        How many counters are missing, by the names of radars.
    """

    from_ns: int
    to_ns: int | None
    n_messages: int | None
    scans: tuple[int, int] | None
    frames: Mapping[str, int]

    def __str__(self) -> str:
        if self.to_ns is None:
            text = f"from {self.from_ns / 1e9:.2f} s on"
        else:
            span_s = max(self.to_ns - self.from_ns, 0) / 1e9
            text = f"{self.from_ns / 1e9:.2f} to {self.to_ns / 1e9:.2f} s ({span_s:.2f} s)"
        parts = []
        if self.scans is not None:
            first, last = self.scans
            which = f"scan {first}" if first == last else f"scans {first} to {last}"
            parts.append(which)
        parts += [f"{n} frame{'s' * (n > 1)} of {radar}" for radar, n in self.frames.items()]
        if self.n_messages is not None:
            parts.append(f"{self.n_messages} message{'s' * (self.n_messages > 1)} in all")
        return ": ".join([text, ", ".join(parts)] if parts else [text])


Event: TypeAlias = Scan | Snapshot | SmoothedRun | RadarImage | LogLine
"""What a run produces."""

METHODS = {
    Scan: "on_scan",
    Snapshot: "on_snapshot",
    SmoothedRun: "on_smoothed",
    RadarImage: "on_image",
    LogLine: "on_log",
}
"""Of an observer, by the type of event that they get."""


class SessionObserver:
    """Gets everything a run produces, in order: a log, a viewer, a progress line.

    Subclasses define the methods they need; those that pass all events on override `take`.
    """

    def take(self, event: Event) -> None:
        """Get an event, by the method for its type."""
        getattr(self, METHODS[type(event)])(event)

    def on_scan(self, scan: Scan) -> None: ...

    def on_snapshot(self, snapshot: Snapshot) -> None: ...

    def on_smoothed(self, smoothed: SmoothedRun) -> None:
        """Get the solution over all states so far: at the end of a run, and when it is asked for.

        A run that has none, as the paper's, does not call it.
        """

    def on_image(self, image: RadarImage) -> None:
        """Get the radar image so far, every few seconds; a run without one does not call it."""

    def on_log(self, line: LogLine) -> None: ...

    def close(self) -> None:
        """Finish; called once, also after a failure."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
