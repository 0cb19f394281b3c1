"""ModuleConnector and its interfaces: the vendor's methods, each as what our driver does.

A method of an interface is one row of a table: what it asks of an `X4M300`, and what it returns.
Where the driver's own method does more than the vendor's (`radar.x4.fps = 17` also reads back where
the bins lie), the row sends the plain command, so that a script's commands reach the module as they
always did. ``peek_message_...`` and ``read_message_...`` follow from `STREAMS`. What the vendor has
and we have not is a row of `data.MISSING`.
"""

import inspect
import weakref
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from importlib.metadata import version
from typing import Any, Final

from xethru_protocol.driver.chip import REGISTER_SPACES, RegisterSpace
from xethru_protocol.driver.files import read_chunks, write_chunks
from xethru_protocol.driver.firmware import ask_for_bootloader
from xethru_protocol.driver.link import CONFIG_SETTINGS, SLOW_TIMEOUT_S
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.legacy.connection import (
    MessageQueues,
    ModuleConnectorError,
    ModuleSource,
    close_left,
)
from xethru_protocol.legacy.data import CLASSES, Data, Pointer, Vector, not_implemented
from xethru_protocol.legacy.recordings import DataPlayer, DataRecorder, PlayerSource
from xethru_protocol.transport import find_ports
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import (
    FramePostprocessing,
    IoPinSetup,
    SensorMode,
    X4Setting,
)
from xethru_protocol.wire.errors import XeThruError
from xethru_protocol.wire.table import Command, Response
from xethru_protocol.wire.x4 import LIMITS

Rows = Mapping[str, Callable[..., Any]]

_ID = 0xFFFFFFFF  # scripts give ids with and without a sign
_WITH_PARAMETER = (SensorMode.XTID_SM_NORMAL, SensorMode.XTID_SM_REG)


# --- what the rows are made of ------------------------------------------------------------------


def _slow(radar: X4M300, command: Command[Any]) -> None:
    radar.request(command, SLOW_TIMEOUT_S)


def _values(radar: X4M300, command: Command[Any], count: int) -> Any:
    """Return the first values of an answer, at least so many of which there must be."""
    values = radar.request(command).values
    if len(values) < count:
        raise ModuleConnectorError(
            f"{radar.port} answers {type(command).__name__} with {len(values)} values, not {count}"
        )
    return values[:count]


def _value(radar: X4M300, command: Command[Any]) -> Any:
    return _values(radar, command, 1)[0]


def _x4_set(setting: X4Setting, kind: Callable[[Any], Any] = int) -> Callable[..., None]:
    def set_(radar: X4M300, value: Any) -> None:
        radar.request(m.X4DriverSet(setting=setting, value=kind(value)))

    return set_


def _x4_get(setting: X4Setting) -> Callable[[X4M300], Any]:
    return lambda radar: _value(radar, m.X4DriverGet(setting=setting))


def _frame_area(radar: X4M300) -> Data:
    start, end = _values(radar, m.X4DriverGet(setting=X4Setting.FRAMEAREA), 2)
    return CLASSES["FrameArea"](start=start, end=end)


def _set_register(space: RegisterSpace) -> Callable[..., None]:
    return lambda radar, address, value: radar.registers.write(space, address, value)


def _get_register(space: RegisterSpace) -> Callable[..., int]:
    return lambda radar, address: radar.registers.read(space, address)


def _set_processing(setting: FramePostprocessing) -> Callable[..., None]:
    def set_(radar: X4M300, value: int) -> None:
        radar.request(m.FramePostprocessingSet(setting=setting, value=value))

    return set_


def _get_processing(setting: FramePostprocessing) -> Callable[[X4M300], Any]:
    return lambda radar: _value(radar, m.FramePostprocessingGet(setting=setting))


def _set_sensor_mode(radar: X4M300, mode: int, param: int = 0) -> None:
    parameter = param if mode in _WITH_PARAMETER else None
    _slow(radar, m.SetMode(mode=mode, param=parameter))


def _zone(radar: X4M300) -> Data:
    start, end = _values(radar, m.GetDetectionZone(), 2)
    return CLASSES["DetectionZone"](start=start, end=end)


def _zone_limits(radar: X4M300) -> Data:
    start, end, step = _values(radar, m.GetDetectionZoneLimits(), 3)
    return CLASSES["DetectionZoneLimits"](start=start, end=end, step=step)


