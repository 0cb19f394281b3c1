"""What ``moduleconnectorwrapper`` holds: numbers, vectors, pointers, and messages as data.

A message of ours becomes an object with the vendor's attribute names by one row of `_DATA`. Its
lists are `Vector`, as the attributes of the vendor's objects are; what a method such as
``get_data()`` returns is a numpy array.
"""

from collections.abc import Iterator, Mapping
from enum import IntEnum
from typing import Any, ClassVar, Final, NoReturn, Self

import numpy as np

from xethru_protocol.recordings.vendor.layouts import ALL_BITS, KINDS
from xethru_protocol.wire import codes
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.table import Response

_X2 = "it is of modules with the X2 chip, to which this driver does not speak"
_CONFIGURATION = "read and write registers by X4M300.registers"
_WHOLE = "all directories of a recording are read; xethru_protocol.read_recording takes one"
MISSING: Final[Mapping[str, str]] = {
    "ModuleConnector.get_x2": _X2,
    "ModuleConnector.get_x2m200": _X2,
    "ModuleConnector.get_transport": "send packets by X4M300.request, receive by X4M300.listeners",
    "ModuleConnector.get_not_supported": "what it did is in get_xep() and get_x4m300()",
    "DataReader.open with a depth": _WHOLE,
    "DataPlayer with a depth": _WHOLE,
    "DataRecorder.process of a text file": "write messages by RecordingWriter of "
    "xethru_protocol.recordings",
    "X4.load_config": _CONFIGURATION,
    "X4.write_config": _CONFIGURATION,
    "X4.set_use_shadow": _CONFIGURATION,
    "X4.refresh_shadow": _CONFIGURATION,
}
"""What a script cannot call, and what there is for it."""


def not_implemented(call: str) -> NoReturn:
    """Raise what a call of `MISSING` gets."""
    raise NotImplementedError(f"{call} is not implemented: {MISSING[call]}")


# --- numbers ------------------------------------------------------------------------------------

