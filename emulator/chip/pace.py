"""How fast an emulated module's clock runs."""

from __future__ import annotations

from enum import StrEnum

__all__ = ["Pace"]


class Pace(StrEnum):
    """The two clocks of an emulated module.

    What a frame holds never depends on the pace; only when, and whether, it arrives does.
    """

    ASAP = "asap"
    """The device's clock waits for the line: frames come as fast as the host reads, none lost."""
    REALTIME = "realtime"
    """Frames come at absolute deadlines; a host too slow loses them as the firmware does."""
