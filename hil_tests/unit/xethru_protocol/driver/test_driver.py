"""The drivers, sync and async, on a scripted module."""

import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest

from hil_tests.unit.xethru_protocol.both_drivers import DriverOn, Scripted
from hil_tests.unit.xethru_protocol.scripted import READY, PlainModule, frame, framed
from xethru_protocol import X4M300, AsyncX4M300
from xethru_protocol.driver.link import Link, RawConfig
from xethru_protocol.driver.matching import ProtocolRecord
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import PongCode, SensorMode, X4Setting
from xethru_protocol.wire.errors import (
    DeviceError,
    LocalProtocolError,
    RemoteProtocolError,
    ResponseTimeout,
)

Said = Sequence[m.Message | bytes]
GET_FPS = m.X4DriverGet(setting=X4Setting.FPS)


def test_raw_mode_follows_the_recipe_of_the_reference(driver_on: DriverOn) -> None:
    radar, line = driver_on()
    geometry = radar.configure_raw()
    radar.start(17.0)
    sets = [c for c in line.received if isinstance(c, m.X4DriverSet)]
    assert [type(c) for c in line.received[:4]] == [m.Ping, m.SetMode, m.SetMode, m.X4DriverInit]
    assert [c.mode for c in line.received if isinstance(c, m.SetMode)] == [
        SensorMode.XTID_SM_STOP,
        SensorMode.XTID_SM_MANUAL,
    ]
    # FRAMEAREAOFFSET is the module's own calibration: read, not set (9.3)
    assert m.X4DriverGet(setting=X4Setting.FRAMEAREAOFFSET) in line.received
    assert [(c.setting.name, c.value) for c in sets] == [
        ("DACMIN", 949),
        ("DACMAX", 1100),
        ("DACSTEP", 0),  # this one and PRFDIV are not in the recipe, but settings of ours
        ("ITERATIONS", 16),
        ("PULSESPERSTEP", 300),
        ("PRFDIV", 16),
        ("TXCENTERFREQUENCY", 3),
        ("TXPOWER", 2),
        ("DOWNCONVERSION", 0),
        ("FRAMEAREA", (float(np.float32(0.2)), float(np.float32(9.4)))),
        ("FPS", 17.0),
    ]
    assert (geometry.n_bins, geometry.range_start_m) == (1431, 0.19929012656211853)
    assert geometry.bin_length_m == pytest.approx(0.006430041, abs=1e-8)
    assert radar.warnings == []


@pytest.mark.parametrize("offset_m", [None, 0.2])
def test_the_modules_own_offset_stays_unless_the_user_sets_one(
    driver_on: DriverOn, offset_m: float | None
) -> None:
    """9.3, 9.4: a board calibrated to 0.2 m gives 0.200000 ... 9.401389 m, as is expected then."""
    own = m.ReplyFloat(content_id=X4Setting.FRAMEAREAOFFSET, values=(float(np.float32(0.2)),))
    area = m.ReplyFloat(content_id=X4Setting.FRAMEAREA, values=(0.2, 9.401389))
    radar, line = driver_on(
        PlainModule(
            instead={
                m.X4DriverGet(setting=X4Setting.FRAMEAREAOFFSET): [own],
                m.X4DriverGet(setting=X4Setting.FRAMEAREA): [area],
            }
        )
    )
    radar.configure_raw(RawConfig(offset_m=offset_m))
    assert radar.warnings == []
    sets = [c.setting for c in line.received if isinstance(c, m.X4DriverSet)]
    assert (X4Setting.FRAMEAREAOFFSET in sets) is (offset_m is not None)


def test_firmware_without_modes_is_tolerated(driver_on: DriverOn) -> None:
    radar, _ = driver_on(PlainModule(instead={m.SetMode: [m.Error(code=1)]}))
    assert radar.configure_raw().n_bins == 1431


