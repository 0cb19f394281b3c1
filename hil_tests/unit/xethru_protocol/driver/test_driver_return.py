"""Modules that restart, vanish and come back, on a virtual clock. Protocol reference 8.1, 10."""

from collections.abc import Sequence
from typing import Any, cast

import pytest

from hil_tests.unit.xethru_protocol.both_drivers import DriverOn, Scripted
from hil_tests.unit.xethru_protocol.machine import Machine, UartModule
from hil_tests.unit.xethru_protocol.scripted import Answer, PlainModule, ScriptedTransport, frame
from xethru_protocol.driver.link import Link, RawConfig
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import BAUD_RATES, OutputFeature, PongCode, SensorMode, X4Setting
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.errors import DeviceError, Disconnected, ResponseTimeout

Said = Sequence[m.Message | bytes]
BOOTING, READY = m.System(code=0x10), m.System(code=0x11)
HOME, DECOY, ELSEWHERE = "/dev/ttyACM0", "/dev/ttyACM1", "/dev/ttyACM2"


@pytest.fixture
def machine() -> Machine:
    """Three ports; behind one of them another module."""
    machine = Machine(DECOY, ELSEWHERE, HOME)
    machine.plug(DECOY, PlainModule("999999999999"))
    return machine


@pytest.fixture
def plugged(driver_on: DriverOn, machine: Machine) -> DriverOn:
    """Maker of drivers whose module is at the port HOME of the machine."""

    def at_home(answer: Answer | None = None, **options: Any) -> tuple[X4M300, ScriptedTransport]:  # noqa: ANN401 - those of drivers
        radar, line = driver_on(answer, ports=machine.ports, name=HOME, **options)
        machine.runs_on(line)
        return radar, line

    return cast(DriverOn, at_home)


def unplug(line: ScriptedTransport) -> None:
    line.pending.clear()
    line.gone = True


def settings_sent(line: ScriptedTransport) -> list[tuple[str, m.X4Value]]:
    return [(c.setting.name, c.value) for c in line.received if isinstance(c, m.X4DriverSet)]


# --- reset --------------------------------------------------------------------------------------


def test_reset_waits_for_ready_on_a_port_that_stays(driver_on: DriverOn) -> None:
    plain = PlainModule()

    def module(command: m.Message) -> Said:
        if isinstance(command, m.ModReset):
            line.say_later(2.5, BOOTING, READY)
        return plain(command)

    radar, line = driver_on(module)
    radar.reset(wait=True)
    assert line.now_ns == pytest.approx(2.5e9, abs=1e7)
    assert (radar.reboots, radar.reconnects, radar.warnings) == (1, 0, [])


def test_reset_polls_where_ready_was_lost(driver_on: DriverOn) -> None:
    plain = PlainModule()
    deaf_until_ns = 0

    def module(command: m.Message) -> Said:
        nonlocal deaf_until_ns
        if line.now_ns < deaf_until_ns:
            return []
        if isinstance(command, m.ModReset):
            deaf_until_ns = line.now_ns + 6_000_000_000
        return plain(command)

    radar, line = driver_on(module)
    radar.reset(wait=True)
    assert 6.0e9 <= line.now_ns < 7.5e9
    assert radar.ping() is PongCode.XTS_SPRP_READY


def test_reset_gives_up_in_time(driver_on: DriverOn) -> None:
    plain = PlainModule()
    is_off = False

    def module(command: m.Message) -> Said:
        nonlocal is_off
        answer = [] if is_off else plain(command)
        is_off |= isinstance(command, m.ModReset)
        return answer

    radar, line = driver_on(module)
    with pytest.raises(ResponseTimeout, match="no READY after the reset from the port"):
        radar.reset(wait=True, timeout_s=10.0)
    assert 10.0e9 <= line.now_ns < 11e9


@pytest.mark.parametrize("path", [HOME, ELSEWHERE])
def test_reset_follows_a_port_that_vanishes(plugged: DriverOn, machine: Machine, path: str) -> None:
    plain = PlainModule()
    machine.plug(path, plain, from_s=3.0)

    def module(command: m.Message) -> Said:
        if isinstance(command, m.ModReset):
            line.vanish_later(0.5)
        return plain(command)

    radar, line = plugged(module)
    radar.reset(wait=True)
    assert 3.0e9 <= line.now_ns < 4.0e9
    assert radar.port == path
    assert (radar.reconnects, radar.warnings) == (1, [])
    # the other module was asked who it is and let alone
    assert machine.asked(DECOY)
    assert all(isinstance(c, m.Ping | m.SystemGetInfo) for c in machine.asked(DECOY))


