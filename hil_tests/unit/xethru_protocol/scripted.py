"""A line to a module that says what a test wrote down, on a virtual clock."""

from collections.abc import Callable, Sequence

import numpy as np

from xethru_protocol import messages as m
from xethru_protocol.codes import PongCode, X4Setting
from xethru_protocol.connection import Connection, Role
from xethru_protocol.errors import Disconnected
from xethru_protocol.packets import NEED_DATA

Answer = Callable[[m.Message], Sequence[m.Message | bytes]]
READY = m.Pong(value=PongCode.XTS_SPRP_READY)


class ScriptedTransport:
    """Answers each command with what ``answer(command)`` returns; raw bytes go out as they are."""

    def __init__(self, answer: Answer) -> None:
        self.name = "the port"
        self.now_ns = 0
        self.received: list[m.Message] = []
        self.closed = False
        self.pending: list[bytes] = []
        self._answer = answer
        self._module = Connection(Role.MODULE)

    def clock(self) -> int:
        """Virtual time."""
        return self.now_ns

    def say(self, *said: m.Message | bytes) -> None:
        """Put something on the line, as one read each."""
        self.pending += [
            item if isinstance(item, bytes) else self._module.send(item) for item in said
        ]

    def read(self, timeout_s: float) -> bytes:
        """Next piece, or nothing after the virtual timeout."""
        if self.pending:
            self.now_ns += 1_000
            return self.pending.pop(0)
        self.now_ns += round(timeout_s * 1e9)
        return b""

    def write(self, data: bytes) -> None:
        """Take a command."""
        if self.closed:
            raise Disconnected("the port was closed")
        self._module.receive_data(data)
        while (event := self._module.next_event()) is not NEED_DATA:
            assert isinstance(event, m.Message)
            self.received.append(event)
            self.say(*self._answer(event))

    def close(self) -> None:
        """Note it."""
        self.closed = True


def frame(counter: int, bins: int = 1431) -> m.DataFloat:
    """Make a frame whose samples all equal its counter."""
    return m.DataFloat(info=counter, values=np.full(bins, counter, np.float32))


def plain_module(  # noqa: PLR0911 - one return per command
    command: m.Message,
) -> Sequence[m.Message | bytes]:
    """Answers of a module with the read-backs of the golden vectors for 0.2 ... 9.4 m."""
    match command:
        case m.Ping():
            return [READY]
        case m.X4DriverGet(setting=X4Setting.FRAMEAREA):
            area = (0.19929012656211853, 9.400678634643555)
            return [m.ReplyFloat(content_id=X4Setting.FRAMEAREA, values=area)]
        case m.X4DriverGet(setting=X4Setting.FRAMEBINCOUNT):
            return [m.ReplyInt(content_id=X4Setting.FRAMEBINCOUNT, values=(1431,))]
        case m.X4DriverGet(setting=X4Setting.FPS):
            return [m.ReplyFloat(content_id=X4Setting.FPS, values=(17.049379348754883,))]
        case m.SystemGetInfo(item=6):
            return [m.ReplyString(content_id=0x58, info=6, text="123456789012")]
        case m.SystemGetInfo() | m.X4DriverGet():
            return [m.Error(code=1)]
        case m.GetMode():
            return [m.ReplyByte(values=b"\x12")]
    return [m.Ack()]
