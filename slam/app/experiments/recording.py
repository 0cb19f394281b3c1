"""A real recording of a standing module beside emulated frames of an equivalent scene.

Everything is per baseband component (I or Q), the mean of each bin over time taken off. Of a record
of finite length all estimates are biased alike for slow processes, so records are compared with
records of the same length and rate, never with the parameters of a model.

The anchors are read off one recording of the vendor's (X4, 54 baseband bins, 17 frames/s, 2017):
of its ten farthest bins, 1.4e-4 per component with an autocorrelation of 0.98 at one frame, so that
2.1e-5 are new with every frame; of its strongest reflector, a phase that wanders by 0.032 rad, of
which 0.0056 rad are new with every frame.

What one recording does not show:

* The working point. 17 frames/s and 54 bins fit the vendor's example settings, 16 iterations x 300
  pulses per step, which are assumed here; the samples lie on no lattice that would show it.
* What is the module and what is the room. In its quietest 7 s the floor of all bins from the 18th
  on is 6e-6, three times below the anchor, and the phase wanders by 0.0014 rad; later a person
  moves close by. The anchors are what the whole recording shows: upper bounds on the module.
* Whether the phase is common to all echoes, as a jitter's is: the strongest echo's fluctuation is
  nearly as large in amplitude as in phase, so a part of it is other echoes.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.signal import welch

from emulator.chip import Pace
from emulator.device import radar_device
from emulator.echo.echo import echo_source
from emulator.echo.reflections import CARRIER_CYCLES_PER_SAMPLE, SIGMA_S, SPEED_OF_LIGHT_MPS
from emulator.loopback import LoopbackTransport
from emulator.module.memory import Identity
from emulator.scene.scene import ClutterSpec, JitterSpec, NoiseSpec, RadarSpec, Scene, TargetSpec
from slam.app.errors import AppError
from slam.app.experiments import Result, table
from slam.app.run.pictures import ESTIMATE, INK, ODOMETRY, TRUTH, label, note
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.processing.downconversion import CHANNELS, TAP_COUNT
from xethru_protocol.recordings import RecordingError, read_recording
from xethru_protocol.system import StopFlag
from xethru_protocol.wire.messages import BasebandIq
from xethru_protocol.wire.x4 import MODULE_SPEED_MPS, SAMPLING_RATE_HZ, real_frame_rate

Array = NDArray[np.float64]

FAR_BINS = 10
"""The farthest bins, taken for empty."""
SEGMENT = 128
"""Frames of a spectrum's segments, and of the quietest stretch."""
FLOOR_FROM_HZ = 6.0
"""The noise floor is read from here upwards; at 17 frames/s spectra end at 8.5 Hz."""

TITLES: Mapping[str, str] = {
    "amplitude": "strongest bin: mean amplitude",
    "phase_rad": "strongest bin: phase, std [rad]",
    "phase_white_rad": "  of it new with each frame [rad]",
    "far_sigma": "ten farthest bins: std per component",
    "far_lag_1": "  autocorrelation at one frame",
    "far_white": "  of it new with each frame",
    "far_floor": f"  floor of the spectrum, as white noise (> {FLOOR_FROM_HZ:.0f} Hz)",
    "far_neighbours": "  correlation of neighbouring bins",
    "far_neighbours_fast": "  the same of its fast part (third differences)",
}
"""Names and titles of the figures, in the table's order."""

NOISE = NoiseSpec(rf_sigma=6.4e-5, iterations=16, pulses_per_step=300)
"""1.5e-5 per baseband component (1 / 4.18 of RF), at an assumed working point.

The flat part of the far bins' spectrum. The rest of the 2.1e-5 is the fast end of the clutter: with
2.1e-5 of white noise beside the clutter, 2.4e-5 would be new with every frame.
"""
CLUTTER = ClutterSpec(sigma=2.25e-4, correlation_s=4.8)
"""1.58e-4 per baseband component (0.70 of RF). In 30 s, the mean taken off, 1.4e-4 of it show."""
JITTER = JitterSpec(white_rad=0.0056, slow_rad=0.032, slow_correlation_s=4.0)

