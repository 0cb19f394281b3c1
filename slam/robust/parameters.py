"""Parameters of the robust back end: noise of wheels and radars, and the rules of its decisions.

The noise comes from specifications of the robot and of the front end; the rules are the same for
every scene.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from slam.config import WheelNoise
from slam.geometry import FieldOfView

# Probability that a test rejects what is true
TAIL_PROBABILITY = 1e-3
# Logarithm of how many times likelier than any other an explanation must be: twenty times
MARGIN_NATS = 3.0


def chi_square_limit(dof: int, excess_sigmas: float) -> float:
    """Return the limit that lies some standard deviations of chi-square above its mean."""
    return dof + excess_sigmas * math.sqrt(2.0 * max(dof, 0))


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeNoise:
    """How one radar of the rig measures."""

    sigma_m: float = 7.4e-3  # standard deviation of a range
    # Added in squares to the front end's sigma of each range, wherever ranges are assigned: a
    # neighbour's echo may shift it by so much. The ranges of a tracklet keep it.
    association_sigma_m: float = 0.0
    # Innovations of more standard deviations weigh less, as in Huber's estimator
    huber_sigmas: float = math.inf
    # Standard deviation of each radar's unknown constant range offset; zero if calibrated
    offset_sigma_m: float = 0.0
    # Standard deviations of the antennas' places, per axis, and of landmarks' radii about zero; a
    # zero takes the unknowns out of the state
    mount_sigma_m: float = 0.0
    radius_sigma_m: float = 0.0
    # `RangeErrors.variance_share` until the ranges of the run show it
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
class ContinuationRule:
    """When single ranges may continue a track."""

    view_margin_rad: float = 0.25  # widens the field of view
    # A landmark takes part while its predicted ranges are surer than so many range deviations
    tight_sigmas: float = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackletRule:
    """When ranges that continue nothing are evidence of one point at rest."""

    window: int = 15  # frames looked back
    # Fewest distinct frames, fewest ranges of each radar, and the least share of the frames with
    # the point in view that hit it
    min_frames: int = 9
    min_hits_per_radar: int = 4
    min_share: float = 0.6
    # Spread about the first fix, and how far a member may lie from its prediction
    prior_sigma_m: float = 0.3
    gate_sigmas: float = 3.0
    # Share of the wheels' scale error by which a frame grows uncertain with the way back to it
    drift_share: float = 0.7
    lever_m: float = 0.3  # lever by which turning back does
    # How far chi-square may exceed its degrees of freedom, in its standard deviations
    excess_sigmas: float = 3.1
    # For a radar without a partner: frames looked back, fewest that hit, and the largest standard
    # deviation in any direction with which a point is used
    single_window: int = 40
    single_min_frames: int = 20
    single_max_sigma_m: float = 0.1
    partner_silence: int = 20  # a radar whose partner has sent nothing for so many frames is single


@dataclass(frozen=True, slots=True, kw_only=True)
class MapRule:
    """When a point is a known landmark, two landmarks are one, or a landmark is none."""

    merge_every: int = 5  # frames between looks
    merge_reach_m: float = 1.5  # largest distance of two that may be one
    merge_sigma_m: float = 1e-5  # noise of the statement that two landmarks are one
    refused_updates: int = 200  # after which a merge that the run did not allow is tried again
    apart_frames: int = 3  # two landmarks seen whole in this many common frames are two
    # Steps, ceiling and floor of a landmark's existence score
    hit: float = 1.0
    miss: float = 1.5
    most: float = 20.0
    least: float = -8.0
    # How far inside its limits a landmark must lie to be missed
    view_inset_rad: float = 0.1
    view_inset_m: float = 0.05
    report_hits: int = 9  # frames a landmark must have been hit in to be reported


@dataclass(frozen=True, slots=True, kw_only=True)
class WallRule:
    """When ranges are a wall's, and when a wall is a known one."""

    # Frames looked back, fewest that hit, and how far the echo must have moved along the wall
    window: int = 40
    min_frames: int = 25
    min_way_m: float = 0.25
    # By how much chi-square must be less under a law for a wall, or a point, to be believed
    wall_margin: float = 30.0
    point_margin: float = 0.0
    # Walls are known in cells of this length; how far from one of them what looks like the same
    # wall may be that
    cell_m: float = 0.1
    reach_m: float = 1.0
    # A wall as near as this to a mapped one, and not it, is its echo merged with another: a pulse
    # is longer than that
    resolution_m: float = 0.05
    resolution_rad: float = 0.1
    # Added in squares to the standard deviation of a known wall's single ranges: none is a mirror
    # to a fraction of a millimetre, and within a Fresnel zone of its end the edge answers, too
    roughness_m: float = 3e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class RelinearisationRule:
    """When the whole run is solved for again, and how."""

    # Way and turn from one keyframe to the next
    key_m: float = 0.05
    key_rad: float = 0.1
    # How far the filter's pose may part from the stored trajectory
    turn_rad: float = 0.02
    shift_m: float = 0.04
    every: int = 20  # fewest frames between two solutions
    # Most frames between two, and as a share of the run: all solutions together cost in proportion
    # to it then
    at_least_every: int = 50
    run_share: float = 0.1
    iterations: int = 10  # most steps of one solution
    # Ranges further off than this are left out from that iteration on
    outlier_sigmas: float = 4.0
    outliers_from: int = 3
    # Standard deviations of a slip, how many steps there are to one, and from which iteration on
    # there are any
    slip_m: float = 0.015
    slip_rad: float = math.radians(2.0)
    steps_per_slip: float = 100.0
    slips_from: int = 2


