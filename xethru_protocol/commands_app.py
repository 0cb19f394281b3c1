"""Rows of the message table: settings of the loaded profile, APPCOMMAND.

Names in dumps are those of the golden vectors. Section numbers refer to the Protocol reference.
"""

from dataclasses import dataclass
from typing import Annotated, ClassVar

from xethru_protocol import wire, wire_lists
from xethru_protocol.codes import AppCommandCode, AppObject, CommandCode
from xethru_protocol.responses import Ack, ReplyByte, ReplyFloat, ReplyInt, ReplyString
from xethru_protocol.responses_profile import ParameterFile
from xethru_protocol.table import Command, command, id32

_APP = CommandCode.XTS_SPC_APPCOMMAND


def _set(target: AppObject) -> tuple[int, ...]:
    return _APP, AppCommandCode.XTS_SPCA_SET, *id32(target)


def _get(target: AppObject) -> tuple[int, ...]:
    return _APP, AppCommandCode.XTS_SPCA_GET, *id32(target)


@command(*_set(AppObject.DETECTION_ZONE), name="APP_SET DETECTION_ZONE")
@dataclass(frozen=True, slots=True, kw_only=True)
class SetDetectionZone(Command[Ack]):
    """Choose the zone [m] in which a profile detects; the module snaps it outward. 4.4."""

    start_m: Annotated[float, wire.Number("f", "start")]
    end_m: Annotated[float, wire.Number("f", "end")]


@command(*_get(AppObject.DETECTION_ZONE), name="APP_GET DETECTION_ZONE")
@dataclass(frozen=True, slots=True, kw_only=True)
class GetDetectionZone(Command[ReplyFloat]):
    """Ask for the actual zone: start and end [m]. 4.4."""


@command(*_get(AppObject.DETECTION_ZONE_LIMITS), name="APP_GET DETECTION_ZONE_LIMITS")
@dataclass(frozen=True, slots=True, kw_only=True)
class GetDetectionZoneLimits(Command[ReplyFloat]):
    """Ask for the smallest start, the largest end and the step of zones [m]. 4.4."""


@command(*_set(AppObject.SENSITIVITY), name="APP_SET SENSITIVITY")
@dataclass(frozen=True, slots=True, kw_only=True)
class SetSensitivity(Command[Ack]):
    """Choose the profile's sensitivity, 0 ... 9. 4.4."""

    sensitivity: Annotated[int, wire.U32]


@command(*_get(AppObject.SENSITIVITY), name="APP_GET SENSITIVITY")
@dataclass(frozen=True, slots=True, kw_only=True)
class GetSensitivity(Command[ReplyInt]):
    """Ask for the profile's sensitivity. 4.4."""


@command(*_set(AppObject.TX_CENTER_FREQ), name="APP_SET TX_CENTER_FREQ")
@dataclass(frozen=True, slots=True, kw_only=True)
class SetTxCenterFrequency(Command[Ack]):
    """Choose the profile's band, a `TxCenterFrequency`. 4.4, 9.2."""

    tx_center_frequency: Annotated[int, wire.Number("I", "band")]


@command(*_get(AppObject.TX_CENTER_FREQ), name="APP_GET TX_CENTER_FREQ")
@dataclass(frozen=True, slots=True, kw_only=True)
class GetTxCenterFrequency(Command[ReplyInt]):
    """Ask for the profile's band. 4.4."""


@command(*_set(AppObject.LED_CONTROL), name="APP_SET LED_CONTROL")
@dataclass(frozen=True, slots=True, kw_only=True)
class AppSetLedControl(Command[Ack]):
    """Choose what the LED shows; as `SetLedControl`, but kept with the profile. 4.4."""

    mode: Annotated[int, wire.U8]
    intensity: Annotated[int, wire.U8] = 0


@command(*_get(AppObject.LED_CONTROL), name="APP_GET LED_CONTROL")
@dataclass(frozen=True, slots=True, kw_only=True)
class AppGetLedControl(Command[ReplyByte]):
    """Ask for the `LedMode`. 4.4."""


@command(*_set(AppObject.PROFILE_PARAMETERFILE), name="APP_SET PROFILE_PARAMETERFILE")
@dataclass(frozen=True, slots=True, kw_only=True)
class SetParameterFile(Command[Ack]):
    """Give a profile its parameter file; the terminating NULs are added here. 4.4."""

    name_length: ClassVar[Annotated[int, wire_lists.Count(("name",), size=wire_lists.text_size)]]
    data_length: ClassVar[Annotated[int, wire_lists.Count(("data",), size=wire_lists.text_size)]]
    name: Annotated[str | bytes, wire_lists.Text("name_length", "filename")]
    data: Annotated[str | bytes, wire_lists.Text("data_length")]


@command(*_get(AppObject.PROFILE_PARAMETERFILE), name="APP_GET PROFILE_PARAMETERFILE")
@dataclass(frozen=True, slots=True, kw_only=True)
class GetParameterFile(Command[ReplyString | ParameterFile | ReplyByte]):
    """Ask for a profile's parameter file; modules answer in one of three ways. 4.4, 16."""

    name_length: ClassVar[Annotated[int, wire_lists.Count(("name",), size=wire_lists.text_size)]]
    name: Annotated[str | bytes, wire_lists.Text("name_length", "filename")]


@command(_APP, AppCommandCode.XTS_SPCA_FACTORY_PRESET, name="APP_FACTORY_PRESET")
@dataclass(frozen=True, slots=True, kw_only=True)
class FactoryPreset(Command[Ack]):
    """Set the profile back to its factory settings. 4.4."""


@command(_APP, AppCommandCode.XTS_SPCA_STORE_NOISEMAP, name="APP_STORE_NOISEMAP")
@dataclass(frozen=True, slots=True, kw_only=True)
class StoreNoiseMap(Command[Ack]):
    """Store the profile's noise map; an error if a store is under way. 4.4."""


@command(_APP, AppCommandCode.XTS_SPCA_LOAD_NOISEMAP, name="APP_LOAD_NOISEMAP")
@dataclass(frozen=True, slots=True, kw_only=True)
class LoadNoiseMap(Command[Ack]):
    """Load the stored noise map; without effect in released firmware. 4.4."""


@command(_APP, name="APP_DELETE_NOISEMAP")
@dataclass(frozen=True, slots=True, kw_only=True)
class DeleteNoiseMap(Command[Ack]):
    """Delete the stored noise map; ``sub_code`` 15h is the document's form of it. 4.4, 11."""

    sub_code: Annotated[
        int,
        wire.Spelling(
            (
                AppCommandCode.XTS_SPCA_DELETE_NOISEMAP,
                AppCommandCode.XTS_SPCA_GET_PARAMETER_FILE,
            ),
            usual=AppCommandCode.XTS_SPCA_DELETE_NOISEMAP,
        ),
    ] = AppCommandCode.XTS_SPCA_DELETE_NOISEMAP


@command(_APP, AppCommandCode.XTS_SPCA_POLL, name="APP_POLL")
@dataclass(frozen=True, slots=True, kw_only=True)
class AppPoll(Command[Ack]):
    """A command that is defined but never parsed: ERROR 1. 4.4."""

    data: Annotated[bytes, wire.RestBytes()] = b""
