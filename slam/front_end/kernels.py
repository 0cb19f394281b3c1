"""Compiled loops of the front end: peaks behind the filter, echoes that overlap, and their misfits.

The formulas are those of :mod:`slam.front_end.matched_filter` and
:mod:`slam.front_end.overlapping`. Sums are in the order of the loops.

Rows of a table are echoes, its columns `POSITION` to `SEVERAL`. Positions are in bins, steps in
values of y. Echoes of a fit lie in rows of a *state*, an array (`ROWS`, `MAX_ECHOES`).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from slam.front_end.numba_compilation import kernel

Array = NDArray[np.float64]
Steps = NDArray[np.int64]
ComplexArray = NDArray[np.complex128]

# Bins from one value of y to the next.
BINS_PER_STEP = 2
# Columns of a table of echoes. The misfit is NaN where it is not computed; SEVERAL is 1 where one
# pulse leaves more than noise and a wrong pulse explain, else 0.
POSITION, AMPLITUDE, PHASE, SIGMA, MISFIT, SEVERAL = range(6)
COLUMNS = 6
# Most echoes that a group is taken apart into.
MAX_ECHOES = 4
# Steps on either side of one from which y is interpolated around it
REACH_STEPS = 4
# Envelope sigmas from an echo behind the filter to 1e-7 of its height, and to 2e-16, taken as zero
FILTERED_REACH, _NOTHING = 8.0, 12.0

# Cells this many times the first guess of sigma_y**2 hold an echo, and so do two on either side.
_ECHO_LEVEL = 3.5**2
_FLANK_CELLS = 2
# If at most one in so many cells is away from echoes, the noise is estimated from all cells.
_LEAST_QUIET = 8

_MAX_STEPS = 30
# The largest step of a position, in envelope sigmas
_LARGEST_STEP = 0.5
# Damping of the first step, its factors after a step that helped and after one that did not, the
# least damping as a share of the largest information, and the damping at which a search ends
_DAMPING, _EASED, _STIFFENED, _LEAST_DAMPING, _HOPELESS = 1e-3, 0.1, 10.0, 1e-12, 1e3
# Least share of a pulse's norm that other echoes do not explain, and least information of a
# position, as a share of the largest
LEAST_NORM, _LEAST_INFORMATION = 1e-3, 1e-12
# Added to the diagonal of the Gram matrix: a share of it, and what remains if no sample is known
_RIDGE, _LEAST_GRAM = 1e-13, 1e-12
# Gains of twice the log-likelihood at which a search ends: while echoes are counted, and at last,
# where it is a hundredth of a standard deviation of a position
COARSE, FINE = 1.0, 1e-4
# At most so many times the gain that it forecasts is expected of a search.
_OPTIMISM = 10.0

# Rows of a state: positions, amplitudes, half the gradient; then one, one and three matrices
U, REAL, IMAG, CLIMB, _KNOWN, INFORMATION, _WORK = 0, 1, 2, 3, 4, 8, 12
ROWS = 24
# States of one fit: the best so far, a search, one step of it, and the best search
_FIT, NOW, _TRIED, _MORE = range(4)
STATES = 4


@kernel("f8(f8[::1], i8)")
def _median(values: Array, size: int) -> float:
    """Return the (upper) median of the first ``size`` values, which are reordered (Hoare)."""
    low, high, middle = 0, size - 1, size // 2
    while low < high:
        pivot = values[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if middle <= j:
            high = j
        elif middle >= i:
            low = i
        else:
            break
    return float(values[middle])


@kernel("f8(c16[::1], i8, f8[:,::1])")
def noise_power(y: ComplexArray, stride: int, cells: Array) -> float:
    """Return sigma_y**2 from every ``stride``-th value of y; ``cells`` (2, n) is working space."""
    n = (y.size + stride - 1) // stride
    powers, sorted_ = cells[0], cells[1]
    for k in range(n):
        powers[k] = y[k * stride].real ** 2 + y[k * stride].imag ** 2
        sorted_[k] = powers[k]
    first = _median(sorted_, n) / (2.0 * math.log(2.0))
    quiet, end = 0, 0  # how many cells are quiet, and the first behind the last echo
    for k in range(n):
        for ahead in range(k, min(k + _FLANK_CELLS + 1, n)):
            if powers[ahead] > _ECHO_LEVEL * first:
                end = ahead + _FLANK_CELLS + 1
        if k >= end:
            sorted_[quiet] = powers[k]
            quiet += 1
    if quiet == n or quiet * _LEAST_QUIET <= n:
        return first
    return _median(sorted_, quiet) / (2.0 * math.log(2.0))


@kernel("f8(f8[:,::1], i8, f8, f8)")
def _power_at(table: Array, n: int, position: float, s: float) -> float:
    """Return the sum of A**2 rho**2 of n echoes, ascending, at a position."""
    total = 0.0
    for k in range(n):
        away = (position - table[k, POSITION]) / s
        if abs(away) < _NOTHING:
            total += math.exp(-0.5 * away * away) * table[k, AMPLITUDE] ** 2
    return total


@kernel("c16(f8[:,::1], i8, f8, f8, f8)")
def _pulse(table: Array, row: int, position: float, s: float, carrier: float) -> complex:
    """Return an echo of a table behind the filter at a position."""
    away = position - table[row, POSITION]
    if abs(away) > _NOTHING * s:
        return 0j
    height = table[row, AMPLITUDE] * math.exp(-0.25 * (away / s) ** 2)
    turn = carrier * away + table[row, PHASE]
    return complex(height * math.cos(turn), height * math.sin(turn))


@kernel("i8(c16[::1],f8,f8,f8,f8,i8[::1],c16[::1],f8,f8,f8,f8,f8,f8,f8[:,::1])")
def single_pulses(
    y: ComplexArray,
    sigma_y: float,
    level: float,
    s: float,
    carrier: float,
    probes: Steps,
    turns: ComplexArray,
    energy: float,
    noise: float,
    wrong: float,
    max_misfit: float,
    first: float,
    last: float,
    table: Array,
) -> int:
    """Write the peaks above ``level`` sigma_y as one pulse each into a table; return how many.

    Those between two positions get a misfit at the ``probes`` [steps], where ``noise`` sigma_y**2
    and the part ``wrong`` of the amplitudes are expected. ``turns`` turn the carrier there to its
    phase at the peak, and ``energy`` is that of a pulse of amplitude 1.
    """
    size = y.size
    least = (level * sigma_y) ** 2
    n = 0
    for at in range(1, size - 1):
        middle = y[at].real ** 2 + y[at].imag ** 2
        if middle <= least:
            continue
        before = y[at - 1].real ** 2 + y[at - 1].imag ** 2
        after = y[at + 1].real ** 2 + y[at + 1].imag ** 2
        if not (middle > before and middle >= after):
            continue
        low, top, high = math.log(before), math.log(middle), math.log(after)
        offset = 0.5 * BINS_PER_STEP * (low - high) / (low - 2.0 * top + high)
        height = math.hypot(y[at].real, y[at].imag)
        amplitude = height * math.exp((offset / (2.0 * s)) ** 2)
        table[n, POSITION] = BINS_PER_STEP * at + offset
        table[n, AMPLITUDE] = amplitude
        table[n, PHASE] = math.atan2(y[at].imag, y[at].real) + carrier * offset
        table[n, SIGMA] = math.sqrt(2.0) * s * sigma_y / amplitude
        table[n, MISFIT] = math.nan
        table[n, SEVERAL] = 0.0
        if first < table[n, POSITION] < last:
            left = 0.0
            # Turned back by the peak's phase and the carrier, a pulse is real.
            back = y[at].conjugate() / height
            for k in range(probes.size):
                bins = BINS_PER_STEP * probes[k]
                value = y[min(max(at + probes[k], 0), size - 1)] * turns[k] * back
                away = (bins - offset) / s
                real = value.real - amplitude * math.exp(-0.25 * away * away)
                left += real * real + value.imag * value.imag
            table[n, MISFIT] = left
            beyond_noise = left > max_misfit * sigma_y**2 * noise
            if beyond_noise and left > wrong**2 * energy * amplitude**2:
                table[n, SEVERAL] = 1.0
        n += 1
    for row in range(n):
        if not math.isnan(table[row, MISFIT]):
            # the highest value is within a bin of the vertex
            at = round(table[row, POSITION] / BINS_PER_STEP)
            expected = sigma_y**2 * noise
            for k in range(probes.size):
                position = float(BINS_PER_STEP * (at + probes[k]))
                expected += wrong**2 * _power_at(table, n, position, s)
            table[row, MISFIT] /= expected
    return n


@kernel("void(c16[::1], b1, f8, f8, f8, i8[::1], f8, f8, f8, f8, f8[:,::1])")
def assess(
    y: ComplexArray,
    subtract: bool,
    sigma_y: float,
    s: float,
    carrier: float,
    probes: Steps,
    noise: float,
    wrong: float,
    first: float,
    last: float,
    table: Array,
) -> None:
    """Write the misfit of each echo of a table between two positions; all echoes are the model.

    Without ``subtract``, y is the residual: the echoes are subtracted already.
    """
    n = len(table)
    for row in range(n):
        table[row, MISFIT] = math.nan
        if not first < table[row, POSITION] < last:
            continue
        at = round(table[row, POSITION] / BINS_PER_STEP)
        left = 0.0
        expected = sigma_y**2 * noise
        for k in range(probes.size):
            position = float(BINS_PER_STEP * (at + probes[k]))
            value = y[min(max(at + probes[k], 0), y.size - 1)]
            if subtract:
                for each in range(n):
                    value -= _pulse(table, each, position, s, carrier)
            left += value.real**2 + value.imag**2
            expected += wrong**2 * _power_at(table, n, position, s)
        table[row, MISFIT] = left / expected


@kernel("void(f8, f8, f8, f8[:,::1])")
def raise_deviations(sigma_y: float, s: float, wrong: float, table: Array) -> None:
    """Raise the deviation of each echo by the part ``wrong`` of the others at its position."""
    for row in range(len(table)):
        others = _power_at(table, len(table), table[row, POSITION], s) - table[row, AMPLITUDE] ** 2
        table[row, SIGMA] *= math.sqrt(1.0 + (wrong / sigma_y) ** 2 * max(others, 0.0))


@kernel("void(f8[:,::1], i8, f8[:,::1], f8[:,::1])")
def _invert(matrix: Array, size: int, inverse: Array, scaled: Array) -> None:
    """Write the inverse of a small symmetric positive definite matrix, by bordering."""
    if size == 1:
        inverse[0, 0] = 1.0 / matrix[0, 0]
        return
    scale = 1.0 / (matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[0, 1])
    inverse[0, 0] = scale * matrix[1, 1]
    inverse[1, 1] = scale * matrix[0, 0]
    inverse[0, 1] = inverse[1, 0] = -scale * matrix[0, 1]
    for k in range(2, size):
        explained = 0.0
        for i in range(k):
            border = 0.0
            for j in range(k):
                border += inverse[i, j] * matrix[k, j]
            scaled[0, i] = border
            explained += border * matrix[k, i]
        scale = 1.0 / (matrix[k, k] - explained)
        for i in range(k):
            for j in range(k):
                inverse[i, j] += scaled[0, i] * (scale * scaled[0, j])
        for i in range(k):
            inverse[i, k] = inverse[k, i] = -scale * scaled[0, i]
        inverse[k, k] = scale


@kernel("f8(c16[:,::1], f8, f8[:,::1], i8)")
def _evaluate_samples(window: ComplexArray, s: float, state: Array, size: int) -> float:
    """Fit as `evaluate` does, to a window of samples.

    Its columns are the samples, and cosine and sine of the carrier as one complex number; both are
    zero where a sample is unknown. The amplitudes are b and d, and there is no ``_KNOWN``.
    """
    n = len(window)
    envelopes = np.empty((n, MAX_ECHOES))
    gram = np.zeros((2 * MAX_ECHOES, 2 * MAX_ECHOES))
    inverse, scaled = np.zeros_like(gram), np.empty((1, 2 * MAX_ECHOES))
    matched, linear = np.zeros(2 * MAX_ECHOES), np.empty(2 * MAX_ECHOES)
    mixed, tangents = np.zeros((MAX_ECHOES, 2 * MAX_ECHOES)), np.empty(MAX_ECHOES)
    information = state[INFORMATION:]
    for at in range(n):
        x, c, d = window[at, 0].real, window[at, 1].real, window[at, 1].imag
        for k in range(size):
            away = (at - state[U, k]) / s
            height = math.exp(-0.5 * away * away)
            envelopes[at, k] = height
            matched[k] += x * height * c
            matched[size + k] += x * height * d
            for m in range(k + 1):
                both = height * envelopes[at, m]
                gram[k, m] += both * c * c
                gram[size + k, size + m] += both * d * d
                gram[size + k, m] += both * c * d
    for k in range(size):
        for m in range(k):
            gram[size + m, k] = gram[size + k, m]
    for k in range(2 * size):
        gram[k, k] = gram[k, k] * (1.0 + _RIDGE) + _LEAST_GRAM
        for m in range(k):
            gram[m, k] = gram[k, m]
    _invert(gram, 2 * size, inverse, scaled)
    for k in range(2 * size):
        linear[k] = 0.0
        for m in range(2 * size):
            linear[k] += inverse[k, m] * matched[m]
    for k in range(size):
        state[REAL, k], state[IMAG, k], state[CLIMB, k] = linear[k], linear[size + k], 0.0
        for m in range(size):
            information[k, m] = 0.0
    explained = 0.0
    for at in range(n):
        x, c, d = window[at, 0].real, window[at, 1].real, window[at, 1].imag
        left = x
        for k in range(size):
            pulse = envelopes[at, k] * (linear[k] * c + linear[size + k] * d)
            left -= pulse
            tangents[k] = pulse * (at - state[U, k]) / s**2
        explained += x * x - left * left
        for k in range(size):
            state[CLIMB, k] += tangents[k] * left
            for m in range(size):
                information[k, m] += tangents[k] * tangents[m]
                mixed[k, m] += tangents[k] * envelopes[at, m] * c
                mixed[k, size + m] += tangents[k] * envelopes[at, m] * d
    for k in range(size):
        for m in range(2 * size):
            matched[m] = 0.0
            for each in range(2 * size):
                matched[m] += inverse[m, each] * mixed[k, each]
        for m in range(size):
            for each in range(2 * size):
                information[k, m] -= mixed[m, each] * matched[each]
    return explained


@kernel("f8(c16[:,::1], f8, f8[:,::1], i8)")
def evaluate(around: ComplexArray, s: float, state: Array, size: int) -> float:
    """Fit the echoes at the positions of a state; return the energy G that they explain.

    ``around`` (n, 9) holds the polynomial around each step of z, the first `REACH_STEPS` left out.
    The state gets the amplitudes a, ``_KNOWN`` R^-1, half of dG/du, and the Fisher matrix times
    sigma_y**2. Two columns are a window of samples, see `_evaluate_samples`.
    """
    if around.shape[1] == 2:
        return _evaluate_samples(around, s, state, size)
    curvature = 0.5 / s**2
    overlap, slope, bend = state[_WORK:], state[_WORK + 4 :], state[_WORK + 8 :]
    seen_real, seen_imag = np.empty(MAX_ECHOES), np.empty(MAX_ECHOES)
    climb_real, climb_imag = np.empty(MAX_ECHOES), np.empty(MAX_ECHOES)
    for k in range(size):
        overlap[k, k], slope[k, k], bend[k, k] = 1.0, 0.0, curvature
        for m in range(k):
            scaled = curvature * (state[U, k] - state[U, m])
            left = scaled * (state[U, k] - state[U, m])
            rho = math.exp(-0.5 * left)
            overlap[k, m] = overlap[m, k] = rho
            slope[m, k] = scaled * rho
            slope[k, m] = -slope[m, k]
            bend[k, m] = bend[m, k] = (1.0 - left) * curvature * rho
        steps = state[U, k] / BINS_PER_STEP
        nearest = min(max(round(steps), REACH_STEPS), len(around) - 1 + REACH_STEPS)
        offset = steps - nearest
        value = climb = 0j
        for power in range(2 * REACH_STEPS, -1, -1):
            climb = climb * offset + value
            value = value * offset + around[nearest - REACH_STEPS, power]
        seen_real[k], seen_imag[k] = value.real, value.imag
        climb_real[k], climb_imag[k] = climb.real / BINS_PER_STEP, climb.imag / BINS_PER_STEP
    inverse, information = state[_KNOWN:], state[INFORMATION:]
    _invert(overlap, size, inverse, information)
    explained = 0.0
    for k in range(size):
        real = imag = 0.0
        for m in range(size):
            real += inverse[k, m] * seen_real[m]
            imag += inverse[k, m] * seen_imag[m]
        state[REAL, k], state[IMAG, k] = real, imag
        explained += real * seen_real[k] + imag * seen_imag[k]
    for k in range(size):
        known_real = known_imag = 0.0
        for m in range(size):
            known_real += slope[k, m] * state[REAL, m]
            known_imag += slope[k, m] * state[IMAG, m]
        real, imag = climb_real[k] - known_real, climb_imag[k] - known_imag
        state[CLIMB, k] = state[REAL, k] * real + state[IMAG, k] * imag
    for k in range(size):
        for m in range(size):  # row k of D R^-1, in what held the derivatives of z
            total = 0.0
            for each in range(size):
                total += slope[k, each] * inverse[m, each]
            climb_real[m] = total
        for m in range(size):
            total = 0.0
            for each in range(size):  # D^T = -D
                total += climb_real[each] * slope[each, m]
            common = state[REAL, k] * state[REAL, m] + state[IMAG, k] * state[IMAG, m]
            information[k, m] = common * (bend[k, m] + total)
    return explained


@kernel("b1(f8[::1], i8, f8)")
def _apart(positions: Array, size: int, separation: float) -> bool:
    apart = True
    for k in range(1, size):
        apart = apart and positions[k] - positions[k - 1] >= separation
    return apart


@kernel("void(f8[::1], i8)")
def _sort(values: Array, size: int) -> None:
    for k in range(1, size):
        for m in range(k, 0, -1):
            if values[m - 1] <= values[m]:
                break
            values[m - 1], values[m] = values[m], values[m - 1]


@kernel("void(f8[:,::1], f8[:,::1])")
def _copy(source: Array, target: Array) -> None:
    for row in range(_WORK):
        for k in range(MAX_ECHOES):
            target[row, k] = source[row, k]


@kernel("f8(c16[:,::1], f8, f8, f8, f8, f8, f8, f8, f8[:,:,::1], i8)")
def polish(
    around: ComplexArray,
    s: float,
    sigma_y: float,
    first: float,
    last: float,
    separation: float,
    tolerance: float,
    at_least: float,
    states: Array,
    size: int,
) -> float:
    """Improve the state `NOW` by Levenberg-Marquardt; return the energy that it explains.

    Positions stay within the limits and ``separation`` [bins] apart. A search ends early when
    `_OPTIMISM` times the gain that it forecasts does not reach ``at_least``.
    """
    now, tried = states[NOW], states[_TRIED]
    explained = evaluate(around, s, now, size)
    largest = _LARGEST_STEP * s
    damping = _DAMPING
    for _ in range(_MAX_STEPS):
        highest = now[INFORMATION, 0]
        for k in range(1, size):
            highest = max(highest, now[INFORMATION + k, k])
        floor = _LEAST_DAMPING * highest
        if floor <= 0.0:  # nothing is there
            break
        damped, inverse = tried[INFORMATION:], tried[_KNOWN:]
        for k in range(size):
            for m in range(size):
                damped[k, m] = now[INFORMATION + k, m]
            damped[k, k] += damping * damped[k, k] + floor
        _invert(damped, size, inverse, tried[_WORK:])
        promised = 0.0
        for k in range(size):
            step = 0.0
            for m in range(size):
                step += inverse[k, m] * now[CLIMB, m]
            # the model's own forecast of the gain
            promised += step * now[CLIMB, k]
            wanted = now[U, k] + min(max(step, -largest), largest)
            tried[U, k] = min(max(wanted, first), last)
        if explained + _OPTIMISM * promised < at_least:
            break
        _sort(tried[U], size)
        gained = 0.0
        if _apart(tried[U], size, separation):
            gained = evaluate(around, s, tried, size) - explained
        if gained > 0.0:
            explained += gained
            _copy(tried, now)
            damping *= _EASED
        else:
            gained = promised
            damping *= _STIFFENED
        if gained <= tolerance * sigma_y**2 or damping >= _HOPELESS:
            break
    return explained


@kernel("void(c16[:,::1], i8, i8, f8, f8, f8[::1])")
def _best_pair(
    around: ComplexArray, low: int, high: int, s: float, separation: float, positions: Array
) -> None:
    """Write the two steps, ``separation`` apart, that explain most; the ends if there are none."""
    best = 0.0
    positions[0] = BINS_PER_STEP * (low + REACH_STEPS)
    positions[1] = BINS_PER_STEP * (high - 1 + REACH_STEPS)
    for lag in range(1, high - low):
        distance = float(BINS_PER_STEP * lag)
        if distance < separation:
            continue
        rho = math.exp(-0.25 * (distance / s) ** 2)
        gain = 1.0 / (1.0 - rho**2)
        for one in range(low, high - lag):
            a, b = around[one, 0], around[one + lag, 0]
            energy = a.real**2 + a.imag**2 + (b.real**2 + b.imag**2)
            explained = (energy - 2.0 * rho * (a.real * b.real + a.imag * b.imag)) * gain
            if explained > best:
                best = explained
                positions[0] = BINS_PER_STEP * (one + REACH_STEPS)
                positions[1] = BINS_PER_STEP * (one + lag + REACH_STEPS)


@kernel("f8(c16[:,::1], i8, i8, f8, f8, f8, f8[:,::1], i8)")
def _one_more(
    around: ComplexArray,
    low: int,
    high: int,
    s: float,
    separation: float,
    needed: float,
    fit: Array,
    size: int,
) -> float:
    """Return where one more echo explains most of the residual; -1 if ``needed`` is too much."""
    overlap = np.empty(MAX_ECHOES)
    most, best, chosen = 0.0, -2.0, low
    for step in range(low, high):
        position = float(BINS_PER_STEP * (step + REACH_STEPS))
        left = around[step, 0]
        nearest = math.inf
        for k in range(size):
            away = position - fit[U, k]
            nearest = min(nearest, abs(away))
            overlap[k] = math.exp(-0.25 * (away / s) ** 2)
            left -= overlap[k] * complex(fit[REAL, k], fit[IMAG, k])
        norm = 1.0
        for k in range(size):
            row = 0.0
            for m in range(size):
                row += fit[_KNOWN + k, m] * overlap[m]
            norm -= overlap[k] * row
        explained = (left.real**2 + left.imag**2) / max(norm, LEAST_NORM)
        most = max(most, explained)
        if nearest < separation:
            explained = -1.0
        if explained > best:
            best, chosen = explained, step
    if _OPTIMISM * most < needed:
        return -1.0
    return float(BINS_PER_STEP * (chosen + REACH_STEPS))


@kernel("void(c16[::1], f8[:,::1], i8, f8, f8, f8[:,::1], c16[::1], c16[:,::1])")
def interpolate(
    y: ComplexArray,
    others: Array,
    begin: int,
    s: float,
    carrier: float,
    taylor: Array,
    z: ComplexArray,
    around: ComplexArray,
) -> None:
    """Write z, y from a step on without the ``others`` and the carrier, and its polynomials.

    ``around`` (n - 2 `REACH_STEPS`, 9) holds that around each step, the outermost ones left out.
    """
    n = z.size
    start, end = float(BINS_PER_STEP * begin), float(BINS_PER_STEP * (begin + n - 1))
    for k in range(n):
        z[k] = y[begin + k]
    for row in range(len(others)):
        if start - FILTERED_REACH * s < others[row, POSITION] < end + FILTERED_REACH * s:
            for k in range(n):
                z[k] -= _pulse(others, row, start + BINS_PER_STEP * k, s, carrier)
    for k in range(n):
        turn = -carrier * BINS_PER_STEP * k
        z[k] = z[k] * complex(math.cos(turn), math.sin(turn))
    for k in range(len(around)):
        for power in range(2 * REACH_STEPS + 1):
            total = 0j
            for m in range(2 * REACH_STEPS + 1):
                total += z[k + m] * taylor[m, power]
            around[k, power] = total


@kernel("i8(c16[:,::1], f8, f8, f8, f8, f8, f8, f8, f8, i8, f8[:,:,::1], f8[:,::1])")
def fit_whole(
    around: ComplexArray,
    first: float,
    last: float,
    s: float,
    carrier: float,
    sigma_y: float,
    threshold: float,
    model_error: float,
    separation: float,
    max_echoes: int,
    states: Array,
    table: Array,
) -> int:
    """Write the echoes between two positions into a table, nearest first; return how many.

    One more is accepted if twice the log-likelihood gains enough (``threshold``, ``model_error``).
    ``around`` is as in `interpolate`; positions count from z[0], phases have the carrier turned
    back. ``states`` (`STATES`, `ROWS`, `MAX_ECHOES`) is working space.
    """
    # steps of the grid, counted as rows of ``around``
    low = max(0, math.ceil(first / BINS_PER_STEP) - REACH_STEPS)
    high = min(max(low + 1, math.floor(last / BINS_PER_STEP) + 1 - REACH_STEPS), len(around))
    fit, now, more = states[_FIT], states[NOW], states[_MORE]
    best, highest = low, -1.0
    for k in range(low, high):
        height = around[k, 0].real ** 2 + around[k, 0].imag ** 2
        if height > highest:
            best, highest = k, height
    now[U, 0] = BINS_PER_STEP * (best + REACH_STEPS)
    size = 1
    explained = polish(around, s, sigma_y, first, last, separation, COARSE, -math.inf, states, size)
    _copy(now, fit)
    while size < max_echoes:
        signal = math.sqrt(max(explained, 0.0))
        needed = (math.sqrt(threshold) * sigma_y + model_error * signal) ** 2
        at_least = explained + needed
        found = -math.inf
        starts = 1
        if size == 1:
            _best_pair(around, low, high, s, separation, now[U])
        else:
            added = _one_more(around, low, high, s, separation, needed, fit, size)
            starts = 0 if added < 0.0 else size + 1
        for start in range(starts):
            if size > 1:
                for k in range(size):
                    now[U, k] = fit[U, k]
                now[U, size] = added
                if start > 0:
                    position = fit[U, start - 1]
                    now[U, start - 1] = max(position - 0.5 * s, first)
                    now[U, size] = min(position + 0.5 * s, last)
                _sort(now[U], size + 1)
            if not _apart(now[U], size + 1, separation):
                continue
            reached = polish(
                around, s, sigma_y, first, last, separation, COARSE, at_least, states, size + 1
            )
            if reached > found:
                found = reached
                _copy(now, more)
        if not found - explained > needed:
            break
        _copy(more, fit)
        explained = found
        size += 1
    _copy(fit, now)
    polish(around, s, sigma_y, first, last, separation, FINE, -math.inf, states, size)

    lowest, highest = math.inf, 0.0
    for k in range(size):
        lowest = min(lowest, now[INFORMATION + k, k])
        highest = max(highest, now[INFORMATION + k, k])
    regular = lowest > _LEAST_INFORMATION * highest
    if regular:
        _invert(now[INFORMATION:], size, now[_KNOWN:], now[_WORK:])
    for k in range(size):
        variance = now[_KNOWN + k, k] if regular else math.inf
        position, real, imag = now[U, k], now[REAL, k], now[IMAG, k]
        table[k, POSITION] = position
        table[k, AMPLITUDE] = math.hypot(real, imag)
        table[k, PHASE] = math.atan2(imag, real) + carrier * position
        table[k, SIGMA] = sigma_y * math.sqrt(variance) if variance > 0.0 else math.inf
    return size
