"""Recorder, reader and player of recordings under the vendor's names."""

import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Final

import numpy as np

from xethru_protocol.driver.matching import Listeners
from xethru_protocol.legacy.connection import ModuleConnectorError, Taker, report
from xethru_protocol.legacy.data import CLASSES, Data, Vector, not_implemented
from xethru_protocol.recordings import (
    Recorder,
    RecordingError,
    RecordingReader,
    Split,
    WriterOptions,
)
from xethru_protocol.recordings.recorded_messages import MS_NS
from xethru_protocol.recordings.vendor.layouts import ALL_BITS, KIND_OF_MESSAGE, KIND_OF_TYPE
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codec import decode_response, encode
from xethru_protocol.wire.errors import XeThruError
from xethru_protocol.wire.table import Response

MessageType = type[Response]
OnFile = Callable[[int, str], object]
OnMetaFile = Callable[[str, str], object]


def _kinds(data_types: int) -> frozenset[MessageType]:
    return frozenset(kind.message for bit, kind in KIND_OF_TYPE.items() if data_types & bit)


def _kind(data_type: int) -> MessageType:
    (kind,) = _kinds(data_type) or {None}
    if kind is None:
        raise ModuleConnectorError(f"{data_type} is not a single DataType that can be recorded")
    return kind


def _bits(kinds: Iterable[MessageType]) -> int:
    return sum(KIND_OF_MESSAGE[kind].data_type for kind in kinds)


# --- options ------------------------------------------------------------------------------------


class PreferredSplitSize:
    """When a file or directory ends and the next begins: by duration, size or hour of the day."""

    DurationType, ByteCountType, FixedDailyHour, InvalidType = range(4)
    _names = ("seconds", "bytes", "daily_hour")

    def __init__(self, other: "PreferredSplitSize | None" = None) -> None:
        self.split: Split | None = other.split if other else None

    def _get(self, name: str) -> int:
        value = getattr(self.split, name) if self.split else None
        return -1 if value is None else int(value)

    def get_duration(self) -> int:
        return self._get("seconds")

    def set_duration(self, seconds: int) -> None:
        self.split = Split(seconds=seconds)

    def get_byte_count(self) -> int:
        return self._get("bytes")

    def set_byte_count(self, count: int) -> None:
        self.split = Split(bytes=count)

    def get_fixed_daily_hour(self) -> int:
        return self._get("daily_hour")

    def set_fixed_daily_hour(self, hour: int) -> None:
        self.split = Split(daily_hour=hour)

    def get_type(self) -> int:
        found = [at for at, name in enumerate(self._names) if self._get(name) >= 0]
        return found[0] if found else self.InvalidType


def _option(
    name: str, default: Any, kept: Callable[[Any], Any]
) -> tuple[Callable[["RecordingOptions", Any], None], Callable[["RecordingOptions"], Any]]:
    """Return setter and getter of an option; both make a copy by ``kept``."""

    def set_(self: "RecordingOptions", value: Any) -> None:
        self._values[name] = kept(value)

    def get(self: "RecordingOptions") -> Any:
        return kept(self._values.get(name, default))

    return set_, get


class RecordingOptions:
    """Options of `DataRecorder.start_recording`."""

    def __init__(self, other: "RecordingOptions | None" = None) -> None:
        self._values: dict[str, Any] = dict(other._values) if other else {}

    def writer_options(self) -> WriterOptions:
        """Return the same for a `RecordingWriter`; the vendor's limit of the rate is in ms."""
        options: WriterOptions = {
            "session_id": self.get_session_id(),
            "user_header": bytes(self.get_user_header()),
            "flush_on_write": self.get_flush_on_write(),
            "split": self.get_file_split_size().split,
            "split_directories": self.get_directory_split_size().split,
        }
        if (limit_ms := self.get_data_rate_limit()) > 0:
            options["interval_s"] = limit_ms / 1000
        return options

    set_session_id, get_session_id = _option("session_id", "", str)
    set_file_split_size, get_file_split_size = _option("file_split", None, PreferredSplitSize)
    set_directory_split_size, get_directory_split_size = _option(
        "directory_split", None, PreferredSplitSize
    )
    set_data_rate_limit, get_data_rate_limit = _option("data_rate_limit", -1, int)
    set_user_header, get_user_header = _option("user_header", (), Vector)
    set_flush_on_write, get_flush_on_write = _option("flush_on_write", False, bool)


# --- DataRecorder -------------------------------------------------------------------------------