_RECORDED, _EMULATED, _QUIET = ODOMETRY, ESTIMATE, TRUTH
_LONGEST_LAG_S = 4.0
_LAGS = 24
_MRAD_TICKS = (1, 2, 5, 10, 20, 50, 100)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SlowTime:
    """Frames of a standing radar."""

    iq: NDArray[np.complex128]  # (n_frames, n_bins): baseband
    rate_hz: float  # frames per second
    first_bin_m: float  # module metres
    bin_length_m: float  # module metres

    @property
    def amplitude(self) -> Array:
        """Return the mean amplitude of each bin, shape (n_bins,)."""
        mean: Array = np.abs(self.iq).mean(axis=0)
        return mean

    @property
    def strongest(self) -> int:
        return int(np.argmax(self.amplitude))

    @property
    def sigma(self) -> Array:
        """Return the standard deviation of each bin over time, per component, shape (n_bins,)."""
        sigma: Array = np.sqrt(self.iq.var(axis=0) / 2)
        return sigma

    @property
    def phase_rad(self) -> Array:
        """Return the strongest bin's phase about its mean, unwrapped, shape (n_frames,)."""
        phase: Array = np.unwrap(np.angle(self.iq[:, self.strongest]))
        phase -= phase.mean()
        return phase

    @property
    def far(self) -> NDArray[np.complex128]:
        """Return the farthest bins about their means, shape (n_frames, FAR_BINS)."""
        far = self.iq[:, -FAR_BINS:]
        centred: NDArray[np.complex128] = far - far.mean(axis=0)
        return centred

    def autocorrelation(self, n_lags: int) -> Array:
        """Return the far bins' autocorrelation at lags 0 ... n_lags - 1, shape (n_lags,)."""
        far, n = self.far, len(self.iq)
        products = [float((far[: n - lag].conj() * far[lag:]).real.mean()) for lag in range(n_lags)]
        return np.array(products) / products[0]

    def spectrum(self, bins: slice) -> tuple[Array, Array]:
        """Return frequencies [Hz] and amplitude spectral density per component [1/sqrt Hz].

        Positive and negative frequencies and all the bins are averaged in power. Both of shape
        (SEGMENT // 2,): without frequency 0, which is the mean's, and without the last.
        """
        frequency, density = welch(
            self.iq[:, bins],
            fs=self.rate_hz,
            window="hann",
            nperseg=SEGMENT,
            detrend="constant",
            return_onesided=False,
            axis=0,
        )
        # of a component: half the complex value's; of one side: the sum of both
        one_sided = (density + density[-np.arange(SEGMENT)]).mean(axis=1) / 2
        use = slice(1, SEGMENT // 2)
        return frequency[use], np.sqrt(one_sided[use])

    def phase_increments_rad(self, lags: NDArray[np.int64]) -> Array:
        """Return the standard deviation of the phase's change over lags, shape of ``lags``."""
        phase = self.phase_rad
        return np.array([float(np.std(phase[lag:] - phase[:-lag])) for lag in lags.tolist()])

    def quietest(self) -> SlowTime:
        """Return the stretch of `SEGMENT` frames whose far bins change least between frames."""
        power = (np.abs(np.diff(self.far, axis=0)) ** 2).mean(axis=1)
        total = np.convolve(power, np.ones(SEGMENT - 1), mode="valid")
        start = int(np.argmin(total))
        return replace(self, iq=self.iq[start : start + SEGMENT])

    def numbers(self) -> dict[str, float]:
        """Return the figures of the table, by the names in `TITLES`."""
        far = self.far
        frequency, density = self.spectrum(slice(-FAR_BINS, None))
        floor = float(np.sqrt((density[frequency >= FLOOR_FROM_HZ] ** 2).mean()))
        change = np.diff(self.phase_rad)
        return {
            "amplitude": float(self.amplitude[self.strongest]),
            "phase_rad": float(self.phase_rad.std()),
            "phase_white_rad": float(change.std() / np.sqrt(2)),
            "far_sigma": _component(far),
            "far_lag_1": float(self.autocorrelation(2)[1]),
            "far_white": _component(np.diff(far, axis=0)) / np.sqrt(2),
            "far_floor": floor * np.sqrt(self.rate_hz / 2),
            "far_neighbours": _neighbours(far),
            "far_neighbours_fast": _neighbours(np.diff(far, n=3, axis=0)),
        }


def _component(values: NDArray[np.complex128]) -> float:
    return float(np.sqrt((np.abs(values) ** 2).mean() / 2))


def _neighbours(values: NDArray[np.complex128]) -> float:
    """Return the mean magnitude of the correlation between bins that lie side by side."""
    sigma = np.sqrt((np.abs(values) ** 2).mean(axis=0))
    products = np.abs((values[:, 1:].conj() * values[:, :-1]).mean(axis=0))
    return float((products / (sigma[1:] * sigma[:-1])).mean())


def read_slow_time(path: Path, radar: str | None = None) -> SlowTime:
    """Return the baseband frames of a recording; of several radars, the named one.

    Raises AppError if there is no such recording, or it holds too few baseband frames of one shape.
    """
    try:
        records = read_recording(path, radar=radar)
        found = [(one, t_ns) for one, t_ns in records if isinstance(one, BasebandIq)]
    except RecordingError as error:
        raise AppError(str(error)) from None
    n_bins = {message.num_bins for message, _ in found}
    times_ns = [t_ns for _, t_ns in found if t_ns is not None]
    if len(found) < 2 * SEGMENT or len(times_ns) < len(found):
        raise AppError(
            f"{path}: {len(times_ns)} baseband frames with times; at least {2 * SEGMENT} are needed"
        )
    if len(n_bins) != 1 or n_bins.pop() <= 2 * FAR_BINS:
        raise AppError(f"{path}: all frames must have the same number of bins, > {2 * FAR_BINS}")
    stamps_ns = np.array(times_ns, dtype=np.int64)
    half = len(stamps_ns) // 2
    # stamps are of arrival, some late: the median over long intervals does not mind
    period_s = float(np.median(stamps_ns[half:] - stamps_ns[:-half])) / half / 1e9
    if not 0 < period_s < 1:
        raise AppError(f"{path}: its time stamps do not tell a frame rate of 1 Hz or more")
    first = found[0][0]
    return SlowTime(
        iq=np.stack([one.i + 1j * one.q.astype(np.complex128) for one, _ in found]),
        rate_hz=1 / period_s,
        first_bin_m=first.range_offset_m,
        bin_length_m=first.bin_length_m,
    )


def equivalent_scene(recorded: SlowTime) -> Scene:
    """Return one reflector where the strongest bin is, as strong as that; and nothing else."""
    label_m = recorded.first_bin_m + recorded.strongest * recorded.bin_length_m
    range_m = label_m * SPEED_OF_LIGHT_MPS / MODULE_SPEED_MPS
    amplitude = float(recorded.amplitude[recorded.strongest]) / echo_gain()
    radar = RadarSpec(name="radar", serial="201709131504", x_m=0.0, y_m=0.0, yaw_deg=0.0)
    reflector = TargetSpec(
        name="reflector", kind="point", x_m=range_m, y_m=0.0, amplitude_1m=amplitude * range_m**2
    )
    return Scene(
        name="static_reflector",
        environment="lab",
        description="One static reflector before a standing radar.",
        radars=(radar,),
        targets=(reflector,),
        noise=NOISE,
        clutter=CLUTTER,
        jitter=JITTER,
    )


def emulate(scene: Scene, like: SlowTime, seed: int) -> SlowTime:
    """Return as many frames of the same bins at the same rate from an emulated module in process.

    Raises AppError if the chip has no frame area with these bins.
    """
    n_frames, n_bins = like.iq.shape
    last_bin_m = like.first_bin_m + (n_bins - 1) * like.bin_length_m
    margin_m = like.bin_length_m / 4  # the area is rounded outwards to whole bins
    device = radar_device(
        Identity(serial=scene.radars[0].serial), echo_source(scene, 0, seed), Pace.ASAP
    )
    transport = LoopbackTransport(device, name="in process")
    with X4M300(transport, clock=transport.clock_ns) as driver:
        geometry = driver.configure_raw(
            RawConfig(
                frame_area_m=(like.first_bin_m + margin_m, last_bin_m - margin_m),
                downconversion=True,
            )
        )
        if geometry.n_bins != n_bins:
            raise AppError(
                f"the emulated chip gives {geometry.n_bins} bins for {like.first_bin_m:.4f} ... "
                f"{last_bin_m:.4f} m, the recording has {n_bins}"
            )
        driver.start(float(round(like.rate_hz)))
        frames = [frame.samples.astype(np.complex128) for frame in driver.frames(n_frames)]
    return SlowTime(
        iq=np.stack(frames),
        rate_hz=real_frame_rate(round(like.rate_hz)),
        first_bin_m=geometry.range_start_m,
        bin_length_m=geometry.bin_length_m,
    )


def echo_gain() -> float:
    """Return the baseband amplitude of a pulse of RF amplitude 1 in the middle of a line."""
    taps = CHANNELS[3]
    at = np.arange(TAP_COUNT) - taps.lead_samples
    cycles, samples = CARRIER_CYCLES_PER_SAMPLE[3]
    pulse = np.exp(
        -0.5 * (at / (SIGMA_S * SAMPLING_RATE_HZ)) ** 2 + 2j * np.pi * cycles / samples * at
    )
    return float(abs(np.dot(taps.i_taps, pulse)) / taps.absolute_sum)


def _draw(figure: Figure, recorded: SlowTime, emulated: Sequence[SlowTime]) -> None:
    """Draw amplitudes, spectra, autocorrelation and phase of both.

    Lines of the emulation are medians over its runs, bands reach from 10 to 90 %.
    """
    quiet = recorded.quietest()
    near, far = slice(recorded.strongest, recorded.strongest + 1), slice(-FAR_BINS, None)
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
    text = (
        "solid: mean amplitude, dashed: std per component\n"
        "in the scene there is the strongest\nreflector only: no room, nobody moves"
    )
    note(axes, text, (0.97, 0.97), (0, 0), INK, xycoords="axes fraction", ha="right", va="top")
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


def run(arguments: argparse.Namespace, stop: StopFlag) -> Result:
    recorded = read_slow_time(arguments.recording, arguments.radar)
    scene = equivalent_scene(recorded)
    emulated = []
    for seed in range(arguments.seed, arguments.seed + arguments.runs):
        stop.check()
        emulated.append(emulate(scene, recorded, seed))
    figures = recorded.numbers()
    quiet = recorded.quietest().numbers()
    runs = [one.numbers() for one in emulated]
    spread = {
        name: np.percentile([one[name] for one in runs], (10, 50, 90)).tolist() for name in TITLES
    }
    text = _three_digits
    return Result(
        numbers={
            "recording": str(arguments.recording),
            "frames": len(recorded.iq),
            "rate_hz": recorded.rate_hz,
            "seed": arguments.seed,
            "runs": arguments.runs,
            "recorded": figures,
            "recorded_quietest": quiet,
            "emulated": {
                name: dict(zip(("p10", "median", "p90"), values, strict=True))
                for name, values in spread.items()
            },
        },
        title=f"A real X4 ({len(recorded.iq)} frames at {recorded.rate_hz:.1f} Hz) and the "
        f"emulated one before a single static reflector ({len(emulated)} runs: median, 10-90 %)",
        size_in=(12.6, 7.6),
        draw=lambda figure: _draw(figure, recorded, emulated),
        tables=[
            table(
                f"{len(recorded.iq)} recorded frames at {recorded.rate_hz:.2f} Hz, and "
                f"{arguments.runs} emulated runs of as many, seeds from {arguments.seed}",
                {
                    "": list(TITLES.values()),
                    "recorded": [text(figures[name]) for name in TITLES],
                    "emulated: median": [text(spread[name][1]) for name in TITLES],
                    "10 ... 90 %": [
                        f"{text(spread[name][0])} ... {text(spread[name][2])}" for name in TITLES
                    ],
                    "recorded, quietest 128": [text(quiet[name]) for name in TITLES],
                },
            )
        ],
    )


def _three_digits(value: float) -> str:
    return f"{value:.3f}" if value >= 0.1 else f"{value:.2e}"
