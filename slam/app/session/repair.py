"""`uwb-slam repair`: a recording that was cut or damaged becomes one that opens everywhere again.

Everything that is whole is written anew, with an index, into a file beside it, which is read back
before it takes the place of the old one. The old one is kept under another name.
"""

from __future__ import annotations

import json
import os
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, TypeVar

from slam.live.errors import AppError
from slam.live.session.description import GAP_TOPIC, METADATA_NAME, SESSION_TOPIC
from slam.live.session.lost_messages import GapFinder, gap_json
from slam.live.session.reader import RADAR_INFO, open_mcap, open_session
from slam.live.session_records import Gap
from xethru_protocol.operating_system import STDOUT, PathInUseError, StopFlag, each_line, locked
from xethru_protocol.recordings import mcap
from xethru_protocol.validation import reason_of

Row = TypeVar("Row")

KEPT_SUFFIX = ".unrepaired"
"""Of the name under which the file is kept as it was."""

_PIECE_BYTES = 1 << 20


@dataclass(slots=True, kw_only=True)
class Repair:
    """What a file holds and lacks, and what was made of it.

    Attributes
    ----------
    path
        The file that opens everywhere now.
    cut_at
        Byte at which the old file ended too early; None if it did not.
    damages
        Places of the old file that were left out.
    has_index
        Whether the old file had an index, with the right checksum.
    has_right_data
        Whether the checksum over all of the old file's data is right, if it has one.
    schemas, channels
        By their numbers in the old file.
    head
        Of a session, the first whole message of each topic that describes it, in order.
    metadata
        Of a session, as the old file has it.
    message_counts, data_end, checksum
        Of the old file: messages by channel as its index has them, where its data end, and their
        checksum.
    gaps
        Of a session, what is lost, by the byte at which the damage begins.
    n_elsewhere
        Of a session, messages that are missing where nothing is damaged, as of a chunk cut out.
    n_messages
        In the new file.
    spans
        Session time of the first and the last message by channel [ns].
    kept
        Where the old file is now; None where it was not moved.
    """

    path: Path
    cut_at: int | None = None
    damages: list[mcap.Damage] = field(default_factory=list)
    has_index: bool = False
    has_right_data: bool = True
    profile: str = ""
    library: str = ""
    schemas: dict[int, mcap.records.Schema] = field(default_factory=dict)
    channels: dict[int, mcap.records.Channel] = field(default_factory=dict)
    head: dict[str, bytes] = field(default_factory=dict)
    metadata: dict[str, str] | None = None
    gaps: dict[int, Gap] = field(default_factory=dict)
    n_elsewhere: int = 0
    message_counts: dict[int, int] = field(default_factory=dict)
    data_end: int = 0
    checksum: int = 0
    n_messages: int = 0
    spans: dict[int, tuple[int, int]] = field(default_factory=dict)
    kept: Path | None = None

    def lose(self, record: mcap.LocatedRecord, error: Exception) -> None:
        """Note that a record is left out, once for all that begin in the same place."""
        if not self.damages or self.damages[-1].at != record.at:
            self.damages.append(
                mcap.Damage(record.at, record.at, f"records there: {reason_of(error)}")
            )

    @property
    def was_whole(self) -> bool:
        is_right = self.has_index and self.has_right_data
        return self.cut_at is None and not self.damages and is_right

    @property
    def is_session(self) -> bool:
        """Whether a run of `uwb-slam` wrote it, whatever is left of what describes it."""
        topics = {channel.topic for channel in self.channels.values()}
        return "/scan" in topics or SESSION_TOPIC in topics or self.metadata is not None

    def duration_s(self) -> float:
        """Return how long what was recorded lasts.

        What describes a session is stamped 0, and so may be its log; a drive begins later where
        odometry or the emulator was on before.
        """
        spans = self.spans
        if self.is_session:
            spans = {
                number: spans[number]
                for number, channel in self.channels.items()
                if number in spans
                and not mcap.is_latched(channel.metadata)
                and channel.topic != "/log"
            }
        times_ns = [t_ns for span in spans.values() for t_ns in span] or [0]
        return (max(times_ns) - min(times_ns)) / 1e9

    def table(self) -> dict[str, str] | None:
        """Return the table of the run: of a message, which has a checksum, or the metadata."""
        if SESSION_TOPIC in self.head:
            body = self.head[SESSION_TOPIC][mcap.MESSAGE_HEAD.size :]
            table: dict[str, str] = json.loads(mcap.unpack_string(body))
            return table
        return self.metadata

    def __str__(self) -> str:
        span = f"{self.n_messages} messages, {self.duration_s():.1f} s"
        if self.was_whole:
            return f"{self.path}: whole, nothing to repair: {span}"
        lines = [f"{self.path}: {span}"]
        if self.cut_at is not None:
            lines.append(f"  it ended too early, at byte {self.cut_at} or behind it")
        lines += [
            f"  bytes {row.at} to {row.until} are left out: {row.reason}" for row in self.damages
        ]
        if self.cut_at is None and not self.damages:
            wrong = "a byte outside of its chunks" if self.has_index else "its index"
            lines.append(f"  {wrong} was missing or wrong")
        lines += [f"  lost: {gap}" for gap in self.gaps.values()]
        if self.n_elsewhere:
            lines.append(f"  lost: {self.n_elsewhere} messages, where no damage shows")
        elif self.is_session and not self.gaps and self.cut_at is None:
            lines.append("  nothing that was recorded is lost")
        if self.kept is not None:
            lines.append(f"  as it was: {self.kept}")
        return "\n".join(lines)


