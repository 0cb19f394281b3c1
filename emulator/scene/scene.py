"""Scene files: where everything stands, how the robot drives, what its radars and wheels are like.

Lengths are true metres, angles in the file degrees, amplitudes normalised X4 units (full scale of
the 11 bit DAC is +-1). What each number does to an echo is on the model page,
``emulator.echo.echo``; to the odometry, in ``emulator.scene.wheels``.

A scene is TOML; ``load_scene`` turns it into frozen, validated models or one :class:`SceneError`
line naming file, key and what is allowed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, StrictBool, StrictInt, field_validator, model_validator

from emulator.chip.chip import ModuleClock
from emulator.scene.motion import (
    AMPLITUDE_OF_1_M2,
    Degrees,
    Metres,
    MoverSpec,
    Name,
    TruePath,
    carried,
    drive,
)
from emulator.scene.people import PersonSpec
from emulator.scene.rooms import FAMILIES, MOST_ROOMS, room_of, room_tables
from emulator.scene.toml_files import Number, SerialNumber, Table, is_name, load_table
from xethru_protocol.validation import choices, shown

MIRROR_AMPLITUDE_1M = AMPLITUDE_OF_1_M2 * math.sqrt(math.pi)
"""Echo of a large perfect mirror on boresight at 1 m: 0.106, as strong as pi R**2 at R."""
SHORTEST_FACE_M = 0.01
LONGEST_DRIVE_S = 24 * 3600
MOST_ODOMETRY_LINES = 500_000
"""A day at the default rate; all lines are computed before the ports open."""

Sigma = Annotated[Number, Field(ge=0, le=1)]
Seconds = Annotated[Number, Field(gt=0, le=86_400)]
CorrelationTime = Annotated[Number, Field(ge=1e-3, le=86_400)]

RECORDED: Mapping[str, Mapping[str, Mapping[str, float]]] = {
    "x4m03_2025": {
        "noise": {"rf_sigma": 1.8e-5, "iterations": 16, "pulses_per_step": 300},
        "leakage": {"amplitude": 0.059, "ringing": 0.25, "ringing_m": 0.35},
        "jitter": {"white_rad": 0.0031, "slow_rad": 0.032, "amplitude": 0.0011},
        "pulse": {"carrier_offset_hz": -7.5e7, "width": 1.12, "skew": 0.0, "ringing": 0.0},
    },
    "x4_2017": {
        "noise": {"rf_sigma": 2.4e-5, "iterations": 16, "pulses_per_step": 300},
        "leakage": {"amplitude": 0.041, "ringing": 0.20, "ringing_m": 0.50},
        "jitter": {"white_rad": 0.0011, "slow_rad": 0.0001, "amplitude": 0.0006},
        "pulse": {"carrier_offset_hz": -7.8e7, "width": 1.07, "skew": 0.0, "ringing": 0.0},
    },
    "bare_x4": {
        "noise": {"rf_sigma": 3.1e-5, "iterations": 16, "pulses_per_step": 300},
        "leakage": {"amplitude": 0.39, "ringing": 0.76, "ringing_m": 0.24},
        "jitter": {"white_rad": 0.004, "slow_rad": 0.013, "amplitude": 0.0042},
        "pulse": {"carrier_offset_hz": -1.9e8, "width": 1.07, "skew": -0.03, "ringing": 0.11},
    },
}
"""Of each recording of a real X4, keys of a scene's tables; ``docs/emulator.md`` has the sources.

