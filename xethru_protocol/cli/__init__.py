"""Command line ``xethru``: one module at a serial port, or bytes from a file.

Results go to stdout, everything else to stderr. Exit 0 done, 1 failed, 2 wrong usage, 130 and
143 after SIGINT and SIGTERM. Nothing heavy is imported before a command is known.
"""

import os
import signal
from collections.abc import Sequence
from types import FrameType


class Terminated(BaseException):
    """SIGTERM; like KeyboardInterrupt, no ordinary handler catches it."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``xethru``; returns the exit code."""
    from xethru_protocol.cli.output import end_output, warn

    _occupy_closed_descriptors()
    previous = {
        signal.SIGTERM: signal.signal(signal.SIGTERM, _terminate),
        # A script's background jobs start with SIGINT ignored; a stream must still be stoppable.
        signal.SIGINT: signal.signal(signal.SIGINT, signal.default_int_handler),
    }
    try:
        return _run(argv)
    except KeyboardInterrupt:
        return 130
    except Terminated:
        return 143
    except SystemExit:  # after --help or wrong usage
        if end_output():
            raise
        warn("xethru: standard output cannot be written")
        return 1
    except BrokenPipeError:  # whoever read our output has enough
        return 0
    finally:
        end_output()  # what fails here was told already, or nobody is there to hear it
        for number, handler in previous.items():
            signal.signal(number, handler)


def _run(argv: Sequence[str] | None) -> int:
    from xethru_protocol.cli.arguments import parse
    from xethru_protocol.cli.output import one_line, warn
    from xethru_protocol.errors import XeThruError

    arguments = parse(argv)
    try:
        code: int = arguments.run(arguments)
    except XeThruError as error:
        warn(f"xethru {arguments.command}: {one_line(str(error))}")
        return 1
    return code


def _occupy_closed_descriptors() -> None:
    """Give closed standard descriptors to /dev/null: a port opened there would get our messages."""
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)


def _terminate(signum: int, frame: FrameType | None) -> None:
    raise Terminated
