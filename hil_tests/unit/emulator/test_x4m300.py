"""The module's answers, modes, reset and streaming, driven with a virtual clock."""

import re
from typing import TypeGuard

import pytest

from emulator.chip import Pace
from emulator.chip.chip import ModuleClock
from emulator.module.memory import Identity
from emulator.module.outbox import StreamBegin
from emulator.module.settings import DeviceOptions
from emulator.x4m300 import radar_device
from hil_tests.unit.emulator.doubles import (
    IDENTITY,
    BareHost,
    FormulaSource,
    RampSource,
    ramp_device,
    working_point,
)
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import SensorMode, X4Setting
from xethru_protocol.wire.connection import Connection, Role

SECOND = 1_000_000_000
PRESENCE_2 = 0x014D4AB8


def is_frame(message: m.Message) -> TypeGuard[m.DataFloat]:
    return isinstance(message, m.DataFloat)


def mode_of(host: BareHost) -> int:
    reply = host.ask(m.GetMode())
    assert isinstance(reply, m.ReplyByte)
    return reply.values[0]


def test_a_stock_module_powers_up_with_its_profile_running(host: BareHost) -> None:
    """Protocol reference 8.2."""
    assert host.ask(m.Ping(seed=0x12345678)) == m.Pong(value=0xAAEEAEEA)
    assert mode_of(host) == 0x01
    # REPLY INT is signed; the id is below 2**31
    assert host.ask(m.GetProfileId()) == m.ReplyInt(values=(PRESENCE_2,))


@pytest.mark.parametrize("mode", [0x10, 0x77])
@pytest.mark.parametrize("param", [None, 0])
def test_unknown_modes_are_refused(host: BareHost, mode: int, param: int | None) -> None:
    assert host.ask(m.SetMode(mode=mode, param=param)) == m.Error(code=1)
    assert mode_of(host) == 0x01


@pytest.mark.parametrize("payload", ["EE", "A0", "51", "90 55", "90 59 00", "50 14", "20", "90 58"])
def test_unknown_and_cut_commands_get_error_1(host: BareHost, payload: str) -> None:
    data = bytes.fromhex(payload)
    assert host.ask(m.UnknownMessage(code=data[0], payload=data)) == m.Error(code=1)
    assert mode_of(host) == 0x01


def test_info_items_of_the_sensor_firmware(host: BareHost) -> None:
    """Protocol reference 4.10."""
    texts = {}
    for item in range(0x0A):
        reply = host.ask(m.SystemGetInfo(item=item))
        if item == 0x05:
            assert reply == m.Error(code=1)
            continue
        assert isinstance(reply, m.ReplyString)
        assert (reply.content_id, reply.info) == (0x58, item)
        texts[item] = reply.text
    assert texts[0x01] == "X4M300"
    assert texts[0x06] == IDENTITY.serial
    assert len(texts[0x06]) == 12
    assert texts[0x04].startswith(texts[0x03] + "+")
    assert len(texts[0x04].split(".sha.")[1]) == 40
    assert re.fullmatch(r"Annapurna:1\.6\.8;XEP:3\.4\.8;X4C51:[\d.]+[;:]\w+:[\d.]+", texts[0x07])
    assert host.ask(m.SystemGetInfo(item=0x0A)) == m.Error(code=1)


@pytest.mark.parametrize("serial", ["12345678901", "1234567890123", "12345678901x", "1²3456789012"])
def test_a_serial_number_has_12_digits(serial: str) -> None:
    with pytest.raises(ValueError, match="12 digits"):
        Identity(serial=serial)


def test_getters_answer_in_the_documented_types(host: BareHost) -> None:
    """Protocol reference 4.9, last column."""
    names = {
        m.ReplyByte: {"DOWNCONVERSION", "DACSTEP", "TXCENTERFREQUENCY", "TXPOWER", "PRFDIV"},
        m.ReplyFloat: {"FPS", "FRAMEAREA", "FRAMEAREAOFFSET"},
        m.ReplyInt: {"PULSESPERSTEP", "ITERATIONS", "DACMIN", "DACMAX", "FRAMEBINCOUNT"},
    }
    for setting in X4Setting:
        address = 4 if setting.name.endswith("REGISTER") else None
        reply = host.ask(m.X4DriverGet(setting=setting, address=address))
        if setting.name == "ENABLE":
            assert reply == m.Error(code=1)
            continue
        assert isinstance(reply, m.ReplyByte | m.ReplyFloat | m.ReplyInt)
        assert setting.name in names[type(reply)] or (address and isinstance(reply, m.ReplyByte))
        assert (reply.content_id, reply.info) == (setting, 0)
        assert len(reply.values) == (2 if setting.name == "FRAMEAREA" else 1)