What a recording does not show is not among them, and keeps the value of the scene.
"""


class RecordedTable(Table):
    """A table that a scene can set to a recording, ``like = "x4m03_2025"``."""

    figures: ClassVar[str]

    @model_validator(mode="before")
    @classmethod
    def _is_like_a_recording(cls, values: Any) -> Any:  # noqa: ANN401 - whatever a file holds
        if not isinstance(values, Mapping) or "like" not in values:
            return values
        own = dict(values)
        name = own.pop("like")
        if name not in tuple(RECORDED):
            raise ValueError(
                f"like: no such recording: {shown(name)}; {choices(str(name), RECORDED)}"
            )
        recorded = RECORDED[name][cls.figures]
        twice = sorted(own.keys() & recorded)
        if twice:
            raise ValueError(f"{twice[0]}: is set by like, too; leave out one of them")
        return own | dict(recorded)

    def recorded(self, name: str) -> Self:
        """Return the table with the figures of a recording in place of its own."""
        return self.model_copy(update=RECORDED[name][self.figures])


class PulseSpec(RecordedTable):
    """How a module's pulse differs from the nominal one (``emulator.echo.pulse``).

    The envelope's standard deviation is the nominal one times ``width`` (1 - ``skew``) before the
    peak and ``width`` (1 + ``skew``) after it; ``ringing`` is the amplitude of a copy of the pulse
    that follows; ``carrier_offset_hz`` is added to the frequency of the carrier.
    """

    figures = "pulse"
    width: Annotated[Number, Field(ge=0.5, le=2)] = 1.0
    skew: Annotated[Number, Field(ge=-0.5, le=0.5)] = 0.0
    ringing: Annotated[Number, Field(ge=0, le=1)] = 0.0
    carrier_offset_hz: Annotated[Number, Field(ge=-1e9, le=1e9)] = 0.0


class BurstSpec(Table):
    """What other modules send into a frame now and then (``emulator.echo.model_error``).

    ``echo_share`` of the frames hold one to three of their pulses, of ``amplitude`` times the
    exponential of a normal number of standard deviation ``spread``; ``noise_share`` of the frames
    more white noise, ``noise_sigma`` per RF sample.
    """

    echo_share: Annotated[Number, Field(ge=0, le=1)] = 0.0
    amplitude: Annotated[Number, Field(ge=0, le=1)] = 0.015
    spread: Annotated[Number, Field(ge=0, le=3)] = 0.6
    noise_share: Annotated[Number, Field(ge=0, le=1)] = 0.0
    noise_sigma: Sigma = 2.5e-3


class AntennaSpec(Table):
    """How much farther than on boresight an echo appears at an angle off it.

    It is ``sin2_m`` times the squared sine of the angle (``emulator.echo.echo``).
    """

    sin2_m: Annotated[Number, Field(ge=-0.1, le=0.1)] = 0.0


class RadarSpec(Table):
    """One module on the robot: an X4M300, or the ``model`` that is named.

    ``x_m``, ``y_m`` and ``yaw_deg`` place the antennas' phase centre and boresight in the body
    frame (x forward, y left, yaw counter-clockwise). ``range_offset_m`` is added to every true
    range (the module's own delay error; positive reads too far). ``gain_db`` is the error of its
    receiver's gain: it scales echoes, leakage and clutter, not the counts. ``start_skew_ms`` is
    how much later than the nominal scene time of a frame this radar samples, and ``clock_ppm`` how
    fast its clock is: its frames come earlier and its bins are shorter
    (``emulator.chip.chip``). ``mount_error_m`` (x, y) and ``mount_error_deg`` are added to place
    and boresight of the radar, but not to the rig that SLAM gets. A frame is taken at a time
    that differs from its nominal one by a normal number of standard deviation
    ``stamp_sigma_ms``, drawn for each frame.
    """

    name: Name
    serial: SerialNumber
    model: Literal["x4m300", "x4m200"] | None = None
    x_m: Metres
    y_m: Metres
    yaw_deg: Degrees
    range_offset_m: Annotated[Number, Field(ge=-1, le=1)] = 0.0
    gain_db: Annotated[Number, Field(ge=-40, le=40)] = 0.0
    start_skew_ms: Annotated[Number, Field(ge=0, le=10_000)] = 0.0
    clock_ppm: Annotated[Number, Field(ge=-1000, le=1000)] = 0.0
    mount_error_m: tuple[Metres, Metres] = (0.0, 0.0)
    mount_error_deg: Degrees = 0.0
    stamp_sigma_ms: Annotated[Number, Field(ge=0, le=1000)] = 0.0
    pulse: PulseSpec = PulseSpec()
    bursts: BurstSpec = BurstSpec()
    antenna: AntennaSpec = AntennaSpec()

    @property
    def clock(self) -> ModuleClock:
        return ModuleClock(skew_ns=round(self.start_skew_ms * 1e6), ppm=self.clock_ppm)


class WanderSpec(Table):
    """How a target's echo changes with the side it is seen from (``emulator.echo.model_error``).

    ``range_m`` scales how the scattering centre wanders along the line of sight, ``inside_m`` is
    how much nearer than the target's place it lies on average, ``fading`` scales the relative
    change of amplitude and ``phase_rad`` that of the phase.
    """

    range_m: Annotated[Number, Field(ge=0, le=1)] = 0.0
    inside_m: Annotated[Number, Field(ge=0, le=1)] = 0.0
    fading: Annotated[Number, Field(ge=0, le=1)] = 0.0
    phase_rad: Annotated[Number, Field(ge=0, le=10)] = 0.0


class ScintillationSpec(Table):
    """How a target's echo fades in time (``emulator.echo.targets``).

    ``lognormal``: its level in dB is Gaussian, of standard deviation ``sigma_db``. ``rayleigh``:
    its power is exponential, of the mean that the target has without (Swerling's case I).
    ``correlation_s`` is the lag at which level or field are correlated by 1/e.
    """

    law: Literal["none", "lognormal", "rayleigh"] = "none"
    sigma_db: Annotated[Number, Field(ge=0, le=20)] = 3.0
    correlation_s: CorrelationTime = 1.0


class ScatteringPointSpec(Table):
    """One scattering point of a body, in the body's own frame.

    ``share`` is its amplitude in those of the target's ``amplitude_1m``; ``phase_deg`` is added to
    the target's reflection phase.
    """

    x_m: Annotated[Number, Field(ge=-10, le=10)]
    y_m: Annotated[Number, Field(ge=-10, le=10)]
    share: Annotated[Number, Field(gt=0, le=10)] = 1.0
    phase_deg: Degrees = 0.0


class TargetSpec(Table):
    """One reflector, in the world frame.

    ``kind`` selects the amplitude law: a ``rod`` falls with R**-1.5, a ``point`` with R**-2, and
    a ``cylinder`` of ``radius_m`` is seen at the point of its surface nearest to the radar.
    ``amplitude_1m`` is the echo's amplitude on boresight at 1 m (of a cylinder: 1 m from its
    surface). The reflection phase is fixed by the name (``emulator.echo.echo``). A rod or a point
    with ``points`` is a body: in place of one echo from its middle it sends one from each of them;
    ``yaw_deg`` turns them with it.
    """

    name: Name
    kind: Literal["rod", "point", "cylinder"]
    x_m: Metres
    y_m: Metres
    amplitude_1m: Annotated[Number, Field(gt=0, le=10)] = 0.015
    radius_m: Annotated[Number, Field(ge=0, le=10)] = 0.0
    wander: WanderSpec = WanderSpec()
    yaw_deg: Degrees = 0.0
    points: Annotated[tuple[ScatteringPointSpec, ...], Field(max_length=64)] = ()
    scintillation: ScintillationSpec = ScintillationSpec()

    @model_validator(mode="after")
    def _points_stand_alone(self) -> TargetSpec:
        if self.points and (self.kind == "cylinder" or self.wander != WanderSpec()):
            raise ValueError("points: a cylinder, or a target with wander, has none")
        return self

    @model_validator(mode="after")
    def _radius_belongs_to_a_cylinder(self) -> TargetSpec:
        if (self.kind == "cylinder") != (self.radius_m > 0):
            raise ValueError(
                "radius_m: a cylinder needs one greater than 0, a rod or a point has none"
            )
        return self


class _Surface(Table):
    """What walls and boxes are made of.

    ``amplitude_1m`` is the echo of a large flat one on boresight at 1 m; it falls with R**-1, and
    a perfect mirror's is ``MIRROR_AMPLITUDE_1M``. ``transmission`` is the factor on the
    amplitude of what passes through, one way. What is reflected and what passes cannot carry
    more than what arrives.
    """

    amplitude_1m: Annotated[Number, Field(ge=0, le=1)] = 0.035
    transmission: Annotated[Number, Field(ge=0, le=1)] = 0.0

    @property
    def reflection(self) -> float:
        """The magnitude of the reflection coefficient, 0 ... 1."""
        return self.amplitude_1m / MIRROR_AMPLITUDE_1M

    @model_validator(mode="after")
    def _creates_no_energy(self) -> _Surface:
        most = MIRROR_AMPLITUDE_1M * math.sqrt(1 - self.transmission**2)
        if self.amplitude_1m > most * (1 + 1e-9):
            raise ValueError(
                f"amplitude_1m: at most {most:.4f} beside a transmission of "
                f"{self.transmission:g}; a perfect mirror gives {MIRROR_AMPLITUDE_1M:.4f}"
            )
        return self


class WallSpec(_Surface):
    """A straight wall from one end to the other, in the world frame; it reflects on both sides."""

    name: Name
    from_m: tuple[Metres, Metres]
    to_m: tuple[Metres, Metres]

    @model_validator(mode="after")
    def _has_a_length(self) -> WallSpec:
        if math.dist(self.from_m, self.to_m) < SHORTEST_FACE_M:
            raise ValueError(f"to_m: must be at least {SHORTEST_FACE_M} m from from_m")
        return self


class ObjectSpec(_Surface):
    """A box: centred at ``x_m``, ``y_m`` in the world frame, turned by ``yaw_deg``.

    ``width_m`` lies along its own x axis, ``depth_m`` along its own y axis. Its four faces are
    like walls; its edges are weak points.
    """

    name: Name
    x_m: Metres
    y_m: Metres
    width_m: Annotated[Number, Field(ge=SHORTEST_FACE_M, le=100)]
    depth_m: Annotated[Number, Field(ge=SHORTEST_FACE_M, le=100)]
    yaw_deg: Degrees = 0.0


class MultipathSpec(Table):
    """Which paths of more than one reflection are received.

    Where there are walls or objects, ``double_bounce`` is by way of a wall and a target or a
    person, ``corners`` of two walls. ``target_pairs`` is the strength of what goes by way of two
    targets that are close together, 0 for none (``emulator.echo.model_error``).
    """

    double_bounce: StrictBool = True
    corners: StrictBool = True
    target_pairs: Annotated[Number, Field(ge=0, le=1)] = 0.0


class HeightsSpec(Table):
    """Floor and ceiling, as mirrors (``emulator.echo.targets``).

    ``antenna_m`` and ``ceiling_m`` are heights above the floor, of the radars' phase centres and of
    the ceiling; ``floor_reflection`` and ``ceiling_reflection`` the magnitudes of the reflection
    coefficients, 0 for none.
    """

    antenna_m: Annotated[Number, Field(gt=0, le=100)] = 0.3
    ceiling_m: Annotated[Number, Field(gt=0, le=100)] = 2.5
    floor_reflection: Annotated[Number, Field(ge=0, le=1)] = 0.0
    ceiling_reflection: Annotated[Number, Field(ge=0, le=1)] = 0.0

    @model_validator(mode="after")
    def _antenna_is_below_the_ceiling(self) -> HeightsSpec:
        if self.antenna_m >= self.ceiling_m:
            raise ValueError("antenna_m: must be less than ceiling_m")
        return self


class OtherModuleSpec(Table):
    """Another X4 in the world frame, which sends at its own pulse repetition.

    ``amplitude_1m`` is that of its pulses at a radar that looks at it from 1 m; ``clock_ppm`` is
    how fast its clock is. See ``emulator.echo.other_modules``.
    """

    name: Name
    x_m: Metres
    y_m: Metres
    amplitude_1m: Annotated[Number, Field(gt=0, le=10)] = round(2 * MIRROR_AMPLITUDE_1M, 4)
    clock_ppm: Annotated[Number, Field(ge=-1000, le=1000)] = 0.0


class ClutterSpec(Table):
    """Slow correlated clutter (``emulator.echo.receiver``).

    ``sigma`` is its standard deviation per RF sample at TX power 2, normalised units;
    ``correlation_s`` the lag at which its autocorrelation has fallen to 1/e.
    """

    sigma: Sigma = 0.0
    correlation_s: CorrelationTime = 4.8


class JitterSpec(RecordedTable):
    """Jitter of the carrier, common to all echoes of a frame (``emulator.echo.receiver``).

    ``white_rad`` and ``slow_rad`` are the standard deviations of a part of its phase that is new
    with every frame and of one that falls to 1/e after ``slow_correlation_s``; ``amplitude`` is
    the relative standard deviation of its amplitude, new with every frame.
    """

    figures = "jitter"

    white_rad: Sigma = 0.0
    slow_rad: Sigma = 0.0
    slow_correlation_s: CorrelationTime = 4.0
    amplitude: Annotated[Number, Field(ge=0, le=0.1)] = 0.0


class CarriedSpec(Table):
    """The robot is picked up and set down further on along its course.

    At ``at_s`` of scene time it is lifted, for ``takes_s`` it moves straight to where it would
    have been ``skips_s`` later, turned likewise, and drives on from there. Its radars see where
    it really is; its wheels hang in the air and report nothing.
    """

    at_s: Seconds
    skips_s: Seconds
    takes_s: Seconds = 3.0


class PathSpec(Table):
    """A closed course of waypoints driven in laps, turning on the spot.

    ``laps`` lists the direction of every lap: ``forward`` visits the waypoints as written and
    returns to the first, ``backward`` the other way round. No laps: the robot stands.
    """

    waypoints_m: tuple[tuple[Metres, Metres], ...] = ((0.0, 0.0),)
    laps: tuple[Literal["forward", "backward"], ...] = ()
    speed_mps: Annotated[Number, Field(ge=1e-3, le=10)] = 0.05
    turn_rate_deg_per_s: Annotated[Number, Field(ge=0.1, le=3600)] = 28.125
    carried: CarriedSpec | None = None

    @field_validator("waypoints_m")
    @classmethod
    def _starts_at_origin(
        cls, value: tuple[tuple[float, float], ...]
    ) -> tuple[tuple[float, float], ...]:
        along_x = len(value) < 2 or (value[1][0] > 0 and value[1][1] == 0)
        if not value or value[0] != (0.0, 0.0) or not along_x:
            raise ValueError(
                "the world frame is the robot's start pose: "
                "begin with [0.0, 0.0] and go on to a point on the positive x axis"
            )
        return value

    def stops_m(self) -> tuple[tuple[float, float], ...]:
        """Return every stop of the whole drive in order, (x, y) [m], world frame."""
        first, *others = self.waypoints_m
        stops = [first]
        for lap in self.laps:
            stops.extend(others if lap == "forward" else reversed(others))
            stops.append(first)
        return tuple(stops)


class OdometrySpec(Table):
    """How the wheels drift: standard deviations of the model in ``emulator.scene.wheels``.

    ``walk_per_sqrt_s`` lets scale, turn scale and curvature wander during a run: by this many of
    their own standard deviations per square root of a second. ``slips_per_s`` is how often the
    wheels slip; a slip is of ``slip_sigma_m`` and ``slip_sigma_deg``.
    """

    rate_hz: Annotated[Number, Field(ge=0.1, le=1000)] = 5.0
    scale_sigma: Sigma = 0.0
    turn_scale_sigma: Sigma = 0.0
    curvature_sigma_rad_per_m: Sigma = 0.0
    along_sigma_m_per_sqrt_m: Sigma = 0.0
    across_sigma_m_per_sqrt_m: Sigma = 0.0
    heading_sigma_rad_per_sqrt_m: Sigma = 0.0
    heading_sigma_rad_per_rad: Sigma = 0.0
    walk_per_sqrt_s: Sigma = 0.0
    slips_per_s: Annotated[Number, Field(ge=0, le=10)] = 0.0
    slip_sigma_m: Sigma = 0.0
    slip_sigma_deg: Annotated[Number, Field(ge=0, le=90)] = 0.0


class NoiseSpec(RecordedTable):
    """White receiver noise: ``rf_sigma`` per RF sample at the named working point."""

    figures = "noise"
    rf_sigma: Sigma = 5e-4
    iterations: Annotated[StrictInt, Field(ge=1, le=255)] = 16
    pulses_per_step: Annotated[StrictInt, Field(ge=1, le=65535)] = 300


class LeakageSpec(RecordedTable):
    """The direct pulse from transmitter to receiver, at TX power 2, and how it rings on.

    The antennas ring with the carrier's frequency, from ``ringing`` times the pulse's amplitude at
    its peak, falling to 1/e over ``ringing_m`` of range (``emulator.echo.paths``).
    """

    figures = "leakage"
    amplitude: Annotated[Number, Field(ge=0, le=10)] = 0.06
    range_m: Metres = 0.05
    ringing: Annotated[Number, Field(ge=0, le=1)] = 0.0
    ringing_m: Annotated[Number, Field(ge=0.01, le=2)] = 0.25


class SceneError(ValueError):
    """A scene that cannot be used; the message is one line naming file, key and the remedy."""


class UnknownSceneError(SceneError):
    """A name of no shipped scene: wrong usage, while a bad file is a failure."""


class Scene(Table):
    """A whole scene. ``environment`` names the preset values a SLAM run should use for it."""

    name: Name
    environment: Literal["lab", "classroom"]
    description: str
    radars: Annotated[tuple[RadarSpec, ...], Field(min_length=1, max_length=64)]
    targets: tuple[TargetSpec, ...] = ()
    people: Annotated[tuple[PersonSpec, ...], Field(max_length=32)] = ()
    movers: Annotated[tuple[MoverSpec, ...], Field(max_length=32)] = ()
    walls: Annotated[tuple[WallSpec, ...], Field(max_length=64)] = ()
    objects: Annotated[tuple[ObjectSpec, ...], Field(max_length=64)] = ()
    other_modules: Annotated[tuple[OtherModuleSpec, ...], Field(max_length=32)] = ()
    multipath: MultipathSpec = MultipathSpec()
    heights: HeightsSpec = HeightsSpec()
    path: PathSpec = PathSpec()
    odometry: OdometrySpec = OdometrySpec()
    noise: NoiseSpec = NoiseSpec()
    leakage: LeakageSpec = LeakageSpec()
    clutter: ClutterSpec = ClutterSpec()
    jitter: JitterSpec = JitterSpec()

    @model_validator(mode="after")
    def _names_are_unique(self) -> Scene:
        for key, values in (
            ("radars.name", [radar.name for radar in self.radars]),
            ("radars.serial", [radar.serial for radar in self.radars]),
            ("targets.name", [target.name for target in self.targets]),
            ("people.name", [person.name for person in self.people]),
            ("movers.name", [mover.name for mover in self.movers]),
            ("walls.name", [wall.name for wall in self.walls]),
            ("objects.name", [box.name for box in self.objects]),
            ("other_modules.name", [module.name for module in self.other_modules]),
        ):
            twice = sorted({value for value in values if values.count(value) > 1})
            if twice:
                raise ValueError(f"{key}: each must be unique, {shown(twice[0])} is used twice")
        return self

    @model_validator(mode="after")
    def _is_not_too_long(self) -> Scene:
        try:
            duration_s = self.trajectory().duration_ns / 1e9
        except ValueError as error:
            raise ValueError(f"path.carried: {error}") from None
        if duration_s > LONGEST_DRIVE_S:
            raise ValueError(
                f"path: the drive takes {duration_s / 3600:.1f} h, at most "
                f"{LONGEST_DRIVE_S // 3600} h are allowed; drive faster or fewer laps"
            )
        lines = int(duration_s * self.odometry.rate_hz) + 1
        if lines > MOST_ODOMETRY_LINES:
            raise ValueError(
                f"odometry.rate_hz: {lines} lines of odometry in the whole drive, at most "
                f"{MOST_ODOMETRY_LINES} are allowed; lower the rate"
            )
        return self

    def trajectory(self) -> TruePath:
        """Return the robot's true path, world frame (the start pose is the origin)."""
        path = drive(
            self.path.stops_m(),
            speed_mps=self.path.speed_mps,
            turn_rate_rad_per_s=math.radians(self.path.turn_rate_deg_per_s),
        )
        lift = self.path.carried
        if lift is None:
            return path
        return carried(
            path,
            at_ns=round(lift.at_s * 1e9),
            skips_ns=round(lift.skips_s * 1e9),
            takes_ns=round(lift.takes_s * 1e9),
        )


def empty_room(count: int = 1) -> Scene:
    """Return a scene of ``count`` stock modules in a room without any reflector.

    The robot stands at the origin; leakage and receiver noise are the defaults.
    """
    return Scene(
        name="empty_room",
        environment="lab",
        description="Stock modules in an empty room.",
        radars=tuple(
            RadarSpec(
                name=f"radar_{index + 1}",
                serial=f"{100_000_000_000 + index:012d}",
                x_m=0.0,
                y_m=0.0,
                yaw_deg=0.0,
            )
            for index in range(count)
        ),
    )


def load_scene(path_or_name: str | Path) -> Scene:
    """Return the scene in a TOML file, a shipped one by its name ("lab"), or a random room.

    A string without a path separator and without ``.toml`` is a name; that of a room is family and
    number ("pillars:3", see ``emulator.scene.rooms``), and the scene's own name is ``pillars_3``.

    Raises
    ------
    UnknownSceneError
        No scene of this name ships with the package.
    SceneError
        File missing or unreadable, TOML broken, key unknown, or value refused.
    """
    room = room_of(path_or_name) if is_name(path_or_name) else None
    if room is not None:
        return Scene.model_validate(room_tables(*room))
    if is_name(path_or_name) and ":" in path_or_name:
        family = path_or_name.partition(":")[0]
        raise UnknownSceneError(
            f"{path_or_name}: no such room; a family has the rooms 0 to {MOST_ROOMS - 1}, such as "
            f"pillars:3" + ("" if family in FAMILIES else f"; {choices(family, FAMILIES)}")
        )
    return load_table(
        Scene,
        path_or_name,
        folder="scenes",
        what="scene",
        error=SceneError,
        unknown=UnknownSceneError,
    )