def test_bare_xep_has_nothing_wrong_with_it(driver_on: DriverOn) -> None:
    """X4M03 and X4M05: no modes, no serial number. Protocol reference 4.10, 8.3."""
    heard: list[ProtocolRecord] = []
    bare = PlainModule(None, instead={m.SetMode: [m.Error(code=1)]})
    radar, line = driver_on(bare, observer=heard.append)
    with radar:
        radar.configure_raw()
        radar.start(17.0)
        line.say(frame(1))
        assert radar.read_frame().counter == 1
        radar.stop()
    assert line.closed
    assert radar.warnings == []
    assert [record for record in heard if record.direction == "warning"] == []


def test_a_mode_refused_for_another_reason_is_reported(driver_on: DriverOn) -> None:
    heard: list[ProtocolRecord] = []
    radar, _ = driver_on(
        PlainModule(instead={m.SetMode: [m.Error(code=0x21)]}), observer=heard.append
    )
    radar.configure_raw()
    assert [record for record in heard if record.direction == "warning"]


def test_start_returns_the_real_rate_and_warns_above_the_possible(raw: Scripted) -> None:
    radar, _ = raw
    assert radar.start(17.0) == pytest.approx(17.049379, abs=1e-6)
    radar.start(20.0)
    assert radar.warnings == [
        "20 frames/s are more than the 19.8 that 16 iterations x 300 pulses leave time for; "
        "a real module may not keep up"
    ]
    with pytest.raises(LocalProtocolError, match="must be positive"):
        radar.start(0.0)


def test_start_returns_the_timers_rate_where_the_read_back_has_a_fraction(
    driver_on: DriverOn,
) -> None:
    answer = m.ReplyFloat(content_id=X4Setting.FPS, values=(50.5,))
    radar, _ = driver_on(PlainModule(instead={GET_FPS: [answer]}))
    radar.configure_raw(RawConfig(iterations=4))
    assert radar.start(50.5) == 50.0


@pytest.mark.parametrize("values", [(0.0,), (-1.0,), (float("nan"),), (float("inf"),), ()])
def test_rate_that_is_none_is_the_modules_fault(
    driver_on: DriverOn, values: tuple[float, ...]
) -> None:
    answer = m.ReplyFloat(content_id=X4Setting.FPS, values=values)
    radar, _ = driver_on(PlainModule(instead={GET_FPS: [answer]}))
    radar.configure_raw()
    with pytest.raises(RemoteProtocolError, match="the port reads back"):
        radar.start(17.0)


def test_frames_keep_their_samples_counters_and_arrival_times(raw: Scripted) -> None:
    radar, line = raw
    line.say(frame(5), frame(6), frame(9))
    frames = list(radar.frames(3))
    assert [f.counter for f in frames] == [5, 6, 9]
    assert [f.samples[0] for f in frames] == [5, 6, 9]
    assert frames[0].samples.dtype == np.float32
    assert frames[0].geometry is radar.geometry
    assert frames[0].arrival_ns < frames[1].arrival_ns <= line.now_ns
    assert radar.frames_lost == 2


@pytest.mark.parametrize(
    ("counters", "lost"),
    [
        ((5, 1_000_006, 7, 8), 0),  # 6, damaged
        ((5, 1_000_006, 9, 10), 2),
        ((5, 9, 8, 9), 1),  # the first 9, damaged, was 6 or 7
        ((5, 9, 9), 2),  # ... or 8
        ((5, 7, 6, 7), 1),  # nothing lies between 5 and 6: the chip was restarted
        ((5, 9, 10, 7, 8), 3),  # the chip was restarted after a true gap
        ((5, 0x8000_0006, 7), 0),
        ((0xFFFF_FFFE, 0x0FFF_FFFF, 0, 1), 0),  # FFFFFFFF, damaged
        ((0xFFFF_FFFF, 0, 1, 0), 0),  # it wraps, then the chip was restarted
    ],
)
def test_lost_frames_are_counted_by_counters(
    raw: Scripted, counters: tuple[int, ...], lost: int
) -> None:
    radar, line = raw
    line.say(*map(frame, counters))
    assert [got.counter for got in radar.frames(len(counters))] == list(counters)
    assert radar.frames_lost == lost


