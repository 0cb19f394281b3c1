"""Rows of the message table: everything a module sends, then every command a host sends.

Names in dumps are those of the golden vectors. Section numbers refer to the Protocol reference.
``file_type`` is a `FileType` or any user-defined one from 80000000h on; identifiers, offsets and
lengths of files are 0 ... 2**32 - 1.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import numpy as np
import numpy.typing as npt

from xethru_protocol.wire import codes, fields
from xethru_protocol.wire.codes import (
    I2C_REGISTER,
    LEGACY_DIR_CODES,
    AppCommandCode,
    AppDataId,
    AppObject,
    BootloaderCode,
    BootloaderFraming,
    BootloaderReply,
    CommandCode,
    DirCode,
    ElementType,
    FileError,
    FramePostprocessing,
    FramePostprocessingCode,
    IoPinCode,
    IoPinError,
    NoiseMapCode,
    OutputCode,
    ResponseCode,
    SensorMode,
    SystemCode,
    X4DriverCode,
    X4Error,
    X4Setting,
    error_name,
)
from xethru_protocol.wire.fields import hex_bytes
from xethru_protocol.wire.table import ROWS, ReplyT, command, id32, response
from xethru_protocol.wire.table import Command as Command
from xethru_protocol.wire.table import Message as Message
from xethru_protocol.wire.table import Response as Response
from xethru_protocol.wire.table import UnknownMessage as UnknownMessage

FloatArray = npt.NDArray[np.float32]


@response(ResponseCode.XTS_SPR_ACK, name="ACK")
class Ack(Response):
    """The command was carried out. 5."""


@response(
    ResponseCode.XTS_SPR_ERROR,
    name="ERROR",
    derived=lambda message: {"code_name": error_name(message.code) or None},
)
class Error(Response):
    """The command was refused; ``code`` is 0 ... 2**32 - 1. 5.1."""

    code: Annotated[int, fields.U32]


@response(ResponseCode.XTS_SPR_PONG, name="PONG")
class Pong(Response):
    """Answer to Ping: a `PongCode`. 5."""

    value: Annotated[int, fields.ID32.of(codes.PongCode)]


@response(
    ResponseCode.XTS_SPR_SYSTEM,
    name="SYSTEM",
    derived=lambda message: {
        "code_name": next(
            (code.name.removeprefix("XTS_SPRS_") for code in SystemCode if code == message.code),
            None,
        )
    },
)
class System(Response):
    """The module reports its state unasked: a `SystemCode`. 5."""

    code: Annotated[int, fields.U32.of(codes.SystemCode)]


_REPLY = ResponseCode.XTS_SPR_REPLY
_DATA = ResponseCode.XTS_SPR_DATA
_CONTENT_ID = fields.Number("I", shown=fields.short_hexadecimal)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)  # rows compare all of their fields
class _Reply(Response):
    """Header of an answer: what it answers, and a number beside it. 5.2."""

    content_id: Annotated[int, _CONTENT_ID] = 0
    info: Annotated[int, fields.U32] = 0


@response(_REPLY, ElementType.XTS_SPRD_NONE, name="REPLY NONE")
class ReplyNone(_Reply):
    """Answer without elements; no firmware is known to send it. 5.2."""

    trailer: Annotated[int | None, fields.OptionalByte(shown_if_absent=True)] = None


@response(_REPLY, ElementType.XTS_SPRD_BYTE, name="REPLY BYTE")
class ReplyByte(_Reply):
    """Answer of bytes. 5.2."""

    values: Annotated[bytes, fields.Elements("c", 1, "values", trailer=1, trailer_shown=True)]


@response(_REPLY, ElementType.XTS_SPRD_INT, name="REPLY INT")
class ReplyInt(_Reply):
    """Answer of signed 32-bit integers; the only REPLY without trailer. 5.2."""

    values: Annotated[tuple[int, ...], fields.Elements("i", 4, "values", trailer_shown=True)]


@response(_REPLY, ElementType.XTS_SPRD_FLOAT, name="REPLY FLOAT")
class ReplyFloat(_Reply):
    """Answer of float32 values, as exact Python floats. 5.2."""

    values: Annotated[
        tuple[float, ...], fields.Elements("f", 4, "values", trailer=4, trailer_shown=True)
    ]


@response(_REPLY, ElementType.XTS_SPRD_STRING, name="REPLY STRING")
class ReplyString(_Reply):
    """Answer of text, one character per byte. 5.2."""

    text: Annotated[str, fields.Elements("s", 1, "value", trailer=1, trailer_shown=True)]


@response(_REPLY, ElementType.XTS_SPRD_USER, name="REPLY USER")
class ReplyUser(_Reply):
    """Answer of a user structure, as bytes. 5.2."""

    values: Annotated[bytes, fields.Elements("c", 1, "values", trailer=1, trailer_shown=True)]


class _Bulk(Response):
    """What messages with arrays share: they are equal if every bit is, NaNs included."""

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


@response(_DATA, ElementType.XTS_SPRD_FLOAT, name="DATA FLOAT", bulk=True)
class DataFloat(_Bulk):
    """A radar frame. 6.1.

    ``info`` is the frame counter. ``values``, shape (n,), float32, read-only: RF amplitudes by
    increasing range, or all I then all Q of a downconverted frame; the message does not show
    which.
    """

    content_id: Annotated[int, fields.U32] = 0
    info: Annotated[int, fields.U32]
    values: Annotated[FloatArray, fields.Elements("a", 4, "data", count_label="length")]


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


_BIN_LENGTH = fields.Number("f", "bin_length")
_SAMPLING = fields.Number("f", "sampling_frequency")
_CARRIER = fields.Number("f", "carrier_frequency")
_OFFSET = fields.Number("f", "range_offset")
_INSTANCE = fields.Number("I", "instance")
_FREQUENCY_START = fields.Number("f", "frequency_start")
_FREQUENCY_STEP = fields.Number("f", "frequency_step")
_RANGE = fields.Number("f", "range")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Baseband(_Bulk):
    """Header of the two baseband messages of a profile. 7.1."""

    counter: Annotated[int, fields.U32]
    num_bins: Annotated[int, fields.U32]
    bin_length_m: Annotated[float, _BIN_LENGTH]
    sampling_frequency_hz: Annotated[float, _SAMPLING]
    carrier_frequency_hz: Annotated[float, _CARRIER]
    range_offset_m: Annotated[float, _OFFSET]


@response(*appdata(AppDataId.XTS_ID_BASEBAND_IQ), name="BASEBAND_IQ", bulk=True)
class BasebandIq(_Baseband):
    """Complex baseband of the running profile. 7.1.

    ``i`` and ``q``: shape (num_bins,), float32, read-only. Ranges in module metres;
    ``range_offset_m`` is the range of bin 0.
    """

    i: Annotated[FloatArray, fields.Bins("num_bins")]
    q: Annotated[FloatArray, fields.Bins("num_bins")]


@response(*appdata(AppDataId.XTS_ID_BASEBAND_AMPLITUDE_PHASE), name="BASEBAND_AP", bulk=True)
class BasebandAp(_Baseband):
    """Baseband as amplitude and phase [rad]. 7.1; fields as in `BasebandIq`."""

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


@response(*appdata(AppDataId.XTS_ID_PULSEDOPPLER_FLOAT), name="PULSEDOPPLER_FLOAT", bulk=True)
class PulseDopplerFloat(_MatrixFloat):
    """Power spectrum of one range bin. 7.2.

    ``power``: shape (frequency_count,), float32, read-only, from ``frequency_start_hz`` in steps
    of ``frequency_step_hz``. ``range_m`` in module metres. A matrix (`MatrixInstance`) is complete
    when ``range_idx`` is ``range_bins`` - 1. ``fps`` is the chip's rate, ``fps_decimated`` what
    the transform sees [1/s].
    """


@response(*appdata(AppDataId.XTS_ID_NOISEMAP_FLOAT), name="NOISEMAP_FLOAT", bulk=True)
class NoiseMapFloat(_MatrixFloat):
    """Noise power spectrum of one range bin; fields as in `PulseDopplerFloat`. 7.2."""


def _decompressed(message: _MatrixByte) -> dict[str, Any]:
    return {"decompressed": message.power.tolist()}


@response(
    *appdata(AppDataId.XTS_ID_PULSEDOPPLER_BYTE),
    name="PULSEDOPPLER_BYTE",
    bulk=True,
    derived=_decompressed,
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
    derived=_decompressed,
)
class NoiseMapByte(_MatrixByte):
    """Noise power spectrum of one range bin; fields as in `PulseDopplerByte`. 7.2."""


_DISTANCE = fields.Number("f", "distance")
_INTERVALS = fields.Count(("movement_slow", "movement_fast"), "interval_count")
_DETECTIONS = fields.Count(
    ("detection_distance_m", "detection_rcs", "detection_velocity"), "detection_count"
)
_Floats = tuple[float, ...]


@response(*appdata(AppDataId.XTS_ID_PRESENCE_SINGLE), name="PRESENCE_SINGLE")
class PresenceSingle(Response):
    """One person, once a second: `PresenceState`, `PresenceDirection`, quality 0 ... 10. 7.3."""

    counter: Annotated[int, fields.U32]
    state: Annotated[int, fields.Number("I", "presence_state").of(codes.PresenceState)]
    distance_m: Annotated[float, _DISTANCE]
    direction: Annotated[int, fields.U8.of(codes.PresenceDirection)]
    signal_quality: Annotated[int, fields.U32]


@response(*appdata(AppDataId.XTS_ID_PRESENCE_MOVINGLIST), name="PRESENCE_MOVINGLIST")
class PresenceMovingList(Response):
    """Movement by range and detections, once a second. 7.3.

    ``movement_slow`` and ``movement_fast``, 0 ... 100, are equally long; the first entry is the
    average of the list. The three ``detection`` lists are equally long: distance [m], radar cross
    section [dB(m^2)] and velocity, of which released firmware computes the first only.
    """

    counter: Annotated[int, fields.U32]
    state: Annotated[int, fields.Number("I", "presence_state").of(codes.PresenceState)]
    interval_count: ClassVar[Annotated[int, _INTERVALS]]
    detection_count: ClassVar[Annotated[int, _DETECTIONS]]
    movement_slow: Annotated[_Floats, fields.Floats("interval_count")]
    movement_fast: Annotated[_Floats, fields.Floats("interval_count")]
    detection_distance_m: Annotated[_Floats, fields.Floats("detection_count", "detection_distance")]
    detection_rcs: Annotated[_Floats, fields.Floats("detection_count")]
    detection_velocity: Annotated[_Floats, fields.Floats("detection_count")]


@response(*appdata(AppDataId.XTS_ID_RESP_STATUS), name="RESP_STATUS")
class RespStatus(Response):
    """Breathing: `RespirationState`, breaths per minute, movement [mm], quality. 7.4."""

    counter: Annotated[int, fields.U32]
    state: Annotated[int, fields.U32.of(codes.RespirationState)]
    rpm: Annotated[int, fields.U32]
    distance_m: Annotated[float, _DISTANCE]
    movement_mm: Annotated[float, fields.F32]
    signal_quality: Annotated[int, fields.U32]


@response(*appdata(AppDataId.XTS_ID_SLEEP_STATUS), name="SLEEP_STATUS")
class SleepStatus(Response):
    """Sleep: `RespirationState`, breaths per minute, quality, slow and fast movement. 7.4."""

    counter: Annotated[int, fields.U32]
    state: Annotated[int, fields.U32.of(codes.RespirationState)]
    rpm: Annotated[float, fields.F32]
    distance_m: Annotated[float, _DISTANCE]
    signal_quality: Annotated[int, fields.U32]
    movement_slow: Annotated[float, fields.F32]
    movement_fast: Annotated[float, fields.F32]


@response(*appdata(AppDataId.XTS_ID_VITAL_SIGNS), name="VITAL_SIGNS")
class VitalSigns(Response):
    """Rates of breath and heartbeat, with distances [m] and confidences. 7.4."""

    counter: Annotated[int, fields.U32]
    state: Annotated[int, fields.U32.of(codes.RespirationState)]
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
    interval_count: ClassVar[Annotated[int, _INTERVALS]]
    movement_slow: Annotated[_Floats, fields.Floats("interval_count")]
    movement_fast: Annotated[_Floats, fields.Floats("interval_count")]


@response(*appdata(AppDataId.XTS_ID_RESPIRATION_DETECTIONLIST), name="RESPIRATION_DETECTIONLIST")
class RespirationDetectionList(Response):
    """Detections: distances [m], cross sections, velocities; equally long lists. 7.4."""

    counter: Annotated[int, fields.U32]
    detection_count: ClassVar[Annotated[int, _DETECTIONS]]
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


_NAME_SIZE = fields.Count(("name",), size=fields.text_size)
_DATA_SIZE = fields.Count(("data",), size=fields.text_size)


@response(*appdata(AppDataId.XTS_ID_PROFILE_PARAMETERFILE), name="PROFILE_PARAMETERFILE")
class ParameterFile(Response):
    """A profile's parameter file; the terminating NULs are taken off. 7.6."""

    name_length: ClassVar[Annotated[int, _NAME_SIZE]]
    data_length: ClassVar[Annotated[int, _DATA_SIZE]]
    name: Annotated[str | bytes, fields.Text("name_length", "filename")]
    data: Annotated[str | bytes, fields.Text("data_length")]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Opaque(Response):
    """A message whose layout is not known, kept whole. 7.4, 7.5."""

    data: Annotated[bytes, fields.RestBytes()]


