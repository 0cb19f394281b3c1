"""Draw a real recording of a standing X4 module beside emulated frames of an equivalent scene.

`recording.png` shows amplitude, spectra, autocorrelation and phase over slow time. The recording is
real; what is simulated is one static reflector with the noise, clutter and jitter below, which are
fitted to the recording. Lines of the emulation are medians over its runs, bands 10 to 90 %.

Of a record of finite length all estimates are biased alike for slow processes, so records are
compared with records of the same length and rate, never with the parameters of a model.
"""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray
from scipy.signal import welch

from emulator.chip import Pace
from emulator.echo.echo import echo_source
from emulator.echo.pulse import CARRIER_CYCLES_PER_SAMPLE, SIGMA_S
from emulator.loopback import LoopbackTransport
from emulator.module.memory import Identity
from emulator.scene.scene import ClutterSpec, JitterSpec, NoiseSpec, Scene, TargetSpec, empty_room
from emulator.x4m300 import radar_device
from slam.app.run.pictures import ESTIMATE, ODOMETRY, TRUTH, label, picture
from xethru_protocol import load
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.processing.downconversion import CHANNELS, TAP_COUNT
from xethru_protocol.wire.x4 import MODULE_SPEED_MPS, SAMPLING_RATE_HZ, SPEED_OF_LIGHT_MPS

Array = NDArray[np.float64]
Measure = Callable[["SlowTime"], tuple[Array, Array]]
Records = tuple["SlowTime", Sequence["SlowTime"], "SlowTime"]

FAR = slice(-10, None)  # the farthest bins, taken for empty
SEGMENT = 128  # frames of a spectrum's segments, and of the quietest stretch
# 1.5e-5 per baseband component (1 / 4.18 of RF), the flat part of the far bins' spectrum. The rest
# of 2.1e-5 is the fast end of the clutter: beside it, 2.1e-5 of white noise would make 2.4e-5 new.
NOISE = NoiseSpec(rf_sigma=6.4e-5, iterations=16, pulses_per_step=300)
# 1.58e-4 per baseband component (0.70 of RF). In 30 s, the mean taken off, 1.4e-4 of it show.
CLUTTER = ClutterSpec(sigma=2.25e-4, correlation_s=4.8)
JITTER = JitterSpec(white_rad=0.0056, slow_rad=0.032, slow_correlation_s=4.0)


