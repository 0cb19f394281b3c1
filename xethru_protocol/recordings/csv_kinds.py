"""The data files of ModuleConnector that are text: one row per data type.

A line is an ISO time stamp and the message's fields, separated by ``;``; the first line names the
columns. Lists stand in square brackets, separated by commas. Known from a recording [OBS]:
PRESENCE_SINGLE with its header, bit and name. Bits [HDR] as in ``layouts``. Everything else is
inferred [INF] from the message's fields in the same manner, or from what others report of such
files; a line of another column count or order is reported, not guessed at.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timedelta, tzinfo
from typing import Any

import numpy as np

from xethru_protocol import responses, responses_profile
from xethru_protocol.codec import encode
from xethru_protocol.recordings.records import EARLIEST_MS, LATEST_MS, MS_NS
from xethru_protocol.table import Response

_EPOCH_DIGITS = "milliseconds"


def float_text(value: float) -> str:
    """Text of a float32 as the vendor writes it, with more digits only where six lose bits.

    >>> [float_text(x) for x in (21.75, 22.0, 0.10000000149011612, 1e-8)]
    ['21.75', '22', '0.1', '1e-08']
    """
    exact = np.float32(value).tobytes()
    for digits in range(6, 10):
        text = f"{value:.{digits}g}"
        if np.float32(text).tobytes() == exact:
            return text
    return text


def _exact_float32(text: str) -> float:
    (value,) = struct.unpack("<f", struct.pack("<f", float(text)))
    return float(value)


def _list_text(values: Any) -> str:  # noqa: ANN401 - an array or a tuple of numbers
    return "[" + ",".join(float_text(float(value)) for value in values) + "]"


def _list(text: str) -> Any:  # noqa: ANN401 - what the message's field holds
    if not (text.startswith("[") and text.endswith("]")):
        raise ValueError(f"a list in square brackets was expected, not {text!r}")
    return tuple(_exact_float32(item) for item in text[1:-1].split(",") if item)


_ESCAPES = {"\\": "\\\\", "\n": "\\n", "\r": "\\r", ";": "\\x3b"}


def _escaped(text: str) -> str:
    return "".join(_ESCAPES.get(character, character) for character in text)


def _unescaped(text: str) -> str:
    return text.encode("latin-1").decode("unicode_escape")


@dataclass(frozen=True, slots=True)
class Column:
    """A column: its title, the message's field, and the field as text and back."""

    title: str
    field: str
    text: Callable[[Any], str] = str
    value: Callable[[str], Any] = int
    is_count: bool = False  # the length of the list ``field``, not a field of its own


def _real(title: str, field: str) -> Column:
    return Column(title, field, float_text, _exact_float32)


def _listed(title: str, field: str) -> Column:
    return Column(title, field, _list_text, _list)


def _counted(title: str, field: str) -> Column:
    return Column(title, field, lambda values: str(len(values)), int, is_count=True)


@dataclass(frozen=True, slots=True)
class CsvKind:
    """One kind of text file; ``message`` is the row of the message table it holds."""

    file_prefix: str
    data_type: int
    message: type[Response]
    columns: tuple[Column, ...]

    @property
    def header(self) -> str:
        """First line of a file, with its end of line."""
        return ";".join(("TimeStamp", *(column.title for column in self.columns))) + "\n"

    def line(self, message: Response, time_ms: int, zone: tzinfo | None) -> str:
        """Line of a message with its time [ms since 1970], with its end of line."""
        cells = (column.text(getattr(message, column.field)) for column in self.columns)
        return ";".join((_stamp(time_ms, zone), *cells)) + "\n"

    def parse(self, line: str) -> tuple[Response, int]:
        """Message of a line and its time [ns since 1970].

        Raises
        ------
        ValueError, OverflowError, LocalProtocolError
            If the line is none of this kind.
        """
        cells = line.rstrip("\r\n").split(";")
        if len(cells) != len(self.columns) + 1:
            raise ValueError(f"{len(self.columns) + 1} columns were expected, not {len(cells)}")
        fields: dict[str, Any] = {}
        counts: dict[str, int] = {}
        for column, cell in zip(self.columns, cells[1:], strict=True):
            (counts if column.is_count else fields)[column.field] = column.value(cell)
        for field, count in counts.items():
            if len(fields[field]) != count:
                raise ValueError(f"{field} has {len(fields[field])} values, not {count}")
        message = self.message(**fields)
        encode(message)  # it must fit the wire, or nothing can be done with it
        return message, _time_ns(cells[0])


_UNIX = datetime.fromisoformat("1970-01-01T00:00:00+00:00")


def _stamp(time_ms: int, zone: tzinfo | None) -> str:
    time = (_UNIX + timedelta(milliseconds=time_ms)).astimezone(zone)
    return time.isoformat(timespec=_EPOCH_DIGITS)


def _time_ns(stamp: str) -> int:
    time = datetime.fromisoformat(stamp)
    if time.tzinfo is None:
        time = time.astimezone()  # the zone it was written in is not told: this machine's
    time_ms = (time - _UNIX) // timedelta(milliseconds=1)
    if not EARLIEST_MS <= time_ms <= LATEST_MS:
        raise ValueError(f"{stamp} is beyond what 64 bits of nanoseconds hold")
    return time_ms * MS_NS


