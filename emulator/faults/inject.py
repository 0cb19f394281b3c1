"""Faults for a test, by name: armed within a block, and counted.

>>> from emulator.faults.plan import fault_spec
>>> fault_spec("counter_jump", frames=3).row.layer.value
'stream'
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from emulator.faults.armed import Armed
from emulator.faults.faulty_device import FaultyDevice
from emulator.faults.plan import fault_spec

__all__ = ["Injection", "fault"]


class Injection:
    """A fault that was armed within a block."""

    def __init__(self, armed: Armed) -> None:
        self._armed = armed

    @property
    def injected(self) -> int:
        """How often it was injected so far."""
        return self._armed.firings


@contextmanager
def fault(device: FaultyDevice, kind: str, **keys: Any) -> Iterator[Injection]:  # noqa: ANN401 - validated
    """Arm a fault within a block; it is cleared at its end.

    Parameters
    ----------
    device
        The module to spoil.
    kind
        See `xethru-emulator faults`.
    keys
        Those of a scenario file (``count``, ``every``, ``command`` ...); what is none of them is
        a parameter of the kind.

    Raises
    ------
    FaultPlanError
        Naming the key and what is allowed.
    """
    number = device.add(fault_spec(kind, **keys))
    armed = device.armed[-1]
    try:
        yield Injection(armed)
    finally:
        device.clear(number)