class DataRecorder:
    """Records what the module sends, in directories as ModuleConnector makes them.

    It does not switch anything on in the module. ``listeners`` get what the module sends.
    """

    def __init__(self) -> None:
        self.listeners = Listeners[Response, int]()
        self._recorders: list[Recorder] = []
        self._on_file: list[tuple[int, OnFile]] = []
        self._on_meta_file: OnMetaFile | None = None
        self._on_error: Callable[[str], object] | None = None
        self._basenames: dict[MessageType, str] = {}

    def _fail(self, error: XeThruError) -> None:
        if self._on_error is not None:
            self._on_error(str(error))
        else:
            report(f"DataRecorder: {error}")

    def start_recording(
        self, data_types: int, directory: str, options: RecordingOptions | None = None
    ) -> int:
        """Begin a recording in a new directory in ``directory``; 0, or 1 if that failed.

        Why it failed goes to the error callback, else to standard error.
        """
        kinds = _kinds(data_types)
        if twice := [kind for kind in kinds if self._recorder_of(kind)]:
            names = ", ".join(sorted(kind.__name__ for kind in twice))
            self._fail(RecordingError(f"{names} is being recorded already"))
            return 1
        chosen = (options or RecordingOptions()).writer_options()
        chosen["basenames"] = {kind: self._basenames[kind] for kind in kinds & {*self._basenames}}
        chosen["on_file"] = self._file_done
        chosen["on_meta_file"] = self._meta_file_done
        recorder = Recorder(self, directory, kinds=kinds, on_error=self._fail, **chosen)
        try:
            recorder.start()
        except RecordingError as error:
            self._fail(error)
            return 1
        self._recorders.append(recorder)
        return 0

    def stop_recording(self, data_types: int) -> None:
        for recorder in self._recorders:
            recorder.kinds = (recorder.kinds or frozenset()) - _kinds(data_types)
            if not recorder.kinds:
                recorder.stop(at_ns=time.time_ns())
        self._recorders = [recorder for recorder in self._recorders if recorder.kinds]

    def stop_all(self) -> None:
        self.stop_recording(ALL_BITS)

    def is_recording(self, data_type: int) -> bool:
        return self._recorder_of(_kind(data_type)) is not None

    def _recorder_of(self, kind: MessageType) -> Recorder | None:
        return next((one for one in self._recorders if one.is_recording(kind)), None)

    def process(self, data_type: int, data: Any) -> bool:
        """Store a record of data made elsewhere; whether it was stored."""
        layout = KIND_OF_TYPE[_bits([_kind(data_type)])]
        prefix = getattr(layout, "prefix", None)
        if prefix is None:
            not_implemented("DataRecorder.process of a text file")
        stored = self._stored()
        self.listeners(decode_response(prefix + bytes(data)), time.monotonic_ns())
        return self._stored() > stored

    def _stored(self) -> int:
        return sum(recorder.messages for recorder in self._recorders)

    def subscribe_to_file_available(self, data_types: int, callback: OnFile) -> int:
        self._on_file.append((data_types, callback))
        return 0

    def unsubscribe_to_file_available(self, data_types: int) -> None:
        self._on_file = [(bits & ~data_types, callback) for bits, callback in self._on_file]

    def subscribe_to_meta_file_available(self, callback: OnMetaFile) -> int:
        self._on_meta_file = callback
        return 0

    def unsubscribe_to_meta_file_available(self) -> int:
        self._on_meta_file = None
        return 0

    def set_error_callback(self, callback: Callable[[str], object] | None) -> None:
        self._on_error = callback

    def _file_done(self, kind: MessageType, path: Path) -> None:
        bit = KIND_OF_MESSAGE[kind].data_type
        for bits, callback in self._on_file:
            if bits & bit:
                callback(bit, str(path))

    def _meta_file_done(self, session_id: str, path: Path) -> None:
        if self._on_meta_file is not None:
            self._on_meta_file(session_id, str(path))

    def set_basename_for_data_type(self, data_type: int, name: str) -> None:
        self._basenames[_kind(data_type)] = name

    def get_basename_for_data_type(self, data_type: int) -> str:
        kind = _kind(data_type)
        return self._basenames.get(kind, f"xethru_{KIND_OF_MESSAGE[kind].name}")

    def clear_basename_for_data_types(self, data_types: int) -> None:
        for kind in _kinds(data_types):
            self._basenames.pop(kind, None)

    def get_recording_directory(self, session_or_type: str | int) -> str:
        """Return the directory of a session id or a DataType; empty if it is not recorded."""
        for recorder in self._recorders:
            if session_or_type == recorder.session_id or (
                isinstance(session_or_type, int)
                and any(map(recorder.is_recording, _kinds(session_or_type)))
            ):
                return str(recorder.directory)
        return ""

    @staticmethod
    def data_type_to_string(data_type: int) -> str:
        return KIND_OF_MESSAGE[_kind(data_type)].name