@response(*appdata(AppDataId.XTS_ID_RESP_STATUS_EXT), name="RESP_STATUS_EXT")
class RespStatusExt(_Opaque):
    """Extended breathing state; layout unknown. 7.4."""


# The vendor's library drops payloads below 40 bytes (RF) and 64 (baseband): as many bins at least.
_BINS, _Q15_BINS = (fields.Number("I", least=least) for least in (2, 3))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RadarMessage(_Bulk):
    """A radar frame of newer firmware: what the four kinds have in common. 7.5.

    ``counter`` is the frame counter, ``frames_per_s`` a whole number on the wire. Ranges in module
    metres; ``range_offset_m`` is the range of bin 0.
    """

    counter: Annotated[int, fields.U32]
    num_bins: Annotated[int, _BINS]
    bin_length_m: Annotated[float, _BIN_LENGTH]
    sampling_frequency_hz: Annotated[float, _SAMPLING]
    carrier_frequency_hz: Annotated[float, _CARRIER]
    frames_per_s: Annotated[int, fields.Number("I", "frames_per_second")]
    range_offset_m: Annotated[float, _OFFSET]

    @property
    def ranges_m(self) -> npt.NDArray[np.float64]:
        """Range of each bin, shape (num_bins,) [module metres]."""
        bins = np.arange(self.num_bins, dtype=np.float64)
        return self.range_offset_m + bins * self.bin_length_m