def _periodic_store(radar: X4M300) -> Data:
    interval = _value(radar, m.NoiseMapGetPeriodicStore())
    return CLASSES["PeriodicNoisemapStore"](interval_minutes=interval)


def _pin_control(radar: X4M300, pin_id: int) -> Data:
    control = radar.pins.control(pin_id)
    return CLASSES["IoPinControl"](setup=int(control.setup), feature=control.feature)


def _run_test(radar: X4M300, testcode: int, data: list[int]) -> int:
    result = radar.diagnostics.run_test(testcode)
    data[:] = result.data
    return int(not result.passed)


def _all_files(radar: X4M300) -> Data:
    found = radar.files.find_all()
    return CLASSES["Files"](
        file_type_items=Vector(name.file_type for name in found),
        file_identifier_items=Vector(name.identifier for name in found),
    )


def _get_file_data(radar: X4M300, type: int, identifier: int, offset: int, length: int) -> Vector:
    part = m.GetFileData(file_type=type & _ID, identifier=identifier, offset=offset, length=length)
    return Vector(radar._call_once(read_chunks, part, length))


def _set_file_data(radar: X4M300, type: int, identifier: int, offset: int, data: Any) -> None:
    part = m.SetFileData(
        file_type=type & _ID, identifier=identifier, offset=offset, data=_bytes(data)
    )
    radar._call_once(write_chunks, part)


def _bytes(data: Any) -> bytes:
    return data.encode() if isinstance(data, str) else bytes(data)


# --- the rows -----------------------------------------------------------------------------------

_BOTH: Rows = {
    "ping": lambda radar: radar.request(m.Ping()).value,
    "get_system_info": lambda radar, info_code: radar.request(m.SystemGetInfo(item=info_code)).text,
    "module_reset": lambda radar: radar.reset(),
    "set_baudrate": lambda radar, baudrate: radar.set_baud_rate(baudrate),
    "set_iopin_control": lambda radar, pin_id, pin_setup, pin_feature: radar.pins.set_control(
        pin_id, IoPinSetup(pin_setup), pin_feature
    ),
    "set_iopin_value": lambda radar, pin_id, pin_value: (
        radar.request(m.IoPinSetValue(pin_id=pin_id, pin_value=pin_value)) and None
    ),
    "get_iopin_value": lambda radar, pin_id: int(radar.pins.read(pin_id)),
}

# the DAC's are not in every release of ModuleConnector, but in scripts of its makers
_WHOLE_NUMBERS = {name: one for name, one in CONFIG_SETTINGS.items() if one in LIMITS}

