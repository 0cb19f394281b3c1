"""Command line ``xethru``: one module at a serial port, or bytes from a file.

Results go to stdout, everything else to stderr. Exit 0 done, 1 failed, 2 wrong usage, 129,
130 and 143 after SIGHUP, SIGINT and SIGTERM. Nothing heavy is imported before a command is known.
"""

import os
import signal
from collections.abc import Sequence
from types import FrameType


class Terminated(BaseException):
    """SIGTERM or SIGHUP; like KeyboardInterrupt, no ordinary handler catches it."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``xethru``; returns the exit code."""
    _occupy_closed_descriptors()
    previous = {
        number: signal.signal(number, _terminate)
        for number in (signal.SIGTERM, signal.SIGHUP)
        # nohup starts its program with SIGHUP ignored; so it stays
        if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN
    }
    # A script's background jobs start with SIGINT ignored; a stream must still be stoppable.
    previous[signal.SIGINT] = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        return _run(argv)
    except KeyboardInterrupt:
        return 130
    except Terminated as end:
        return 128 + end.number
    except BrokenPipeError:  # whoever read our output has enough
        return 0
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _run(argv: Sequence[str] | None) -> int:
    from xethru_protocol.cli.arguments import parse
    from xethru_protocol.cli.output import end_output, one_line, warn
    from xethru_protocol.wire.errors import XeThruError

    try:
        arguments = parse(argv)
        try:
            code: int = arguments.run(arguments)
        except XeThruError as error:
            warn(f"xethru {arguments.command}: {one_line(str(error))}")
            return 1
    except SystemExit:  # after --help or wrong usage
        if end_output():
            raise
        warn("xethru: standard output cannot be written")
        return 1
    finally:
        end_output()  # what fails here was told already, or nobody is there to hear it
    return code


def _occupy_closed_descriptors() -> None:
    """Give closed standard descriptors to /dev/null: a port opened there would get our messages."""
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)


def _terminate(signum: int, frame: FrameType | None) -> None:
    raise Terminated(signum)
