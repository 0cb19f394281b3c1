"""Several hosts at one module, in virtual time: who gets what, and who may command."""

from collections.abc import Sequence

import pytest

from hil_tests.unit.xethru_protocol.scripted import frame, framed
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import ErrorCode, FileError, SystemCode, X4Error, X4Setting
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.framing import NEED_DATA
from xethru_protocol.wire.sharing import MOST_UNSENT, SETTINGS_CHANGE, Host, SharedModule

READY = m.Pong(value=0xAAEEAEEA)
FPS = m.X4DriverSet(setting=X4Setting.FPS, value=17.0)
ASK_FPS = m.X4DriverGet(setting=X4Setting.FPS)
FPS_IS = m.ReplyFloat(content_id=X4Setting.FPS, values=(17.0,))
S = 1_000_000_000


class Shared:
    """A shared module, whose side a test plays."""

    def __init__(self) -> None:
        self.to_module = bytearray()
        self.core = SharedModule(self.to_module.extend)
        self.now_ns = 0
        self._module = Connection(Role.MODULE)
        self._hosts: dict[Host, tuple[Connection, bytearray]] = {}

    def join(self, name: str) -> Host:
        unsent = bytearray()
        host = self.core.join(name, unsent.extend, unsent.__len__)
        self._hosts[host] = Connection(Role.HOST), unsent
        return host

    def ask(self, host: Host, *commands: m.Command[m.Response]) -> None:
        data = b"".join(self._hosts[host][0].send(command) for command in commands)
        self.core.receive_from_host(host, data, self.now_ns)

    def say(self, *messages: m.Response | bytes) -> None:
        data = [one if isinstance(one, bytes) else self._module.send(one) for one in messages]
        self.core.receive_from_module(b"".join(data), self.now_ns)

    def asked(self) -> list[object]:
        """Return what the module got since the last call."""
        return self._all(self._module, self.to_module)

    def got(self, host: Host) -> list[object]:
        return self._all(*self._hosts[host])

    def _all(self, end: Connection, data: bytearray) -> list[object]:
        end.receive_data(bytes(data))
        data.clear()
        found: list[object] = []
        while (event := end.next_event()) is not NEED_DATA:
            found.append(event)
        return found


def counters(messages: Sequence[object]) -> list[int]:
    return [message.info for message in messages if isinstance(message, m.DataFloat)]


def test_frames_go_to_all_and_an_answer_to_the_one_that_asked() -> None:
    shared = Shared()
    one, other = shared.join("one"), shared.join("other")
    shared.ask(one, FPS)
    assert shared.asked() == [FPS]
    shared.say(frame(1), m.Ack(), frame(2), m.System(code=SystemCode.XTS_SPRS_READY))
    seen, told = shared.got(one), shared.got(other)
    assert counters(seen) == counters(told) == [1, 2]
    assert [each for each in seen if not isinstance(each, m.DataFloat)] == [
        m.Ack(),
        m.System(code=SystemCode.XTS_SPRS_READY),
    ]
    assert m.Ack() not in told


def test_a_question_waits_until_the_others_are_answered() -> None:
    """Protocol reference 3: one at a time; an answer does not say whom it answers."""
    shared = Shared()
    one, other = shared.join("one"), shared.join("other")
    shared.ask(one, ASK_FPS)
    shared.ask(other, m.Ping())
    assert shared.asked() == [ASK_FPS]
    shared.say(FPS_IS)
    assert shared.asked() == [m.Ping()]
    shared.say(READY)
    assert shared.got(one) == [FPS_IS]
    assert shared.got(other) == [READY]


def test_an_answer_that_never_comes_holds_others_up_for_a_while_only() -> None:
    shared = Shared()
    one, other = shared.join("one"), shared.join("other")
    shared.ask(one, ASK_FPS)
    shared.ask(other, m.Ping())
    shared.ask(one, m.Ping())  # it gave up, and is not held up itself
    assert shared.asked() == [ASK_FPS, m.Ping()]
    shared.say(READY)  # so nothing answers the first question any more
    assert shared.got(one) == [READY]
    assert shared.asked() == [m.Ping()]
    shared.say(READY)
    for command, limit_ns in ((ASK_FPS, S), (FPS, 10 * S)):  # a module may ignore a question (4.4)
        shared.ask(one, command)
        shared.ask(other, m.Ping())
        assert shared.asked() == [command]
        shared.now_ns += limit_ns - 1
        shared.core.advance(shared.now_ns)
        assert shared.asked() == []
        shared.now_ns += 1
        shared.core.advance(shared.now_ns)
        assert shared.asked() == [m.Ping()]
        shared.say(READY)


