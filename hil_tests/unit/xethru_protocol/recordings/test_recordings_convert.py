"""Conversion among vendor directories, wire captures and MCAP, and each format by itself."""

import json
import struct
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_typestore

from hil_tests.unit.slam.app.sessions import scan, session_info
from hil_tests.unit.xethru_protocol.recordings.messages import (
    RECORDINGS,
    frame,
    read_with_faults,
    write_capture,
)
from slam.app.session.writer import SessionLog
from slam.live.odometry_track import OdometryTrack, format_tum_line
from xethru_protocol.recordings import (
    RecordingError,
    RecordingWriter,
    WireCapture,
    convert,
    describe_recording,
    load,
    read_chunks,
    read_note,
    read_recording,
    recording_facts,
    recording_format,
)
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import X4Setting

TARGETS = ("a.mcap", "c.xtwire", "vendor")


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """Write a capture with commands, answers and data of several kinds by hand."""
    path = tmp_path / "port.xtwire"
    with WireCapture(path, {"port": "/dev/somewhere"}) as file:
        file.write("tx", bytes.fromhex("7D 01 AE EA AA EE 90 7E"), 1_000_000_001)
        file.write("rx", bytes.fromhex("7D 01 EA AE"), 1_000_000_002)
        file.write("rx", bytes.fromhex("EE AA 7C 7E"), 1_000_000_003)
        rf = struct.pack("<IIIff", 0, 7, 2, 0.25, -0.5)
        file.write("rx", b"\x7c" * 4 + struct.pack("<I", 22) + b"\0\xa0\x12" + rf, 1_000_000_004)
        iq = struct.pack("<II4f4f", 8, 2, 0.05, 2.3e10, 7.29e9, 0.4, 1, 2, 3, 4)
        header = b"\x7c" * 4 + struct.pack("<I", 45) + b"\0\x50\x0c\0\0\0"
        file.write("rx", header + iq, 1_000_000_005)
    return path


def test_a_capture_gives_messages_with_the_time_of_their_last_byte(capture: Path) -> None:
    messages = list(read_recording(capture))
    assert [t_ns for _, t_ns in messages] == [1_000_000_003, 1_000_000_004, 1_000_000_005]
    pong, rf, iq = (message for message, _ in messages)
    assert pong == m.Pong(value=0xAAEEAEEA)
    assert rf == m.DataFloat(info=7, values=np.array([0.25, -0.5], np.float32))
    assert isinstance(iq, m.BasebandIq)
    assert (iq.counter, iq.q.tolist()) == (8, [3.0, 4.0])


def test_a_capture_is_laid_out_as_documented(tmp_path: Path) -> None:
    with WireCapture(tmp_path / "x.xtwire") as file:
        file.write("tx", b"ab", 5)
        file.write("rx", b"c", None)
        file.write("rx", b"", 9)
    assert (tmp_path / "x.xtwire").read_bytes() == bytes.fromhex(
        "89 58 54 57 49 52 45 0A  01 00 00 00  02 00 00 00 7B 7D"
        "3E 05 00 00 00 00 00 00 00  02 00 00 00 61 62"
        "3C 00 00 00 00 00 00 00 80  01 00 00 00 63"
    )
    chunks = [(chunk.way, chunk.data, chunk.t_ns) for chunk in read_chunks(tmp_path / "x.xtwire")]
    assert chunks == [("tx", b"ab", 5), ("rx", b"c", None)]
    assert read_note(tmp_path / "x.xtwire") == {}


def test_a_capture_is_never_written_over(capture: Path) -> None:
    with pytest.raises(RecordingError):
        WireCapture(capture)


