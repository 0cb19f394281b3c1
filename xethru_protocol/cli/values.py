"""What may be given on the command line: each function turns a text into a value, or refuses."""

import math
from argparse import ArgumentTypeError

_LONGEST_S = 1e9  # 30 years


def frame_rate(text: str) -> float:
    """Read frames per second."""
    value = _number(text)
    if not 0 < value < 65536:
        raise ArgumentTypeError(f"{text!r} must be a number between 0 and 65536")
    return value


def seconds(text: str) -> float:
    """Read a time span [s]."""
    value = _number(text)
    if not 0 < value <= _LONGEST_S:
        raise ArgumentTypeError(f"{text!r} must be seconds, more than 0")
    return value


def metres(text: str) -> float:
    """Read a distance [m], a hundred times what any radar sees."""
    value = _number(text)
    if not -1000 <= value <= 1000:
        raise ArgumentTypeError(f"{text!r} must be metres between -1000 and 1000")
    return value


def not_empty(text: str) -> str:
    """Read a name."""
    if not text:
        raise ArgumentTypeError("an empty name is none")
    return text


def text(text: str) -> str:
    """Read a text."""
    try:
        text.encode()
    except UnicodeEncodeError:  # bytes that the shell passed on
        raise ArgumentTypeError("this is no text in UTF-8") from None
    return text


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan  # in no range: the caller says what is allowed


def at_least_one(text: str) -> int:
    """Read a count."""
    try:
        value = int(text)
    except ValueError:
        value = 0
    if value < 1:
        raise ArgumentTypeError(f"{text!r} must be a whole number from 1 on")
    return value


def baud_rate(text: str) -> int:
    """Read a rate that a module could be set to (Protocol reference 4.10)."""
    try:
        value = int(text)
    except ValueError:
        value = 0
    if not 600 <= value <= 10_000_000:
        raise ArgumentTypeError(f"{text!r} must be a whole number from 600 to 10000000")
    return value
