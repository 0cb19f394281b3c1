"""What commands print: lines, progress, names for people."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any, TextIO

from xethru_protocol.operating_system import STDERR, STDOUT, json_text, one_line
from xethru_protocol.wire.codes import ProfileId
from xethru_protocol.wire.errors import Disconnected, XeThruError

if TYPE_CHECKING:
    from xethru_protocol.driver.frames import FrameGeometry
    from xethru_protocol.driver.link import RawConfig
    from xethru_protocol.driver.radar import X4M300
    from xethru_protocol.recordings import RecordingFault


def profile_name(profile_id: int) -> str:
    """Short name of a profile, or its number.

    >>> profile_name(0x014D4AB8), profile_name(5)
    ('PRESENCE_2', '0x00000005')
    """
    try:
        return ProfileId(profile_id).name.removeprefix("XTS_ID_APP_")
    except ValueError:
        return f"0x{profile_id:08X}"


class CommandFailed(XeThruError):  # noqa: N818 - reads as the event it is
    """A command came to nothing: the cause, and what followed from it."""


def print_json(value: dict[str, Any]) -> None:
    """Write one JSON object on a line of its own, at once; NaN and infinities become null."""
    try:
        text = json_text(value, allow_nan=False)
    except ValueError:
        text = json_text(_without_nan(value))
    print_text(text + "\n")


def print_line(text: str) -> None:
    """Write a result line at once, so that the reader of a pipe gets it immediately.

    What is not printable is written out. CommandFailed if it cannot be written, BrokenPipeError if
    its reader has ended.
    """
    print_text(one_line(text) + "\n")


def print_text(text: str) -> None:
    """Write a part of a result as it is, at once; raises like `print_line`."""
    if STDOUT.stream is None:  # started with it closed
        raise CommandFailed("standard output is closed; nothing can be printed")
    STDOUT.write(text)
    check_output()


def check_output() -> None:
    """Raise what `print_text` does if standard output takes no more."""
    failure = STDOUT.failure
    if isinstance(failure, BrokenPipeError):
        raise failure
    if failure is not None:
        raise CommandFailed(f"standard output cannot be written: {failure.strerror}")


def warn(text: str) -> None:
    """Write a line to standard error; what is not printable is written out.

    While standard error blocks the line is kept, and the command goes on.
    """
    STDERR.write_soon(one_line(text) + "\n")


def _without_nan(value: Any) -> Any:  # noqa: ANN401 - any JSON value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_without_nan(item) for item in value]
    return value


_REWRITE_S = 0.2
_LINE_S = 10.0


class Progress:
    """Shows the newest of many states, not too often; ``name`` begins the lines of a log.

    Nothing waits for a terminal that blocks, as after Ctrl-S: states are left out meanwhile.
    """

    def __init__(self, name: str, clock: Callable[[], float] = time.monotonic) -> None:
        self.state = ""  # the newest
        self._name = name
        self._clock = clock
        self._rewrites = STDERR.is_terminal
        self._shown_s = clock()
        self._is_open = False  # a line is there that ends in no line end

    def show(self, state: str) -> None:
        self.state = state
        now_s = self._clock()
        if now_s - self._shown_s < (_REWRITE_S if self._rewrites else _LINE_S):
            return
        self._shown_s = now_s
        if self._rewrites:
            STDERR.offer(rewriting(one_line(state), STDERR.stream))
            self._is_open = True
        else:
            warn(f"{self._name}: {state}")

    def finish(self) -> None:
        """Bring a rewritten line up to date and end it."""
        if self._is_open:
            STDERR.write_soon(rewriting(one_line(self.state), STDERR.stream) + "\n")
            self._is_open = False


def rewriting(line: str, terminal: TextIO | None) -> str:
    """Text that replaces the line of a terminal, cut to fit: a longer one would scroll."""
    columns = 0
    if terminal is not None:
        with suppress(OSError, ValueError):  # unknown
            columns = os.get_terminal_size(terminal.fileno()).columns
    return f"\r{line[: columns - 1] if columns else line}\x1b[K"


def counted(count: int, noun: str) -> str:
    """Write a number of things, for people.

    >>> counted(0, "frame"), counted(1, "frame"), counted(2, "frame")
    ('0 frames', '1 frame', '2 frames')
    """
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def rate_text(count: int, span_s: float) -> str:
    """Write how often something came, as a further part of a line; nothing of no time.

    >>> rate_text(17, 2.0), rate_text(1, 0.0)
    (', 8.5/s', '')
    """
    return f", {count / span_s:.1f}/s" if span_s > 0 else ""


def bytes_text(count: int) -> str:
    """Amount of data, for people.

    >>> bytes_text(999), bytes_text(5_747_000)
    ('999 B', '5.7 MB')
    """
    value, unit = float(count), "B"
    for larger in ("kB", "MB", "GB", "TB"):
        if value < 1000:
            break
        value, unit = value / 1000, larger
    return f"{value:.0f} B" if unit == "B" else f"{value:.1f} {unit}"


_MOST = 10  # lines; a damaged text file has as many faults as lines


def warn_of(command: str, faults: Sequence[RecordingFault]) -> None:
    """Print the first faults one by one, and the number of the others."""
    for fault in faults[:_MOST]:
        warn(f"xethru {command}: {fault}")
    if len(faults) > _MOST:
        warn(f"xethru {command}: and {len(faults) - _MOST} faults more")


@contextmanager
def module_at(port: str, baudrate: int) -> Iterator[X4M300]:
    """Open a module, and close it however the block ends.

    A failure to stop the module is part of the error that ended the block, then a CommandFailed;
    after a good end, or a signal, it is a warning.
    """
    from xethru_protocol.driver.radar import X4M300  # heavy, and --help needs this module

    radar = X4M300.open(port, baudrate=baudrate)
    losses = ""
    try:
        with radar:
            try:
                yield radar
            finally:
                # what is skipped to stop the module does not count as lost
                if radar.frames_lost or radar.fault_count:
                    lost = counted(radar.frames_lost, "frame")
                    damaged = counted(radar.fault_count, "damaged place")
                    losses = f"{lost} lost, {damaged} on the line"
                print_warnings(radar)
    except Disconnected:  # that it could not be stopped goes without saying
        raise
    except XeThruError as error:
        if radar.warnings:  # of closing
            raise CommandFailed(f"{error} (and it could not be stopped)") from error
        raise
    except BaseException:
        _print_end(radar, losses)
        raise
    _print_end(radar, losses)


def set_up(radar: X4M300, config: RawConfig | None) -> FrameGeometry:
    """Configure raw radar frames; None: take those that come already."""
    return radar.attach() if config is None else radar.configure_raw(config)


def let_send(radar: X4M300, config: RawConfig | None, wanted_hz: float | None) -> float:
    """Start what was set up, if that is for us to do; returns the rate of the frames [Hz]."""
    if config is None:
        return float(radar.description["rate_hz"])
    return radar.start(frame_rate(radar, wanted_hz))


def frame_timeout_s(rate_hz: float) -> float:
    """How long to wait for a frame of a radar that sends at this rate."""
    return max(2.0, 3.0 / rate_hz)


_USUAL_FPS = 17.0


def frame_rate(radar: X4M300, wanted_hz: float | None) -> float:
    """Return the rate to ask for: without a wanted one the usual, or what a UART carries."""
    from xethru_protocol.transport import carried_rate_hz

    if wanted_hz is not None:
        return wanted_hz
    assert radar.geometry is not None, "configured before"
    frame_bytes = radar.geometry.frame_bytes
    rate_hz = carried_rate_hz(_USUAL_FPS, radar.bytes_per_s, frame_bytes)
    if rate_hz < _USUAL_FPS:
        warn(
            f"xethru: {rate_hz:g} frames/s instead of {_USUAL_FPS:g}: the line carries "
            f"{radar.bytes_per_s / frame_bytes:.1f} of {frame_bytes} bytes; --baseband or a "
            "smaller --frame-area make them shorter, --fps asks for another rate"
        )
    return rate_hz


def print_warnings(radar: X4M300) -> None:
    for text in radar.warnings:
        warn(f"xethru: {text}")
    radar.warnings.clear()


def _print_end(radar: X4M300, losses: str) -> None:
    print_warnings(radar)
    if losses:
        warn(f"xethru: {losses}")
