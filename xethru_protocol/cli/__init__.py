"""Command line ``xethru``: one module at a serial port, or bytes from a file.

Results go to stdout, everything else to stderr. Exit 0 done, 1 failed, 2 wrong usage, 130 and
143 after SIGINT and SIGTERM. Nothing heavy is imported before a command is known.
"""

import os
import signal
import sys
from collections.abc import Sequence
from types import FrameType


class Terminated(BaseException):
    """SIGTERM; like KeyboardInterrupt, no ordinary handler catches it."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``xethru``; returns the exit code."""
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
    except BrokenPipeError:
        # Whoever read our output has enough. Python flushes stdout once more at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _run(argv: Sequence[str] | None) -> int:
    from xethru_protocol.cli.arguments import parse
    from xethru_protocol.errors import XeThruError

    arguments = parse(argv)
    try:
        code: int = arguments.run(arguments)
    except XeThruError as error:
        sys.stderr.write(f"xethru {arguments.command}: {error}\n")
        return 1
    sys.stdout.flush()
    return code


def _terminate(signum: int, frame: FrameType | None) -> None:
    raise Terminated
