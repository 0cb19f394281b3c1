"""What bounds and checks a stream: queue, statistics, lattice, read-backs, rates, listeners."""

import math
from collections.abc import Sequence

import numpy as np
import pytest

from hil_tests.unit.xethru_protocol.both_drivers import DriverOn, Scripted
from hil_tests.unit.xethru_protocol.scripted import BYTE_SETTINGS, READY, PlainModule, frame
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import X4Setting
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
    assert radar.statistics.off_lattice_samples > 1000


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


def test_baud_rate_changes_on_both_sides_with_the_vendors_pauses(driver_on: DriverOn) -> None:
    plain = PlainModule()
    changes: list[tuple[int, int]] = []
    asked: list[tuple[str, int]] = []

    def module(command: m.Message) -> Said:
        asked.append((type(command).__name__, line.now_ns))
        return plain(command)

    radar, line = driver_on(module)
    line.set_baudrate = lambda rate: changes.append((rate, line.now_ns))
    radar.set_baud_rate(921600)
    assert line.received[0] == m.SetBaudRate(baudrate=921600)
    (rate, changed_ns), (last, pinged_ns) = changes[0], asked[-1]
    assert rate == 921600
    assert changed_ns - asked[0][1] == pytest.approx(100e6, abs=1e6)
    assert last == "Ping"
    assert pinged_ns - changed_ns == pytest.approx(400e6, abs=1e6)


def test_module_that_is_silent_at_the_new_rate_is_talked_to_at_the_old_one(
    driver_on: DriverOn,
) -> None:
    changes: list[int] = []
    radar, line = driver_on(lambda c: [m.Ack()] if isinstance(c, m.SetBaudRate) else [])
    line.set_baudrate = changes.append
    with pytest.raises(ResponseTimeout, match="not answer at 38400 baud; this side is back at 115"):
        radar.set_baud_rate(38400)
    assert changes == [38400, 115200]


def test_rates_no_module_lists_are_sent_only_when_forced(driver_on: DriverOn) -> None:
    radar, line = driver_on()
    with pytest.raises(LocalProtocolError, match="12345 baud is no rate of a module; it has 9600"):
        radar.set_baud_rate(12345)
    assert line.received == []
    radar.set_baud_rate(12345, force=True)
    assert line.received[0] == m.SetBaudRate(baudrate=12345)


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
