"""Files in the module's flash as part of a driver: ``radar.files``.

::

    with X4M300.open(port) as radar:
        radar.presence.load()
        zone_m = radar.presence.set_zone(0.4, 5.0)
        radar.presence.set_output(OutputFeature.PRESENCE_SINGLE)
        radar.presence.run()
        radar.presence.wait_until_initialized()
        for message in radar.presence.messages():
            ...

A transfer is not repeated when the line breaks: `Disconnected` says that it did not end.
"""

from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from dataclasses import dataclass
from typing import Protocol, TypeVar

from xethru_protocol.driver import profiles, reconnect
from xethru_protocol.driver.link import SLOW_TIMEOUT_S, Procedure, RadarCore, request
from xethru_protocol.driver.profiles import MESSAGE_TIMEOUT_S
from xethru_protocol.driver.reconnect import awaited, awaited_once, blocking, blocking_once
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import FileError
from xethru_protocol.wire.errors import DeviceError, RemoteProtocolError, XeThruError
from xethru_protocol.wire.messages import Response

CHUNK_BYTES = 256  # as the vendor's host reads and writes

OnProgress = Callable[[int, int], None]
T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True, order=True)
class FileName:
    """What a file is known by: a `FileType` or a user-defined type, and a number."""

    file_type: int
    identifier: int

    def __str__(self) -> str:
        """As messages to people call it."""
        return f"{self.file_type:08X}/{self.identifier}"


def find_all(core: RadarCore) -> Procedure[tuple[FileName, ...]]:
    """List all files."""
    values = (yield from request(core, m.FindAllFiles())).values
    if len(values) % 2:
        raise RemoteProtocolError(f"{core.path} lists {len(values)} numbers, no pairs, as files")
    half = len(values) // 2
    return tuple(
        FileName(file_type=kind & 0xFFFFFFFF, identifier=number & 0xFFFFFFFF)
        for kind, number in zip(values[:half], values[half:], strict=True)
    )


def find(core: RadarCore, file_type: int) -> Procedure[tuple[FileName, ...]]:
    """List the files of one type; a module without any may say NOT_FOUND, which is none, too."""
    try:
        values = (yield from request(core, m.SearchFileType(file_type=file_type))).values
    except DeviceError as error:
        if error.code != FileError.NOT_FOUND:
            raise
        values = ()
    return tuple(FileName(file_type=file_type, identifier=one & 0xFFFFFFFF) for one in values)


def length(core: RadarCore, file_type: int, identifier: int) -> Procedure[int]:
    """Ask for the size of a file [bytes]."""
    command = m.GetFileLength(file_type=file_type, identifier=identifier)
    values = (yield from request(core, command)).values
    if len(values) != 1 or values[0] < 0:
        raise RemoteProtocolError(f"{core.path} tells a file's length as {values}")
    return values[0]


def read(
    core: RadarCore, file_type: int, identifier: int, on_progress: OnProgress | None = None
) -> Procedure[bytes]:
    """Read a file.

    Parameters
    ----------
    file_type, identifier
        What it is known by.
    on_progress
        Called with the bytes read so far and all there are: at the start and after each chunk.

    Raises
    ------
    DeviceError
        If it does not exist, or the module cannot read it; `DeviceError.code` is a `FileError`.
    """
    total = yield from length(core, file_type, identifier)
    yield from _open(core, file_type, identifier)

    def chunk(offset: int, count: int) -> m.GetFileData:
        return m.GetFileData(
            file_type=file_type, identifier=identifier, offset=offset, length=count
        )

    body = _read_chunks(core, chunk, total, on_progress)
    return (yield from _then_close(core, file_type, identifier, body))


def write(
    core: RadarCore,
    file_type: int,
    identifier: int,
    data: bytes,
    on_progress: OnProgress | None = None,
) -> Procedure[None]:
    """Create a file and write it; if that fails midway it is deleted again.

    Parameters
    ----------
    file_type, identifier
        What it will be known by; user-defined types begin at 80000000h.
    data
        Its content.
    on_progress
        Called with the bytes written so far and all there are: at the start and after each chunk.

    Raises
    ------
    DeviceError
        If the file exists already, there is no room, or the module cannot write.
    """
    yield from request(
        core,
        m.CreateFile(file_type=file_type, identifier=identifier, length=len(data)),
        SLOW_TIMEOUT_S,
    )
    body = _write_chunks(core, file_type, identifier, data, on_progress)
    try:
        yield from _then_close(core, file_type, identifier, body)
    except GeneratorExit:
        raise
    except BaseException:
        yield from _quietly(core, delete(core, file_type, identifier))
        raise


