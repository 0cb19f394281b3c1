"""What a module answers to each command: one handler per command, or per group of like ones.

A handler is ``(module, command) -> response``; None stands for an ACK. It raises `Refusal` for an
ERROR and `Silence` for no answer at all. Commands without a handler get ERROR 1, as the firmware
does. `emulator.module.modes` defines in which modes a command is taken.

Source: protocol reference 3, 4, 5, 11 and 16.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from emulator.chip.chip import Refusal, Silence
from emulator.module.modes import Group, State, check_permission, group_of
from emulator.module.module import CRASH_DUMP, NOISE_MAPS, PARAMETER_FILE, Module, Wait
from emulator.module.settings import ZONE_LIMITS_M
from xethru_protocol.wire import messages as m
from xethru_protocol.wire import versions, x4
from xethru_protocol.wire.codes import (
    I2C_REGISTER,
    AppObject,
    BootloaderKey,
    DirCode,
    ErrorCode,
    FramePostprocessing,
    IoPinCode,
    NoiseMapCode,
    OutputFeature,
    PongCode,
    SensorMode,
    TestCode,
    TraceLevel,
    X4Error,
    X4Setting,
)

HIGHEST_TRACE_LEVEL = 9
SLOWEST_BAUDRATE, FASTEST_BAUDRATE = 600, 10_000_000
"""The firmware acknowledges and ignores any other rate."""
TEST_REPLY_BYTES = 256
_TEST_CONTENT_ID = 0x5090
LONGEST_READ = 4096
"""Bytes that one READ_I2C may ask for; assumed, no source has the command."""
_FEATURES: frozenset[int] = frozenset(OutputFeature)
_BYTE_REPLIES = frozenset(
    {
        X4Setting.DOWNCONVERSION,
        X4Setting.DACSTEP,
        X4Setting.TXCENTERFREQUENCY,
        X4Setting.TXPOWER,
        X4Setting.PRFDIV,
    }
)
_LATE_GETS = _BYTE_REPLIES | {
    X4Setting.ITERATIONS,
    X4Setting.PULSESPERSTEP,
    X4Setting.DACMIN,
    X4Setting.DACMAX,
    X4Setting.FRAMEAREAOFFSET,
}
"""Assumed: the GETs that XEP before 3.3.0 lacks; the reference says several."""
_POSTPROCESSING_DEFAULTS: dict[int, m.PostprocessingValue] = {
    FramePostprocessing.NORMALISATION: 1,
    FramePostprocessing.PHASE_NOISE_CORRECTION: (0, 0.0),
    FramePostprocessing.DECIMATION_FACTOR: 1,
    FramePostprocessing.NUMBER_FORMAT: 0,
    FramePostprocessing.LEGACY_OUTPUT: 0,
}
"""Assumed: what leaves frames as chapter 6 describes them."""

Handler = Callable[[Module, Any], m.Response | None]
HANDLERS: dict[type[m.Message], Handler] = {}
HandlerT = TypeVar("HandlerT", bound=Handler)


def answers(*commands: type[m.Command[Any]]) -> Callable[[HandlerT], HandlerT]:
    """Enter a handler into the table."""

    def enter(handler: HandlerT) -> HandlerT:
        HANDLERS.update(dict.fromkeys(commands, handler))
        return handler

    return enter


def _signed(value: int) -> int:
    return value - (1 << 32) if value >> 31 else value


# --- modes, profiles, restarts (4.1 to 4.3, 4.5)


@answers(m.Ping)
def _ping(module: Module, command: m.Ping) -> m.Response:
    safe = module.state is State.SAFE and versions.SAFE_MODE_PONG.is_in(module.firmware)
    return m.Pong(value=PongCode.XTS_SPRP_SAFEMODE if safe else PongCode.XTS_SPRP_READY)


@answers(m.ModReset)
def _reset(module: Module, command: m.ModReset) -> None:
    module.request_restart()


@answers(m.StartBootloader)
def _start_bootloader(module: Module, command: m.StartBootloader) -> None:
    current = versions.BOOTLOADER_KEY.is_in(module.firmware)
    if command.key != (BootloaderKey.CURRENT if current else BootloaderKey.OLD):
        module.notices.append(m.DataString(text="Unknown start_bootloader key."))
        raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
    module.request_restart(into_bootloader=True)


@answers(m.SetMode)
def _set_mode(module: Module, command: m.SetMode) -> None:
    options, modes = module.options, module.modes
    if options.profile_switch == "restart" and modes.switches_profile(command.mode):
        modes.restart_with_profile()
        module.save()
        module.request_restart()
        raise Refusal(ErrorCode.XTS_SPRE_RESTARTING)
    before = module.state
    without_profile = not module.modes.profile_id
    module.set_mode(command.mode)
    stops_nothing = command.mode == SensorMode.XTID_SM_STOP and without_profile
    if stops_nothing and not versions.STOP_WITHOUT_PROFILE.is_in(module.firmware):
        raise Silence
    entered = module.state is not before
    if entered and module.state is State.MANUAL and options.manual_settings == "init":
        module.chip.init()
    module.trace(TraceLevel.INFO, f"Mode {SensorMode(command.mode).label}.")


@answers(m.GetMode)
def _get_mode(module: Module, command: m.GetMode) -> m.Response:
    return m.ReplyByte(values=bytes([module.modes.mode]))


@answers(m.LoadApp)
def _load_app(module: Module, command: m.LoadApp) -> None:
    module.load_profile(command.profile_id)
    module.trace(TraceLevel.INFO, f"Profile {command.profile_id:08X} loaded.")


@answers(m.GetProfileId)
def _get_profile_id(module: Module, command: m.GetProfileId) -> m.Response:
    return m.ReplyInt(values=(_signed(module.modes.profile_id),))


@answers(m.DebugLevel)
def _debug_level(module: Module, command: m.DebugLevel) -> None:
    if command.level > HIGHEST_TRACE_LEVEL:
        raise Refusal(module.options.bad_value_error)
    module.trace_level = command.level


# --- files (4.10 and 4.11)


@answers(m.SearchFileType)
def _search(module: Module, command: m.SearchFileType) -> m.Response:
    found = (identifier for kind, identifier in module.files.names() if kind == command.file_type)
    return m.ReplyInt(values=tuple(_signed(identifier) for identifier in found))


@answers(m.FindAllFiles)
def _find_all(module: Module, command: m.FindAllFiles) -> m.Response:
    keys = module.files.names()
    types = [kind for kind, _ in keys]
    identifiers = [identifier for _, identifier in keys]
    return m.ReplyInt(values=tuple(_signed(value) for value in types + identifiers))


@answers(m.CreateFile)
def _create(module: Module, command: m.CreateFile) -> None:
    module.files.create((command.file_type, command.identifier), command.length)
    module.save()


@answers(m.OpenFile)
def _open(module: Module, command: m.OpenFile) -> None:
    module.files.open((command.file_type, command.identifier))


@answers(m.SetFileData)
def _write(module: Module, command: m.SetFileData) -> None:
    module.files.write((command.file_type, command.identifier), command.offset, command.data)
    module.save()


@answers(m.CloseFile)
def _close(module: Module, command: m.CloseFile) -> None:
    module.files.close((command.file_type, command.identifier))


@answers(m.GetFileLength)
def _length(module: Module, command: m.GetFileLength) -> m.Response:
    return m.ReplyInt(values=(module.files.length((command.file_type, command.identifier)),))


@answers(m.GetFileData)
def _read(module: Module, command: m.GetFileData) -> m.Response:
    key = command.file_type, command.identifier
    return m.ReplyByte(values=module.files.read(key, command.offset, command.length))


@answers(m.DeleteFile)
def _delete(module: Module, command: m.DeleteFile) -> None:
    module.files.delete((command.file_type, command.identifier))
    module.wait = Wait(duration_ns=module.options.file_delete_ns, before_reply=True)
    module.save()


@answers(m.FormatFilesystem)
def _format(module: Module, command: m.FormatFilesystem) -> None:
    module.files.format(command.key)
    module.save()


@answers(m.GetCrashDumpLength)
def _crash_dump_length(module: Module, command: m.GetCrashDumpLength) -> m.Response:
    dump = module.files.get(CRASH_DUMP) or b""
    return m.ReplyInt(content_id=DirCode.XTS_SDC_GET_CRASH_DUMP_LENGTH, values=(len(dump),))


@answers(m.ClearCrashDump)
def _clear_crash_dump(module: Module, command: m.ClearCrashDump) -> None:
    if module.files.get(CRASH_DUMP) is None:
        return
    try:
        module.files.delete(CRASH_DUMP)
    except Refusal:  # it is open, or too many are
        raise Refusal(ErrorCode.XTS_SPRE_BUSY) from None
    module.save()


@answers(m.GetCrashDump)
def _crash_dump(module: Module, command: m.GetCrashDump) -> m.Response:
    dump = module.files.get(CRASH_DUMP)
    if dump is None:
        raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
    end = command.offset + command.length
    if end > len(dump):
        raise Refusal(ErrorCode.XTS_SPRE_USER)
    content_id = DirCode.XTS_SDC_GET_CRASH_DUMP
    return m.ReplyByte(content_id=content_id, values=dump[command.offset : end])


# --- IO pins (4.8)


@answers(m.IoPinSetControl)
def _set_control(module: Module, command: m.IoPinSetControl) -> None:
    module.pins.set_control(command.pin_id, command.pin_setup, command.pin_feature)


@answers(m.IoPinGetControl)
def _get_control(module: Module, command: m.IoPinGetControl) -> m.Response:
    control = module.pins.control(command.pin_id)
    values = (control.setup, control.feature)
    return m.ReplyInt(content_id=IoPinCode.XTS_SPCIOP_GETCONTROL, values=values)


@answers(m.IoPinSetValue)
def _set_value(module: Module, command: m.IoPinSetValue) -> None:
    module.pins.set_value(command.pin_id, command.pin_value)


@answers(m.IoPinGetValue)
def _get_value(module: Module, command: m.IoPinGetValue) -> m.Response:
    level = module.pins.value(command.pin_id)
    return m.ReplyInt(content_id=IoPinCode.XTS_SPCIOP_GETVALUE, values=(level,))


# --- profile settings, noise maps, outputs (4.4 to 4.7)


@answers(m.SetDetectionZone)
def _set_zone(module: Module, command: m.SetDetectionZone) -> None:
    module.profile.set_zone(command.start_m, command.end_m, module.options)


@answers(m.GetDetectionZone)
def _get_zone(module: Module, command: m.GetDetectionZone) -> m.Response:
    return m.ReplyFloat(content_id=AppObject.DETECTION_ZONE, values=module.profile.zone_m)


@answers(m.GetDetectionZoneLimits)
def _get_zone_limits(module: Module, command: m.GetDetectionZoneLimits) -> m.Response:
    values = (*ZONE_LIMITS_M, x4.BASEBAND_BIN_M)
    return m.ReplyFloat(content_id=AppObject.DETECTION_ZONE_LIMITS, values=values)


@answers(m.SetSensitivity)
def _set_sensitivity(module: Module, command: m.SetSensitivity) -> None:
    module.profile.set_sensitivity(command.sensitivity, module.options)


@answers(m.GetSensitivity)
def _get_sensitivity(module: Module, command: m.GetSensitivity) -> m.Response:
    return m.ReplyInt(content_id=AppObject.SENSITIVITY, values=(module.profile.sensitivity,))


@answers(m.SetTxCenterFrequency)
def _set_band(module: Module, command: m.SetTxCenterFrequency) -> None:
    module.profile.set_band(command.tx_center_frequency, module.options)


@answers(m.GetTxCenterFrequency)
def _get_band(module: Module, command: m.GetTxCenterFrequency) -> m.Response:
    band = module.profile.tx_center_frequency
    return m.ReplyInt(content_id=AppObject.TX_CENTER_FREQ, values=(band,))


@answers(m.AppSetLedControl, m.SetLedControl)
def _set_led(module: Module, command: m.AppSetLedControl | m.SetLedControl) -> None:
    module.profile.set_led(command.mode, module.options)


@answers(m.AppGetLedControl)
def _get_led(module: Module, command: m.AppGetLedControl) -> m.Response:
    return m.ReplyByte(content_id=AppObject.LED_CONTROL, values=bytes([module.profile.led]))


@answers(m.FactoryPreset)
def _factory_preset(module: Module, command: m.FactoryPreset) -> None:
    module.restore_factory_settings()


@answers(m.SetParameterFile)
def _set_parameter_file(module: Module, command: m.SetParameterFile) -> None:
    module.files.replace(PARAMETER_FILE, _as_bytes(command.data))
    module.parameter_file_name = _as_text(command.name)
    module.save()


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
def _set_noise_map_control(module: Module, command: m.NoiseMapSetControl) -> None:
    module.profile.set_noise_map_control(command.control)


@answers(m.NoiseMapGetControl)
def _get_noise_map_control(module: Module, command: m.NoiseMapGetControl) -> m.Response:
    values = (module.profile.noise_map_control,)
    return m.ReplyInt(content_id=NoiseMapCode.XTS_SPCN_GETCONTROL, values=values)


@answers(m.NoiseMapSetPeriodicStore)
def _set_periodic_store(module: Module, command: m.NoiseMapSetPeriodicStore) -> None:
    module.profile.noise_map_interval_min = command.interval_min & 0x7FFFFFFF


@answers(m.NoiseMapGetPeriodicStore)
def _get_periodic_store(module: Module, command: m.NoiseMapGetPeriodicStore) -> m.Response:
    values = (module.profile.noise_map_interval_min, 0)
    return m.ReplyInt(content_id=NoiseMapCode.GET_PERIODIC_STORE, values=values)


@answers(m.StoreNoiseMap)
def _store_noise_map(module: Module, command: m.StoreNoiseMap) -> None:
    module.store_noise_maps()


@answers(m.LoadNoiseMap)
def _load_noise_map(module: Module, command: m.LoadNoiseMap) -> m.Response:
    return m.Ack()  # without effect in released firmware


@answers(m.DeleteNoiseMap)
def _delete_noise_map(module: Module, command: m.DeleteNoiseMap) -> None:
    for key in NOISE_MAPS:
        if module.files.get(key) is not None:
            module.files.delete(key)
    module.save()


@answers(m.OutputSetControl)
def _set_output(module: Module, command: m.OutputSetControl) -> None:
    module.profile.set_output(_known(command.feature), command.control)


@answers(m.OutputGetControl)
def _get_output(module: Module, command: m.OutputGetControl) -> m.Response:
    return _control_reply(module.profile.outputs, command.feature)


@answers(m.DebugOutputSetControl)
def _set_debug_output(module: Module, command: m.DebugOutputSetControl) -> None:
    module.profile.set_debug_output(_known(command.feature), command.control)


@answers(m.DebugOutputGetControl)
def _get_debug_output(module: Module, command: m.DebugOutputGetControl) -> m.Response:
    return _control_reply(module.profile.debug_outputs, command.feature)


def _control_reply(outputs: Mapping[int, int], feature: int) -> m.Response:
    return m.ReplyInt(values=(_signed(outputs.get(_known(feature), 0)),))


def _known(feature: int) -> int:
    if feature not in _FEATURES:
        raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
    return feature


def _as_text(value: str | bytes) -> str:
    return value if isinstance(value, str) else value.decode("latin-1")


def _as_bytes(value: str | bytes) -> bytes:
    return value if isinstance(value, bytes) else value.encode("latin-1", errors="replace")


# --- identity, UART, tests (4.10)


@answers(m.SystemGetInfo)
def _system_get_info(module: Module, command: m.SystemGetInfo) -> m.Response:
    text = module.identity.info(command.item, base_firmware=module.base_firmware)
    if text is None:
        raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
    return m.ReplyString(content_id=DirCode.XTS_SDC_SYSTEM_GET_INFO, info=command.item, text=text)


@answers(m.SetBaudRate)
def _set_baud_rate(module: Module, command: m.SetBaudRate) -> None:
    ignored = not SLOWEST_BAUDRATE <= command.baudrate <= FASTEST_BAUDRATE
    module.change_baudrate(module.uart_baudrate if ignored else command.baudrate)


@answers(m.PrepareInjectFrame, m.InjectFrame)
def _inject(module: Module, command: m.Message) -> m.Response:
    return m.Ack()  # accepted; this emulator's frames come from its scene


@answers(m.SystemTest)
def _system_test(module: Module, command: m.SystemTest) -> m.Response:
    passed, data = True, b""
    match command.code:
        case TestCode.TX_ONLY | TestCode.TX_ONLY_TX_OFF:
            module.sleep()
            return m.Ack()
        case TestCode.STREAM_TX_OFF:
            module.chip.set(X4Setting.TXPOWER, 0)
            return m.Ack()
        case TestCode.EXTERNAL_RAM:
            pass
        case TestCode.READ_IO_PINS:
            data = module.pins.levels().to_bytes(4, "little")
        case TestCode.X4_CONNECTION:
            passed = module.chip.powered
            data = b"" if passed else bytes([X4Error.REGISTER_TIMEOUT])
        case TestCode.CERTIFICATION_ON | TestCode.CERTIFICATION_OFF:
            module.certification = command.code == TestCode.CERTIFICATION_ON
            module.save()
            passed = False  # although it worked, as the firmware answers
        case TestCode.HARDWARE_CONFIG:
            data = module.identity.serial.encode("ascii")
        case _:
            raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
    return m.ReplyByte(
        content_id=_TEST_CONTENT_ID,
        info=command.code | passed << 8,
        values=(bytes([passed]) + data).ljust(TEST_REPLY_BYTES, b"\x00"),
    )


# --- X4 driver (4.9)


@answers(m.X4DriverInit)
def _x4_init(module: Module, command: m.X4DriverInit) -> None:
    module.chip.init()
    if module.options.x4_init_ns:
        module.wait = Wait(duration_ns=module.options.x4_init_ns, before_reply=True)


@answers(m.X4DriverSet)
def _x4_set(module: Module, command: m.X4DriverSet) -> None:
    module.chip.set(command.setting, command.value)


@answers(m.X4DriverGet)
def _x4_get(module: Module, command: m.X4DriverGet) -> m.Response:
    setting = command.setting
    if setting in _LATE_GETS and not versions.X4_GETS.is_in(module.firmware):
        raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
    if command.address is not None:
        byte = module.chip.read_register(setting, command.address)
        return m.ReplyByte(content_id=setting, values=bytes([byte]))
    value = module.chip.get(setting)
    if isinstance(value, tuple):
        return m.ReplyFloat(content_id=setting, values=(float(value[0]), float(value[1])))
    if isinstance(value, float):
        return m.ReplyFloat(content_id=setting, values=(value,))
    if setting in _BYTE_REPLIES:
        return m.ReplyByte(content_id=setting, values=bytes([value]))
    return m.ReplyInt(content_id=setting, values=(value,))


@answers(m.X4DriverWrite)
def _x4_write(module: Module, command: m.X4DriverWrite) -> None:
    _check_block_access(command.setting)
    module.chip.write_burst(command.address, command.values)


@answers(m.X4DriverRead)
def _x4_read(module: Module, command: m.X4DriverRead) -> m.Response:
    _check_block_access(command.setting)
    values = module.chip.read_burst(command.address, command.length)
    return m.ReplyByte(content_id=command.setting, values=values)


def _check_block_access(setting: X4Setting) -> None:
    if setting is not X4Setting.SPIREGISTER:
        raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)


@answers(m.X4DriverWriteI2c)
def _write_i2c(module: Module, command: m.X4DriverWriteI2c) -> None:
    module.i2c[command.address] = command.values
    module.i2c_address = command.address


@answers(m.X4DriverReadI2c)
def _read_i2c(module: Module, command: m.X4DriverReadI2c) -> m.Response:
    """Answer what was written last, as a device that keeps its registers; zeros beyond."""
    if command.length > LONGEST_READ:
        raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
    values = module.i2c.get(module.i2c_address, b"").ljust(command.length, b"\x00")
    return m.ReplyByte(content_id=I2C_REGISTER, values=values[: command.length])


@answers(m.FramePostprocessingSet)
def _set_postprocessing(module: Module, command: m.FramePostprocessingSet) -> None:
    module.postprocessing[command.setting] = command.value


@answers(m.FramePostprocessingGet)
def _get_postprocessing(module: Module, command: m.FramePostprocessingGet) -> m.Response:
    setting = command.setting
    value = module.postprocessing.get(setting, _POSTPROCESSING_DEFAULTS[setting])
    if isinstance(value, tuple):
        return m.ReplyFloat(content_id=setting, values=(value[1],))
    if setting is FramePostprocessing.DECIMATION_FACTOR:
        return m.ReplyInt(content_id=setting, values=(_signed(value),))
    return m.ReplyByte(content_id=setting, values=bytes([value]))


def answer(module: Module, command: m.Message) -> m.Response | None:
    """Carry out one command and return its reply, None if it gets none.

    Never raises on anything a host can send.
    """
    try:
        if any(not row.is_in(module.firmware) for row in versions.needed_by(command)):
            return m.Error(code=ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
        if (
            module.state is State.RUN
            and group_of(command) is Group.PROFILE_SET
            and not versions.SETTINGS_WHILE_RUNNING.is_in(module.firmware)
        ):
            return m.Ack()
        check_permission(command, module.state, module.options)
        handler = HANDLERS.get(type(command))
        if handler is None:
            return m.Error(code=ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
        reply = handler(module, command)
        return m.Ack() if reply is None else reply
    except Refusal as refusal:
        return m.Error(code=refusal.code)
    except Silence:
        return None
