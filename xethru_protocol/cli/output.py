"""Lines on stdout and stderr."""

import json
import math
import os
import sys
from typing import Any, TextIO

from xethru_protocol.errors import XeThruError


class OutputError(XeThruError):
    """Standard output takes nothing more: it is closed, or its disk is full."""


def print_json(value: dict[str, Any]) -> None:
    """Write one JSON object on a line of its own, at once; NaN and infinities become null."""
    try:
        text = json.dumps(value, allow_nan=False)
    except ValueError:
        text = json.dumps(_without_nan(value))
    print_line(text)


def print_line(text: str) -> None:
    """Write a result line, at once: whoever reads a pipe gets each as it comes.

    Raises
    ------
    OutputError
        If it cannot be written.
    BrokenPipeError
        If whoever read it has left.
    """
    print_text(text + "\n")


def print_text(text: str) -> None:
    """Write a part of a result, at once; raises like `print_line`."""
    if sys.stdout is None:  # started with it closed
        raise OutputError("standard output is closed; nothing can be printed")
    try:
        try:
            sys.stdout.write(text)
        except UnicodeEncodeError:  # a file name that is no text, or a terminal without UTF-8
            sys.stdout.write(_printable(text, sys.stdout))
        sys.stdout.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        raise OutputError(f"standard output cannot be written: {error.strerror}") from None


def warn(text: str) -> None:
    """Write a line for people."""
    show(text + "\n")


def show(text: str) -> None:
    """Write something for people; that nobody can see it is no reason to fail."""
    if sys.stderr is None:
        return
    try:
        sys.stderr.write(text)
        sys.stderr.flush()
    except OSError:
        _mute(sys.stderr)


def end_output() -> bool:
    """Write out what waits on stdout; False if that cannot be done.

    Python does the same at its exit, but complains with a traceback.
    """
    try:
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError:
        _mute(sys.stdout)
        return False
    return True


def is_terminal(stream: TextIO | None) -> bool:
    """Whether people see a stream as it comes; a closed one nobody sees."""
    return stream is not None and stream.isatty()


def one_line(text: str) -> str:
    """Write control characters out: a file name may hold line ends."""
    return "".join(part if part.isprintable() else ascii(part)[1:-1] for part in text)


def _mute(stream: TextIO) -> None:
    """Send what is written from now on nowhere, and what is buffered too."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _printable(text: str, stream: TextIO) -> str:
    encoding = stream.encoding or "ascii"
    return text.encode(encoding, "backslashreplace").decode(encoding)


def _without_nan(value: Any) -> Any:  # noqa: ANN401 - any JSON value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_without_nan(item) for item in value]
    return value