# The vendor's prefix of members that bear their plain names here.
_PREFIXES: Final[Mapping[str, type[IntEnum]]] = {
    "XTS_SPCXI_": codes.X4Setting,
    "XTS_ID_": codes.AppObject,
    "XTS_SM_NORMAL_": codes.NormalModeParam,
    "XTID_LED_MODE_": codes.LedMode,
    "XTID_FIM_": codes.InjectMode,
    "XTID_IOPIN_FEATURE_": codes.IoPinFeature,
    "XTS_VAL_RESP_STATE_": codes.RespirationState,
    "XTS_VAL_PRESENCE_PRESENCESTATE_": codes.PresenceState,
    "XTFILE_TYPE_": codes.FileType,
}
_OTHERS: Final[Mapping[str, int]] = {
    "XTS_ID_APP_UNKNOWN": codes.ProfileId.XTS_ID_APP_NONE,
    "XTS_ID_APPLICATION_USER_ZONE": 0xA53695BB,
    "XTS_ID_RESPIRATION_MOVEMENTLIST": codes.OutputFeature.RESPIRATION_MOVINGLIST,
    "XTS_DEF_PINGVAL": 0xEEAAEAAE,
    "XTS_DEF_PONGVAL_READY": codes.PongCode.XTS_SPRP_READY,
    "XTS_DEF_PONGVAL_NOTREADY": codes.PongCode.XTS_SPRP_NOTREADY,
    "XTS_DEF_PONGVAL_SAFEMODE": codes.PongCode.XTS_SPRP_SAFEMODE,
    "XTS_SSTC_TEST_READ_IOPINS": codes.TestCode.READ_IO_PINS,
    "XTS_SSTC_TEST_X4_CONN": codes.TestCode.X4_CONNECTION,
    "XTS_SSTC_TEST_CERT_MODE_EN": codes.TestCode.CERTIFICATION_ON,
    "XTS_SSTC_TEST_CERT_MODE_DIS": codes.TestCode.CERTIFICATION_OFF,
    "XTS_SSTC_TEST_HW_CONFIG": codes.TestCode.HARDWARE_CONFIG,
    "XTS_SSTC_TEST_CERT_TX_ONLY": codes.TestCode.TX_ONLY,
    "XTS_SSTC_TEST_CERT_TX_ONLY_TX_OFF": codes.TestCode.TX_ONLY_TX_OFF,
    "XTS_SSTC_TEST_CERT_STREAM_TX_OFF": codes.TestCode.STREAM_TX_OFF,
    "XTFILE_TYPE_CRASHDUMP": codes.FileType.CRASH_DUMP,
    "XTFILE_TYPE_PARFILE": codes.FileType.PARAMETER_FILE,
    "XTID_IOPIN_SETUP_INPUT": 0,
    "XTID_IOPIN_SETUP_OUTPUT": codes.IoPinSetup.OUTPUT,
    "XTID_IOPIN_SETUP_PUSH_PULL": codes.IoPinSetup.PUSH_PULL,
    "XTID_IOPIN_SETUP_INVERTED": codes.IoPinSetup.ACTIVE_LOW,
    "XTID_IOPIN_SETUP_PULLUP": codes.IoPinSetup.PULL_UP,
    "XTID_IOPIN_FEATURE_NOPRESENCE": codes.IoPinFeature.NO_PRESENCE,
    "XTID_IOPIN_FEATURE_LAST": codes.IoPinFeature.NO_PRESENCE,
    "XTID_OUTPUT_CONTROL_DISABLE": 0,
    "XTID_OUTPUT_CONTROL_ENABLE": codes.OutputControl.ON,
    "XTID_OUTPUT_CONTROL_DEBUG": codes.OutputControl.DEBUG_ROUTING,
    "XTID_OUTPUT_CONTROL_PD_SLOW_ENABLE": codes.MatrixControl.SLOW,
    "XTID_OUTPUT_CONTROL_PD_FAST_ENABLE": codes.MatrixControl.FAST,
    "XTID_NOISEMAP_CONTROL_USE_DEFAULT": 0,
    "XTID_NOISEMAP_CONTROL_DISABLE": 0,
    "XTID_NOISEMAP_CONTROL_ENABLE": codes.NoiseMapControl.NO_DEFAULT,
    "XTID_NOISEMAP_CONTROL_NONADAPTIVE": 0,
    "XTID_NOISEMAP_CONTROL_ADAPTIVE": codes.NoiseMapControl.ADAPTIVE,
    "XTID_NOISEMAP_CONTROL_USE_STORED": 0,
    "XTID_NOISEMAP_CONTROL_INIT_ON_RESET": codes.NoiseMapControl.IGNORE_STORED,
    "XTID_CENTER_FREQ_LOWBAND": codes.TxCenterFrequency.LOW_BAND,
    "XTID_CENTER_FREQ_HIGHBAND": codes.TxCenterFrequency.HIGH_BAND,
    "XTID_MCP_ERROR_NOT_RECOGNIZED": codes.ErrorCode.XTS_SPRE_NOT_RECOGNIZED,
    **{f"XTID_BAUDRATE_{rate}": rate for rate in codes.BAUD_RATES},
}


def numbers() -> dict[str, int]:
    """Return the numbers of ``pymoduleconnector.ids`` by name, without those of retired commands.

    Modes and items of information have two names each, ``XTID_SM_RUN`` and ``XTS_SM_RUN``.
    """
    found: dict[str, int] = {}
    for enum in vars(codes).values():
        if isinstance(enum, type) and issubclass(enum, IntEnum):
            for name, member in enum.__members__.items():
                if name.startswith(("XTS_", "XTID_")):
                    found[name] = int(member)
                if name.startswith(("XTID_SM_", "XTID_SSIC_")):
                    found[name.replace("XTID_", "XTS_", 1)] = int(member)
    for prefix, enum in _PREFIXES.items():
        found |= {f"{prefix}{name}": int(member) for name, member in enum.__members__.items()}
    return found | {name: int(value) for name, value in _OTHERS.items()}


# Where the vendor's name of the bit is not that of our message.
_TYPE_NAMES = {
    m.SleepStatus: "Sleep",
    m.RespStatus: "Respiration",
    m.DataString: "String",
    m.DataFloat: "Float",
    m.DataByte: "Byte",
}

DataType: Any = type(
    "DataType",
    (),
    {
        "PerformanceStatusType": 1 << 4,
        **{
            f"{_TYPE_NAMES.get(kind.message, kind.message.__name__)}DataType": kind.data_type
            for kind in KINDS
        },
    },
)
"""Bits of the kinds of recorded data; `start_recording` takes several, joined by ``|``."""
InvalidDataType = 0
AllDataTypes = ALL_BITS


# --- vectors and pointers -----------------------------------------------------------------------


