"""What is in the way of a new recording, and its removal."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from xethru_protocol.recordings import RecordingError


def what_must_go(targets: Iterable[Path], *, replace: bool) -> list[Path]:
    """Files of older recordings where new ones shall be.

    Of a directory only the files of a recording are in the way.

    Raises
    ------
    RecordingError
        If something is there and must stay.
    """
    old = [path for target in targets for path in _recording_files(target)]
    for path in old:
        if not path.is_file():  # --force is no reason to remove a device
            raise RecordingError(f"{path} is no file; name a new one")
    if old and not replace:
        raise RecordingError(f"there is a recording already: {old[0]}; --force replaces it")
    return old


def is_part_of(source: Path, target: Path) -> bool:
    """Whether writing to ``target`` would replace ``source``."""
    return target.exists() and any(
        path.exists() and path.samefile(source) for path in (target, *_recording_files(target))
    )


def make_room(targets: Iterable[Path], *, replace: bool) -> None:
    """Remove older recordings where new ones shall be, if that is allowed.

    Raises
    ------
    RecordingError
        If something is there and must stay, or cannot be removed.
    """
    for path in what_must_go(targets, replace=replace):
        try:
            path.unlink()
        except OSError as error:
            raise RecordingError(f"{path} cannot be removed: {error.strerror}") from None


@contextmanager
def set_aside(target: Path, *, replace: bool) -> Iterator[None]:
    """Keep an older recording under other names meanwhile; back it comes if the block fails.

    What the failed block has written goes: it would pass for a whole recording.

    Raises
    ------
    RecordingError
        If something is there and must stay, or cannot be moved.
    """
    was_there = target.exists()
    kept = [
        (path, path.with_name(f".{path.name}.old"))
        for path in what_must_go((target,), replace=replace)
    ]
    try:
        for path, aside in kept:
            path.replace(aside)
    except OSError as error:
        _put_back(kept)
        raise RecordingError(f"{target} cannot be replaced: {error.strerror}") from None
    try:
        yield
    except BaseException:
        remove_unfinished(target, was_there=was_there)
        _put_back(kept)
        raise
    for _, aside in kept:
        with suppress(OSError):
            aside.unlink()


def _put_back(kept: Iterable[tuple[Path, Path]]) -> None:
    for path, aside in kept:
        with suppress(OSError):
            aside.replace(path)


def remove_unfinished(target: Path, *, was_there: bool) -> None:
    """Remove what was written so far and is of no use."""
    with suppress(OSError):
        for path in _recording_files(target):
            if path.is_file():
                path.unlink()
        if target.is_dir() and not was_there:
            target.rmdir()


def _recording_files(target: Path) -> list[Path]:
    if target.is_dir():
        return sorted(path for path in target.glob("xethru_*") if not path.is_dir())
    return [target] if target.exists() else []
