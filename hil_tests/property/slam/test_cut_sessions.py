"""A session cut or damaged anywhere: what is left is a prefix, and `repair` makes it whole."""

import struct
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from rosbags.highlevel import AnyReader

from hil_tests.property.examples import examples
from hil_tests.unit.slam.app.session.mcap_files import chunks_of, records_of
from hil_tests.unit.slam.app.sessions import SlowClock, scan, session_info, snapshot
from slam.app.session.repair import KEPT_SUFFIX, repair
from slam.app.session.writer import SessionLog
from slam.live.errors import AppError
from slam.live.session.reader import open_session, read_entries
from xethru_protocol.operating_system import StopFlag
from xethru_protocol.recordings.mcap import CHUNK, FLOAT_ARRAY, Cut
from xethru_protocol.recordings.mcap import McapMessage as StoredMessage

N_BINS = 32
MESSAGE_INDEX = 7
N_SCANS = 10

McapMessage = tuple[str, int, int, int, bytes]


class Content(bytes):
    """The bytes of a file, which no report of a failure should print."""

    def __repr__(self) -> str:
        return f"<{len(self)} bytes>"


NO_CHECK = [HealthCheck.function_scoped_fixture, HealthCheck.too_slow]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Content:
    path = tmp_path_factory.mktemp("whole") / "session.mcap"
    info = session_info()
    info = replace(info, radars=tuple(replace(radar, n_bins=N_BINS) for radar in info.radars))
    log = SessionLog(path, info, drawn=False, clock_ns=SlowClock())
    for counter in range(N_SCANS):
        log.on_scan(scan(counter, n_bins=N_BINS))
        log.on_snapshot(snapshot(counter))
    log.close()
    return Content(path.read_bytes())


def is_of_head(topic: str) -> bool:
    """Whether a topic describes the run: its messages are repeated, which `repair` does anew."""
    return topic in {"/session/info", "/session/gap", "/tf_static"} or topic.endswith("/info")


def messages(path: Path) -> list[McapMessage]:
    """Return what our reader finds before the file ends; an AppError where it finds damage.

    What describes the run is left out.
    """
    return [
        (entry.topic, entry.sequence, entry.t_ns, entry.publish_ns, entry.data)
        for entry in read_entries(path)
        if isinstance(entry, StoredMessage) and not is_of_head(entry.topic)
    ]


def messages_by_mcap(path: Path) -> list[McapMessage]:
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        return [
            (channel.topic, message.sequence, message.log_time, message.publish_time, message.data)
            for _, channel, message in reader.iter_messages(log_time_order=False)
            if not is_of_head(channel.topic)
        ]


def count_by_rosbags(path: Path) -> int:
    with AnyReader([path]) as reader:
        return sum(1 for connection, _, _ in reader.messages() if not is_of_head(connection.topic))


@pytest.mark.parametrize(
    ("chunks", "apart"), [(5, 307), pytest.param(1, 101, marks=pytest.mark.rare)]
)
def test_a_cut_at_any_byte_leaves_a_prefix(
    whole: Content, tmp_path: Path, chunks: int, apart: int
) -> None:
    path = tmp_path / "cut.mcap"
    path.write_bytes(whole)
    everything = messages(path)
    assert len(everything) == N_SCANS * (3 + 5)
    longest, whole_until_ns = 0, -1
    # every record's first byte, the bytes beside it but of message indexes, which are two thirds
    # of the records, all of the heads of some chunks or all, and a comb through the rest
    starts = [at for _, at in records_of(whole)]
    before = starts[0]
    places = set(starts)
    places |= {at + k for at in starts if whole[at] != MESSAGE_INDEX for k in (-1, 1, 9)}
    places |= {at + k for at in chunks_of(whole)[::chunks] for k in range(0, 60, 3)}
    places |= set(range(8, len(whole), apart))
    for cut in sorted(place for place in places if 8 <= place < len(whole)):
        path.write_bytes(whole[:cut])
        found = messages(path)
        assert found == everything[: len(found)], cut
        assert len(found) >= longest, cut  # more bytes never give less
        longest = len(found)
        if cut in starts and whole[before] == CHUNK:  # and no whole chunk is lost
            whole_until_ns = max(whole_until_ns, struct.unpack_from("<Q", whole, before + 17)[0])
        assert whole_until_ns <= 0 or found[-1][2] >= whole_until_ns, cut
        before = cut if cut in starts else before
    assert longest == len(everything)


@settings(max_examples=examples(15, 30), suppress_health_check=NO_CHECK)
@given(data=st.data())
def test_repair_makes_what_every_program_opens(
    whole: Content, tmp_path: Path, data: st.DataObject
) -> None:
    path = tmp_path / "cut.mcap"
    kept = path.with_name(path.name + KEPT_SUFFIX)
    kept.unlink(missing_ok=True)
    cut = data.draw(st.integers(0, len(whole) - 1))
    path.write_bytes(whole[:cut])
    try:
        before = messages(path)
    except AppError:
        assert cut < 8  # not even the magic
        return
    try:
        done = repair(path, None, StopFlag())
    except AppError:  # not even what describes the run
        assert not before
        assert path.read_bytes() == whole[:cut]
        return
    assert not done.was_whole
    assert kept.read_bytes() == whole[:cut]
    assert messages(path) == messages_by_mcap(path) == before
    assert count_by_rosbags(path) == len(before)
    assert repair(path, None, StopFlag()).was_whole
    assert {found.name for found in tmp_path.iterdir()} == {path.name, kept.name}


