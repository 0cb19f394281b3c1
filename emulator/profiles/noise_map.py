"""The noise map: what the pulse-Doppler matrices hold of a room where nobody moves.

Noise map control chooses where the map of a starting profile comes from (`map_source`): a stored
one, the default - the receiver noise of a nominal module, the same in every bin - or one created
from the first 100 s after the matrices are full. Afterwards it follows the room with a time
constant of ten minutes, but not in bins where somebody may be. The two last numbers of that
sentence and the default map are ours; the reference names the 100 s only.

Source: protocol reference 4.6.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import Enum, auto

import numpy as np
from numpy.typing import NDArray

from emulator.downconversion import CHANNELS
from emulator.profiles.doppler import MATRICES, Matrix
from emulator.scene import NoiseSpec
from xethru_protocol.codes import MatrixInstance, NoiseMapControl

__all__ = [
    "CREATION_TICKS",
    "MapSource",
    "NoiseMap",
    "StoredMap",
    "default_noise_map",
    "map_source",
]

CREATION_TICKS = 100
"""Matrices that are averaged for a new map, one per tick of 0.997 s."""
ADAPTATION = 1 / 600
"""Share of the newest matrix in the adapting map, per tick."""

_FILE_HEADER = struct.Struct("<ffII")

Powers = dict[MatrixInstance, NDArray[np.float64]]


class MapSource(Enum):
    """Where the noise map of a starting profile comes from."""

    STORED = auto()
    DEFAULT = auto()
    CREATED = auto()


def map_source(control: int, *, stored: bool) -> MapSource:
    """Return which map to start with.

    Examples
    --------
    >>> [map_source(control, stored=False).name for control in (2, 3, 6, 7)]
    ['DEFAULT', 'CREATED', 'DEFAULT', 'CREATED']
    >>> [map_source(control, stored=True).name for control in (2, 3, 6, 7)]
    ['STORED', 'STORED', 'DEFAULT', 'CREATED']
    """
    if stored and not control & NoiseMapControl.IGNORE_STORED:
        return MapSource.STORED
    return MapSource.CREATED if control & NoiseMapControl.NO_DEFAULT else MapSource.DEFAULT


class NoiseMap:
    """Mean power by matrix, range and frequency.

    Attributes
    ----------
    power
        By instance, shape (n_bins, frequencies), float64.
    """

    def __init__(self, power: Powers | None = None) -> None:
        self.power: Powers = {} if power is None else power
        self._learned = 0 if power is None else CREATION_TICKS

    @property
    def complete(self) -> bool:
        """Whether it may be used."""
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

    def copy(self) -> NoiseMap:
        """Return a map that changes independently."""
        return NoiseMap({instance: power.copy() for instance, power in self.power.items()})


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredMap:
    """A noise map kept over restarts, valid for one zone and band.

    Attributes
    ----------
    zone_m
        Detection zone it was made in [module metres].
    tx_center_frequency
        Band it was made in.
    noise_map
        The map.
    """

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
        """Whether it was made in this zone and band."""
        bins = {len(power) for power in self.noise_map.power.values()}
        same_zone = np.allclose(self.zone_m, zone_m, atol=1e-5)
        return same_zone and self.tx_center_frequency == tx_center_frequency and bins == {n_bins}


def default_noise_map(n_bins: int, tx_center_frequency: int) -> NoiseMap:
    """Return the map of nominal receiver noise: white, equal in all bins."""
    taps = CHANNELS[tx_center_frequency]
    gain = sum(tap * tap for tap in taps.i_taps) / taps.absolute_sum**2
    variance = 2 * gain * NoiseSpec().rf_sigma ** 2
    return NoiseMap(
        {
            matrix.instance: np.full((n_bins, matrix.pulses), variance * _noise_gain(matrix))
            for matrix in MATRICES
        }
    )


def _noise_gain(matrix: Matrix) -> float:
    """Return the power at one frequency of white noise of variance 1 per frame."""
    window = matrix.window
    return float((window**2).sum() / window.sum() ** 2) / matrix.decimation
