"""For each golden vector of a message, the message that its decoded fields describe.

The tables here are written by hand from the vectors' own vocabulary; nothing in them is computed
by the codec under test.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from hil_tests.golden.vectors import ABOUT, Fields, Vector
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import FramePostprocessing, X4Setting


def _number(text: str | int) -> int:
    return int(text, 16) if isinstance(text, str) else text


def _x4_set(fields: Fields) -> m.Message:
    setting = X4Setting[fields["id"]]
    value: Any
    if setting is X4Setting.FRAMEAREA:
        value = fields["start"], fields["end"]
    elif setting in m.REGISTERS:
        value = fields["address"], fields["value"]
    elif fields["value"] == "NaN":
        value = float("nan")
    else:
        value = fields["value"]
    short = "1-byte" in fields.get("note", "")
    return m.X4DriverSet(setting=setting, value=value, value_width=1 if short else None)


def _reply(kind: type[Any], values: Callable[[Any], Any], name: str, key: str) -> Any:  # noqa: ANN401 - rows differ in type
    return lambda fields: kind(
        content_id=_number(fields["content_id"]), info=fields["info"], **{name: values(fields[key])}
    )


def _floats(values: list[float]) -> Any:  # noqa: ANN401 - an array
    return np.array(values, dtype=np.float32)


def _baseband(kind: type[Any], first: str, second: str) -> Any:  # noqa: ANN401 - rows differ in type
    return lambda fields: kind(
        counter=fields["counter"],
        num_bins=fields["num_bins"],
        bin_length_m=fields["bin_length"],
        sampling_frequency_hz=fields["sampling_frequency"],
        carrier_frequency_hz=fields["carrier_frequency"],
        range_offset_m=fields["range_offset"],
        **{first: _floats(fields[first]), second: _floats(fields[second])},
    )


def _plain(kind: type[Any], **renamed: str) -> Callable[[Fields], m.Message]:
    """Build a message whose fields are the vector's numbers and texts, some under another name."""

    def build(fields: Fields) -> m.Message:
        given = {renamed.get(key, key): fields[key] for key in fields if key not in ABOUT}
        ids = {key: _number(value) for key, value in given.items() if str(value).startswith("0x")}
        message: m.Message = kind(**given | ids)
        return message

    return build


def _postprocessing_set(fields: Fields) -> m.Message:
    switched = "enable" in fields
    value = (fields["enable"], fields["correction_distance"]) if switched else fields["value"]
    return m.FramePostprocessingSet(setting=FramePostprocessing[fields["id"]], value=value)


def _matrix(kind: type[Any]) -> Callable[[Fields], m.Message]:
    names = {
        "instance": "pulsedoppler_instance",
        "byte_step_start": "byte_step_start_db",
        "byte_step_size": "byte_step_size_db",
        "frequency_start": "frequency_start_hz",
        "frequency_step": "frequency_step_hz",
        "range": "range_m",
    }

    def build(fields: Fields) -> m.Message:
        rest = {key: fields[key] for key in fields.keys() - {"data", "decompressed"}}
        is_float = "byte_step_start" not in fields
        data = {"power": _floats(fields["data"])} if is_float else {"levels": bytes(fields["data"])}
        return _plain(kind, **names)(rest | data)

    return build


def _listed(kind: type[Any], **renamed: str) -> Callable[[Fields], m.Message]:
    """Build a message with lists, whose counts it derives; a vector leaves empty lists out."""

    def build(vector: Fields) -> m.Message:
        counts = {"interval_count", "detection_count", "count", "frame_length"}
        rest = {key: vector[key] for key in vector.keys() - counts}
        lists = {key: tuple(value) for key, value in rest.items() if isinstance(value, list)}
        given = {renamed.get(key, key) for key in rest}
        absent = {field.name: () for field in dataclasses.fields(kind) if field.name not in given}
        return _plain(kind, **renamed)(rest | lists | absent)

    return build


_HIL_TYPES = {"none": 0x00, "byte": 0x10, "int": 0x11, "float": 0x12, "string": 0x13, "user": 0x50}


def _hil(fields: Fields) -> m.Message:
    data = fields["data"]
    kind = fields["datatype"]
    if kind in {"int", "float"}:
        values: Any = tuple(data)
    else:
        values = data if kind == "string" else bytes.fromhex(data)
    return m.HilReply(
        datatype=_HIL_TYPES[kind],
        hil_command=fields["hil_command"],
        info=fields["info"],
        values=values,
    )


