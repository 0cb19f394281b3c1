"""Rates of a module's UART.

Source: protocol reference 4.10 and chapter 10.
"""

from __future__ import annotations

__all__ = ["DEFAULT_BAUDRATE", "accepted_baudrate"]

DEFAULT_BAUDRATE = 115_200
"""After every power-up; a rate is never saved."""
_SLOWEST, _FASTEST = 600, 10_000_000


def accepted_baudrate(wanted: int, current: int) -> int:
    """Return the rate after SETBAUDRATE; one the firmware ignores changes nothing.

    Examples
    --------
    >>> accepted_baudrate(921_600, 115_200), accepted_baudrate(599, 115_200)
    (921600, 115200)
    """
    return wanted if _SLOWEST <= wanted <= _FASTEST else current
