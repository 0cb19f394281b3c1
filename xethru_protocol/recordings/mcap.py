"""Recordings as MCAP, which ROS 2, Foxglove and PlotJuggler open; the only user of mcap here.

Little-endian, each number aligned to its size counted from behind the four header bytes.

Topics, as in the sessions of this project: ``/radar/<name>/frame`` holds radar frames (DATA FLOAT
of content 0) as Float32MultiArray with the counter in the record's sequence number,
``/radar/<name>/info`` once what is known of them, where the recorded module answered for its
settings. Every other message is on
``/radar/<name>/payload``, its payload as UInt8MultiArray, and for reading, if it is a short one, on
``/radar/<name>/message`` as JSON. Messages without a time have one of 0 and a channel that says so.
A cut file loses its last chunk of at most 256 KiB.
"""

import json
import math
import os
import re
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt
import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, Message, Metadata
from mcap.stream_reader import CRCValidationError, StreamReader
from mcap.writer import CompressionType, Writer

from xethru_protocol.driver.frames import FrameGeometry
from xethru_protocol.recordings.records import (
    FaultHandler,
    RadarFacts,
    RecordingError,
    RecordingFacts,
    RecordingFault,
    Timed,
    TimedMessages,
    report,
    unreadable,
    unwritable,
)
from xethru_protocol.wire.codec import decode_response, describe, encode
from xethru_protocol.wire.codes import X4Setting
from xethru_protocol.wire.messages import (
    BasebandAp,
    BasebandIq,
    DataFloat,
    ReplyFloat,
    ReplyInt,
    X4Value,
)
from xethru_protocol.wire.table import ROWS, Response, UnknownMessage
from xethru_protocol.wire.x4 import RF_BIN_M

FLOAT_ARRAY = "std_msgs/msg/Float32MultiArray"
BYTE_ARRAY = "std_msgs/msg/UInt8MultiArray"
STRING = "std_msgs/msg/String"

_LITTLE_ENDIAN = b"\x00\x01\x00\x00"
_U32 = struct.Struct("<I")
_LABEL = {FLOAT_ARRAY: "range_bin", BYTE_ARRAY: "byte"}
_RULE = "=" * 80
_ARRAY_PARTS = f"""\
{_RULE}
MSG: std_msgs/MultiArrayLayout
std_msgs/MultiArrayDimension[] dim
uint32 data_offset
{_RULE}
MSG: std_msgs/MultiArrayDimension
string label
uint32 size
uint32 stride
"""
SCHEMAS = {
    FLOAT_ARRAY: f"std_msgs/MultiArrayLayout layout\nfloat32[] data\n{_ARRAY_PARTS}",
    BYTE_ARRAY: f"std_msgs/MultiArrayLayout layout\nuint8[] data\n{_ARRAY_PARTS}",
    STRING: "string data\n",
}
"""Definition of each message with all it refers to, as ``ros2msg`` text."""


def _text(text: str) -> bytes:
    data = text.encode() + b"\0"
    return _U32.pack(len(data)) + data


def _aligned(data: bytes) -> bytes:
    return data + bytes(-len(data) % 4)


def pack_string(text: str) -> bytes:
    """Bytes of a String."""
    return _LITTLE_ENDIAN + _text(text)


def pack_array(message_type: str, values: npt.NDArray[Any]) -> bytes:
    """Bytes of a one-dimensional array, shape (n,), float32 or uint8 as ``message_type`` says."""
    count = _U32.pack(len(values))
    dimension = _aligned(_U32.pack(1) + _text(_LABEL[message_type])) + count + count
    return _LITTLE_ENDIAN + dimension + _U32.pack(0) + count + values.tobytes()