def run_repair(stop: StopFlag, *, session: Path, out: Path | None) -> None:
    STDOUT.write(each_line(str(repair(session, out, stop))) + "\n")


def repair(path: Path, out: Path | None, stop: StopFlag) -> Repair:
    """Make a recording whole.

    Parameters
    ----------
    path
        An MCAP file, of this program or another.
    out
        Where to write; None: in its place, and the old one stays as `path` + `KEPT_SUFFIX`. A
        file that is whole is left alone then.
    stop
        A stop leaves everything as it was.

    Raises
    ------
    AppError
        Not an MCAP file, nothing left of it, still being written, or no place to write; or a
        session without any description left, of which only `out` gets what is whole.
    """
    with _held(path):
        survey = _survey(path, stop)
        kept = path.with_name(path.name + KEPT_SUFFIX)
        if survey.was_whole and out is None:
            n_found = survey.n_messages
            _read_back(path, survey)
            if survey.n_messages == n_found:
                return survey
            survey.has_index = False  # damage made a chunk look like another record
        if not survey.channels:
            raise AppError(f"{path}: nothing in it can be kept, no channel is named before its end")
        if out is None and kept.exists():
            raise AppError(f"{kept}: exists, from an earlier repair; move or remove it first")
        if out is not None and out.exists():
            raise AppError(f"{out}: exists; choose another --out")
        survey.path = path if out is None else out
        fresh = survey.path.with_name(f".{survey.path.name}.repairing")
        try:
            _write(path, fresh, survey, stop)
            _read_back(fresh, survey)
            lost = _lost_description(fresh, stop) if survey.is_session else ""
            if out is not None:
                fresh.replace(out)
            elif not lost:
                survey.kept = kept
                _swap(fresh, path, kept)
        except OSError as error:
            raise AppError(
                f"{error.filename or fresh}: cannot be written: {error.strerror or error}; "
                f"{path} is as it was; make room or give --out on another disk"
            ) from None
        finally:
            fresh.unlink(missing_ok=True)
    if lost:
        raise AppError(_not_a_session(path, out, survey, lost))
    return survey


def _lost_description(fresh: Path, stop: StopFlag) -> str:
    """Return why a session cannot be read as one; "" if it can."""
    try:
        open_session(fresh, stop)
    except AppError as error:
        return str(error).removeprefix(f"{fresh}: ")
    return ""


def _not_a_session(path: Path, out: Path | None, survey: Repair, lost: str) -> str:
    text = f"{path}: was a session, and what describes it is lost ({lost}); "
    if out is None:
        return (
            f"{text}it is as it was; with --out FILE the {survey.n_messages} messages that are "
            "whole are written, for programs that read MCAP"
        )
    return (
        f"{text}{out} holds the {survey.n_messages} messages that are whole, for programs that "
        "read MCAP, but `uwb-slam` cannot replay them"
    )


def _swap(fresh: Path, path: Path, kept: Path) -> None:
    """Put a file in another's place, and keep that one under its second name; all or nothing."""
    try:
        kept.hardlink_to(path)  # whatever ends us before the next line, the session has its name
    except OSError:  # FAT and some network shares have no second names
        path.rename(kept)
    try:
        fresh.replace(path)
    except OSError:
        kept.replace(path)
        kept.unlink(missing_ok=True)  # two names of one file: replacing did nothing
        raise