def test_damage_on_the_line_is_a_fault_with_the_offset_of_the_line(tmp_path: Path) -> None:
    with WireCapture(tmp_path / "x.xtwire") as file:
        file.write("rx", bytes.fromhex("7D 10 6D 7E FF FF 7D 10 6D 7E"), 5)
    found, faults = read_with_faults(tmp_path / "x.xtwire")
    assert found == [(m.Ack(), 5), (m.Ack(), 5)]
    assert [fault.offset for fault in faults] == [4]
    assert "on the line: bytes between packets" in faults[0].reason


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"\x89XTWIRE\n", "is cut"),
        (b"\x89XTWIRE\n" + struct.pack("<II", 2, 0), "of version 2, known is 1"),
        (b"\x89XTWIRE\n" + struct.pack("<II", 1, 9) + b"{}", "cut or damaged"),
        (b"\x89XTWIRE\n" + struct.pack("<II", 1, 2) + b"[]", "cut or damaged"),
    ],
)
def test_a_damaged_head_of_a_capture_is_named(tmp_path: Path, content: bytes, reason: str) -> None:
    (tmp_path / "x.xtwire").write_bytes(content)
    with pytest.raises(RecordingError, match=reason):
        list(read_recording(tmp_path / "x.xtwire"))


def test_a_chunk_that_claims_much_comes_in_pieces(tmp_path: Path) -> None:
    """A damaged length must not make the reader take the rest of a large file at once."""
    path = tmp_path / "a.xtwire"
    with WireCapture(path) as capture:
        capture.write("rx", bytes(3_000_000), 7)
    chunks = list(read_chunks(path))
    assert {(chunk.way, chunk.t_ns) for chunk in chunks} == {("rx", 7)}
    assert max(len(chunk.data) for chunk in chunks) == 1 << 20
    assert sum(len(chunk.data) for chunk in chunks) == 3_000_000


def test_a_chunk_that_is_none_ends_the_reading(capture: Path) -> None:
    whole = len(list(read_recording(capture)))
    capture.write_bytes(capture.read_bytes() + b"\x00" * 20)
    found, faults = read_with_faults(capture)
    assert len(found) == whole
    assert [fault.reason for fault in faults] == ["no chunk begins with byte 00"]


@pytest.mark.parametrize("name", ["iq", "float", "single"])
def test_vendor_recordings_survive_every_way_around(name: str, tmp_path: Path) -> None:
    """Each format in turn, then once more in the other order: nothing is lost at any step."""
    source = RECORDINGS / name
    expected = list(read_recording(source))
    facts = recording_facts(source)
    previous = source
    for number, target in enumerate((*TARGETS, *reversed(TARGETS))):
        path = tmp_path / f"{number}{target}"
        done = convert(previous, path)
        assert (done.messages, done.skipped, done.faults) == (40, {}, ())
        assert list(read_recording(path)) == expected
        assert recording_facts(path) == facts
        previous = path
    assert recording_format(previous) == "mcap"


def test_what_the_vendors_format_has_no_room_for_is_counted(capture: Path, tmp_path: Path) -> None:
    done = convert(capture, tmp_path / "vendor")
    assert (done.messages, done.skipped) == (2, {"PONG": 1})
    expected = [(message, 1_000_000_000) for message, _ in read_recording(capture)]
    assert list(read_recording(tmp_path / "vendor")) == expected[1:], "times have milliseconds"


@pytest.mark.parametrize("target", ["a.mcap", "c.xtwire"])
def test_unknown_times_stay_unknown(tmp_path: Path, target: str) -> None:
    source = tmp_path / "xethru_datafloat_20261121_003602.dat"
    whole = (RECORDINGS / "float" / source.name).read_bytes()
    source.write_bytes(whole)
    convert(source, tmp_path / target)
    found = list(read_recording(tmp_path / target))
    assert len(found) == 40
    assert {t_ns for _, t_ns in found} == {None}


