"""What each control does to a playback, to the nanosecond, and to sessions of several radars."""

import json
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

from emulator.loopback import LoopbackTransport
from emulator.module.outbox import LosslessOutbox
from emulator.playback import (
    NOMINAL_PERIOD_NS,
    QUIET_NS,
    PlayedRadar,
    PlayStream,
    played_radars,
    schedule,
)
from hil_tests.unit.emulator.doubles import BareHost
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.recordings import RecordingError, read_recording
from xethru_protocol.recordings.formats import recording_content
from xethru_protocol.recordings.mcap import FLOAT_ARRAY, pack_array, pack_string
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import InfoItem, X4Setting
from xethru_protocol.wire.connection import Connection, Role

SECOND = 1_000_000_000
RECORDS = [m.DataString(content_id=0, info=second, text="") for second in range(5)]


class Played:
    """Five messages a second apart, begun at device time 0 by a host that reads at once."""

    def __init__(self, **settings: object) -> None:
        timed = tuple(schedule([(item, item.info * SECOND) for item in RECORDS]))
        self.stream = PlayStream(timed, **settings)  # type: ignore[arg-type] # the caller knows
        self.stream.port_opened(-QUIET_NS)
        self.outbox = LosslessOutbox()

    def at(self, now_s: float) -> list[int]:
        """Numbers of the messages that came by a time."""
        now_ns = round(now_s * SECOND)
        heard: list[int] = []
        while True:
            self.outbox.refill_on_demand(self.stream, now_ns)
            message = self.outbox.take(now_ns)
            if message is None:
                return heard
            assert isinstance(message, m.DataString)
            heard.append(message.info)


def s(seconds: float) -> int:
    return round(seconds * SECOND)


def test_a_pause_shifts_what_follows_by_its_length() -> None:
    played = Played()
    assert played.at(1.25) == [0, 1]
    played.stream.pause(s(1.25))
    assert played.stream.next_due_ns() is None
    assert played.at(100) == []
    played.stream.resume(s(101))
    assert played.stream.next_due_ns() == s(101.75)
    played.stream.resume(s(101.5))  # goes on already
    assert played.stream.next_due_ns() == s(101.75)


def test_a_pause_holds_back_even_what_was_due() -> None:
    played = Played()
    played.stream.pause(s(3.5))  # nobody has read anything until now
    assert played.at(10) == []
    played.stream.resume(s(10))
    assert played.at(10) == [0, 1, 2, 3]
    assert played.at(10.5) == [4]


def test_a_rate_counts_from_where_it_was_set() -> None:
    played = Played()
    assert played.at(0.5) == [0]
    played.stream.set_rate(2.0, s(0.5))
    assert played.stream.next_due_ns() == s(0.75)
    assert played.at(0.75) == [1]
    played.stream.set_rate(0.5, s(1.0))
    assert played.stream.next_due_ns() == s(2.0)
    played.stream.set_rate(0.0, s(1.5))
    assert played.at(1.5) == [2, 3, 4]


def test_after_rate_0_the_time_of_the_last_message_counts() -> None:
    played = Played(rate=0.0)
    assert played.at(0.0) == [0, 1, 2, 3, 4]
    played = Played(rate=0.0)
    played.outbox.refill_on_demand(played.stream, 0)
    played.stream.set_rate(1.0, s(7.0))
    assert played.stream.next_due_ns() == s(8.0)


@pytest.mark.parametrize("rate", [-1.0, 1e-9, float("inf"), float("nan")])
def test_an_impossible_rate_is_refused_and_changes_nothing(rate: float) -> None:
    played = Played()
    with pytest.raises(ValueError, match="neither 0 nor"):
        played.stream.set_rate(rate, 0)
    assert played.stream.state(0)["rate"] == 1.0


