"""Answers that come late or never: no command ever gets another one's."""

from collections.abc import Sequence

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from hil_tests.unit.xethru_protocol.scripted import READY, ScriptedTransport
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import X4Setting
from xethru_protocol.wire.errors import DeviceError, ResponseTimeout

_SECOND = 1_000_000_000
_WORK_NS = 20_000_000
TAG = 1000  # above all codes that have a meaning


class StallingModule:
    """Answers in order, one per 20 ms, and after a stall all that waited; some answers are lost.

    A SET is refused with the number that was to be set, so that each answer names its command.
    """

    def __init__(self, stalls: Sequence[tuple[int, int]], losses: set[int]) -> None:
        self._stalls = stalls
        self._losses = losses
        self._count = 0
        self._busy_until_ns = 0
        self.line = ScriptedTransport(self)

    def __call__(self, command: m.Message) -> Sequence[m.Message | bytes]:
        """Say nothing now; the answer is due when the stall is over."""
        self._count += 1
        now_ns = self.line.now_ns
        end_ns = max((end for begin, end in self._stalls if begin <= now_ns < end), default=now_ns)
        self._busy_until_ns = end_ns = max(end_ns, self._busy_until_ns + _WORK_NS)
        if self._count in self._losses:
            return []
        answer: m.Message = READY
        if isinstance(command, m.X4DriverSet):
            assert isinstance(command.value, int)
            answer = m.Error(code=command.value)
        self.line.say_later((end_ns - now_ns) * 1e-9, answer)
        return []


@st.composite
def stalls(draw: st.DrawFn) -> list[tuple[int, int]]:
    begins = draw(st.lists(st.integers(0, 60), max_size=5, unique=True).map(sorted))
    lengths = draw(st.lists(st.floats(0.5, 12.0), min_size=5, max_size=5))
    return [
        (begin * _SECOND, begin * _SECOND + round(length * _SECOND))
        for begin, length in zip(begins, lengths, strict=False)
    ]


@settings(deadline=None, max_examples=150)
@given(
    stalls(),
    st.sets(st.integers(1, 30), max_size=8),
    st.lists(st.sampled_from(["ping", "set", "wait"]), min_size=1, max_size=25),
)
def test_no_command_gets_the_answer_of_another(
    stalled: list[tuple[int, int]], losses: set[int], actions: list[str]
) -> None:
    module = StallingModule(stalled, losses)
    radar = X4M300(module.line, clock=module.line.clock)
    for number, action in enumerate(actions, start=TAG):
        if action == "wait":
            module.line.now_ns += _SECOND // 2
            continue
        command = m.X4DriverSet(setting=X4Setting.PULSESPERSTEP, value=number)
        code = number
        try:
            radar.request(m.Ping() if action == "ping" else command)
        except ResponseTimeout:
            continue
        except DeviceError as error:
            code = error.code
        assert code == number


@settings(deadline=None, max_examples=100)
@given(st.lists(st.integers(1, 4000), min_size=1, max_size=40))
def test_replies_and_frames_survive_any_chunking(sizes: list[int]) -> None:
    line = ScriptedTransport(lambda command: [])
    radar = X4M300(line, clock=line.clock)
    heard: list[m.Response] = []
    radar.listener = lambda message, t_ns: heard.append(message)
    said: list[m.Message] = [
        m.DataFloat(info=1, values=np.arange(300, dtype=np.float32)),
        m.System(code=0x11),
        m.DataFloat(info=2, values=np.zeros(0, np.float32)),
        READY,
    ]
    stream = b"".join(line._bytes(message) for message in said)
    position = 0
    while position < len(stream):
        size = sizes[position % len(sizes)]
        line.say(stream[position : position + size])
        position += size
    while line.pending:
        radar._pump(0.0)
    assert heard == said
    assert radar.fault_count == 0
