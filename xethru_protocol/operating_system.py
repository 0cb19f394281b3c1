"""The operating system for command lines: signals, streams, text for terminals, files, locks.

Imports nothing heavy: a command line uses it while it imports the rest.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import json
import os
import select
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from types import FrameType
from typing import Any, ClassVar, Literal, Self, TextIO, TypeVar

T = TypeVar("T")

MOST_BYTES = 1 << 20
_PR_SET_PDEATHSIG = 1  # Linux, prctl(2)


def read_bounded(path: Path, most_bytes: int = MOST_BYTES) -> bytes:
    """Return all of a file, which may be a pipe; OSError if it has more bytes than that."""
    with waiting(), path.open("rb") as file:
        content = file.read(most_bytes + 1)
    if len(content) > most_bytes:
        raise OSError(errno.EFBIG, f"longer than {most_bytes >> 20} MiB")
    return content


class PathInUseError(Exception):
    """Another running process holds the path."""


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold an existing file or folder while the block runs; OSError if it cannot be opened.

    The lock is advisory, and has no effect on a file system without locks.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise PathInUseError(f"{path}: in use") from None
        except OSError:
            pass  # no locks here
        if not _is_open_as(descriptor, path):  # who held it has moved or removed it
            raise PathInUseError(f"{path}: in use")
        yield
    finally:
        os.close(descriptor)


def _is_open_as(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except OSError:  # the path leads nowhere any more, or the shell closed the stream
        return False


def _is_output(path: Path) -> bool:
    return _is_open_as(1, path) or _is_open_as(2, path)


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Give the block a path beside ``path`` to write to, then put that file in its place.

    Whoever reads ``path`` finds the file of before or all of the new one, also after a kill or a
    power failure. An error or a signal in the block leaves the file of before. What is there and
    no regular file, such as a pipe, is written to itself; so is ``/dev/stdout``, and the file that
    it is redirected to, as what is printed would go to the file of before.

    Raises OSError if the file cannot be written, or another process is just doing so.
    """
    if path.exists() and (not path.is_file() or _is_output(path)):
        with waiting():  # a pipe waits for its reader
            yield path
        return
    target = Path(os.path.realpath(path))  # a link stays one
    fresh = target.with_name(f".unfinished.{target.name}")
    fresh.touch()
    try:
        with locked(fresh):
            try:
                yield fresh
                sync(fresh)
                fresh.replace(target)
            except BaseException:
                fresh.unlink(missing_ok=True)
                raise
    except PathInUseError:
        raise OSError(errno.EBUSY, "another process is writing it") from None
    with suppress(OSError):  # some file systems have no such thing for folders
        sync(target.parent)


@contextmanager
def built_aside(path: Path) -> Iterator[Path]:
    """Give the block a path of the same name in a hidden folder beside ``path``, or in it.

    The block moves what it has built there to ``path`` when that is whole. The folder is removed
    at the end; one that a killed process left is removed by the next.

    Raises OSError if the folder cannot be made, PathInUseError if another process is using it.
    """
    around = path if path.is_dir() else path.parent  # a folder may be a file system of its own
    folder = around / f".unfinished.{path.name}"
    folder.mkdir(exist_ok=True)
    with locked(folder):
        try:
            _empty(folder)
            yield folder / path.name
        finally:
            _empty(folder)
            folder.rmdir()


def _empty(folder: Path) -> None:
    for path in folder.iterdir():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()