def test_frames_of_several_sizes_survive(tmp_path: Path) -> None:
    messages: list[m.Response] = [
        frame(1, 3),
        frame(2, 0),
        m.PresenceSingle(counter=1, state=0, distance_m=1, direction=0, signal_quality=0),
        frame(3, 4),
        m.DataFloat(content_id=4, info=4, values=np.array([np.nan], np.float32)),
        m.DataByte(info=5, values=b"\x7d\x7e\x7f"),
        m.UnknownMessage(code=0x77, payload=b"\x77\x01"),
    ]
    source = tmp_path / "source.xtwire"
    expected = [(message, number) for number, message in enumerate(messages)]
    write_capture(source, expected)
    assert list(read_recording(source)) == expected
    convert(source, tmp_path / "a.mcap")
    assert list(read_recording(tmp_path / "a.mcap")) == expected


@pytest.mark.rare
def test_samples_are_not_held_in_memory(tmp_path: Path) -> None:
    n_frames, n_bins = 2000, 1000
    with RecordingWriter(tmp_path / "long") as writer:
        for counter in range(n_frames):
            writer.write(frame(counter, n_bins), counter * 1_000_000)
    for source, target in [("long", "x.mcap"), ("x.mcap", "y.xtwire"), ("long", "z.npz")]:
        tracemalloc.start()
        try:
            convert(tmp_path / source, tmp_path / target)
            _, peak = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
        assert peak < 4 * n_frames * n_bins / 2
    expected = list(read_recording(tmp_path / "long"))
    assert list(read_recording(tmp_path / "y.xtwire")) == expected
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["long", "x.mcap", "y.xtwire", "z.npz"]


def test_an_archive_of_messages_is_refused_in_one_line(tmp_path: Path) -> None:
    """Where its frames had one layout, it holds them as arrays, too."""
    path = tmp_path / "old.npz"
    arrays = {"format": "xethru-hil recording 1", "message_payload": np.zeros(5, np.uint8)}
    np.savez(path, **arrays)  # type: ignore[arg-type]  # of allow_pickle
    with pytest.raises(RecordingError, match=r"\.mcap"):
        _ = load(path).iq
    with pytest.raises(RecordingError, match=r"\.mcap"):
        list(read_recording(path))
    np.savez(path, **arrays, iq=np.ones((2, 3)))  # type: ignore[arg-type]  # as above
    np.testing.assert_array_equal(load(path).iq, np.ones((2, 3)))


ROS: Any = get_typestore(Stores.ROS2_HUMBLE)


def ros_messages(path: Path, *topics: str) -> Iterator[tuple[Any, Any, Any, Any]]:
    """Yield schema, channel, record and message of each, as rosbags reads it."""
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        for schema, channel, message in reader.iter_messages(topics or None):
            assert schema is not None
            yield schema, channel, message, ROS.deserialize_cdr(message.data, schema.name)


def test_an_independent_ros_reader_reads_the_frames(tmp_path: Path) -> None:
    """Topics, types and the counter's place are those of this project's sessions."""
    convert(RECORDINGS / "float", tmp_path / "f.mcap")
    frames = list(ros_messages(tmp_path / "f.mcap", "/radar/module/frame"))
    assert [message.sequence for _, _, message, _ in frames] == list(range(124, 164))
    expected = [message for message, _ in read_recording(RECORDINGS / "float")]
    for (schema, channel, message, array), told in zip(frames, expected, strict=True):
        assert isinstance(told, m.DataFloat)
        assert (schema.name, schema.encoding) == ("std_msgs/msg/Float32MultiArray", "ros2msg")
        assert channel.message_encoding == "cdr"
        np.testing.assert_array_equal(array.data, told.values)
        dimension = array.layout.dim[0]
        assert (dimension.label, dimension.size, dimension.stride) == ("range_bin", 94, 94)
        # byte for byte what the library that writes the sessions makes of it
        assert message.data == ROS.serialize_cdr(array, schema.name)
    ((_, _, _, info),) = ros_messages(tmp_path / "f.mcap", "/radar/module/info")
    facts = json.loads(info.data)
    # 94 bins of RF or 47 of baseband, and where: this recording does not tell
    assert (facts["n_bins"], facts["range_start_m"]) == (None, None)