def delete(core: RadarCore, file_type: int, identifier: int) -> Procedure[None]:
    """Delete a file."""
    command = m.DeleteFile(file_type=file_type, identifier=identifier)
    yield from request(core, command, SLOW_TIMEOUT_S)


def format_all(core: RadarCore, key: int) -> Procedure[None]:
    """Delete all files, the module's own among them; ``key`` shows that this is meant.

    It is `xethru_protocol.wire.codes.FORMAT_KEY`; the module refuses any other.
    """
    yield from request(core, m.FormatFilesystem(key=key), SLOW_TIMEOUT_S)


def crash_dump(core: RadarCore, on_progress: OnProgress | None = None) -> Procedure[bytes]:
    """Read what the firmware left when it crashed last; empty if it did not."""
    values = (yield from request(core, m.GetCrashDumpLength())).values
    if len(values) != 1 or values[0] < 0:
        raise RemoteProtocolError(f"{core.path} tells its crash dump's length as {values}")

    def chunk(offset: int, count: int) -> m.GetCrashDump:
        return m.GetCrashDump(offset=offset, length=count)

    return (yield from _read_chunks(core, chunk, values[0], on_progress))


def clear_crash_dump(core: RadarCore) -> Procedure[None]:
    """Delete the crash dump, if there is one."""
    yield from request(core, m.ClearCrashDump(), SLOW_TIMEOUT_S)


# --- inside -------------------------------------------------------------------------------------


def _open(core: RadarCore, file_type: int, identifier: int) -> Procedure[None]:
    command = m.OpenFile(file_type=file_type, identifier=identifier)
    try:
        yield from request(core, command)
    except DeviceError as error:
        if error.code != FileError.ALREADY_OPEN:
            raise
        # a host before us left it open
        yield from request(core, m.CloseFile(file_type=file_type, identifier=identifier))
        yield from request(core, command)


def _read_chunks(
    core: RadarCore,
    chunk: Callable[[int, int], m.Command[m.ReplyByte]],
    total: int,
    on_progress: OnProgress | None,
) -> Procedure[bytes]:
    data = bytearray()
    _tell(on_progress, 0, total)
    while len(data) < total:
        wanted = min(CHUNK_BYTES, total - len(data))
        got = (yield from request(core, chunk(len(data), wanted))).values
        if len(got) != wanted:
            raise RemoteProtocolError(
                f"{core.path} sent {len(got)} bytes from {len(data)} on, not {wanted}"
            )
        data += got
        _tell(on_progress, len(data), total)
    return bytes(data)


def _write_chunks(
    core: RadarCore, file_type: int, identifier: int, data: bytes, on_progress: OnProgress | None
) -> Procedure[None]:
    _tell(on_progress, 0, len(data))
    for offset in range(0, len(data), CHUNK_BYTES):
        piece = data[offset : offset + CHUNK_BYTES]
        command = m.SetFileData(
            file_type=file_type, identifier=identifier, offset=offset, data=piece
        )
        yield from request(core, command, SLOW_TIMEOUT_S)
        _tell(on_progress, offset + len(piece), len(data))


def _then_close(
    core: RadarCore, file_type: int, identifier: int, body: Procedure[T]
) -> Procedure[T]:
    """Close the open file, whatever becomes of ``body``."""
    close = request(core, m.CloseFile(file_type=file_type, identifier=identifier))
    try:
        result = yield from body
    except GeneratorExit:  # nobody carries steps out any more
        raise
    except BaseException:  # also an interrupt: the module has room for ten open files
        yield from _quietly(core, close)
        raise
    yield from close
    return result


def _quietly(core: RadarCore, procedure: Procedure[object]) -> Procedure[None]:
    """Tidy up after a failure, which is what the user should hear of."""
    try:
        yield from procedure
    except XeThruError as error:
        core.warn(f"could not tidy up: {error}")


def _tell(on_progress: OnProgress | None, done: int, total: int) -> None:
    if on_progress is not None:
        on_progress(done, total)


class Run(Protocol):
    """Carries a procedure out."""

    def __call__(self, procedure: Procedure[T], /) -> T:
        """Return its result."""


class RunAsync(Protocol):
    """Carries a procedure out."""

    def __call__(self, procedure: Procedure[T], /) -> Awaitable[T]:
        """Await its result."""


class RunBeside(Protocol):
    """Carries a procedure out that only hears, beside others."""

    def __call__(self, procedure: Callable[[], Procedure[T]], /) -> Awaitable[T]:
        """Await its result."""