def sync(path: Path) -> None:
    """Wait until a file or folder is on disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StopRequestedError(BaseException):
    """SIGINT, SIGTERM or SIGHUP arrived; like KeyboardInterrupt, no ordinary handler catches it."""

    def __init__(self, received: signal.Signals, left_behind: str = "") -> None:
        super().__init__(f"stopped by {received.name}{left_behind}")
        self.received = received

    @property
    def exit_code(self) -> int:
        """What a shell expects of a program ended by this signal: 130, 143 or 129."""
        return 128 + int(self.received)


_TWICE_S = 0.5
"""A signal that comes again sooner is the same request: a wrapper around a command passes on what
the terminal sent to both."""


class StopFlag:
    """Catches SIGINT, SIGTERM and SIGHUP while it is entered.

    A signal only sets the flag, calls what is attached, and makes `check` raise, so that no
    file is left in the middle of a record. A SIGHUP that is ignored already stays so, as `nohup`
    wants.

    Parameters
    ----------
    second
        What a second signal of the same kind gets: ``"default"``, half a second after the first or
        later, the system's handler, which ends the process where it stands (a second SIGHUP is
        ignored: a closing terminal sends two);
        ``"previous"``, the handler of before; ``"same"``, the same as the first.

    Attributes
    ----------
    entered
        The flag that was entered last and gets the signals; None outside of all.
    """

    entered: ClassVar[StopFlag | None] = None

    def __init__(self, second: Literal["default", "previous", "same"] = "default") -> None:
        self.received: signal.Signals | None = None  # the last that arrived
        self._received_s = 0.0
        self.requested = False  # by a signal or by `request`
        self._second = second
        self._previous: dict[signal.Signals, Any] = {}
        self._at_once = False
        self._outer: StopFlag | None = None
        self._leave: Callable[[signal.Signals], None] | None = None
        self._end: Callable[[], None] | None = None

    def __enter__(self) -> Self:
        """Install the handlers. Main thread only, as Python demands."""
        self._outer, StopFlag.entered = StopFlag.entered, self
        for which in _SIGNALS:
            if which is not signal.SIGHUP or signal.getsignal(which) is not signal.SIG_IGN:
                self._previous[which] = signal.signal(which, self._on_signal)
        return self

    def __exit__(self, *exception: object) -> None:
        for which, handler in self._previous.items():
            signal.signal(which, handler)
        StopFlag.entered = self._outer

    def check(self) -> None:
        """Raise StopRequestedError if a signal arrived since this flag was entered."""
        if self.received is not None:
            raise StopRequestedError(self.received)

    @contextmanager
    def at_once(self, *, earlier: bool = True) -> Iterator[None]:
        """Let a signal raise where it arrives: for waiting, where nothing is half-done.

        So does one that came ``earlier``, if asked for.
        """
        before = self._at_once
        try:
            # in this order: a signal is seen by the check, or raises where it arrives
            self._at_once = True
            if earlier:
                self.check()
            yield
        finally:
            self._at_once = before

    def each(self, items: Iterable[T]) -> Iterator[T]:
        """Yield items; a signal raises where it arrives while the next one is made, as by reading.

        What is done with an item is not interrupted.
        """
        source = iter(items)
        while True:
            with self.at_once():
                try:
                    item = next(source)
                except StopIteration:
                    return
            yield item

    @contextmanager
    def leaving(self, exit_code: int | None = None, *, program: str = "") -> Iterator[None]:
        """Let a signal end the process where it arrives: for imports, before anything is begun.

        An exception would not do: modules written in C report another in its place. The exit code
        is that of the signal if none is given; with ``program``, standard error gets a line.
        """

        def leave(which: signal.Signals) -> None:
            stopped = StopRequestedError(which)
            if program:
                STDERR.write_soon(f"{program}: {stopped}\n")
            os._exit(stopped.exit_code if exit_code is None else exit_code)

        try:
            self._leave = leave
            if self.received is not None:
                leave(self.received)
            yield
        finally:
            self._leave = None

    def attach(self, end: Callable[[], None]) -> None:
        """Call ``end`` at every request; at once if there was one already."""
        self._end = end
        if self.requested:
            end()

    def detach(self) -> None:
        self._end = None

    def request(self) -> None:
        self.requested = True
        if self._end is not None:
            self._end()

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        which = signal.Signals(number)
        if self._second == "default" and self.received is which:
            self._on_second(which)
            return
        self.received, self._received_s = which, time.monotonic()
        if self._leave is not None:
            self._leave(which)
        if self._second == "previous":
            signal.signal(which, self._previous[which])
        self.request()
        if self._at_once:
            self.check()

    def _on_second(self, which: signal.Signals) -> None:
        if which is not signal.SIGHUP and time.monotonic() - self._received_s >= _TWICE_S:
            signal.signal(which, signal.SIG_DFL)
            os.kill(os.getpid(), which)


@contextmanager
def waiting(*, earlier: bool = True) -> Iterator[None]:
    """Let a signal raise where it arrives: around what waits for another process, as a pipe does.

    A system call that a signal interrupts is repeated, unless the handler raises. ``earlier`` is
    that of `StopFlag.at_once`.
    """
    flag = StopFlag.entered if threading.current_thread() is threading.main_thread() else None
    with nullcontext() if flag is None else flag.at_once(earlier=earlier):
        yield


def open_closed_streams(*, replace: bool = True) -> None:
    """Put the null device where the shell closed a standard stream (`>&-`).

    Python has None for such a stream, and the next file that is opened would get its descriptor.
    With ``replace`` the stream is a file on the null device from now on, else it stays None.
    """
    for descriptor, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            _null_at(descriptor)
            if replace:
                file = os.fdopen(descriptor, "w" if descriptor else "r", closefd=False)
                setattr(sys, name, file)


_PIECE = 64
"""Letters that a stream takes whole when it takes anything: of a terminal's buffer 256 bytes are
free then, of a pipe's 4096."""
_MOST_LATE = 100_000
"""Letters that wait for a stream that blocks; a run's session log has its warnings, too."""


