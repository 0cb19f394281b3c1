"""Rows of the message table: everything a module sends.

Names in dumps are those of the golden vectors. Section numbers refer to the Protocol reference.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
import numpy.typing as npt

from xethru_protocol.wire import fields
from xethru_protocol.wire.codes import AppDataId, ElementType, ResponseCode, SystemCode, error_name
from xethru_protocol.wire.table import ROWS, Response, id32, response

FloatArray = npt.NDArray[np.float32]


@response(ResponseCode.XTS_SPR_ACK, name="ACK")
class Ack(Response):
    """The command was carried out. 5."""


@response(
    ResponseCode.XTS_SPR_ERROR,
    name="ERROR",
    derived={"code_name": lambda message: error_name(message.code) or None},
)
class Error(Response):
    """The command was refused; ``code`` is 0 ... 2**32 - 1. 5.1."""

    code: Annotated[int, fields.U32]


@response(ResponseCode.XTS_SPR_PONG, name="PONG")
class Pong(Response):
    """Answer to Ping: a `PongCode`. 5."""

    value: Annotated[int, fields.ID32]


@response(
    ResponseCode.XTS_SPR_SYSTEM,
    name="SYSTEM",
    derived={
        "code_name": lambda message: next(
            (code.name.removeprefix("XTS_SPRS_") for code in SystemCode if code == message.code),
            None,
        )
    },
)
class System(Response):
    """The module reports its state unasked: a `SystemCode`. 5."""

    code: Annotated[int, fields.U32]


_REPLY = ResponseCode.XTS_SPR_REPLY
_DATA = ResponseCode.XTS_SPR_DATA
_CONTENT_ID = fields.Number("I", shown=fields.short_hexadecimal)


@response(_REPLY, ElementType.XTS_SPRD_NONE, name="REPLY NONE")
class ReplyNone(Response):
    """Answer without elements; no firmware is known to send it. 5.2."""

    content_id: Annotated[int, _CONTENT_ID] = 0
    info: Annotated[int, fields.U32] = 0
    trailer: Annotated[int | None, fields.OptionalByte(shown_if_absent=True)] = None


@response(_REPLY, ElementType.XTS_SPRD_BYTE, name="REPLY BYTE")
class ReplyByte(Response):
    """Answer of bytes. 5.2."""

    content_id: Annotated[int, _CONTENT_ID] = 0
    info: Annotated[int, fields.U32] = 0
    values: Annotated[bytes, fields.Elements("c", 1, "values", trailer=1, trailer_shown=True)]


@response(_REPLY, ElementType.XTS_SPRD_INT, name="REPLY INT")
class ReplyInt(Response):
    """Answer of signed 32-bit integers; the only REPLY without trailer. 5.2."""

    content_id: Annotated[int, _CONTENT_ID] = 0
    info: Annotated[int, fields.U32] = 0
    values: Annotated[tuple[int, ...], fields.Elements("i", 4, "values", trailer_shown=True)]


@response(_REPLY, ElementType.XTS_SPRD_FLOAT, name="REPLY FLOAT")
class ReplyFloat(Response):
    """Answer of float32 values, as exact Python floats. 5.2."""

    content_id: Annotated[int, _CONTENT_ID] = 0
    info: Annotated[int, fields.U32] = 0
    values: Annotated[
        tuple[float, ...], fields.Elements("f", 4, "values", trailer=4, trailer_shown=True)
    ]


@response(_REPLY, ElementType.XTS_SPRD_STRING, name="REPLY STRING")
class ReplyString(Response):
    """Answer of text, one character per byte. 5.2."""

    content_id: Annotated[int, _CONTENT_ID] = 0
    info: Annotated[int, fields.U32] = 0
    text: Annotated[str, fields.Elements("s", 1, "value", trailer=1, trailer_shown=True)]


@response(_REPLY, ElementType.XTS_SPRD_USER, name="REPLY USER")
class ReplyUser(Response):
    """Answer of a user structure, as bytes. 5.2."""

    content_id: Annotated[int, _CONTENT_ID] = 0
    info: Annotated[int, fields.U32] = 0
    values: Annotated[bytes, fields.Elements("c", 1, "values", trailer=1, trailer_shown=True)]


@response(_DATA, ElementType.XTS_SPRD_FLOAT, name="DATA FLOAT", bulk=True, eq=False)
class DataFloat(Response):
    """A radar frame. 6.1.

    ``info`` is the frame counter. ``values``, shape (n,), float32, read-only: RF amplitudes by
    increasing range, or all I then all Q of a downconverted frame; the message does not show
    which.
    """

    content_id: Annotated[int, fields.U32] = 0
    info: Annotated[int, fields.U32]
    values: Annotated[FloatArray, fields.Elements("a", 4, "data", count_label="length")]

    def __eq__(self, other: object) -> bool:
        """Equal if every bit of every sample is (NaNs included)."""
        if not isinstance(other, DataFloat):
            return NotImplemented
        return (self.content_id, self.info, self.values.tobytes()) == (
            other.content_id,
            other.info,
            other.values.tobytes(),
        )

    def __hash__(self) -> int:
        """Hash of the header; frames with equal headers are compared by their samples."""
        return hash((self.content_id, self.info, self.values.size))


@response(_DATA, ElementType.XTS_SPRD_BYTE, name="DATA BYTE", bulk=True)
class DataByte(Response):
    """Generic bytes. 6.2."""

    content_id: Annotated[int, fields.U32] = 0
    info: Annotated[int, fields.U32] = 0
    values: Annotated[bytes, fields.Elements("c", 1, "data", count_label="length")]


@response(_DATA, ElementType.XTS_SPRD_STRING, name="DATA STRING")
class DataString(Response):
    """Debug text, one character per byte. 6.2."""

    content_id: Annotated[int, fields.U32] = 0
    info: Annotated[int, fields.U32] = 0
    text: Annotated[str, fields.Elements("s", 1, "value", count_label="length")]


@response(_DATA, ElementType.XTS_SPRD_USER, name="DATA USER")
class DataUser(Response):
    """A user structure. 6.2."""

    content_id: Annotated[int, fields.U32] = 0
    info: Annotated[int, fields.U32] = 0
    values: Annotated[bytes, fields.Elements("c", 1, "data", count_label="length")]


def _type_name(code: int) -> str:
    name = next((kind.name for kind in ElementType if kind == code), f"{code:02X}")
    return name.removeprefix("XTS_SPRD_").lower()


@response(ResponseCode.XTS_SPR_HIL, name="HIL")
class HilReply(Response):
    """Hardware-in-the-loop traffic, not used by an X4M300: a `HilCommand` and elements. 5.4.

    ``values`` are bytes, text, or a tuple of numbers, by ``datatype`` (`ElementType`).
    """

    datatype: Annotated[int, fields.Number("B", shown=_type_name)]
    hil_command: Annotated[int, fields.U32]
    info: Annotated[int, fields.U32] = 0
    values: Annotated[
        bytes | str | tuple[int, ...] | tuple[float, ...],
        fields.TypedElements(
            "datatype",
            {
                ElementType.XTS_SPRD_NONE: fields.Elements("c", 1, "data", count_label="length"),
                ElementType.XTS_SPRD_BYTE: fields.Elements("c", 1, "data", count_label="length"),
                ElementType.XTS_SPRD_INT: fields.Elements("i", 4, "data", count_label="length"),
                ElementType.XTS_SPRD_FLOAT: fields.Elements("f", 4, "data", count_label="length"),
                ElementType.XTS_SPRD_STRING: fields.Elements("s", 1, "data", count_label="length"),
                ElementType.XTS_SPRD_USER: fields.Elements("c", 1, "data", count_label="length"),
            },
        ),
    ] = b""


def appdata(content: AppDataId) -> tuple[int, ...]:
    """Prefix of an APPDATA message."""
    return ResponseCode.XTS_SPR_APPDATA, *id32(content)


class _Bulk(Response):
    """What messages with arrays share: equality of every bit."""

    __slots__ = ()

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, _Bulk) or type(other) is not type(self):
            return NotImplemented
        return self._identity() == other._identity()

    def __hash__(self) -> int:
        return hash(self._identity())

    def _identity(self) -> tuple[bytes, ...]:
        values = (getattr(self, field) for field in ROWS[type(self)].fields)
        return tuple(np.asarray(value).tobytes() for value in values)


_BIN_LENGTH = fields.Number("f", "bin_length")
_SAMPLING = fields.Number("f", "sampling_frequency")
_CARRIER = fields.Number("f", "carrier_frequency")
_OFFSET = fields.Number("f", "range_offset")
_INSTANCE = fields.Number("I", "instance")
_FREQUENCY_START = fields.Number("f", "frequency_start")
_FREQUENCY_STEP = fields.Number("f", "frequency_step")
_RANGE = fields.Number("f", "range")


@response(*appdata(AppDataId.XTS_ID_BASEBAND_IQ), name="BASEBAND_IQ", bulk=True, eq=False)
class BasebandIq(_Bulk):
    """Complex baseband of the running profile. 7.1.

    ``i`` and ``q``: shape (num_bins,), float32, read-only. Ranges in module metres;
    ``range_offset_m`` is the range of bin 0.
    """

    counter: Annotated[int, fields.U32]
    num_bins: Annotated[int, fields.U32]
    bin_length_m: Annotated[float, _BIN_LENGTH]
    sampling_frequency_hz: Annotated[float, _SAMPLING]
    carrier_frequency_hz: Annotated[float, _CARRIER]
    range_offset_m: Annotated[float, _OFFSET]
    i: Annotated[FloatArray, fields.Bins("num_bins")]
    q: Annotated[FloatArray, fields.Bins("num_bins")]


@response(
    *appdata(AppDataId.XTS_ID_BASEBAND_AMPLITUDE_PHASE), name="BASEBAND_AP", bulk=True, eq=False
)
class BasebandAp(_Bulk):
    """Baseband as amplitude and phase [rad]. 7.1; fields as in `BasebandIq`."""

    counter: Annotated[int, fields.U32]
    num_bins: Annotated[int, fields.U32]
    bin_length_m: Annotated[float, _BIN_LENGTH]
    sampling_frequency_hz: Annotated[float, _SAMPLING]
    carrier_frequency_hz: Annotated[float, _CARRIER]
    range_offset_m: Annotated[float, _OFFSET]
    amplitude: Annotated[FloatArray, fields.Bins("num_bins")]
    phase: Annotated[FloatArray, fields.Bins("num_bins")]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _MatrixFloat(_Bulk):
    """Layout of the two FLOAT messages. 7.2."""

    counter: Annotated[int, fields.U32]
    matrix_counter: Annotated[int, fields.U32]
    range_idx: Annotated[int, fields.U32]
    range_bins: Annotated[int, fields.U32]
    frequency_count: Annotated[int, fields.U32]
    pulsedoppler_instance: Annotated[int, _INSTANCE]
    fps: Annotated[float, fields.F32]
    fps_decimated: Annotated[float, fields.F32]
    frequency_start_hz: Annotated[float, _FREQUENCY_START]
    frequency_step_hz: Annotated[float, _FREQUENCY_STEP]
    range_m: Annotated[float, _RANGE]
    power: Annotated[FloatArray, fields.Bins("frequency_count", "data")]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _MatrixByte(_Bulk):
    """Layout of the two BYTE messages. 7.2."""

    counter: Annotated[int, fields.U32]
    matrix_counter: Annotated[int, fields.U32]
    range_idx: Annotated[int, fields.U32]
    range_bins: Annotated[int, fields.U32]
    frequency_count: Annotated[int, fields.U32]
    pulsedoppler_instance: Annotated[int, _INSTANCE]
    byte_step_start_db: Annotated[float, fields.Number("f", "byte_step_start")]
    byte_step_size_db: Annotated[float, fields.Number("f", "byte_step_size")]
    fps: Annotated[float, fields.F32]
    fps_decimated: Annotated[float, fields.F32]
    frequency_start_hz: Annotated[float, _FREQUENCY_START]
    frequency_step_hz: Annotated[float, _FREQUENCY_STEP]
    range_m: Annotated[float, _RANGE]
    levels: Annotated[bytes, fields.Block("frequency_count", "data", shown=list)]

    @property
    def power(self) -> npt.NDArray[np.float64]:
        """Power per frequency, linear, shape (F,); a damaged header may give infinities."""
        levels = np.frombuffer(self.levels, dtype=np.uint8)
        with np.errstate(all="ignore"):
            decibels = self.byte_step_start_db + levels * self.byte_step_size_db
            return np.asarray(10.0 ** (decibels / 10.0), dtype=np.float64)


@response(
    *appdata(AppDataId.XTS_ID_PULSEDOPPLER_FLOAT), name="PULSEDOPPLER_FLOAT", bulk=True, eq=False
)
class PulseDopplerFloat(_MatrixFloat):
    """Power spectrum of one range bin. 7.2.

    ``power``: shape (frequency_count,), float32, read-only, from ``frequency_start_hz`` in steps
    of ``frequency_step_hz``. ``range_m`` in module metres. A matrix (`MatrixInstance`) is complete
    when ``range_idx`` is ``range_bins`` - 1. ``fps`` is the chip's rate, ``fps_decimated`` what
    the transform sees [1/s].
    """


@response(*appdata(AppDataId.XTS_ID_NOISEMAP_FLOAT), name="NOISEMAP_FLOAT", bulk=True, eq=False)
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
    eq=False,
)
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
    eq=False,
)
class NoiseMapByte(_MatrixByte):
    """Noise power spectrum of one range bin; fields as in `PulseDopplerByte`. 7.2."""


_DISTANCE = fields.Number("f", "distance")
_Floats = tuple[float, ...]


@response(*appdata(AppDataId.XTS_ID_PRESENCE_SINGLE), name="PRESENCE_SINGLE")
class PresenceSingle(Response):
    """One person, once a second: `PresenceState`, `PresenceDirection`, quality 0 ... 10. 7.3."""

    counter: Annotated[int, fields.U32]
    state: Annotated[int, fields.Number("I", "presence_state")]
    distance_m: Annotated[float, _DISTANCE]
    direction: Annotated[int, fields.U8]
    signal_quality: Annotated[int, fields.U32]


@response(*appdata(AppDataId.XTS_ID_PRESENCE_MOVINGLIST), name="PRESENCE_MOVINGLIST")
class PresenceMovingList(Response):
    """Movement by range and detections, once a second. 7.3.

    ``movement_slow`` and ``movement_fast``, 0 ... 100, are equally long; the first entry is the
    average of the list. The three ``detection`` lists are equally long: distance [m], radar cross
    section [dB(m^2)] and velocity, of which released firmware computes the first only.
    """

    counter: Annotated[int, fields.U32]
    state: Annotated[int, fields.Number("I", "presence_state")]
    interval_count: ClassVar[
        Annotated[int, fields.Count(("movement_slow", "movement_fast"), "interval_count")]
    ]
    detection_count: ClassVar[
        Annotated[
            int,
            fields.Count(
                ("detection_distance_m", "detection_rcs", "detection_velocity"), "detection_count"
            ),
        ]
    ]
    movement_slow: Annotated[_Floats, fields.Floats("interval_count")]
    movement_fast: Annotated[_Floats, fields.Floats("interval_count")]
    detection_distance_m: Annotated[_Floats, fields.Floats("detection_count", "detection_distance")]
    detection_rcs: Annotated[_Floats, fields.Floats("detection_count")]
    detection_velocity: Annotated[_Floats, fields.Floats("detection_count")]


@response(*appdata(AppDataId.XTS_ID_RESP_STATUS), name="RESP_STATUS")
class RespStatus(Response):
    """Breathing: `RespirationState`, breaths per minute, movement [mm], quality. 7.4."""

    counter: Annotated[int, fields.U32]
    state: Annotated[int, fields.U32]
    rpm: Annotated[int, fields.U32]
    distance_m: Annotated[float, _DISTANCE]
    movement_mm: Annotated[float, fields.F32]
    signal_quality: Annotated[int, fields.U32]


@response(*appdata(AppDataId.XTS_ID_SLEEP_STATUS), name="SLEEP_STATUS")
class SleepStatus(Response):
    """Sleep: `RespirationState`, breaths per minute, quality, slow and fast movement. 7.4."""

    counter: Annotated[int, fields.U32]
    state: Annotated[int, fields.U32]
    rpm: Annotated[float, fields.F32]
    distance_m: Annotated[float, _DISTANCE]
    signal_quality: Annotated[int, fields.U32]
    movement_slow: Annotated[float, fields.F32]
    movement_fast: Annotated[float, fields.F32]


@response(*appdata(AppDataId.XTS_ID_VITAL_SIGNS), name="VITAL_SIGNS")
class VitalSigns(Response):
    """Rates of breath and heartbeat, with distances [m] and confidences. 7.4."""

    counter: Annotated[int, fields.U32]
    state: Annotated[int, fields.U32]
    respiration_rate: Annotated[float, fields.F32]
    respiration_distance_m: Annotated[float, fields.Number("f", "respiration_distance")]
    respiration_confidence: Annotated[float, fields.F32]
    heart_rate: Annotated[float, fields.F32]
    heart_distance_m: Annotated[float, fields.Number("f", "heart_distance")]
    heart_confidence: Annotated[float, fields.F32]
    normalized_movement_slow: Annotated[float, fields.F32]
    normalized_movement_fast: Annotated[float, fields.F32]
    normalized_movement_start_m: Annotated[float, fields.Number("f", "normalized_movement_start")]
    normalized_movement_end_m: Annotated[float, fields.Number("f", "normalized_movement_end")]


@response(*appdata(AppDataId.XTS_ID_SLEEPSTAGE), name="SLEEPSTAGE")
class SleepStage(Response):
    """Stage of sleep. 7.4."""

    counter: Annotated[int, fields.U32]
    stage: Annotated[int, fields.U32]


@response(*appdata(AppDataId.XTS_ID_RESPIRATION_MOVINGLIST), name="RESPIRATION_MOVINGLIST")
class RespirationMovingList(Response):
    """Movement by range, slow and fast; the two lists are equally long. 7.4."""

    counter: Annotated[int, fields.U32]
    interval_count: ClassVar[
        Annotated[int, fields.Count(("movement_slow", "movement_fast"), "interval_count")]
    ]
    movement_slow: Annotated[_Floats, fields.Floats("interval_count")]
    movement_fast: Annotated[_Floats, fields.Floats("interval_count")]


@response(*appdata(AppDataId.XTS_ID_RESPIRATION_DETECTIONLIST), name="RESPIRATION_DETECTIONLIST")
class RespirationDetectionList(Response):
    """Detections: distances [m], cross sections, velocities; equally long lists. 7.4."""

    counter: Annotated[int, fields.U32]
    detection_count: ClassVar[
        Annotated[
            int,
            fields.Count(
                ("detection_distance_m", "detection_rcs", "detection_velocity"), "detection_count"
            ),
        ]
    ]
    detection_distance_m: Annotated[_Floats, fields.Floats("detection_count", "detection_distance")]
    detection_rcs: Annotated[_Floats, fields.Floats("detection_count")]
    detection_velocity: Annotated[_Floats, fields.Floats("detection_count")]


@response(
    *appdata(AppDataId.XTS_ID_RESPIRATION_NORMALIZEDMOVEMENTLIST),
    name="RESPIRATION_NORMALIZEDMOVEMENTLIST",
)
class RespirationNormalizedMovementList(Response):
    """Normalised movement per bin from ``start_m`` on, slow and fast, equally long. 7.4."""

    counter: Annotated[int, fields.U32]
    start_m: Annotated[float, fields.Number("f", "start")]
    bin_length_m: Annotated[float, fields.Number("f", "bin_length")]
    count: ClassVar[Annotated[int, fields.Count(("movement_slow", "movement_fast"), "count")]]
    movement_slow: Annotated[_Floats, fields.Floats("count", "slow")]
    movement_fast: Annotated[_Floats, fields.Floats("count", "fast")]


@response(*appdata(AppDataId.XTS_ID_PROFILE_PARAMETERFILE), name="PROFILE_PARAMETERFILE")
class ParameterFile(Response):
    """A profile's parameter file; the terminating NULs are taken off. 7.6."""

    name_length: ClassVar[Annotated[int, fields.Count(("name",), size=fields.text_size)]]
    data_length: ClassVar[Annotated[int, fields.Count(("data",), size=fields.text_size)]]
    name: Annotated[str | bytes, fields.Text("name_length", "filename")]
    data: Annotated[str | bytes, fields.Text("data_length")]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Opaque(Response):
    """A message whose layout is not known, kept whole. 7.4, 7.5."""

    data: Annotated[bytes, fields.RestBytes()]


