"""Restarting a module as no host could: by a fault of its own, or by a power cut."""

from __future__ import annotations

from emulator.faults.inner_device import EmulatedInside, InnerDevice
from emulator.faults.packets import command_bytes
from xethru_protocol.messages import ModReset

__all__ = ["Power"]


class Power:
    """Power and watchdog of one module.

    A module that is not emulated here, as one behind a proxy, can only be told to reset itself.

    Parameters
    ----------
    module
        The module.

    Attributes
    ----------
    deaf
        Whether a module that was told to reset is to be taken for gone, until it says BOOTING.
    """

    def __init__(self, module: InnerDevice) -> None:
        self._module = module
        self._inside = module if isinstance(module, EmulatedInside) else None
        self.deaf = False

    @property
    def hears(self) -> bool:
        """Whether the module hears the host."""
        return not self.deaf and (self._inside is None or self._inside.listens)

    def crash(self, reason: str, now_ns: int) -> None:
        """Restart the module as by a fault, which it counts towards safe mode."""
        if self._inside is None:
            self._reset(now_ns)
        else:
            self._inside.crash(reason, now_ns)

    def cycle(self, now_ns: int) -> None:
        """Cut the power and give it back, which makes the module forget its faults."""
        if self._inside is None:
            self._reset(now_ns)
        else:
            self._inside.power_cycle(now_ns)

    def _reset(self, now_ns: int) -> None:
        self.deaf = True
        self._module.receive_data(command_bytes(ModReset()), now_ns)