def test_a_seek_goes_anywhere_and_keeps_the_time_up_to_the_next_message() -> None:
    played = Played()
    assert played.at(0.0) == [0]
    played.stream.seek(s(2.75), s(0.5))
    assert played.stream.next_due_ns() == s(0.75)
    assert played.at(0.75) == [3]
    played.stream.seek(s(1.0), s(1.0))
    assert played.at(1.0) == [1]
    played.stream.seek(s(99), s(1.5))
    assert played.at(100) == []
    assert not played.stream.state(s(100))["playing"]
    played.stream.seek(0, s(200))
    assert played.at(204) == [0, 1, 2, 3, 4]
    with pytest.raises(ValueError, match="begins at 0 s"):
        played.stream.seek(-1, 0)


def test_a_seek_without_a_host_is_where_the_next_one_begins() -> None:
    played = Played()
    played.stream.port_closed(0)
    played.stream.seek(s(3), 0)
    for expected in ([3, 4], [0, 1, 2, 3, 4]):
        played.stream.port_opened(-QUIET_NS)
        assert played.at(10) == expected
        played.stream.port_closed(s(10))


def test_a_seek_past_the_end_of_a_loop_is_followed_by_the_next_round() -> None:
    played = Played(loop_gap_ns=SECOND)
    played.stream.seek(s(99), s(0.5))
    assert played.stream.next_due_ns() == s(1.5)
    assert played.at(1.5) == [0]


def test_a_loop_is_turned_on_and_off() -> None:
    played = Played()
    assert played.at(4) == [0, 1, 2, 3, 4]
    played.stream.set_loop(True, s(50))
    assert played.at(52) == [0, 1, 2]
    assert played.at(54) == [3, 4]
    assert played.stream.next_due_ns() == s(54) + NOMINAL_PERIOD_NS
    played.stream.set_loop(False, s(54))
    assert played.stream.next_due_ns() is None
    assert played.at(100) == []


def test_a_start_command_ends_the_wait_of_a_paused_host_too() -> None:
    played = Played()
    played.stream.port_opened(0)
    played.stream.pause(s(0.1))
    played.stream.command_done(m.X4DriverSet(setting=X4Setting.FPS, value=17.0), s(0.2))
    assert played.at(5) == []
    played.stream.resume(s(6))
    assert played.at(6) == [0]


def write_session(path: Path, starts_ns: dict[str, int], n_frames: int = 6) -> None:
    """Radars of a session, each with frames of its own; the second begins later."""
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=2000)
        writer.start()
        channels = {}
        for number, name in enumerate(starts_ns):
            info = {
                "serial": f"20261121000{number}",
                "range_start_m": 0.25 + number,
                "bin_length_m": 1.5e8 / 23.328e9,
                "n_bins": 4,
            }
            channels[name] = writer.register_channel(f"/radar/{name}/frame", "cdr", 0)
            about = writer.register_channel(f"/radar/{name}/info", "cdr", 0)
            writer.add_message(about, 0, pack_string(json.dumps(info)), 0)
        for counter in range(n_frames):
            for number, (name, start_ns) in enumerate(starts_ns.items()):
                t_ns = start_ns + counter * SECOND
                data = pack_array(FLOAT_ARRAY, samples(number, counter))
                writer.add_message(channels[name], t_ns, data, t_ns, counter)
        writer.finish()  # type: ignore[no-untyped-call]  # mcap annotates in part


def samples(radar: int, counter: int) -> np.ndarray:
    return np.array([radar, counter, -1.5, 1 / 3], np.float32)


