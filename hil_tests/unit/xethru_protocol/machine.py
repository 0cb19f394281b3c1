"""A machine with ports at which scripted modules appear, on one virtual clock."""

from collections.abc import Callable

from hil_tests.unit.xethru_protocol.scripted import Answer, ScriptedTransport
from xethru_protocol.errors import PortUnavailable


class Machine:
    """Which module is behind which port, and from when on.

    Attributes
    ----------
    lines
        Every line that was opened, in order.
    """

    def __init__(self, *paths: str) -> None:
        self.lines: list[ScriptedTransport] = []
        self._paths = paths
        self._behind: dict[str, tuple[Answer, int]] = {}
        self._first: ScriptedTransport | None = None

    def plug(self, path: str, module: Answer, from_s: float = 0.0) -> None:
        """Put a module behind a port."""
        self._behind[path] = (module, round(from_s * 1e9))

    def runs_on(self, first: ScriptedTransport) -> None:
        """Take the time from this line."""
        self._first = first

    @property
    def ports(self) -> dict[str, Callable[[], ScriptedTransport]]:
        """How to open each port."""
        return {path: lambda path=path: self._open(path) for path in self._paths}  # type: ignore[misc] # a default binds it

    def asked(self, path: str) -> list[object]:
        """Everything the module behind a port was asked."""
        return [command for line in self.lines if line.name == path for command in line.received]

    def _open(self, path: str) -> ScriptedTransport:
        assert self._first is not None
        module, from_ns = self._behind.get(path, (None, 0))
        if module is None or self._first.now_ns < from_ns:
            raise PortUnavailable(f"there is no port {path}")
        line = _SameClock(module, path, self._first)
        self.lines.append(line)
        return line


class _SameClock(ScriptedTransport):
    """A line whose time is that of another."""

    def __init__(self, module: Answer, name: str, first: ScriptedTransport) -> None:
        self._first = first
        super().__init__(module, name)

    @property
    def now_ns(self) -> int:
        """Time of the first line."""
        return self._first.now_ns

    @now_ns.setter
    def now_ns(self, value: int) -> None:
        if value:  # not a new line's 0
            self._first.now_ns = value
