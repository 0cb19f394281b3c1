"""The radar under a profile: its baseband, pulse-Doppler matrices and noise map.

The profile drives the X4 with the sensor's working point: 17 frames/s of baseband over the
detection zone and one bin more at either end. The profile's chip is a model of its own, so the
X4 commands of a host neither see nor disturb it (assumed; on hardware they would disturb it).

| Matrix | Frames averaged | Pulses F | Window | Frequencies | Sent |
|---|---|---|---|---|---|
| slow | 4 | 85 | 340 frames, 19.94 s | +-2.1 Hz, step 0.050 Hz | every 85 frames, 4.99 s |
| fast | 1 | 34 | 34 frames, 1.99 s | +-8.5 Hz, step 0.501 Hz | every 17 frames, 0.997 s |

The slow window is the 20 s which a profile needs to start; all other numbers are ours, because the
reference gives none. Power is that of a complex tone: amplitude A at one of the frequencies reads
A**2, in the normalised units of baseband. What stands still is at 0 Hz and, through the Hann
window, at one step on either side. Approaching is positive, as the phase falls with range.

Noise map control chooses where the map of a starting profile comes from: a stored one, the
default - the receiver noise of a nominal module, the same in every bin - or one created from the
first 100 s after the matrices are full. Afterwards it follows the room with a time constant of ten
minutes, but not in bins where a person may be. The time constant and the default map are ours; the
reference names the 100 s only.

Source: protocol reference 4.6, 7.1, 7.2, 8.3 and 9.3.
"""

from __future__ import annotations

import struct
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emulator.chip.chip import Chip, EchoSource
from emulator.scene.scene import NoiseSpec
from xethru_protocol.processing.doppler import hann
from xethru_protocol.processing.downconversion import CHANNELS
from xethru_protocol.wire import x4
from xethru_protocol.wire.codes import MatrixInstance, X4Setting
from xethru_protocol.wire.messages import X4Value

REQUESTED_FPS = 17.0
FRAME_RATE_HZ = x4.real_frame_rate(REQUESTED_FPS)
"""What the chip's timer makes of 17 frames per second: 17.049 Hz."""
FRAMES_PER_TICK = 17
"""Frames from one presence message to the next: 0.997 s."""

_WORKING_POINT: dict[X4Setting, X4Value] = {
    X4Setting.DACMIN: 949,
    X4Setting.DACMAX: 1100,
    X4Setting.ITERATIONS: 16,
    X4Setting.PULSESPERSTEP: 300,
    X4Setting.TXPOWER: 2,
    X4Setting.DOWNCONVERSION: 1,
    X4Setting.FPS: REQUESTED_FPS,
}
CREATION_TICKS = 100
"""Matrices that are averaged for a new map, one per tick of 0.997 s."""
ADAPTATION = 1 / 600
"""Share of the newest matrix in the adapting map, per tick."""
_FILE_HEADER = struct.Struct("<ffII")

Powers = dict[MatrixInstance, NDArray[np.float64]]