def test_gap_of_the_last_stream_explains_nothing_in_the_next(raw: Scripted) -> None:
    radar, line = raw
    line.say(frame(5), frame(100))
    list(radar.frames(2))
    radar.start(17.0)
    line.say(frame(30), frame(29))
    list(radar.frames(2))
    assert radar.frames_lost == 94


def test_frames_of_the_last_stream_are_no_part_of_the_next(raw: Scripted) -> None:
    radar, line = raw
    radar.start(17.0)
    line.say(frame(4), frame(5))
    assert radar.read_frame().counter == 4
    radar.stop()  # frame 5 came with the answer and was not read
    line.say(frame(6))  # it was on its way already
    radar.start(17.0)
    line.say(frame(40), frame(41))
    assert [got.counter for got in radar.frames(2)] == [40, 41]
    assert radar.frames_lost == 0


def test_baseband_frames_become_complex(driver_on: DriverOn) -> None:
    area, count = X4Setting.FRAMEAREA, X4Setting.FRAMEBINCOUNT
    module = PlainModule(
        instead={
            m.X4DriverGet(setting=area): [m.ReplyFloat(content_id=area, values=(0.25, 0.375))],
            m.X4DriverGet(setting=count): [m.ReplyInt(content_id=count, values=(3,))],
        }
    )
    radar, line = driver_on(module)
    geometry = radar.configure_raw(RawConfig(downconversion=True))
    line.say(m.DataFloat(info=1, values=np.array([1, 2, 3, 4, 5, 6], np.float32)))
    samples = radar.read_frame().samples
    assert samples.dtype == np.complex64
    assert samples.tolist() == [1 + 4j, 2 + 5j, 3 + 6j]
    assert geometry.bin_length_m == 0.0625  # three bins: the area ends at the last one


def test_profile_baseband_messages_are_frames_with_their_own_geometry(driver_on: DriverOn) -> None:
    radar, line = driver_on()
    message = m.BasebandIq(
        counter=7,
        num_bins=2,
        bin_length_m=0.5,
        sampling_frequency_hz=2.0,
        carrier_frequency_hz=3.0,
        range_offset_m=0.25,
        i=np.array([1, 2], np.float32),
        q=np.array([3, 4], np.float32),
    )
    line.say(message)
    got = radar.read_frame()
    assert (got.counter, got.samples.tolist()) == (7, [1 + 3j, 2 + 4j])
    assert (got.geometry.range_start_m, got.geometry.bin_length_m) == (0.25, 0.5)


@pytest.mark.parametrize(
    "other",
    [frame(1, bins=99), m.DataFloat(content_id=4, info=1, values=np.zeros(1431, np.float32))],
    ids=["length", "content id"],
)
def test_data_that_are_no_radar_frames_are_discarded_and_counted(
    raw: Scripted, other: m.DataFloat
) -> None:
    radar, line = raw
    line.say(other, frame(2))
    assert radar.read_frame(math.inf).counter == 2  # without a limit
    assert radar.frames_discarded == 1


def test_what_arrives_before_a_reply_is_sorted_and_nothing_is_lost(driver_on: DriverOn) -> None:
    module = PlainModule()
    radar, _ = driver_on(module)
    radar.configure_raw()
    module.instead = {
        GET_FPS: [
            frame(1),
            m.System(code=0x11),
            m.DataString(text="debug"),
            b"\x01\x02",
            frame(2),
            m.ReplyFloat(content_id=X4Setting.FPS, values=(1.0,)),
            frame(3),
        ]
    }
    reply = radar.request(GET_FPS)
    assert reply.values == (1.0,)
    assert [f.counter for f in radar.frames(3)] == [1, 2, 3]
    assert radar.fault_count == 1