# --- DataReader ---------------------------------------------------------------------------------


class DataRecord:
    """A record as stored. Titles of text files and user headers do not count as records."""

    def __init__(self) -> None:
        self.data = Vector()
        self.data_type = 0
        self.epoch = 0
        self.is_valid = False
        self.is_user_header = False
        self.meta_version = RecordingReader.meta_version
        self._message: Response | None = None

    def get_data(self) -> Any:
        return np.array(self.data, np.uint8)

    def is_csv_header(self) -> bool:
        return False

    def to_binary_packet(self, ok: object = None) -> Vector:
        return Vector(b"" if self._message is None else encode(self._message))

    def _to(self, kind: MessageType, name: str) -> Data:
        return CLASSES[name].of(self._message) if type(self._message) is kind else CLASSES[name]()

    def to_sleep_data(self, ok: object = None) -> Data:
        return self._to(m.SleepStatus, "SleepData")

    def to_vitalsigns_data(self, ok: object = None) -> Data:
        return self._to(m.VitalSigns, "VitalSignsData")


_WHOLE_CHAIN: Final = -1


class DataReader:
    """Reads a recording of ModuleConnector record by record."""

    def __init__(self) -> None:
        self._opened: RecordingReader | None = None

    def open(self, meta_filename: str, depth: int = _WHOLE_CHAIN) -> int:
        """Open a recording; 0, or 1 with the reason on standard error."""
        if depth != _WHOLE_CHAIN:
            not_implemented("DataReader.open with a depth")
        self.close()
        try:
            self._opened = RecordingReader(meta_filename)
        except XeThruError as error:
            report(f"DataReader: {error}")
            return 1
        return 0

    def is_open(self) -> bool:
        return self._opened is not None

    def close(self) -> None:
        if self._opened is not None:
            self._opened.close()
        self._opened = None

    @property
    def _reader(self) -> RecordingReader:
        if self._opened is None:
            raise ModuleConnectorError("DataReader: open() a recording first")
        return self._opened

    def at_end(self) -> bool:
        return self._reader.at_end

    def _record(self, *, stay: bool) -> DataRecord:
        found = DataRecord()
        try:
            record = self._reader.peek() if stay else self._reader.read()
        except RecordingError as error:
            report(f"DataReader: {error}")
            return found
        found.data = Vector(record.data)
        found.data_type = KIND_OF_MESSAGE[type(record.message)].data_type
        found.epoch = record.t_ns // MS_NS
        found.is_valid = True
        found._message = record.message
        return found

    def read_record(self) -> DataRecord:
        return self._record(stay=False)

    def peek_record(self) -> DataRecord:
        return self._record(stay=True)

    def _seek(self, seek: Callable[[int], None], position: int) -> int:
        try:
            seek(position)
        except RecordingError:
            return 1
        return 0

    def seek_ms(self, position: int) -> int:
        return self._seek(self._reader.seek_ms, position)

    def seek_byte(self, position: int) -> int:
        return self._seek(self._reader.seek_byte, position)

    def set_filter(self, data_types: int) -> int:
        _set_filter(self._reader, data_types)
        return 0

    def get_filter(self) -> int:
        return _bits(self._reader.filter) or ALL_BITS

    def get_start_epoch(self) -> int:
        return self._reader.start_ns // MS_NS

    def get_duration(self) -> int:
        return self._reader.duration_ns // MS_NS

    def get_size(self) -> int:
        return self._reader.size_bytes

    def get_data_types(self) -> int:
        return _bits(self._reader.kinds)

    def get_max_record_size(self) -> int:
        return self._reader.largest_record_bytes

    def get_session_id(self) -> str:
        return self._reader.session_id

    def get_meta_version(self) -> int:
        return self._reader.meta_version

    def get_profile_id(self) -> int:
        return self._reader.profile_id


def _set_filter(reader: RecordingReader, data_types: int) -> None:
    every = data_types & ALL_BITS == ALL_BITS
    reader.set_filter(*(() if every else _kinds(data_types)))


# --- DataPlayer ---------------------------------------------------------------------------------