def unpack_array(data: bytes, dtype: str) -> npt.NDArray[Any]:
    """Values of an array message, shape (n,), read-only.

    Raises
    ------
    ValueError, struct.error
        If the bytes are none.
    """
    if data[:4] != _LITTLE_ENDIAN:
        raise ValueError("the array is not little-endian CDR")
    body = data[4:]
    (dimensions,) = _U32.unpack_from(body, 0)
    position = 4
    for _ in range(dimensions):
        (length,) = _U32.unpack_from(body, position)
        position += 4 + length
        position += -position % 4 + 8
    (count,) = _U32.unpack_from(body, position + 4)
    return np.frombuffer(body, dtype, count, position + 8)


def unpack_string(data: bytes) -> str:
    """Text of a String message.

    Raises
    ------
    ValueError, struct.error
        If the bytes are none.
    """
    if data[:4] != _LITTLE_ENDIAN:
        raise ValueError("the text is not little-endian CDR")
    (length,) = _U32.unpack_from(data, 4)
    return data[8 : 8 + length].rstrip(b"\0").decode()


_FACTS = "xethru-hil recording"
_LENGTH_UNIT = "module metres, c = 3.0e8 m/s"
_CHUNK_BYTES = 256 * 1024
_UNTIMED = {"xethru-hil": "time unknown"}
_DAMAGED = (
    McapError,
    CRCValidationError,
    EOFError,
    struct.error,
    ValueError,
    OverflowError,
    zstandard.ZstdError,
    MemoryError,  # a damaged size
)


class _McapWriter:
    """The channels of one radar in a file being written."""

    def __init__(self, stream: BinaryIO, radar: str, facts: RecordingFacts) -> None:
        self._radar = radar
        self._writer = Writer(stream, chunk_size=_CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(profile="ros2", library="xethru-hil")
        self._writer.add_metadata(_FACTS, {"facts": json.dumps(facts.as_json())})
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, bool], int] = {}
        self._others = 0
        self._has_info = False
        self._settings: dict[str, X4Value] = {}  # as the recorded module read them back

    def write(self, message: Response, t_ns: int | None) -> None:
        """Add a message."""
        if isinstance(message, DataFloat) and message.content_id == 0:
            self._info(message, t_ns)
            data = pack_array(FLOAT_ARRAY, np.ascontiguousarray(message.values, "<f4"))
            self._add("frame", FLOAT_ARRAY, data, t_ns, message.info)
            return
        if isinstance(message, ReplyInt | ReplyFloat):
            self._note_setting(message)
        bulk = not isinstance(message, UnknownMessage) and ROWS[type(message)].bulk
        if isinstance(message, BasebandIq | BasebandAp):
            self._info(message, t_ns)
        payload = np.frombuffer(encode(message), np.uint8)
        self._add("payload", BYTE_ARRAY, pack_array(BYTE_ARRAY, payload), t_ns, self._others)
        if not bulk:
            name, fields = describe(message)
            text = json.dumps({"message": name, "fields": fields})
            self._add("message", STRING, pack_string(text), t_ns, self._others)
        self._others = (self._others + 1) & 0xFFFFFFFF

    def finish(self) -> None:
        """Write the index."""
        self._writer.finish()  # type: ignore[no-untyped-call]  # mcap annotates in part

    def _info(self, frame: DataFloat | BasebandIq | BasebandAp, t_ns: int | None) -> None:
        """Say once what is known of the frames; what is not is null."""
        if self._has_info:
            return
        self._has_info = True
        geometry = self._geometry(frame)
        info: dict[str, object] = {
            "name": self._radar,
            "serial": "",
            "port": "",
            "x_m": None,
            "y_m": None,
            "yaw_rad": None,
            "range_offset_m": None,
            "range_start_m": None if geometry is None else geometry.range_start_m,
            "bin_length_m": None if geometry is None else geometry.bin_length_m,
            "n_bins": None if geometry is None else geometry.n_bins,
            "rate_hz": None,
            "settings": self._settings,
            "length_unit": _LENGTH_UNIT,
        }
        self._add("info", STRING, pack_string(json.dumps(info)), t_ns, 0)

    def _geometry(self, frame: DataFloat | BasebandIq | BasebandAp) -> FrameGeometry | None:
        """Where the bins lie: as the message says, or as the module answered before it."""
        if not isinstance(frame, DataFloat):
            return FrameGeometry(
                range_start_m=frame.range_offset_m,
                bin_length_m=frame.bin_length_m,
                n_bins=frame.num_bins,
                downconversion=True,
            )
        area_m = self._settings.get(X4Setting.FRAMEAREA.name)
        n_bins = self._settings.get(X4Setting.FRAMEBINCOUNT.name)
        if not isinstance(area_m, tuple) or not isinstance(n_bins, int):
            return None
        if len(frame.values) not in {n_bins, 2 * n_bins}:
            return None  # of another time
        return FrameGeometry.from_read_back(
            area_m=(float(area_m[0]), float(area_m[1])),
            n_bins=n_bins,
            downconversion=len(frame.values) == 2 * n_bins,
        )

    def _note_setting(self, answer: ReplyInt | ReplyFloat) -> None:
        """Remember what the module answered of its frame area: the content id is the setting's."""
        match answer:
            case ReplyFloat(content_id=X4Setting.FRAMEAREA, values=(start_m, end_m)):
                self._settings[X4Setting.FRAMEAREA.name] = start_m, end_m
            case ReplyInt(content_id=X4Setting.FRAMEBINCOUNT, values=(n_bins,)):
                self._settings[X4Setting.FRAMEBINCOUNT.name] = n_bins

    def _add(self, topic: str, schema: str, data: bytes, t_ns: int | None, sequence: int) -> None:
        channel = self._channel(topic, schema, timed=t_ns is not None)
        stamp_ns = t_ns or 0
        if stamp_ns < 0:
            raise RecordingError("MCAP has no place for times before 1970")
        self._writer.add_message(
            channel_id=channel,
            log_time=stamp_ns,
            publish_time=stamp_ns,
            sequence=sequence,
            data=data,
        )

    def _channel(self, topic: str, schema: str, *, timed: bool) -> int:
        key = topic, timed
        if key not in self._channels:
            if schema not in self._schemas:
                text = SCHEMAS[schema].encode()
                self._schemas[schema] = self._writer.register_schema(schema, "ros2msg", text)
            self._channels[key] = self._writer.register_channel(
                f"/radar/{self._radar}/{topic}",
                "cdr",
                self._schemas[schema],
                {} if timed else _UNTIMED,
            )
        return self._channels[key]


