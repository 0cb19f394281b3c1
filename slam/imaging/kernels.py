"""What is done for every profile, bin and point, compiled: sums of profiles, and reflectors.

Formulas and sources are in `slam.imaging.back_projection` and `slam.imaging.reflectors`. Places of
the latter are metres from the antenna in the middle of the patch, x along its boresight. Arrays
that many functions take:

signal
    Profiles, shape (frames, bins); their scale: range of bin 0 [m], bins per metre, entries of
    ``turns`` per metre of range, k [rad/m]; and ``turns``: exp(j x) at equal steps of one turn,
    their number a power of two.
track
    Shape (frames, 6): each antenna, and the unit vector of its boresight.
view
    Cosine of the angle off boresight up to which a point is seen, least and largest range [m].
beam
    Gain at equal steps of the cosine of the angle off boresight, 0 to 1.
place
    Shape (3,): range, bearing and curvature of one reflector.
work
    Ranges R_f, gains, echoes v_f and the model's a_f of one reflector, shape (frames,); written.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from slam.front_end.numba_compilation import kernel

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Signal = tuple[NDArray[np.complex64], Array, Complex]
Work = tuple[Array, Array, Complex, Complex]

_SIGNAL = "Tuple((complex64[:, ::1], float64[::1], complex128[::1]))"
_WORK = "Tuple((float64[::1], float64[::1], complex128[::1], complex128[::1]))"

ECHO_STEPS = 8  # samples of an echo per bin: `slam.imaging.range_profiles`
_STEP_BINS = 2.0  # of range, for the parabola through the logarithm
_MOST_BEARING, _MOST_CURVATURE = 0.02, 0.5  # of one move [rad], [1 / range]
_CURVATURE_STEP = 0.01  # of the difference quotient [1/m]
_ROWS_AWAY = 2  # rows of the image that one echo changes, on either side
_LEAST_COSINE = 0.4  # edge of the beam in the search
_BURST = 3.0  # see `remove_bursts`
_NEAR_M = 0.6  # farther walls are found from the place of a point
_WALL = 0.4  # curvature over that of a point: the model of a plane leaves less beside it


@kernel(
    f"void({_SIGNAL}, float64[:, ::1], float64[::1], float64[:, ::1], complex128[::1], "
    "float64[::1], int64[::1])"
)
def sum_profiles(
    signal: Signal,
    track: Array,
    view: Array,
    points: Array,
    total: Complex,
    power: Array,
    count: NDArray[np.int64],
) -> None:
    """Write the sums of profiles at points (n, 3); see `back_project`."""
    values, scale, turns = signal
    last, mask = values.shape[1] - 1, turns.shape[0] - 1
    start, per_bin, per_m = scale[0], scale[1], scale[2]
    cosine, min_m, max_m = view[0], view[1], view[2]
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        real, imag, square_sum, seen = 0.0, 0.0, 0.0, 0
        for f in range(track.shape[0]):
            dx, dy, dz = x - track[f, 0], y - track[f, 1], z - track[f, 2]
            range_m = math.sqrt(dx * dx + dy * dy + dz * dz)
            at = (range_m - start) * per_bin
            if not (0.0 <= at < last and min_m <= range_m <= max_m):
                continue
            if dx * track[f, 3] + dy * track[f, 4] + dz * track[f, 5] < cosine * range_m:
                continue
            low = int(at)
            part = at - low
            near, far = values[f, low], values[f, low + 1]
            u = near.real + part * (far.real - near.real)
            v = near.imag + part * (far.imag - near.imag)
            turn = turns[int(range_m * per_m + 0.5) & mask]
            real += u * turn.real - v * turn.imag
            imag += u * turn.imag + v * turn.real
            square_sum += u * u + v * v
            seen += 1
        total[i] = complex(real, imag)
        power[i] = square_sum
        count[i] = seen


@kernel("float64(float64, float64, float64)")
def way_difference(curvature: float, along: float, square: float) -> float:
    """Return how much longer the way to a reflector is from another place of the antenna.

    ``along`` is that place's distance towards the reflector, ``square`` its squared distance.
    """
    under = 1.0 - 2.0 * curvature * along + curvature * curvature * square
    return (curvature * square - 2.0 * along) / (1.0 + math.sqrt(max(0.0, under)))


@kernel("float64(float64, float64[::1])")
def beam_gain(cosine: float, beam: Array) -> float:
    return beam[int(cosine * (beam.shape[0] - 1) + 0.5)] if cosine > 0.0 else 0.0


@kernel(f"void({_SIGNAL}, float64[:, ::1], float64[::1], float64, {_WORK})")
def read_echoes(signal: Signal, track: Array, place: Array, further_m: float, work: Work) -> None:
    """Read what profiles have ``further_m`` behind one reflector; 0 out of the bins."""
    values, scale, turns = signal
    ranges, _, echoes, _ = work
    last, mask = values.shape[1] - 1, turns.shape[0] - 1
    ex, ey = math.cos(place[1]), math.sin(place[1])
    for f in range(track.shape[0]):
        x, y = track[f, 0], track[f, 1]
        r = place[0] + further_m + way_difference(place[2], x * ex + y * ey, x * x + y * y)
        ranges[f] = r
        at = (r - scale[0]) * scale[1]
        echoes[f] = 0.0
        if 0.0 <= at < last:
            low = int(at)
            part = at - low
            value = (1.0 - part) * values[f, low] + part * values[f, low + 1]
            echoes[f] = value * turns[int(r * scale[2] + 0.5) & mask]


@kernel(f"void({_SIGNAL}, float64[::1], float64[::1], complex128[::1], float64)")
def add_echoes(
    signal: Signal, echo: Array, ranges: Array, amplitudes: Complex, sign: float
) -> None:
    """Add ``sign`` times the echoes of one reflector to profiles."""
    values, scale, turns = signal
    mask, reach = turns.shape[0] - 1, (echo.shape[0] - 1) // ECHO_STEPS
    for f in range(ranges.shape[0]):
        turn = turns[int(ranges[f] * scale[2] + 0.5) & mask]
        value = sign * amplitudes[f] * turn.conjugate()
        if value == 0.0:
            continue
        at = (ranges[f] - scale[0]) * scale[1]
        first, end = max(0, int(at) - reach + 2), min(values.shape[1], int(at) + reach - 1)
        for b in range(first, end):
            steps = abs(b - at) * ECHO_STEPS
            low = int(steps)
            part = steps - low
            values[f, b] += value * ((1.0 - part) * echo[low] + part * echo[low + 1])


@kernel(f"void({_SIGNAL}, float64[:, ::1], float64[:, :, ::1], int64, int64, float64[:, ::1])")
def image_rows(
    signal: Signal, track: Array, cells: Array, first: int, end: int, image: Array
) -> None:
    """Put the energy that a point in each cell would explain into rows of an image.

    It is |S1|**2 / n at ``cells`` (rows, columns, 2), where the beam has an edge, at the cosine
    ``_LEAST_COSINE``, and is even within. In the plane, this takes three quarters of the time of
    `sum_profiles`.
    """
    values, scale, turns = signal
    last, mask = values.shape[1] - 1, turns.shape[0] - 1
    start, per_bin, per_m = scale[0], scale[1], scale[2]
    for i in range(max(0, first), min(image.shape[0], end)):
        for j in range(image.shape[1]):
            x, y = cells[i, j, 0], cells[i, j, 1]
            real, imag, count = 0.0, 0.0, 0
            for f in range(track.shape[0]):
                dx, dy = x - track[f, 0], y - track[f, 1]
                r = math.sqrt(dx * dx + dy * dy)
                at = (r - start) * per_bin
                if not 0.0 <= at < last or dx * track[f, 3] + dy * track[f, 4] < _LEAST_COSINE * r:
                    continue
                low = int(at)
                part = at - low
                near, far = values[f, low], values[f, low + 1]
                u = near.real + part * (far.real - near.real)
                v = near.imag + part * (far.imag - near.imag)
                turn = turns[int(r * per_m + 0.5) & mask]
                real += u * turn.real - v * turn.imag
                imag += u * turn.imag + v * turn.real
                count += 1
            image[i, j] = (real * real + imag * imag) / max(count, 1)


@kernel("void(complex64[:, ::1])")
def remove_bursts(values: NDArray[np.complex64]) -> None:
    """Set to 0 what is in one frame alone: pulses of other modules.

    That is a bin more than ``_BURST`` times as strong as in the four frames around its own: echoes
    move by less than a tenth of their width from frame to frame.
    """
    n = values.shape[0]
    squares = np.zeros(values.shape, dtype=np.float64)
    for f in range(n):
        for b in range(values.shape[1]):
            squares[f, b] = values[f, b].real ** 2 + values[f, b].imag ** 2
    for f in range(n):
        first = max(0, min(f - 2, n - 5))
        for b in range(values.shape[1]):
            largest = 0.0
            for other in range(first, min(n, first + 5)):
                if other != f:
                    largest = max(largest, squares[other, b])
            if squares[f, b] > _BURST * _BURST * largest:
                values[f, b] = 0.0


@kernel("int64(float64[:, ::1], float64[::1], float64[::1], float64)")
def strongest_cell(image: Array, rows_m: Array, floors: Array, least_over_level: float) -> int:
    """Return the cell whose energy, under the law of a rod, is largest; -1 if none stands out.

    It must be above the floor of its row, and stand out of the level of the image: the geometric
    mean, of noise alone 0.56 times the mean.
    """
    total, best, most = 0.0, -1, 0.0
    for i in range(image.shape[0]):
        for j in range(image.shape[1]):
            total += math.log(image[i, j] + 1e-300)
            at_1_m = image[i, j] * rows_m[i] ** 3
            if at_1_m > most and image[i, j] > floors[i]:
                best, most = i * image.shape[1] + j, at_1_m
    is_out = best >= 0 and image.flat[best] > least_over_level * math.exp(total / image.size)
    return best if is_out else -1


@kernel(f"float64(float64[:, ::1], float64[::1], float64[::1], {_WORK})")
def fit_amplitudes(track: Array, beam: Array, place: Array, work: Work) -> float:
    """Fit a_f = c b_f (1 + g t_f) to echoes, g real and t_f -1 to 1; return the energy of a."""
    _, gains, echoes, amplitudes = work
    n = track.shape[0]
    qx, qy = place[0] * math.cos(place[1]), place[0] * math.sin(place[1])
    w0, w1, w2 = 1e-30, 0.0, 1e-30
    s0, s1 = 0j, 0j
    for f in range(n):
        dx, dy = qx - track[f, 0], qy - track[f, 1]
        ahead = dx * track[f, 3] + dy * track[f, 4]
        gain = 0.0
        if echoes[f] != 0.0:
            gain = beam_gain(ahead / (math.sqrt(dx * dx + dy * dy) + 1e-9), beam)
        t = 2.0 * f / (n - 1.0) - 1.0
        gains[f] = gain
        w0 += gain * gain
        w1 += gain * gain * t
        w2 += gain * gain * t * t
        s0 += gain * echoes[f]
        s1 += gain * t * echoes[f]
    det = max(w0 * w2 - w1 * w1, 1e-9 * w0 * w2)
    c0, c1 = (w2 * s0 - w1 * s1) / det, (w0 * s1 - w1 * s0) / det
    square = c0.real * c0.real + c0.imag * c0.imag + 1e-300
    slope = min(1.0, max(-1.0, (c1 * c0.conjugate()).real / square))
    total, norm = 0j, 1e-30
    for f in range(n):
        gains[f] *= 1.0 + slope * (2.0 * f / (n - 1.0) - 1.0)
        total += gains[f] * echoes[f]
        norm += gains[f] * gains[f]
    for f in range(n):
        amplitudes[f] = total / norm * gains[f]
    return (total.real * total.real + total.imag * total.imag) / norm


@kernel(f"float64({_SIGNAL}, float64[:, ::1], float64[::1], float64[::1], int64, int64, {_WORK})")
def refine(
    signal: Signal, track: Array, beam: Array, place: Array, form: int, rounds: int, work: Work
) -> float:
    """Move a place to where a reflector explains the most energy; return how much.

    ``form`` 0: the curvature stays, 1: it is that of a point, 2: it is free.
    """
    _, scale, _ = signal
    _, _, echoes, amplitudes = work
    step_m = _STEP_BINS / scale[1]
    levels = np.zeros(3)
    for _ in range(rounds):
        if form == 1:
            place[2] = 1.0 / place[0]
        bearing, curvature = 0.0, 0.0
        for side in range(3):
            read_echoes(signal, track, place, ((side + 1) % 3 - 1) * step_m, work)
            if side == 0:
                fit_amplitudes(track, beam, place, work)
                ex, ey = math.cos(place[1]), math.sin(place[1])
                # Normal equations of phase = common + bearing b + curvature c, the common removed:
                # amplitudes are fitted, so the weighted mean of the phases is 0.
                w, wb, wc, wbb, wbc, wcc = 1e-30, 0.0, 0.0, 0.0, 0.0, 0.0
                yb, yc = 0.0, 0.0
                for f in range(track.shape[0]):
                    px, py = track[f, 0], track[f, 1]
                    along, across, square = px * ex + py * ey, py * ex - px * ey, px * px + py * py
                    under = 1.0 + place[2] * (place[2] * square - 2.0 * along)
                    b, c = scale[3] * across / math.sqrt(max(1e-6, under)), 0.0
                    if form == 2:
                        bend = way_difference(place[2] + _CURVATURE_STEP, along, square)
                        bend -= way_difference(place[2] - _CURVATURE_STEP, along, square)
                        c = -scale[3] * bend / (2.0 * _CURVATURE_STEP)
                    # Phase by which the echo is ahead of the model's, times its square
                    ahead = (echoes[f] * amplitudes[f].conjugate()).imag
                    weight = amplitudes[f].real ** 2 + amplitudes[f].imag ** 2
                    w += weight
                    wb += weight * b
                    wc += weight * c
                    wbb += weight * b * b
                    wbc += weight * b * c
                    wcc += weight * c * c
                    yb += ahead * b
                    yc += ahead * c
                wbb += 1e-12 - wb * wb / w
                wbc -= wb * wc / w
                wcc += 1e-12 - wc * wc / w
                if form == 2:
                    det = max(wbb * wcc - wbc * wbc, 1e-9 * wbb * wcc)
                    bearing = (wcc * yb - wbc * yc) / det
                    curvature = (wbb * yc - wbc * yb) / det
                else:
                    bearing = yb / wbb
            total = 0j
            for f in range(track.shape[0]):
                total += echoes[f] * amplitudes[f].conjugate()
            levels[side] = math.log(abs(total) + 1e-300)
        bend = levels[1] + levels[2] - 2.0 * levels[0]
        steps = 0.5 * (levels[2] - levels[1]) / bend if bend < -1e-9 else 0.0
        place[0] = max(step_m, place[0] + step_m * min(2.0, max(-2.0, steps)))
        place[1] += min(_MOST_BEARING, max(-_MOST_BEARING, bearing))
        most = _MOST_CURVATURE / place[0]
        place[2] += min(most, max(-most, curvature))
    if form == 1:
        place[2] = 1.0 / place[0]
    read_echoes(signal, track, place, 0.0, work)
    return fit_amplitudes(track, beam, place, work)


@kernel(
    f"Tuple((float64[:, ::1], complex128[:, ::1]))({_SIGNAL}, float64[:, ::1], float64[::1], "
    "float64[::1], float64[:, :, ::1], float64[::1], float64[::1], int64, UniTuple(float64, 5))"
)
def separate(
    signal: Signal,
    track: Array,
    beam: Array,
    echo: Array,
    cells: Array,
    rows_m: Array,
    bearings: Array,
    most: int,
    limits: tuple[float, float, float, float, float],
) -> tuple[Array, Complex]:
    """Take reflectors out of profiles, the strongest first; what is left stays in ``signal``.

    Return range, bearing, curvature, form, energy, and curvature where it is free, of each, shape
    (k, 6), and its amplitudes (k, frames). ``limits`` are those of `SeparationRule`.
    """
    least_over_level, least_share, beside_share, more_than_point, beside_m = limits
    n = track.shape[0]
    ranges, gains = np.zeros(n), np.zeros(n)
    echoes, amplitudes = np.zeros(n, dtype=np.complex128), np.zeros(n, dtype=np.complex128)
    work = (ranges, gains, echoes, amplitudes)
    found, models = np.zeros((most, 6)), np.zeros((most, n), dtype=np.complex128)
    all_ranges = np.zeros((most, n))
    place, other, bent = np.zeros(3), np.zeros(3), np.zeros(3)
    facing = 0.0
    row_m, strongest, count = rows_m[1] - rows_m[0], 0.0, 0
    floors = np.zeros(rows_m.size)
    image = np.empty((rows_m.size, bearings.size))
    remove_bursts(signal[0])
    image_rows(signal, track, cells, 0, rows_m.size, image)
    while count < most:
        top = strongest_cell(image, rows_m, floors, least_over_level)
        if top < 0:
            break
        i, j = top // image.shape[1], top % image.shape[1]
        before = image[i, j]
        place[:] = rows_m[i], bearings[j], 0.0
        energy = refine(signal, track, beam, place, 1, 3, work)
        strongest = max(strongest, energy * place[0] ** 3)
        if energy * place[0] ** 3 < least_share * least_share * strongest:
            break
        other[:] = place
        free = refine(signal, track, beam, other, 2, 4, work)
        if place[0] < _NEAR_M:
            # A near wall looks like several points: its normal may be at another bearing
            best = 0.0
            for bearing in bearings:
                bent[:] = place[0], bearing, 0.0
                plane = refine(signal, track, beam, bent, 0, 0, work)
                if plane > best:
                    best, facing = plane, bearing
            bent[:] = place[0], facing, 0.0
            best = refine(signal, track, beam, bent, 2, 4, work)
            if best > more_than_point * free:
                free = best
                other[:] = bent
        found[count, 3] = 1
        if free > more_than_point * energy:
            found[count, 3] = 2
            place[:] = other
        refine(signal, track, beam, place, 0, 0, work)
        add_echoes(signal, echo, ranges, amplitudes, -1.0)
        found[count, :3] = place
        all_ranges[count], models[count] = ranges, amplitudes
        count += 1
        middle = int((place[0] - rows_m[0]) / row_m + 0.5)
        floor = beside_share * beside_share * energy
        if place[0] * place[2] < _WALL:
            floor *= 0.25
        beside = int(beside_m / row_m)
        for row in range(max(0, middle - beside), min(rows_m.size, middle + beside + 1)):
            floors[row] = max(floors[row], floor)
        first, end = min(i, middle) - _ROWS_AWAY, max(i, middle) + _ROWS_AWAY + 1
        image_rows(signal, track, cells, first, end, image)
        if image[i, j] >= before:
            break
    for k in range(count):
        add_echoes(signal, echo, all_ranges[k], models[k], 1.0)
        other[:] = found[k, :3]
        refine(signal, track, beam, other, 2, 3, work)
        found[k, 5] = other[2]
        place[:] = found[k, :3]
        found[k, 4] = refine(signal, track, beam, place, int(found[k, 3]), 2, work)
        found[k, :3] = place
        models[k] = amplitudes
        add_echoes(signal, echo, ranges, amplitudes, -1.0)
    return found[:count], models[:count]