@response(*appdata(AppDataId.XTS_ID_RESP_STATUS_EXT), name="RESP_STATUS_EXT")
class RespStatusExt(_Opaque):
    """Extended breathing state; layout unknown. 7.4."""


@response(*appdata(AppDataId.XTS_ID_RADAR_RF), name="RADAR_RF")
class RadarRf(_Opaque):
    """RF frame of newer firmware; order of its fields on the wire unproven. 7.5."""


@response(*appdata(AppDataId.XTS_ID_RADAR_RF_NORMALIZED), name="RADAR_RF_NORMALIZED")
class RadarRfNormalized(_Opaque):
    """RF frame of newer firmware, as float; layout unproven. 7.5."""


@response(*appdata(AppDataId.XTS_ID_RADAR_BASEBAND_FLOAT), name="RADAR_BASEBAND_FLOAT")
class RadarBasebandFloat(_Opaque):
    """Baseband frame of newer firmware, as float; layout unproven. 7.5."""


@response(*appdata(AppDataId.XTS_ID_RADAR_BASEBAND_Q15), name="RADAR_BASEBAND_Q15")
class RadarBasebandQ15(_Opaque):
    """Baseband frame of newer firmware, as Q15; layout unproven. 7.5."""


@response(*appdata(AppDataId.XTS_ID_PRESENCE_STATUS), name="PRESENCE_STATUS")
class PresenceStatus(_Opaque):
    """Legacy message; layout unknown. 7.5."""


@response(*appdata(AppDataId.XTS_ID_DECIM_STATUS), name="DECIM_STATUS")
class DecimStatus(_Opaque):
    """Legacy message; layout unknown. 7.5."""
