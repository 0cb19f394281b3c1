"""The golden vectors and, for each, the message that its decoded fields describe.

The tables here are written by hand from the vectors' own vocabulary; nothing in them is computed
by the codec under test.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from xethru_protocol import messages as m
from xethru_protocol.codes import X4Setting

Fields = dict[str, Any]

FIXTURES = Path(__file__).parents[2] / "fixtures"


@dataclass(frozen=True, slots=True)
class Vector:
    """One entry of ``fixtures/wire/protocol_vectors.json``."""

    name: str
    from_host: bool
    wire: bytes
    decoded: Fields
    valid: bool

    @property
    def message(self) -> str:
        """What the vector calls its message; empty for streams."""
        return str(self.decoded.get("message", ""))

    @property
    def is_stream(self) -> bool:
        """Whether the vector is about framing rather than one message."""
        return self.decoded["framing"] == "stream" or self.name.startswith("stream_")

    @property
    def payload(self) -> bytes | None:
        """The payload, where the vector lists it."""
        text = self.decoded.get("payload")
        return None if text is None else bytes.fromhex(text)


def load() -> tuple[Vector, ...]:
    """All vectors, in the file's order."""
    text = (FIXTURES / "wire" / "protocol_vectors.json").read_text("utf-8")
    return tuple(
        Vector(
            entry["name"],
            entry["direction"] == "host->module",
            bytes.fromhex(entry["hex"]),
            entry["decoded"],
            entry["valid"],
        )
        for entry in json.loads(text)
    )


def _number(text: str | int) -> int:
    return int(text, 16) if isinstance(text, str) else text


def _x4_set(fields: Fields) -> m.Message:
    setting = X4Setting[fields["id"]]
    value: Any
    if setting is X4Setting.FRAMEAREA:
        value = fields["start"], fields["end"]
    elif setting in m.REGISTERS:
        value = fields["address"], fields["value"]
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


BUILDERS: dict[str, Callable[[Fields], m.Message]] = {
    "PING": lambda fields: m.Ping(seed=_number(fields["seed"])),
    "MOD_RESET": lambda fields: m.ModReset(),
    "SETMODE": lambda fields: m.SetMode(mode=fields["mode"], param=fields["param"]),
    "GETMODE": lambda fields: m.GetMode(),
    "MOD_LOADAPP": lambda fields: m.LoadApp(profile_id=_number(fields["profile_id"])),
    "NOISEMAP_SETCONTROL": lambda fields: m.NoiseMapSetControl(control=fields["control"]),
    "OUTPUT_SETCONTROL": lambda fields: m.OutputSetControl(
        feature=_number(fields["feature"]), control=fields["control"]
    ),
    "IOPIN_SETCONTROL": lambda fields: m.IoPinSetControl(
        pin_id=fields["pin_id"], pin_setup=fields["pin_setup"], pin_feature=fields["pin_feature"]
    ),
    "IOPIN_SETVALUE": lambda fields: m.IoPinSetValue(
        pin_id=fields["pin_id"], pin_value=fields["pin_value"]
    ),
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
    "REPLY FLOAT": _reply(m.ReplyFloat, tuple, "values", "values"),
    "REPLY STRING": _reply(m.ReplyString, str, "text", "value"),
    "DATA FLOAT": _reply(m.DataFloat, _floats, "values", "data"),
    "DATA BYTE": _reply(m.DataByte, bytes.fromhex, "values", "data"),
    "DATA STRING": _reply(m.DataString, str, "text", "value"),
    "DATA USER": _reply(m.DataUser, bytes.fromhex, "values", "data"),
    "BASEBAND_IQ": _baseband(m.BasebandIq, "i", "q"),
    "BASEBAND_AP": _baseband(m.BasebandAp, "amplitude", "phase"),
}

# Vectors whose fields the file abbreviates; the rest is written out from the rule it gives.
_ABBREVIATED: dict[str, Fields] = {
    "reply_system_test_x4_conn_pass": {"values": [1, *[0] * 255]},
    "data_float_baseband_181bins": {"data": [(k - 90) / 1024 for k in range(362)]},
}


def message_of(vector: Vector) -> m.Message:
    """Message that a vector of a known kind describes."""
    return BUILDERS[vector.message](vector.decoded | _ABBREVIATED.get(vector.name, {}))


# Messages that have no row yet: what a later change adds must be taken from here.
WITHOUT_ROW = frozenset(
    {
        "APP_DELETE_NOISEMAP",
        "APP_FACTORY_PRESET",
        "APP_GET DETECTION_ZONE",
        "APP_GET DETECTION_ZONE_LIMITS",
        "APP_GET LED_CONTROL",
        "APP_GET PROFILE_PARAMETERFILE",
        "APP_GET SENSITIVITY",
        "APP_GET TX_CENTER_FREQ",
        "APP_LOAD_NOISEMAP",
        "APP_SET DETECTION_ZONE",
        "APP_SET LED_CONTROL",
        "APP_SET PROFILE_PARAMETERFILE",
        "APP_SET SENSITIVITY",
        "APP_SET TX_CENTER_FREQ",
        "APP_STORE_NOISEMAP",
        "BOOTLOADER_GET_DEVICE_INFO",
        "BOOTLOADER_START_APP",
        "BOOTLOADER_WRITE_PAGE",
        "DEBUG_LEVEL",
        "DEBUG_OUTPUT_GETCONTROL",
        "DEBUG_OUTPUT_SETCONTROL",
        "DIR CLEAR_CRASH_DUMP",
        "DIR CLOSE_FILE",
        "DIR CREATE_NEW_FILE",
        "DIR DELETE_FILE",
        "DIR FIND_ALL_FILES",
        "DIR FORMAT_FILESYSTEM",
        "DIR GET_CRASH_DUMP",
        "DIR GET_CRASH_DUMP_LENGTH",
        "DIR GET_FILE_DATA",
        "DIR GET_FILE_LENGTH",
        "DIR INJECT_FRAME",
        "DIR OPEN_FILE",
        "DIR PREPARE_INJECT_FRAME",
        "DIR RADLIB_GETVARINT (legacy)",
        "DIR SEARCH_FILE_TYPE",
        "DIR SET_FILE_DATA",
        "DIR SYSTEM_GET_DEBUG_DATA",
        "DIR SYSTEM_GET_VERSION (legacy)",
        "DIR SYSTEM_TEST",
        "HIL",
        "IOPIN_GETCONTROL",
        "IOPIN_GETVALUE",
        "NOISEMAP_BYTE",
        "NOISEMAP_FLOAT",
        "NOISEMAP_GETCONTROL",
        "OUTPUT_GETCONTROL",
        "PRESENCE_MOVINGLIST",
        "PRESENCE_SINGLE",
        "PROFILE_PARAMETERFILE",
        "PULSEDOPPLER_BYTE",
        "PULSEDOPPLER_FLOAT",
        "RESPIRATION_DETECTIONLIST",
        "RESPIRATION_MOVINGLIST",
        "RESPIRATION_NORMALIZEDMOVEMENTLIST",
        "RESP_STATUS",
        "SETLEDCONTROL",
        "SLEEPSTAGE",
        "SLEEP_STATUS",
        "START_BOOTLOADER",
        "UNKNOWN",
        "VITAL_SIGNS",
    }
)