def test_replies_to_nothing_and_to_something_else_are_not_taken(driver_on: DriverOn) -> None:
    def confused(command: m.Message) -> Said:
        return [
            m.Ack(),
            m.ReplyInt(content_id=X4Setting.DACMIN, values=(949,)),
            m.ReplyInt(content_id=X4Setting.DACMAX, values=(1100,)),
        ]

    radar, line = driver_on(confused)
    line.say(m.ReplyInt(content_id=X4Setting.DACMAX, values=(1,)))  # too late for its request
    reply = radar.request(m.X4DriverGet(setting=X4Setting.DACMAX))
    assert reply.values == (1100,)
    assert radar.stray_count == 3


@pytest.mark.parametrize(
    ("command", "came", "text"),
    [
        (
            m.GetProfileId(),
            m.ReplyByte(values=b"\x05"),
            r"answered DIR GET_PROFILEID with REPLY BYTE .*where REPLY INT was expected",
        ),
        (
            m.X4DriverGet(setting=X4Setting.DACMAX),
            m.ReplyInt(content_id=X4Setting.DACMIN, values=(949,)),
            r"answered X4DRIVER_GET id=DACMAX with REPLY INT .*=.949., where .* content id 0x17 ",
        ),
        (
            m.SystemGetInfo(item=6),
            m.ReplyString(content_id=0x58, info=3, text="1.6.8"),
            r"with REPLY STRING .*1\.6\.8.* content id 0x58 and info 6 was expected",
        ),
        (m.ModReset(), m.Pong(value=0xAAEEAEEA), r"answered MOD_RESET with PONG .*where ACK was"),
    ],
    ids=["type", "content id", "info", "pong"],
)
def test_answer_that_does_not_fit_is_named(
    driver_on: DriverOn, command: m.Command[m.Response], came: m.Message, text: str
) -> None:
    radar, line = driver_on(lambda command: [came])
    with pytest.raises(RemoteProtocolError, match=text):
        radar.request(command)
    assert line.now_ns < 0.6e9  # not the whole timeout: what was to come has come


def test_answer_that_is_cut_off_is_named(driver_on: DriverOn) -> None:
    """REPLY INT with one element announced and none there: 11 11, id, info, length (5.2)."""
    payload = bytes.fromhex("11 11 17000000 00000000 01000000")
    radar, _ = driver_on(lambda command: [framed(payload)])
    with pytest.raises(RemoteProtocolError, match=r"with .*11 11 17 .*where REPLY"):
        radar.request(m.X4DriverGet(setting=X4Setting.DACMAX))


def test_anything_but_a_pong_is_no_pong(driver_on: DriverOn) -> None:
    radar, _ = driver_on(lambda command: [m.Ack()])
    with pytest.raises(ResponseTimeout, match=r"answered PING .* with ACK, where PONG was "):
        radar.ping()


def test_right_answer_behind_a_wrong_one_is_taken(driver_on: DriverOn) -> None:
    def confused(command: m.Message) -> Said:
        line.say_later(0.4, m.Ack())
        return [m.ReplyInt(values=(1,))]

    radar, line = driver_on(confused)
    assert radar.request(m.X4DriverInit()) == m.Ack()


def test_silence_of_a_module_that_sends_frames_is_none_of_its_power(raw: Scripted) -> None:
    radar, line = raw
    line.answer = lambda command: []
    for k in range(60):
        line.say_later(0.05 * k, frame(k))
    began_ns = line.now_ns
    with pytest.raises(ResponseTimeout, match="it sends frames meanwhile"):
        radar.request(m.GetMode())
    assert 2.0e9 <= line.now_ns - began_ns < 2.1e9  # frames do not put it off