class Outlet:
    """Standard output or standard error for as long as it takes text; no OSError is raised.

    A terminal goes away with its connection, the reader of a pipe ends, a disk gets full: nothing
    more is written then, and `failure` is the reason. A stream may also block, as a terminal does
    after Ctrl-S or a pipe that nobody reads. Only `write` waits for it; a signal ends that.
    """

    def __init__(self, name: Literal["stdout", "stderr"], descriptor: int) -> None:
        self._name, self._descriptor = name, descriptor
        self._failed: tuple[TextIO, OSError] | None = None
        self._late = ""

    @property
    def stream(self) -> TextIO | None:
        """The stream itself, for what it is connected to; None if it was closed at the start."""
        stream: TextIO | None = getattr(sys, self._name)
        return stream

    @property
    def is_terminal(self) -> bool:
        return self.stream is not None and self.stream.isatty()

    @property
    def failure(self) -> OSError | None:
        """Why the stream takes no more; BrokenPipeError if its reader has ended."""
        if self._failed is None or self._failed[0] is not self.stream:
            return None
        return self._failed[1]

    def write(self, text: str) -> None:
        """Write a text behind those that wait, however long the stream blocks."""
        text, self._late = self._late + text, ""
        with waiting(earlier=False):  # results are printed after a signal, too
            self._put(text)

    def write_soon(self, text: str) -> None:
        """Write a text if the stream does not block, else keep it until it takes text again."""
        self._late = (self._late + text)[:_MOST_LATE]
        while self._late and not self._blocks():
            piece, self._late = self._late[:_PIECE], self._late[_PIECE:]
            self._put(piece)

    def offer(self, text: str) -> None:
        """Write a text if the stream does not block, else leave it out."""
        self.write_soon("")
        if not self._late and not self._blocks():
            self.write_soon(text)

    def _blocks(self) -> bool:
        if self.stream is None or self.failure is not None:
            return False
        try:
            descriptor = self.stream.fileno()
        except (OSError, ValueError):  # a stream of text in memory, in tests
            return False
        poll = select.poll()
        poll.register(descriptor, select.POLLOUT)
        return not poll.poll(0)

    def _put(self, text: str) -> None:
        stream = self.stream
        if stream is None or self.failure is not None:
            return
        try:
            try:
                stream.write(text)
            except UnicodeEncodeError:  # a file name that is not text, or a terminal without UTF-8
                encoding = stream.encoding or "ascii"
                stream.write(text.encode(encoding, "backslashreplace").decode(encoding))
            stream.flush()
        except OSError as error:
            self._give_up(error.errno or errno.EIO)
        except ValueError:  # somebody closed it
            self._give_up(errno.EBADF)
        except BaseException:  # a signal ended the waiting
            if self._blocks():
                self._give_up(errno.EINTR)
            raise

    def _give_up(self, number: int) -> None:
        """Write nothing more.

        What is left in the stream's buffer would make the interpreter wait, or complain and end
        with an exit code of its own, when it flushes at its end: the null device takes it.
        """
        stream = self.stream
        assert stream is not None
        self._late = ""
        # of the errno's own class, such as BrokenPipeError
        self._failed = stream, OSError(number, os.strerror(number))
        with suppress(OSError, ValueError):
            if stream.fileno() == self._descriptor:
                _null_at(self._descriptor)


STDOUT, STDERR = Outlet("stdout", 1), Outlet("stderr", 2)


def flush_streams(*, wait: bool = True) -> bool:
    """Write what was kept for both outputs; return whether standard output took all there was.

    Without ``wait``, what they do not take at once is dropped.
    """
    for outlet in (STDOUT, STDERR):
        if wait:
            outlet.write("")
        else:
            outlet.write_soon("")
    return STDOUT.failure is None


def one_line(text: str) -> str:
    r"""Write out what is not printable: text of modules, files and other programs is shown so.

    Control characters would move the cursor, set the title or recolour the terminal that shows
    them, and line ends would pass for lines of ours.

    >>> print(one_line("radar \x1b[2J\n"))
    radar \x1b[2J\n
    """
    if text.isprintable():
        return text
    return "".join(part if part.isprintable() else ascii(part)[1:-1] for part in text)


def each_line(text: str) -> str:
    """Do as `one_line` in text whose line ends are ours."""
    return "\n".join(map(one_line, text.split("\n")))


def json_text(value: object, **options: Any) -> str:  # noqa: ANN401 - those of json.dumps
    """JSON in ASCII without control characters; DEL is the one that `json.dumps` leaves."""
    return json.dumps(value, **options).replace("\x7f", "\\u007f")


def signal_at_parents_death(which: signal.Signals) -> Callable[[], None] | None:
    """Return what a process calls to get a signal when its parent dies; None except on Linux.

    Strictly, when the thread that started it ends. It is a single system call, as a `preexec_fn`
    must be.
    """
    if sys.platform != "linux":
        return None
    libc = ctypes.CDLL(None)
    return lambda: libc.prctl(_PR_SET_PDEATHSIG, which)


def _null_at(descriptor: int) -> None:
    opened = os.open(os.devnull, os.O_RDWR)
    if opened != descriptor:
        os.dup2(opened, descriptor)
        os.close(opened)