_COUNTER = Column("Counter", "counter")
_STATE = Column("State", "state")
_RATE = _real("RPM", "rpm")
_DISTANCE = _real("ObjectDistance", "distance_m")
_QUALITY = Column("SignalQuality", "signal_quality")
_MOVEMENT = (
    _counted("MovementIntervalCount", "movement_slow"),
    _listed("MovementSlowItem", "movement_slow"),
    _listed("MovementFastItem", "movement_fast"),
)
_DETECTION_COUNT = _counted("DetectionCount", "detection_distance_m")
_DETECTION = (
    _listed("DetectionDistance", "detection_distance_m"),
    _listed("DetectionRadarCrossSection", "detection_rcs"),
    _listed("DetectionVelocity", "detection_velocity"),
)

CSV_KINDS: tuple[CsvKind, ...] = (
    CsvKind(  # bit, name and columns [OBS]
        "xethru_presence_single_",
        1 << 12,
        responses_profile.PresenceSingle,
        (
            _COUNTER,
            Column("PresenceState", "state"),
            _real("Distance", "distance_m"),
            Column("Direction", "direction"),
            _QUALITY,
        ),
    ),
    CsvKind(  # bit [OBS]; name, columns and brackets as others report them [INF]
        "xethru_presence_movinglist_",
        1 << 13,
        responses_profile.PresenceMovingList,
        (
            _COUNTER,
            Column("PresenceState", "state"),
            _MOVEMENT[0],
            _DETECTION_COUNT,
            *_MOVEMENT[1:],
            *_DETECTION,
        ),
    ),
    CsvKind(  # bit [HDR]; name and columns as others report them, the last two [INF]
        "xethru_sleep_",
        1 << 2,
        responses_profile.SleepStatus,
        (
            Column("FrameCounter", "counter"),
            _STATE,
            _RATE,
            _DISTANCE,
            _QUALITY,
            _real("MovementSlow", "movement_slow"),
            _real("MovementFast", "movement_fast"),
        ),
    ),
    CsvKind(  # bit [HDR]; name as others report it, columns [INF]
        "xethru_respiration_",
        1 << 3,
        responses_profile.RespStatus,
        (
            Column("FrameCounter", "counter"),
            _STATE,
            Column("RPM", "rpm"),
            _DISTANCE,
            _real("ObjectMovement", "movement_mm"),
            _QUALITY,
        ),
    ),
    CsvKind(  # bit [HDR], name and columns [INF]
        "xethru_string_",
        1 << 5,
        responses.DataString,
        (
            Column("ContentId", "content_id"),
            Column("Info", "info"),
            Column("Text", "text", _escaped, _unescaped),
        ),
    ),
    CsvKind(  # bit [HDR], name and columns [INF]
        "xethru_respiration_detectionlist_",
        1 << 14,
        responses_profile.RespirationDetectionList,
        (_COUNTER, _DETECTION_COUNT, *_DETECTION),
    ),
    CsvKind(  # bit [HDR], name and columns [INF]
        "xethru_respiration_movinglist_",
        1 << 15,
        responses_profile.RespirationMovingList,
        (_COUNTER, *_MOVEMENT),
    ),
    CsvKind(  # bit [HDR], name and columns [INF]
        "xethru_vitalsigns_",
        1 << 16,
        responses_profile.VitalSigns,
        (
            _COUNTER,
            _STATE,
            _real("RespirationRate", "respiration_rate"),
            _real("RespirationDistance", "respiration_distance_m"),
            _real("RespirationConfidence", "respiration_confidence"),
            _real("HeartRate", "heart_rate"),
            _real("HeartDistance", "heart_distance_m"),
            _real("HeartConfidence", "heart_confidence"),
            _real("NormalizedMovementSlow", "normalized_movement_slow"),
            _real("NormalizedMovementFast", "normalized_movement_fast"),
            _real("NormalizedMovementStart", "normalized_movement_start_m"),
            _real("NormalizedMovementEnd", "normalized_movement_end_m"),
        ),
    ),
    CsvKind(  # bit [HDR], name and columns [INF]
        "xethru_sleepstage_",
        1 << 17,
        responses_profile.SleepStage,
        (_COUNTER, Column("SleepStage", "stage")),
    ),
    CsvKind(  # bit [HDR], name and columns [INF]
        "xethru_respiration_normalizedmovementlist_",
        1 << 18,
        responses_profile.RespirationNormalizedMovementList,
        (
            _COUNTER,
            _real("Start", "start_m"),
            _real("BinLength", "bin_length_m"),
            _counted("Count", "movement_slow"),
            _listed("MovementSlow", "movement_slow"),
            _listed("MovementFast", "movement_fast"),
        ),
    ),
)
"""All kinds. Bits 1 << 4 (performance status) and 1 << 19 ... 22 (frames of newer firmware) of the
vendor's header have no row: their layout is not known (Protocol reference 7.5)."""
BY_MESSAGE: dict[type[Response], CsvKind] = {kind.message: kind for kind in CSV_KINDS}