@contextmanager
def _held(path: Path) -> Iterator[None]:
    """Refuse a file that a run is still writing: it holds its folder."""
    try:
        with locked(Path(os.path.realpath(path)).parent):
            yield
    except PathInUseError:
        raise AppError(f"{path}: a run is still writing it; wait for its end") from None


def _survey(path: Path, stop: StopFlag) -> Repair:
    survey, finder = Repair(path=path), GapFinder()
    with open_mcap(path) as opened:
        for found in stop.each(mcap.RecordReader(*opened).read()):
            if isinstance(found, mcap.Cut):
                survey.cut_at = found.at
            elif isinstance(found, mcap.Damage):
                survey.damages.append(found)
                finder.damage(found.at)
            else:
                try:
                    _note(survey, finder, found)
                except mcap.DAMAGES as error:
                    survey.lose(found, error)
        survey.has_index = any(mcap.index_of(*opened))
        if not survey.damages and survey.checksum:
            survey.has_right_data = _checksum(*opened, survey.data_end, stop) == survey.checksum
    topics = {
        number: channel.topic
        for number, channel in survey.channels.items()
        if not mcap.is_latched(channel.metadata)
    }
    if survey.is_session:
        if survey.message_counts:
            finder.count(sum(n for number, n in survey.message_counts.items() if number in topics))
        survey.gaps, survey.n_elsewhere = finder.gaps(topics), finder.n_elsewhere
        _order_head(survey)
    else:
        survey.head, survey.metadata = {}, None
    return survey


def _order_head(survey: Repair) -> None:
    """Put the table of the run first, then the radars in their order."""
    try:
        table = survey.table() or {}
        names = json.loads(table.get("radars", "[]"))
        first = [SESSION_TOPIC, *(f"/radar/{name}/info" for name in names)]
    except (ValueError, TypeError, struct.error):
        return  # reading it back will fail, too
    topics = [topic for topic in dict.fromkeys([*first, *survey.head]) if topic in survey.head]
    survey.head = {topic: survey.head[topic] for topic in topics}
    if SESSION_TOPIC in survey.head and survey.metadata not in (None, table):
        survey.has_right_data = False


def _checksum(stream: BinaryIO, size: int, end: int, stop: StopFlag) -> int:
    """Return the CRC-32 of a file's bytes before a place."""
    stream.seek(0)
    checksum = 0
    for at in range(0, min(end, size), _PIECE_BYTES):
        stop.check()
        checksum = zlib.crc32(stream.read(min(_PIECE_BYTES, end - at)), checksum)
    return checksum


def _note(survey: Repair, finder: GapFinder, record: mcap.LocatedRecord) -> None:
    if record.code == mcap.MESSAGE:
        _note_message(survey, finder, record.body)
        return
    match record.content():
        case mcap.records.Header(profile=profile, library=library):
            survey.profile, survey.library = profile, library
        case mcap.records.Schema() as schema:
            _define(survey.schemas, record, schema.id, schema)
        case mcap.records.Channel() as channel:
            _define(survey.channels, record, channel.id, channel)
        case mcap.records.Metadata(name=name, metadata=table) if name == METADATA_NAME:
            survey.metadata = table
        case mcap.records.DataEnd(data_section_crc=checksum):
            survey.data_end, survey.checksum = record.at, checksum
            finder.end_data()
        case mcap.records.Statistics(channel_message_counts=counts):
            survey.message_counts = counts


def _note_message(survey: Repair, finder: GapFinder, body: bytes) -> None:
    survey.n_messages += 1
    number, sequence, t_ns, _ = mcap.MESSAGE_HEAD.unpack_from(body)
    first_ns, last_ns = survey.spans.get(number, (t_ns, t_ns))
    survey.spans[number] = min(first_ns, t_ns), max(last_ns, t_ns)
    channel = survey.channels.get(number)
    topic = "" if channel is None else channel.topic
    if topic == SESSION_TOPIC:
        finder.count(sequence)
    if topic == SESSION_TOPIC or RADAR_INFO.fullmatch(topic):
        survey.head.setdefault(topic, body)
    finder.message(number, sequence, t_ns)


