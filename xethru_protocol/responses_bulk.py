"""Rows of the message table: APPDATA with bulk content, in NoEscape framing.

Names in dumps are those of the golden vectors. Section numbers refer to the Protocol reference.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from xethru_protocol import wire, wire_lists
from xethru_protocol.codes import AppDataId, ResponseCode
from xethru_protocol.responses import FloatArray
from xethru_protocol.table import ROWS, Response, id32, response


def appdata(content: AppDataId) -> tuple[int, ...]:
    """Prefix of an APPDATA message."""
    return ResponseCode.XTS_SPR_APPDATA, *id32(content)


class _Bulk(Response):
    """What messages with arrays share: equality of every bit."""

    __slots__ = ()

    def __eq__(self, other: object) -> bool:
        """Equal if every bit of every field is."""
        if not isinstance(other, _Bulk) or type(other) is not type(self):
            return NotImplemented
        return self._identity() == other._identity()

    def __hash__(self) -> int:
        """Hash of all bits."""
        return hash(self._identity())

    def _identity(self) -> tuple[bytes, ...]:
        values = (getattr(self, field) for field in ROWS[type(self)].fields)
        return tuple(np.asarray(value).tobytes() for value in values)


_BIN_LENGTH = wire.Number("f", "bin_length")
_SAMPLING = wire.Number("f", "sampling_frequency")
_CARRIER = wire.Number("f", "carrier_frequency")
_OFFSET = wire.Number("f", "range_offset")
_INSTANCE = wire.Number("I", "instance")
_FREQUENCY_START = wire.Number("f", "frequency_start")
_FREQUENCY_STEP = wire.Number("f", "frequency_step")
_RANGE = wire.Number("f", "range")


@response(*appdata(AppDataId.XTS_ID_BASEBAND_IQ), name="BASEBAND_IQ", bulk=True)
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BasebandIq(_Bulk):
    """Complex baseband of the running profile. 7.1.

    ``i`` and ``q``: shape (num_bins,), float32, read-only. Ranges in module metres;
    ``range_offset_m`` is the range of bin 0.
    """

    counter: Annotated[int, wire.U32]
    num_bins: Annotated[int, wire.U32]
    bin_length_m: Annotated[float, _BIN_LENGTH]
    sampling_frequency_hz: Annotated[float, _SAMPLING]
    carrier_frequency_hz: Annotated[float, _CARRIER]
    range_offset_m: Annotated[float, _OFFSET]
    i: Annotated[FloatArray, wire.Bins("num_bins")]
    q: Annotated[FloatArray, wire.Bins("num_bins")]


@response(*appdata(AppDataId.XTS_ID_BASEBAND_AMPLITUDE_PHASE), name="BASEBAND_AP", bulk=True)
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BasebandAp(_Bulk):
    """Baseband as amplitude and phase [rad]. 7.1; fields as in `BasebandIq`."""

    counter: Annotated[int, wire.U32]
    num_bins: Annotated[int, wire.U32]
    bin_length_m: Annotated[float, _BIN_LENGTH]
    sampling_frequency_hz: Annotated[float, _SAMPLING]
    carrier_frequency_hz: Annotated[float, _CARRIER]
    range_offset_m: Annotated[float, _OFFSET]
    amplitude: Annotated[FloatArray, wire.Bins("num_bins")]
    phase: Annotated[FloatArray, wire.Bins("num_bins")]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _MatrixFloat(_Bulk):
    """Layout of the two FLOAT messages. 7.2."""

    counter: Annotated[int, wire.U32]
    matrix_counter: Annotated[int, wire.U32]
    range_idx: Annotated[int, wire.U32]
    range_bins: Annotated[int, wire.U32]
    frequency_count: Annotated[int, wire.U32]
    pulsedoppler_instance: Annotated[int, _INSTANCE]
    fps: Annotated[float, wire.F32]
    fps_decimated: Annotated[float, wire.F32]
    frequency_start_hz: Annotated[float, _FREQUENCY_START]
    frequency_step_hz: Annotated[float, _FREQUENCY_STEP]
    range_m: Annotated[float, _RANGE]
    power: Annotated[FloatArray, wire.Bins("frequency_count", "data")]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _MatrixByte(_Bulk):
    """Layout of the two BYTE messages. 7.2."""

    counter: Annotated[int, wire.U32]
    matrix_counter: Annotated[int, wire.U32]
    range_idx: Annotated[int, wire.U32]
    range_bins: Annotated[int, wire.U32]
    frequency_count: Annotated[int, wire.U32]
    pulsedoppler_instance: Annotated[int, _INSTANCE]
    byte_step_start_db: Annotated[float, wire.Number("f", "byte_step_start")]
    byte_step_size_db: Annotated[float, wire.Number("f", "byte_step_size")]
    fps: Annotated[float, wire.F32]
    fps_decimated: Annotated[float, wire.F32]
    frequency_start_hz: Annotated[float, _FREQUENCY_START]
    frequency_step_hz: Annotated[float, _FREQUENCY_STEP]
    range_m: Annotated[float, _RANGE]
    levels: Annotated[bytes, wire_lists.Block("frequency_count", "data", shown=list)]

    @property
    def power(self) -> npt.NDArray[np.float64]:
        """Power per frequency, linear, shape (F,); a damaged header may give infinities."""
        levels = np.frombuffer(self.levels, dtype=np.uint8)
        with np.errstate(all="ignore"):
            decibels = self.byte_step_start_db + levels * self.byte_step_size_db
            return np.asarray(10.0 ** (decibels / 10.0), dtype=np.float64)


@response(*appdata(AppDataId.XTS_ID_PULSEDOPPLER_FLOAT), name="PULSEDOPPLER_FLOAT", bulk=True)
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PulseDopplerFloat(_MatrixFloat):
    """Power spectrum of one range bin. 7.2.

    ``power``: shape (frequency_count,), float32, read-only, from ``frequency_start_hz`` in steps
    of ``frequency_step_hz``. ``range_m`` in module metres. A matrix (`MatrixInstance`) is complete
    when ``range_idx`` is ``range_bins`` - 1. ``fps`` is the chip's rate, ``fps_decimated`` what
    the transform sees [1/s].
    """


@response(*appdata(AppDataId.XTS_ID_NOISEMAP_FLOAT), name="NOISEMAP_FLOAT", bulk=True)
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NoiseMapFloat(_MatrixFloat):
    """Noise power spectrum of one range bin; fields as in `PulseDopplerFloat`. 7.2."""


_DECOMPRESSED: Mapping[str, Callable[[Any], Any]] = {
    "decompressed": lambda message: message.power.tolist()
}


@response(
    *appdata(AppDataId.XTS_ID_PULSEDOPPLER_BYTE),
    name="PULSEDOPPLER_BYTE",
    bulk=True,
    derived=_DECOMPRESSED,
)
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PulseDopplerByte(_MatrixByte):
    """Power spectrum of one range bin on a logarithmic scale. 7.2.

    ``levels`` holds a byte per frequency, in dB ``byte_step_start_db`` + byte x
    ``byte_step_size_db``; ``power`` is linear. Other fields as in `PulseDopplerFloat`.
    """


@response(
    *appdata(AppDataId.XTS_ID_NOISEMAP_BYTE),
    name="NOISEMAP_BYTE",
    bulk=True,
    derived=_DECOMPRESSED,
)
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class NoiseMapByte(_MatrixByte):
    """Noise power spectrum of one range bin; fields as in `PulseDopplerByte`. 7.2."""
