"""Echoes that overlap, told apart by joint maximum likelihood.

A window of a raw frame is modelled as K pulses of known shape and white noise,

    x[n] = sum_k g(n - u_k) (b_k cos(w n) + d_k sin(w n)) + sigma w[n],

g the Gaussian envelope, w the carrier. Whatever the reflection and the carrier do to the phase is
in the linear b and d, so the carrier's 20 mm ambiguity never enters: only the envelope is asked
where an echo lies. For given positions b and d are a linear least-squares solution; the positions
are found by Levenberg-Marquardt on what is left, the Jacobian projected off the linear part
(variable projection; Golub and Pereyra 1973, in Kaufman's form). Two echoes start at
the best pair of a grid over the whole window, so no first guess can lock the search; each further
echo starts where it explains most of what the others leave, and as a half of each of them.

How many echoes: one more is believed if it raises twice the log-likelihood by more than

    (sqrt(h) + model_error sqrt(E) / sigma)**2,    E = energy of the echoes so far.

h is exceeded by noise alone, anywhere in the window, with probability ``false_split`` (upcrossings
of a chi-square process with 2 degrees of freedom; Davies 1987). The other term keeps a pulse that
is not quite ours one echo, however strong: what the pulse model leaves of it grows with the signal,
and the noise adds to its root. Its price: of two echoes in phase, closer than the bandwidth can be
trusted to tell from one wide pulse, or one far weaker than the other, only one is reported.

All arithmetic is batched over windows of one length.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from slam.joint_fit import TINY, Solver, State, Windows, best_pair, best_single, one_more

Array = NDArray[np.float64]

_GRID_STEP = 0.2
"""Of the envelope's sigma: spacing of the start grid. The likelihood is smooth on that scale."""
_COARSE = 1.0
"""Of twice the log-likelihood: what does not decide between one echo more or less."""
_FINE = 1e-4
"""Likewise: a hundredth of a standard deviation of a position."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EchoFit:
    """One echo of a window.

    Attributes
    ----------
    position_bins
        Centre of the pulse, in bins from the window's first sample.
    amplitude
        Peak of the envelope, in the unit of the samples.
    phase_rad
        Phase of the carrier at the pulse's centre, in (-pi, pi].
    sigma_bins
        Standard deviation of the position: the Cramer-Rao bound at this fit, the amplitudes and
        phases of all echoes and the other positions unknown.
    misfit
        Of the whole window: root of the residual's energy above noise over the echoes' energy.
    """

    position_bins: float
    amplitude: float
    phase_rad: float
    sigma_bins: float
    misfit: float


@dataclass(frozen=True, slots=True, kw_only=True)
class KnownPulse:
    """What the fit knows of the pulse.

    Attributes
    ----------
    envelope_sigma_bins
        Standard deviation of the Gaussian envelope, in bins.
    carrier_rad_per_bin
        Advance of the carrier's phase per bin.
    """

    envelope_sigma_bins: float
    carrier_rad_per_bin: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SplitTest:
    """When one more echo is believed.

    Attributes
    ----------
    max_echoes
        No window gets more.
    false_split
        Probability that noise alone makes one more echo in a window.
    model_error
        Amplitude error of the pulse model, relative. 0.08 covers a bandwidth wrong by 10 %.
    min_separation
        Closest echoes told apart, in standard deviations of the envelope.
    """

    max_echoes: int = 4
    false_split: float = 1e-3
    model_error: float = 0.08
    min_separation: float = 0.5


def fit_echoes(
    samples: Array,
    *,
    pulse: KnownPulse,
    noise_sigma: float,
    usable: NDArray[np.bool_] | None = None,
    search_bins: tuple[float, float] | None = None,
    split: SplitTest | None = None,
) -> tuple[EchoFit, ...]:
    """Return the echoes of one window, nearest first; see `fit_many`."""
    return fit_many(
        samples[np.newaxis],
        pulse=pulse,
        noise_sigma=np.array([noise_sigma]),
        usable=None if usable is None else usable[np.newaxis],
        search_bins=search_bins,
        split=split,
    )[0]


def fit_many(
    windows: Array,
    *,
    pulse: KnownPulse,
    noise_sigma: Array,
    usable: NDArray[np.bool_] | None = None,
    search_bins: tuple[float, float] | None = None,
    split: SplitTest | None = None,
) -> tuple[tuple[EchoFit, ...], ...]:
    """Return the echoes of windows, at least one and at most ``split.max_echoes`` each.

    Parameters
    ----------
    windows
        Shape (b, n), float64: raw samples. About 3.5 envelope sigmas either side of the cluster.
    pulse
        The pulse.
    noise_sigma
        Shape (b,): standard deviation of a sample's noise, > 0.
    usable
        Shape (b, n): false where a sample says nothing (clipped, outside the frame). All, if None.
    search_bins
        Least and largest position of an echo, in bins; 1.5 envelope sigmas off the ends, if None.
    split
        When one more echo is believed; `SplitTest()`, if None.

    Returns
    -------
    One tuple per window, nearest echo first.
    """
    split = split or SplitTest()
    n_bins = windows.shape[1]
    sigma = pulse.envelope_sigma_bins
    first, last = search_bins or (1.5 * sigma, n_bins - 1 - 1.5 * sigma)
    if not 0 <= first <= last <= n_bins - 1:
        raise ValueError(f"echoes cannot be searched in bins {first} ... {last} of {n_bins}")
    if not (noise_sigma > 0).all():
        raise ValueError("the noise of a window must be more than 0")
    data = Windows.of(windows, usable, noise_sigma, pulse.carrier_rad_per_bin)
    grid = np.linspace(first, last, max(2, math.ceil((last - first) / (_GRID_STEP * sigma)) + 1))
    solver = Solver(sigma, first, last, split.min_separation * sigma)
    threshold = split_threshold(split.false_split, (last - first) / sigma)
    energy = np.einsum("rn,rn->r", data.samples, data.samples)

    found: list[tuple[EchoFit, ...]] = [()] * len(windows)
    active = np.arange(len(windows))
    state = solver.fit(data, best_single(data, grid, sigma), _COARSE)
    while active.size:
        more, believed = _try_one_more(
            data.rows(active),
            state,
            grid=grid,
            solver=solver,
            split=split,
            threshold=threshold,
            energy=energy[active],
        )
        settled = ~believed
        final = solver.polish(
            data.rows(active[settled]), state.rows(np.flatnonzero(settled)), _FINE
        )
        for place, row in enumerate(active[settled]):
            found[row] = _echoes(
                data,
                final,
                place=place,
                row=row,
                energy=energy[row],
                carrier_rad_per_bin=pulse.carrier_rad_per_bin,
            )
        active, state = active[believed], more
    return tuple(found)


def _try_one_more(
    data: Windows,
    state: State,
    *,
    grid: Array,
    solver: Solver,
    split: SplitTest,
    threshold: float,
    energy: Array,
) -> tuple[State, NDArray[np.bool_]]:
    """Return the fits with one more echo that are believed, and of which rows, shape (r,)."""
    n_echoes = state.positions.shape[1] + 1
    signal = np.sqrt(np.maximum(energy - state.sse, 0.0))
    needed = (math.sqrt(threshold) * data.noise_sigma + split.model_error * signal) ** 2
    # no echo can explain more than all that is left
    believed = (state.sse > needed) & (n_echoes <= split.max_echoes)
    hopeful = np.flatnonzero(believed)
    if not hopeful.size:
        return state.rows(hopeful), believed
    rows, fewer = data.rows(hopeful), state.rows(hopeful)
    if n_echoes == 2:
        starts = best_pair(rows, grid, solver.sigma, solver.separation)
    else:
        starts = one_more(rows, fewer, grid, solver.sigma, solver.separation)
    more = solver.fit(rows, starts, _COARSE)
    enough = fewer.sse - more.sse > needed[hopeful]
    believed[hopeful] = enough
    return more.rows(np.flatnonzero(enough)), believed


@lru_cache
def split_threshold(false_split: float, search_sigmas: float) -> float:
    """Return the rise of twice the log-likelihood that noise exceeds with a given probability.

    Along the position, what one more echo explains is a chi-square process of 2 degrees, whose
    correlation is that of the pulse; the probability that it exceeds h anywhere is at most that
    of its first point plus its upcrossings, ``exp(-h/2) (1 + L sqrt(h / (4 pi)))``.

    Parameters
    ----------
    false_split
        The probability, 0 ... 1.
    search_sigmas
        Length L of the interval searched, in standard deviations of the envelope.
    """

    def excess(h: float) -> float:
        return math.log1p(search_sigmas * math.sqrt(h / (4 * math.pi))) - h / 2

    return float(brentq(lambda h: excess(h) - math.log(false_split), 0.0, 200.0))


def _echoes(
    data: Windows,
    fit: State,
    *,
    place: int,
    row: int,
    energy: float,
    carrier_rad_per_bin: float,
) -> tuple[EchoFit, ...]:
    """Return the echoes of window ``row``, whose fit is row ``place`` of ``fit``."""
    positions = fit.positions[place]
    n_echoes = len(positions)
    noise_sigma = data.noise_sigma[row]
    information = fit.information[place]
    if np.linalg.eigvalsh(information)[0] > TINY:
        sigma_bins = noise_sigma * np.sqrt(np.diag(np.linalg.inv(information)))
    else:
        sigma_bins = np.full(n_echoes, math.inf)

    weight = data.weight[min(row, len(data.weight) - 1)]
    freedom = max(0.0, weight.sum() - 3 * n_echoes)
    above_noise = max(0.0, fit.sse[place] - freedom * noise_sigma**2)
    misfit = math.sqrt(above_noise / max(energy - fit.sse[place], TINY))

    b, d = fit.linear[place, :n_echoes], fit.linear[place, n_echoes:]
    # A cos(w (n - u) + phase) = b cos(w n) + d sin(w n)
    phases = np.angle((b - 1j * d) * np.exp(1j * carrier_rad_per_bin * positions))
    return tuple(
        EchoFit(
            position_bins=position,
            amplitude=amplitude,
            phase_rad=phase,
            sigma_bins=spread,
            misfit=misfit,
        )
        for position, amplitude, phase, spread in zip(
            positions.tolist(),
            np.hypot(b, d).tolist(),
            phases.tolist(),
            sigma_bins.tolist(),
            strict=True,
        )
    )
