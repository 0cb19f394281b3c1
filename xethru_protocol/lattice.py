"""Which samples a chip can send: the only check there is on the inside of a NoEscape frame.

A radar frame carries float32 values, but the chip counts in integers and the firmware multiplies
each count by one quantum. So only few of all float32 values can be true, and a damaged sample is
nearly always none of them (Protocol reference 9.7). That holds for radar frames as the chip's
driver sends them; what a profile filters before it sends it (BASEBAND_IQ of a real recording) is
on no lattice.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from xethru_protocol.errors import LocalProtocolError
from xethru_protocol.x4 import Normalisation

# Sum of the absolute filter taps of the first I set, by TXCENTERFREQUENCY.
_TAP_SUMS: Final = {3: 306, 4: 316}

# Two float32 roundings lie between a counter and its sample: together less than 2 counts.
_NEIGHBOURS: Final = (-2.0, -1.0, -0.5, 0.5, 1.0, 2.0)

Float32s = NDArray[np.float32]
Float64s = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Lattice:
    """The float32 values that counters of one setting become, by the firmware's arithmetic.

    RF: ``counter * quantum - dac_offset`` for the counters 0 ... ``max_counter``. Baseband:
    ``counter * quantum / tap_sum`` for sums of counters weighted by taps of total 0, so from
    ``-max_counter`` to ``max_counter``; Q is sent with the opposite sign, which is the same set.
    Every step rounds to float32; a compiler may have fused RF's product and difference, so the
    value rounded once is accepted, too.

    ``lowest`` and ``highest`` are the ends of the range.
    """

    quantum: np.float32
    dac_offset: np.float32
    tap_sum: np.float32
    min_counter: int
    max_counter: int
    lowest: float
    highest: float

    @classmethod
    def of(
        cls,
        *,
        iterations: int,
        pulses_per_step: int,
        dac_min: int,
        dac_max: int,
        dac_step: int,
        downconversion: bool,
        tx_center_frequency: int,
    ) -> "Lattice":
        """Lattice of a radar with these settings.

        Raises
        ------
        LocalProtocolError
            If the settings count nothing, or no filter is known for the centre frequency.

        >>> lattice = Lattice.of(
        ...     iterations=16, pulses_per_step=300, dac_min=949, dac_max=1100, dac_step=0,
        ...     downconversion=False, tx_center_frequency=3)
        >>> lattice.off_lattice(np.array([-0.07421875, 0.0, 0.0742, 0.1], np.float32))
        2
        """
        if min(iterations, pulses_per_step, dac_max - dac_min + 1) < 1:
            raise LocalProtocolError("a chip with these settings counts nothing")
        if downconversion and tx_center_frequency not in _TAP_SUMS:
            raise LocalProtocolError(
                f"no filter is known for centre frequency {tx_center_frequency}"
            )
        unit = Normalisation.of(
            iterations=iterations,
            pulses_per_step=pulses_per_step,
            dac_min=dac_min,
            dac_max=dac_max,
            dac_step=dac_step,
        )
        tap_sum = _TAP_SUMS[tx_center_frequency] if downconversion else 1
        # all positive taps see the most and all negative ones nothing, or the reverse
        largest = unit.max_counter * tap_sum // 2 if downconversion else unit.max_counter
        smallest = -largest if downconversion else 0
        offset = 0.0 if downconversion else unit.dac_offset
        ends = _values(
            np.array([smallest, largest], np.float32),
            np.float32(unit.quantum),
            np.float32(offset),
            np.float32(tap_sum),
        )
        return cls(
            quantum=np.float32(unit.quantum),
            dac_offset=np.float32(offset),
            tap_sum=np.float32(tap_sum),
            min_counter=smallest,
            max_counter=largest,
            lowest=float(ends[0]),
            highest=float(ends[1]),
        )

    def off_lattice(self, samples: Float32s) -> int:
        """Count the samples that no chip counter can give; NaN and infinities are such.

        Parameters
        ----------
        samples
            Values as sent, shape (n,), float32.
        """
        # Nearly every frame is whole: one rounding to the lattice and back proves it. Bytes take
        # a fourth of array_equal's time; a -0.0, which they tell from 0.0, is judged below.
        if samples.size == 0 or (
            np.minimum.reduce(samples) >= self.lowest
            and np.maximum.reduce(samples) <= self.highest
            and self._rounded(samples).tobytes() == samples.tobytes()
        ):
            return 0
        with np.errstate(invalid="ignore"):  # comparing with a signalling NaN
            in_range = samples[(samples >= self.lowest) & (samples <= self.highest)]
        doubtful = in_range[self._rounded(in_range) != in_range]
        bad = samples.size - in_range.size + doubtful.size - self._count_neighbours(doubtful)
        return int(bad)

    def nearest(self, samples: Float32s) -> Float32s:
        """Return what the chip would give for samples: of the nearest counter it can hold.

        Parameters
        ----------
        samples
            Finite values, shape (n,), float32.
        """
        counters = np.rint((samples + self.dac_offset) * (self.tap_sum / self.quantum))
        counters = np.clip(counters, self.min_counter, self.max_counter).astype(np.float32)
        return _values(counters, self.quantum, self.dac_offset, self.tap_sum)

    def _rounded(self, samples: Float32s) -> Float32s:
        """Round each sample to the value of the nearest counter, found in float32."""
        scale = self.tap_sum / self.quantum
        counters = samples + self.dac_offset
        counters *= scale
        np.rint(counters, out=counters)
        return _values(counters, self.quantum, self.dac_offset, self.tap_sum)

    def _count_neighbours(self, samples: Float32s) -> int:
        """Count samples that a counter near the most likely one gives, or the fused arithmetic."""
        scale = float(self.tap_sum) / float(self.quantum)
        middle: Float64s = np.rint((samples.astype(np.float64) + float(self.dac_offset)) * scale)
        # Beyond 2**24 the firmware's float32 skips counters.
        spacing = np.maximum(np.spacing(np.abs(middle).astype(np.float32)), np.float32(1.0))
        found = np.zeros(samples.shape, np.bool_)
        for steps in (0.0, *_NEIGHBOURS):
            exact = np.rint(middle + steps * spacing)
            valid = (exact >= self.min_counter) & (exact <= self.max_counter)
            counters = exact.astype(np.float32)
            separate = _values(counters, self.quantum, self.dac_offset, self.tap_sum)
            found |= valid & (separate == samples)
            if self.tap_sum == 1.0:
                fused = counters.astype(np.float64) * float(self.quantum) - float(self.dac_offset)
                found |= valid & (fused.astype(np.float32) == samples)
        return int(np.count_nonzero(found))


def _values(
    counters: Float32s, quantum: np.float32, dac_offset: np.float32, tap_sum: np.float32
) -> Float32s:
    """Compute the samples of counters; each operation rounds to float32, as in the firmware."""
    values = counters * quantum
    if tap_sum != 1.0:
        values /= tap_sum
    else:
        values -= dac_offset
    return values
