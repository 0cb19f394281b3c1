"""Draws the experiment `recording`: a real recording and emulated frames, side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from slam.app.experiments.slow_time import FAR_BINS, SlowTime
from slam.app.picture import ESTIMATE, INK, ODOMETRY, TRUTH, label, picture

Array = NDArray[np.float64]

_RECORDED, _EMULATED, _QUIET = ODOMETRY, ESTIMATE, TRUTH
_LONGEST_LAG_S = 4.0
_LAGS = 24
_MRAD_TICKS = (1, 2, 5, 10, 20, 50, 100)


def draw_recording(path: Path, recorded: SlowTime, emulated: Sequence[SlowTime]) -> None:
    """Draw amplitudes, spectra, autocorrelation and phase of both; into a PNG file.

    Lines of the emulation are medians over its runs, bands reach from 10 to 90 %.
    """
    quiet = recorded.quietest()
    near, far = slice(recorded.strongest, recorded.strongest + 1), slice(-FAR_BINS, None)
    with picture(path, width_in=12.6, height_in=7.6) as figure:
        figure.suptitle(
            f"A real X4 ({len(recorded.iq)} frames at {recorded.rate_hz:.1f} Hz) and the emulated "
            f"one before a single static reflector ({len(emulated)} runs: median, 10-90 %)",
            fontsize=11,
            color=INK,
            x=0.01,
            ha="left",
        )
        panels = figure.subplots(2, 3)
        _draw_amplitudes(panels[0, 0], recorded, emulated)
        for axes, bins, title in (
            (panels[0, 1], near, "(b) spectrum of the strongest bin"),
            (panels[0, 2], far, f"(c) spectrum of the {FAR_BINS} farthest bins"),
        ):
            _draw_spectra(axes, recorded, emulated, quiet, bins)
            label(axes, title, "frequency over slow time [Hz]", "amplitude per component [1/√Hz]")
        _draw_autocorrelation(panels[1, 0], recorded, emulated)
        _draw_phase(panels[1, 1], recorded, emulated[0])
        _draw_increments(panels[1, 2], recorded, emulated, quiet)
        panels[0, 2].legend(frameon=False, fontsize=8.5)


def _draw_band(axes: Axes, x: Array, runs: Sequence[Array]) -> None:
    low, middle, high = np.percentile(runs, (10, 50, 90), axis=0)
    axes.fill_between(x, low, high, color=_EMULATED, alpha=0.2, linewidth=0)
    axes.plot(x, middle, color=_EMULATED, linewidth=1.4, label="emulated")


def _draw_amplitudes(axes: Axes, recorded: SlowTime, emulated: Sequence[SlowTime]) -> None:
    bins = np.arange(recorded.iq.shape[1], dtype=np.float64)
    range_m = recorded.first_bin_m + bins * recorded.bin_length_m
    axes.axvspan(range_m[-FAR_BINS], range_m[-1], color=TRUTH, alpha=0.15, linewidth=0)
    axes.semilogy(range_m, recorded.amplitude, color=_RECORDED, linewidth=1.4)
    axes.semilogy(range_m, recorded.sigma, color=_RECORDED, linewidth=1.0, linestyle="--")
    _draw_band(axes, range_m, [one.amplitude for one in emulated])
    sigma = np.median([one.sigma for one in emulated], axis=0)
    axes.semilogy(range_m, sigma, color=_EMULATED, linewidth=1.0, linestyle="--")
    axes.annotate(
        "solid: mean amplitude, dashed: std per component\n"
        "in the scene there is the strongest\nreflector only: no room, nobody moves",
        (0.97, 0.97),
        xycoords="axes fraction",
        ha="right",
        va="top",
        fontsize=8.5,
        color=INK,
    )
    label(axes, "(a) bins (grey: the ten farthest)", "range [module m]", "amplitude")


def _draw_spectra(
    axes: Axes, recorded: SlowTime, emulated: Sequence[SlowTime], quiet: SlowTime, bins: slice
) -> None:
    frequency, density = recorded.spectrum(bins)
    axes.semilogy(frequency, density, color=_RECORDED, linewidth=1.4, label="recorded")
    _draw_band(axes, frequency, [one.spectrum(bins)[1] for one in emulated])
    axes.semilogy(
        *quiet.spectrum(bins),
        color=_QUIET,
        linewidth=1.0,
        label=f"recorded, quietest {len(quiet.iq) / quiet.rate_hz:.0f} s",
    )


def _draw_autocorrelation(axes: Axes, recorded: SlowTime, emulated: Sequence[SlowTime]) -> None:
    n_lags = round(_LONGEST_LAG_S * recorded.rate_hz)
    lag_s = np.arange(n_lags) / recorded.rate_hz
    axes.plot(lag_s, recorded.autocorrelation(n_lags), color=_RECORDED, linewidth=1.4)
    _draw_band(axes, lag_s, [one.autocorrelation(n_lags) for one in emulated])
    axes.set_ylim(-0.15, 1.05)
    label(axes, "(d) the ten farthest bins: autocorrelation", "lag [s]", "correlation")


def _draw_phase(axes: Axes, recorded: SlowTime, emulated: SlowTime) -> None:
    for one, colour in ((emulated, _EMULATED), (recorded, _RECORDED)):
        time_s = np.arange(len(one.iq)) / one.rate_hz
        axes.plot(time_s, 1e3 * one.phase_rad, color=colour, linewidth=1.0)
    label(axes, "(e) phase of the strongest bin (one run)", "time [s]", "phase [mrad]")


def _draw_increments(
    axes: Axes, recorded: SlowTime, emulated: Sequence[SlowTime], quiet: SlowTime
) -> None:
    longest = len(recorded.iq) // 3
    lags = np.unique(np.geomspace(1, longest, _LAGS).round().astype(np.int64))
    lag_s = lags / recorded.rate_hz
    axes.loglog(lag_s, 1e3 * recorded.phase_increments_rad(lags), color=_RECORDED, linewidth=1.4)
    _draw_band(axes, lag_s, [1e3 * one.phase_increments_rad(lags) for one in emulated])
    short = lags[lags <= len(quiet.iq) // 2]
    axes.loglog(
        short / quiet.rate_hz,
        1e3 * quiet.phase_increments_rad(short),
        color=_QUIET,
        linewidth=1.0,
    )
    axes.set_yticks(_MRAD_TICKS, [str(tick) for tick in _MRAD_TICKS])
    axes.minorticks_off()
    label(axes, "(f) change of that phase over a lag", "lag [s]", "std [mrad]")
