"""Command line ``xethru``: one module at a serial port, or bytes from a file.

Results go to stdout, everything else to stderr. Exit 0 done, 1 failed, 2 wrong usage, 129,
130 and 143 after SIGHUP, SIGINT and SIGTERM. Nothing heavy is imported before a command is known.
"""

from collections.abc import Sequence
from importlib import import_module

from xethru_protocol.operating_system import (
    StopFlag,
    StopRequestedError,
    flush_streams,
    open_closed_streams,
)

_BY_A_SIGNAL = 128
"""Exit codes from here on are of signals."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``xethru``; returns the exit code."""
    open_closed_streams(replace=False)  # a port opened in their place would get our messages
    code = 0
    stop = StopFlag("same")
    try:
        with stop, stop.at_once():
            code = _run(argv, stop)
        stop.check()  # a terminal that closes also takes no more output, which is a failure
    except KeyboardInterrupt:  # before the handlers were installed
        return 130
    except StopRequestedError as stopped:
        return stopped.exit_code
    except BrokenPipeError:  # the reader of our output has ended
        return 0
    return code


def _run(argv: Sequence[str] | None, stop: StopFlag) -> int:
    with stop.leaving():
        from xethru_protocol.cli.arguments import parse
        from xethru_protocol.cli.output import warn
        from xethru_protocol.wire.errors import XeThruError

    code = _BY_A_SIGNAL
    try:
        arguments = parse(argv)
        try:
            file, _, function = arguments.run.partition(":")
            with stop.leaving():
                run = getattr(import_module(f"xethru_protocol.cli.{file}"), function)
            code = run(arguments)
        except XeThruError as error:
            warn(f"xethru {arguments.command}: {error}")
            code = 1
    except SystemExit:  # after --help or wrong usage
        if flush_streams():
            raise
        warn("xethru: standard output cannot be written")
        code = 1
    finally:  # a signal ends the wait for a stream that blocks
        flush_streams(wait=code < _BY_A_SIGNAL)
    return code
