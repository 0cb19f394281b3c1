"""One module on two lines: its own port, and a guest that has the module while it is there.

A module talks to one host at a time. While a guest is connected, the port is deaf and dumb: what a
host writes there is lost, as on a line that leads nowhere.
"""

from __future__ import annotations

from emulator.server import ByteDevice

__all__ = ["DeviceSide", "SharedDevice"]


class SharedDevice:
    """A device and who has it.

    Parameters
    ----------
    device
        The module.

    Attributes
    ----------
    port, guest
        The two sides, each a `emulator.server.ByteDevice`.
    guest_present
        Whether the guest has the module.
    """

    def __init__(self, device: ByteDevice) -> None:
        self.device = device
        self.guest_present = False
        self.port = DeviceSide(self, guest=False)
        self.guest = DeviceSide(self, guest=True)


class DeviceSide:
    """The module as one of its two lines sees it."""

    def __init__(self, shared: SharedDevice, *, guest: bool) -> None:
        self._shared = shared
        self._guest = guest

    @property
    def wants_data(self) -> bool:
        """Whether to read from the host; what is read without having the module is thrown away."""
        return not self._has_it or self._shared.device.wants_data

    def receive_data(self, data: bytes, now_ns: int) -> None:
        """Take bytes from the host."""
        if self._has_it:
            self._shared.device.receive_data(data, now_ns)

    def advance(self, now_ns: int) -> None:
        """Let time pass, whoever has the module."""
        self._shared.device.advance(now_ns)

    def next_packet(self, now_ns: int) -> bytes | None:
        """Return the next packet to send now; None without the module."""
        return self._shared.device.next_packet(now_ns) if self._has_it else None

    def wake_ns(self, now_ns: int) -> int | None:
        """Return when time alone changes something; None without the module."""
        return self._shared.device.wake_ns(now_ns) if self._has_it else None

    @property
    def _has_it(self) -> bool:
        return self._shared.guest_present is self._guest
