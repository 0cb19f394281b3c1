"""Counting resets caused by faults: ten in a row start safe mode, more the bootloader.

Source: protocol reference 8.5 and 11, row 18.
"""

from __future__ import annotations

__all__ = ["BOOTLOADER_FAULTS", "SAFE_MODE_FAULTS", "FaultCounter"]

SAFE_MODE_FAULTS = 10
"""Consecutive faults that start safe mode."""
BOOTLOADER_FAULTS = 15
"""Faults that are still answered with safe mode; the next one ends in the bootloader."""


class FaultCounter:
    """Consecutive faults of one module.

    Parameters
    ----------
    memory_ns
        Time without fault after which the count begins anew.

    Attributes
    ----------
    count
        Faults in a row.
    """

    def __init__(self, memory_ns: int) -> None:
        self._memory_ns = memory_ns
        self._last_ns: int | None = None
        self.count = 0

    @property
    def safe(self) -> bool:
        """Whether the module restarts in safe mode."""
        return self.count >= SAFE_MODE_FAULTS

    @property
    def hopeless(self) -> bool:
        """Whether the module restarts in the bootloader."""
        return self.count > BOOTLOADER_FAULTS

    def fault(self, now_ns: int) -> None:
        """Count a reset caused by a fault."""
        if self._last_ns is not None and now_ns - self._last_ns >= self._memory_ns:
            self.count = 0
        self.count += 1
        self._last_ns = now_ns

    def clear(self) -> None:
        """Forget all, as after a reset that was asked for."""
        self.count = 0
        self._last_ns = None