def test_module_that_does_not_come_back_is_disconnected(
    plugged: DriverOn, machine: Machine
) -> None:
    radar, line = plugged()
    line.vanish_later(0.5)
    with pytest.raises(
        Disconnected, match=f"module of {HOME} did not come back within 15 s: there is no port"
    ):
        radar.reset(wait=True)
    assert 15.0e9 <= line.now_ns < 17e9
    assert len([1 for opened in machine.lines if opened.name == DECOY]) < 8  # not every 0.2 s


# --- reconnect ----------------------------------------------------------------------------------


def test_vanished_module_is_disconnected_unless_asked_otherwise(raw: Scripted) -> None:
    radar, line = raw
    unplug(line)
    with pytest.raises(Disconnected):
        radar.read_frame()
    with pytest.raises(Disconnected):
        radar.ping()


def test_stream_goes_on_after_an_unplug_under_another_name(
    plugged: DriverOn, machine: Machine
) -> None:
    back = PlainModule()
    back.stream = (frame(0), frame(1))
    machine.plug(ELSEWHERE, back, from_s=5.0)
    radar, line = plugged(reconnect_s=20.0)
    radar.configure_raw(RawConfig(iterations=8, dac_step=1))
    radar.start(17.0)
    line.say(frame(40), frame(41))
    assert (radar.read_frame().counter, radar.read_frame().stream) == (40, 0)
    unplug(line)
    before_ns = line.now_ns
    first, second = radar.frames(2)
    assert [first.counter, second.counter] == [0, 1]
    assert radar.port == ELSEWHERE
    # the time without frames, at the timer's real rate for 17 (Protocol reference 9.6)
    missing = round((first.arrival_ns - before_ns) * 1e-9 * 17.04938) - 1
    assert missing > 80
    assert (radar.reconnects, radar.frames_lost) == (1, missing)
    assert (first.stream, second.stream) == (1, 1)
    assert settings_sent(machine.lines[-1]) == settings_sent(line)  # with iterations and rate
    assert any("looking for the module for 20 s" in text for text in radar.warnings)


def test_the_time_in_which_the_radar_was_stopped_has_no_frames_to_lose(
    plugged: DriverOn, machine: Machine
) -> None:
    back = PlainModule()
    back.stream = (frame(1),)
    machine.plug(HOME, back, from_s=103.0)
    radar, line = plugged(reconnect_s=20.0)
    radar.configure_raw()
    radar.start(17.0)
    line.say(frame(1))
    radar.read_frame()
    radar.stop()
    line.now_ns = 100 * 10**9
    radar.start(17.0)
    unplug(line)
    assert radar.read_frame().stream == 1
    assert radar.frames_lost <= 17.1 * 4  # it was 1750


@pytest.mark.parametrize("setting", ["FPS", "ITERATIONS"])
def test_a_setting_that_was_being_changed_is_changed_after_the_outage(
    plugged: DriverOn, machine: Machine, setting: str
) -> None:
    """The module vanishes with the stop before the change, or with the change itself."""
    plain = PlainModule()

    def vanishing(command: m.Message) -> Said:
        match command:
            case m.X4DriverSet(setting=at, value=0.0 | 8) if at.name == setting:
                line.gone = True
                return []
        return plain(command)

    machine.plug(HOME, PlainModule(), from_s=2.0)
    radar, line = plugged(vanishing, reconnect_s=10.0)
    radar.configure_raw()
    radar.start(17.0)
    radar.x4.iterations = 8
    sent = settings_sent(machine.lines[-1])
    assert sent[-4:] == [("FPS", 17.0), ("FPS", 0.0), ("ITERATIONS", 8), ("FPS", 17.0)]
    assert radar.reconnects == 1