@pytest.mark.parametrize("late", [m.Ack(), m.Error(code=1)], ids=["ack", "error"])
def test_late_answer_is_not_taken_for_the_next_commands(
    driver_on: DriverOn, late: m.Message
) -> None:
    plain = PlainModule()
    first = m.X4DriverSet(setting=X4Setting.DACMIN, value=949)
    second = m.X4DriverSet(setting=X4Setting.TXPOWER, value=9)

    def slow(command: m.Message) -> Said:
        if command == first:
            return []
        if isinstance(command, m.Ping):
            return [late, READY]  # the module answers in order, and is back
        return [m.Error(code=21)] if command == second else plain(command)

    radar, line = driver_on(slow)
    with pytest.raises(ResponseTimeout):
        radar.request(first)
    with pytest.raises(DeviceError) as caught:
        radar.request(second)
    assert caught.value.code == 21
    assert line.received == [first, m.Ping(), second]
    radar.request(m.X4DriverInit())
    assert line.received[3:] == [m.X4DriverInit()]  # in step again: no PING


def test_module_that_stays_silent_is_pinged_before_each_command(driver_on: DriverOn) -> None:
    radar, line = driver_on(lambda command: [])
    for _ in range(2):
        with pytest.raises(ResponseTimeout):
            radar.stop()
    stop = m.X4DriverSet(setting=X4Setting.FPS, value=0.0)
    assert line.received == [stop, m.Ping()]
    line.answer = lambda command: [m.Error(code=1), READY]
    assert radar.ping() is PongCode.XTS_SPRP_READY
    assert line.received[2:] == [m.Ping()]


def test_refusal_names_command_code_and_meaning(driver_on: DriverOn) -> None:
    radar, _ = driver_on(lambda command: [m.Error(code=17)])
    with pytest.raises(DeviceError) as caught:
        radar.request(m.X4DriverSet(setting=X4Setting.FRAMEAREA, value=(5.0, 0.4)))
    assert caught.value.code == 17
    assert str(caught.value) == (
        "the module refused X4DRIVER_SET id=FRAMEAREA start=5.0 end=0.4: "
        "error 17 (X4 FRAME_AREA_END_OUT_OF_SCOPE)"
    )


def test_silence_is_a_timeout_that_names_port_and_remedy(driver_on: DriverOn) -> None:
    radar, line = driver_on(lambda command: [])
    with pytest.raises(
        ResponseTimeout, match=r"no answer to PING .* from the port within 2 s; is it"
    ):
        radar.configure_raw()
    assert 2_000_000_000 <= line.now_ns < 2_100_000_000
    assert isinstance(ResponseTimeout(""), TimeoutError)


def test_garbage_instead_of_an_answer_suggests_another_device(driver_on: DriverOn) -> None:
    radar, _ = driver_on(lambda command: [b"\x06\x1a login:"])
    with pytest.raises(ResponseTimeout, match="is it another device"):
        radar.ping()


def test_strange_pong_is_no_xethru_module(driver_on: DriverOn) -> None:
    radar, _ = driver_on(lambda command: [m.Pong(value=1)])
    with pytest.raises(RemoteProtocolError, match="0x00000001"):
        radar.ping()


def test_module_that_is_not_ready_is_waited_for(driver_on: DriverOn) -> None:
    plain = PlainModule()
    answers = [m.Pong(value=PongCode.XTS_SPRP_NOTREADY)] * 3 + [READY]

    def booting(command: m.Message) -> Said:
        return [answers.pop(0)] if isinstance(command, m.Ping) else plain(command)

    radar, line = driver_on(booting)
    radar.configure_raw()
    assert 0.3e9 <= line.now_ns < 0.5e9


def test_module_that_never_gets_ready_is_waited_for_ten_seconds(driver_on: DriverOn) -> None:
    radar, line = driver_on(lambda command: [m.Pong(value=PongCode.XTS_SPRP_NOTREADY)])
    with pytest.raises(ResponseTimeout):
        radar.configure_raw()
    assert 10e9 <= line.now_ns < 10.2e9