def test_one_byte_pulses_and_dac_step_are_understood(host: BareHost) -> None:
    """Protocol reference 11, rows 1 and 3: `7D 50 10 11 00 00 00 14 38 7E` and the host's form."""
    for hexadecimal in ("7D 50 10 11 00 00 00 14 38 7E", "7D 50 10 15 00 00 00 00 28 7E"):
        host.device.receive_data(bytes.fromhex(hexadecimal), 0)
        assert host.hear() == [m.Ack()]
    pulses = host.ask(m.X4DriverGet(setting=X4Setting.PULSESPERSTEP))
    assert isinstance(pulses, m.ReplyInt)
    assert pulses.values == (20,)


def test_extra_bytes_are_ignored(host: BareHost) -> None:
    assert host.ask(m.UnknownMessage(code=0x26, payload=b"\x26\x01\x02")) == m.ReplyByte(
        values=b"\x01"
    )


def test_a_burst_goes_to_one_register(host: BareHost) -> None:
    """4.9, SPI bursts: the address is sent once, and every byte belongs to it."""
    assert host.ask(m.X4DriverWrite(address=0x14, values=b"\x01\x02\x03")) == m.Ack()
    reply = host.ask(m.X4DriverRead(address=0x14, length=4))
    assert reply == m.ReplyByte(content_id=0x22, values=b"\x03\x03\x03\x03")
    reply = host.ask(m.X4DriverRead(address=0x15, length=2))
    assert reply == m.ReplyByte(content_id=0x22, values=b"\x00\x00")
    reply = host.ask(m.X4DriverRead(address=0x01, length=6175))
    assert reply == m.ReplyByte(content_id=0x22, values=b"\xff" * 6175)
    assert host.ask(m.X4DriverWrite(address=0x14, values=bytes(6174))) == m.Ack()
    assert host.ask(m.X4DriverRead(address=5, length=1 << 31)) == m.Error(code=0x21)


@pytest.mark.parametrize(
    "burst",
    [m.X4DriverRead(address=5, length=6176), m.X4DriverWrite(address=5, values=bytes(6175))],
)
def test_a_burst_that_is_too_long_ends_the_frames_until_reset(
    host: BareHost, burst: m.Command[m.Response]
) -> None:
    """4.9: error 11, and the driver's lock is never given back; commands still work."""
    host.stream()
    assert host.hear(3)
    assert host.ask(burst) == m.Error(code=11)
    host.set(X4Setting.FPS, 17.0)
    assert host.hear() == []
    assert host.ask(m.X4DriverInit()) == m.Ack()
    host.set(X4Setting.FPS, 17.0)
    assert host.hear() == []
    host.command(m.ModReset())
    host.at(SECOND)
    assert host.at(3 * SECOND) == [m.System(code=0x10), m.System(code=0x11)]
    host.stream()
    assert host.hear(1)


def test_frames_flow_in_manual_mode_only(host: BareHost) -> None:
    host.ask(m.SetMode(mode=SensorMode.XTID_SM_STOP))
    host.set(X4Setting.FPS, 17.0)
    assert host.hear() == []
    assert host.ask(m.SetMode(mode=SensorMode.XTID_SM_MANUAL)) == m.Ack()
    assert [frame.info for frame in host.frames(3)] == [1, 2, 3]
    host.send(m.SetMode(mode=SensorMode.XTID_SM_STOP))
    assert host.hear() == [m.Ack()]


def test_a_reply_waits_behind_no_frame_and_no_frame_follows_a_stop(host: BareHost) -> None:
    host.stream()
    assert len(host.frames(10)) == 10
    assert host.ask(m.Ping()) == m.Pong(value=0xAAEEAEEA)
    host.send(m.X4DriverSet(setting=X4Setting.FPS, value=0.0))
    assert host.hear() == [m.Ack()]


