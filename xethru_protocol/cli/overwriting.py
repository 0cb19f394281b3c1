"""What is in the way of a new recording, and its removal."""

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from xethru_protocol.recordings import RecordingError


def make_room(targets: Iterable[Path], *, replace: bool) -> None:
    """Remove older recordings where new ones shall be, if that is allowed.

    Of a directory only the files of a recording go.

    Raises
    ------
    RecordingError
        If something is there and must stay, or cannot be removed.
    """
    old = [path for target in targets for path in _recording_files(target)]
    for path in old:
        if not path.is_file():  # --force is no reason to remove a device
            raise RecordingError(f"{path} is no file; name a new one")
    if old and not replace:
        raise RecordingError(f"there is a recording already: {old[0]}; --force replaces it")
    for path in old:
        try:
            path.unlink()
        except OSError as error:
            raise RecordingError(f"{path} cannot be removed: {error.strerror}") from None


def remove_unfinished(target: Path, *, was_there: bool) -> None:
    """Remove what a conversion that failed has written so far."""
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
