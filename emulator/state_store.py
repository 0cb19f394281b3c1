"""A module's flash as a file: one JSON document per serial number in a directory.

A document is replaced as a whole, so that a crash of the emulator leaves the old one or the new
one. What cannot be read is told in one line and left alone until the module saves; the module
starts as shipped.
"""

from __future__ import annotations

import errno
import os
from base64 import b64decode, b64encode
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from emulator.filesystem import MAX_FILES
from emulator.modes import Start, State
from emulator.profile_settings import ProfileSettings
from emulator.saved_state import SavedState

__all__ = ["DirectoryMemory", "make_state_directory"]

U32 = Annotated[int, Field(ge=0, lt=1 << 32)]


class _Document(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)


class _Profile(_Document):
    profile_id: U32
    zone_m: list[Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)]] = Field(
        min_length=2, max_length=2
    )
    sensitivity: int = Field(ge=0, le=9)
    tx_center_frequency: int = Field(ge=3, le=4)
    led: int = Field(ge=0, le=2)
    noise_map_control: int = Field(ge=0, le=7)
    noise_map_interval_min: int = Field(ge=0, lt=1 << 31)
    outputs: list[tuple[U32, U32]]
    debug_outputs: list[tuple[U32, U32]]


class _File(_Document):
    type: U32
    identifier: U32
    base64: str


class _State(_Document):
    format: Literal["xethru-emulator state"] = "xethru-emulator state"
    version: Literal[1] = 1
    serial: str
    start: Literal["RUN", "LOADED", "STOPPED"]
    profile_id: U32
    profiles: list[_Profile]
    files: list[_File] = Field(max_length=MAX_FILES)
    parameter_file_name: str
    certification: bool


def make_state_directory(directory: Path) -> None:
    """Make a directory of states, if it is missing.

    Raises
    ------
    OSError
        When nothing could be kept there: told before the start, not at the first save.
    """
    directory.mkdir(parents=True, exist_ok=True)
    if not os.access(directory, os.R_OK | os.W_OK | os.X_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))


class DirectoryMemory:
    """Keeps the flash of one module in a directory.

    Parameters
    ----------
    directory
        Where the documents of all modules are; made if it is missing.
    serial
        Serial number of this module, the name of its document.
    warn
        Called with one line about what cannot be read or written.
    """

    def __init__(self, directory: Path, serial: str, warn: Callable[[str], None]) -> None:
        self._path = directory / f"{serial}.json"
        self._serial = serial
        self._warn = warn
        self._last: SavedState | None = None

    def load(self) -> SavedState | None:
        """Return what was saved; None, after one line, if it is unreadable or another's."""
        try:
            state = _State.model_validate_json(self._path.read_bytes(), strict=False)
            if state.serial != self._serial:
                raise ValueError(f"it is of module {state.serial}")
            return _saved(state)
        except FileNotFoundError:
            return None
        except ValidationError as error:
            reason = error.errors()[0]["msg"]
        except (OSError, ValueError) as error:
            reason = str(error)
        self._warn(f"{self._path}: not the state of this module, which starts new: {reason}")
        return None

    def save(self, state: SavedState) -> None:
        """Replace the document, if anything changed."""
        if state == self._last:
            return
        self._last = state
        text = _document(state, self._serial).model_dump_json(indent=1)
        unfinished = self._path.with_name(f".{self._path.name}.{os.getpid()}")
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            unfinished.write_text(text)
            os.replace(unfinished, self._path)
        except OSError as error:
            self._warn(f"{self._path}: the state of the module is not kept: {error}")
            with suppress(OSError):
                unfinished.unlink(missing_ok=True)


def _document(state: SavedState, serial: str) -> _State:
    return _State(
        serial=serial,
        start=state.start.state.name,  # type: ignore[arg-type] # the model checks it
        profile_id=state.start.profile_id,
        profiles=[
            _Profile(
                profile_id=profile_id,
                zone_m=list(settings.zone_m),
                sensitivity=settings.sensitivity,
                tx_center_frequency=settings.tx_center_frequency,
                led=settings.led,
                noise_map_control=settings.noise_map_control,
                noise_map_interval_min=settings.noise_map_interval_min,
                outputs=list(settings.outputs.items()),
                debug_outputs=list(settings.debug_outputs.items()),
            )
            for profile_id, settings in state.profiles.items()
        ],
        files=[
            _File(type=kind, identifier=identifier, base64=b64encode(data).decode("ascii"))
            for (kind, identifier), data in state.files.items()
        ],
        parameter_file_name=state.parameter_file_name,
        certification=state.certification,
    )


def _saved(state: _State) -> SavedState:
    return SavedState(
        start=Start(state=State[state.start], profile_id=state.profile_id),
        profiles={
            profile.profile_id: ProfileSettings(
                zone_m=(profile.zone_m[0], profile.zone_m[1]),
                sensitivity=profile.sensitivity,
                tx_center_frequency=profile.tx_center_frequency,
                led=profile.led,
                noise_map_control=profile.noise_map_control,
                noise_map_interval_min=profile.noise_map_interval_min,
                outputs=dict(profile.outputs),
                debug_outputs=dict(profile.debug_outputs),
            )
            for profile in state.profiles
        },
        files={
            (file.type, file.identifier): b64decode(file.base64, validate=True)
            for file in state.files
        },
        parameter_file_name=state.parameter_file_name,
        certification=state.certification,
    )
