"""What a procedure wants of the line, step by step, so that it need not know who carries it out.

A procedure is a generator that yields steps and returns its result. `X4M300` carries steps out on
a line that blocks, `AsyncX4M300` on one that does not; the procedures are the same.
"""

from collections.abc import Generator
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias, TypeVar


class Read(NamedTuple):  # several per frame: twice as fast to make as a frozen dataclass
    """Hear what comes, waiting up to ``timeout_s`` for its first byte; answered by whether any."""

    timeout_s: float


@dataclass(frozen=True, slots=True)
class Write:
    """Send bytes."""

    data: bytes


@dataclass(frozen=True, slots=True)
class Sleep:
    """Wait while there is no line to hear from."""

    seconds: float


@dataclass(frozen=True, slots=True)
class CloseLine:
    """Release the line."""


@dataclass(frozen=True, slots=True)
class OpenLine:
    """Open a line in place of one that was closed; raises `PortUnavailable`."""

    path: str
    baudrate: int


@dataclass(frozen=True, slots=True)
class SetLineRate:
    """Change this side's baud rate; no effect on lines that have none."""

    baudrate: int


Step: TypeAlias = Read | Write | Sleep | CloseLine | OpenLine | SetLineRate
T = TypeVar("T")
Procedure: TypeAlias = Generator[Step, bool, T]
