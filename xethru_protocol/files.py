"""Files in the module's flash as part of a driver: ``radar.files``.

A transfer is not repeated when the line breaks: `Disconnected` says that it did not end.
"""

from xethru_protocol import file_transfer
from xethru_protocol.core import RadarCore
from xethru_protocol.file_transfer import FileName, OnProgress
from xethru_protocol.presence import Run, RunAsync
from xethru_protocol.verbs import awaited, awaited_once, blocking, blocking_once

__all__ = ["AsyncFiles", "FileName", "Files", "OnProgress"]


class Files:
    """The file system of a module behind an `X4M300`."""

    def __init__(self, core: RadarCore, run: Run) -> None:
        self._core = core
        self._run = run

    find_all = blocking(file_transfer.find_all)
    find = blocking(file_transfer.find)
    length = blocking(file_transfer.length)
    read = blocking_once(file_transfer.read)
    write = blocking_once(file_transfer.write)
    delete = blocking_once(file_transfer.delete)
    format_all = blocking_once(file_transfer.format_all)
    crash_dump = blocking_once(file_transfer.crash_dump)
    clear_crash_dump = blocking_once(file_transfer.clear_crash_dump)


class AsyncFiles:
    """The file system of a module behind an `AsyncX4M300`; methods as of `Files`."""

    def __init__(self, core: RadarCore, run: RunAsync) -> None:
        self._core = core
        self._run = run

    find_all = awaited(file_transfer.find_all)
    find = awaited(file_transfer.find)
    length = awaited(file_transfer.length)
    read = awaited_once(file_transfer.read)
    write = awaited_once(file_transfer.write)
    delete = awaited_once(file_transfer.delete)
    format_all = awaited_once(file_transfer.format_all)
    crash_dump = awaited_once(file_transfer.crash_dump)
    clear_crash_dump = awaited_once(file_transfer.clear_crash_dump)