_XEP: Rows = {
    **_BOTH,
    **{f"x4driver_set_{name}": _x4_set(setting) for name, setting in _WHOLE_NUMBERS.items()},
    **{f"x4driver_get_{name}": _x4_get(setting) for name, setting in _WHOLE_NUMBERS.items()},
    "set_normalization": _set_processing(FramePostprocessing.NORMALISATION),
    "get_normalization": _get_processing(FramePostprocessing.NORMALISATION),
    "set_phase_noise_correction": lambda radar, enable, correction_distance: (
        radar.postprocessing.set_phase_noise_correction(bool(enable), correction_distance)
    ),
    "get_phase_noise_correction": lambda radar: (
        radar.postprocessing.phase_noise_correction_distance()
    ),
    "set_decimation_factor": _set_processing(FramePostprocessing.DECIMATION_FACTOR),
    "get_decimation_factor": _get_processing(FramePostprocessing.DECIMATION_FACTOR),
    "set_number_format": _set_processing(FramePostprocessing.NUMBER_FORMAT),
    "get_number_format": _get_processing(FramePostprocessing.NUMBER_FORMAT),
    "set_legacy_output": _set_processing(FramePostprocessing.LEGACY_OUTPUT),
    "get_legacy_output": _get_processing(FramePostprocessing.LEGACY_OUTPUT),
    "x4driver_init": lambda radar: _slow(radar, m.X4DriverInit()),
    "x4driver_set_enable": _x4_set(X4Setting.ENABLE),
    "x4driver_set_fps": _x4_set(X4Setting.FPS, float),
    "x4driver_get_fps": _x4_get(X4Setting.FPS),
    "x4driver_get_frame_bin_count": _x4_get(X4Setting.FRAMEBINCOUNT),
    "x4driver_set_frame_area": lambda radar, start, end: _x4_set(X4Setting.FRAMEAREA, tuple)(
        radar, (float(start), float(end))
    ),
    "x4driver_get_frame_area": _frame_area,
    "x4driver_set_frame_area_offset": _x4_set(X4Setting.FRAMEAREAOFFSET, float),
    "x4driver_get_frame_area_offset": _x4_get(X4Setting.FRAMEAREAOFFSET),
    **{f"x4driver_set_{space}_register": _set_register(space) for space in REGISTER_SPACES},
    **{f"x4driver_get_{space}_register": _get_register(space) for space in REGISTER_SPACES},
    "x4driver_write_to_spi_register": lambda radar, address, values: radar.registers.write_burst(
        address, _bytes(values)
    ),
    "x4driver_read_from_spi_register": lambda radar, address, length: Vector(
        radar.registers.read_burst(address, length)
    ),
    "x4driver_write_to_i2c_register": lambda radar, address, values: radar.registers.write_i2c(
        address, _bytes(values)
    ),
    "x4driver_read_from_i2c_register": lambda radar, length: Vector(
        radar.registers.read_i2c(length)
    ),
    "search_for_file_by_type": lambda radar, type: Vector(
        name.identifier for name in radar.files.find(type & _ID)
    ),
    "find_all_files": _all_files,
    "create_file": lambda radar, file_type, identifier, length: _slow(
        radar, m.CreateFile(file_type=file_type & _ID, identifier=identifier, length=length)
    ),
    "open_file": lambda radar, file_type, identifier: _slow(
        radar, m.OpenFile(file_type=file_type & _ID, identifier=identifier)
    ),
    "set_file_data": _set_file_data,
    "close_file": lambda radar, type, identifier, commit: _slow(
        radar, m.CloseFile(file_type=type & _ID, identifier=identifier, commit=int(commit))
    ),
    "get_file_length": lambda radar, type, identifier: radar.files.length(type & _ID, identifier),
    "delete_file": lambda radar, type, identifier: radar.files.delete(type & _ID, identifier),
    "format_filesystem": lambda radar, key: radar.files.format_all(key & _ID),
    "get_file_data": _get_file_data,
    "set_file": lambda radar, type, identifier, data: radar.files.write(
        type & _ID, identifier, _bytes(data)
    ),
    "get_file": lambda radar, type, identifier: Vector(radar.files.read(type & _ID, identifier)),
}

_SENSOR: Rows = {
    **_BOTH,
    "set_debug_level": lambda radar, level: radar.diagnostics.set_debug_level(level),
    "reset_to_factory_preset": lambda radar: _slow(radar, m.FactoryPreset()),
    "start_bootloader": lambda radar: radar._call_once(ask_for_bootloader),
    "inject_frame": lambda radar, frame_counter, frame_length, frame: (
        radar.diagnostics.inject_frame(frame_counter, frame[: 2 * frame_length])
    ),
    "prepare_inject_frame": lambda radar, num_frames, num_bins, mode: _slow(
        radar, m.PrepareInjectFrame(frames=num_frames, bins=num_bins, mode=mode)
    ),
    "system_run_test": _run_test,
    "load_profile": lambda radar, profileid: _slow(radar, m.LoadApp(profile_id=profileid & _ID)),
    "get_profileid": lambda radar: radar.profile.profile_id(),
    "set_sensor_mode": _set_sensor_mode,
    "get_sensor_mode": lambda radar: _value(radar, m.GetMode()),
    "set_sensitivity": lambda radar, sensitivity: _slow(
        radar, m.SetSensitivity(sensitivity=sensitivity)
    ),
    "get_sensitivity": lambda radar: _value(radar, m.GetSensitivity()),
    "set_tx_center_frequency": lambda radar, frequency_band: _slow(
        radar, m.SetTxCenterFrequency(tx_center_frequency=frequency_band)
    ),
    "get_tx_center_frequency": lambda radar: _value(radar, m.GetTxCenterFrequency()),
    "set_detection_zone": lambda radar, start, end: _slow(
        radar, m.SetDetectionZone(start_m=float(start), end_m=float(end))
    ),
    "get_detection_zone": _zone,
    "get_detection_zone_limits": _zone_limits,
    "set_led_control": lambda radar, mode, intensity: _slow(
        radar, m.AppSetLedControl(mode=mode, intensity=intensity)
    ),
    "get_led_control": lambda radar: _value(radar, m.AppGetLedControl()),
    "set_output_control": lambda radar, output_feature, output_control: _slow(
        radar, m.OutputSetControl(feature=output_feature & _ID, control=output_control)
    ),
    "get_output_control": lambda radar, output_feature: (
        _value(radar, m.OutputGetControl(feature=output_feature & _ID)) & _ID
    ),
    "set_debug_output_control": lambda radar, output_feature, output_control: _slow(
        radar, m.DebugOutputSetControl(feature=output_feature & _ID, control=output_control)
    ),
    "get_debug_output_control": lambda radar, output_feature: (
        _value(radar, m.DebugOutputGetControl(feature=output_feature & _ID)) & _ID
    ),
    "load_noisemap": lambda radar: radar.profile.load_noise_map(),
    "store_noisemap": lambda radar: radar.profile.store_noise_map(),
    "delete_noisemap": lambda radar: radar.profile.delete_noise_map(),
    "set_noisemap_control": lambda radar, noisemap_control: _slow(
        radar, m.NoiseMapSetControl(control=noisemap_control & _ID)
    ),
    "get_noisemap_control": lambda radar: _value(radar, m.NoiseMapGetControl()),
    "set_periodic_noisemap_store": lambda radar, interval_minutes, reserved: _slow(
        radar, m.NoiseMapSetPeriodicStore(interval_min=interval_minutes, padding=reserved)
    ),
    "get_periodic_noisemap_store": _periodic_store,
    "get_parameter_file": lambda radar, filename: radar.profile.parameter_file(filename),
    "set_parameter_file": lambda radar, filename, data: radar.profile.set_parameter_file(
        filename, data
    ),
    "get_iopin_control": _pin_control,
}

