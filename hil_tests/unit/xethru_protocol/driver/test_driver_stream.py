"""What bounds and checks a stream: queue, statistics, lattice, read-backs, rates, listeners."""

import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest

from hil_tests.unit.xethru_protocol.both_drivers import DriverOn, Scripted
from hil_tests.unit.xethru_protocol.machine import UartModule
from hil_tests.unit.xethru_protocol.scripted import (
    BYTE_SETTINGS,
    READY,
    PlainModule,
    ScriptedTransport,
    frame,
)
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import PongCode, X4Setting
from xethru_protocol.wire.errors import LocalProtocolError, RemoteProtocolError, ResponseTimeout
from xethru_protocol.wire.framing import FaultKind

Said = Sequence[m.Message | bytes]
QUANTUM, OFFSET = np.float32(2.03450526e-07), np.float32(0.07421875)  # Protocol reference 9.7


# --- queue --------------------------------------------------------------------------------------


def test_full_queue_drops_the_oldest_and_says_so_once_per_burst(driver_on: DriverOn) -> None:
    radar, line = driver_on(queue_frames=3)
    radar.configure_raw()
    line.say(*(frame(k) for k in range(8)))
    radar.ping()  # takes them all in
    assert [got.counter for got in radar.frames(3)] == [5, 6, 7]
    assert (radar.frames_dropped, radar.frames_lost) == (5, 0)
    assert radar.warnings == [
        "3 frames wait unread, so the oldest are dropped; read them faster or make the queue longer"
    ]
    line.say(*(frame(k) for k in range(8, 12)))
    radar.ping()
    assert radar.frames_dropped == 6
    assert len(radar.warnings) == 2  # another burst


def test_queue_that_is_never_empty_warns_once(driver_on: DriverOn) -> None:
    radar, line = driver_on(queue_frames=2)
    radar.configure_raw()
    for k in range(20):
        line.say(frame(3 * k), frame(3 * k + 1), frame(3 * k + 2))
        radar.ping()
        radar.read_frame()
    assert radar.frames_dropped == 39
    assert len(radar.warnings) == 1


def test_what_an_earlier_program_left_half_read_is_no_damage(driver_on: DriverOn) -> None:
    left = PlainModule()
    radar, line = driver_on(left)
    half = line.bytes_of(frame(7))[4000:]
    left.instead = {m.Ping(): [half, line.bytes_of(frame(8)), half, READY]}
    radar.ping()
    assert (radar.fault_count, radar.statistics.clean) == (0, True)
    assert radar.statistics.bytes == 9 + 14 + 4 * 1431 + len(line.bytes_of(READY))
    left.instead = {m.Ping(): [half, READY]}
    radar.ping()  # it is damage now
    faults = radar.fault_count, radar.statistics.junk_bytes
    assert faults[0] > 0
    assert faults[1] == len(half)
    left.instead = {m.ModReset(): [m.Ack(), half, m.System(code=0x10)]}
    radar.reset()
    radar.ping()
    assert (radar.fault_count, radar.statistics.junk_bytes) == faults
    line.say(half, frame(1))
    radar.ping()
    assert radar.fault_count > faults[0]


def test_queue_without_room_is_refused(driver_on: DriverOn) -> None:
    with pytest.raises(LocalProtocolError, match="needs room for a frame, not for 0"):
        driver_on(queue_frames=0)


def test_line_is_read_only_when_no_frame_waits(raw: Scripted) -> None:
    radar, line = raw
    line.say(frame(0), frame(1), frame(2))
    frames = radar.frames()
    next(frames)
    assert len(line.pending) == 2  # held back, not taken in and dropped


# --- statistics ---------------------------------------------------------------------------------


def test_statistics_count_what_came_and_what_was_wrong(driver_on: DriverOn) -> None:
    radar, line = driver_on()
    radar.ping()
    # Protocol reference 5: a PONG is 7D 01 u32 checksum 7E; here with a wrong checksum
    line.say(bytes.fromhex("7D 01 EA AE EE AA 00 7E"), frame(1), frame(4))
    radar.configure_raw()
    line.say(frame(1), frame(4))
    list(radar.frames(2))
    statistics = radar.statistics
    assert statistics.faults[FaultKind.CHECKSUM] == 1
    assert statistics.frames_lost == radar.frames_lost == 2
    assert statistics.packets > 20
    assert statistics.bytes > 4 * 5747


