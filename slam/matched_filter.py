"""Front ends that know the pulse: ``matched_filter`` and ``joint``.

Echoes are the local maxima of the magnitude of y, the frame correlated with the pulse
(:mod:`slam.pulse_filter`), above its threshold. The logarithm of the magnitude is a parabola around
an echo: the vertex through three of its values is the position, and its scatter is the Cramer-Rao
bound of the position with unknown amplitude and phase (``PulseModel.position_bound_bins``).

Misfit
    Energy of y minus the fitted pulse at nine points within 2 s of the peak (s the envelope's
    sigma), over what noise leaves there when amplitude, phase and position are fitted: per point
    2 - (2 + d**2 / (2 s**2)) rho(d)**2 in units of sigma_y**2, d the distance from the peak.
Joint
    Where peaks overlap or one is not one pulse, and the misfit is more than the pulse's own
    uncertain shape leaves, :mod:`slam.close_echoes` decides how many echoes there are and where.
Cut pulses
    Where samples within 3 s of a peak are missing - saturated, or beyond an end of the frame - the
    echo is fitted to those that are left, likewise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from slam.close_echoes import SplitTest
from slam.config import FrontEnd, SlamConfig
from slam.detector import Detection, reaches_limits, usable_samples
from slam.frames import RadarFrame
from slam.pulse_filter import BINS_PER_STEP, PulseFilter
from slam.pulse_model import PulseModel
from slam.pulse_refit import OVERLAP, Filtered, Peaks, cut_pulses, refit

Array = NDArray[np.float64]

# Most echoes that a group is taken apart into.
_MAX_ECHOES = 4
# A second look is worth while where this part of the pulse's own possible error is exceeded.
_SUSPICIOUS = 0.5
_NEIGHBOURS = np.array([[-1], [0], [1]])
# A float32 frame says its samples to this part of the largest; noise is never less.
_RESOLUTION = float(np.finfo(np.float32).eps)


class MatchedFilterDetector:
    """Echoes by correlation with the pulse; under ``joint``, those that overlap fitted together.

    Parameters
    ----------
    config
        Range limits, pulse, false alarms.
    """

    def __init__(self, config: SlamConfig) -> None:
        settings = config.matched_filter
        self.config = config
        self.pulse = PulseModel(carrier_hz=settings.carrier_hz, bandwidth_hz=settings.bandwidth_hz)
        self._joint = config.detection.front_end is FrontEnd.JOINT
        self._split = SplitTest(
            max_echoes=_MAX_ECHOES if self._joint else 1, model_error=settings.model_error
        )
        self._filters: dict[tuple[int, float], PulseFilter] = {}

    def detect(self, frame: RadarFrame, range_offset_m: float = 0.0) -> tuple[Detection, ...]:
        """Return the echoes of one frame inside the range limits; see ``Detector``."""
        limits = self.config.detection
        start_m = frame.range_start_m - range_offset_m
        peaks = self.peaks(frame, (limits.min_range_m - start_m, limits.max_range_m - start_m))
        ranges_m = start_m + peaks.position_bins * frame.bin_length_m
        columns = zip(
            ranges_m.tolist(),
            peaks.amplitude.tolist(),
            peaks.phase_rad.tolist(),
            (peaks.sigma_bins * frame.bin_length_m).tolist(),
            peaks.misfit.tolist(),
            peaks.saturated.tolist(),
            strict=True,
        )
        return tuple(
            Detection(
                radar=frame.radar,
                t_ns=frame.t_ns,
                range_m=range_m,
                amplitude=amplitude,
                phase_rad=math.remainder(phase_rad, math.tau),
                sigma_m=sigma_m,
                misfit=misfit,
                saturated=saturated,
            )
            for range_m, amplitude, phase_rad, sigma_m, misfit, saturated in columns
            if limits.min_range_m <= range_m <= limits.max_range_m
        )

    def detect_many(
        self, frames: Sequence[RadarFrame], offsets_m: Sequence[float]
    ) -> list[tuple[Detection, ...]]:
        """Return the echoes of each frame; see ``Detector``."""
        return [self.detect(*each) for each in zip(frames, offsets_m, strict=True)]

    def peaks(self, frame: RadarFrame, within_m: tuple[float, float]) -> Peaks:
        """Return every echo of a frame, whatever its range.

        Samples that are NaN or lie at one of the frame's limits are not used. A second look is
        taken only at echoes that lie ``within_m``, from the first bin on [m], or overlap with one
        that may.
        """
        filtered = self._filtered(frame)
        found, unexplained = _single_pulses(filtered)
        again = cut_pulses(found.position_bins, filtered)
        if self._joint:
            settings = self.config.matched_filter
            several = found.misfit > settings.max_single_misfit
            several &= unexplained > (_SUSPICIOUS * settings.model_error) ** 2
            again = several if again is None else again | several
        if again is None:
            return found
        reach = OVERLAP * filtered.pulse_filter.sigma_bins
        again &= found.position_bins > within_m[0] / frame.bin_length_m - reach
        again &= found.position_bins < within_m[1] / frame.bin_length_m + reach
        if not again.any():
            return found
        return refit(found, again, filtered, self._split)

    def _filter(self, frame: RadarFrame) -> PulseFilter:
        key = frame.samples.size, frame.bin_length_m
        if key not in self._filters:
            settings = self.config.matched_filter
            self._filters[key] = PulseFilter(
                self.pulse,
                *key,
                false_alarms=settings.false_alarms_per_frame,
                noise_is_told=settings.noise_sigma > 0,
            )
        return self._filters[key]

    def _filtered(self, frame: RadarFrame) -> Filtered:
        pulse_filter = self._filter(frame)
        samples = frame.samples.astype(np.float64)
        lowest, highest = float(samples.min()), float(samples.max())
        usable = None
        if math.isnan(lowest) or reaches_limits(frame, lowest, highest):
            usable = usable_samples(frame)
            samples[np.isnan(samples)] = 0.0
            lowest, highest = float(samples.min()), float(samples.max())
        # A constant frame must come out as nothing, not as the two steps at its ends.
        samples -= np.add.reduce(samples) / samples.size
        y = pulse_filter.apply(samples)
        power = y.real**2 + y.imag**2
        told = self.config.matched_filter.noise_sigma
        sigma_y = told * pulse_filter.noise_gain
        if not told:
            sigma_y = math.sqrt(pulse_filter.noise_power(power))
        sigma_y = max(sigma_y, _RESOLUTION * max(highest, -lowest))
        return Filtered(
            samples=samples,
            usable=usable,
            y=y,
            power=power,
            sigma_y=sigma_y,
            pulse_filter=pulse_filter,
        )


def _single_pulses(filtered: Filtered) -> tuple[Peaks, Array]:
    """Return every peak as if it were one pulse, and the part of its energy that is none."""
    y, power, sigma_y = filtered.y, filtered.power, filtered.sigma_y
    pulse_filter = filtered.pulse_filter
    at = (power[1:-1] > (pulse_filter.threshold * sigma_y) ** 2).nonzero()[0] + 1
    near = power.take(at + _NEIGHBOURS)
    highest = (near[1] > near[0]) & (near[1] >= near[2])
    at = at[highest]
    before, middle, after = np.log(near[:, highest])
    offset = 0.5 * BINS_PER_STEP * (before - after) / (before - 2 * middle + after)
    s, kappa = pulse_filter.sigma_bins, pulse_filter.carrier_rad
    at_peak = y[at]
    height = np.abs(at_peak)
    amplitude = height * np.exp((offset / (2 * s)) ** 2)

    # Turned back by the peak's phase and the carrier, a pulse is real.
    around = y.take(at[:, np.newaxis] + pulse_filter.probes, mode="clip")
    around *= pulse_filter.probe_turns
    around *= (at_peak.conj() / height)[:, np.newaxis]
    away = pulse_filter.probe_sigmas - (offset / s)[:, np.newaxis]
    around -= amplitude[:, np.newaxis] * np.exp(-0.25 * (away * away))
    left = np.vecdot(around, around).real
    peaks = Peaks(
        position_bins=BINS_PER_STEP * at + offset,
        amplitude=amplitude,
        phase_rad=np.arctan2(at_peak.imag, at_peak.real) + kappa * offset,
        sigma_bins=math.sqrt(2) * s * sigma_y / amplitude,
        misfit=left / (sigma_y**2 * pulse_filter.probe_noise),
        saturated=np.zeros(at.size, dtype=np.bool_),
    )
    return peaks, left / (amplitude**2 * pulse_filter.probe_energy)