@response(*appdata(AppDataId.XTS_ID_RADAR_RF), name="RADAR_RF", bulk=True)
class RadarRf(RadarMessage):
    """RF frame as counts of the chip: ``samples``, shape (num_bins,), uint32, read-only. 7.5."""

    samples: Annotated[
        npt.NDArray[np.uint32], fields.Bins("num_bins", dtype=fields.UINT32, last=True)
    ]


@response(*appdata(AppDataId.XTS_ID_RADAR_RF_NORMALIZED), name="RADAR_RF_NORMALIZED", bulk=True)
class RadarRfNormalized(RadarMessage):
    """RF frame: ``samples``, shape (num_bins,), float32, read-only. 7.5."""

    samples: Annotated[FloatArray, fields.Bins("num_bins", last=True)]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _RadarBaseband(RadarMessage):
    """Header of the two baseband messages. 7.5."""

    decimation_factor: Annotated[int, fields.U32]
    correction_bin: Annotated[int, fields.U32]
    correction_i: Annotated[float, fields.F32]
    correction_q: Annotated[float, fields.F32]


@response(*appdata(AppDataId.XTS_ID_RADAR_BASEBAND_FLOAT), name="RADAR_BASEBAND_FLOAT", bulk=True)
class RadarBasebandFloat(_RadarBaseband):
    """Baseband frame: ``i`` and ``q``, shape (num_bins,), float32, read-only. 7.5.

    The correction fields are of the phase-noise correction: a bin, and its I and Q.
    """

    i: Annotated[FloatArray, fields.Bins("num_bins")]
    q: Annotated[FloatArray, fields.Bins("num_bins", last=True)]

    @property
    def iq(self) -> npt.NDArray[np.complex64]:
        """``i`` + j ``q``, complex64, shape (num_bins,)."""
        return np.asarray(self.i + np.complex64(1j) * self.q, dtype=np.complex64)


@response(*appdata(AppDataId.XTS_ID_RADAR_BASEBAND_Q15), name="RADAR_BASEBAND_Q15", bulk=True)
class RadarBasebandQ15(_RadarBaseband):
    """Baseband frame in 16-bit integers. 7.5; other fields as in `RadarBasebandFloat`.

    ``i`` and ``q``, shape (num_bins,), int16, read-only, are as sent; `iq` scales them.
    """

    num_bins: Annotated[int, _Q15_BINS]
    scaling_factor: Annotated[float, fields.F32]
    i: Annotated[npt.NDArray[np.int16], fields.Bins("num_bins", dtype=fields.INT16)]
    q: Annotated[npt.NDArray[np.int16], fields.Bins("num_bins", dtype=fields.INT16, last=True)]

    @property
    def iq(self) -> npt.NDArray[np.complex64]:
        """(``i`` + j ``q``) times the scaling factor, complex64, shape (num_bins,).

        That the factor is meant so is inferred; no module that sends this was seen.
        """
        samples = self.i.astype(np.float32) + np.complex64(1j) * self.q.astype(np.float32)
        return np.asarray(samples * np.float32(self.scaling_factor), dtype=np.complex64)


@response(*appdata(AppDataId.XTS_ID_PRESENCE_STATUS), name="PRESENCE_STATUS")
class PresenceStatus(_Opaque):
    """Legacy message; layout unknown. 7.5."""


@response(*appdata(AppDataId.XTS_ID_DECIM_STATUS), name="DECIM_STATUS")
class DecimStatus(_Opaque):
    """Legacy message; layout unknown. 7.5."""


def _bootloader_data(data: bytes) -> int | str:
    """Show one byte as it is, two as the number, more as the text they are. 4.12."""
    if len(data) == 2:
        return int.from_bytes(data, "little")
    return hex_bytes(data) if len(data) < 2 else data.decode("latin-1")


@response(BootloaderReply.SUCCESS, name="BOOTLOADER success")
class BootloaderSuccess(Response):
    """A bootloader's answer E0 and what follows it: nothing, bytes, a number or a text. 4.12.

    Only ``data`` 33 says that a page was written; without data, it was not.
    """

    data: Annotated[
        bytes, fields.RestBytes(shown=_bootloader_data, label="value", empty_shown=False)
    ] = b""


