"""A machine with ports at which scripted modules appear, on one virtual clock."""

from collections.abc import Callable, Sequence
from functools import partial

from hil_tests.unit.xethru_protocol.scripted import Answer, PlainModule, ScriptedTransport
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.errors import PortUnavailable


class Machine:
    """Which module is behind which port, and from when on."""

    def __init__(self, *paths: str) -> None:
        self.lines: list[ScriptedTransport] = []  # every one that was opened, in order
        self._paths = paths
        self._behind: dict[str, tuple[Answer, int]] = {}
        self._first: ScriptedTransport | None = None

    def plug(self, path: str, module: Answer, from_s: float = 0.0) -> None:
        self._behind[path] = (module, round(from_s * 1e9))

    def runs_on(self, first: ScriptedTransport) -> None:
        self._first = first

    @property
    def ports(self) -> dict[str, Callable[[int], ScriptedTransport]]:
        return {path: partial(self._open, path) for path in self._paths}

    def asked(self, path: str) -> list[object]:
        return [command for line in self.lines if line.name == path for command in line.received]

    def _open(self, path: str, baudrate: int) -> ScriptedTransport:
        assert self._first is not None
        module, from_ns = self._behind.get(path, (None, 0))
        if module is None or self._first.now_ns < from_ns:
            raise PortUnavailable(f"there is no port {path}")
        line = _SameClock(module, path, self._first)
        if isinstance(module, UartModule):
            module.connect(line, baudrate)
        self.lines.append(line)
        return line


class UartModule(PlainModule):
    """A module that hears and is heard only at its own baud rate.

    ``takes_ns`` after its ACK it changes the rate, unless it is ``stubborn``, and hears nothing
    until then. Protocol reference 3.
    """

    def __init__(self, *, takes_ns: int = 500_000_000, stubborn: bool = False) -> None:
        super().__init__()
        self.baudrate = 115200
        self.deaf = False
        self._takes_ns = takes_ns
        self._stubborn = stubborn
        self._line_rate = 115200
        self._asleep_until_ns = 0
        self._now_ns: Callable[[], int] = lambda: 0

    def connect(self, line: ScriptedTransport, baudrate: int) -> None:
        self._now_ns = line.clock
        self._line_rate = baudrate
        line.bytes_per_s = 11520.0
        line.set_baudrate = self._set_line_rate

    def _set_line_rate(self, baudrate: int) -> None:
        self._line_rate = baudrate

    def __call__(self, command: m.Message) -> Sequence[m.Message | bytes]:
        if self._now_ns() < self._asleep_until_ns or self._line_rate != self.baudrate or self.deaf:
            return []
        answer = super().__call__(command)
        if isinstance(command, m.SetBaudRate):
            # behind the answer, which goes out at the old rate
            self._asleep_until_ns = self._now_ns() + self._takes_ns
            if not self._stubborn:
                self.baudrate = command.baudrate
        if isinstance(command, m.ModReset):
            self.baudrate = 115200
        return answer


class _SameClock(ScriptedTransport):
    """A line whose time is that of another."""

    def __init__(self, module: Answer, name: str, first: ScriptedTransport) -> None:
        self._first = first
        super().__init__(module, name)

    @property
    def now_ns(self) -> int:
        return self._first.now_ns

    @now_ns.setter
    def now_ns(self, value: int) -> None:
        if value:  # not a new line's 0
            self._first.now_ns = value