@pytest.mark.parametrize(
    ("command", "code"),
    [
        (FPS, X4Error.BUSY),
        (m.X4DriverInit(), X4Error.BUSY),
        (m.ModReset(), ErrorCode.XTS_SPRE_BUSY),
        (m.DeleteFile(file_type=1, identifier=2), FileError.BUSY),
        (m.X4DriverRead(address=1, length=1), X4Error.BUSY),
    ],
)
def test_a_second_host_may_change_nothing(command: m.Command[m.Response], code: int) -> None:
    shared = Shared()
    listener, commander, second = map(shared.join, ("listener", "commander", "second"))
    shared.ask(listener, m.Ping())  # asking is no claim
    shared.ask(commander, FPS)
    shared.say(READY)
    shared.say(m.Ack())
    shared.asked()
    shared.got(second)
    shared.ask(second, command)
    text, error = shared.got(second)
    assert isinstance(text, m.DataString)
    assert "commander" in text.text
    assert error == m.Error(code=code)
    assert shared.asked() == []
    shared.core.leave(commander)
    shared.ask(second, command)
    assert shared.asked() == [command]
    assert shared.core.commander is second


def test_nobody_may_change_the_rate_of_the_line() -> None:
    shared = Shared()
    one = shared.join("one")
    shared.ask(one, m.SetBaudRate(baudrate=921600))
    assert shared.asked() == []
    assert shared.got(one)[-1] == m.Error(code=ErrorCode.XTS_SPRE_BUSY)


def test_a_slow_host_loses_whole_messages_and_the_others_none() -> None:
    shared = Shared()
    slow, quick = shared.join("slow"), shared.join("quick")
    sent, seen = 400, []
    for counter in range(sent):
        shared.say(frame(counter))
        seen += counters(shared.got(quick))
    assert seen == list(range(sent))
    assert quick.lost == 0
    frame_bytes = 9 + 14 + 4 * 1431
    kept = MOST_UNSENT // frame_bytes
    assert (slow.messages, slow.lost) == (kept, sent - kept)
    shared.ask(slow, m.Ping())  # an answer is not lost
    shared.say(READY)
    got = shared.got(slow)
    assert counters(got) == list(range(kept))
    assert got[-1] == READY
    shared.say(frame(sent))
    assert counters(shared.got(slow)) == [sent]


def test_a_host_that_goes_in_the_middle_of_a_command_leaves_the_line_whole() -> None:
    shared = Shared()
    goes, stays = shared.join("goes"), shared.join("stays")
    half = framed(b"\x50\x10\x10\x00\x00\x00")[:-4]  # of a setting
    shared.core.receive_from_host(goes, half, 0)
    shared.core.leave(goes)
    assert shared.asked() == []
    asks = shared.join("asks")
    shared.ask(asks, ASK_FPS)
    shared.ask(stays, m.Ping())
    shared.core.leave(asks)  # with its question asked
    shared.say(FPS_IS)
    assert shared.asked() == [ASK_FPS, m.Ping()]
    shared.say(READY)
    assert shared.got(stays) == [READY]


def test_a_change_is_announced_before_other_frames_can_come() -> None:
    shared = Shared()
    commander, listener = shared.join("commander"), shared.join("listener")
    notice = m.DataString(text=SETTINGS_CHANGE)
    shared.ask(commander, FPS, m.X4DriverInit(), m.X4DriverSet(setting=X4Setting.DACMIN, value=949))
    assert shared.got(listener) == [notice]  # once for all of them
    shared.ask(listener, ASK_FPS)  # it looks anew
    shared.ask(commander, FPS)
    assert shared.got(listener) == [notice]
    shared.say(m.Ack(), m.Ack(), m.Ack(), m.Ack(), frame(1))
    shared.say(FPS_IS)
    shared.ask(commander, FPS)
    assert shared.got(listener)[-1] == notice
    assert notice not in shared.got(commander)


def test_a_host_that_never_stops_asking_holds_up_nobody() -> None:
    """Answers of another host's flood come to that host only, however many there are."""
    shared = Shared()
    one, other = shared.join("one"), shared.join("other")
    shared.ask(one, *[m.Ping()] * 3000)
    shared.ask(other, ASK_FPS)
    refused = [each for each in shared.got(one) if isinstance(each, m.Error)]
    assert len(refused) > 1500
    n_asked = 0
    while ASK_FPS not in (asked := shared.asked()):
        n_asked += len(asked)
        assert 0 < asked.count(m.Ping()) == len(asked)
        assert n_asked <= 100
        shared.ask(one, m.Ping())
        shared.say(*[READY] * len(asked))
        assert shared.got(other) == []
    shared.say(FPS_IS)
    assert shared.got(other) == [FPS_IS]
    assert FPS_IS not in shared.got(one)


def test_a_module_that_restarts_answers_nothing_it_was_asked_before() -> None:
    """Protocol reference 3: what is sent after a reset is never answered."""
    shared = Shared()
    one, other = shared.join("one"), shared.join("other")
    shared.ask(one, m.ModReset(), ASK_FPS)
    shared.ask(other, m.Ping())
    shared.say(m.Ack())
    shared.asked()
    shared.say(m.System(code=SystemCode.XTS_SPRS_BOOTING))
    assert shared.asked() == [m.Ping()]
    shared.say(READY)
    assert shared.got(other)[-1] == READY


def test_damaged_bytes_are_not_passed_on() -> None:
    shared = Shared()
    one = shared.join("one")
    shared.say(frame(1), b"\x00\x7d\x50\x7e junk", frame(2))
    assert counters(shared.got(one)) == [1, 2]