def test_counters_on_either_side_of_an_outage_make_no_gap(
    plugged: DriverOn, machine: Machine
) -> None:
    """A module that kept its power counts on until INIT. Protocol reference 6.1."""
    back = PlainModule()
    back.stream = (frame(900),)
    machine.plug(HOME, lambda c: [frame(500), *back(c)] if isinstance(c, m.Ping) else back(c))
    radar, line = plugged(reconnect_s=9.0)
    radar.configure_raw()
    radar.start(17.0)
    line.say(frame(40))
    radar.read_frame()
    unplug(line)
    streams: dict[int, int] = {}
    while 900 not in streams:
        got = radar.read_frame()
        streams[got.counter] = got.stream
    assert streams == {500: 1, 900: 2}
    assert radar.frames_lost == 0  # all of it took less than a frame period


def test_packet_cut_by_an_outage_is_counted_as_junk(plugged: DriverOn, machine: Machine) -> None:
    machine.plug(HOME, PlainModule(), from_s=2.0)
    radar, line = plugged(reconnect_s=10.0)
    radar.configure_raw()
    line.say(line.bytes_of(frame(7))[:100])
    radar._call_once(Link.take_stale_input)
    unplug(line)
    radar.ping()
    assert (radar.reconnects, radar.statistics.junk_bytes) == (1, 100)


def test_request_is_repeated_on_the_new_line_and_waiting_frames_are_kept(
    plugged: DriverOn, machine: Machine
) -> None:
    back = PlainModule()
    machine.plug(HOME, back, from_s=2.0)
    radar, line = plugged(reconnect_s=10.0)
    radar.configure_raw()
    line.say(frame(7))
    radar.ping()  # takes the frame in
    unplug(line)
    power = m.X4DriverSet(setting=X4Setting.TXPOWER, value=1)
    radar.request(power)
    assert machine.lines[-1].received[-1] == power
    assert radar.read_frame().counter == 7
    assert radar.reconnects == 1


def test_stopped_radar_is_not_started_by_a_reconnect(plugged: DriverOn, machine: Machine) -> None:
    machine.plug(HOME, PlainModule())
    radar, line = plugged()
    radar.configure_raw()
    radar.start(17.0)
    radar.stop()
    unplug(line)
    assert radar.reconnect() == HOME
    assert "FPS" not in [name for name, _ in settings_sent(machine.lines[-1])]


def test_module_of_another_number_at_the_same_port_is_not_taken(
    plugged: DriverOn, machine: Machine
) -> None:
    machine.plug(HOME, PlainModule("888888888888"))
    radar, line = plugged()
    line.vanish_later(0.5)
    with pytest.raises(Disconnected, match="is another module"):
        radar.reset(wait=True)


def test_module_without_a_number_is_known_by_its_port_only(
    plugged: DriverOn, machine: Machine
) -> None:
    machine.plug(HOME, PlainModule(None), from_s=3.0)
    machine.plug(ELSEWHERE, PlainModule(None))
    radar, line = plugged(PlainModule(None), reconnect_s=9.0)
    radar.configure_raw()
    assert radar.warnings == []  # bare XEP has none, and nothing is wrong with it
    unplug(line)
    radar.ping()
    assert radar.port == HOME
    assert machine.asked(ELSEWHERE) == []
    assert any("by its port only" in text for text in radar.warnings)


def test_module_that_came_back_in_safe_mode_is_taken_and_told_of(
    plugged: DriverOn, machine: Machine
) -> None:
    safe = m.Pong(value=PongCode.XTS_SPRP_SAFEMODE)
    # the profile layer, which knows the number, is not started
    machine.plug(HOME, PlainModule(None, {m.Ping: [safe]}))
    radar, line = plugged(reconnect_s=9.0)
    radar.configure_raw()
    unplug(line)
    assert radar.ping() is PongCode.XTS_SPRP_SAFEMODE
    assert any("safe mode" in text for text in radar.warnings)


def test_module_that_vanishes_again_while_it_is_set_up_is_waited_for(
    plugged: DriverOn, machine: Machine
) -> None:
    back = PlainModule()

    def brown_out(command: m.Message) -> Said:
        if command == rate and len(machine.lines) == 1:
            unplug(machine.lines[0])
            return []
        return back(command)

    rate = m.X4DriverSet(setting=X4Setting.FPS, value=17.0)
    machine.plug(HOME, brown_out)
    radar, line = plugged(reconnect_s=9.0)
    radar.configure_raw()
    radar.start(17.0)
    unplug(line)
    radar.ping()
    assert len([1 for opened in machine.lines if opened.name == HOME]) == 2
    assert radar.reconnects == 1
    assert rate in machine.lines[-1].received  # what was wanted is not forgotten midway