STREAMS: Final[Mapping[str, tuple[type[Response], str]]] = {
    "data_float": (m.DataFloat, "DataFloat"),
    "radar_rf": (m.RadarRf, "RadarRfData"),
    "radar_rf_normalized": (m.RadarRfNormalized, "RadarRfNormalizedData"),
    "radar_baseband_float": (m.RadarBasebandFloat, "RadarBasebandFloatData"),
    "radar_baseband_q15": (m.RadarBasebandQ15, "RadarBasebandQ15Data"),
    "baseband_ap": (m.BasebandAp, "BasebandApData"),
    "baseband_iq": (m.BasebandIq, "BasebandIqData"),
    "pulsedoppler_float": (m.PulseDopplerFloat, "PulseDopplerFloatData"),
    "pulsedoppler_byte": (m.PulseDopplerByte, "PulseDopplerByteData"),
    "noisemap_float": (m.NoiseMapFloat, "PulseDopplerFloatData"),
    "noisemap_byte": (m.NoiseMapByte, "PulseDopplerByteData"),
    "presence_single": (m.PresenceSingle, "PresenceSingleData"),
    "presence_movinglist": (m.PresenceMovingList, "PresenceMovingListData"),
    "respiration_legacy": (m.RespStatus, "RespirationData"),
    "respiration_sleep": (m.SleepStatus, "SleepData"),
    "respiration_movinglist": (m.RespirationMovingList, "RespirationMovingListData"),
    "respiration_detectionlist": (m.RespirationDetectionList, "RespirationDetectionListData"),
    "respiration_normalizedmovementlist": (
        m.RespirationNormalizedMovementList,
        "RespirationNormalizedMovementListData",
    ),
    "vital_signs": (m.VitalSigns, "VitalSignsData"),
}
"""Messages by the ends of ``peek_message_`` and ``read_message_``: ours, and the vendor's class."""


# --- interfaces ---------------------------------------------------------------------------------


class Interface:
    """What a ``get_...`` of a ModuleConnector returns; keeps its port open as long as it lives."""

    def __init__(self, parent: "ModuleConnector") -> None:
        self._parent = parent

    @property
    def connection(self) -> MessageQueues:
        return self._parent.connection

    @property
    def radar(self) -> X4M300:
        """Our own driver of the same module."""
        source = self.connection.source
        if not isinstance(source, ModuleSource):
            raise ModuleConnectorError(
                f"{source.name} is a recording: it plays messages and answers no commands"
            )
        if reason := source.why_ended():
            raise ModuleConnectorError(f"{source.name}: {reason}")
        return source.radar


def _peek(kind: type[Response]) -> Callable[[Interface], int]:
    return lambda self: self.connection.waiting(kind)


