"""What a module answers to each command, by a row of `HANDLERS`.

A handler is ``(module, command) -> response``; None stands for an ACK. It raises `Refusal` for an
ERROR and `Silence` for no answer at all. Commands without a handler get ERROR 1, as the firmware
does. `emulator.module.modes` defines in which modes a command is taken.

Source: protocol reference 3, 4, 5, 11 and 16.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

from emulator.chip.chip import Refusal, Silence
from emulator.module.memory import FileKey, part_limits, stored_part
from emulator.module.modes import Group, ModuleState, check_permission, group_of
from emulator.module.settings import BAD_VALUE, ZONE_LIMITS_M
from emulator.module.state import CRASH_DUMP, NOISE_MAPS, PARAMETER_FILE, Module, Wait
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
FILE_DELETE_NS = 100_000_000
"""How long DELETE_FILE takes to answer (4.11)."""
TEST_REPLY_BYTES = 256
_TEST_CONTENT_ID = 0x5090
LONGEST_READ = 4096
"""Bytes that one READ_I2C may ask for; assumed, no source has the command."""
_WORD = 0xFFFFFFFF
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
HandlerT = TypeVar("HandlerT", bound=Handler)


def _reply_int(*values: int, content_id: int = 0) -> m.Response:
    """Return a REPLY INT of 32-bit values, which it carries as signed ones."""
    return m.ReplyInt(content_id=content_id, values=tuple(map(_signed, values)))


def _signed(value: int) -> int:
    value &= _WORD
    return value - (1 << 32) if value >> 31 else value


def _key(command: Any) -> FileKey:  # noqa: ANN401 - of any command with a file
    return command.file_type, command.identifier


def _ints(value: Callable[[Module], Sequence[int]], content_id: int = 0) -> Handler:
    return lambda module, _: _reply_int(*value(module), content_id=content_id)


def _known(feature: int) -> int:
    if feature not in _FEATURES:
        raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
    return feature


def _control_reply(outputs: Mapping[int, int], feature: int) -> m.Response:
    return _reply_int(outputs.get(_known(feature), 0))


def _accepted(module: Module, command: m.Message) -> None:
    """Do nothing."""


HANDLERS: dict[type[m.Message], Handler] = {
    # restarts, modes (4.1, 4.2)
    m.ModReset: lambda module, _: module.request_restart(),
    m.GetMode: lambda module, _: m.ReplyByte(values=bytes([module.modes.mode])),
    m.GetProfileId: _ints(lambda module: [module.modes.profile_id]),
    # files (4.11)
    m.OpenFile: lambda module, c: module.files.open(_key(c)),
    m.CloseFile: lambda module, c: module.files.close(_key(c)),
    m.GetFileLength: lambda module, c: _reply_int(module.files.length(_key(c))),
    m.GetFileData: lambda module, c: m.ReplyByte(
        values=module.files.read(_key(c), c.offset, c.length)
    ),
    m.SearchFileType: lambda module, c: _reply_int(
        *(name for kind, name in module.files.names() if kind == c.file_type)
    ),
    m.GetCrashDumpLength: _ints(
        lambda module: [len(module.files.get(CRASH_DUMP) or b"")],
        DirCode.XTS_SDC_GET_CRASH_DUMP_LENGTH,
    ),
    # IO pins (4.8)
    m.IoPinSetControl: lambda module, c: module.pins.set_control(
        c.pin_id, c.pin_setup, c.pin_feature
    ),
    m.IoPinGetControl: lambda module, c: _reply_int(
        module.pins.control(c.pin_id).setup,
        module.pins.control(c.pin_id).feature,
        content_id=IoPinCode.XTS_SPCIOP_GETCONTROL,
    ),
    m.IoPinSetValue: lambda module, c: module.pins.set_value(c.pin_id, c.pin_value),
    m.IoPinGetValue: lambda module, c: _reply_int(
        module.pins.value(c.pin_id), content_id=IoPinCode.XTS_SPCIOP_GETVALUE
    ),
    # profile settings (4.4, 4.5)
    m.SetDetectionZone: lambda module, c: module.profile.set_zone(
        c.start_m, c.end_m, module.options
    ),
    m.GetDetectionZone: lambda module, _: m.ReplyFloat(
        content_id=AppObject.DETECTION_ZONE, values=module.profile.zone_m
    ),
    m.GetDetectionZoneLimits: lambda module, _: m.ReplyFloat(
        content_id=AppObject.DETECTION_ZONE_LIMITS, values=(*ZONE_LIMITS_M, x4.BASEBAND_BIN_M)
    ),
    m.SetSensitivity: lambda module, c: module.profile.set_sensitivity(
        c.sensitivity, module.options
    ),
    m.GetSensitivity: _ints(lambda module: [module.profile.sensitivity], AppObject.SENSITIVITY),
    m.SetTxCenterFrequency: lambda module, c: module.profile.set_band(
        c.tx_center_frequency, module.options
    ),
    m.GetTxCenterFrequency: _ints(
        lambda module: [module.profile.tx_center_frequency], AppObject.TX_CENTER_FREQ
    ),
    m.AppSetLedControl: lambda module, c: module.profile.set_led(c.mode, module.options),
    m.SetLedControl: lambda module, c: module.profile.set_led(c.mode, module.options),
    m.AppGetLedControl: lambda module, _: m.ReplyByte(
        content_id=AppObject.LED_CONTROL, values=bytes([module.profile.led])
    ),
    m.FactoryPreset: lambda module, _: module.restore_factory_settings(),
    # noise maps (4.6)
    m.NoiseMapSetControl: lambda module, c: module.profile.set_noise_map_control(c.control),
    m.NoiseMapGetControl: _ints(
        lambda module: [module.profile.noise_map_control], NoiseMapCode.XTS_SPCN_GETCONTROL
    ),
    m.NoiseMapGetPeriodicStore: _ints(
        lambda module: [module.profile.noise_map_interval_min, 0], NoiseMapCode.GET_PERIODIC_STORE
    ),
    m.StoreNoiseMap: lambda module, _: module.store_noise_maps(),
    m.LoadNoiseMap: _accepted,  # without effect in released firmware
    # outputs (4.7)
    m.OutputSetControl: lambda module, c: module.profile.set_output(_known(c.feature), c.control),
    m.OutputGetControl: lambda module, c: _control_reply(module.profile.outputs, c.feature),
    m.DebugOutputSetControl: lambda module, c: module.profile.set_debug_output(
        _known(c.feature), c.control
    ),
    m.DebugOutputGetControl: lambda module, c: _control_reply(
        module.profile.debug_outputs, c.feature
    ),
    # X4 driver (4.9); this emulator's frames come from its scene
    m.X4DriverInit: lambda module, _: module.chip.init(),
    m.X4DriverSet: lambda module, c: module.chip.set(c.setting, c.value),
    m.PrepareInjectFrame: _accepted,
    m.InjectFrame: _accepted,
}
"""Answers that are one expression; the functions below enter the others."""


def answers(command: type[m.Command[Any]]) -> Callable[[HandlerT], HandlerT]:
    """Enter a handler into the table."""

    def enter(handler: HandlerT) -> HandlerT:
        HANDLERS[command] = handler
        return handler

    return enter


# --- modes, profiles, restarts (4.1 to 4.3, 4.5)


@answers(m.Ping)
def _ping(module: Module, command: m.Ping) -> m.Response:
    safe = module.state is ModuleState.SAFE and versions.SAFE_MODE_PONG.is_in(module.firmware)
    return m.Pong(value=PongCode.XTS_SPRP_SAFEMODE if safe else PongCode.XTS_SPRP_READY)


@answers(m.StartBootloader)
def _start_bootloader(module: Module, command: m.StartBootloader) -> None:
    current = versions.BOOTLOADER_KEY.is_in(module.firmware)
    if command.key != (BootloaderKey.CURRENT if current else BootloaderKey.OLD):
        module.notices.append(m.DataString(text="Unknown start_bootloader key."))
        raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
    module.request_restart(into_bootloader=True)


@answers(m.SetMode)
def _set_mode(module: Module, command: m.SetMode) -> None:
    without_profile = not module.modes.profile_id
    module.set_mode(command.mode)
    stops_nothing = command.mode == SensorMode.XTID_SM_STOP and without_profile
    if stops_nothing and not versions.STOP_WITHOUT_PROFILE.is_in(module.firmware):
        raise Silence
    module.trace(TraceLevel.INFO, f"Mode {SensorMode(command.mode).label}.")


@answers(m.LoadApp)
def _load_app(module: Module, command: m.LoadApp) -> None:
    module.load_profile(command.profile_id)
    module.trace(TraceLevel.INFO, f"Profile {command.profile_id:08X} loaded.")


@answers(m.DebugLevel)
def _debug_level(module: Module, command: m.DebugLevel) -> None:
    if command.level > HIGHEST_TRACE_LEVEL:
        raise Refusal(BAD_VALUE)
    module.trace_level = command.level


# --- files (4.10 and 4.11)


@answers(m.CreateFile)
def _create(module: Module, command: m.CreateFile) -> None:
    module.files.create(_key(command), command.length)
    module.save()


@answers(m.SetFileData)
def _write(module: Module, command: m.SetFileData) -> None:
    module.files.write(_key(command), command.offset, command.data)
    module.save()


@answers(m.FormatFilesystem)
def _format(module: Module, command: m.FormatFilesystem) -> None:
    module.files.format(command.key)
    module.save()


@answers(m.FindAllFiles)
def _find_all(module: Module, command: m.FindAllFiles) -> m.Response:
    keys = module.files.names()
    types = [kind for kind, _ in keys]
    identifiers = [identifier for _, identifier in keys]
    return _reply_int(*types, *identifiers)


@answers(m.DeleteFile)
def _delete(module: Module, command: m.DeleteFile) -> None:
    module.files.delete(_key(command))
    module.wait = Wait(duration_ns=FILE_DELETE_NS, before_reply=True)
    module.save()


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
    """Answer a part of the dump; the firmware goes on behind each error.

    What lies outside the dump, or where there is none, is assumed to be erased.
    """
    dump = module.files.get(CRASH_DUMP)
    errors = [ErrorCode.XTS_SPRE_NOT_RECOGNIZED] * 2 if dump is None else []
    dump = dump or b""
    begin, end = part_limits(command.offset, command.length)
    if end > len(dump):
        errors.append(ErrorCode.XTS_SPRE_USER)
    module.notices += [m.Error(code=code) for code in errors]
    part = stored_part(dump, begin, command.length)
    return m.ReplyByte(content_id=DirCode.XTS_SDC_GET_CRASH_DUMP, values=part)


# --- profile settings, noise maps, outputs (4.4 to 4.7)


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
    return m.ReplyString(content_id=AppObject.PROFILE_PARAMETERFILE, text=data.decode("latin-1"))


@answers(m.NoiseMapSetPeriodicStore)
def _set_periodic_store(module: Module, command: m.NoiseMapSetPeriodicStore) -> None:
    module.profile.noise_map_interval_min = command.interval_min & 0x7FFFFFFF


@answers(m.DeleteNoiseMap)
def _delete_noise_map(module: Module, command: m.DeleteNoiseMap) -> None:
    for key in NOISE_MAPS:
        if module.files.get(key) is not None:
            module.files.delete(key)
    module.save()


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
    return _reply_int(value, content_id=setting)


@answers(m.X4DriverWrite)
def _x4_write(module: Module, command: m.X4DriverWrite) -> None:
    _check_block_access(command.setting)
    module.chip.write_burst(command.address, command.values)


@answers(m.X4DriverRead)
def _x4_read(module: Module, command: m.X4DriverRead) -> m.Response:
    _check_block_access(command.setting)
    if command.length == 0:  # the firmware takes the empty block that it gets for lack of memory
        module.crash("out of memory", module.now_ns)
        raise Silence
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
        return _reply_int(value, content_id=setting)
    return m.ReplyByte(content_id=setting, values=bytes([value]))


def answer(module: Module, command: m.Message) -> m.Response | None:
    """Carry out one command and return its reply, None if it gets none.

    Never raises on anything a host can send.
    """
    try:
        if any(not row.is_in(module.firmware) for row in versions.needed_by(command)):
            return m.Error(code=ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
        if (
            module.state is ModuleState.RUN
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