@pytest.mark.parametrize(
    "restarts",
    [
        lambda radar, line: radar.configure_raw(),
        lambda radar, line: radar.request(m.X4DriverInit()),
        lambda radar, line: radar.reset(),
        lambda radar, line: radar.request(m.X4DriverSet(setting=X4Setting.ENABLE, value=0)),
        lambda radar, line: radar.request(m.LoadApp(profile_id=0x014D4AB8)),
        lambda radar, line: line.say(m.System(code=0x10)),  # BOOTING: it restarted by itself
    ],
    ids=["configure_raw", "INIT", "reset", "ENABLE", "LOADAPP", "BOOTING"],
)
def test_stream_begins_wherever_the_counter_may_begin_anew(
    raw: Scripted, restarts: Callable[[X4M300, ScriptedTransport], object]
) -> None:
    """Protocol reference 6.1: the counter is cleared by the chip's start-up code."""
    radar, line = raw
    line.say(frame(1), frame(2))
    assert [got.stream for got in radar.frames(2)] == [0, 0]
    for stream in (1, 2):
        restarts(radar, line)
        # more than before, and yet another count
        line.say(frame(10 * stream), frame(10 * stream + 3))
        assert [got.stream for got in radar.frames(2)] == [stream, stream]
    assert radar.frames_lost == 4  # two in each of the new streams


def test_counter_that_goes_back_begins_a_stream_and_rates_do_not(raw: Scripted) -> None:
    radar, line = raw
    radar.start(17.0)
    line.say(frame(7), frame(8))
    assert [got.stream for got in radar.frames(2)] == [0, 0]
    radar.stop()
    radar.start(10.0)
    line.say(frame(9), frame(1), frame(2))
    assert [(got.counter, got.stream) for got in radar.frames(3)] == [(9, 0), (1, 1), (2, 1)]
    # neither a damaged counter nor a frame that came twice is a restart (17: XEP 2.1.3)
    line.say(frame(900), frame(4), frame(4))
    assert [got.stream for got in radar.frames(3)] == [1, 1, 1]
    assert radar.frames_lost == 0  # it was 3


def test_frames_before_configure_raw_are_reported(driver_on: DriverOn) -> None:
    radar, line = driver_on()
    for k in range(50):
        line.say_later(0.05 * k, frame(k))
    with pytest.raises(ResponseTimeout, match=r"1431 values come, but where their bins lie"):
        radar.read_frame()
    assert len(radar.warnings) == 1
    assert "call configure_raw()" in radar.warnings[0]
    assert radar.frames_discarded > 30
    line.timed.clear()
    radar.configure_raw()
    line.say(frame(99, bins=50))
    with pytest.raises(ResponseTimeout, match="frames of 50 values come, not of the 1431"):
        radar.read_frame(timeout_s=0.5)


def on_lattice(counter: int, counts: np.ndarray[tuple[int], np.dtype[np.uint32]]) -> m.DataFloat:
    return m.DataFloat(info=counter, values=counts.astype(np.float32) * QUANTUM - OFFSET)


def test_samples_no_counter_can_give_are_counted(driver_on: DriverOn) -> None:
    radar, line = driver_on()
    counts = np.linspace(0, 729_600, 1431).astype(np.uint32)
    whole, damaged = on_lattice(0, counts), on_lattice(1, counts)
    values = damaged.values.copy()
    values[[3, 700]] = np.nan, 0.08
    radar.configure_raw()
    line.say(whole)
    radar.read_frame()
    assert radar.statistics.off_lattice_samples == 0
    line.say(m.DataFloat(info=1, values=values))
    got = radar.read_frame().samples  # delivered all the same
    assert math.isnan(got[3])
    assert radar.statistics.off_lattice_samples == 2


def test_lattice_is_that_of_the_settings(driver_on: DriverOn) -> None:
    radar, line = driver_on()
    counts = np.arange(1431, dtype=np.uint32)
    radar.configure_raw(RawConfig(iterations=8, pulses_per_step=37))
    line.say(on_lattice(0, counts))
    radar.read_frame()
    off = radar.statistics.off_lattice_samples
    assert off > 1000
    line.say(on_lattice(1, counts), on_lattice(2, counts[::-1]))
    list(radar.frames(2))
    # of the frames behind a clear one only the first 128 samples are judged
    assert 64 < (radar.statistics.off_lattice_samples - off) / 2 <= 128