class Vector(list[Any]):
    """A list that also has the methods of the vendor's ``FloatVector``, ``ucVector`` and others."""

    size = list.__len__
    push_back = list.append

    def empty(self) -> bool:
        return not self

    def front(self) -> Any:
        return self[0]

    def back(self) -> Any:
        return self[-1]

    def pop_back(self) -> None:
        self.pop()

    def tobytes(self) -> bytes:
        """Return numbers 0 ... 255 as bytes."""
        return bytes(self)


def vector(values: Any) -> Vector:
    """Return numbers as Python numbers, which printing and JSON know."""
    return Vector(values.tolist() if isinstance(values, np.ndarray) else values)


class Pointer:
    """Where a method that fills its arguments puts a value."""

    def __init__(self, value: Any) -> None:
        self.value = value


def pointer_functions() -> Iterator[tuple[str, Any]]:
    """Yield ``new_uint32_t_ptr`` and its like, by name."""

    def assign(pointer: Pointer, value: Any) -> None:
        pointer.value = value

    for name, empty in {"uint32_t": 0, "uint8_t": 0, "float": 0.0, "string": ""}.items():
        yield f"new_{name}_ptr", lambda empty=empty: Pointer(empty)
        yield f"copy_{name}_ptr", Pointer
        yield f"delete_{name}_ptr", lambda pointer: None
        yield f"{name}_ptr_assign", assign
        yield f"{name}_ptr_value", lambda pointer: pointer.value


# --- messages as data ---------------------------------------------------------------------------


class Data:
    """Attributes under the vendor's names; made from one of our messages, or empty."""

    _fields: ClassVar[Mapping[str, str]] = {}
    _lists: ClassVar[frozenset[str]] = frozenset()

    def __init__(self, **values: Any) -> None:
        for name in self._fields:
            default: Any = Vector() if name in self._lists else 0
            setattr(self, name, values.get(name, default))

    def __repr__(self) -> str:
        shown = ", ".join(f"{name}={getattr(self, name)!r}" for name in self._fields)
        return f"{type(self).__name__}({shown})"

    @classmethod
    def of(cls, message: Response) -> Self:
        values = {}
        for name, ours in cls._fields.items():
            value = getattr(message, ours) if ours else 0
            values[name] = vector(value) if name in cls._lists else value
        return cls(**values)


def _array_method(name: str, dtype: type[np.generic]) -> Any:
    return lambda self: np.array(getattr(self, name), dtype)


def _data(fields: str, lists: str = "", methods: str = "") -> tuple[str, str, str]:
    return fields, lists, methods


_BINS = (
    "num_bins bin_length=bin_length_m sample_frequency=sampling_frequency_hz "
    "carrier_frequency=carrier_frequency_hz "
)
_BASEBAND = f"frame_counter=counter {_BINS}range_offset=range_offset_m"
_RADAR = f"frame_counter=counter {_BINS}frames_per_second=frames_per_s range_offset=range_offset_m"
_CORRECTED = f"{_RADAR} decimation_factor correction_bin correction_i correction_q"
_MATRIX = (
    "frame_counter=counter matrix_counter range_idx range_bins frequency_count "
    "pulsedoppler_instance fps fps_decimated frequency_start=frequency_start_hz "
    "frequency_step=frequency_step_hz range=range_m"
)
_IQ = "i_data=i q_data=q"
_IQ_METHODS = "get_I=i_data get_Q=q_data"

