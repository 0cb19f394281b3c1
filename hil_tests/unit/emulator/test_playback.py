"""What a module that plays a recording sends, when, and what it says of itself meanwhile."""

import shutil
import struct
import tracemalloc
from datetime import UTC
from pathlib import Path

import numpy as np
import pytest

from emulator.chip.chip import Chip
from emulator.loopback import LoopbackTransport
from emulator.module.outbox import LosslessOutbox
from emulator.module.state import Module
from emulator.playback import PlayStream, played_radars, schedule
from emulator.x4m300 import Device
from hil_tests.paths import FIXTURES
from hil_tests.unit.emulator.doubles import IDENTITY, BareHost, RampSource
from hil_tests.unit.xethru_protocol.scripted import framed
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.recordings import (
    RecordingError,
    RecordingWriter,
    WireCapture,
    convert,
    read_recording,
)
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import SensorMode, X4Setting

RECORDINGS = FIXTURES / "recordings"
SECOND = 1_000_000_000
RECORDS = [m.Pong(value=value) for value in range(5)]


def device_of(recording: Path, rate: float = 0, warnings: list[str] | None = None) -> Device:
    (radar,) = played_radars(
        recording,
        rate=rate,
        on_fault=lambda fault: pytest.fail(fault.reason),
        warn=lambda line: None if warnings is None else warnings.append(line),
    )
    return radar.device


def wire_bytes(device: Device) -> bytes:
    device.port_opened(0)
    device.advance(SECOND)
    packets = iter(lambda: device.next_packet(SECOND), None)
    return b"".join(packets)


def copy_of_the_vendors_recording(folder: Path) -> Path:
    return Path(shutil.copytree(RECORDINGS / "iq", folder / "recording"))


def test_a_recording_of_nothing_is_refused(tmp_path: Path) -> None:
    recording = copy_of_the_vendors_recording(tmp_path)
    next(recording.glob("*baseband_iq*.dat")).write_bytes(b"")
    with pytest.raises(RecordingError):
        played_radars(recording, rate=0, on_fault=lambda fault: None)


def test_radar_frames_come_byte_for_byte_without_escapes() -> None:
    data = (RECORDINGS / "float" / "xethru_datafloat_20261121_003602.dat").read_bytes()[4:]
    expected = b"".join(
        b"\x7c" * 4 + struct.pack("<I", 390) + b"\0\xa0\x12" + data[at : at + 388]
        for at in range(0, len(data), 388)
    )
    assert wire_bytes(device_of(RECORDINGS / "float")) == expected


def test_presence_comes_byte_for_byte_in_normal_framing() -> None:
    """The first line of the recording: 164;2;21.75;2;10."""
    payload = bytes.fromhex(
        "50 1E FA 3B 72  A4 00 00 00  02 00 00 00  00 00 AE 41  02  0A 00 00 00"
    )
    expected = framed(payload)
    played = wire_bytes(device_of(RECORDINGS / "single"))
    assert played.startswith(expected)
    assert len(played) == 40 * len(expected)


@pytest.mark.parametrize("target", ["x.mcap", "x.xtwire"])
@pytest.mark.parametrize("name", ["iq", "float", "single"])
def test_every_format_plays_the_same_bytes(name: str, target: str, tmp_path: Path) -> None:
    convert(RECORDINGS / name, tmp_path / target)
    assert wire_bytes(device_of(tmp_path / target)) == wire_bytes(device_of(RECORDINGS / name))