def _radar(kind: type[Any], arrays: dict[str, str]) -> Callable[[Fields], m.Message]:
    def build(fields: Fields) -> m.Message:
        given = {name: np.array(fields[name], dtype) for name, dtype in arrays.items()}
        return _plain(
            kind,
            bin_length="bin_length_m",
            sampling_frequency="sampling_frequency_hz",
            carrier_frequency="carrier_frequency_hz",
            frames_per_second="frames_per_s",
            range_offset="range_offset_m",
        )(fields | given)

    return build


def _bootloader_success(fields: Fields) -> m.Message:
    value = fields.get("value", "")
    if isinstance(value, int):
        data = value.to_bytes(2, "little")
    else:
        data = bytes.fromhex(value) if len(value) == 2 else value.encode("latin-1")
    return m.BootloaderSuccess(data=data)


def _opaque(kind: type[Any]) -> Callable[[Fields], m.Message]:
    return lambda fields: kind(data=bytes.fromhex(fields["data"]))


BUILDERS: dict[str, Callable[[Fields], m.Message]] = {
    "PING": lambda fields: m.Ping(seed=_number(fields["seed"])),
    "MOD_RESET": lambda fields: m.ModReset(),
    "SETMODE": lambda fields: m.SetMode(mode=fields["mode"], param=fields["param"]),
    "GETMODE": lambda fields: m.GetMode(),
    "MOD_LOADAPP": lambda fields: m.LoadApp(profile_id=_number(fields["profile_id"])),
    "NOISEMAP_SETCONTROL": lambda fields: m.NoiseMapSetControl(control=fields["control"]),
    "OUTPUT_SETCONTROL": _plain(m.OutputSetControl),
    "IOPIN_SETCONTROL": _plain(m.IoPinSetControl),
    "IOPIN_SETVALUE": _plain(m.IoPinSetValue),
    "DIR SYSTEM_GET_INFO": lambda fields: m.SystemGetInfo(item=fields["info_code"]),
    "DIR GET_PROFILEID": lambda fields: m.GetProfileId(),
    "DIR SETBAUDRATE": lambda fields: m.SetBaudRate(baudrate=fields["baudrate"]),
    "X4DRIVER_INIT": lambda fields: m.X4DriverInit(),
    "X4DRIVER_SET": _x4_set,
    "X4DRIVER_GET": lambda fields: m.X4DriverGet(
        setting=X4Setting[fields["id"]], address=fields.get("address")
    ),
    "X4DRIVER_WRITE": lambda fields: m.X4DriverWrite(
        setting=X4Setting[fields["id"]], address=fields["address"], values=bytes(fields["values"])
    ),
    "X4DRIVER_READ": lambda fields: m.X4DriverRead(
        setting=X4Setting[fields["id"]], address=fields["address"], length=fields["length"]
    ),
    "ACK": lambda fields: m.Ack(),
    "ERROR": lambda fields: m.Error(code=fields["code"]),
    "PONG": lambda fields: m.Pong(value=_number(fields["value"])),
    "SYSTEM": lambda fields: m.System(code=fields["code"]),
    "REPLY BYTE": _reply(m.ReplyByte, bytes, "values", "values"),
    "REPLY INT": _reply(m.ReplyInt, tuple, "values", "values"),
    "REPLY FLOAT": _reply(
        m.ReplyFloat, lambda values: tuple(map(float, values)), "values", "values"
    ),
    "REPLY STRING": _reply(m.ReplyString, str, "text", "value"),
    "DATA FLOAT": _reply(m.DataFloat, _floats, "values", "data"),
    "DATA BYTE": _reply(m.DataByte, bytes.fromhex, "values", "data"),
    "DATA STRING": _reply(m.DataString, str, "text", "value"),
    "DATA USER": _reply(m.DataUser, bytes.fromhex, "values", "data"),
    "BASEBAND_IQ": _baseband(m.BasebandIq, "i", "q"),
    "BASEBAND_AP": _baseband(m.BasebandAp, "amplitude", "phase"),
    "START_BOOTLOADER": lambda fields: m.StartBootloader(key=_number(fields["key"])),
    "MOD_SETCOM": lambda fields: m.SetCom(data=bytes.fromhex(fields["data"])),
    "SETLEDCONTROL": _plain(m.SetLedControl),
    "DEBUG_LEVEL": _plain(m.DebugLevel),
    "HIL": lambda fields: _hil(fields) if "datatype" in fields else m.Hil(),
    "APP_SET DETECTION_ZONE": _plain(m.SetDetectionZone, start="start_m", end="end_m"),
    "APP_GET DETECTION_ZONE": _plain(m.GetDetectionZone),
    "APP_GET DETECTION_ZONE_LIMITS": _plain(m.GetDetectionZoneLimits),
    "APP_SET SENSITIVITY": _plain(m.SetSensitivity),
    "APP_GET SENSITIVITY": _plain(m.GetSensitivity),
    "APP_SET TX_CENTER_FREQ": _plain(m.SetTxCenterFrequency, band="tx_center_frequency"),
    "APP_GET TX_CENTER_FREQ": _plain(m.GetTxCenterFrequency),
    "APP_SET LED_CONTROL": _plain(m.AppSetLedControl),
    "APP_GET LED_CONTROL": _plain(m.AppGetLedControl),
    "APP_SET PROFILE_PARAMETERFILE": _plain(m.SetParameterFile, filename="name"),
    "APP_GET PROFILE_PARAMETERFILE": _plain(m.GetParameterFile, filename="name"),
    "APP_FACTORY_PRESET": _plain(m.FactoryPreset),
    "APP_STORE_NOISEMAP": _plain(m.StoreNoiseMap),
    "APP_LOAD_NOISEMAP": _plain(m.LoadNoiseMap),
    "APP_DELETE_NOISEMAP": _plain(m.DeleteNoiseMap),
    "APP_POLL": lambda fields: m.AppPoll(data=bytes.fromhex(fields["data"])),
    "NOISEMAP_GETCONTROL": _plain(m.NoiseMapGetControl),
    "NOISEMAP_SET_PERIODIC_STORE": _plain(m.NoiseMapSetPeriodicStore),
    "NOISEMAP_GET_PERIODIC_STORE": _plain(m.NoiseMapGetPeriodicStore),
    "OUTPUT_GETCONTROL": _plain(m.OutputGetControl),
    "DEBUG_OUTPUT_SETCONTROL": _plain(m.DebugOutputSetControl),
    "DEBUG_OUTPUT_GETCONTROL": _plain(m.DebugOutputGetControl),
    "IOPIN_GETCONTROL": _plain(m.IoPinGetControl),
    "IOPIN_GETVALUE": _plain(m.IoPinGetValue),
    "X4DRIVER_WRITE_I2C": lambda fields: m.X4DriverWriteI2c(
        address=fields["address"], values=bytes(fields["values"])
    ),
    "X4DRIVER_READ_I2C": _plain(m.X4DriverReadI2c),
    "FRAME_POSTPROCESSING_SET": _postprocessing_set,
    "FRAME_POSTPROCESSING_GET": lambda fields: m.FramePostprocessingGet(
        setting=FramePostprocessing[fields["id"]]
    ),
    "DIR SYSTEM_TEST": _plain(m.SystemTest, test_code="code"),
    "DIR SYSTEM_GET_DEBUG_DATA": _plain(m.SystemGetDebugData, info_code="item"),
    "DIR GET_CRASH_DUMP_LENGTH": _plain(m.GetCrashDumpLength),
    "DIR CLEAR_CRASH_DUMP": _plain(m.ClearCrashDump),
    "DIR GET_CRASH_DUMP": _plain(m.GetCrashDump),
    "DIR PREPARE_INJECT_FRAME": _plain(m.PrepareInjectFrame, num_frames="frames", num_bins="bins"),
    "DIR INJECT_FRAME": _listed(m.InjectFrame, frame_counter="counter", samples="values"),
    "DIR SYSTEM_GET_VERSION (legacy)": _plain(m.LegacyGetVersion),
    "DIR RADLIB_GETVARINT (legacy)": _plain(m.LegacyGetVarInt, id="variable"),
    "DIR (legacy)": lambda fields: m.LegacyDirCommand(
        sub_code=_number(fields["sub_code"]), data=bytes.fromhex(fields["data"])
    ),
    "DIR SEARCH_FILE_TYPE": _plain(m.SearchFileType, type="file_type"),
    "DIR FIND_ALL_FILES": _plain(m.FindAllFiles),
    "DIR CREATE_NEW_FILE": _plain(m.CreateFile, type="file_type"),
    "DIR OPEN_FILE": _plain(m.OpenFile, type="file_type"),
    "DIR SET_FILE_DATA": lambda fields: m.SetFileData(
        file_type=_number(fields["type"]),
        identifier=fields["identifier"],
        offset=fields["offset"],
        data=bytes.fromhex(fields["data"]),
    ),
    "DIR CLOSE_FILE": _plain(m.CloseFile, type="file_type"),
    "DIR GET_FILE_LENGTH": _plain(m.GetFileLength, type="file_type"),
    "DIR GET_FILE_DATA": _plain(m.GetFileData, type="file_type"),
    "DIR DELETE_FILE": _plain(m.DeleteFile, type="file_type"),
    "DIR FORMAT_FILESYSTEM": _plain(m.FormatFilesystem),
    "BOOTLOADER_GET_DEVICE_INFO": _plain(m.BootloaderGetDeviceInfo),
    "BOOTLOADER_WRITE_PAGE": lambda fields: m.BootloaderWritePage(
        page=fields["page_address"], data=bytes.fromhex(fields["data"])
    ),
    "BOOTLOADER_START_APP": _plain(m.BootloaderStartApp),
    "BOOTLOADER_PAGE_SIZE": _plain(m.BootloaderPageSize),
    "BOOTLOADER_PAGE_CNT": _plain(m.BootloaderPageCount),
    "BOOTLOADER_ECHO": lambda fields: m.BootloaderEcho(data=bytes.fromhex(fields["data"])),
    "BOOTLOADER success": _bootloader_success,
    "BOOTLOADER framing error": lambda fields: m.BootloaderFramingError(code=fields["code"]),
    "BOOTLOADER error": _plain(m.BootloaderError),
    "REPLY NONE": _plain(m.ReplyNone),
    "REPLY USER": _reply(m.ReplyUser, bytes, "values", "values"),
    "PULSEDOPPLER_FLOAT": _matrix(m.PulseDopplerFloat),
    "PULSEDOPPLER_BYTE": _matrix(m.PulseDopplerByte),
    "NOISEMAP_FLOAT": _matrix(m.NoiseMapFloat),
    "NOISEMAP_BYTE": _matrix(m.NoiseMapByte),
    "PRESENCE_SINGLE": _plain(m.PresenceSingle, presence_state="state", distance="distance_m"),
    "PRESENCE_MOVINGLIST": _listed(
        m.PresenceMovingList, presence_state="state", detection_distance="detection_distance_m"
    ),
    "RESP_STATUS": _plain(m.RespStatus, distance="distance_m"),
    "SLEEP_STATUS": _plain(m.SleepStatus, distance="distance_m"),
    "VITAL_SIGNS": _plain(
        m.VitalSigns,
        respiration_distance="respiration_distance_m",
        heart_distance="heart_distance_m",
        normalized_movement_start="normalized_movement_start_m",
        normalized_movement_end="normalized_movement_end_m",
    ),
    "SLEEPSTAGE": _plain(m.SleepStage),
    "RESPIRATION_MOVINGLIST": _listed(m.RespirationMovingList),
    "RESPIRATION_DETECTIONLIST": _listed(
        m.RespirationDetectionList, detection_distance="detection_distance_m"
    ),
    "RESPIRATION_NORMALIZEDMOVEMENTLIST": _listed(
        m.RespirationNormalizedMovementList,
        start="start_m",
        bin_length="bin_length_m",
        slow="movement_slow",
        fast="movement_fast",
    ),
    "PROFILE_PARAMETERFILE": _plain(m.ParameterFile, filename="name"),
    "RESP_STATUS_EXT": _opaque(m.RespStatusExt),
    "RADAR_RF": _radar(m.RadarRf, {"samples": "<u4"}),
    "RADAR_RF_NORMALIZED": _radar(m.RadarRfNormalized, {"samples": "<f4"}),
    "RADAR_BASEBAND_FLOAT": _radar(m.RadarBasebandFloat, {"i": "<f4", "q": "<f4"}),
    "RADAR_BASEBAND_Q15": _radar(m.RadarBasebandQ15, {"i": "<i2", "q": "<i2"}),
    "PRESENCE_STATUS": _opaque(m.PresenceStatus),
    "DECIM_STATUS": _opaque(m.DecimStatus),
}

# Vectors whose fields the file abbreviates; the rest is written out from the rule it gives.
_ABBREVIATED: dict[str, Fields] = {
    "bl_write_page": {"data": "00 01 02 03 04 05 06 07"},
    "bl_write_page_0_checksum": {"data": "87 D6 12 00"},
    "bl_write_page_128": {"data": "00 01 02 03 04 05 06 07 08 09 0A 0B 0C 0D 0E 0F"},
    "reply_system_test_x4_conn_pass": {"values": [1, *[0] * 255]},
    "data_float_baseband_181bins": {"data": [(k - 90) / 1024 for k in range(362)]},
}


def message_of(vector: Vector) -> m.Message:
    if vector.name == "bl_reply_echo":  # command and answer have one name
        return m.BootloaderEchoed(data=bytes.fromhex(vector.decoded["data"]))
    return BUILDERS[vector.message](vector.decoded | _ABBREVIATED.get(vector.name, {}))
