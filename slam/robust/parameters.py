"""Parameters of the robust back end: noise of wheels and radars, and the rules of its decisions.

The noise comes from specifications of the robot and of the front end; the rules are the same for
every scene. Every number of a rule has an origin (`slam.config.Origin`) and one sentence that says
what it is; `docs/constants.md` is made of them.

What is a constant in this sense: a number that decides something, so that with half or twice of it
another landmark, place, weight or time could result. It is a field here or a setting. Not
constants, and beside the code that uses them, are

- numbers that keep arithmetic regular: floors and ceilings that no run reaches, damping, tolerances
  and steps of a search that converges, the noise of a statement that is exact, and uncertainties
  so small that they count as none or so large that they state nothing;
- numbers of mathematics, such as a half, or the median of normal noise;
- sizes of buffers, and what marks a value as missing.

Fields of ``RangeNoise``, ``JumpNoise`` and ``WheelNoise`` have the values of the settings and of
the robot; their defaults are for tests.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated

from scipy.special import chdtri

from slam.config import Origin, WheelNoise
from slam.geometry import FieldOfView

TAIL_PROBABILITY: Annotated[float, Origin.QUANTILE] = 1e-3
"""Probability with which a test rejects what is true."""
MARGIN_NATS: Annotated[float, Origin.QUANTILE] = 3.0
"""Logarithm of how many times likelier than any other an explanation must be: twenty times."""
MOST_RADII: Annotated[int, Origin.CHOSEN] = 10
"""What any number of radii that wavefronts show of one landmark count as, at most."""
VAGUE_RADIUS: Annotated[float, Origin.CHOSEN] = 3.0
"""How many times the least standard deviation of such radii may be, for a radius to count."""
THICK_SIGMAS: Annotated[float, Origin.CHOSEN] = 3.0
"""From how many standard deviations on a radius is that of a thick thing."""
FIRST_NOISE_FACTOR: Annotated[float, Origin.CHOSEN] = 30.0
"""By what the noise of measurements is multiplied first, where a solution starts far away."""
SECOND_NOISE_FACTOR: Annotated[float, Origin.CHOSEN] = 8.0
"""By what it is multiplied then, before the solution with the noise as it is. Ranges that would be
outliers even so, where a loop is closed, are of another thing."""
SIGMA_PER_MEDIAN = 1.4826  # the standard deviation of normal noise over its median magnitude
NEIGHBOURHOOD_M = 1.5  # default of `MapRule.neighbourhood_m`: in a room


def is_plausible(chi_square: float, dof: int) -> bool:
    """Return whether chi-square is at most its quantile for `TAIL_PROBABILITY`.

    With no degrees of freedom it is judged as with one.
    """
    return chi_square <= float(chdtri(max(dof, 1), TAIL_PROBABILITY))


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeNoise:
    """How one radar of the rig measures."""

    sigma_m: float = 7.4e-3  # standard deviation of a range
    bearing_sigma_rad: float = 0.03  # standard deviation of a bearing, of a sensor that measures it
    # Share of the variance of range and bearing that is one error in all detections of a passage,
    # of a sensor that measures both: what is left is how well it repeats itself
    common_share: float = 0.0
    # How many landmarks per square metre may not be in the map yet, where such a sensor looks: what
    # a match competes with
    unmapped_per_m2: float = 0.02
    # Added in squares to the front end's sigma of each range, wherever ranges are assigned: a
    # neighbour's echo may shift it by so much. Ranges of nothing known keep it.
    association_sigma_m: float = 0.0
    # Innovations of more standard deviations weigh less, as in Huber's estimator
    huber_sigmas: float = math.inf
    # Standard deviation of each radar's unknown constant range offset; zero if calibrated
    offset_sigma_m: float = 0.0
    # Standard deviations of the antennas' places, per axis, and of landmarks' radii about zero; a
    # zero takes the unknowns out of the state
    mount_sigma_m: float = 0.0
    radius_sigma_m: float = 0.0
    # The least of `RangeErrors.variance_share`; what the ranges of the run show may be more
    variance_share: float = 1.0
    detection_probability: float = 0.92  # that a target in view is detected in a frame
    clutter_per_m: float = 0.15 / 1.3  # false ranges per radar, frame and metre of range
    field_of_view_rad: float = math.radians(65.0)  # full opening angle
    # Where targets are detected
    min_range_m: float = 0.2
    max_range_m: float = 1.5

    @property
    def field_of_view(self) -> FieldOfView:
        return FieldOfView(
            opening_rad=self.field_of_view_rad,
            min_range_m=self.min_range_m,
            max_range_m=self.max_range_m,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class JumpNoise:
    """A motion that the wheels do not report at all, as when somebody bumps into the robot."""

    # Standard deviations along each axis, and of the turn; zero: there is no such motion
    sigma_m: float = 0.0
    sigma_rad: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class ContinuationRule:
    """When single ranges may continue a track.

    A landmark takes part while its predicted ranges are surer than ``RangeNoise.sigma_m``.
    """

    view_margin_rad: Annotated[float, Origin.CHOSEN] = 0.25
    """How far outside the field of view a landmark may lie and still be looked for."""
    blur_m: Annotated[float, Origin.DATA_SHEET] = 0.12
    """Two echoes closer than this in range are hard to tell apart: the width of a pulse at half of
    its height. With images, no single range is of a landmark while another one in view is as near
    in range."""


@dataclass(frozen=True, slots=True, kw_only=True)
class InitialisationRule:
    """When detections of nothing known are of one point at rest, which is a new landmark."""

    window: Annotated[int, Origin.BUDGET, "frames"] = 15
    """For how many scans a new point is kept that none of them shows; the paper's window."""
    min_share: Annotated[float, Origin.CHOSEN] = 0.6
    """Least share of the frames with a point in view that must hit it, and of the window that must
    be such frames; 9 of 15 are the paper's."""
    min_hits_per_radar: Annotated[int, Origin.CHOSEN, "ranges"] = 4
    """Fewest ranges of each radar, and detections with bearings, of a landmark."""
    gate_sigmas: Annotated[float, Origin.QUANTILE] = 3.0
    """How far from its prediction a range may lie, in standard deviations: 99.7 % of normal errors
    are less. Further off, a new landmark is not fitted to it, a landmark is missed in spite of it,
    and it counts as this far off where noise is learned. As far outside the limits of range a
    landmark may lie and still be looked for."""
    drift_share: Annotated[float, Origin.CHOSEN] = 0.7
    """Share of the wheels' scale error by which a frame grows uncertain with the way back to it; a
    radian counts as `WheelNoise.walk_lever_m`."""
    edge_rad: Annotated[float, Origin.CHOSEN] = 0.1
    """Half the width of the edge of the field of view: what lies further outside has no range, and
    a landmark must lie further inside to be missed."""
    long_window: Annotated[int, Origin.BUDGET, "frames"] = 40
    """How far back a new landmark is fitted to single ranges."""

    @property
    def min_frames(self) -> int:
        """Return the fewest frames that must hit a point: the least share of the window."""
        return math.ceil(self.min_share * self.window)