def test_a_pause_continues_the_counter_and_init_resets_it(host: BareHost) -> None:
    """Protocol reference 6.1: sweeps are counted, the first after INIT is 1."""
    host.stream()
    host.frames(5)
    host.set(X4Setting.FPS, 0.0)
    host.set(X4Setting.FPS, 17.0)
    assert [frame.info for frame in host.frames(2)] == [6, 7]
    host.ask(m.X4DriverInit())
    assert host.hear() == [], "INIT stops the stream"
    host.set(X4Setting.FPS, 17.0)
    assert [frame.info for frame in host.frames(1)] == [1]


def test_scene_time_continues_in_segments_over_a_rate_change() -> None:
    source = RampSource()
    host = BareHost(ramp_device(source=source))
    host.stream(100.0)
    host.frames(50)
    host.set(X4Setting.FPS, 40.0)
    host.frames(2)
    assert source.scene_times_ns[10] == SECOND // 10
    assert source.scene_times_ns[50] == SECOND // 2
    assert source.scene_times_ns[51] == SECOND // 2 + SECOND // 40


@pytest.mark.parametrize("pace", list(Pace))
def test_a_pause_in_real_time_passes_scene_time_but_no_sweeps(pace: Pace) -> None:
    """Protocol reference 6.1: it stands still while FPS is 0. ASAP's time stands still, too."""
    source = RampSource()
    host = BareHost(ramp_device(pace, source))
    host.stream(50.0)
    before = [frame.info for frame in host.frames(5)]
    while len(before) < 5:
        before += [one.info for one in host.at(host.now_ns + SECOND // 50) if is_frame(one)]
    host.set(X4Setting.FPS, 0.0)
    host.at(host.now_ns + 10 * SECOND + 1)
    source.scene_times_ns.clear()
    host.set(X4Setting.FPS, 50.0)
    after = [one.info for one in host.at(host.now_ns + SECOND // 50) if is_frame(one)]
    assert [*before, after[0]] == [1, 2, 3, 4, 5, 6]
    begin_ns = min(source.scene_times_ns.values())
    assert begin_ns == SECOND // 10 if pace is Pace.ASAP else begin_ns > 10 * SECOND


def test_frames_that_are_not_fetched_leave_gaps() -> None:
    """Protocol reference 6.1: the chip counts on, also while nothing goes to the host."""
    host = BareHost(ramp_device(Pace.REALTIME))
    host.stream(50.0)
    assert [frame.info for frame in host.frames(5)] == [1]
    host.command(m.SetMode(mode=SensorMode.XTID_SM_STOP))
    host.at(SECOND + 1)
    host.command(m.SetMode(mode=SensorMode.XTID_SM_MANUAL))
    assert [one.info for one in host.at(SECOND + SECOND // 50) if is_frame(one)] == [52]


def test_where_a_stream_begins_is_known() -> None:
    """Under ASAP a later stream goes on where the one before it ended."""
    source = RampSource()
    device = ramp_device(source=source)
    host = BareHost(device)
    host.enter_manual()
    before = device.stream_begin
    assert before is None
    host.set(X4Setting.FPS, 100.0)
    assert device.stream_begin == StreamBegin(number=0, scene_time_ns=0)
    host.frames(50)
    host.set(X4Setting.FPS, 0.0)
    host.set(X4Setting.FPS, 40.0)
    host.frames(4)  # to 0.6 s
    assert device.stream_begin == StreamBegin(number=0, scene_time_ns=0)
    host.command(m.X4DriverInit())
    host.set(X4Setting.FPS, 40.0)
    assert device.stream_begin == StreamBegin(number=1, scene_time_ns=6 * SECOND // 10)
    assert [frame.info for frame in host.frames(2)] == [1, 2]
    assert host.ask(m.ModReset()) == m.Ack()
    host.hear(20)
    for now_ns in (SECOND, 10 * SECOND):
        host.now_ns = now_ns
        device.advance(now_ns)
    host.hear(2)
    host.enter_manual()
    source.scene_times_ns.clear()
    host.set(X4Setting.FPS, 50.0)
    begin = device.stream_begin
    assert begin is not None
    assert begin.number == 2
    assert host.frames(1)[0].info == 1
    assert min(source.scene_times_ns.values()) == begin.scene_time_ns > 6 * SECOND // 10


def test_reset_acks_goes_deaf_and_comes_back_stopped(host: BareHost) -> None:
    """Protocol reference 3, 8.1 and 8.2: it was stopped, so it stays stopped."""
    host.stream()
    assert host.ask(m.ModReset()) == m.Ack()
    host.send(m.Ping())
    host.now_ns = SECOND // 2 - 1
    host.device.advance(host.now_ns)
    assert not any(isinstance(message, m.Pong) for message in host.hear(20)), "3: no answer, ever"
    host.now_ns = SECOND // 2
    host.device.advance(host.now_ns)
    host.send(m.Ping())
    assert host.hear() == []
    assert host.device.wake_ns(host.now_ns) == SECOND // 2 + 2 * SECOND
    assert host.at(SECOND // 2 + 2 * SECOND) == [m.System(code=0x10), m.System(code=0x11)]
    assert mode_of(host) == 0x13
    count = host.ask(m.X4DriverGet(setting=X4Setting.FRAMEBINCOUNT))
    assert isinstance(count, m.ReplyInt)
    assert count.values == (1467,), "X4 settings are never saved"


@pytest.mark.parametrize("restart", ["reset", "power"])
def test_a_module_whose_profile_was_loaded_but_not_run_starts_stopped(
    host: BareHost, restart: str
) -> None:
    """Protocol reference 8.2: only one that was in RUN starts its profile; 8.3: RUN needs one."""
    assert mode_of(host) == 0x01, "as shipped"
    host.command(m.LoadApp(profile_id=PRESENCE_2))
    assert host.ask(m.GetProfileId()) == m.ReplyInt(values=(PRESENCE_2,))
    if restart == "reset":
        host.command(m.ModReset())
    else:
        host.device.power_cycle(host.now_ns)
    assert host.at(5 * SECOND) == [m.System(code=0x10), m.System(code=0x11)]
    assert mode_of(host) == 0x13
    assert host.ask(m.SetMode(mode=SensorMode.XTID_SM_RUN)) == m.Error(code=0x20)
    # once it runs, it starts running
    host.command(m.LoadApp(profile_id=PRESENCE_2), m.SetMode(mode=SensorMode.XTID_SM_RUN))
    host.hear()
    host.command(m.ModReset())
    host.at(10 * SECOND)
    assert mode_of(host) == 0x01


@pytest.mark.parametrize("pace", list(Pace))
def test_a_host_that_never_reads_is_held_back(pace: Pace) -> None:
    device = ramp_device(pace)
    ping = Connection(Role.HOST).send(m.Ping())
    sent = 0
    while device.wants_data:
        device.receive_data(ping, 0)
        sent += 1
        assert sent < 1000
    assert sent == 50
    for _ in range(sent):
        assert device.next_packet(0) is not None
        assert device.wants_data
    assert device.next_packet(0) is None


def test_frames_that_wait_hold_no_command_back() -> None:
    host = BareHost(ramp_device(Pace.REALTIME))
    host.stream(100.0)
    for _ in range(90):
        host.now_ns += SECOND // 100
        host.device.advance(host.now_ns)
    assert host.device.wants_data
    host.send(m.Ping())
    assert m.Pong(value=0xAAEEAEEA) in host.hear()


def test_a_second_reset_does_not_postpone_the_first(host: BareHost) -> None:
    host.command(m.SetMode(mode=SensorMode.XTID_SM_STOP), m.ModReset())
    host.now_ns = SECOND // 4
    host.send(m.ModReset())
    assert host.hear() == []
    assert host.device.wake_ns(host.now_ns) == SECOND // 2


def test_commands_wait_behind_one_that_waits(host: BareHost) -> None:
    """3: as many as the firmware's message pool holds (1.1), and frames go on meanwhile."""
    host.stream()
    assert host.ask(m.SetBaudRate(baudrate=9600)) == m.Ack()
    ping, sent = Connection(Role.HOST).send(m.Ping()), 0
    while host.device.wants_data:
        host.device.receive_data(ping, 0)
        sent += len(ping)
    assert 15_000 <= sent < 15_000 + len(ping)
    assert all(isinstance(message, m.DataFloat) for message in host.hear(3))
    host.now_ns = SECOND // 2
    pongs = 0
    for _ in range(200):  # a few are answered per visit
        host.device.advance(host.now_ns)
        pongs += sum(isinstance(message, m.Pong) for message in host.hear(50))
    assert pongs == sent // len(ping)
    assert host.device.wants_data


@pytest.mark.parametrize("level", [16 * 300 * 152 // 2, 0])
def test_the_guard_counts_frames_that_a_host_never_gets(level: int) -> None:
    """8.4: 100 zero frames, although only the first 50 found room in the queue."""
    source = FormulaSource(lambda index: 0 * index + level)
    host = BareHost(radar_device(IDENTITY, source, Pace.REALTIME))
    host.enter_manual()
    working_point(host.device.module.chip)
    host.set(X4Setting.FPS, 100.0)
    for now_ns in range(0, SECOND * 6 // 5, SECOND // 100):  # the host does not read
        host.device.advance(now_ns)
    assert host.device.module.chip.running is (level == 0)


def test_realtime_frames_are_due_at_absolute_deadlines() -> None:
    zero_ns, skew_ns = 7 * SECOND, 3_000_000
    device = radar_device(
        IDENTITY,
        RampSource(),
        Pace.REALTIME,
        scene_time_zero_ns=zero_ns,
        clock=ModuleClock(skew_ns=skew_ns),
    )
    host = BareHost(device, now_ns=zero_ns)
    host.stream(50.0)
    arrivals = {}
    for _ in range(100):
        due_ns = device.wake_ns(host.now_ns)
        assert due_ns is not None
        host.now_ns = due_ns + 100_000  # the loop wakes a little late, every time
        device.advance(host.now_ns)
        for frame in host.frames(10):
            arrivals[frame.info] = host.now_ns
    expected = {k + 1: zero_ns + skew_ns + k * SECOND // 50 + 100_000 for k in range(100)}
    assert arrivals == expected


def test_after_lost_frames_none_comes_before_it_is_due() -> None:
    """A host that does not read for half a second, and then reads."""
    device = radar_device(IDENTITY, RampSource(), Pace.REALTIME)
    host = BareHost(device)
    host.stream(200.0)
    for _ in range(50):
        host.now_ns += SECOND // 100 + 1
        device.advance(host.now_ns)
    counters = [frame.info for frame in host.frames(100)]
    for _ in range(10):
        device.advance(host.now_ns)
        counters += [frame.info for frame in host.frames(100)]
        assert (counters[-1] - 1) * SECOND // 200 <= host.now_ns
        host.now_ns += SECOND // 500
    assert counters != list(range(1, len(counters) + 1))  # some were lost


def test_a_late_start_in_realtime_skips_what_is_past() -> None:
    source = RampSource()
    device = radar_device(IDENTITY, source, Pace.REALTIME)
    host = BareHost(device)
    host.enter_manual()
    host.now_ns = 10 * SECOND + 1
    host.set(X4Setting.FPS, 50.0)
    host.now_ns += SECOND // 50
    device.advance(host.now_ns)
    (frame,) = host.frames(10)
    assert frame.info == 1, "the timer has just begun"
    assert source.scene_times_ns[501] == 501 * SECOND // 50


def test_a_stream_after_a_reset_begins_with_the_first_frame_ahead() -> None:
    """On the bare firmware nothing but the reset says that the stream before it ended."""
    host = BareHost(ramp_device(Pace.REALTIME, options=DeviceOptions(firmware="xep")))
    host.set(X4Setting.FPS, 50.0)
    assert host.at(SECOND // 10)
    assert host.ask(m.ModReset()) == m.Ack()
    for now_ns in (SECOND, 10 * SECOND + 1):
        host.at(now_ns)
    host.set(X4Setting.FPS, 50.0)
    assert len(host.at(host.now_ns + SECOND // 50)) == 1, "and not what a second before it missed"


def test_realtime_overflow_shows_as_counter_gaps_and_commands_still_work() -> None:
    device = ramp_device(Pace.REALTIME)
    host = BareHost(device)
    host.stream(100.0)
    for _ in range(500):  # five seconds nobody reads
        host.now_ns += SECOND // 100
        device.advance(host.now_ns)
    host.send(m.Ping())
    heard = host.hear()
    counters = [message.info for message in heard if isinstance(message, m.DataFloat)]
    assert m.Pong(value=0xAAEEAEEA) in heard
    assert len(heard) <= 50
    assert counters == sorted(set(counters))
    assert counters[-1] > 490
    host.now_ns += SECOND // 100
    device.advance(host.now_ns)
    (fresh,) = host.frames(5)
    assert fresh.info == counters[-1] + 1
