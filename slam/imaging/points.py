"""Points and walls of a patch: which of its reflectors are what, and how well they are known.

Covariance
    Noise: the range of a pulse of deviation s is known to s / snr, its bearing to
    1 / (snr k L), L the deviation of the antenna's way across the line of sight (Kay 1993,
    Fundamentals of Statistical Signal Processing vol. 1, section 3.9; snr is that of the patch).
    Wheels: the least-squares bearing is a weighted sum of the phases, so of the errors of range at
    the frames. The increments of odometry between frames err independently, but for three constants
    (`slam.config.WheelNoise`); each error moves all antennas behind it, seen from the middle of the
    patch, so its share in the bearing is a sum over them.
Radius
    Range, bearing and curvature of the wavefront are one least-squares fit to the phases, so noise
    and wheels err in the curvature as in the bearing, with other weights.
Mirror images
    From a straight way, what is left of it and what is right of it look alike. Only the beam says
    which is there, and a beam along the way does not. Near the way the two are one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from slam.config import WheelNoise
from slam.geometry import mirrored
from slam.imaging.patches import Patch, seen_from
from slam.imaging.reflectors import Reflectors, SeparationRule

Array = NDArray[np.float64]

# From which way across the line of sight on a bearing is computed
_LEAST_SPREAD_M = 1e-6
_PULSE_M = 0.052  # s, of a module with 1.4 GHz
_ANY_RADIUS_M = 1e3  # standard deviation of a radius of which nothing is known


@dataclass(frozen=True, slots=True, kw_only=True)
class PointRule:
    """Which reflectors are points, and how well they are known."""

    separation: SeparationRule = field(default_factory=SeparationRule)
    wheels: WheelNoise = field(default_factory=WheelNoise)
    least_snr: float = 10.0
    least_in_view: float = 0.5  # share of the frames
    # Amplitude over that of the strongest that is no plane
    least_share: float = 0.2
    # Up to the first it is a point, up to the second something round, beyond the last a plane
    flatness: tuple[float, float, float] = (0.3, 0.5, 0.6)
    # Within this range of a stronger one, and a smaller share of it, it may be what the model of
    # that one leaves; twice the share where it is as near across the line of sight
    beside_m: float = 0.12
    beside_share: float = 0.25
    beside_wall_share: float = 0.1
    # Until the module's pulse is learnt, in place of both `beside_m`, of points and of separation,
    # and of the `beside_share` of separation; the former is also that of what is cut off
    unlearned_beside_m: float = 0.18
    unlearned_beside_share: float = 0.4
    # If a larger share of the samples of an echo is at a limit of the sampler (from 1.5 times the
    # limit on), its range is so uncertain
    most_cut: float = 0.3
    cut_sigma_m: float = 0.04
    most_fading: float = 0.4
    least_wall_share: float = 0.3  # size over that of the strongest reflector
    # Clutter that stays for some seconds goes along with the robot, as the echo of a wall does.
    least_wall_snr: float = 20.0
    # Along the way of the antenna, the wavefront of a plane is that of a point
    most_flatness_sigma: float = 0.25
    on_wall_share: float = 0.3
    image_m: float = 0.06  # this near to where an image would be, a reflector is one
    # A point and its mirror image look alike up to so many radians of phase (standard deviation)
    alike_rad: float = 1.0
    # and are two if their bearings differ by more than so many standard deviations
    two_sigmas: float = 4.0
    range_floor_m: float = 1e-3
    bearing_floor_rad: float = 1e-3
    # What the wavefronts of bodies that are no cylinders add to the deviation of flatness
    flatness_floor: float = 0.02


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PatchPoint:
    """A point in the frame of its patch.

    Attributes
    ----------
    x_m, y_m
        Body frame of the middle of the patch; of something round, its nearest surface.
    range_m, bearing_rad
        From the antenna in the middle of the patch, and off its boresight.
    sigma_m, bearing_sigma_rad
        Standard deviations of these; their errors are independent.
    amplitude
        Its largest in the patch, at 1 m under the law of a rod, in units of the frames.
    snr
        Root of its energy over what is left beside it.
    radius_m, radius_sigma_m
        Of something round, by the curvature of its wavefront, and the standard deviation of that.
    mirrored_rad
        Bearing of its mirror image across the way of the antenna, where that may be what is there,
        and its own where the two are one; None: it is on this side.
    """

    x_m: float
    y_m: float
    range_m: float
    bearing_rad: float
    sigma_m: float
    bearing_sigma_rad: float
    amplitude: float
    snr: float
    radius_m: float
    radius_sigma_m: float
    mirrored_rad: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PatchLine:
    """A flat face in the frame of its patch: n . x = d, from one end to the other.

    Attributes
    ----------
    normal
        Shape (2,), unit vector away from the antenna.
    distance_m
        d, from the origin of the patch.
    range_m, bearing_rad
        Of the foot of the perpendicular from the antenna in the middle of the patch.
    sigma_m, bearing_sigma_rad
        Standard deviations of these.
    ends_m
        Shape (2, 2): the feet of the perpendiculars from the first and the last antenna that saw
        it; the face may go on.
    """

    normal: Array
    distance_m: float
    range_m: float
    bearing_rad: float
    sigma_m: float
    bearing_sigma_rad: float
    ends_m: Array


def points_of(patch: Patch, reflectors: Reflectors, rule: PointRule) -> tuple[PatchPoint, ...]:
    """Return those of the reflectors of a patch that are points, the nearest first."""
    aperture = patch.aperture
    assert aperture.boresights is not None
    antenna, (bx, by) = aperture.antennas_m[patch.middle], aperture.boresights[patch.middle]
    turn = np.array([[bx, -by], [by, bx]])
    places = antenna + reflectors.places_m @ turn.T
    are_cut = _are_cut(patch, places, rule)
    is_point = _are_points(patch, reflectors, places, rule, are_cut)
    order = np.flatnonzero(is_point)[np.argsort(reflectors.range_m[is_point])]
    points = []
    for k in order.tolist():
        lines = places[k] - aperture.antennas_m
        lines /= np.linalg.norm(lines, axis=1, keepdims=True)
        sigma_m, bearing_sigma_rad = _sigmas(patch, reflectors, k, lines, rule)
        if bearing_sigma_rad > aperture.half_beam_rad:
            continue
        if are_cut[k]:
            sigma_m = math.hypot(sigma_m, rule.cut_sigma_m)
        range_m, bearing_rad = float(reflectors.range_m[k]), float(reflectors.bearing_rad[k])
        apart_rad = _way_to_mirror_rad(patch, places[k], rule)
        if apart_rad is not None and abs(apart_rad) <= rule.two_sigmas * bearing_sigma_rad:
            bearing_rad += 0.5 * apart_rad
            bearing_sigma_rad = math.hypot(bearing_sigma_rad, 0.5 * apart_rad)
            apart_rad = 0.0
            c, s = math.cos(bearing_rad), math.sin(bearing_rad)
            places[k] = antenna + range_m * (turn @ (c, s))
        radius_m, radius_sigma_m = _radius(patch, reflectors, k, lines, rule)
        points.append(
            PatchPoint(
                x_m=float(places[k, 0]),
                y_m=float(places[k, 1]),
                range_m=range_m,
                bearing_rad=bearing_rad,
                sigma_m=sigma_m,
                bearing_sigma_rad=bearing_sigma_rad,
                amplitude=float(reflectors.amplitude[k]),
                snr=float(reflectors.snr[k]),
                radius_m=radius_m,
                radius_sigma_m=radius_sigma_m,
                mirrored_rad=None if apart_rad is None else bearing_rad + apart_rad,
            )
        )
    return tuple(points)


def lines_of(patch: Patch, reflectors: Reflectors, rule: PointRule) -> tuple[PatchLine, ...]:
    """Return those of the reflectors of a patch that are walls, the nearest first."""
    aperture = patch.aperture
    assert aperture.boresights is not None
    antennas, (bx, by) = aperture.antennas_m, aperture.boresights[patch.middle]
    lines = []
    size = np.sqrt(reflectors.energy)
    is_wall = stand_out(reflectors, rule) & (reflectors.flatness > rule.flatness[2])
    is_wall &= size >= rule.least_wall_share * size.max(initial=0.0)
    is_wall &= reflectors.snr >= rule.least_wall_snr
    for k in np.argsort(reflectors.range_m).tolist():
        if not is_wall[k]:
            continue
        c, s = np.cos(reflectors.bearing_rad[k]), np.sin(reflectors.bearing_rad[k])
        normal = np.array([c * bx - s * by, s * bx + c * by])
        distance_m = float(normal @ antennas[patch.middle] + reflectors.range_m[k])
        feet = antennas + (distance_m - antennas @ normal)[:, np.newaxis] * normal
        if in_view(patch, feet[patch.middle][np.newaxis])[0] < rule.least_in_view:
            continue
        if _flatness(patch, reflectors, k, normal)[0] > rule.most_flatness_sigma:
            continue
        sight = np.broadcast_to(normal, antennas.shape)
        sigma_m, bearing_sigma_rad = _sigmas(patch, reflectors, k, sight, rule)
        if bearing_sigma_rad > aperture.half_beam_rad:
            continue
        lines.append(
            PatchLine(
                normal=normal,
                distance_m=distance_m,
                range_m=float(reflectors.range_m[k]),
                bearing_rad=float(reflectors.bearing_rad[k]),
                sigma_m=sigma_m,
                bearing_sigma_rad=bearing_sigma_rad,
                ends_m=feet[[0, -1]],
            )
        )
    return tuple(lines)


def _flatness(patch: Patch, reflectors: Reflectors, k: int, sight: Array) -> tuple[float, Array]:
    """Return the standard deviation of the flatness of a reflector in direction ``sight`` (2,).

    It is that of noise. Returns as well the flatness per error of the range at each frame [1/m],
    (n,). Range and bearing are fitted, too.
    """
    antennas, weights = patch.aperture.antennas_m, reflectors.levels[k]
    across = (antennas - antennas[patch.middle]) @ (-sight[1], sight[0])
    phases = patch.profiles.wave_number_rad_per_m * across**2 / (2 * reflectors.range_m[k])
    fitted = np.column_stack([np.ones_like(across), across]) * weights[:, np.newaxis]
    left = weights * phases
    left = left - fitted @ np.linalg.lstsq(fitted, left)[0]
    snr, of_shape = float(reflectors.snr[k]), float(left @ left)
    if snr * of_shape <= 0.0:
        return math.inf, np.zeros_like(left)
    sigma = float(np.linalg.norm(weights)) / (snr * math.sqrt(of_shape))
    return sigma, weights * left * patch.profiles.wave_number_rad_per_m / of_shape


def _radius(
    patch: Patch, reflectors: Reflectors, k: int, lines: Array, rule: PointRule
) -> tuple[float, float]:
    """Return the radius of a reflector [m] and its standard deviation.

    With f its flatness the centre of its wavefronts is r / (1 - f) away. ``lines`` (n, 2) are the
    directions to where it answers, at each antenna.
    """
    range_m, flatness = float(reflectors.range_m[k]), float(reflectors.flatness[k])
    of_noise, of_range = _flatness(patch, reflectors, k, lines[patch.middle])
    variance = of_noise**2 + rule.flatness_floor**2
    variance += _wheel_variance(patch, of_range[:, np.newaxis] * lines, rule.wheels)
    if not math.isfinite(variance):
        return 0.0, _ANY_RADIUS_M
    rest = max(1.0 - flatness, 0.5)  # less only where the flatness is not known
    return range_m * flatness / rest, range_m * math.sqrt(variance) / rest**2


def in_view(patch: Patch, places: Array) -> Array:
    """Return the share of the frames that have points (k, 2) in beam and range."""
    aperture = patch.aperture
    assert aperture.boresights is not None
    ways = places[:, np.newaxis] - aperture.antennas_m
    ranges_m = np.linalg.norm(ways, axis=2)
    ahead = np.sum(ways * aperture.boresights, axis=2)
    seen = ahead >= math.cos(aperture.half_beam_rad) * ranges_m
    seen &= (ranges_m >= aperture.min_range_m) & (ranges_m <= aperture.max_range_m)
    return np.asarray(seen.mean(axis=1))


def _way_to_mirror_rad(patch: Patch, place: Array, rule: PointRule) -> float | None:
    """Return the angle from a place (2,) to its mirror image across the way.

    It is seen from the antenna in the middle; None if what answers cannot be at the mirror image.
    """
    antennas = patch.aperture.antennas_m
    other = mirrored(place, antennas)
    one_m, other_m = (np.linalg.norm(at - antennas, axis=1) for at in (place, other))
    phases = patch.profiles.wave_number_rad_per_m * (one_m - other_m)
    is_alike = float(phases.std()) <= rule.alike_rad
    if not is_alike or in_view(patch, other[np.newaxis])[0] < rule.least_in_view:
        return None
    (ax, ay), (bx, by) = place - antennas[patch.middle], other - antennas[patch.middle]
    return math.atan2(ax * by - ay * bx, ax * bx + ay * by)


def _are_points(
    patch: Patch,
    reflectors: Reflectors,
    places: Array,
    rule: PointRule,
    are_cut: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    may_be, amplitude = reflectors.flatness <= rule.flatness[1], reflectors.amplitude
    # Where a face ends, its echo fades, and its wavefront is between that of a plane and a point.
    quarter = max(1, reflectors.levels.shape[1] // 4)
    first, last = (
        reflectors.levels[:, part].mean(axis=1)
        for part in (slice(0, quarter), slice(-quarter, None))
    )
    fades = np.abs(first - last) > rule.most_fading * (first + last)
    may_be &= ~fades | (reflectors.flatness <= rule.flatness[0])
    for k in np.flatnonzero(reflectors.flatness > rule.flatness[1]).tolist():
        sight = (places[k] - patch.aperture.antennas_m[patch.middle]) / reflectors.range_m[k]
        may_be[k] |= _flatness(patch, reflectors, k, sight)[0] > rule.most_flatness_sigma
    chosen = may_be & (amplitude >= rule.least_share * amplitude.max(where=may_be, initial=0.0))
    chosen &= stand_out(reflectors, rule, are_cut)
    chosen &= in_view(patch, places) >= rule.least_in_view
    return np.asarray(chosen & ~_are_images(reflectors, rule))


def _are_cut(patch: Patch, places: Array, rule: PointRule) -> NDArray[np.bool_]:
    """Return which places (k, 2) have echoes of which the sampler has cut off too much.

    What is left of such an echo may be beside its place, and look like two or three.
    """
    if patch.cut is None:
        return np.zeros(len(places), dtype=np.bool_)
    profiles, n_bins = patch.profiles, patch.cut.shape[1]
    n_cut = np.zeros((len(patch.cut), n_bins + 1), dtype=np.int64)
    n_cut[:, 1:] = np.cumsum(patch.cut, axis=1)
    ranges_m = np.linalg.norm(places[:, np.newaxis] - patch.aperture.antennas_m, axis=2)
    ends_m = ranges_m + 0.5 * rule.beside_m * np.array([-1.0, 1.0])[:, np.newaxis, np.newaxis]
    ends = np.ceil((ends_m - profiles.range_start_m) / profiles.bin_length_m).astype(np.int64)
    first, end = np.clip(ends, 0, n_bins)
    frames = np.arange(len(n_cut))
    n_near = n_cut[frames, end] - n_cut[frames, first]
    return np.asarray(n_near.sum(axis=1) > rule.most_cut * (end - first).sum(axis=1))


def stand_out(
    reflectors: Reflectors, rule: PointRule, are_cut: NDArray[np.bool_] | None = None
) -> NDArray[np.bool_]:
    """Return which reflectors are more than noise and what stronger ones beside them leave."""
    size, range_m = np.sqrt(reflectors.energy), reflectors.range_m
    xy = reflectors.places_m
    apart_m = np.abs(range_m[:, np.newaxis] - range_m)
    is_beside = apart_m < rule.beside_m
    is_near = np.linalg.norm(xy[:, np.newaxis] - xy, axis=2) < rule.beside_m
    share = np.where(is_near, 2 * rule.beside_share, rule.beside_share)
    share = np.where(reflectors.flatness > rule.flatness[2], rule.beside_wall_share, share)
    if are_cut is not None:
        either_cut = are_cut[:, np.newaxis] | are_cut
        is_beside |= either_cut & (apart_m < rule.unlearned_beside_m)
        share = np.where(either_cut, 1.0, share)
    is_less = np.any(is_beside & (size[:, np.newaxis] < share * size), axis=1)
    return np.asarray((reflectors.snr >= rule.least_snr) & ~is_less)


def _are_images(reflectors: Reflectors, rule: PointRule) -> NDArray[np.bool_]:
    """Return which reflectors lie where a wall of the patch shows another one.

    With q' the mirror image of q, waves that meet the wall on one way only come from the range
    (|q| + |q'|) / 2 and the mean of the directions of q and q', those that meet it twice from q'.
    What is weak and lies on a wall may be what the model leaves of it.
    """
    is_wall = stand_out(reflectors, rule) & (reflectors.flatness > rule.flatness[2])
    xy, range_m, size = reflectors.places_m, reflectors.range_m, np.sqrt(reflectors.energy)
    are = np.zeros(range_m.size, dtype=np.bool_)
    for wall in np.flatnonzero(is_wall).tolist():
        distance_m, size_of_wall = range_m[wall], size[wall]
        normal = xy[wall] / distance_m
        before_m = distance_m - xy @ normal
        are |= (np.abs(before_m) < rule.image_m) & (size < rule.on_wall_share * size_of_wall)
        is_before = (before_m > rule.image_m) & ~is_wall
        mirrored = xy[is_before] + 2 * before_m[is_before, np.newaxis] * normal
        far_m = np.linalg.norm(mirrored, axis=1)
        once = xy[is_before] / range_m[is_before, np.newaxis] + mirrored / far_m[:, np.newaxis]
        once /= np.linalg.norm(once, axis=1, keepdims=True)
        once *= 0.5 * (range_m[is_before] + far_m)[:, np.newaxis]
        images = np.vstack([mirrored, once])
        off_m = np.linalg.norm(xy[:, np.newaxis] - images, axis=2)
        are |= off_m.min(axis=1, initial=math.inf) < rule.image_m
    return are


def _sigmas(
    patch: Patch, reflectors: Reflectors, k: int, lines: Array, rule: PointRule
) -> tuple[float, float]:
    """Return the standard deviations of range [m] and bearing [rad] of a reflector.

    ``lines`` (n, 2) are the directions to where it answers, at each antenna. The bearing of what
    was in the beam from one place only, or along one line, is not known.
    """
    profiles, antennas = patch.profiles, patch.aperture.antennas_m
    sight = lines[patch.middle]
    across = np.array([-sight[1], sight[0]])
    weights = reflectors.levels[k] ** 2
    # Ranges change with the bearing by the way across; a common phase is fitted, too.
    lever = -(antennas - antennas[patch.middle]) @ across
    lever -= np.average(lever, weights=weights)
    spread = math.sqrt(float(np.average(lever**2, weights=weights)))
    snr = float(reflectors.snr[k])
    sigma_m = math.hypot(_PULSE_M / snr, rule.range_floor_m)
    if spread < _LEAST_SPREAD_M:
        return sigma_m, math.inf
    of_range = weights * lever / float(weights @ lever**2)  # bearing per error of each range
    bearing = (1 / (snr * profiles.wave_number_rad_per_m * spread)) ** 2
    bearing += _wheel_variance(patch, of_range[:, np.newaxis] * lines, rule.wheels)
    bearing += rule.bearing_floor_rad**2
    return sigma_m, math.sqrt(bearing)


def _wheel_variance(patch: Patch, pulls: Array, wheels: WheelNoise) -> float:
    """Return the variance of a sum over frames of -pulls (n, 2) . errors of the antennas.

    Steps are those from frame to frame; the frame in the middle has no error.
    """
    poses, antennas, middle = patch.poses, patch.aperture.antennas_m, patch.middle
    steps = seen_from(poses[:-1], poses[1:])
    # What each step moves: all behind it, or, before the middle, all ahead of it, the other way
    moment = pulls[:, 1] * antennas[:, 0] - pulls[:, 0] * antennas[:, 1]
    rows = np.column_stack([pulls, moment])
    behind = np.cumsum(rows[::-1], axis=0)[::-1]
    moved = np.where(
        (np.arange(len(steps)) >= middle)[:, np.newaxis], behind[1:], behind[1:] - behind[0]
    )
    c, s = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
    along, left = moved[:, 0] * c + moved[:, 1] * s, moved[:, 1] * c - moved[:, 0] * s
    turned = moved[:, 2] - (moved[:, 1] * poses[1:, 0] - moved[:, 0] * poses[1:, 1])
    moved_by = np.column_stack([along, left, turned])
    white = float(np.sum((moved_by * wheels.step_sigmas(steps)) ** 2))
    way = np.hypot(steps[:, 0], steps[:, 1])
    constants = (
        float(np.sum(moved_by[:, :2] * steps[:, :2])),
        float(turned @ steps[:, 2]),
        float(turned @ way),
    )
    return white + sum(
        (sigma * value) ** 2
        for sigma, value in zip(wheels.calibration_sigmas, constants, strict=True)
    )
