"""Types of command-line arguments that several commands share; light, for `--help`."""

from __future__ import annotations

import argparse
from pathlib import Path


def folder(text: str) -> Path:
    """Return a folder to write into; its name must be UTF-8, Rerun's writer takes no other."""
    try:
        text.encode()
    except UnicodeEncodeError:
        raise argparse.ArgumentTypeError(f"must be a UTF-8 name, not {text!r}") from None
    return Path(text)


def seed(text: str) -> int:
    """Return the seed of a random generator: a whole number, 0 or more."""
    return _whole_number(text, least=0)


def count(text: str) -> int:
    """Return how many of something: a whole number, 1 or more."""
    return _whole_number(text, least=1)


def _whole_number(text: str, *, least: int) -> int:
    if not text.isascii() or not text.isdigit() or not least <= int(text) < 2**63:
        raise argparse.ArgumentTypeError(f"must be a whole number, {least} or more, not {text!r}")
    return int(text)