@dataclass(frozen=True, slots=True, kw_only=True)
class MapRule:
    """When a point is a known landmark, two landmarks are one, or a landmark is none.

    A landmark's existence score rises by one for every frame that hits it, and falls for every
    frame that should have hit it and did not. It is reported when it has been hit in as many frames
    as a new one of two radars (`InitialisationRule.min_frames`).
    """

    look_every: Annotated[int, Origin.BUDGET, "scans"] = 5
    """Scans between two looks for landmarks that may be one, and for evidence of a carry."""
    gap_poses: Annotated[int, Origin.CHOSEN, "scans"] = 50
    """A landmark that has not been seen for longer is in another passage when it is seen again."""
    neighbourhood_m: Annotated[float, Origin.CHOSEN] = NEIGHBOURHOOD_M
    """Distance within which landmarks are neighbours: those that may be one, and those that count
    for the density of a map."""
    refused_updates: Annotated[int, Origin.BUDGET, "scans"] = 200
    """After how many scans a merge that the run did not allow is tried again."""
    miss: Annotated[float, Origin.CHOSEN, "hits"] = 1.5
    """By how much, at most, a frame that should have hit a landmark, and did not, lowers its score.
    With 1, what has moved since a map was made may stay on it for a lap."""
    most: Annotated[float, Origin.BUDGET, "hits"] = 20.0
    """Ceiling of the score; it limits how long a landmark stays that is there no more."""
    least: Annotated[float, Origin.BUDGET, "hits"] = -8.0
    """Score below which a landmark is deleted."""
    prior_looks: Annotated[float, Origin.CHOSEN, "looks"] = 20.0
    """Weight of the configured probability of detection in that of a landmark."""
    view_inset_m: Annotated[float, Origin.CHOSEN] = 0.05
    """How far inside the limits of range a landmark must lie to be missed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WallRule:
    """When a wall is a known one."""

    cell_m: Annotated[float, Origin.BUDGET] = 0.1
    """Length of the cells in which it is stored where along it a wall gave echoes."""
    reach_m: Annotated[float, Origin.CHOSEN] = 1.0
    """How far along the line from a known wall an echo may lie and be of it."""
    resolution_m: Annotated[float, Origin.CHOSEN] = 0.05
    """A wall closer than this to a known one, and not it, is its echo merged with another: a pulse
    is longer than that."""
    resolution_rad: Annotated[float, Origin.CHOSEN] = 0.1
    """The same of its direction."""
    roughness_m: Annotated[float, Origin.CHOSEN] = 3e-3
    """Added in squares to the standard deviation of a known wall's single ranges: none is a mirror
    to a fraction of a millimetre, and within a Fresnel zone of its end the edge answers, too."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RadiusRule:
    """What is known of the radii of things before they are seen (`slam.robust.solver.radii`)."""

    thin_m: Annotated[float, Origin.CHOSEN] = 1e-3
    """Standard deviation of the radii of thin things; in a search smaller ones cost the same."""
    thick_m: Annotated[float, Origin.CHOSEN] = 0.2
    """Scale of the half-normal density of the radii of the others."""
    thin_share: Annotated[float, Origin.CHOSEN] = 0.8
    """Share of things that are thin."""
    rounds: Annotated[int, Origin.BUDGET, "rounds"] = 2
    """Of expectation propagation in one solution."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RelinearisationRule:
    """When the whole run is solved for again, and how."""

    key_m: Annotated[float, Origin.BUDGET] = 0.05
    """Way from one keyframe to the next."""
    key_rad: Annotated[float, Origin.BUDGET] = 0.1
    """Turn from one keyframe to the next."""
    turn_rad: Annotated[float, Origin.BUDGET] = 0.02
    """How far the filter's heading may part from the stored trajectory before a solution."""
    shift_m: Annotated[float, Origin.BUDGET] = 0.04
    """How far its position may part from it."""
    every: Annotated[int, Origin.BUDGET, "scans"] = 20
    """Fewest scans between two solutions."""
    at_least_every: Annotated[int, Origin.BUDGET, "scans"] = 50
    """Most scans between two solutions, at the beginning of a run."""
    run_share: Annotated[float, Origin.BUDGET] = 0.1
    """Later, most scans as a share of the run: so all solutions cost in proportion to it."""
    most_at_once: Annotated[int, Origin.BUDGET, "scans"] = 2000
    """A longer run is solved for beside the scans that follow."""
    adopted_after: Annotated[int, Origin.BUDGET, "scans"] = 20
    """After how many of them its solution is there, and catches up with the scans since."""
    iterations: Annotated[int, Origin.BUDGET, "steps"] = 10
    """Most steps of one solution."""
    outlier_sigmas: Annotated[float, Origin.QUANTILE] = 4.0
    """Ranges further off than this are left out: of normal errors one in 16000."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SlipRule:
    """When the wheels may have slipped (`slam.robust.proposals.slips`)."""

    most_share: Annotated[float, Origin.CHOSEN] = 1.5
    """Up to which multiple of the motion around it a step is an ordinary one: times that are a
    little off make one step shorter and the next one longer."""

    most_steps: Annotated[int, Origin.CHOSEN, "steps"] = 3
    """Steps of the longest slip: one between two samples of odometry falls into two, and two slips
    that follow on each other into three, of which none is like the next one."""
    steady_m: Annotated[float, Origin.CHOSEN] = 0.005
    """What the wheels report for one step or two beyond the motion around them may be a slip if it
    is more than this; for three steps the limit is 1.4 times as high."""
    steady_rad: Annotated[float, Origin.CHOSEN] = 0.01
    """The same of the turn."""
    recent_steps: Annotated[int, Origin.CHOSEN, "steps"] = 20
    """Among the changes of motion of so many steps, three quarters are taken for ordinary ones:
    wheels may count coarsely, and a heading may swing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseRule:
    """What the residuals of a solution say of the noise of ranges."""

    fewest_ranges: Annotated[int, Origin.CHOSEN, "ranges"] = 200
    """With fewer ranges in the run the noise stays as it is."""
    keys_per_passage: Annotated[int, Origin.CHOSEN, "keyframes"] = 5
    """Over so many keyframes the errors of the ranges of one landmark are correlated."""
    aspect_rad: Annotated[float, Origin.CHOSEN] = 0.25
    """Seen from within such an angle, a body errs alike, on every lap; 0: on one passage only, as
    things do whose surface is what is measured."""
    prior_weight: Annotated[int, Origin.CHOSEN, "groups"] = 5
    """Weight, in groups, of the configured share of the variance
    (`RobustConfig.range_variance_share`). The noise of all landmarks has the same weight in that of
    one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BranchRule:
    """When the robot may have been carried, and when that is believed."""

    model_sigma_m: Annotated[float, Origin.CHOSEN] = 0.01
    """Added in squares to the noise of a range where it is evidence of a carry: what the scattering
    centre of a body may wander."""
    correlated_steps: Annotated[float, Origin.CHOSEN, "scans"] = 2.0
    """Over so many scans the errors of the ranges of one target are correlated; their evidence is
    divided by it."""
    carries_per_hour: Annotated[float, Origin.CHOSEN] = 0.01
    """How often a robot is carried while its wheels turn."""
    carries_per_hour_stood: Annotated[float, Origin.CHOSEN] = 60.0
    """How often a robot is carried while its wheels stand, per hour of that: of stops of three
    seconds, one in twenty is a carry."""
    stop_s: Annotated[float, Origin.CHOSEN, "s"] = 1.0
    """Shortest stop of the wheels: one that is shorter counts as driving."""
    steps_per_hidden: Annotated[float, Origin.CHOSEN, "scans"] = 3000.0
    """How many scans there are to one motion that the wheels do not report: one in ten minutes."""
    steps_per_jump: Annotated[float, Origin.CHOSEN, "scans"] = 100.0
    """The same of a robot that often moves so, for which `JumpNoise` is not zero."""
    hidden_m: Annotated[float, Origin.CHOSEN] = 0.1
    """Standard deviation of such a motion, along each axis."""
    hidden_rad: Annotated[float, Origin.CHOSEN] = 0.2
    """Standard deviation of its turn."""
    most_against: Annotated[float, Origin.CHOSEN, "nats"] = 5.0
    """Most evidence that one landmark gives against a place: one in 150 has been taken away, is
    hidden, or does not answer to this side."""
    most_for: Annotated[float, Origin.CHOSEN, "nats"] = 9.0
    """Most evidence that one landmark gives for a place, for others may lie near its prediction."""
    new_landmark_nats: Annotated[float, Origin.CHOSEN] = 8.0
    """Price of a new landmark: that one lies within a centimetre of a given place, where there is
    one per square metre."""
    price_nats: Annotated[float, Origin.CHOSEN] = 20.0
    """By how much something rare, such as a hypothesis, must be likelier than that it did not
    happen; with so much, the question of a carry is settled."""
    least_landmarks: Annotated[int, Origin.CHOSEN, "landmarks"] = 3
    """Fewest landmarks that place a map on another."""
    lost_steps: Annotated[int, Origin.BUDGET, "scans"] = 100
    """How many of the last scans decide whether the robot is lost, and for how many scans a motion
    that the wheels did not report is tried."""
    carry_steps: Annotated[int, Origin.BUDGET, "scans"] = 500
    """After how many scans the question of a carry is dropped, unless the robot is lost, and an
    adoption is final."""
    most_places: Annotated[int, Origin.BUDGET, "places"] = 4
    """How many places are on trial at a time."""
    patience: Annotated[int, Origin.BUDGET] = 4
    """After how many times `InitialisationRule.window` a place on trial is dropped."""
    snapshot_every: Annotated[int, Origin.BUDGET, "scans"] = 50
    """Scans between two snapshots of the back end."""
    snapshots: Annotated[int, Origin.BUDGET, "copies"] = 9
    """How many copies of the back end are kept: snapshots, to the oldest of which a carry is dated
    that is noticed later, or hypotheses."""
    catch_up: Annotated[int, Origin.BUDGET, "scans"] = 10
    """How many scans an alternative that lags behind takes at a time."""
    most_doubts: Annotated[int, Origin.BUDGET, "doubts"] = 20
    """How many doubts of the wheels are kept apart; of more, the oldest two become one."""
    open_share: Annotated[float, Origin.CHOSEN] = 0.1
    """Share of the variance of a doubtful motion below which ranges must leave it, in every
    direction, to end the doubt."""
    newest: Annotated[int, Origin.BUDGET, "landmarks"] = 8
    """How many of the newest landmarks are looked for among all others."""
    base_m: Annotated[float, Origin.CHOSEN] = 0.3
    """Least distance of two landmarks from which a place is guessed."""
    reach_m: Annotated[float, Origin.CHOSEN] = 0.2
    """How far lengths and places may differ in a guess."""
    most_tried: Annotated[int, Origin.BUDGET, "guesses"] = 200
    """Most guesses that are judged at a time."""
    placement_nats: Annotated[float, Origin.QUANTILE] = 4.0
    """Least evidence of a place, and by how much it must beat every other: 55 times."""
    weakened: Annotated[float, Origin.CHOSEN] = 4.0
    """Factor on the covariance of the points by which the robot is set down, as their ranges are
    used once more."""
    start_m: Annotated[float, Origin.CHOSEN] = 0.1
    """Standard deviation of a start on a map that is given, along each axis and, at a metre, of its
    heading: that of a robot which somebody has put down by eye."""
    lost_position_m: Annotated[float, Origin.CHOSEN] = 5.0
    """Standard deviation that is reported for the position while the robot is lost."""

    @property
    def likeness_nats(self) -> float:
        """Return the price of a part of the world that looks like another one.

        It does not depend on how many landmarks that has.
        """
        return -math.log(TAIL_PROBABILITY)

    @property
    def start_sigmas(self) -> tuple[float, float, float]:
        """Standard deviations of a start on a map that is given: x, y [m] and heading [rad]."""
        return self.start_m, self.start_m, self.start_m

    @property
    def hidden_variances(self) -> tuple[float, float, float]:
        """Variances of a motion that the wheels do not report: x, y [m^2] and heading."""
        return self.hidden_m**2, self.hidden_m**2, self.hidden_rad**2

    @property
    def lost_variances(self) -> tuple[float, float, float]:
        """Variances of the pose of a lost robot, x, y [m^2] and heading; that is uniform."""
        return self.lost_position_m**2, self.lost_position_m**2, math.pi**2 / 3.0

    def carry_nats(self, elapsed_s: float, stood_s: float) -> float:
        """Return how unlikely a carry is within a time, for a part of which the wheels stood."""
        moved = self.carries_per_hour * (elapsed_s - stood_s)
        carries = (moved + self.carries_per_hour_stood * stood_s) / 3600
        return -math.log(-math.expm1(-carries)) if carries > 0.0 else math.inf


@dataclass(frozen=True, slots=True, kw_only=True)
class ImagedPointRule:
    """How points and walls of patches are used (`slam.imaging.patches`)."""

    new_patches: Annotated[int, Origin.CHOSEN, "patches"] = 2
    """Fewest patches that begin a landmark or a wall, or decide which known landmark they show."""
    frames_per_patch: Annotated[int, Origin.CHOSEN, "frames"] = 3
    """As how many frames a patch counts for the existence of a landmark."""
    sigma_m: Annotated[float, Origin.CHOSEN] = 2e-3
    """Standard deviation of the range of a point, beside noise and wheels, until points of the run
    show it."""
    sigma_rad: Annotated[float, Origin.MEASURED] = 2.5e-3
    """The same of its bearing; in `dense` it is 3.0 mrad, in `lab` 2.3 mrad."""
    prior_differences: Annotated[int, Origin.CHOSEN, "differences"] = 12
    """How many differences of two points these two count as, beside those of the run."""
    differences: Annotated[int, Origin.BUDGET, "differences"] = 150
    """Of how many of the newest differences of the run the median is taken."""
    bearing_share: Annotated[float, Origin.CHOSEN] = 3.0
    """Factor on the standard deviation of bearings: those of one passage err alike."""
    unmapped_per_m2: Annotated[float, Origin.CHOSEN] = 1.0
    """How many landmarks per square metre may not be in the map yet."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LagRule:
    """Which poses are corrected for some way after the robot was there."""

    way_m: Annotated[float, Origin.CHOSEN] = 2.0
    """How far the robot drives until such a pose is final."""
    every: Annotated[int, Origin.BUDGET, "keyframes"] = 2
    """Keyframes from one such pose to the next."""
    most: Annotated[int, Origin.BUDGET, "poses"] = 40
    """Most such poses at a time. Where the robot turns on the spot there would be more; then the
    oldest is final. 0: there are none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BearingRule:
    """When detections with bearings make a landmark; made of the other rules."""

    unmapped_per_m2: float  # how many landmarks per square metre may not be in the map yet
    frames_per_scan: int  # as how many frames a scan counts for the existence of a landmark
    fewest: int  # detections that a landmark needs
    if_unclear: int  # from how many on it is decided what they are of, where that is not certain


@dataclass(frozen=True, slots=True, kw_only=True)
class BackEndParameters:
    """All parameters of the back end."""

    wheels: WheelNoise = field(default_factory=WheelNoise)
    ranges: RangeNoise = field(default_factory=RangeNoise)
    continuation: ContinuationRule = field(default_factory=ContinuationRule)
    initialisation: InitialisationRule = field(default_factory=InitialisationRule)
    map: MapRule = field(default_factory=MapRule)
    walls: WallRule = field(default_factory=WallRule)
    radii: RadiusRule = field(default_factory=RadiusRule)
    relinearisation: RelinearisationRule = field(default_factory=RelinearisationRule)
    slips: SlipRule = field(default_factory=SlipRule)
    noise: NoiseRule = field(default_factory=NoiseRule)
    branches: BranchRule = field(default_factory=BranchRule)
    jumps: JumpNoise = field(default_factory=JumpNoise)
    imaged: ImagedPointRule = field(default_factory=ImagedPointRule)
    lag: LagRule = field(default_factory=LagRule)

    def bearings(self, *, of_patches: bool) -> BearingRule:
        """Return the rule for points of patches, or for detections of a sensor with bearings."""
        if of_patches:
            return BearingRule(
                unmapped_per_m2=self.imaged.unmapped_per_m2,
                frames_per_scan=self.imaged.frames_per_patch,
                fewest=self.imaged.new_patches,
                if_unclear=self.imaged.new_patches,
            )
        return BearingRule(
            unmapped_per_m2=self.ranges.unmapped_per_m2,
            frames_per_scan=1,
            fewest=self.initialisation.min_hits_per_radar,
            if_unclear=self.initialisation.min_frames,
        )
