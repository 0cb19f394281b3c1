"""Parameters of the robust back end: noise of wheels and radars, and the rules of its decisions.

The noise comes from specifications of the robot and of the front end; the rules are the same for
every scene. Lengths in metres, angles in radians.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from slam.config import WheelNoise


@dataclass(frozen=True, slots=True, kw_only=True)
class RangeNoise:
    """How one radar of the rig measures.

    Attributes
    ----------
    sigma_m
        Standard deviation of a range.
    association_sigma_m
        Added in squares to the front end's sigma of each range, wherever ranges are assigned: a
        neighbour's echo may shift it by so much. The ranges of a tracklet keep it.
    huber_sigmas
        Innovations of more standard deviations weigh less, as in Huber's estimator.
    offset_sigma_m
        Standard deviation of each radar's unknown constant range offset; zero if calibrated.
    detection_probability
        That a target in view is detected in a frame.
    clutter_per_m
        False ranges per radar, frame and metre of range.
    field_of_view_rad
        Full opening angle.
    min_range_m, max_range_m
        Where targets are detected.
    """

    sigma_m: float = 7.4e-3
    association_sigma_m: float = 0.0
    huber_sigmas: float = math.inf
    offset_sigma_m: float = 0.0
    detection_probability: float = 0.92
    clutter_per_m: float = 0.15 / 1.3
    field_of_view_rad: float = math.radians(65.0)
    min_range_m: float = 0.2
    max_range_m: float = 1.5


@dataclass(frozen=True, slots=True, kw_only=True)
class ContinuationRule:
    """When single ranges may continue a track.

    ``view_margin_rad`` widens the field of view. A landmark takes part while its predicted ranges
    are surer than ``tight_sigmas`` range standard deviations. ``gates`` bounds the squared
    Mahalanobis distance by the number of ranges, the last one for all higher numbers.
    """

    view_margin_rad: float = 0.25
    tight_sigmas: float = 1.0
    gates: tuple[float, ...] = (9.0, 13.8)


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackletRule:
    """When ranges that continue nothing are evidence of one point at rest.

    Attributes
    ----------
    window
        Frames looked back.
    min_frames, min_hits_per_radar, min_share
        Fewest distinct frames, fewest ranges of each radar, and the least share of the frames
        with the point in view that hit it.
    prior_sigma_m, gate_sigmas
        Spread about the first fix, and how far a member may lie from its prediction.
    drift_share
        Share of the wheels' scale error by which a frame grows uncertain with the way back to it.
    lever_m
        Lever by which turning back does.
    excess_sigmas
        How far chi-square may exceed its degrees of freedom, in its standard deviations.
    single_window, single_min_frames, single_max_sigma_m
        For a radar without a partner: frames looked back, fewest that hit, and the largest
        standard deviation in any direction with which a point is used.
    partner_silence
        After how many frames without its partner a radar counts as alone.
    """

    window: int = 15
    min_frames: int = 9
    min_hits_per_radar: int = 4
    min_share: float = 0.6
    prior_sigma_m: float = 0.3
    gate_sigmas: float = 3.0
    drift_share: float = 0.7
    lever_m: float = 0.3
    excess_sigmas: float = 3.1
    single_window: int = 40
    single_min_frames: int = 20
    single_max_sigma_m: float = 0.1
    partner_silence: int = 20


@dataclass(frozen=True, slots=True, kw_only=True)
class MapRule:
    """When a point is a known landmark, two landmarks are one, or a landmark is none.

    Attributes
    ----------
    unmapped_per_m2
        Density beta of landmarks not yet in the map: the likelihood of a match must exceed it.
    match_gate, match_margin
        Bound on d^2 of a point and a landmark (2 dof), and by how much ``d^2 + ln det S`` must
        beat the next.
    merge_every, merge_reach_m, merge_gate, merge_gate_joint, merge_margin
        Frames between looks, largest distance, bounds on d^2 of one merge and of two together
        (2 and 4 dof), and by how many nats a merge must beat its competitors.
    merge_sigma_m
        Noise of the statement that two landmarks are one.
    apart_frames
        Two landmarks seen whole in this many common frames are two.
    hit, miss, most, least
        Steps, ceiling and floor of a landmark's existence score.
    view_inset_rad, view_inset_m
        How far inside its limits a landmark must lie to be missed.
    report_hits
        Frames a landmark must have been hit in to be reported.
    """

    unmapped_per_m2: float = 1.0
    match_gate: float = 13.8
    match_margin: float = 6.0
    merge_every: int = 5
    merge_reach_m: float = 1.5
    merge_gate: float = 11.8
    merge_gate_joint: float = 18.5
    merge_margin: float = 3.0
    merge_sigma_m: float = 1e-5
    apart_frames: int = 3
    hit: float = 1.0
    miss: float = 1.5
    most: float = 20.0
    least: float = -8.0
    view_inset_rad: float = 0.1
    view_inset_m: float = 0.05
    report_hits: int = 9


@dataclass(frozen=True, slots=True, kw_only=True)
class WallRule:
    """When ranges are a wall's, and when a wall is a known one.

    Attributes
    ----------
    window, min_frames, min_way_m
        Frames looked back, fewest that hit, and how far the echo must have moved along the wall.
    wall_margin, point_margin
        By how much chi-square must be less under a law for a wall, or a point, to be believed.
    match_gate, match_margin
        Bound on d^2 of a wall seen and one mapped (2 dof), and by how much ``d^2 + ln det S`` must
        beat the next.
    unmapped_per_rad_m
        Density of walls not yet in the map: the likelihood of a match must exceed it.
    cell_m, reach_m
        Walls are known in cells of this length; how far from one of them what looks like the
        same wall may be that.
    resolution_m, resolution_rad
        A wall as near as this to a mapped one, and not it, is its echo merged with another: a
        pulse is longer than that.
    roughness_m
        Added in squares to the standard deviation of a known wall's single ranges: none is a mirror
        to a fraction of a millimetre, and within a Fresnel zone of its end the edge answers, too.
    """

    window: int = 40
    min_frames: int = 25
    min_way_m: float = 0.25
    wall_margin: float = 30.0
    point_margin: float = 0.0
    match_gate: float = 13.8
    match_margin: float = 6.0
    unmapped_per_rad_m: float = 0.3
    cell_m: float = 0.1
    reach_m: float = 1.0
    resolution_m: float = 0.05
    resolution_rad: float = 0.1
    roughness_m: float = 3e-3


@dataclass(frozen=True, slots=True, kw_only=True)
class RoundnessRule:
    """When a landmark is a round target and no point.

    Attributes
    ----------
    window, most_turn_rad
        Frames looked back, fewer if the robot turned by more than that since.
    min_ranges, min_way_m
        Fewest ranges, and least way between the first and the last.
    every
        Frames that hit a landmark between two looks at it.
    sigmas, largest_m
        How many standard deviations a radius must be from zero to be likely, and what none exceeds.
    margin
        By how much the cost of the solution over all poses must fall for it to be believed.
    sharper
        Share of the standard deviation at the last look that is worth another one.
    excess_sigmas
        How far chi-square may exceed its degrees of freedom, in its standard deviations.
    """

    window: int = 120
    most_turn_rad: float = 0.1
    min_ranges: int = 60
    min_way_m: float = 0.4
    every: int = 10
    sigmas: float = 3.0
    largest_m: float = 0.5
    margin: float = 9.0
    sharper: float = 0.9
    excess_sigmas: float = 3.1


@dataclass(frozen=True, slots=True, kw_only=True)
class RelinearisationRule:
    """When all poses that are kept are solved for again, and how.

    Attributes
    ----------
    most_poses, kept_share
        When more poses than this are kept, all but this share of it are condensed into a prior.
    turn_rad, shift_m
        How far the filter's pose may part from the stored trajectory.
    every
        Fewest frames between two solutions.
    iterations
        Most steps of one solution.
    outlier_sigmas, outliers_from
        Ranges further off than this are left out from that iteration on.
    """

    most_poses: int = 3000
    kept_share: float = 0.67
    turn_rad: float = 0.02
    shift_m: float = 0.04
    every: int = 20
    iterations: int = 10
    outlier_sigmas: float = 4.0
    outliers_from: int = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class SurpriseRule:
    """When the robot is not where the map has it.

    Attributes
    ----------
    gate_sigmas, most_sigma_m
        A range is near a prediction within so many standard deviations; predictions less sure than
        that are no evidence.
    view_inset_rad, view_inset_m
        How far inside a radar's limits a landmark must lie to be a trial.
    least_chance
        Least probability that a range lies near a prediction it has nothing to do with.
    most_against, most_for
        Most evidence [nats] that one landmark gives against the pose (it may have been taken away)
        and for it (other ranges may lie near its prediction for long).
    every, hypotheses
        Frames between two moments at which the robot may have been carried; how many are tested.
    suspicious, carried
        Evidence from which on nothing is undone for good, and from which on the robot is old_map.
    """

    gate_sigmas: float = 3.0
    most_sigma_m: float = 0.05
    view_inset_rad: float = 0.15
    view_inset_m: float = 0.1
    least_chance: float = 0.05
    most_against: float = 12.0
    most_for: float = 8.0
    every: int = 10
    hypotheses: int = 40
    suspicious: float = 2.0
    carried: float = 25.0


@dataclass(frozen=True, slots=True, kw_only=True)
class RelocationRule:
    """When a constellation of landmarks tells where on the map a robot was set down.

    Attributes
    ----------
    least_landmarks
        Fewest landmarks a join rests on.
    evidence, margin
        Least evidence [nats] of a join against all new landmarks, and over every other join.
    least_base_m, reach_m, turn_rad
        Least distance of two landmarks that a guess is made from, how far lengths and places may
        differ in a guess, and by how much two joins differ at least.
    most_tried
        Most guesses judged at a time.
    lost_position_m
        Standard deviation that is stated of the position while it is not known.
    """

    least_landmarks: int = 3
    evidence: float = 8.0
    margin: float = 8.0
    least_base_m: float = 0.3
    reach_m: float = 0.2
    turn_rad: float = 0.2
    most_tried: int = 200
    lost_position_m: float = 5.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PointRule:
    """How points with range and bearing find their landmarks.

    ``gate`` bounds d^2 of a match (2 dof, 99 %); what is farther than ``new_gate`` from every
    landmark is new; ``reach_m`` limits the search.
    """

    gate: float = 9.21
    new_gate: float = 25.0
    reach_m: float = 20.0


@dataclass(frozen=True, slots=True, kw_only=True)
class BackEndParameters:
    """All parameters of the back end."""

    wheels: WheelNoise = field(default_factory=WheelNoise)
    ranges: RangeNoise = field(default_factory=RangeNoise)
    continuation: ContinuationRule = field(default_factory=ContinuationRule)
    tracklets: TrackletRule = field(default_factory=TrackletRule)
    map: MapRule = field(default_factory=MapRule)
    surprise: SurpriseRule = field(default_factory=SurpriseRule)
    relocation: RelocationRule = field(default_factory=RelocationRule)
    walls: WallRule | None = field(default_factory=WallRule)
    roundness: RoundnessRule | None = field(default_factory=RoundnessRule)
    relinearisation: RelinearisationRule | None = field(default_factory=RelinearisationRule)