class ProfileSweep:
    """Baseband frames of one zone, each selected by its index in scene time.

    Attributes
    ----------
    range_m
        Shape (n_bins,), float64: range of each bin [module metres].
    in_zone
        Shape (n_bins,), bool: the bins inside the zone.
    """

    def __init__(
        self,
        source: EchoSource,
        *,
        zone_m: tuple[float, float],
        tx_center_frequency: int,
        largest_block: int,
    ) -> None:
        self._chip = Chip(source, largest_block)
        start_m, end_m = zone_m
        margin_m = x4.BASEBAND_BIN_M
        for setting, value in _WORKING_POINT.items():
            self._chip.set(setting, value)
        self._chip.set(X4Setting.TXCENTERFREQUENCY, tx_center_frequency)
        self._chip.set(X4Setting.FRAMEAREA, (start_m - margin_m, end_m + margin_m))
        area = self._chip.area
        bins = np.arange(area.n_bins, dtype=np.float64)
        self.range_m: NDArray[np.float64] = area.start_m + bins * x4.BASEBAND_BIN_M
        tolerance_m = x4.BASEBAND_BIN_M / 2
        self.in_zone: NDArray[np.bool_] = (self.range_m > start_m - tolerance_m) & (
            self.range_m < end_m + tolerance_m
        )
        self.timeline = self._chip.timeline
        self.carrier_hz = x4.CARRIER_HZ[tx_center_frequency]

    @property
    def n_bins(self) -> int:
        return len(self.range_m)

    def first_index_from(self, scene_time_ns: int) -> int:
        """Return the first index that does not lie before a scene time."""
        self.timeline.next_index = 0
        self.timeline.pause_until(scene_time_ns)
        return self.timeline.next_index

    def frame(self, index: int) -> NDArray[np.complex128]:
        """Return I + jQ of one frame, shape (n_bins,); its float32 values, exactly."""
        self.timeline.next_index = index
        values = self._chip.next_frame().values.astype(np.float64)
        iq: NDArray[np.complex128] = values[: self.n_bins] + 1j * values[self.n_bins :]
        return iq