def test_module_that_stops_is_a_timeout_and_says_if_it_restarted(raw: Scripted) -> None:
    radar, line = raw
    with pytest.raises(ResponseTimeout, match="no frame from the port within 1 s"):
        radar.read_frame(timeout_s=1.0)
    line.say(m.System(code=0x10))
    with pytest.raises(ResponseTimeout, match="restarted"):
        radar.read_frame()
    assert radar.reboots == 1


def test_trouble_before_the_last_answer_or_frame_explains_no_silence(driver_on: DriverOn) -> None:
    radar, line = driver_on()
    line.say(b"\x00junk", m.System(code=0x10))
    radar.configure_raw()
    radar.start(5)
    with pytest.raises(ResponseTimeout, match="is it an X4M300"):
        radar.read_frame()
    line.say(b"\x00junk", m.System(code=0x10), frame(1))
    radar.read_frame()
    with pytest.raises(ResponseTimeout, match="did the module stop"):
        radar.read_frame()
    line.say(b"\x00junk")
    with pytest.raises(ResponseTimeout, match="is it another device"):
        radar.read_frame()
    assert (radar.fault_count, radar.reboots) == (2, 2)  # none before the first answer


@pytest.mark.parametrize("driver", [X4M300, AsyncX4M300])
def test_a_path_is_no_open_line(driver: Callable[[str], object]) -> None:
    with pytest.raises(TypeError, match=r"X4M300\.open\('/dev/ttyACM0'\) opens a port"):
        driver("/dev/ttyACM0")


def test_frames_of_a_radar_that_was_not_started_are_not_blamed_on_it(driver_on: DriverOn) -> None:
    radar, _ = driver_on()
    for prepare in (radar.ping, radar.configure_raw):
        prepare()
        with pytest.raises(ResponseTimeout, match=r"was the radar started, by start\(fps\)"):
            radar.read_frame()


def test_info_has_what_the_module_tells(driver_on: DriverOn) -> None:
    radar, _ = driver_on()
    info = radar.info()
    assert (info.serial_number, info.mode, info.order_code) == ("123456789012", "MANUAL", None)
    settings = radar.x4.settings()
    assert settings[X4Setting.FRAMEBINCOUNT] == 1431
    assert settings[X4Setting.DACMIN] is None
    assert X4Setting.ENABLE not in settings


def test_closing_stops_the_radar_also_in_the_middle_of_a_packet(driver_on: DriverOn) -> None:
    radar, line = driver_on()
    with radar:
        radar.configure_raw()
        radar.start(17.0)
        line.say(b"\x7c\x7c\x7c\x7c\x6a\x16\x00\x00\x00\xa0")
        radar._call_once(Link.take_stale_input)
        line.say(bytes(5736))  # the rest of it
        line.received.clear()
    assert [type(c) for c in line.received] == [m.X4DriverSet, m.SetMode]
    assert line.closed
    assert radar.fault_count == 0
    assert radar.statistics.clean


def test_closing_a_dead_module_tells_and_does_not_raise(driver_on: DriverOn) -> None:
    radar, line = driver_on()
    with radar:
        radar.configure_raw()
        line.answer = lambda command: []
    assert line.closed
    assert radar.warnings[0].startswith("the module was not stopped: no answer")


def test_observer_hears_everything_but_frames(driver_on: DriverOn) -> None:
    heard: list[ProtocolRecord] = []
    radar, line = driver_on(observer=heard.append)
    radar.ping()
    line.say(m.System(code=0x11), b"\x00", frame(1))
    radar._call_once(Link.take_stale_input)
    assert [(record.direction, record.summary) for record in heard] == [
        ("tx", "PING seed=0xEEAAEAAE"),
        ("rx", "PONG value=0xAAEEAEEA"),
        ("rx", "SYSTEM code=17 code_name=READY"),
        ("fault", "bytes between packets at byte 16"),
    ]


def test_reset_returns_at_the_ack(driver_on: DriverOn) -> None:
    radar, line = driver_on()
    radar.reset()
    assert line.now_ns < 1_000_000
    radar.close()
    assert [type(c) for c in line.received] == [m.ModReset]