# Name of the vendor's class: its attributes, as ``theirs`` or ``theirs=ours`` (nothing: the message
# of ours lacks it), those that are lists, and methods that return a list.
_DATA: Final = {
    "DataFloat": _data("content_id info", "data=values", "get_data=data get_copy=data"),
    "BasebandApData": _data(
        _BASEBAND, "amplitude phase", "get_amplitude=amplitude get_phase=phase"
    ),
    "BasebandIqData": _data(_BASEBAND, _IQ, _IQ_METHODS),
    "RadarRfData": _data(_RADAR, "data=samples", "get_data=data"),
    "RadarRfNormalizedData": _data(_RADAR, "data=samples", "get_data=data"),
    "RadarBasebandFloatData": _data(_CORRECTED, _IQ, _IQ_METHODS),
    "RadarBasebandQ15Data": _data(f"{_CORRECTED} scaling_factor", _IQ, _IQ_METHODS),
    "PulseDopplerFloatData": _data(_MATRIX, "data=power", "get_data=data"),
    "PulseDopplerByteData": _data(
        f"{_MATRIX} byte_step_start=byte_step_start_db byte_step_size=byte_step_size_db",
        "data=levels",
        "get_data=data",
    ),
    "PresenceSingleData": _data(
        "frame_counter=counter presence_state=state distance=distance_m direction signal_quality"
    ),
    "PresenceMovingListData": _data(
        "frame_counter=counter presence_state=state",
        "movement_slow_items=movement_slow movement_fast_items=movement_fast "
        "detection_distance_items=detection_distance_m radar_cross_section_items=detection_rcs "
        "detection_velocity_items=detection_velocity",
        "get_movement_slow_items=movement_slow_items get_movement_fast_items=movement_fast_items "
        "get_detection_distance_items=detection_distance_items "
        "get_radar_cross_section=radar_cross_section_items "
        "get_detection_velocity_items=detection_velocity_items",
    ),
    "RespirationData": _data(
        "frame_counter=counter sensor_state=state respiration_rate=rpm distance=distance_m "
        "movement=movement_mm signal_quality"
    ),
    "SleepData": _data(
        "frame_counter=counter sensor_state=state respiration_rate=rpm distance=distance_m "
        "signal_quality movement_slow movement_fast"
    ),
    "RespirationMovingListData": _data(
        "counter",
        "movement_slow_items=movement_slow movement_fast_items=movement_fast",
        "get_movement_slow_items=movement_slow_items get_movement_fast_items=movement_fast_items",
    ),
    "RespirationDetectionListData": _data(
        "counter",
        "detection_distance_items=detection_distance_m "
        "detection_radar_cross_section_items=detection_rcs "
        "detection_velocity_items=detection_velocity",
        "get_detection_distance_items=detection_distance_items "
        "get_detection_radar_cross_section_items=detection_radar_cross_section_items "
        "get_detection_velocity_items=detection_velocity_items",
    ),
    "RespirationNormalizedMovementListData": _data(
        "frame_counter=counter start=start_m bin_length=bin_length_m",
        "normalized_movement_slow_items=movement_slow normalized_movement_fast_items=movement_fast",
    ),
    "VitalSignsData": _data(
        "frame_counter=counter sensor_state=state respiration_rate "
        "respiration_distance=respiration_distance_m respiration_confidence heart_rate "
        "heart_distance=heart_distance_m heart_confidence normalized_movement_slow "
        "normalized_movement_fast normalized_movement_start=normalized_movement_start_m "
        "normalized_movement_end=normalized_movement_end_m"
    ),
    "SleepStageData": _data("frame_counter=counter sleepstage=stage confidence="),
    "DetectionZone": _data("start end"),
    "DetectionZoneLimits": _data("start end step"),
    "FrameArea": _data("start end"),
    "IoPinControl": _data("setup feature"),
    "PeriodicNoisemapStore": _data("interval_minutes reserved"),
    "Files": _data(
        "",
        "file_type_items file_identifier_items",
        "get_file_type_items=file_type_items get_file_identifier_items=file_identifier_items",
    ),
}


_DTYPES: Final[Mapping[str, type[np.generic]]] = {
    "PulseDopplerByteData": np.uint8,
    "RadarBasebandQ15Data": np.int16,
    "Files": np.int64,
}


def _pairs(text: str) -> dict[str, str]:
    return {
        theirs: ours if equals else theirs
        for theirs, equals, ours in (one.partition("=") for one in text.split())
    }


def _make(name: str, fields: str, lists: str, methods: str) -> type[Data]:
    members: dict[str, Any] = {
        "_fields": _pairs(fields) | _pairs(lists),
        "_lists": frozenset(_pairs(lists)),
    }
    dtype = _DTYPES.get(name, np.float32)
    members |= {method: _array_method(of, dtype) for method, of in _pairs(methods).items()}
    if "detection_distance_items" in members["_lists"]:
        members["detection_count"] = property(lambda self: len(self.detection_distance_items))
    if "normalized_movement_slow_items" in members["_lists"]:
        members["count"] = property(lambda self: len(self.normalized_movement_slow_items))
    return type(name, (Data,), members)


CLASSES: Final[Mapping[str, type[Data]]] = {name: _make(name, *row) for name, row in _DATA.items()}
"""The vendor's classes of data, by name."""