class Presence:
    """The profile of a module behind an `X4M300`."""

    def __init__(self, core: RadarCore, run: Run) -> None:
        self._core = core
        self._run = run

    load = blocking(profiles.load)
    profile_id = blocking(profiles.profile_id)

    # settings: after `load`, before `run`
    zone_limits = blocking(profiles.zone_limits)
    set_zone = blocking(profiles.set_zone)
    zone = blocking(profiles.zone)
    set_sensitivity = blocking(profiles.set_sensitivity)
    sensitivity = blocking(profiles.sensitivity)
    set_band = blocking(profiles.set_band)
    band = blocking(profiles.band)
    set_led = blocking(profiles.set_led)
    led = blocking(profiles.led)
    set_noise_map = blocking(profiles.set_noise_map)
    noise_map = blocking(profiles.noise_map)
    store_noise_map = blocking(profiles.store_noise_map)
    load_noise_map = blocking(profiles.load_noise_map)
    delete_noise_map = blocking(profiles.delete_noise_map)
    factory_preset = blocking(profiles.factory_preset)
    set_output = blocking(profiles.set_output)
    output = blocking(profiles.output)

    # running
    run = blocking(reconnect.run_profile)
    idle = blocking(profiles.idle)
    stop = blocking(profiles.stop)
    wait_until_initialized = blocking(profiles.wait_until_initialized)
    _next_message = blocking(profiles.wait_for_message)

    def messages(
        self, count: int | None = None, timeout_s: float = MESSAGE_TIMEOUT_S
    ) -> Iterator[Response]:
        """Iterate over what the module says of its own accord, but frames; `ResponseTimeout`."""
        while count is None or count > 0:
            yield self._next_message(timeout_s)
            if count is not None:
                count -= 1


class AsyncPresence:
    """The profile of a module behind an `AsyncX4M300`; methods as of `Presence`."""

    def __init__(self, core: RadarCore, run: RunAsync, run_beside: RunBeside) -> None:
        self._core = core
        self._run = run
        self._run_beside = run_beside

    load = awaited(profiles.load)
    profile_id = awaited(profiles.profile_id)

    # settings: after `load`, before `run`
    zone_limits = awaited(profiles.zone_limits)
    set_zone = awaited(profiles.set_zone)
    zone = awaited(profiles.zone)
    set_sensitivity = awaited(profiles.set_sensitivity)
    sensitivity = awaited(profiles.sensitivity)
    set_band = awaited(profiles.set_band)
    band = awaited(profiles.band)
    set_led = awaited(profiles.set_led)
    led = awaited(profiles.led)
    set_noise_map = awaited(profiles.set_noise_map)
    noise_map = awaited(profiles.noise_map)
    store_noise_map = awaited(profiles.store_noise_map)
    load_noise_map = awaited(profiles.load_noise_map)
    delete_noise_map = awaited(profiles.delete_noise_map)
    factory_preset = awaited(profiles.factory_preset)
    set_output = awaited(profiles.set_output)
    output = awaited(profiles.output)

    # running
    run = awaited(reconnect.run_profile)
    idle = awaited(profiles.idle)
    stop = awaited(profiles.stop)

    async def wait_until_initialized(self, timeout_s: float | None = None) -> Response:
        """See `Presence.wait_until_initialized`; other tasks may ask meanwhile."""
        return await self._run_beside(
            lambda: profiles.wait_until_initialized(self._core, timeout_s)
        )

    async def messages(
        self, count: int | None = None, timeout_s: float = MESSAGE_TIMEOUT_S
    ) -> AsyncIterator[Response]:
        """Iterate over what the module says of its own accord, but frames; `ResponseTimeout`."""
        while count is None or count > 0:
            yield await self._run_beside(lambda: profiles.wait_for_message(self._core, timeout_s))
            if count is not None:
                count -= 1


class Files:
    """The file system of a module behind an `X4M300`."""

    def __init__(self, core: RadarCore, run: Run) -> None:
        self._core = core
        self._run = run

    find_all = blocking(find_all)
    find = blocking(find)
    length = blocking(length)
    read = blocking_once(read)
    write = blocking_once(write)
    delete = blocking_once(delete)
    format_all = blocking_once(format_all)
    crash_dump = blocking_once(crash_dump)
    clear_crash_dump = blocking_once(clear_crash_dump)


class AsyncFiles:
    """The file system of a module behind an `AsyncX4M300`; methods as of `Files`."""

    def __init__(self, core: RadarCore, run: RunAsync) -> None:
        self._core = core
        self._run = run

    find_all = awaited(find_all)
    find = awaited(find)
    length = awaited(length)
    read = awaited_once(read)
    write = awaited_once(write)
    delete = awaited_once(delete)
    format_all = awaited_once(format_all)
    crash_dump = awaited_once(crash_dump)
    clear_crash_dump = awaited_once(clear_crash_dump)
