"""A line to a module that says what a test wrote down, on a virtual clock."""

import math
import re
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import PongCode, X4Setting
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.errors import Disconnected
from xethru_protocol.wire.framing import NEED_DATA

Answer = Callable[[m.Message], Sequence[m.Message | bytes]]
READY = m.Pong(value=PongCode.XTS_SPRP_READY)


class ScriptedTransport:
    """Answers each command with what ``answer(command)`` returns; raw bytes go out as they are.

    ``gone`` makes the line one whose module was unplugged.
    """

    def __init__(self, answer: Answer, name: str = "the port") -> None:
        self.name = name
        self.now_ns = 0
        self.received: list[m.Message] = []
        self.closed = False
        self.gone = False
        self.vanishes_ns: int | None = None
        self.bytes_per_s = math.inf
        self.set_baudrate: Callable[[int], object] = lambda baudrate: None
        self.pending: list[bytes] = []
        self.timed: list[tuple[int, bytes]] = []
        self.answer = answer
        self._module = Connection(Role.MODULE)

    def clock(self) -> int:
        return self.now_ns

    def say(self, *said: m.Message | bytes) -> None:
        self.pending += [self.bytes_of(item) for item in said]

    def say_later(self, delay_s: float, *said: m.Message | bytes) -> None:
        due_ns = self.now_ns + round(delay_s * 1e9)
        self.timed = sorted([*self.timed, *((due_ns, self.bytes_of(item)) for item in said)])

    def vanish_later(self, delay_s: float) -> None:
        self.vanishes_ns = self.now_ns + round(delay_s * 1e9)

    def bytes_of(self, item: m.Message | bytes) -> bytes:
        return item if isinstance(item, bytes) else self._module.send(item)

    def read(self, timeout_s: float) -> bytes:
        """Next piece, or nothing after the virtual timeout."""
        self._check_open()
        end_ns = self.now_ns + round(min(timeout_s, 1e9) * 1e9)
        if not self.pending and self.timed and self.timed[0][0] <= end_ns:
            due_ns, data = self.timed.pop(0)
            self.now_ns = max(self.now_ns, due_ns)
            self.pending.append(data)
        if self.pending:
            self.now_ns += 1_000
            return self.pending.pop(0)
        if self.vanishes_ns is not None and self.vanishes_ns <= end_ns:
            self.now_ns = max(self.now_ns, self.vanishes_ns)
            self.gone = True
            self._check_open()
        self.now_ns = end_ns
        return b""

    def write(self, data: bytes) -> None:
        self._check_open()
        self._module.receive_data(data)
        while (event := self._module.next_event()) is not NEED_DATA:
            assert isinstance(event, m.Message)
            self.received.append(event)
            self.say(*self.answer(event))

    def close(self) -> None:
        self.closed = True

    def _check_open(self) -> None:
        if self.closed or self.gone:
            raise Disconnected(f"{self.name} was disconnected")


def framed(payload: bytes) -> bytes:
    """Frame a payload as Protocol reference 1.1 says, without the product's encoder."""
    checksum = 0x7D
    for byte in payload:
        checksum ^= byte
    content = re.sub(rb"[\x7d-\x7f]", b"\x7f\\g<0>", payload + bytes([checksum]))
    return b"\x7d" + content + b"\x7e"


def frame(counter: int, bins: int = 1431) -> m.DataFloat:
    """Make a frame whose samples all equal its counter."""
    return m.DataFloat(info=counter, values=np.full(bins, counter, np.float32))


BYTE_SETTINGS = frozenset(  # Protocol reference 4.9, column "GET reply"
    {
        X4Setting.DOWNCONVERSION,
        X4Setting.DACSTEP,
        X4Setting.TXCENTERFREQUENCY,
        X4Setting.TXPOWER,
        X4Setting.PRFDIV,
    }
)
INT_SETTINGS = frozenset(
    {X4Setting.PULSESPERSTEP, X4Setting.ITERATIONS, X4Setting.DACMIN, X4Setting.DACMAX}
)


class PlainModule:
    """A module with the read-backs of the golden vectors for 0.2 ... 9.4 m; it keeps settings.

    ``stream`` is what it sends behind the read-back of the frame rate; a ``serial`` of None is
    one it refuses to tell. ``instead`` has other answers to single commands or to all of a type.
    """

    def __init__(
        self,
        serial: str | None = "123456789012",
        instead: Mapping[m.Message | type[m.Message], Sequence[m.Message | bytes]] | None = None,
    ) -> None:
        self.serial = serial
        self.instead = instead or {}
        self.stream: tuple[m.Message, ...] = ()
        self.settings: dict[X4Setting, m.X4Value] = {X4Setting.FRAMEAREAOFFSET: 0.18}

    def __call__(  # noqa: PLR0911 - one return per command
        self, command: m.Message
    ) -> Sequence[m.Message | bytes]:
        for key in (command, type(command)):
            if key in self.instead:
                return self.instead[key]
        match command:
            case m.Ping():
                return [READY]
            case m.X4DriverSet(setting=setting, value=value):
                self.settings[setting] = value
                return [m.Ack()]
            case m.X4DriverGet(setting=X4Setting.FRAMEAREA):
                area = (0.19929012656211853, 9.400678634643555)
                return [m.ReplyFloat(content_id=X4Setting.FRAMEAREA, values=area)]
            case m.X4DriverGet(setting=X4Setting.FRAMEBINCOUNT):
                return [m.ReplyInt(content_id=X4Setting.FRAMEBINCOUNT, values=(1431,))]
            case m.X4DriverGet(setting=X4Setting.FPS):
                rate = m.ReplyFloat(content_id=X4Setting.FPS, values=(17.049379348754883,))
                return [rate, *self.stream]
            case m.X4DriverGet(setting=setting):
                return [self._kept(setting)]
            case m.SystemGetInfo(item=6) if self.serial is not None:
                return [m.ReplyString(content_id=0x58, info=6, text=self.serial)]
            case m.SystemGetInfo():
                return [m.Error(code=1)]
            case m.GetMode():
                return [m.ReplyByte(values=b"\x12")]
        return [m.Ack()]

    def _kept(self, setting: X4Setting) -> m.Response:
        value = self.settings.get(setting)
        if isinstance(value, float):
            return m.ReplyFloat(content_id=setting, values=(value,))
        if isinstance(value, int) and setting in BYTE_SETTINGS:
            return m.ReplyByte(content_id=setting, values=bytes([value]))
        if isinstance(value, int) and setting in INT_SETTINGS:
            return m.ReplyInt(content_id=setting, values=(value,))
        return m.Error(code=1)