def test_module_in_a_restart_loop_is_given_up(plugged: DriverOn, machine: Machine) -> None:
    plain = PlainModule()

    def loop(command: m.Message) -> Said:
        if isinstance(command, m.GetMode):
            unplug(machine.lines[-1])
            return []
        return plain(command)

    machine.plug(HOME, loop)
    radar, line = plugged(reconnect_s=9.0)
    radar.ping()
    unplug(line)
    with pytest.raises(Disconnected):
        radar.request(m.GetMode())
    assert radar.reconnects == 3


def test_module_that_refuses_its_settings_after_a_return_says_so(
    plugged: DriverOn, machine: Machine
) -> None:
    machine.plug(HOME, PlainModule(instead={m.X4DriverInit: [m.Error(code=5)]}))
    radar, line = plugged(reconnect_s=9.0)
    radar.configure_raw()
    unplug(line)
    with pytest.raises(DeviceError, match="OSCILLATOR_LOCK_FAILED"):
        radar.ping()


def test_profile_is_set_up_again_after_a_return(plugged: DriverOn, machine: Machine) -> None:
    machine.plug(HOME, PlainModule())
    radar, line = plugged(reconnect_s=9.0)
    radar.profile.load()
    radar.profile.set_output(OutputFeature.PULSEDOPPLER_BYTE, 1)
    radar.profile.set_sensitivity(3)
    radar.profile.set_sensitivity(7)
    radar.profile.set_output(OutputFeature.PULSEDOPPLER_BYTE, 3)
    radar.profile.run()
    unplug(line)
    radar.ping()
    said = machine.lines[-1].received
    begin = said.index(m.SetMode(mode=SensorMode.XTID_SM_STOP))
    assert said[begin:] == [
        m.SetMode(mode=SensorMode.XTID_SM_STOP),
        m.LoadApp(profile_id=0x014D4AB8),
        m.SetSensitivity(sensitivity=7),
        m.OutputSetControl(feature=0x11, control=3),
        m.SetMode(mode=SensorMode.XTID_SM_RUN),
        m.Ping(),
    ]


def test_uart_is_talked_to_at_its_own_rate_again_after_a_reset(driver_on: DriverOn) -> None:
    """It starts at 115200 whatever it was set to. Protocol reference 10."""
    uart = UartModule()
    radar, line = driver_on(uart)
    uart.connect(line, 115200)
    radar.set_baud_rate(921600)
    assert (uart.baudrate, radar.ping()) == (921600, PongCode.XTS_SPRP_READY)
    radar.reset(wait=True)
    assert (uart.baudrate, radar.ping()) == (921600, PongCode.XTS_SPRP_READY)


def test_uart_whose_rate_is_not_known_is_found_at_it(driver_on: DriverOn) -> None:
    """Whichever of those in protocol reference 10 it is."""
    uart = UartModule()
    radar, line = driver_on(uart)
    uart.connect(line, 115200)
    for rate in BAUD_RATES:
        uart.baudrate = rate
        assert radar.find_baud_rate() == rate
        assert radar.ping() is PongCode.XTS_SPRP_READY
    uart.deaf = True
    assert radar.find_baud_rate() is None
    uart.deaf, uart.baudrate = False, 115200  # as after a restart
    assert radar.ping() is PongCode.XTS_SPRP_READY


@pytest.mark.parametrize("rate", [115200, 921600], ids=["restarted", "kept its power"])
def test_uart_is_found_again_at_either_rate(plugged: DriverOn, machine: Machine, rate: int) -> None:
    uart, back = UartModule(), UartModule()
    back.baudrate = rate
    machine.plug(HOME, back)
    radar, line = plugged(uart, reconnect_s=9.0)
    uart.connect(line, 115200)
    radar._link.bytes_per_s = line.bytes_per_s
    radar.set_baud_rate(921600)
    radar.ping()
    unplug(line)
    assert radar.ping() is PongCode.XTS_SPRP_READY
    assert back.baudrate == 921600
    assert radar.reconnects == 1


def test_closing_after_the_module_vanished_does_not_look_for_it(
    plugged: DriverOn, machine: Machine
) -> None:
    radar, line = plugged(reconnect_s=9.0)
    with radar:
        radar.configure_raw()
        began_ns = line.now_ns
        unplug(line)
    assert line.now_ns - began_ns < 1_000_000
    assert machine.lines == []