@response(
    BootloaderReply.FRAMING_ERROR,
    name="BOOTLOADER framing error",
    derived=lambda message: {
        "code_name": next((code.name for code in BootloaderFraming if code == message.code), None)
    },
)
class BootloaderFramingError(Response):
    """A bootloader found a packet damaged: a `BootloaderFraming`. 4.12."""

    code: Annotated[int, fields.U8.of(codes.BootloaderFraming)]


_BOOTLOADER_ERROR_CODES = (
    int(BootloaderReply.UNKNOWN_COMMAND),
    int(BootloaderReply.WRITING_REFUSED),
    int(BootloaderReply.WRONG_CHECKSUM),
    int(BootloaderReply.PAGE_OUT_OF_BOUNDS),
)


@response(name="BOOTLOADER error")
class BootloaderError(Response):
    """A bootloader refuses a command: ``code`` is a `BootloaderReply`, E2 to E5. 4.12."""

    code: Annotated[int, fields.Spelling(_BOOTLOADER_ERROR_CODES, shown=int)]


@response(BootloaderReply.ECHO, name="BOOTLOADER_ECHO")
class BootloaderEchoed(Response):
    """A bootloader sends back what `BootloaderEcho` carried. 4.12."""

    data: Annotated[bytes, fields.RestBytes()]


BOOTLOADER_ERRORS = (BootloaderError, BootloaderFramingError)
ANSWERS = (
    *(Ack, Error, Pong, ReplyByte, ReplyInt, ReplyFloat, ReplyString),
    *(BootloaderSuccess, BootloaderEchoed, *BOOTLOADER_ERRORS),
)
"""Messages that answer a command and come for no other reason. Protocol reference 3."""

# --- commands ---------------------------------------------------------------------------------


@command(CommandCode.XTS_SPC_PING, name="PING")
class Ping(Command[Pong]):
    """Ask for a sign of life; the firmware does not check the seed. 4.1."""

    seed: Annotated[int, fields.ID32] = 0xEEAAEAAE


@command(CommandCode.XTS_SPC_START_BOOTLOADER, name="START_BOOTLOADER")
class StartBootloader(Command[Ack]):
    """Restart into the bootloader about 500 ms after the ACK; ``key`` as `BootloaderKey`. 4.1."""

    key: Annotated[int, fields.ID32.of(codes.BootloaderKey)]


@command(CommandCode.XTS_SPC_MOD_RESET, name="MOD_RESET")
class ModReset(Command[Ack]):
    """Restart the module about 500 ms after its ACK; a USB port vanishes meanwhile. 4.1."""


@command(
    CommandCode.XTS_SPC_MOD_SETMODE,
    name="SETMODE",
    derived=lambda message: {
        "mode_name": next((mode.label for mode in SensorMode if mode == message.mode), None)
    },
)
class SetMode(Command[Ack]):
    """Switch to a `SensorMode`; a host leaves ``param`` out for all but NORMAL and REG. 4.2."""

    mode: Annotated[int, fields.U8.of(codes.SensorMode)]
    param: Annotated[int | None, fields.OptionalByte(shown_if_absent=True)] = None


@command(CommandCode.XTS_SPC_MOD_GETMODE, name="GETMODE")
class GetMode(Command[ReplyByte]):
    """Ask for the `SensorMode`. 4.2."""


@command(CommandCode.XTS_SPC_MOD_LOADAPP, name="MOD_LOADAPP")
class LoadApp(Command[Ack]):
    """Load a profile (`ProfileId`) without running it. 4.3."""

    profile_id: Annotated[int, fields.ID32.of(codes.ProfileId)]


@command(CommandCode.XTS_SPC_DIR_COMMAND, DirCode.XTS_SDC_GET_PROFILEID, name="DIR GET_PROFILEID")
class GetProfileId(Command[ReplyInt]):
    """Ask for the loaded profile; 0 if none. 4.3."""


@command(CommandCode.XTS_SPC_MOD_SETLEDCONTROL, name="SETLEDCONTROL")
class SetLedControl(Command[Ack]):
    """Choose what the LED shows (`LedMode`); an intensity, 0 ... 100, is not implemented. 4.5."""

    mode: Annotated[int, fields.U8.of(codes.LedMode)]
    intensity: Annotated[int, fields.U8] = 0


@command(CommandCode.XTS_SPC_DEBUG_LEVEL, name="DEBUG_LEVEL")
class DebugLevel(Command[Ack]):
    """Choose how much trace output comes as DATA STRING: a `TraceLevel`, up to 9. 4.5."""

    level: Annotated[int, fields.U8]


@command(CommandCode.XTS_SPC_MOD_SETCOM, name="MOD_SETCOM")
class SetCom(Command[Ack]):
    """A command that is defined but handled by no firmware: ERROR 1. 2."""

    data: Annotated[bytes, fields.RestBytes()] = b""


@command(CommandCode.XTS_SPC_HIL, name="HIL")
class Hil(Command[Ack]):
    """A command that every firmware answers with ERROR 1; its content has no known layout. 2."""


_APP = CommandCode.XTS_SPC_APPCOMMAND


def _set(target: AppObject) -> tuple[int, ...]:
    return _APP, AppCommandCode.XTS_SPCA_SET, *id32(target)


def _get(target: AppObject) -> tuple[int, ...]:
    return _APP, AppCommandCode.XTS_SPCA_GET, *id32(target)


@command(*_set(AppObject.DETECTION_ZONE), name="APP_SET DETECTION_ZONE")
class SetDetectionZone(Command[Ack]):
    """Choose the zone [m] in which a profile detects; the module snaps it outward. 4.4."""

    start_m: Annotated[float, fields.Number("f", "start")]
    end_m: Annotated[float, fields.Number("f", "end")]


@command(*_get(AppObject.DETECTION_ZONE), name="APP_GET DETECTION_ZONE")
class GetDetectionZone(Command[ReplyFloat]):
    """Ask for the actual zone: start and end [m]. 4.4."""


@command(*_get(AppObject.DETECTION_ZONE_LIMITS), name="APP_GET DETECTION_ZONE_LIMITS")
class GetDetectionZoneLimits(Command[ReplyFloat]):
    """Ask for the smallest start, the largest end and the step of zones [m]. 4.4."""


@command(*_set(AppObject.SENSITIVITY), name="APP_SET SENSITIVITY")
class SetSensitivity(Command[Ack]):
    """Choose the profile's sensitivity, 0 ... 9. 4.4."""

    sensitivity: Annotated[int, fields.U32]