def test_the_module_s_own_answers_say_where_the_bins_lie(tmp_path: Path) -> None:
    answers = [
        m.ReplyFloat(content_id=X4Setting.FRAMEAREA, values=(0.5, 0.75)),
        m.ReplyInt(content_id=X4Setting.FRAMEBINCOUNT, values=(10,)),
    ]
    write_capture(tmp_path / "x.xtwire", [(message, 1) for message in (*answers, frame(1, 10))])
    convert(tmp_path / "x.xtwire", tmp_path / "x.mcap")
    ((_, _, _, found),) = ros_messages(tmp_path / "x.mcap", "/radar/module/info")
    facts = json.loads(found.data)
    assert (facts["range_start_m"], facts["n_bins"]) == (0.5, 10)
    assert facts["bin_length_m"] == pytest.approx(0.025)
    assert facts["settings"] == {"FRAMEAREA": [0.5, 0.75], "FRAMEBINCOUNT": 10}


def test_the_definitions_in_the_file_are_those_of_ros(tmp_path: Path) -> None:
    convert(RECORDINGS / "single", tmp_path / "s.mcap")
    for schema, channel, _, found in ros_messages(tmp_path / "s.mcap"):
        text, _ = ROS.generate_msgdef(schema.name, ros_version=2)
        assert schema.data.decode().split() == text.split()
        if channel.topic == "/radar/module/message":
            assert json.loads(found.data)["message"] == "PRESENCE_SINGLE"
        else:
            assert (channel.topic, found.data[0]) == ("/radar/module/payload", 0x50)


@pytest.mark.parametrize("n_radars", [1, 2])
def test_a_session_of_one_radar_is_a_recording(n_radars: int, tmp_path: Path) -> None:
    poses = [format_tum_line(k * 200_000_000, np.zeros(3)) for k in range(2)]
    track = OdometryTrack.from_lines(poses)
    log = SessionLog(tmp_path / "s.mcap", session_info(n_radars), track)
    for counter in range(3):
        log.on_scan(scan(counter, n_radars))
    log.close()
    if n_radars == 2:
        with pytest.raises(RecordingError, match=r"several radars \(radar0, radar1\)"):
            describe_recording(tmp_path / "s.mcap")
        return
    sent = [scan(counter, 1).frames[0] for counter in range(3)]
    assert list(read_recording(tmp_path / "s.mcap")) == [
        (m.DataFloat(info=frame.counter, values=frame.samples), frame.t_ns) for frame in sent
    ]


def test_a_target_that_is_there_or_unknown_is_refused(tmp_path: Path) -> None:
    for target in ("a.mcap", "b.npz", "c.xtwire"):
        (tmp_path / target).write_bytes(b"mine")
        with pytest.raises(RecordingError):
            convert(RECORDINGS / "iq", tmp_path / target)
        assert (tmp_path / target).read_bytes() == b"mine"
    with pytest.raises(RecordingError, match=r"no format has the suffix \.wav"):
        convert(RECORDINGS / "iq", tmp_path / "x.wav")
    with RecordingWriter(tmp_path / "vendor"):
        pass
    convert(RECORDINGS / "iq", tmp_path / "vendor")
    with pytest.raises(RecordingError):
        convert(RECORDINGS / "iq", tmp_path / "vendor")


@pytest.mark.parametrize("target", [*TARGETS, "b.npz"])
def test_a_source_that_is_none_leaves_no_target(tmp_path: Path, target: str) -> None:
    with pytest.raises(RecordingError):
        convert(tmp_path / "nothing", tmp_path / target)
    assert not (tmp_path / target).exists()


def test_progress_is_reported(tmp_path: Path) -> None:
    told: list[int] = []
    convert(RECORDINGS / "iq", tmp_path / "x.npz", told.append)
    assert told == [40]