@dataclass(frozen=True, slots=True, kw_only=True)
class Matrix:
    """One of the two pulse-Doppler matrices.

    Attributes
    ----------
    decimation
        Frames averaged to one pulse.
    pulses
        Pulses per transform, and frequencies.
    period
        Frames from one matrix sent to the next.
    notch
        Frequencies on either side of 0 Hz that detection leaves out.
    """

    instance: MatrixInstance
    decimation: int
    pulses: int
    period: int
    notch: int

    @property
    def frames(self) -> int:
        """Frames that fill it."""
        return self.decimation * self.pulses

    @property
    def rate_hz(self) -> float:
        return FRAME_RATE_HZ / self.decimation

    @property
    def step_hz(self) -> float:
        return self.rate_hz / self.pulses

    @property
    def start_hz(self) -> float:
        return -(self.pulses // 2) * self.step_hz

    @property
    def moving(self) -> NDArray[np.bool_]:
        """Which frequencies are movement, shape (pulses,)."""
        return np.abs(np.arange(self.pulses) - self.pulses // 2) > self.notch


SLOW = Matrix(instance=MatrixInstance.SLOW, decimation=4, pulses=85, period=85, notch=1)
FAST = Matrix(instance=MatrixInstance.FAST, decimation=1, pulses=34, period=17, notch=2)
MATRICES = (SLOW, FAST)


class SlowTime:
    """The newest pulses of one matrix."""

    def __init__(self, matrix: Matrix) -> None:
        self._matrix = matrix
        window = hann(matrix.pulses)
        self._window = window[:, np.newaxis] / window.sum()
        self.clear()

    def clear(self) -> None:
        self._pulses: deque[NDArray[np.complex128]] = deque(maxlen=self._matrix.pulses)
        self._sum: NDArray[np.complex128] | None = None
        self._summed = 0

    @property
    def full(self) -> bool:
        return len(self._pulses) == self._matrix.pulses

    def add(self, iq: NDArray[np.complex128]) -> None:
        """Take one frame, shape (n_bins,)."""
        self._sum = iq if self._sum is None else self._sum + iq
        self._summed += 1
        if self._summed == self._matrix.decimation:
            self._pulses.append(self._sum / self._matrix.decimation)
            self._sum, self._summed = None, 0

    def pulses(self) -> NDArray[np.complex128]:
        """Return what is there, oldest first, shape (at most matrix.pulses, n_bins)."""
        return np.array(self._pulses)

    def power(self) -> NDArray[np.float64]:
        """Return the matrix, shape (n_bins, matrix.pulses), lowest frequency first."""
        spectrum = np.fft.fft(self.pulses() * self._window, axis=0)
        power = spectrum.real**2 + spectrum.imag**2
        return np.ascontiguousarray(np.fft.fftshift(power, axes=0).T)


class NoiseMap:
    """Mean power, by instance of matrix: shape (n_bins, frequencies), float64."""

    def __init__(self, power: Powers | None = None) -> None:
        self.power: Powers = {} if power is None else power
        self._learned = 0 if power is None else CREATION_TICKS

    @property
    def complete(self) -> bool:
        return self._learned >= CREATION_TICKS

    def learn(self, power: Powers) -> None:
        """Average one more tick's matrices into a map that is being created."""
        self._learned += 1
        for instance, newest in power.items():
            mean = self.power.get(instance)
            self.power[instance] = (
                newest.copy() if mean is None else mean + (newest - mean) / self._learned
            )

    def adapt(self, power: Powers, quiet: NDArray[np.bool_]) -> None:
        """Follow the room in the quiet bins, shape (n_bins,)."""
        for instance, newest in power.items():
            mean = self.power[instance]
            mean[quiet] += ADAPTATION * (newest[quiet] - mean[quiet])


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredMap:
    """A noise map kept over restarts, valid for one zone [module metres] and band."""

    zone_m: tuple[float, float]
    tx_center_frequency: int
    noise_map: NoiseMap

    def files(self) -> tuple[bytes, bytes]:
        """Return the content of the two files, slow and fast.

        Each is zone start and end (f32), band and frequencies (u32), then power (f32) by range;
        little-endian. The layout is ours.
        """
        header = (*self.zone_m, self.tx_center_frequency)
        slow, fast = (
            _FILE_HEADER.pack(*header, matrix.pulses)
            + self.noise_map.power[matrix.instance].astype("<f4").tobytes()
            for matrix in MATRICES
        )
        return slow, fast

    @classmethod
    def of_files(cls, files: tuple[bytes, bytes]) -> StoredMap | None:
        """Return the map in the two files; None if they hold none, or two of different runs."""
        power: Powers = {}
        headers = set()
        for matrix, data in zip(MATRICES, files, strict=True):
            if len(data) <= _FILE_HEADER.size:
                return None
            start_m, end_m, band, frequencies = _FILE_HEADER.unpack_from(data)
            rows = len(data) - _FILE_HEADER.size
            if frequencies != matrix.pulses or rows % (4 * matrix.pulses):
                return None
            values = np.frombuffer(data, dtype="<f4", offset=_FILE_HEADER.size)
            power[matrix.instance] = values.astype(np.float64).reshape(-1, matrix.pulses)
            headers.add((start_m, end_m, band, rows // (4 * matrix.pulses)))
        if len(headers) != 1 or not all(np.isfinite(one).all() for one in power.values()):
            return None
        ((start_m, end_m, band, _),) = headers
        return cls(zone_m=(start_m, end_m), tx_center_frequency=band, noise_map=NoiseMap(power))

    def fits(self, zone_m: tuple[float, float], tx_center_frequency: int, n_bins: int) -> bool:
        bins = {len(power) for power in self.noise_map.power.values()}
        same_zone = np.allclose(self.zone_m, zone_m, atol=1e-5)
        return same_zone and self.tx_center_frequency == tx_center_frequency and bins == {n_bins}


def default_noise_map(n_bins: int, tx_center_frequency: int) -> NoiseMap:
    """Return the map of nominal receiver noise: white, equal in all bins."""
    taps = CHANNELS[tx_center_frequency]
    gain = sum(tap * tap for tap in taps.i_taps) / taps.absolute_sum**2
    variance = 2 * gain * NoiseSpec().rf_sigma ** 2
    power = {}
    for matrix in MATRICES:
        window = hann(matrix.pulses)
        # the power at one frequency of white noise of variance 1 per frame
        noise_gain = float((window**2).sum() / window.sum() ** 2) / matrix.decimation
        power[matrix.instance] = np.full((n_bins, matrix.pulses), variance * noise_gain)
    return NoiseMap(power)