@dataclass(frozen=True, slots=True, kw_only=True)
class BranchRule:
    """When the robot may have been carried, and when that is believed."""

    # A landmark is missed if no range lies within so many standard deviations, that of the model
    # included: what the scattering centre of a body may wander, added in squares
    miss_sigmas: float = 3.0
    model_sigma_m: float = 0.01
    # Over so many steps the errors of the ranges of one target are correlated: their evidence is
    # divided by that number
    correlated_steps: float = 2.0
    # Most evidence [nats] that one landmark gives against a place (it may have been taken away) and
    # for it (other ranges may lie near its prediction for long)
    most_against: float = 12.0
    most_for: float = 9.0
    # Evidence [nats] against the pose from which on another place is looked for, from which on the
    # robot is lost, and by which a place must be likelier to be adopted
    suspicious: float = 12.0
    carry_price: float = 20.0
    steps: int = 15  # over which a place proves itself
    lost_steps: int = 100  # the last so many decide whether the robot is lost, or at a place
    carry_steps: int = 1000  # after which the question is dropped, unless a place is on trial
    # Fewest landmarks that place a map on another, and how far lengths and places may
    # differ in a guess
    least_landmarks: int = 3
    reach_m: float = 0.2
    # Standard deviation reported for the position while the robot is lost
    lost_position_m: float = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PointRule:
    """How points with range and bearing find their landmarks."""

    gate: float = 9.21  # bound on d^2 of a match (2 dof, 99 %)
    new_gate: float = 25.0  # d^2 to every landmark from which on a point is new
    reach_m: float = 20.0  # limit of the search


@dataclass(frozen=True, slots=True, kw_only=True)
class BackEndParameters:
    """All parameters of the back end."""

    wheels: WheelNoise = field(default_factory=WheelNoise)
    ranges: RangeNoise = field(default_factory=RangeNoise)
    continuation: ContinuationRule = field(default_factory=ContinuationRule)
    tracklets: TrackletRule = field(default_factory=TrackletRule)
    map: MapRule = field(default_factory=MapRule)
    branches: BranchRule = field(default_factory=BranchRule)
    walls: WallRule = field(default_factory=WallRule)
    relinearisation: RelinearisationRule = field(default_factory=RelinearisationRule)