class SlowTime(NamedTuple):
    """Baseband frames of a standing radar."""

    iq: NDArray[np.complex128]  # (n_frames, n_bins)
    rate_hz: float  # frames per second
    ranges_m: Array  # (n_bins,): module metres

    def amplitude(self) -> Array:
        return np.asarray(np.abs(self.iq).mean(axis=0))

    def strongest(self) -> int:
        return int(np.argmax(self.amplitude()))

    def phase_rad(self) -> Array:
        """Return the strongest bin's phase about its mean, unwrapped, of each frame."""
        phase = np.unwrap(np.angle(self.iq[:, self.strongest()]))
        return np.asarray(phase - phase.mean(), dtype=np.float64)

    def far(self) -> NDArray[np.complex128]:
        return np.asarray(self.iq[:, FAR] - self.iq[:, FAR].mean(axis=0))

    def autocorrelation(self, longest_s: float) -> tuple[Array, Array]:
        """Return lags [s] from 0 on, and the far bins' autocorrelation."""
        far, lags = self.far(), np.arange(round(longest_s * self.rate_hz))
        products = [(far[: len(far) - k].conj() * far[k:]).real.mean() for k in lags.tolist()]
        return lags / self.rate_hz, np.array(products) / products[0]

    def spectrum(self, bins: slice) -> tuple[Array, Array]:
        """Return frequencies [Hz] and amplitude spectral density per component [1/sqrt Hz].

        Both signs of frequency and all bins are averaged in power; 0, the mean's, is left out.
        """
        rows = self.iq[:, bins].T
        frequency, density = welch(rows, self.rate_hz, nperseg=SEGMENT, return_onesided=False)
        # of a component: half the complex value's; of one side: the sum of both
        one_sided = (density + density[:, -np.arange(SEGMENT)]).mean(axis=0) / 2
        return frequency[1 : SEGMENT // 2], np.sqrt(one_sided[1 : SEGMENT // 2])

    def phase_changes_mrad(self) -> tuple[Array, Array]:
        """Return lags [s] up to a third of the record, and the phase's change over them, std."""
        lags = np.unique(np.geomspace(1, len(self.iq) // 3, 24).round().astype(np.int64))
        phase = 1e3 * self.phase_rad()
        changes = [np.std(phase[lag:] - phase[:-lag]) for lag in lags.tolist()]
        return lags / self.rate_hz, np.array(changes)

    def quietest(self) -> "SlowTime":
        """Return the stretch of `SEGMENT` frames whose far bins change least between frames."""
        power = (np.abs(np.diff(self.far(), axis=0)) ** 2).mean(axis=1)
        start = int(np.argmin(np.convolve(power, np.ones(SEGMENT - 1), mode="valid")))
        return self._replace(iq=self.iq[start : start + SEGMENT])


def read(path: Path) -> SlowTime:
    """Return the baseband frames of a recording of one radar, in any format that `load` reads."""
    found = load(path)
    iq, t_ns, ranges_m = found.iq, found.t_ns, found.ranges_m
    if iq is None or t_ns is None or ranges_m is None or len(iq) < 2 * SEGMENT:
        raise SystemExit(f"{path}: at least {2 * SEGMENT} baseband frames with times are needed")
    half = len(t_ns) // 2
    # stamps are of arrival, some late: the median over long intervals does not mind
    period_s = float(np.median(t_ns[half:] - t_ns[:-half])) / half / 1e9
    return SlowTime(iq=iq.astype(np.complex128), rate_hz=1 / period_s, ranges_m=ranges_m)


def equivalent_scene(recorded: SlowTime) -> Scene:
    """Return one reflector where the strongest bin is, as strong as that; and nothing else."""
    bin_m, amplitude = (x[recorded.strongest()] for x in (recorded.ranges_m, recorded.amplitude()))
    range_m = float(bin_m) * SPEED_OF_LIGHT_MPS / MODULE_SPEED_MPS
    strength = float(amplitude) / echo_gain() * range_m**2
    target = TargetSpec(name="static", kind="point", x_m=range_m, y_m=0.0, amplitude_1m=strength)
    room, noises = empty_room(), {"noise": NOISE, "clutter": CLUTTER, "jitter": JITTER}
    radar = room.radars[0].model_copy(update={"serial": "201709131504"})  # seeds the noise
    return room.model_copy(update={"radars": (radar,), "targets": (target,), **noises})


def echo_gain() -> float:
    """Return the baseband amplitude of a pulse of RF amplitude 1 in the middle of a line."""
    taps = CHANNELS[3]
    at = np.arange(TAP_COUNT) - taps.lead_samples
    cycles, samples = CARRIER_CYCLES_PER_SAMPLE[3]
    envelope = np.exp(-0.5 * (at / (SIGMA_S * SAMPLING_RATE_HZ)) ** 2)
    pulse = envelope * np.exp(2j * np.pi * cycles / samples * at)
    return float(abs(np.dot(taps.i_taps, pulse)) / taps.absolute_sum)


def emulate(scene: Scene, like: SlowTime, seed: int) -> SlowTime:
    """Return as many frames of the same bins at the same rate from an emulated module."""
    margin_m = (like.ranges_m[1] - like.ranges_m[0]) / 4  # an area is rounded outwards to bins
    area_m = (float(like.ranges_m[0] + margin_m), float(like.ranges_m[-1] - margin_m))
    serial = Identity(serial=scene.radars[0].serial)
    device = radar_device(serial, echo_source(scene, 0, seed), Pace.ASAP)
    transport = LoopbackTransport(device, name="in process")
    with X4M300(transport, clock=transport.clock_ns) as driver:
        geometry = driver.configure_raw(RawConfig(frame_area_m=area_m, downconversion=True))
        if geometry.n_bins != len(like.ranges_m):
            raise SystemExit(f"the emulated chip has no frame area with the bins of {area_m} m")
        rate_hz = driver.start(float(round(like.rate_hz)))
        frames = [each.samples.astype(np.complex128) for each in driver.frames(len(like.iq))]
    return like._replace(iq=np.stack(frames), rate_hz=rate_hz)


def draw(axes: Axes, measure: Measure, records: Records, *labels: str, style: str = "-") -> None:
    """Draw what is measured on the recording, on the emulated runs and on the quietest stretch."""
    recorded, runs, quiet = records
    axes.plot(*measure(recorded), color=ODOMETRY, linestyle=style, label="recorded")
    x, values = measure(recorded)[0], [measure(one)[1] for one in runs]
    low, middle, high = np.percentile(values, (10, 50, 90), axis=0)
    axes.fill_between(x, low, high, color=ESTIMATE, alpha=0.2, linewidth=0)
    axes.plot(x, middle, color=ESTIMATE, linestyle=style, label="emulated")
    axes.plot(*measure(quiet), color=TRUTH, linewidth=1.0, label="recorded, quietest 8 s")
    label(axes, *labels)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/studies"), help="folder to write to")
    parser.add_argument("--seed", type=int, default=0, help="seed of the first run, drawn in (e)")
    parser.add_argument("--runs", type=int, default=20, help="emulated runs")
    parser.add_argument("--recording", type=Path, required=True, help="as `xethru record` writes")
    given = parser.parse_args()
    recorded = read(given.recording)
    scene, seeds = equivalent_scene(recorded), range(given.seed, given.seed + given.runs)
    runs = [emulate(scene, recorded, seed) for seed in seeds]
    title = f"A real X4 ({len(recorded.iq)} frames at {recorded.rate_hz:.1f} Hz) and the emulated "
    title += f"one before a single static reflector ({len(runs)} runs: median, 10-90 %)"
    path, strongest = given.out / "recording.png", recorded.strongest()
    with picture(path, width_in=12.6, height_in=7.6, title=title) as figure:
        (bins, near, far), (lags, phase, changes) = figure.subplots(2, 3)
        records = (recorded, runs, recorded.quietest())
        title = "(a) bins: mean, dashed: std per component"
        labels = [title, "range [module m]", "amplitude"]
        draw(
            bins,
            lambda one: (one.ranges_m, one.iq.std(axis=0) / 2**0.5),
            records,
            *labels,
            style="--",
        )
        draw(bins, lambda one: (one.ranges_m, one.amplitude()), records, *labels)
        labels = ["frequency over slow time [Hz]", "amplitude per component [1/√Hz]"]
        title, one_bin = "(b) spectrum of the strongest bin", slice(strongest, strongest + 1)
        draw(near, lambda one: one.spectrum(one_bin), records, title, *labels)
        draw(far, lambda one: one.spectrum(FAR), records, "(c) the ten farthest bins", *labels)
        far.legend(frameon=False)
        labels = ["(d) the ten farthest bins: autocorrelation", "lag [s]", "correlation"]
        draw(lags, lambda one: one.autocorrelation(4.0), records, *labels)
        labels = ["(f) change of that phase over a lag", "lag [s]", "std [mrad]"]
        draw(changes, lambda one: one.phase_changes_mrad(), records, *labels)
        for one, colour in ((runs[0], ESTIMATE), (recorded, ODOMETRY)):
            phase.plot(np.arange(len(one.iq)) / one.rate_hz, 1e3 * one.phase_rad(), color=colour)
        label(phase, "(e) phase of the strongest bin (one run)", "time [s]", "phase [mrad]")
        for axes in (bins, near, far, changes):
            axes.set_yscale("log")
        changes.set_xscale("log")
        changes.set_yticks(ticks := [1, 2, 5, 10, 20, 50, 100], [f"{each}" for each in ticks])
        changes.minorticks_off()


if __name__ == "__main__":
    main()
