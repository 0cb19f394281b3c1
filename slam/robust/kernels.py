"""Loops of the back end over single ranges, compiled at their first call.

Plain functions of numbers and C-contiguous arrays; the signature of each is explicit, so that it is
compiled once and kept on disk. Nothing is reordered (no ``fastmath``): same input, same bits.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from slam.front_end.numba_compilation import kernel

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

# Products of two smaller entries of a substitution are denormal, a hundred times slower.
_LEAST_ENTRY = 1e-60


@kernel(
    "Tuple((f8[:,:,::1], i8[:,::1], b1[:,:,::1], b1[:,::1], f8[:,::1]))"
    "(f8[:,::1], f8[:,::1], f8[:,:,::1], f8[:,:,::1], f8[:,:,::1], i8[::1], i8[::1], i8[::1],"
    " f8[::1], f8[:,::1], b1[::1], i8[::1], f8[:,::1], f8[:,::1], f8[:,::1], b1[:,::1], f8[::1])"
)
def assign(
    predicted: Array,
    off_boresight: Array,
    directions: Array,
    by_feature: Array,
    by_mount: Array,
    rows: Indices,
    first: Indices,
    widths: Indices,
    added: Array,
    block: Array,
    has_frame: NDArray[np.bool_],
    sides: Indices,
    ranges: Array,
    variances: Array,
    blurred: Array,
    barred: NDArray[np.bool_],
    limits: Array,
) -> tuple[Array, Indices, NDArray[np.bool_], NDArray[np.bool_], Array]:
    """Return which range of each radar is of which of some landmarks, at the least cost.

    What is predicted is given for all r radars and n landmarks, shapes (r, n) and (r, n, 2);
    ``rows`` (c,) are those that may be in view, ``first`` and ``widths`` (c,) their columns in the
    covariance ``block``, behind two of the position, r offsets and, if ``by_mount`` is not empty,
    2 r of the mounts; ``added`` (c,) are variances of their ranges. ``ranges``, with their
    ``variances``, and ``blurred`` are NaN beyond those of a radar, shapes (r, k) and (r, b). What a
    radar ranges is never taken for what is ``barred`` (r, n), but may hide that it is missed.
    ``limits`` are half the field of view and the limits of range; the angle and the length by which
    they are widened, and by which they are narrowed; the variance of a sure prediction; bounds on
    d^2 for one range and for more; cost of a range before its density; the noise of a range and how
    many standard deviations it may lie off; the length within which echoes blur.

    Returns H P H^T between the radars of each landmark, with the variances added, (c, r, r); the
    assignment, rows of radar, index and place in ``rows``; of each side and landmark (s, c, 2)
    whether it took part, and whether it was missed; of each landmark and radar (c, r) whether it is
    surely in view and not heard; and the rows H of the assignment.
    """
    half_view, shortest, longest, wide_rad, wide_m = (
        limits[0],
        limits[1],
        limits[2],
        limits[3],
        limits[4],
    )
    n_radars, n_rows = len(predicted), len(rows)
    n_sides, n_ranges, n_columns = 0, ranges.shape[1], len(block)
    for radar in range(n_radars):
        n_sides = max(n_sides, sides[radar] + 1)
    entries = np.zeros((n_radars, n_rows, 8))
    columns = np.zeros((n_radars, n_rows, 8), dtype=np.int64)
    prior = np.zeros((n_rows, n_radars, n_radars))
    status = np.zeros((n_sides, n_rows, 2), dtype=np.bool_)
    unheard = np.zeros((n_rows, n_radars), dtype=np.bool_)
    chosen = np.empty((n_radars * n_ranges, 3), dtype=np.int64)
    n_chosen = 0
    for c in range(n_rows):
        for radar in range(n_radars):
            n = rows[c]
            entries[radar, c, 2], columns[radar, c, 2] = 1.0, 2 + radar
            for axis in range(2):
                entries[radar, c, axis] = -directions[radar, n, axis]
                columns[radar, c, axis] = axis
                if len(by_mount):
                    entries[radar, c, 3 + axis] = by_mount[radar, n, axis]
                    columns[radar, c, 3 + axis] = 2 + n_radars + 2 * radar + axis
                entries[radar, c, 5 + axis] = by_feature[radar, n, axis]
                columns[radar, c, 5 + axis] = first[c] + axis
            if widths[c] == 3:
                entries[radar, c, 7], columns[radar, c, 7] = -1.0, first[c] + 2
    radars = np.empty(n_radars, dtype=np.int64)
    part = np.empty(n_rows, dtype=np.int64)
    near_of = np.empty((n_rows, n_radars, n_ranges), dtype=np.int64)
    count_of = np.empty((n_rows, n_radars), dtype=np.int64)
    begin = np.zeros(n_rows + 1, dtype=np.int64)
    root, whitened = np.empty((n_radars, n_radars)), np.empty(n_radars)
    bound, spent = np.zeros(n_rows + 1), np.zeros(n_rows + 1)
    choice, best_choice = np.zeros(n_rows + 1, dtype=np.int64), np.zeros(n_rows, dtype=np.int64)
    in_use = np.zeros((n_radars, n_ranges), dtype=np.bool_)
    for side in range(n_sides):
        m = 0
        for radar in range(n_radars):
            if sides[radar] == side and has_frame[radar]:
                radars[m] = radar
                m += 1
        n_part, n_options = 0, 0
        for c in range(n_rows):
            n = rows[c]
            near, well, sure, silent, hidden = False, True, True, True, False
            for place in range(m):
                i = radars[place]
                off, range_m = abs(off_boresight[i, n]), predicted[i, n]
                if off <= half_view + wide_rad and shortest - wide_m <= range_m <= longest + wide_m:
                    near = True
                unheard[c, i] = off <= half_view - limits[5]
                if range_m < shortest + limits[6] or range_m > longest - limits[6]:
                    unheard[c, i] = False
                well = well and unheard[c, i]
            if not near:
                for place in range(m):
                    unheard[c, radars[place]] = False
                continue
            product = 1
            for place in range(m):
                i = radars[place]
                for other in range(place, m):
                    j = radars[other]
                    value = 0.0
                    for a in range(8):
                        for b in range(8):
                            value += (
                                entries[i, c, a]
                                * block[columns[i, c, a], columns[j, c, b]]
                                * entries[j, c, b]
                            )
                    prior[c, i, j] = value
                    prior[c, j, i] = value
                if prior[c, i, i] > limits[7]:
                    sure = False
                prior[c, i, i] += added[c]
                if prior[c, i, i] > limits[6] * limits[6]:
                    unheard[c, i] = False
                reach = limits[12] * math.sqrt(prior[c, i, i] + limits[11] * limits[11])
                count = 0
                for k in range(n_ranges):
                    away = abs(ranges[i, k] - predicted[i, n])
                    if away <= reach:
                        unheard[c, i] = False
                        hidden = hidden or barred[i, n]
                    if barred[i, n]:
                        continue
                    if away * away <= limits[9] * (prior[c, i, i] + variances[i, k]):
                        near_of[n_part, place, count] = k
                        count += 1
                count_of[n_part, place] = count
                product *= count + 1
                for k in range(blurred.shape[1]):
                    away = abs(blurred[i, k] - predicted[i, n])
                    if away <= limits[13] + reach:
                        unheard[c, i] = False
                    if away <= limits[13]:
                        hidden = True
                silent = silent and unheard[c, i]
            status[side, c, 0] = sure
            if sure:
                status[side, c, 1] = well and not hidden
                part[n_part] = c
                n_part += 1
                n_options += product
            else:
                status[side, c, 1] = silent
        # All options, combinations of one range or none of each radar, landmark by landmark
        costs = np.empty(n_options)
        taken = np.empty((n_options, m), dtype=np.int64)
        n_options = 0
        for at_part in range(n_part):
            c = part[at_part]
            n = rows[c]
            product = 1
            for place in range(m):
                product *= count_of[at_part, place] + 1
            for option in range(product):
                rest, used = option, 0
                for place in range(m):
                    count = count_of[at_part, place] + 1
                    number = rest % count
                    rest //= count
                    taken[n_options, place] = -1
                    if number == 0:
                        continue
                    # One more row of the Cholesky factor, and of the whitened innovation
                    i, k = radars[place], near_of[at_part, place, number - 1]
                    nu = ranges[i, k] - predicted[i, n]
                    variance = prior[c, i, i] + variances[i, k]
                    before = 0
                    for other in range(place):
                        if taken[n_options, other] >= 0:
                            value = prior[c, i, radars[other]]
                            for b in range(before):
                                value -= root[used, b] * root[before, b]
                            value /= root[before, before]
                            root[used, before] = value
                            variance -= value * value
                            nu -= value * whitened[before]
                            before += 1
                    root[used, used] = math.sqrt(variance)
                    whitened[used] = nu / root[used, used]
                    taken[n_options, place] = k
                    used += 1
                cost, distance = used * limits[10], 0.0
                for b in range(used):
                    distance += whitened[b] * whitened[b]
                    cost += 2.0 * math.log(root[b, b])
                cost += distance
                gate = limits[8] if used == 1 else limits[9]
                if used and (cost >= 0.0 or distance > gate):
                    continue
                costs[n_options] = cost
                # In order of cost; the one without any range costs nothing and is the last
                place = n_options
                while place > begin[at_part] and costs[place - 1] > costs[place]:
                    costs[place - 1], costs[place] = costs[place], costs[place - 1]
                    for other in range(m):
                        k = taken[place, other]
                        taken[place, other] = taken[place - 1, other]
                        taken[place - 1, other] = k
                    place -= 1
                n_options += 1
            begin[at_part + 1] = n_options
        # Branch and bound: the bound on what is to come is the sum of the cheapest
        bound[n_part] = 0.0
        for at_part in range(n_part - 1, -1, -1):
            bound[at_part] = bound[at_part + 1] + costs[begin[at_part]]
        best = math.inf
        depth = 0
        choice[0] = 0
        while depth >= 0:
            option = choice[depth]
            if depth == n_part:
                if spent[depth] < best:
                    best = spent[depth]
                    for at_part in range(n_part):
                        best_choice[at_part] = choice[at_part]
                is_end = True
            else:
                is_end = option >= begin[depth + 1]
                if not is_end:
                    is_end = spent[depth] + costs[option] + bound[depth + 1] >= best
            if is_end:
                depth -= 1
                if depth >= 0:
                    for place in range(m):
                        k = taken[choice[depth], place]
                        if k >= 0:
                            in_use[place, k] = False
                    choice[depth] += 1
                continue
            free = True
            for place in range(m):
                k = taken[option, place]
                if k >= 0 and in_use[place, k]:
                    free = False
            if free:
                for place in range(m):
                    k = taken[option, place]
                    if k >= 0:
                        in_use[place, k] = True
                spent[depth + 1] = spent[depth] + costs[option]
                depth += 1
                choice[depth] = begin[depth]
            else:
                choice[depth] += 1
        for at_part in range(n_part):
            c = part[at_part]
            for place in range(m):
                k = taken[best_choice[at_part], place]
                if k >= 0:
                    chosen[n_chosen, 0] = radars[place]
                    chosen[n_chosen, 1] = k
                    chosen[n_chosen, 2] = c
                    n_chosen += 1
                    status[side, c, 1] = False
    H = np.zeros((n_chosen, n_columns))
    for k in range(n_chosen):
        for a in range(8):
            H[k, columns[chosen[k, 0], chosen[k, 2], a]] += entries[chosen[k, 0], chosen[k, 2], a]
    return prior, chosen[:n_chosen], status, unheard, H


@kernel(
    "Tuple((f8[:,::1], f8[::1], f8[::1], f8[::1]))"
    "(f8[:,::1], i8[::1], f8[:,::1], f8[::1], f8[::1], f8, f8)"
)
def weigh(
    covariance: Array,
    at: Indices,
    H: Array,
    innovations: Array,
    variances: Array,
    huber: float,
    share: float,
) -> tuple[Array, Array, Array, Array]:
    """Return the gain of k measurements, those far off weighted by Huber.

    ``covariance`` (m, c) are the columns ``at`` (c,) of P, for which H (k, c) has entries. With
    S = H P H^T + R = L L^T: first for the ``variances`` R as they are, then with those enlarged
    whose innovations exceed ``huber`` standard deviations, so that the information falls by Huber's
    weight and what they move grows no further, and all then multiplied by ``share``, for ranges of
    one passage err alike. Source: Huber, Annals of Mathematical Statistics 35(1), 1964.

    Returns W = P H^T L^-T (m, k) and L^-1 innovations, both with the weights; and without, L^-1
    innovations and the diagonal of L.
    """
    m, k = len(covariance), len(innovations)
    gain, prior = np.zeros((m, k)), np.zeros((k, k))
    white, weighted, scale = np.empty(k), np.empty(k), np.empty(k)
    L = np.zeros((k, k))
    for i in range(k):
        for c in range(len(at)):
            h = H[i, c]
            if h != 0.0:
                for row in range(m):
                    gain[row, i] += h * covariance[row, c]
    for i in range(k):
        for c in range(len(at)):
            h = H[i, c]
            if h != 0.0:
                for j in range(k):
                    prior[i, j] += h * gain[at[c], j]
    for again in range(2):
        for i in range(k):
            nu = innovations[i]
            variance = variances[i]
            whole = prior[i, i] + variance
            excess = abs(nu) / (huber * math.sqrt(whole))
            if again == 1 and excess > 1.0:
                variance = whole * excess - prior[i, i]
            if again == 1:
                variance *= share
            for j in range(i + 1):
                value = 0.5 * (prior[i, j] + prior[j, i])
                if i == j:
                    value += variance
                for b in range(j):
                    value -= L[i, b] * L[j, b]
                L[i, j] = math.sqrt(value) if i == j else value / L[j, j]
            for b in range(i):
                nu -= L[i, b] * weighted[b]
            weighted[i] = nu / L[i, i]
        if again == 0:
            for i in range(k):
                white[i] = weighted[i]
                scale[i] = L[i, i]
    for row in range(m):
        for i in range(k):
            value = gain[row, i]
            for b in range(i):
                value -= gain[row, b] * L[i, b]
            gain[row, i] = value / L[i, i]
    return gain, weighted, white, scale


@kernel("f8[:,::1](f8[:,::1], f8[:,::1])", has_long_loops=True)
def substitute(columns: Array, right: Array) -> Array:
    """Return W (n, m) with L W = ``right`` (n, m), for a lower triangle L with a narrow band.

    Row j of ``columns`` (n, b) has the entries of column j of L from the diagonal down. Entries of
    W less than `_LEAST_ENTRY` become zero.
    """
    n, width = columns.shape
    found = np.empty_like(right)
    left = np.empty(right.shape[1])
    for row in range(n):
        for k in range(len(left)):
            left[k] = right[row, k]
        for back in range(1, min(width, row + 1)):
            entry, above = columns[row - back, back], found[row - back]
            for k in range(len(left)):
                left[k] -= entry * above[k]
        for k in range(len(left)):
            entry = left[k] / columns[row, 0]
            # so written that what is no number stays none
            found[row, k] = 0.0 if abs(entry) < _LEAST_ENTRY else entry
    return found