@command(*_get(AppObject.SENSITIVITY), name="APP_GET SENSITIVITY")
class GetSensitivity(Command[ReplyInt]):
    """Ask for the profile's sensitivity. 4.4."""


@command(*_set(AppObject.TX_CENTER_FREQ), name="APP_SET TX_CENTER_FREQ")
class SetTxCenterFrequency(Command[Ack]):
    """Choose the profile's band, a `TxCenterFrequency`. 4.4, 9.2."""

    tx_center_frequency: Annotated[int, fields.Number("I", "band").of(codes.TxCenterFrequency)]


@command(*_get(AppObject.TX_CENTER_FREQ), name="APP_GET TX_CENTER_FREQ")
class GetTxCenterFrequency(Command[ReplyInt]):
    """Ask for the profile's band. 4.4."""


@command(*_set(AppObject.LED_CONTROL), name="APP_SET LED_CONTROL")
class AppSetLedControl(Command[Ack]):
    """Choose what the LED shows; as `SetLedControl`, but kept with the profile. 4.4."""

    mode: Annotated[int, fields.U8.of(codes.LedMode)]
    intensity: Annotated[int, fields.U8] = 0


@command(*_get(AppObject.LED_CONTROL), name="APP_GET LED_CONTROL")
class AppGetLedControl(Command[ReplyByte]):
    """Ask for the `LedMode`. 4.4."""


@command(*_set(AppObject.PROFILE_PARAMETERFILE), name="APP_SET PROFILE_PARAMETERFILE")
class SetParameterFile(Command[Ack]):
    """Give a profile its parameter file; the terminating NULs are added here. 4.4."""

    name_length: ClassVar[Annotated[int, _NAME_SIZE]]
    data_length: ClassVar[Annotated[int, _DATA_SIZE]]
    name: Annotated[str | bytes, fields.Text("name_length", "filename")]
    data: Annotated[str | bytes, fields.Text("data_length")]


@command(*_get(AppObject.PROFILE_PARAMETERFILE), name="APP_GET PROFILE_PARAMETERFILE")
class GetParameterFile(Command[ReplyString | ParameterFile | ReplyByte]):
    """Ask for a profile's parameter file; modules answer in one of three ways. 4.4, 16."""

    name_length: ClassVar[Annotated[int, _NAME_SIZE]]
    name: Annotated[str | bytes, fields.Text("name_length", "filename")]


@command(_APP, AppCommandCode.XTS_SPCA_FACTORY_PRESET, name="APP_FACTORY_PRESET")
class FactoryPreset(Command[Ack]):
    """Set the profile back to its factory settings. 4.4."""


@command(_APP, AppCommandCode.XTS_SPCA_STORE_NOISEMAP, name="APP_STORE_NOISEMAP")
class StoreNoiseMap(Command[Ack]):
    """Store the profile's noise map; an error if a store is under way. 4.4."""


@command(_APP, AppCommandCode.XTS_SPCA_LOAD_NOISEMAP, name="APP_LOAD_NOISEMAP")
class LoadNoiseMap(Command[Ack]):
    """Load the stored noise map; without effect in released firmware. 4.4."""


_DELETE = AppCommandCode.XTS_SPCA_DELETE_NOISEMAP
_DELETE_AS_PRINTED = AppCommandCode.XTS_SPCA_GET_PARAMETER_FILE


@command(_APP, name="APP_DELETE_NOISEMAP")
class DeleteNoiseMap(Command[Ack]):
    """Delete the stored noise map; ``sub_code`` 15h is the document's form of it. 4.4, 11."""

    sub_code: Annotated[int, fields.Spelling((_DELETE, _DELETE_AS_PRINTED), _DELETE)] = _DELETE


@command(_APP, AppCommandCode.XTS_SPCA_POLL, name="APP_POLL")
class AppPoll(Command[Ack]):
    """A command that is defined but never parsed: ERROR 1. 4.4."""

    data: Annotated[bytes, fields.RestBytes()] = b""


_NOISEMAP = CommandCode.XTS_SPC_MOD_NOISEMAP
_OUTPUT = CommandCode.XTS_SPC_OUTPUT
_DEBUG_OUTPUT = CommandCode.XTS_SPC_DEBUG_OUTPUT
_IOPIN = CommandCode.XTS_SPC_IOPIN


@command(_NOISEMAP, NoiseMapCode.XTS_SPCN_SETCONTROL, name="NOISEMAP_SETCONTROL")
class NoiseMapSetControl(Command[Ack]):
    """Choose where a profile's noise map comes from: `NoiseMapControl` bits. 4.6."""

    control: Annotated[int, fields.U32]


@command(_NOISEMAP, NoiseMapCode.XTS_SPCN_GETCONTROL, name="NOISEMAP_GETCONTROL")
class NoiseMapGetControl(Command[ReplyInt]):
    """Ask for the noise map's `NoiseMapControl` bits. 4.6."""


@command(_NOISEMAP, NoiseMapCode.SET_PERIODIC_STORE, name="NOISEMAP_SET_PERIODIC_STORE")
class NoiseMapSetPeriodicStore(Command[Ack]):
    """Store the noise map every ``interval_min`` minutes; ``padding`` is sent as 0. 16."""

    interval_min: Annotated[int, fields.U32]
    padding: Annotated[int, fields.U32] = 0


@command(_NOISEMAP, NoiseMapCode.GET_PERIODIC_STORE, name="NOISEMAP_GET_PERIODIC_STORE")
class NoiseMapGetPeriodicStore(Command[ReplyInt]):
    """Ask for the interval [min] at which the noise map is stored; two integers. 16."""


@command(_OUTPUT, OutputCode.XTS_SPCO_SETCONTROL, name="OUTPUT_SETCONTROL")
class OutputSetControl(Command[Ack]):
    """Switch a profile's message (`OutputFeature`) on or off. 4.7.

    ``control`` holds `OutputControl` bits; for pulse-Doppler and noise maps `MatrixControl` bits.
    """

    feature: Annotated[int, fields.ID32.of(codes.OutputFeature)]
    control: Annotated[int, fields.U32]


@command(_OUTPUT, OutputCode.XTS_SPCO_GETCONTROL, name="OUTPUT_GETCONTROL")
class OutputGetControl(Command[ReplyInt]):
    """Ask for the control bits of an `OutputFeature`. 4.7."""

    feature: Annotated[int, fields.ID32.of(codes.OutputFeature)]


