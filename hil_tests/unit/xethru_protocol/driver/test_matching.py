"""Answers to questions: the matcher alone, then both drivers on a scripted module.

The module answers in order. Codes and values are those of the protocol reference, 5 and 5.1.
"""

from collections.abc import Sequence

import pytest

from hil_tests.unit.xethru_protocol.both_drivers import DriverOn
from hil_tests.unit.xethru_protocol.scripted import READY, frame
from xethru_protocol.driver.matching import Matcher
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import PongCode, X4Setting
from xethru_protocol.wire.errors import DeviceError, ResponseTimeout

Said = Sequence[m.Message | bytes]
FIRST = m.X4DriverSet(setting=X4Setting.DACMIN, value=949)
SECOND = m.X4DriverSet(setting=X4Setting.TXPOWER, value=9)
NOT_READY = m.Pong(value=PongCode.XTS_SPRP_NOTREADY)


def silent(command: m.Message) -> Said:
    return []


GET = m.X4DriverGet(setting=X4Setting.DACMAX)
VALUE = m.ReplyInt(content_id=X4Setting.DACMAX, values=(1100,))
ANOTHER_VALUE = m.ReplyInt(content_id=X4Setting.DACMIN, values=(949,))
ECHO = m.BootloaderEcho(data=b"now")


@pytest.mark.parametrize(
    ("question", "came", "answer", "strays", "patience_s"),
    [
        (GET, [], None, 0, None),
        (GET, [VALUE], VALUE, 0, 0.0),
        (GET, [m.Error(code=1)], m.Error(code=1), 0, 0.0),
        (GET, [m.Ack(), ANOTHER_VALUE, VALUE], VALUE, 2, 0.0),
        (GET, [ANOTHER_VALUE], None, 1, 0.5),  # a quarter of its two seconds
        (GET, [m.DataString(text="no answer")], None, 0, None),
        (ECHO, [m.BootloaderError(code=1)], None, 1, None),
        (
            ECHO,
            [m.BootloaderEchoed(data=b"old"), m.BootloaderEchoed(data=b"now")],
            m.BootloaderEchoed(data=b"now"),
            1,
            0.0,
        ),
        (m.Ping(), [NOT_READY], NOT_READY, 0, 0.0),
        (m.Ping(), [NOT_READY, READY], READY, 1, 0.0),
        (m.Ping(), [m.Ack()], None, 1, None),
    ],
)
def test_matcher_finds_the_answer(
    question: m.Command[m.Response],
    came: list[m.Response],
    answer: m.Response | None,
    strays: int,
    patience_s: float | None,
) -> None:
    matcher = Matcher()
    matcher.ask(question, 2.0)
    for message in came:
        assert matcher.take(message) is not isinstance(message, m.DataString)
    assert matcher.match() == patience_s
    assert matcher.answer == answer
    assert matcher.stray_count == strays


def test_matcher_waits_a_quarter_second_for_a_pong_that_may_be_due() -> None:
    matcher = Matcher()
    for _ in range(2):
        matcher.ask(m.Ping(), 2.0)
    matcher.take(NOT_READY)
    assert matcher.match() == 0.25
    matcher.take(READY)
    assert (matcher.match(), matcher.answer) == (0.0, READY)
    matcher.settle()
    assert not matcher.pongs_possible


def test_a_token_settles_what_was_asked_before_it() -> None:
    matcher = Matcher()
    matcher.ask(m.Ping(), 2.0)
    matcher.ask(GET, 2.0)
    assert matcher.answer_owed
    token = matcher.token()
    matcher.ask(token, 2.0, as_token=True)
    for late in (READY, VALUE, m.Error(code=1)):
        matcher.take(late)
    assert matcher.match() is None
    matcher.take(m.ReplyString(content_id=0x58, info=token.item, text="1.6.8"))
    assert matcher.match() == 0.0
    matcher.settle()
    assert (matcher.answer_owed, matcher.pongs_possible) == (False, 0)
    assert matcher.token() != token  # its late answer would be taken for this one's


# --- drivers ------------------------------------------------------------------------------------


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

    line.answer = slow
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
    line.answer = lambda command: [NOT_READY, NOT_READY, NOT_READY, READY]
    began_ns = line.now_ns
    assert radar.ping() is PongCode.XTS_SPRP_READY
    assert line.now_ns - began_ns < 100_000_000  # all that were owed came: nothing to wait for
    assert radar.stray_count == 3


def test_pongs_a_module_never_sent_cost_a_quarter_second_once(driver_on: DriverOn) -> None:
    radar, line = driver_on(silent)
    for _ in range(3):
        with pytest.raises(ResponseTimeout):
            radar.ping()
    line.answer = lambda command: [READY]  # it was off meanwhile and owes nothing
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
    line.answer = lambda command: [READY]
    began_ns = line.now_ns
    assert radar.ping(0.1) is PongCode.XTS_SPRP_READY
    assert line.now_ns - began_ns == pytest.approx(100_000_000, abs=1_000_000)


def test_all_that_came_before_a_request_is_no_answer_to_it(driver_on: DriverOn) -> None:
    radar, line = driver_on(lambda command: [m.Ack()])
    line.say(frame(0), frame(1), m.Error(code=21))
    assert radar.request(FIRST) == m.Ack()
    assert radar.stray_count == 1