# --- another radar ------------------------------------------------------------------------------


class Streaming(PlainModule):
    """Another module, which sends frames, texts and damage without being asked."""

    def __call__(self, command: m.Message) -> Said:
        said = [frame(n) for n in range(500, 600, 7)]
        text = m.DataString(content_id=0, info=0, text="of another module")
        return [*said, text, BOOTING, READY, b"\x7d\x01\x7e", *super().__call__(command), said[0]]


@pytest.mark.parametrize("place", [HOME, DECOY, ELSEWHERE])
@pytest.mark.parametrize("returns", [True, False], ids=["returns", "stays away"])
def test_nothing_of_another_module_reaches_the_caller(
    plugged: DriverOn, machine: Machine, place: str, returns: bool
) -> None:
    """Not its frames, texts, restarts, damage, counters or bytes."""
    path = next(path for path in (ELSEWHERE, HOME) if path != place)
    machine.plug(place, Streaming("999999999999"))
    back = PlainModule()
    back.stream = (frame(1), frame(2))
    if returns:
        machine.plug(path, back, from_s=2.0)
    radar, line = plugged(reconnect_s=9.0)
    heard: list[Any] = []
    radar.listener = lambda message, t_ns: heard.append(message)
    radar.raw_listener = lambda direction, data, t_ns: heard.append(data)
    radar.configure_raw()
    radar.start(17.0)
    line.say(frame(40))
    assert radar.read_frame().counter == 40
    before = radar.statistics.summary()
    unplug(line)
    heard.clear()
    if returns:
        assert [(got.counter, got.stream) for got in radar.frames(2)] == [(1, 1), (2, 1)]
        assert (radar.port, radar.messages_waiting()) == (path, 0)
    else:
        with pytest.raises(Disconnected, match="did not come back within 9 s"):
            radar.read_frame()
        assert heard == []
        assert radar.statistics.summary() == before
    assert machine.asked(place)
    assert {one.info for one in heard if isinstance(one, m.DataFloat)} <= {1, 2}
    assert not [one for one in heard if isinstance(one, m.DataString | m.System)]
    assert not [
        one for one in heard if isinstance(one, bytes) and frame(500).values.tobytes() in one
    ]
    assert (radar.fault_count, radar.reboots, radar.stray_count) == (0, 0, 0)
    assert radar.frames_discarded == 0


def test_bytes_behind_the_answer_by_which_a_module_is_recognised_count(
    plugged: DriverOn, machine: Machine
) -> None:
    """The rest of a frame whose beginning came before is neither damage nor a gap."""
    plain = PlainModule()
    cut = line_bytes(frame(8))

    def streaming(command: m.Message) -> Said:
        if command == m.SystemGetInfo(item=6):
            return [*plain(command), cut[:4000]]
        if isinstance(command, m.Ping) and len(machine.lines[-1].received) == 3:
            return [cut[4000:], *plain(command)]
        return plain(command)

    machine.plug(HOME, streaming)
    radar, line = plugged(reconnect_s=9.0)
    radar.configure_raw()
    unplug(line)
    radar.ping()
    assert (radar.fault_count, radar.reconnects) == (0, 1)
    assert radar.statistics.junk_bytes == 0


@pytest.mark.parametrize("number", [0, 1, 2])
def test_interrupted_search_leaves_no_other_module_s_line_open(
    plugged: DriverOn, machine: Machine, number: int
) -> None:
    """Else the next read would be from that module."""
    other = Streaming("999999999999")
    asked: list[m.Message] = []

    def interrupting(command: m.Message) -> Said:
        asked.append(command)
        if len(asked) == number + 1:
            raise KeyboardInterrupt
        return other(command)

    machine.plug(HOME, interrupting)
    machine.plug(ELSEWHERE, back := PlainModule())
    back.stream = (frame(1),)
    radar, line = plugged(reconnect_s=9.0)
    radar.configure_raw()
    radar.start(17.0)
    unplug(line)
    if number < 2:
        with pytest.raises(KeyboardInterrupt):
            radar.read_frame()
        assert all(opened.closed for opened in machine.lines)
    assert radar.read_frame().counter == 1
    assert radar.port == ELSEWHERE


def line_bytes(message: m.Message) -> bytes:
    return Connection(Role.MODULE).send(message)