@command(_DEBUG_OUTPUT, OutputCode.XTS_SPCO_SETCONTROL, name="DEBUG_OUTPUT_SETCONTROL")
class DebugOutputSetControl(Command[Ack]):
    """Switch a message on or off on the debug line; fields as in `OutputSetControl`. 4.7, 16."""

    feature: Annotated[int, fields.ID32.of(codes.OutputFeature)]
    control: Annotated[int, fields.U32]


@command(_DEBUG_OUTPUT, OutputCode.XTS_SPCO_GETCONTROL, name="DEBUG_OUTPUT_GETCONTROL")
class DebugOutputGetControl(Command[ReplyInt]):
    """Ask for a message's control bits on the debug line. 4.7, 16."""

    feature: Annotated[int, fields.ID32.of(codes.OutputFeature)]


@command(_IOPIN, IoPinCode.XTS_SPCIOP_SETCONTROL, name="IOPIN_SETCONTROL", errors=IoPinError)
class IoPinSetControl(Command[Ack]):
    """Set what a pin does: `IoPinSetup` bits and an `IoPinFeature`. 4.8.

    ``pin_id``: an `IoPin`.
    """

    pin_id: Annotated[int, fields.U32.of(codes.IoPin)]
    pin_setup: Annotated[int, fields.U32]
    pin_feature: Annotated[int, fields.U32.of(codes.IoPinFeature)]


@command(_IOPIN, IoPinCode.XTS_SPCIOP_GETCONTROL, name="IOPIN_GETCONTROL", errors=IoPinError)
class IoPinGetControl(Command[ReplyInt]):
    """Ask for a pin's setup bits and feature: two integers. 4.8."""

    pin_id: Annotated[int, fields.U32.of(codes.IoPin)]


@command(_IOPIN, IoPinCode.XTS_SPCIOP_SETVALUE, name="IOPIN_SETVALUE", errors=IoPinError)
class IoPinSetValue(Command[Ack]):
    """Drive an output pin high (1) or low (0). 4.8."""

    pin_id: Annotated[int, fields.U32.of(codes.IoPin)]
    pin_value: Annotated[int, fields.U32]


@command(_IOPIN, IoPinCode.XTS_SPCIOP_GETVALUE, name="IOPIN_GETVALUE", errors=IoPinError)
class IoPinGetValue(Command[ReplyInt]):
    """Ask whether a pin is high (1) or low (0). 4.8."""

    pin_id: Annotated[int, fields.U32.of(codes.IoPin)]


_DIR = CommandCode.XTS_SPC_DIR_COMMAND
_TYPE = fields.Number("I", "type", shown=fields.hexadecimal).of(codes.FileType)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)  # rows compare all of their fields
class _OfFile(Command[ReplyT]):
    """What commands about one file begin with. 4.11."""

    file_type: Annotated[int, _TYPE]
    identifier: Annotated[int, fields.U32]


@command(_DIR, DirCode.XTS_SDC_SEARCH_FILE_TYPE, name="DIR SEARCH_FILE_TYPE", errors=FileError)
class SearchFileType(Command[ReplyInt]):
    """Ask for the identifiers of all files of a type. 4.11."""

    file_type: Annotated[int, _TYPE]


@command(_DIR, DirCode.XTS_SDC_FIND_ALL_FILES, name="DIR FIND_ALL_FILES", errors=FileError)
class FindAllFiles(Command[ReplyInt]):
    """Ask for all files: n types, then n identifiers. 4.11."""


@command(_DIR, DirCode.XTS_SDC_CREATE_NEW_FILE, name="DIR CREATE_NEW_FILE", errors=FileError)
class CreateFile(_OfFile[Ack]):
    """Create a file of ``length`` bytes; it is open and erased then. 4.11."""

    length: Annotated[int, fields.U32]


@command(_DIR, DirCode.XTS_SDC_OPEN_FILE, name="DIR OPEN_FILE", errors=FileError)
class OpenFile(_OfFile[Ack]):
    """Open a file; at most 10 may be open. 4.11."""


@command(_DIR, DirCode.XTS_SDC_SET_FILE_DATA, name="DIR SET_FILE_DATA", errors=FileError)
class SetFileData(_OfFile[Ack]):
    """Write ``data``, at most 1024 bytes, into an open file. 4.11."""

    offset: Annotated[int, fields.U32]
    length: ClassVar[Annotated[int, fields.Count(("data",), "length")]]
    data: Annotated[bytes, fields.Block("length")]


@command(_DIR, DirCode.XTS_SDC_CLOSE_FILE, name="DIR CLOSE_FILE", errors=FileError)
class CloseFile(_OfFile[Ack]):
    """Close a file; the firmware ignores ``commit``. 4.11."""

    commit: Annotated[int, fields.U32] = 1


@command(_DIR, DirCode.XTS_SDC_GET_FILE_LENGTH, name="DIR GET_FILE_LENGTH", errors=FileError)
class GetFileLength(_OfFile[ReplyInt]):
    """Ask for a file's size [bytes]; it need not be open. 4.11."""


@command(_DIR, DirCode.XTS_SDC_GET_FILE_DATA, name="DIR GET_FILE_DATA", errors=FileError)
class GetFileData(_OfFile[ReplyByte]):
    """Read ``length`` bytes, at most 1024, of an open file. 4.11."""

    offset: Annotated[int, fields.U32]
    length: Annotated[int, fields.U32]


@command(_DIR, DirCode.XTS_SDC_DELETE_FILE, name="DIR DELETE_FILE", errors=FileError)
class DeleteFile(_OfFile[Ack]):
    """Delete a closed file; takes about 100 ms. 4.11."""


@command(_DIR, DirCode.XTS_SDC_FORMAT_FILESYSTEM, name="DIR FORMAT_FILESYSTEM", errors=FileError)
class FormatFilesystem(Command[Ack]):
    """Delete all files; ``key`` must be `FORMAT_KEY`. 4.11."""

    key: Annotated[int, fields.ID32]


@command(_DIR, DirCode.XTS_SDC_SYSTEM_TEST, name="DIR SYSTEM_TEST")
class SystemTest(Command[ReplyByte | Ack]):
    """Run a `TestCode`; 256 bytes, of which the first tells whether it passed, or an ACK. 4.10."""

    code: Annotated[int, fields.Number("B", "test_code").of(codes.TestCode)]


@command(
    _DIR,
    DirCode.XTS_SDC_SYSTEM_GET_INFO,
    name="DIR SYSTEM_GET_INFO",
    reply_content_id=lambda message: DirCode.XTS_SDC_SYSTEM_GET_INFO,
)
class SystemGetInfo(Command[ReplyString]):
    """Ask for an `InfoItem`. 4.10."""

    item: Annotated[int, fields.Number("B", "info_code").of(codes.InfoItem)]


