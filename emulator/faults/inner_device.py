"""What the faults need of the module that they spoil."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

__all__ = ["EmulatedInside", "InnerDevice"]


class InnerDevice(Protocol):
    """A module as its port sees it: see `emulator.device.Device`."""

    @property
    def wants_data(self) -> bool:
        """Whether more bytes should be read from the host now."""
        ...

    def receive_data(self, data: bytes, now_ns: int) -> None:
        """Take bytes from the host."""
        ...

    def advance(self, now_ns: int) -> None:
        """Let time pass."""
        ...

    def next_packet(self, now_ns: int) -> bytes | None:
        """Return the next packet to send now."""
        ...

    def wake_ns(self, now_ns: int) -> int | None:
        """Return when time alone changes something."""
        ...

    def port_opened(self, now_ns: int) -> None:
        """Learn that a host opened the port."""
        ...

    def port_closed(self, now_ns: int) -> None:
        """Learn that the last host closed the port."""
        ...


@runtime_checkable
class EmulatedInside(Protocol):
    """What an emulated module has beyond that: its inside can be made to fail."""

    @property
    def listens(self) -> bool:
        """Whether it hears the host: not while it starts or sleeps."""
        ...

    def crash(self, reason: str, now_ns: int) -> None:
        """Restart at once as after a fault, which counts towards safe mode."""
        ...

    def power_cycle(self, now_ns: int) -> None:
        """Restart at once as after a power cut, which forgets the faults."""
        ...
