"""Answers that come late, and PONGs that were given up: both drivers on a scripted module.

The module answers in order. Codes and values are those of the protocol reference, 5 and 5.1.
"""

from collections.abc import Sequence

import pytest

from hil_tests.unit.xethru_protocol.both_drivers import DriverOn
from hil_tests.unit.xethru_protocol.scripted import READY, frame
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import PongCode, X4Setting
from xethru_protocol.wire.errors import DeviceError, ResponseTimeout

Said = Sequence[m.Message | bytes]
FIRST = m.X4DriverSet(setting=X4Setting.DACMIN, value=949)
SECOND = m.X4DriverSet(setting=X4Setting.TXPOWER, value=9)
NOT_READY = m.Pong(value=PongCode.XTS_SPRP_NOTREADY)


def silent(command: m.Message) -> Said:
    return []


def test_answer_behind_a_late_pong_is_not_taken_for_the_next_commands(driver_on: DriverOn) -> None:
    radar, line = driver_on(silent)
    with pytest.raises(ResponseTimeout):
        radar.ping()  # its PONG is owed from now on
    with pytest.raises(ResponseTimeout):
        radar.request(FIRST)  # and so is this ACK

    def slow(command: m.Message) -> Said:
        if isinstance(command, m.SystemGetInfo):
            version = m.ReplyString(content_id=0x58, info=command.item, text="1.6.8")
            line.say_later(0.1, m.Ack(), version)  # FIRST's and this one's
            return [READY]  # the one that was owed
        line.say_later(0.2, m.Error(code=21))  # in order: behind the others
        return []

    line._answer = slow
    with pytest.raises(DeviceError) as caught:
        radar.request(SECOND)
    assert caught.value.code == 21  # not the ACK of FIRST
    # a PONG would not say which PING it answers; this answer names its question (5.3)
    assert line.received[2:] == [m.SystemGetInfo(item=3), SECOND]


def test_ping_tells_the_state_of_now_not_of_a_late_pong(driver_on: DriverOn) -> None:
    radar, line = driver_on(silent)
    for _ in range(3):
        with pytest.raises(ResponseTimeout):
            radar.ping()
    line._answer = lambda command: [NOT_READY, NOT_READY, NOT_READY, READY]
    began_ns = line.now_ns
    assert radar.ping() is PongCode.XTS_SPRP_READY
    assert line.now_ns - began_ns < 100_000_000  # all that were owed came: nothing to wait for
    assert radar.stray_count == 3


def test_pongs_a_module_never_sent_cost_a_quarter_second_once(driver_on: DriverOn) -> None:
    radar, line = driver_on(silent)
    for _ in range(3):
        with pytest.raises(ResponseTimeout):
            radar.ping()
    line._answer = lambda command: [READY]  # it was off meanwhile and owes nothing
    began_ns = line.now_ns
    assert radar.ping() is PongCode.XTS_SPRP_READY
    assert line.now_ns - began_ns == pytest.approx(250_000_000, abs=1_000_000)
    began_ns = line.now_ns
    assert radar.ping() is PongCode.XTS_SPRP_READY
    assert line.now_ns - began_ns < 1_000_000


def test_waiting_for_owed_pongs_never_outlasts_the_timeout(driver_on: DriverOn) -> None:
    radar, line = driver_on(silent)
    for _ in range(2):
        with pytest.raises(ResponseTimeout):
            radar.ping()
    line._answer = lambda command: [READY]
    began_ns = line.now_ns
    assert radar.ping(0.1) is PongCode.XTS_SPRP_READY
    assert line.now_ns - began_ns == pytest.approx(100_000_000, abs=1_000_000)


def test_all_that_came_before_a_request_is_no_answer_to_it(driver_on: DriverOn) -> None:
    radar, line = driver_on(lambda command: [m.Ack()])
    line.say(frame(0), frame(1), m.Error(code=21))
    assert radar.request(FIRST) == m.Ack()
    assert radar.stray_count == 1


def test_frames_that_stream_do_not_put_off_a_timeout(driver_on: DriverOn) -> None:
    radar, line = driver_on(silent)
    for k in range(60):
        line.say_later(0.05 * k, frame(k))
    with pytest.raises(ResponseTimeout):
        radar.request(FIRST)
    assert 2.0e9 <= line.now_ns < 2.1e9