@command(_DIR, DirCode.XTS_SDC_SYSTEM_GET_DEBUG_DATA, name="DIR SYSTEM_GET_DEBUG_DATA")
class SystemGetDebugData(Command[Response]):
    """A command that is not implemented: an emulator answers ERROR 1. 4.10."""

    item: Annotated[int, fields.Number("B", "info_code").of(codes.InfoItem)]


@command(_DIR, DirCode.XTS_SDC_GET_CRASH_DUMP_LENGTH, name="DIR GET_CRASH_DUMP_LENGTH")
class GetCrashDumpLength(Command[ReplyInt]):
    """Ask for the size of the crash dump [bytes]; 0 if there is none. 4.10."""


@command(_DIR, DirCode.XTS_SDC_CLEAR_CRASH_DUMP, name="DIR CLEAR_CRASH_DUMP")
class ClearCrashDump(Command[Ack]):
    """Delete the crash dump. 4.10."""


@command(_DIR, DirCode.XTS_SDC_GET_CRASH_DUMP, name="DIR GET_CRASH_DUMP")
class GetCrashDump(Command[ReplyByte]):
    """Read ``length`` bytes of the crash dump from ``offset``. 4.10."""

    offset: Annotated[int, fields.U32]
    length: Annotated[int, fields.U32]


@command(_DIR, DirCode.XTS_SDC_PREPARE_INJECT_FRAME, name="DIR PREPARE_INJECT_FRAME")
class PrepareInjectFrame(Command[Ack]):
    """Announce frames that replace the chip's: how many, of how many bins, `InjectMode`. 4.10."""

    frames: Annotated[int, fields.Number("I", "num_frames")]
    bins: Annotated[int, fields.Number("I", "num_bins")]
    mode: Annotated[int, fields.U32]


@command(_DIR, DirCode.XTS_SDC_INJECT_FRAME, name="DIR INJECT_FRAME")
class InjectFrame(Command[Ack]):
    """Give one frame in the chip's place: ``values`` are two float32 per bin. 4.10."""

    counter: Annotated[int, fields.Number("I", "frame_counter")]
    bins: ClassVar[Annotated[int, fields.Count(("values",), "frame_length", per=2)]]
    values: Annotated[tuple[float, ...], fields.Floats("bins", "samples", per=2, empty_shown=True)]


@command(_DIR, DirCode.XTS_SDC_COMM_SETBAUDRATE, name="DIR SETBAUDRATE")
class SetBaudRate(Command[Ack]):
    """Change the UART rate after the ACK; no effect on USB. 4.10."""

    baudrate: Annotated[int, fields.U32]


@command(_DIR, DirCode.XTS_SDC_SYSTEM_GET_VERSION, name="DIR SYSTEM_GET_VERSION (legacy)")
class LegacyGetVersion(Command[Response]):
    """An X2 command; an X4 answers ERROR 1. 4.10."""


@command(_DIR, DirCode.XTS_SDC_RADLIB_GETVARINT, name="DIR RADLIB_GETVARINT (legacy)")
class LegacyGetVarInt(Command[Response]):
    """An X2 command; an X4 answers ERROR 1. 4.10."""

    variable: Annotated[int, fields.Number("I", "id")]


@command(_DIR, name="DIR (legacy)")
class LegacyDirCommand(Command[Response]):
    """Any other X2 command, kept whole; an X4 answers ERROR 1. 4.10."""

    sub_code: Annotated[int, fields.Spelling(tuple(sorted(LEGACY_DIR_CODES)))]
    data: Annotated[bytes, fields.RestBytes()] = b""


_BOOTLOADER = CommandCode.XTS_SPC_BOOTLOADER


@command(_BOOTLOADER, BootloaderCode.GET_DEVICE_INFO, name="BOOTLOADER_GET_DEVICE_INFO")
class BootloaderGetDeviceInfo(Command[BootloaderSuccess]):
    """Ask which bootloader this is: a text. 4.12."""


@command(_BOOTLOADER, BootloaderCode.PAGE_SIZE, name="BOOTLOADER_PAGE_SIZE")
class BootloaderPageSize(Command[BootloaderSuccess]):
    """Ask for the size of a flash page [bytes]. 4.12."""


@command(_BOOTLOADER, BootloaderCode.PAGE_CNT, name="BOOTLOADER_PAGE_CNT")
class BootloaderPageCount(Command[BootloaderSuccess]):
    """Ask for the number of pages that an application may have. 4.12."""


def _image_checksum(message: "BootloaderWritePage") -> dict[str, Any]:
    announced = message.page == 0 and len(message.data) >= 4
    return {"image_checksum": int.from_bytes(message.data[:4], "little")} if announced else {}


@command(
    _BOOTLOADER, BootloaderCode.WRITE_PAGE, name="BOOTLOADER_WRITE_PAGE", derived=_image_checksum
)
class BootloaderWritePage(Command[BootloaderSuccess]):
    """Write a page of 512 bytes, the last one padded with FF. 4.12.

    Page 0 is not a page of the flash: its first four bytes are the sum of the image's bytes, and it
    unlocks the flash.
    """

    # The one big-endian number of the protocol, and a zero byte.
    page: Annotated[int, fields.Number("Hx", "page_address", order=">")]
    data: Annotated[bytes, fields.RestBytes(shown=len, label="data_len")]


@command(_BOOTLOADER, BootloaderCode.START_APP, name="BOOTLOADER_START_APP")
class BootloaderStartApp(Command[BootloaderSuccess]):
    """Compare the flash with the announced sum and leave for the application. 4.12."""


@command(_BOOTLOADER, BootloaderCode.ECHO, name="BOOTLOADER_ECHO")
class BootloaderEcho(Command[BootloaderEchoed]):
    """Ask the bootloader to send ``data`` back. 4.12."""

    data: Annotated[bytes, fields.RestBytes()] = b""