@settings(max_examples=examples(15, 40), suppress_health_check=NO_CHECK)
@given(share=st.floats(0, 1), garbage=st.binary(min_size=1, max_size=40))
def test_damage_in_the_middle_loses_the_chunk_it_is_in(
    whole: Content, tmp_path: Path, share: float, garbage: bytes
) -> None:
    path = tmp_path / "damaged.mcap"
    path.with_name(path.name + KEPT_SUFFIX).unlink(missing_ok=True)
    path.write_bytes(whole)
    everything = messages(path)
    chunks = chunks_of(whole)
    # the second chunk or a later one: the first holds what all others need to be understood
    place = chunks[1] + round(share * (chunks[-1] - chunks[1]))
    path.write_bytes(whole[:place] + garbage + whole[place + len(garbage) :])
    repair(path, None, StopFlag())
    found = messages(path)
    assert messages_by_mcap(path) == found
    assert count_by_rosbags(path) == len(found)
    kept = iter(everything)
    assert all(row in kept for row in found)  # in order, and nothing that was not there
    for one in open_session(path).scans():  # whole ones, whatever is lost between them
        frames = [(frame.radar, frame.counter) for frame in one.frames]
        assert frames == [(0, one.counter), (1, one.counter)]
    # 40 bytes touch two chunks at most, with eight messages each at most
    assert len(found) >= len(everything) - 2 * 8


def test_a_tail_of_zeros_is_a_cut(whole: Content, tmp_path: Path) -> None:
    """A file system may know of a file's length and not of its last bytes when the power goes."""
    path = tmp_path / "zeros.mcap"
    places = [at for _, at in records_of(whole)]
    at = places[len(places) // 2]
    path.write_bytes(whole[:at] + bytes(5000))
    *entries, cut = read_entries(path)
    assert cut == Cut(at)
    path.write_bytes(whole[:at])
    assert len(entries) == sum(not isinstance(entry, Cut) for entry in read_entries(path)) > 50


@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_foreign_file_is_repaired_whatever_is_in_it(
    tmp_path: Path, compression: CompressionType
) -> None:
    """Other schemas, compressions, attachments and metadata; none of it is ours."""
    path = tmp_path / "foreign.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=2000, compression=compression)
        writer.start(profile="x-weather", library="somebody's")
        schema = writer.register_schema("Rain", "jsonschema", b'{"type": "object"}')
        rain = writer.register_channel("/rain", "json", schema, {"unit": "mm"})
        bare = writer.register_channel("/bare", "raw", 0)
        writer.add_attachment(1, 2, "map.png", "image/png", b"\x89PNG" * 30)
        writer.add_metadata("station", {"name": "Üetliberg"})
        for k in range(200):
            writer.add_message(rain, k, b'{"mm": %d}' % k, k + 7, k)
            writer.add_message(bare, k, bytes([k]) * 20, k, k)
        end_of_data = stream.tell()
        writer.finish()  # type: ignore[no-untyped-call]  # mcap annotates in part
    path.write_bytes(path.read_bytes()[:end_of_data])
    before = messages(path)
    assert len(before) > 300
    out = tmp_path / "whole.mcap"
    done = repair(path, out, StopFlag())
    assert (done.path, done.kept) == (out, None)
    assert path.stat().st_size == end_of_data
    assert messages_by_mcap(out) == before
    with out.open("rb") as stream:
        reader = make_reader(stream)
        (attachment,) = reader.iter_attachments()
        (metadata,) = reader.iter_metadata()
        header, summary = reader.get_header(), reader.get_summary()
    assert (attachment.name, attachment.log_time, attachment.create_time) == ("map.png", 2, 1)
    assert attachment.data == b"\x89PNG" * 30
    assert metadata.metadata == {"name": "Üetliberg"}
    assert (header.profile, header.library) == ("x-weather", "somebody's")
    assert summary is not None
    assert {c.topic: c.metadata for c in summary.channels.values()} == {
        "/rain": {"unit": "mm"},
        "/bare": {},
    }


def test_ros_types_survive(whole: Content, tmp_path: Path) -> None:
    path = tmp_path / "cut.mcap"
    path.write_bytes(whole[: len(whole) * 2 // 3])
    repair(path, None, StopFlag())
    with AnyReader([path]) as reader:
        connection = next(c for c in reader.connections if c.topic == "/radar/radar1/frame")
        _, t_ns, raw = next(reader.messages([connection]))
        message = reader.deserialize(raw, connection.msgtype)
    assert connection.msgtype == FLOAT_ARRAY
    assert (t_ns, len(message.data)) == (0, N_BINS)  # type: ignore[attr-defined]  # made at run time


@settings(max_examples=examples(25, 60), suppress_health_check=NO_CHECK)
@given(data=st.data())
def test_any_bytes_are_one_line_or_messages(
    whole: Content, tmp_path: Path, data: st.DataObject
) -> None:
    """Garbage behind the magic, and damage anywhere, the first chunk and the index included."""
    path, out = tmp_path / "any.mcap", tmp_path / "out.mcap"
    out.unlink(missing_ok=True)
    if data.draw(st.booleans()):
        content = whole[:8] + data.draw(st.binary(max_size=300))
    else:
        mutable = bytearray(whole)
        for _ in range(data.draw(st.integers(1, 4))):
            mutable[data.draw(st.integers(8, len(whole) - 1))] = data.draw(st.integers(0, 255))
        content = bytes(mutable)
    path.write_bytes(content)
    for read in (messages, lambda place: list(open_session(place).records())):
        with suppress(AppError):
            read(path)
    try:
        repair(path, out, StopFlag())
    except AppError:
        assert not out.exists()
    else:
        assert messages(out) == messages_by_mcap(out)
    assert path.read_bytes() == content
