"""A module for the time of one command, and what is said when that ends."""

from collections.abc import Iterator
from contextlib import contextmanager

from xethru_protocol.cli.output import one_line, warn
from xethru_protocol.cli.progress import counted
from xethru_protocol.driver import X4M300
from xethru_protocol.errors import Disconnected, XeThruError


class CommandFailed(XeThruError):  # noqa: N818 - reads as the event it is
    """A command came to nothing: the cause, and what followed from it."""


@contextmanager
def module_at(port: str, baudrate: int) -> Iterator[X4M300]:
    """Open a module, and close it however the block ends.

    What could not be undone at the end is said in one line with the cause of the end; after a
    good end, or a signal, it is a warning.

    Raises
    ------
    CommandFailed
        If the block failed, and then the module could not be stopped.
    """
    radar = X4M300.open(port, baudrate=baudrate)
    losses = ""
    try:
        with radar:
            try:
                yield radar
            finally:
                losses = _losses(radar)  # what is skipped to stop the module is no loss
                say_warnings(radar)
    except Disconnected:  # that it could not be stopped goes without saying
        raise
    except XeThruError as error:
        if radar.warnings:  # of closing
            raise CommandFailed(f"{error} (and it could not be stopped)") from error
        raise
    except BaseException:
        _say_end(radar, losses)
        raise
    _say_end(radar, losses)


def say_warnings(radar: X4M300) -> None:
    """Tell people what the driver warns of, once."""
    for text in radar.warnings:
        warn(f"xethru: {one_line(text)}")
    radar.warnings.clear()


def _losses(radar: X4M300) -> str:
    if not radar.frames_lost and not radar.fault_count:
        return ""
    return (
        f"{counted(radar.frames_lost, 'frame')} lost, "
        f"{counted(radar.fault_count, 'damaged place')} on the line"
    )


def _say_end(radar: X4M300, losses: str) -> None:
    say_warnings(radar)
    if losses:
        warn(f"xethru: {losses}")