def test_sound_frame_behind_one_that_is_none_is_judged_in_full(driver_on: DriverOn) -> None:
    radar, line = driver_on()
    counts = np.linspace(0, 729_600, 1431).astype(np.uint32)
    radar.configure_raw()
    line.say(m.DataFloat(info=0, values=np.full(1431, 0.08, np.float32)))
    values = on_lattice(1, counts).values.copy()
    values[1430] = 0.08
    line.say(m.DataFloat(info=1, values=values), m.DataFloat(info=2, values=values))
    list(radar.frames(3))
    assert radar.statistics.off_lattice_samples == 1431 + 1 + 1


@pytest.mark.parametrize("damaged", [{}, {0: 1}, {4: 3}, {1: 1, 3: 1431, 4: 2}])
def test_frames_that_come_together_are_judged_one_by_one(
    driver_on: DriverOn, damaged: dict[int, int]
) -> None:
    """``damaged`` samples by frame; behind a clear frame the first 128 are judged (above)."""
    radar, line = driver_on()
    counts = np.linspace(0, 729_600, 1431).astype(np.uint32)
    radar.configure_raw()
    frames = []
    for counter in range(6):
        values = on_lattice(counter, counts).values.copy()
        values[: damaged.get(counter, 0)] = 0.08
        frames.append(line.bytes_of(m.DataFloat(info=counter, values=values)))
    line.say(b"".join(frames))
    assert radar.frames_waiting() == 6
    assert radar.statistics.off_lattice_samples == sum(damaged.values())


# --- configuring --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "setting",
    [
        X4Setting.DACMIN,
        X4Setting.DACMAX,
        X4Setting.DACSTEP,
        X4Setting.ITERATIONS,
        X4Setting.PULSESPERSTEP,
        X4Setting.PRFDIV,
        X4Setting.TXCENTERFREQUENCY,
        X4Setting.TXPOWER,
        X4Setting.DOWNCONVERSION,
        X4Setting.FRAMEAREAOFFSET,
    ],
    ids=lambda setting: setting.name,
)
def test_every_setting_is_read_back(driver_on: DriverOn, setting: X4Setting) -> None:
    other: m.Response = m.ReplyInt(content_id=setting, values=(123,))
    if setting is X4Setting.FRAMEAREAOFFSET:
        other = m.ReplyFloat(content_id=setting, values=(0.25,))
    elif setting in BYTE_SETTINGS:
        other = m.ReplyByte(content_id=setting, values=b"\x7b")
    radar, _ = driver_on(PlainModule(instead={m.X4DriverGet(setting=setting): [other]}))
    with pytest.raises(RemoteProtocolError, match=rf"reads back {setting.name} as (123|0\.25)"):
        radar.configure_raw(RawConfig(offset_m=0.18))


def test_frame_area_is_quantised_and_only_a_strange_one_is_a_warning(raw: Scripted) -> None:
    radar, _ = raw
    assert radar.warnings == []
    radar.configure_raw(RawConfig(frame_area_m=(0.4, 5.0)))  # the script answers 0.2 ... 9.4
    assert radar.warnings == [
        "the module made 1431 bins over 0.1993 ... 9.4007 m of the frame area, where 716 over "
        "0.3986 ... 5.0025 m were expected; its own values are used"
    ]


def test_step_and_divider_count_for_the_highest_rate() -> None:
    # Protocol reference 9.6: D PRF / (iterations pps (dac_max - dac_min + 1) / 2^step)
    config = RawConfig(dac_step=1, prf_div=8)
    assert config.fps_max == pytest.approx(0.95 * 243e6 / 8 / (16 * 300 * 152 / 2))
    for wrong in ({"dac_step": 4}, {"dac_step": -1}, {"prf_div": 3}, {"prf_div": 256}):
        with pytest.raises(LocalProtocolError, match=r"must be [04] \.\.\. (3|255)"):
            RawConfig(**wrong)  # type: ignore[arg-type] # both are integer fields


# --- rates of the line --------------------------------------------------------------------------


def test_rate_beyond_a_uart_is_a_warning(driver_on: DriverOn) -> None:
    radar, line = driver_on()
    radar._link.bytes_per_s = 11520.0  # 115200 baud; the table of Protocol reference 10 says 2.0
    radar.configure_raw()
    radar.start(2.0)
    assert radar.warnings == []
    radar.start(3.0)
    assert radar.warnings == [
        "3 frames/s of 5747 bytes are more than the 2.0 that 115200 baud carry; "
        "frames will be lost; set_baud_rate() makes the line faster"
    ]
    assert line.received[-2] == m.X4DriverSet(
        setting=X4Setting.FPS, value=3.0
    )  # tried all the same