def write_mcap(
    path: Path, messages: Iterable[Timed], facts: RecordingFacts, radar: str = "module"
) -> None:
    """Write messages to a new file; ``radar`` is the name in its topics.

    Raises
    ------
    RecordingError
        If the file exists or cannot be written. What was written before stays.
    """
    try:
        with path.open("xb") as stream:
            writer = _McapWriter(stream, radar, facts)
            for message, t_ns in messages:
                writer.write(message, t_ns)
            writer.finish()
    except OSError as error:
        raise unwritable(path, error) from None


def read_mcap(path: Path, on_fault: FaultHandler | None, radar: str | None = None) -> TimedMessages:
    """Messages of an MCAP file of this program: a recording, or a session of one radar.

    Of a session of several, those of the named ``radar``.

    Raises
    ------
    RecordingError
        If it holds no radar, or several and none is named, or is damaged and ``on_fault`` is None.
    """
    topics: dict[int, tuple[str, bool]] = {}
    radars: set[str] = set()
    faults: list[RecordingFault] = []

    def note(fault: RecordingFault) -> None:
        faults.append(fault)
        report(fault, on_fault)

    for record in _records(path, note):
        if isinstance(record, Channel):
            name, topic = _radar_topic(record.topic)
            if name and topic in {"frame", "payload"} and radar in {None, name}:
                topics[record.id] = topic, record.metadata.get("xethru-hil") is None
                radars.add(name)
                if len(radars) > 1:
                    raise RecordingError(
                        f"{path} holds several radars ({_names(path)}), not one; "
                        "choose one: --radar NAME, in Python radar="
                    )
        elif isinstance(record, Message) and record.channel_id in topics:
            topic, timed = topics[record.channel_id]
            try:
                message = _message(topic, record)
            except (ValueError, struct.error) as error:
                raise RecordingError(f"{path}: a message is damaged: {error}") from None
            yield message, record.log_time if timed else None
    if not radars and radar is not None and (names := _names(path)):
        raise RecordingError(f"{path} holds no radar {radar!r}; it holds {names}")
    if not radars and not faults:
        raise RecordingError(f"{path} holds no topic /radar/<name>/frame or .../payload")


