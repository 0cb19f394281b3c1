"""``xethru legacy``: runs a script that was written for the vendor's library ModuleConnector."""

import argparse
import builtins
import signal
import sys
import threading
from collections.abc import Collection
from pathlib import Path
from types import CodeType, ModuleType, TracebackType

import xethru_protocol
from xethru_protocol import legacy as pymoduleconnector
from xethru_protocol.operating_system import StopRequestedError
from xethru_protocol.wire.errors import XeThruError

_OURS = str(Path(xethru_protocol.__file__).parent)
_INTERRUPTED = 130


class _ScriptError(XeThruError):
    """A script cannot be read or compiled."""


def legacy(arguments: argparse.Namespace) -> int:
    path = Path(arguments.script)
    code = _compiled(path)
    main = ModuleType("__main__")
    vars(main).update(__file__=str(path), __builtins__=builtins)
    running = threading.enumerate()
    before = sys.argv, sys.path[0], sys.modules["__main__"]
    # Ctrl-C is the script's, which may catch it
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        sys.argv = [str(path), *arguments.arguments]
        sys.path[0] = str(path.resolve().parent)
        sys.modules["__main__"] = main
        pymoduleconnector.install()
        exec(code, vars(main))
        _join_threads(running)
    except KeyboardInterrupt:
        return _INTERRUPTED
    # BrokenPipeError: of a script's output, whose reader has ended
    except (SystemExit, BrokenPipeError, StopRequestedError):
        raise
    except BaseException as error:
        shown = error.with_traceback(_of_script(error.__traceback__))
        sys.excepthook(type(shown), shown, shown.__traceback__)
        return 1
    finally:
        pymoduleconnector.close_all()
        pymoduleconnector.remove()
        sys.argv, sys.path[0], sys.modules["__main__"] = before
        signal.signal(signal.SIGINT, handler)
    return 0


def _compiled(path: Path) -> CodeType:
    try:
        source = path.read_bytes()
    except OSError as error:
        raise _ScriptError(f"{path} cannot be read: {error.strerror or error}") from None
    try:
        return compile(source, str(path), "exec", dont_inherit=True)
    except SyntaxError as error:
        raise _ScriptError(
            f"{path} is not Python 3: {error}; if it is Python 2, convert it by "
            f"'2to3 -w {path.name}' of a Python before 3.13, or 'futurize -w {path.name}' of the "
            "package future"
        ) from None
    except (ValueError, RecursionError, MemoryError) as error:  # null bytes, or nested too deeply
        reason = str(error) or "it is nested too deeply"
        raise _ScriptError(f"{path} is not a Python script: {reason}") from None


def _join_threads(others: Collection[threading.Thread]) -> None:
    """Wait for threads that the script started, as Python does at its end."""
    for thread in threading.enumerate():
        if thread not in others and not thread.daemon:
            thread.join()


def _of_script(trace: TracebackType | None) -> TracebackType | None:
    """Return a traceback without the frames of this package at both of its ends."""
    while trace is not None and _is_ours(trace):
        trace = trace.tb_next
    frames = []
    while trace is not None:
        frames.append(trace)
        trace = trace.tb_next
    while frames and _is_ours(frames[-1]):
        frames.pop()
    for frame in reversed(frames):
        trace = TracebackType(trace, frame.tb_frame, frame.tb_lasti, frame.tb_lineno)
    return trace


def _is_ours(trace: TracebackType) -> bool:
    return trace.tb_frame.f_code.co_filename.startswith(_OURS)