def uart(
    driver_on: DriverOn, module: UartModule
) -> tuple[X4M300, ScriptedTransport, list[tuple[int, int]]]:
    """Return driver, line, and the rates this side changes to, with their times."""
    radar, line = driver_on(module)
    module.connect(line, 115200)
    changes: list[tuple[int, int]] = []

    def change(rate: int) -> None:
        changes.append((rate, line.now_ns))
        module._set_line_rate(rate)

    line.set_baudrate = change
    return radar, line, changes


def test_baud_rate_changes_on_both_sides(driver_on: DriverOn) -> None:
    """The module sleeps for 500 ms behind its ACK; a PING of that time would be lost (3)."""
    module = UartModule()
    radar, line, changes = uart(driver_on, module)
    radar.set_baud_rate(921600)
    asked = [type(command).__name__ for command in line.received]
    assert asked == ["SystemGetInfo", "SetBaudRate", "Ping"]
    ((rate, changed_ns),) = changes
    assert rate == 921600
    assert changed_ns == pytest.approx(100e6, abs=1e6)
    assert (module.baudrate, radar.warnings) == (921600, [])
    assert 500e6 <= line.now_ns < 700e6


def test_module_that_takes_its_time_to_change_its_rate_is_asked_again(driver_on: DriverOn) -> None:
    radar, line, changes = uart(driver_on, UartModule(takes_ns=1_700_000_000))
    radar.set_baud_rate(921600)
    assert [rate for rate, _ in changes] == [921600]
    assert 1.7e9 <= line.now_ns < 2.5e9
    assert radar.ping() is PongCode.XTS_SPRP_READY


def test_module_that_keeps_its_rate_is_talked_to_at_it(driver_on: DriverOn) -> None:
    radar, line, changes = uart(driver_on, UartModule(stubborn=True))
    with pytest.raises(ResponseTimeout, match="38400 baud and still answers at 115200; this side"):
        radar.set_baud_rate(38400)
    assert [rate for rate, _ in changes] == [38400, 115200]
    assert 2e9 < line.now_ns < 4e9
    assert (radar._link.baudrate, radar.ping()) == (115200, PongCode.XTS_SPRP_READY)


def test_module_that_answers_at_neither_rate_is_expected_at_the_new_one(
    driver_on: DriverOn,
) -> None:
    """It said it would change; going back would cut off one that only needs longer."""
    module = UartModule()
    radar, line, changes = uart(driver_on, module)
    radar.info()
    line.answer = lambda command: [m.Ack()] if isinstance(command, m.SetBaudRate) else []
    with pytest.raises(ResponseTimeout, match="neither at 38400 nor at 115200 baud; this side st"):
        radar.set_baud_rate(38400)
    assert [rate for rate, _ in changes] == [38400, 115200, 38400]
    assert radar._link.baudrate == 38400


def test_rates_no_module_lists_are_sent_only_when_forced(driver_on: DriverOn) -> None:
    radar, line = driver_on()
    with pytest.raises(LocalProtocolError, match=r"12345 .* 9600"):
        radar.set_baud_rate(12345)
    assert line.received == []
    radar.set_baud_rate(12345, force=True)
    assert line.received[1] == m.SetBaudRate(baudrate=12345)


# --- listeners ----------------------------------------------------------------------------------


def test_listener_hears_every_message_frames_included_before_they_are_queued(
    driver_on: DriverOn,
) -> None:
    radar, line = driver_on(queue_frames=1)
    heard: list[tuple[m.Response, int]] = []
    radar.listener = lambda message, t_ns: heard.append((message, t_ns))
    line.say(frame(1), m.System(code=0x11), b"junk", frame(2))
    radar.ping()
    assert [message for message, _ in heard] == [frame(1), m.System(code=0x11), frame(2), READY]
    stamps = [t_ns for _, t_ns in heard]
    assert stamps == sorted(stamps)
    assert len(set(stamps)) == 4


def test_raw_listener_hears_every_byte_both_ways(driver_on: DriverOn) -> None:
    radar, line = driver_on()
    heard: list[tuple[str, bytes, int]] = []
    radar.raw_listener = lambda direction, data, t_ns: heard.append((direction, data, t_ns))
    line.say(b"\x01\x02")
    radar.ping()
    assert [(direction, data.hex(" ")) for direction, data, _ in heard] == [
        ("rx", "01 02"),
        ("tx", "7d 01 ae ea aa ee 7c 7e"),  # Protocol reference 4.1, the nominal seed
        ("rx", "7d 01 ea ae ee aa 7c 7e"),
    ]
    assert heard[0][2] <= heard[1][2] < heard[2][2]
