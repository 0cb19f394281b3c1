"""Handlers of profile settings, noise maps, output control and the parameter file.

Source: protocol reference 4.4 to 4.7, 11 and 16.
"""

from __future__ import annotations

from emulator.handler_table import answers
from emulator.module import NOISE_MAPS, Module
from emulator.profile_settings import ZONE_LIMITS_M
from emulator.refusal import Refusal
from xethru_protocol import messages as m
from xethru_protocol import x4
from xethru_protocol.codes import (
    AppObject,
    ErrorCode,
    FileType,
    NoiseMapCode,
    OutputFeature,
)

PARAMETER_FILE = (int(FileType.PARAMETER_FILE), 0)


@answers(m.SetDetectionZone)
def _set_zone(module: Module, command: m.SetDetectionZone) -> m.Response:
    module.profile.set_zone(command.start_m, command.end_m, module.options)
    return m.Ack()


@answers(m.GetDetectionZone)
def _get_zone(module: Module, command: m.GetDetectionZone) -> m.Response:
    return m.ReplyFloat(content_id=AppObject.DETECTION_ZONE, values=module.profile.zone_m)


@answers(m.GetDetectionZoneLimits)
def _get_zone_limits(module: Module, command: m.GetDetectionZoneLimits) -> m.Response:
    values = (*ZONE_LIMITS_M, x4.BASEBAND_BIN_M)
    return m.ReplyFloat(content_id=AppObject.DETECTION_ZONE_LIMITS, values=values)


@answers(m.SetSensitivity)
def _set_sensitivity(module: Module, command: m.SetSensitivity) -> m.Response:
    module.profile.set_sensitivity(command.sensitivity, module.options)
    return m.Ack()


@answers(m.GetSensitivity)
def _get_sensitivity(module: Module, command: m.GetSensitivity) -> m.Response:
    return m.ReplyInt(content_id=AppObject.SENSITIVITY, values=(module.profile.sensitivity,))


@answers(m.SetTxCenterFrequency)
def _set_band(module: Module, command: m.SetTxCenterFrequency) -> m.Response:
    module.profile.set_band(command.tx_center_frequency, module.options)
    return m.Ack()


@answers(m.GetTxCenterFrequency)
def _get_band(module: Module, command: m.GetTxCenterFrequency) -> m.Response:
    band = module.profile.tx_center_frequency
    return m.ReplyInt(content_id=AppObject.TX_CENTER_FREQ, values=(band,))


@answers(m.AppSetLedControl, m.SetLedControl)
def _set_led(module: Module, command: m.AppSetLedControl | m.SetLedControl) -> m.Response:
    module.profile.set_led(command.mode, module.options)
    return m.Ack()


@answers(m.AppGetLedControl)
def _get_led(module: Module, command: m.AppGetLedControl) -> m.Response:
    return m.ReplyByte(content_id=AppObject.LED_CONTROL, values=bytes([module.profile.led]))


@answers(m.FactoryPreset)
def _factory_preset(module: Module, command: m.FactoryPreset) -> m.Response:
    module.restore_factory_settings()
    return m.Ack()


@answers(m.SetParameterFile)
def _set_parameter_file(module: Module, command: m.SetParameterFile) -> m.Response:
    module.files.replace(PARAMETER_FILE, _as_bytes(command.data))
    module.parameter_file_name = _as_text(command.name)
    module.save()
    return m.Ack()


@answers(m.GetParameterFile)
def _get_parameter_file(module: Module, command: m.GetParameterFile) -> m.Response:
    data, name = module.files.get(PARAMETER_FILE), _as_text(command.name)
    if data is None or name != module.parameter_file_name:
        raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
    text, content_id = data.decode("latin-1"), AppObject.PROFILE_PARAMETERFILE
    replies: dict[str, m.Response] = {
        "string": m.ReplyString(content_id=content_id, text=text),
        "appdata": m.ParameterFile(name=name, data=text),
        "byte": m.ReplyByte(content_id=content_id, values=data),
    }
    return replies[module.options.parameter_file_reply]


@answers(m.NoiseMapSetControl)
def _set_noise_map_control(module: Module, command: m.NoiseMapSetControl) -> m.Response:
    module.profile.set_noise_map_control(command.control)
    return m.Ack()


@answers(m.NoiseMapGetControl)
def _get_noise_map_control(module: Module, command: m.NoiseMapGetControl) -> m.Response:
    values = (module.profile.noise_map_control,)
    return m.ReplyInt(content_id=NoiseMapCode.XTS_SPCN_GETCONTROL, values=values)


@answers(m.NoiseMapSetPeriodicStore)
def _set_periodic_store(module: Module, command: m.NoiseMapSetPeriodicStore) -> m.Response:
    module.profile.noise_map_interval_min = command.interval_min & 0x7FFFFFFF
    return m.Ack()


@answers(m.NoiseMapGetPeriodicStore)
def _get_periodic_store(module: Module, command: m.NoiseMapGetPeriodicStore) -> m.Response:
    values = (module.profile.noise_map_interval_min, 0)
    return m.ReplyInt(content_id=NoiseMapCode.GET_PERIODIC_STORE, values=values)


@answers(m.StoreNoiseMap)
def _store_noise_map(module: Module, command: m.StoreNoiseMap) -> m.Response:
    module.store_noise_maps()
    return m.Ack()


@answers(m.LoadNoiseMap)
def _load_noise_map(module: Module, command: m.LoadNoiseMap) -> m.Response:
    return m.Ack()  # without effect in released firmware


@answers(m.DeleteNoiseMap)
def _delete_noise_map(module: Module, command: m.DeleteNoiseMap) -> m.Response:
    for key in NOISE_MAPS:
        if module.files.get(key) is not None:
            module.files.delete(key)
    module.save()
    return m.Ack()


_FEATURES: frozenset[int] = frozenset(OutputFeature)


@answers(m.OutputSetControl)
def _set_output(module: Module, command: m.OutputSetControl) -> m.Response:
    module.profile.set_output(_known(command.feature), command.control)
    return m.Ack()


@answers(m.OutputGetControl)
def _get_output(module: Module, command: m.OutputGetControl) -> m.Response:
    return _control_reply(module.profile.outputs.get(_known(command.feature), 0))


@answers(m.DebugOutputSetControl)
def _set_debug_output(module: Module, command: m.DebugOutputSetControl) -> m.Response:
    module.profile.set_debug_output(_known(command.feature), command.control)
    return m.Ack()


@answers(m.DebugOutputGetControl)
def _get_debug_output(module: Module, command: m.DebugOutputGetControl) -> m.Response:
    return _control_reply(module.profile.debug_outputs.get(_known(command.feature), 0))


def _known(feature: int) -> int:
    if feature not in _FEATURES:
        raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
    return feature


def _control_reply(bits: int) -> m.Response:
    return m.ReplyInt(values=(bits - (1 << 32) if bits >> 31 else bits,))


def _as_text(value: str | bytes) -> str:
    return value if isinstance(value, str) else value.decode("latin-1")


def _as_bytes(value: str | bytes) -> bytes:
    return value if isinstance(value, bytes) else value.encode("latin-1", errors="replace")