class _DataMessages(Interface):
    """The messages of an XEP whose reading fills arguments, and SYSTEM."""

    peek_message_data_string = _peek(m.DataString)
    peek_message_data_byte = _peek(m.DataByte)
    peek_message_system = _peek(m.System)

    def read_message_data_string(self, content_id: Pointer, info: Pointer, data: Pointer) -> int:
        message = self.connection.read(m.DataString, "read_message_data_string")
        content_id.value, info.value, data.value = message.content_id, message.info, message.text
        return 0

    def read_message_data_byte(self, content_id: Pointer, info: Pointer, data: list[int]) -> int:
        message = self.connection.read(m.DataByte, "read_message_data_byte")
        content_id.value, info.value = message.content_id, message.info
        data[:] = message.values
        return 0

    def read_message_system(self) -> int:
        return self.connection.read(m.System, "read_message_system").code


class _Restarts(Interface):
    def reset(self) -> int:
        """Restart the module and wait until it is ready at a port."""
        if isinstance(self.connection.source, ModuleSource):
            try:
                self.connection.source.restart()
            except XeThruError as error:
                raise ModuleConnectorError(f"reset: {error}") from None
        return 0


def _method(name: str, row: Callable[..., Any]) -> Callable[..., Any]:
    signature = inspect.signature(row)

    def call(self: Interface, *args: Any, **kwargs: Any) -> Any:
        try:
            signature.bind(self, *args, **kwargs)
        except TypeError as error:
            raise TypeError(f"{name}(): {error}") from None
        try:
            return row(self.radar, *args, **kwargs)
        except ModuleConnectorError:
            raise
        except XeThruError as error:
            raise ModuleConnectorError(f"{name}: {error}") from None

    call.__name__ = name
    return call


def _read(name: str, kind: type[Response], data: str) -> Callable[[Interface], Data]:
    return lambda self: CLASSES[data].of(self.connection.read(kind, name))


def _interface(name: str, base: type[Interface], rows: Rows, *streams: str) -> type[Interface]:
    members: dict[str, Any] = {method: _method(method, row) for method, row in rows.items()}
    for stream in (one for one in STREAMS if one.startswith(streams)):
        kind, data = STREAMS[stream]
        read = f"read_message_{stream}"
        members |= {f"peek_message_{stream}": _peek(kind), read: _read(read, kind, data)}
    return type(name, (base,), members)


_MATRICES = ("baseband_", "pulsedoppler_", "noisemap_")
_RESPIRATION = ("respiration_", "vital_signs")
XEP = _interface("PyXEP", _DataMessages, _XEP, "data_float", "radar_")
X4M300Interface = _interface("PyX4M300", _Restarts, _SENSOR, *_MATRICES, "presence_")
X4M200Interface = _interface("PyX4M200", _Restarts, _SENSOR, *_MATRICES, *_RESPIRATION)
X4M210Interface = _interface("PyX4M210", _Restarts, _SENSOR, *_MATRICES, *_RESPIRATION)


class ModuleConnector:
    """A module at a port, or a `DataPlayer`.

    Raises `ModuleConnectorError`, a `RuntimeError`, if the port cannot be opened.
    """

    def __init__(
        self, device_name: "str | bytes | DataPlayer | None" = None, log_level: int = 0
    ) -> None:
        self._log_level = log_level
        self._connection: MessageQueues | None = None
        self._recorder: DataRecorder | None = None
        if device_name:
            self.open(device_name)

    def open(self, device: "str | bytes | DataPlayer") -> None:
        self.close()
        if isinstance(device, DataPlayer):
            connection = MessageQueues(PlayerSource(device))
        else:
            port = device.decode() if isinstance(device, bytes) else device
            close_left(port)
            try:
                connection = MessageQueues(ModuleSource(port, self._log_level))
            except XeThruError as error:
                raise ModuleConnectorError(f"ModuleConnector: {error}") from None
        self._connection, self._recorder = connection, None
        # a script that drops its ModuleConnector closes the port
        self._close = weakref.finalize(self, connection.close)

    def close(self) -> None:
        if self._connection is not None:
            self._close()

    @property
    def connection(self) -> MessageQueues:
        if self._connection is None:
            raise ModuleConnectorError("this ModuleConnector has no port: open() one")
        return self._connection

    def get_xep(self) -> Any:
        return XEP(self)

    def get_x4m300(self) -> Any:
        return X4M300Interface(self)

    def get_x4m200(self) -> Any:
        return X4M200Interface(self)

    def get_x4m210(self) -> Any:
        return X4M210Interface(self)

    def get_data_recorder(self) -> DataRecorder:
        if self._recorder is None:
            self._recorder = DataRecorder()
            self.connection.listeners.append(self._recorder.listeners)
            # with the port, so that the files of a script that forgets its recorder are complete
            self.connection.on_close.append(self._recorder.stop_all)
        return self._recorder

    def set_log_level(self, new_log_level: int) -> None:
        self._log_level = new_log_level
        if self._connection is not None and isinstance(self._connection.source, ModuleSource):
            self._connection.source.log_level = new_log_level

    def set_default_timeout(self, new_default_timeout: int) -> None:
        """Accept a timeout; every command has the one of our driver, 2 s or 10 s."""

    def git_sha(self) -> str:
        return version("xethru-hil")

    get_x2 = partial(not_implemented, "ModuleConnector.get_x2")
    get_x2m200 = partial(not_implemented, "ModuleConnector.get_x2m200")
    get_transport = partial(not_implemented, "ModuleConnector.get_transport")
    get_not_supported = partial(not_implemented, "ModuleConnector.get_not_supported")