def session(
    tmp_path: Path,
    starts_ns: dict[str, int] | None = None,
    *,
    rate: float = 1.0,
    loop: bool = False,
) -> dict[str, PlayedRadar]:
    path = tmp_path / "session.mcap"
    write_session(path, starts_ns or {"left": 10 * SECOND, "right": 10 * SECOND + SECOND // 4})
    played = played_radars(
        path, rate=rate, loop=loop, on_fault=lambda fault: pytest.fail(fault.reason)
    )
    return {radar.name: radar for radar in played}


def test_every_radar_of_a_session_plays_its_own_bytes(tmp_path: Path) -> None:
    radars = session(tmp_path, rate=0)
    assert list(radars) == ["left", "right"]
    for number, radar in enumerate(radars.values()):
        module = Connection(Role.MODULE)
        line = LoopbackTransport(radar.device)
        sent = b"".join(iter(lambda line=line: line.read(10.0), b""))  # type: ignore[misc] # mypy has no type for it
        assert sent == b"".join(
            module.send(m.DataFloat(info=counter, values=samples(number, counter)))
            for counter in range(6)
        )


def test_every_radar_of_a_session_says_who_it_is_and_where_its_bins_lie(tmp_path: Path) -> None:
    for number, radar in enumerate(session(tmp_path).values()):
        line = LoopbackTransport(radar.device)
        with X4M300(line, clock=line.clock_ns) as driver:
            geometry = driver.configure_raw(RawConfig())
            serial = driver.request(m.SystemGetInfo(item=InfoItem.XTID_SSIC_SERIALNUMBER)).text
        assert serial == radar.serial == f"20261121000{number}"
        assert geometry.range_start_m == pytest.approx(0.25 + number)
        assert geometry.n_bins == 4
        assert geometry.bin_length_m == pytest.approx(1.5e8 / 23.328e9, rel=1e-5)


def test_radars_of_a_session_keep_their_time_in_every_round(tmp_path: Path) -> None:
    radars = session(tmp_path, loop=True)
    for offset_ns, radar in zip((0, SECOND // 4), radars.values(), strict=True):
        radar.stream.port_opened(-QUIET_NS)
        dues = []
        for _ in range(18):
            due_ns = radar.stream.next_due_ns()
            assert due_ns is not None
            dues.append(due_ns)
            radar.stream.take()
        round_ns = 5 * SECOND + SECOND // 4 + NOMINAL_PERIOD_NS
        assert dues == [
            turn * round_ns + counter * SECOND + offset_ns
            for turn in range(3)
            for counter in range(6)
        ]


def test_a_seek_means_the_same_time_in_all_radars(tmp_path: Path) -> None:
    for radar in session(tmp_path).values():
        host = BareHost(radar.device)
        radar.device.port_opened(-QUIET_NS)
        radar.stream.seek(2 * SECOND, 0)
        host.now_ns = SECOND // 4
        (frame,) = host.frames(5)
        assert frame.info == 2


@pytest.mark.parametrize("name", ["..", ".hidden", "a\0b", "x" * 100])
def test_a_name_that_would_be_a_strange_file_is_not_used(name: str, tmp_path: Path) -> None:
    radars = session(tmp_path, {"left": 0, name: 0})
    assert list(radars) == ["radar0", "radar1"]


def test_one_radar_of_a_session_is_read_by_its_name(tmp_path: Path) -> None:
    session(tmp_path)
    path = tmp_path / "session.mcap"
    assert list(recording_content(path).radars) == ["left", "right"]
    read = list(read_recording(path, radar="right"))
    assert [message for message, _ in read] == [
        m.DataFloat(info=counter, values=samples(1, counter)) for counter in range(6)
    ]
    with pytest.raises(RecordingError, match='holds no radar "middle"; it holds left, right'):
        list(read_recording(path, radar="middle"))


def test_an_info_that_makes_no_sense_costs_only_itself(tmp_path: Path) -> None:
    with (tmp_path / "x.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        about = writer.register_channel("/radar/a/info", "cdr", 0)
        frames = writer.register_channel("/radar/a/frame", "cdr", 0)
        for data in (b"", pack_string("["), pack_string("[]"), pack_string('{"n_bins": null}')):
            writer.add_message(about, 0, data, 0)
        writer.add_message(frames, 0, pack_array(FLOAT_ARRAY, samples(0, 0)), 0)
        writer.finish()  # type: ignore[no-untyped-call]  # mcap annotates in part
    warned: list[str] = []
    (radar,) = played_radars(
        tmp_path / "x.mcap", on_fault=lambda fault: pytest.fail(fault.reason), warn=warned.append
    )
    assert radar.serial == "0" * 12
    (line,) = warned
    assert "does not say where its radar frames lie" in line