X4Value = int | float | tuple[float, float] | tuple[int, int]
_X4 = CommandCode.XTS_SPC_X4DRIVER
_I2C = id32(I2C_REGISTER)
_SETTING = fields.Member(X4Setting, "id")
REGISTERS = frozenset({X4Setting.SPIREGISTER, X4Setting.PIFREGISTER, X4Setting.XIFREGISTER})
# Struct codes and names of what SET carries, as the firmware parses it (4.9).
X4_SET_LAYOUTS: Mapping[int, tuple[str, tuple[str, ...]]] = {
    X4Setting.FPS: ("f", ("value",)),
    X4Setting.PULSESPERSTEP: ("I", ("value",)),
    X4Setting.ITERATIONS: ("I", ("value",)),
    X4Setting.DOWNCONVERSION: ("B", ("value",)),
    X4Setting.FRAMEAREA: ("ff", ("start", "end")),
    X4Setting.DACSTEP: ("I", ("value",)),
    X4Setting.DACMIN: ("I", ("value",)),
    X4Setting.DACMAX: ("I", ("value",)),
    X4Setting.FRAMEAREAOFFSET: ("f", ("value",)),
    X4Setting.ENABLE: ("B", ("value",)),
    X4Setting.TXCENTERFREQUENCY: ("B", ("value",)),
    X4Setting.TXPOWER: ("B", ("value",)),
    X4Setting.SPIREGISTER: ("BB", ("address", "value")),
    X4Setting.PIFREGISTER: ("BB", ("address", "value")),
    X4Setting.XIFREGISTER: ("BB", ("address", "value")),
    X4Setting.PRFDIV: ("B", ("value",)),
}
# The document's example sets PULSESPERSTEP in one byte; the vendor's host does so with DACSTEP.
_SHORT = frozenset({X4Setting.PULSESPERSTEP, X4Setting.DACSTEP})


@command(_X4, X4DriverCode.XTS_SPCX_INIT, name="X4DRIVER_INIT", errors=X4Error)
class X4DriverInit(Command[Ack]):
    """Restart the radar chip with default settings; takes up to a second. 4.9."""


@command(_X4, X4DriverCode.XTS_SPCX_SET, name="X4DRIVER_SET", errors=X4Error)
class X4DriverSet(Command[Ack]):
    """Set one X4 setting. 4.9.

    ``value`` is a number, of FPS [1/s], of FRAMEAREAOFFSET [m]; for FRAMEAREA (start, end) in
    module metres; for a register (address, value). ``value_width`` 1 marks the one-byte form that
    two settings tolerate.
    """

    setting: Annotated[X4Setting, _SETTING]
    value_width: Annotated[int | None, fields.ShortForm("setting", _SHORT)] = None
    value: Annotated[
        X4Value, fields.ByDiscriminator("setting", X4_SET_LAYOUTS, _SHORT, "value_width")
    ]


@command(
    _X4,
    X4DriverCode.XTS_SPCX_GET,
    name="X4DRIVER_GET",
    reply_content_id=lambda message: message.setting,
    errors=X4Error,
)
class X4DriverGet(Command[ReplyByte | ReplyInt | ReplyFloat]):
    """Read one X4 setting; a register needs its ``address``. 4.9."""

    setting: Annotated[X4Setting, _SETTING]
    address: Annotated[
        int | None,
        fields.OptionalByte(wanted=lambda fields: fields["setting"] in REGISTERS, required=True),
    ] = None


@command(_X4, X4DriverCode.XTS_SPCX_WRITE, name="X4DRIVER_WRITE", errors=X4Error)
class X4DriverWrite(Command[Ack]):
    """Write bytes to consecutive registers from ``address``. 4.9."""

    setting: Annotated[X4Setting, _SETTING] = X4Setting.SPIREGISTER
    address: Annotated[int, fields.U8]
    values: Annotated[bytes, fields.RestBytes(shown=list)]


@command(
    _X4,
    X4DriverCode.XTS_SPCX_READ,
    name="X4DRIVER_READ",
    reply_content_id=lambda message: message.setting,
    errors=X4Error,
)
class X4DriverRead(Command[ReplyByte]):
    """Read ``length`` bytes of registers from ``address``. 4.9."""

    setting: Annotated[X4Setting, _SETTING] = X4Setting.SPIREGISTER
    address: Annotated[int, fields.U8]
    length: Annotated[int, fields.U32]


@command(_X4, X4DriverCode.WRITE_I2C, *_I2C, name="X4DRIVER_WRITE_I2C", errors=X4Error)
class X4DriverWriteI2c(Command[Ack]):
    """Write bytes to the I2C device at ``address``; newer sensor firmware. 16."""

    address: Annotated[int, fields.U8]
    values: Annotated[bytes, fields.RestBytes(shown=list)]


@command(_X4, X4DriverCode.READ_I2C, *_I2C, name="X4DRIVER_READ_I2C", errors=X4Error)
class X4DriverReadI2c(Command[ReplyByte]):
    """Read ``length`` bytes from the I2C device; newer sensor firmware. 16."""

    length: Annotated[int, fields.U32]


_POSTPROCESSING = CommandCode.XTS_SPC_FRAME_POSTPROCESSING
PostprocessingValue = int | tuple[int, float]
# Struct codes and names of what SET carries (16).
POSTPROCESSING_LAYOUTS: Mapping[int, tuple[str, tuple[str, ...]]] = {
    FramePostprocessing.NORMALISATION: ("B", ("value",)),
    FramePostprocessing.PHASE_NOISE_CORRECTION: ("Bf", ("enable", "correction_distance")),
    FramePostprocessing.DECIMATION_FACTOR: ("I", ("value",)),
    FramePostprocessing.NUMBER_FORMAT: ("B", ("value",)),
    FramePostprocessing.LEGACY_OUTPUT: ("B", ("value",)),
}


@command(_POSTPROCESSING, FramePostprocessingCode.SET, name="FRAME_POSTPROCESSING_SET")
class FramePostprocessingSet(Command[Ack]):
    """Choose one step between chip and host; newer sensor firmware. 16.

    ``value`` is a number; for PHASE_NOISE_CORRECTION (1 or 0 for on or off, correction distance
    [m]).
    """

    setting: Annotated[FramePostprocessing, fields.Member(FramePostprocessing, "id")]
    value: Annotated[PostprocessingValue, fields.ByDiscriminator("setting", POSTPROCESSING_LAYOUTS)]


@command(_POSTPROCESSING, FramePostprocessingCode.GET, name="FRAME_POSTPROCESSING_GET")
class FramePostprocessingGet(Command[ReplyByte | ReplyFloat | ReplyInt]):
    """Ask for one setting between chip and host. 16.

    Of PHASE_NOISE_CORRECTION only the distance is answered, not whether it is on.
    """

    setting: Annotated[FramePostprocessing, fields.Member(FramePostprocessing, "id")]