@contextmanager
def create_mc(*args: Any, **kwargs: Any) -> Iterator[ModuleConnector]:
    """Yield a `ModuleConnector` for a block.

    The port is closed at its end, or, if the script keeps an interface, when that is dropped or the
    port is opened again.
    """
    yield from _lent(ModuleConnector(*args, **kwargs))


def _lent(connector: ModuleConnector) -> Iterator[ModuleConnector]:
    connection = connector.connection
    try:
        yield weakref.proxy(connector)
    finally:
        connection.is_left = True
        del connector


class Bootloader:
    """A module in its bootloader."""

    def __init__(self, device_name: str | bytes | None = None, log_level: int = 0) -> None:
        if not device_name:
            raise ModuleConnectorError("Bootloader: name the port of the module")
        port = device_name.decode() if isinstance(device_name, bytes) else device_name
        try:
            self._radar = X4M300.open(port)
        except XeThruError as error:
            raise ModuleConnectorError(f"Bootloader: {error}") from None
        weakref.finalize(self, self._radar.close)

    def _request(self, command: Command[m.BootloaderSuccess], timeout_s: float) -> bytes:
        try:
            return self._radar.request(command, timeout_s).data
        except XeThruError as error:
            raise ModuleConnectorError(f"Bootloader: {error}") from None

    def get_bootloader_info(self) -> str:
        data = self._request(m.BootloaderGetDeviceInfo(), SLOW_TIMEOUT_S)
        return data.decode("latin-1").rstrip()

    def write_page(self, page_address: int, page_data: Any) -> int:
        command = m.BootloaderWritePage(page=page_address, data=_bytes(page_data))
        self._request(command, SLOW_TIMEOUT_S)
        return 0

    def start_application(self, timeout: float = SLOW_TIMEOUT_S) -> int:
        """Start the firmware; ``timeout`` [s] is how long its check may take."""
        self._request(m.BootloaderStartApp(), float(timeout))
        self._radar.close()
        return 0


# --- extras.auto --------------------------------------------------------------------------------

_FAMILIES = {"bl": "bootloader", "bootloader": "bootloader", "ftdi": "ftdi", "x4": "x4"}


def auto(dev: str = "all") -> list[str]:
    """Return the ports of modules, those of running emulators last.

    ``dev``: all, x4, ftdi, bl or bootloader, separated by commas; an emulated module is an x4.
    """
    wanted = {_FAMILIES.get(one.strip(), one.strip()) for one in dev.split(",")}
    return [
        port.path for port in find_ports() if "all" in wanted or _family(port.description) in wanted
    ]


def _family(description: str) -> str:
    lowered = description.lower()
    return next((name for name in ("bootloader", "ftdi") if name in lowered), "x4")


def auto_open(dev: str = "all", ix: int = 0, log_level: int = 0) -> ModuleConnector:
    """Open the module at place ``ix`` of `auto`; IndexError if there are fewer."""
    ports = auto(dev)
    if ix >= len(ports):
        raise IndexError("no module was found; 'xethru list' shows ports")
    return ModuleConnector(ports[ix], log_level=log_level)


@contextmanager
def create_auto(*args: Any, **kwargs: Any) -> Iterator[ModuleConnector]:
    """As `create_mc`, for `auto_open`."""
    yield from _lent(auto_open(*args, **kwargs))