def mcap_radars(path: Path) -> tuple[RadarFacts, ...]:
    """Return the radars of a file in the order in which their topics begin; damage passes."""
    names: dict[str, None] = {}  # a set in order
    channels: dict[int, str] = {}
    said: dict[str, RadarFacts] = {}
    for record in _records(path, lambda fault: None):
        if isinstance(record, Channel):
            name, topic = _radar_topic(record.topic)
            if name and topic in {"frame", "payload"}:
                names[name] = None
            elif name and topic == "info":
                channels[record.id] = name
        elif isinstance(record, Message) and record.channel_id in channels:
            name = channels[record.channel_id]
            said[name] = _radar_facts(name, record.data)
    return tuple(said.get(name, RadarFacts(name=name)) for name in names)


def _names(path: Path) -> str:
    return ", ".join(sorted(facts.name or "" for facts in mcap_radars(path)))


def _radar_facts(name: str, data: bytes) -> RadarFacts:
    """Read what a latched info says of a radar; nothing where it makes no sense."""
    try:
        info = json.loads(unpack_string(data))
        start_m, bin_m = float(info["range_start_m"]), float(info["bin_length_m"])
        # the read-back of baseband ends at the last bin, that of RF one behind it
        steps = int(info["n_bins"]) - (bin_m > 4 * RF_BIN_M)
        area_m = start_m, start_m + bin_m * steps
    except (KeyError, ValueError, TypeError, OverflowError, RecursionError, struct.error):
        return RadarFacts(name=name)
    serial = info.get("serial")
    return RadarFacts(
        name=name,
        serial=serial if isinstance(serial, str) and serial else None,
        area_m=area_m if all(map(math.isfinite, area_m)) else None,
    )


def mcap_facts(path: Path) -> RecordingFacts:
    """Return what a file says about itself; defaults where it says nothing."""
    for record in _records(path, lambda fault: None):
        if isinstance(record, Metadata) and record.name == _FACTS:
            try:
                return RecordingFacts.from_json(json.loads(record.metadata["facts"]))
            except (KeyError, ValueError, TypeError, RecursionError) as error:
                raise RecordingError(f"{path}: what it says about itself: {error}") from None
        if isinstance(record, Message):
            break
    return RecordingFacts()


def _message(topic: str, record: Message) -> Response:
    if topic == "frame":
        return DataFloat(info=record.sequence, values=unpack_array(record.data, "<f4"))
    return decode_response(unpack_array(record.data, "u1").tobytes())


def _radar_topic(topic: str) -> tuple[str, str]:
    found = re.fullmatch(r"/radar/([^/]+)/([^/]+)", topic)
    return (found[1], found[2]) if found else ("", "")


def _records(path: Path, on_fault: FaultHandler | None) -> Iterator[object]:
    try:
        with path.open("rb") as stream:
            try:
                size = os.fstat(stream.fileno()).st_size  # no record is larger, whatever it claims
                reader = StreamReader(stream, validate_crcs=True, record_size_limit=size)
                yield from reader.records
            except _DAMAGED as error:
                reason = f"it is cut or damaged: {str(error) or type(error).__name__}"
                fault = RecordingFault(file=path.name, offset=stream.tell(), reason=reason)
                report(fault, on_fault)
    except OSError as error:
        raise unreadable(path, error) from None
