"""The X4 radar chip: settings, registers, frame timing, downconversion."""

from __future__ import annotations

from enum import StrEnum


class Pace(StrEnum):
    """The two clocks of an emulated module; here because command lines load nothing heavier.

    What a frame holds never depends on the pace; only when, and whether, it arrives does.
    """

    ASAP = "asap"
    """The device's clock waits for the line: frames come as fast as the host reads, none lost."""
    REALTIME = "realtime"
    """Frames come at absolute deadlines; a host too slow loses them as the firmware does."""
