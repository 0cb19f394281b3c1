"""Frames as an application sees them, and where their bins lie."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from xethru_protocol.messages import BasebandIq, DataFloat

Samples = npt.NDArray[np.float32] | npt.NDArray[np.complex64]


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameGeometry:
    """Where the bins of a frame lie, in module metres, from the module's own answers.

    Bin k lies at ``range_start_m + k * bin_length_m``, in RF and in baseband.
    """

    range_start_m: float
    bin_length_m: float
    n_bins: int
    downconversion: bool

    @property
    def frame_bytes(self) -> int:
        """Bytes of one radar frame on the wire. Protocol reference 1.3, 6.1.

        >>> FrameGeometry(
        ...     range_start_m=0.2, bin_length_m=0.0064, n_bins=1431, downconversion=False
        ... ).frame_bytes
        5747
        """
        return 9 + 14 + 4 * self.n_bins * (2 if self.downconversion else 1)

    @classmethod
    def from_read_back(
        cls, *, area_m: tuple[float, float], n_bins: int, downconversion: bool
    ) -> "FrameGeometry":
        """Geometry from the answers to GET FRAMEAREA and GET FRAMEBINCOUNT.

        The area ends at the last bin in baseband, one bin behind it in RF (Protocol reference
        9.4).

        >>> geometry = FrameGeometry.from_read_back(
        ...     area_m=(0.19929012656211853, 9.400678634643555), n_bins=1431, downconversion=False)
        >>> round(geometry.bin_length_m, 8)
        0.00643004
        """
        start, end = area_m
        steps = n_bins - 1 if downconversion else n_bins
        return cls(
            range_start_m=start,
            bin_length_m=(end - start) / steps if steps > 0 else 0.0,
            n_bins=n_bins,
            downconversion=downconversion,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Frame:
    """One sweep of the radar.

    ``samples``, shape (geometry.n_bins,): float32 RF amplitudes (read-only, the only copy of
    the received bytes) or complex64 baseband. ``arrival_ns`` is the driver's clock when the
    frame's last byte was read; the frame itself carries only ``counter``.
    """

    counter: int
    samples: Samples
    geometry: FrameGeometry
    arrival_ns: int


def rf_or_baseband(message: DataFloat, geometry: FrameGeometry) -> Samples | None:
    """Return the samples of a radar frame, or None if the message is none of this geometry.

    Radar frames have content id 0 (Protocol reference 6.1).
    """
    if message.content_id != 0:
        return None
    values = message.values
    n = geometry.n_bins
    if not geometry.downconversion:
        return values if values.size == n else None
    return _complex(values[:n], values[n:]) if values.size == 2 * n else None


def baseband(message: BasebandIq) -> Samples:
    """Return the samples of a profile's baseband message, shape (num_bins,), complex64."""
    return _complex(message.i, message.q)


def _complex(i: npt.NDArray[np.float32], q: npt.NDArray[np.float32]) -> npt.NDArray[np.complex64]:
    iq = np.empty(i.size, np.complex64)
    iq.real = i
    iq.imag = q
    return iq