class DataPlayer:
    """Plays a recording to the ModuleConnectors that were made with it, at its own pace."""

    StoppedState, PlayingState, PausedState = range(3)

    def __init__(self, meta_filename: str, depth: int = _WHOLE_CHAIN) -> None:
        if depth != _WHOLE_CHAIN:
            not_implemented("DataPlayer with a depth")
        try:
            self._reader = RecordingReader(meta_filename)
        except XeThruError as error:
            raise ModuleConnectorError(f"DataPlayer: {error}") from None
        self._meta_filename = str(meta_filename)
        self.takers: list[Taker] = []
        self.why_ended: str | None = None
        self._state = self.StoppedState
        self._filter = ALL_BITS
        self._rate = 1.0
        self._loop = False
        self._from_ms, self._from_s = 0.0, time.monotonic()  # the position at a time of the clock
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None

    def play(self) -> None:
        self.set_state(self.PlayingState)

    def pause(self) -> None:
        self.set_state(self.PausedState)

    def stop(self) -> None:
        self.set_state(self.StoppedState)

    def set_state(self, state: int) -> None:
        with self._changed:
            self._from_ms = 0.0 if state == self.StoppedState else self._now_ms()
            if state == self.StoppedState:
                self._reader.seek_ms(0)
            self._from_s = time.monotonic()
            self._state = state
            self.why_ended = None
            if state == self.PlayingState and self._thread is None:
                self._thread = threading.Thread(target=self._run, name="DataPlayer", daemon=True)
                self._thread.start()
            self._changed.notify_all()

    def get_state(self) -> int:
        return self._state

    def set_filter(self, data_types: int) -> int:
        with self._changed:
            self._filter = data_types & ALL_BITS
            _set_filter(self._reader, self._filter)
        return 0

    def get_filter(self) -> int:
        return self._filter

    def set_playback_rate(self, rate: float) -> None:
        if not rate > 0:
            raise ModuleConnectorError(f"the playback rate must be more than 0, not {rate}")
        with self._changed:
            self._from_ms, self._from_s = self._now_ms(), time.monotonic()
            self._rate = float(rate)
            self._changed.notify_all()

    def get_playback_rate(self) -> float:
        return self._rate

    def set_loop_mode_enabled(self, enabled: bool) -> None:
        self._loop = bool(enabled)

    def get_loop_mode_enabled(self) -> bool:
        return self._loop

    def set_position(self, position: int) -> int:
        with self._changed:
            try:
                self._reader.seek_ms(position)
            except RecordingError:
                return 1
            self._from_ms, self._from_s = float(position), time.monotonic()
            self._changed.notify_all()
        return 0

    def get_position(self) -> int:
        with self._changed:
            return min(int(self._now_ms()), self.get_duration())

    def get_duration(self) -> int:
        return self._reader.duration_ns // MS_NS

    def meta_filename(self) -> str:
        return self._meta_filename

    def _now_ms(self) -> float:
        if self._state != self.PlayingState:
            return self._from_ms
        return self._from_ms + (time.monotonic() - self._from_s) * 1000 * self._rate

    def _run(self) -> None:
        while True:
            with self._changed:
                message = self._due()
                takers = tuple(self.takers)
            if message is not None:
                for take in takers:
                    take(message, time.monotonic_ns())

    def _due(self) -> Response | None:
        """Wait for the next message, or for a change of what is played."""
        if self._state != self.PlayingState:
            self._changed.wait()
            return None
        if self._reader.at_end and self._loop:
            self._reader.seek_ms(0)
            self._from_ms, self._from_s = 0.0, time.monotonic()
        if self._reader.at_end:
            self._end("the recording has ended")
            return None
        try:
            record = self._reader.peek()
        except RecordingError as error:
            self._end(str(error))
            return None
        due_ms = (record.t_ns - self._reader.start_ns) / MS_NS
        left_s = (due_ms - self._now_ms()) / (1000 * self._rate)
        if left_s > 0:
            self._changed.wait(left_s)
            return None
        return self._reader.read().message

    def _end(self, why: str) -> None:
        self._state = self.StoppedState
        self._from_ms = 0.0
        self.why_ended = why


class PlayerSource:
    """A `DataPlayer` as the source of a connection."""

    def __init__(self, player: DataPlayer) -> None:
        self.name = player.meta_filename()
        self._player = player
        self._take: Taker | None = None

    def attach(self, take: Taker) -> None:
        self._take = take
        self._player.takers.append(take)

    def close(self) -> None:
        if self._take in self._player.takers:
            self._player.takers.remove(self._take)

    def why_ended(self) -> str | None:
        if self._take not in self._player.takers:
            return "the ModuleConnector was closed"
        return self._player.why_ended