def _define(table: dict[int, Row], record: mcap.LocatedRecord, number: int, row: Row) -> None:
    """Take a schema or channel; the last word has a chunk, for the index has no checksum each."""
    if record.is_in_chunk or number not in table:
        table[number] = row


def _write(path: Path, fresh: Path, survey: Repair, stop: StopFlag) -> None:
    profile, library = survey.profile, survey.library
    if survey.is_session:
        profile, library = "ros2", "xethru-hil"
    with fresh.open("wb") as stream, open_mcap(path) as opened:
        # Chunks end below at half of that, so that a session's copies lie between them.
        most = 2 * mcap.CHUNK_BYTES
        writer = mcap.McapWriter(stream, chunk_bytes=most, profile=profile, library=library)
        copy = _Copy(writer, survey)
        if survey.is_session:
            copy.write_head()
        for found in stop.each(mcap.RecordReader(*opened).read()):
            stop.check()  # also while nothing is read, but much is written
            if isinstance(found, mcap.Damage) and found.at in survey.gaps:
                copy.write_gap(survey.gaps[found.at])
            if not isinstance(found, mcap.LocatedRecord):
                continue
            try:
                copy.write(found)
            except mcap.DAMAGES as error:
                survey.lose(found, error)
        writer.finish()
        stream.flush()
        os.fsync(stream.fileno())


class _Copy:
    """Writes what is whole of a file into another."""

    def __init__(self, writer: mcap.McapWriter, survey: Repair) -> None:
        self._writer, self._survey = writer, survey
        schemas = {
            number: writer.register_schema(one.name, one.encoding, one.data)
            for number, one in survey.schemas.items()
        }
        self._channels = {
            number: writer.register_channel(
                one.topic, one.message_encoding, schemas.get(one.schema_id, 0), one.metadata
            )
            for number, one in survey.channels.items()
        }
        self._gaps: int | None = None
        self._pending_bytes = 0
        self._latched: dict[int, tuple[int, bytes]] = {}

    def write_head(self) -> None:
        """Write what describes a session at its beginning, and have it repeated."""
        if (table := self._survey.table()) is not None:
            self._writer.add_metadata(METADATA_NAME, table)
        for body in self._survey.head.values():
            self._message(body, is_head=True)
        self._writer.end_chunk()
        self._writer.has_copies = True
        self._writer.write_copy()

    def write_gap(self, gap: Gap) -> None:
        if self._gaps is None:
            schema = mcap.SCHEMAS[mcap.STRING].encode()
            self._gaps = self._writer.add_channel(GAP_TOPIC, mcap.STRING, schema, {})
        self._writer.add_message(
            channel_id=self._gaps,
            log_time=gap.from_ns,
            publish_time=gap.from_ns,
            data=mcap.pack_string(gap_json(gap)),
        )

    def write(self, record: mcap.LocatedRecord) -> None:
        if record.code == mcap.MESSAGE:
            self._message(record.body)
            return
        match record.content():
            case mcap.records.Metadata(name=name, metadata=table):
                if not self._survey.is_session or name != METADATA_NAME:
                    self._writer.add_metadata(name, table)
            case mcap.records.Attachment() as one:
                self._writer.add_attachment(
                    one.create_time, one.log_time, one.name, one.media_type, one.data
                )

    def _message(self, body: bytes, *, is_head: bool = False) -> None:
        number, sequence, t_ns, publish_ns = mcap.MESSAGE_HEAD.unpack_from(body)
        data = body[mcap.MESSAGE_HEAD.size :]
        if self._survey.is_session and mcap.is_latched(self._survey.channels[number].metadata):
            if self._latched.get(number) == (t_ns, data):
                return  # a copy; the writer makes its own
            self._latched[number] = t_ns, data
            sequence = 0
        if not is_head and self._pending_bytes + len(body) > mcap.CHUNK_BYTES:
            self._writer.end_chunk()
            self._pending_bytes = 0
        self._pending_bytes += len(body)
        self._writer.add_message(
            channel_id=self._channels[number],
            log_time=t_ns,
            publish_time=publish_ns,
            sequence=sequence,
            data=data,
        )


def _read_back(readable: Path, survey: Repair) -> None:
    """Read the finished file's own index, as every other program will."""
    try:
        statistics = mcap.statistics_of(readable)
    except ValueError as error:
        raise AppError(f"{survey.path}: cannot be made whole: {error}") from None
    survey.n_messages = statistics.message_count