def test_messages_of_several_kinds_come_in_the_order_of_time(tmp_path: Path) -> None:
    frame = m.DataFloat(info=1, values=np.zeros(2, np.float32))
    presence = m.PresenceSingle(counter=9, state=1, distance_m=1.0, direction=0, signal_quality=3)
    written: list[m.Message] = [frame, presence, frame, presence]
    with RecordingWriter(tmp_path / "r", timezone=UTC) as writer:
        for number, message in enumerate(written):
            assert isinstance(message, m.Response)
            writer.write(message, number * SECOND)
    host = BareHost(device_of(tmp_path / "r", rate=1.0))
    host.device.port_opened(0)
    heard = [host.at(SECOND // 2 + number * SECOND) for number in range(4)]
    assert heard == [[message] for message in written]


def frames_read(recording: Path, config: RawConfig) -> tuple[list[np.ndarray], list[float]]:
    line = LoopbackTransport(device_of(recording))
    with X4M300(line, clock=line.clock_ns) as radar:
        geometry = radar.configure_raw(config)
        radar.start(20.0)
        frames = list(radar.frames(40, timeout_s=5.0))
    assert [frame.counter for frame in frames] == list(range(124, 164))
    return [frame.samples for frame in frames], [geometry.range_start_m, geometry.bin_length_m]


def test_a_host_that_configures_reads_the_recorded_frames() -> None:
    samples, (start_m, bin_m) = frames_read(RECORDINGS / "float", RawConfig())
    recorded = [message for message, _ in read_recording(RECORDINGS / "float")]
    for played, message in zip(samples, recorded, strict=True):
        assert isinstance(message, m.DataFloat)
        assert played.tobytes() == message.values.tobytes()
    assert start_m == pytest.approx(0.2, abs=0.004), "the recording does not tell: as requested"
    assert bin_m == pytest.approx(1.5e8 / 23.328e9, rel=1e-5)


def test_a_host_that_wants_baseband_gets_half_as_many_bins() -> None:
    samples, (_, bin_m) = frames_read(RECORDINGS / "float", RawConfig(downconversion=True))
    assert {len(played) for played in samples} == {47}
    assert samples[0].dtype == np.complex64
    assert bin_m == pytest.approx(8 * 1.5e8 / 23.328e9, rel=1e-5)


def test_a_warning_is_printed_if_the_place_of_the_frames_is_unknown() -> None:
    warnings: list[str] = []
    device_of(RECORDINGS / "float", warnings=warnings)
    assert len(warnings) == 1
    assert "does not say where its radar frames lie" in warnings[0]
    device_of(RECORDINGS / "iq", warnings=warnings)
    assert len(warnings) == 1, "baseband messages say it themselves"


@pytest.fixture
def raw_capture(tmp_path: Path) -> Path:
    """Commands, their answers (FRAMEAREA 0.5 ... 0.75 among them), and two frames of 39 bins."""
    path = tmp_path / "raw.xtwire"
    area = struct.pack("<IIIff", X4Setting.FRAMEAREA, 0, 2, 0.5, 0.75)
    with WireCapture(path) as capture:
        capture.write("tx", bytes.fromhex("7D 01 AE EA AA EE 90 7E"), 0)
        capture.write("rx", bytes.fromhex("7D 10 6D 7E"), 1)
        capture.write("rx", framed(b"\x11\x12" + area + b"\4"), 2)
        for counter in range(2):
            body = b"\xa0\x12" + struct.pack("<III", 0, counter, 39) + bytes(4 * 39)
            capture.write("rx", b"\x7c" * 4 + struct.pack("<I", len(body)) + b"\0" + body, 3)
    return path


def test_recorded_answers_are_not_played_but_their_area_is_read_back(raw_capture: Path) -> None:
    warnings: list[str] = []
    host = BareHost(device_of(raw_capture, warnings=warnings))
    assert warnings == []
    host.device.port_opened(0)
    area = host.ask(m.X4DriverGet(setting=X4Setting.FRAMEAREA))
    assert isinstance(area, m.ReplyFloat)
    assert area.values == (0.5, 0.75)
    assert host.ask(m.X4DriverGet(setting=X4Setting.FRAMEBINCOUNT)) == m.ReplyInt(
        content_id=X4Setting.FRAMEBINCOUNT, values=(39,)
    )
    assert [type(message) for message in host.at(SECOND)] == [m.DataFloat, m.DataFloat]


def test_a_recording_of_answers_only_is_refused(tmp_path: Path) -> None:
    with WireCapture(tmp_path / "x.xtwire") as capture:
        capture.write("rx", bytes.fromhex("7D 10 6D 7E"), 1)
    with pytest.raises(RecordingError):
        device_of(tmp_path / "x.xtwire")


@pytest.mark.parametrize("rate", [1e-300, 1e-9, 5e-324])
def test_a_rate_that_takes_for_ever_is_refused_in_one_line(rate: float) -> None:
    with pytest.raises(RecordingError, match="would play for more than 20 days"):
        device_of(RECORDINGS / "iq", rate=rate)


def test_a_recording_is_not_held_in_memory(tmp_path: Path) -> None:
    n_frames, n_bins = 2000, 1000
    with RecordingWriter(tmp_path / "long") as writer:
        for counter in range(n_frames):
            writer.write(m.DataFloat(info=counter, values=np.ones(n_bins, np.float32)), 0)
    tracemalloc.start()
    try:
        device = device_of(tmp_path / "long")
        device.port_opened(0)
        device.advance(SECOND)
        played = sum(len(packet) for packet in iter(lambda: device.next_packet(SECOND), None))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert played == n_frames * (9 + 14 + 4 * n_bins)
    assert peak < played / 4


def test_a_recording_that_is_gone_is_a_warning_and_the_module_answers_on(tmp_path: Path) -> None:
    recording = copy_of_the_vendors_recording(tmp_path)
    warnings: list[str] = []
    device = device_of(recording, warnings=warnings)
    shutil.rmtree(recording)
    assert wire_bytes(device) == b""
    assert [str(recording) in line for line in warnings] == [True]
    host = BareHost(device)
    assert host.ask(m.Ping()) == m.Pong(value=0xAAEEAEEA)


def test_any_high_rate_plays() -> None:
    assert wire_bytes(device_of(RECORDINGS / "iq", rate=1e300)) == wire_bytes(
        device_of(RECORDINGS / "iq")
    )


def player(rate: float = 1.0, gap_ns: int | None = None) -> BareHost:
    stamps = [10 * SECOND + index * SECOND for index in range(5)]
    timed = tuple(schedule(zip(RECORDS, stamps, strict=True)))
    stream = PlayStream(timed, loop_gap_ns=gap_ns, rate=rate)
    module = Module(IDENTITY, Chip(RampSource()))
    return BareHost(Device(module, stream, LosslessOutbox()))


def test_a_listening_host_hears_everything_half_a_second_after_opening() -> None:
    host = player()
    assert host.at(SECOND) == []
    host.device.port_opened(SECOND)
    assert host.at(SECOND * 3 // 2 - 1) == []
    assert host.device.wake_ns(host.now_ns) == SECOND * 3 // 2
    heard = [host.at(SECOND * 3 // 2 + index * SECOND) for index in range(5)]
    assert heard == [[record] for record in RECORDS]
    assert host.device.wake_ns(host.now_ns) is None


@pytest.mark.parametrize(
    "start",
    [
        m.X4DriverSet(setting=X4Setting.FPS, value=17.0),
        m.SetMode(mode=SensorMode.XTID_SM_RUN),
    ],
)
def test_a_host_that_starts_the_radar_hears_it_at_once(start: m.Command[m.Response]) -> None:
    host = player()
    host.device.port_opened(0)
    host.send(start)
    assert host.hear() == [m.Ack(), RECORDS[0]]


def test_commands_postpone_and_never_stop_it() -> None:
    host = player()
    host.device.port_opened(0)
    host.now_ns = SECOND * 4 // 10
    host.ask(m.Ping())
    assert host.at(SECOND * 8 // 10) == []
    assert host.at(SECOND * 9 // 10) == [RECORDS[0]]
    assert host.ask(m.X4DriverSet(setting=X4Setting.FPS, value=0.0)) == m.Ack()
    assert host.at(SECOND * 19 // 10) == [RECORDS[1]]


def test_every_host_hears_it_from_the_beginning_at_rate_0_at_once() -> None:
    host = player(rate=0)
    for opening_ns in (0, 5 * SECOND):
        host.device.port_opened(opening_ns)
        assert host.at(opening_ns + SECOND // 2) == RECORDS
        host.device.port_closed(opening_ns + SECOND)
        assert host.at(opening_ns + 2 * SECOND) == []


def test_a_quick_visitor_does_not_start_it() -> None:
    host = player()
    host.device.port_opened(0)
    host.ask(m.GetMode())
    host.device.port_closed(SECOND // 10)
    assert host.at(10 * SECOND) == []


def test_a_slow_reader_makes_it_wait() -> None:
    host = player()
    host.device.port_opened(0)
    host.now_ns = 100 * SECOND
    assert host.hear(2) == RECORDS[:2]
    assert host.ask(m.Ping()) == m.Pong(value=0xAAEEAEEA), "no queue of records to wait behind"
    assert host.hear() == RECORDS[2:]


def test_a_loop_goes_on() -> None:
    host = player(gap_ns=SECOND)
    host.device.port_opened(0)
    assert host.at(SECOND // 2 + 4 * SECOND) == RECORDS
    assert host.at(SECOND // 2 + 5 * SECOND - 1) == []
    assert host.at(SECOND // 2 + 9 * SECOND) == RECORDS


def test_records_without_time_come_at_the_nominal_rate() -> None:
    times = [item.time_ns for item in schedule([(record, None) for record in RECORDS])]
    assert times == pytest.approx([index * SECOND / 17 for index in range(5)], abs=2)


def test_time_that_runs_backwards_is_not_waited_for() -> None:
    stamps = [5, 9, 3, 4, None]
    times = [item.time_ns for item in schedule(zip(RECORDS, stamps, strict=True))]
    assert times == [0, 4, 4, 5, 5 + SECOND // 17]
