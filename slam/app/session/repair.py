"""`uwb-slam repair`: a recording that was cut or damaged becomes one that opens everywhere again.

Everything that is whole is written anew, with an index, into a file beside it, which is read back
before it takes the place of the old one. The old one is kept under another name.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from slam.app.errors import AppError
from slam.app.session.reader import open_mcap
from xethru_protocol.recordings import mcap
from xethru_protocol.system import STDOUT, PathInUseError, StopFlag, each_line, locked

KEPT_SUFFIX = ".unrepaired"
"""Of the name under which the file is kept as it was."""

_ATTACHMENT = struct.Struct("<QQ")
_FOOTER = struct.Struct("<QQI")
_FOOTER_HEAD_BYTES = 9  # code and length
_CHECKED_FOOTER_BYTES = 16  # of its body, that its checksum covers


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
    schemas, channels
        By their numbers in the old file.
    n_messages, first_ns, last_ns
        Messages in the new file, and the session time they span [ns].
    kept
        Where the old file is now; None where it was not moved.
    """

    path: Path
    cut_at: int | None = None
    damages: list[mcap.Damage] = field(default_factory=list)
    has_index: bool = False
    profile: str = ""
    library: str = ""
    schemas: dict[int, tuple[str, str, bytes]] = field(default_factory=dict)
    channels: dict[int, tuple[int, str, str, dict[str, str]]] = field(default_factory=dict)
    n_messages: int = 0
    first_ns: int = 0
    last_ns: int = 0
    kept: Path | None = None

    def lose(self, record: mcap.Record, error: Exception) -> None:
        """Note that a record is left out, once for all that begin in the same place."""
        if not self.damages or self.damages[-1].at != record.at:
            self.damages.append(mcap.Damage(record.at, record.at, f"records there: {error!r}"))

    @property
    def was_whole(self) -> bool:
        return self.cut_at is None and not self.damages and self.has_index

    def __str__(self) -> str:
        span = f"{self.n_messages} messages, {(self.last_ns - self.first_ns) / 1e9:.1f} s"
        if self.was_whole:
            return f"{self.path}: whole, nothing to repair: {span}"
        lines = [f"{self.path}: {span}"]
        if self.cut_at is not None:
            lines.append(f"  it ended too early, at byte {self.cut_at} or behind it")
        lines += [
            f"  bytes {row.at} to {row.until} are left out: {row.reason}" for row in self.damages
        ]
        if self.cut_at is None and not self.damages:
            lines.append("  its index was missing or wrong")
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
        Not an MCAP file, nothing left of it, still being written, or no place to write.
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
            if out is None:
                survey.kept = kept
                _swap(fresh, path, kept)
            else:
                fresh.replace(out)
        except OSError as error:
            raise AppError(
                f"{error.filename or fresh}: cannot be written: {error.strerror or error}; "
                f"{path} is as it was; make room or give --out on another disk"
            ) from None
        finally:
            fresh.unlink(missing_ok=True)
    return survey


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
    survey = Repair(path=path)
    with open_mcap(path) as opened:
        for found in mcap.RecordReader(*opened).read():
            if isinstance(found, mcap.Cut):
                survey.cut_at = found.at
            elif isinstance(found, mcap.Damage):
                survey.damages.append(found)
            else:
                stop.check()
                try:
                    _note(survey, path, found)
                except mcap.DAMAGES as error:
                    survey.lose(found, error)
    return survey


def _note(survey: Repair, path: Path, record: mcap.Record) -> None:
    body = record.body
    if record.code == mcap.HEADER:
        survey.profile, at = mcap.text_at(body, 0)
        survey.library, _ = mcap.text_at(body, at)
    elif record.code == mcap.SCHEMA:
        (number,) = struct.unpack_from("<H", body)
        name, at = mcap.text_at(body, 2)
        encoding, at = mcap.text_at(body, at)
        survey.schemas[number] = (name, encoding, mcap.bytes_at(body, at)[0])
    elif record.code == mcap.CHANNEL:
        number, schema = struct.unpack_from("<HH", body)
        topic, at = mcap.text_at(body, 4)
        encoding, at = mcap.text_at(body, at)
        survey.channels[number] = (schema, topic, encoding, mcap.table_at(body, at)[0])
    elif record.code == mcap.MESSAGE:
        survey.n_messages += 1
    elif record.code == mcap.FOOTER:
        survey.has_index = _is_index_right(path, record)


def _is_index_right(path: Path, footer: mcap.Record) -> bool:
    """Whether the index before the footer is there and what its checksum says."""
    start, _, checksum = _FOOTER.unpack(footer.body)
    with path.open("rb") as stream:
        stream.seek(start)
        checked = footer.at + _FOOTER_HEAD_BYTES + _CHECKED_FOOTER_BYTES - start
        index = stream.read(max(checked, 0))
        stream.seek(footer.at + _FOOTER_HEAD_BYTES + _FOOTER.size)
        ends_well = stream.read() == mcap.MAGIC
    return ends_well and start != 0 and checksum in (0, zlib.crc32(index))


def _write(path: Path, fresh: Path, survey: Repair, stop: StopFlag) -> None:
    with fresh.open("wb") as stream, open_mcap(path) as opened:
        writer = mcap.McapWriter(stream, profile=survey.profile, library=survey.library)
        schemas = {0: 0} | {
            number: writer.register_schema(*row) for number, row in survey.schemas.items()
        }
        channels = {
            number: writer.register_channel(topic, encoding, schemas.get(schema, 0), table)
            for number, (schema, topic, encoding, table) in survey.channels.items()
        }
        for found in mcap.RecordReader(*opened).read():
            stop.check()
            if not isinstance(found, mcap.Record):
                continue
            try:
                _copy(writer, channels, found)
            except mcap.DAMAGES as error:
                survey.lose(found, error)
        writer.finish()
        stream.flush()
        os.fsync(stream.fileno())


def _copy(writer: mcap.McapWriter, channels: dict[int, int], record: mcap.Record) -> None:
    body = record.body
    if record.code == mcap.MESSAGE:
        channel, sequence, t_ns, publish_ns = mcap.MESSAGE_HEAD.unpack_from(body)
        writer.add_message(
            channel_id=channels[channel],
            log_time=t_ns,
            publish_time=publish_ns,
            sequence=sequence,
            data=body[mcap.MESSAGE_HEAD.size :],
        )
    elif record.code == mcap.METADATA:
        name, at = mcap.text_at(body, 0)
        writer.add_metadata(name, mcap.table_at(body, at)[0])
    elif record.code == mcap.ATTACHMENT:
        log_ns, created_ns = _ATTACHMENT.unpack_from(body)
        name, at = mcap.text_at(body, _ATTACHMENT.size)
        media_type, at = mcap.text_at(body, at)
        (size,) = struct.unpack_from("<Q", body, at)
        writer.add_attachment(created_ns, log_ns, name, media_type, body[at + 8 : at + 8 + size])


def _read_back(readable: Path, survey: Repair) -> None:
    """Read the finished file's own index, as every other program will."""
    try:
        statistics = mcap.statistics_of(readable)
    except ValueError as error:
        raise AppError(f"{survey.path}: cannot be made whole: {error}") from None
    survey.n_messages = statistics.message_count
    survey.first_ns = statistics.message_start_time
    survey.last_ns = statistics.message_end_time
