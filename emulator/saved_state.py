"""What a module keeps over resets and power cuts, and where it keeps it.

Source: protocol reference 4.7, 4.10, 4.11 and 8.2.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

from emulator.filesystem import FileKey
from emulator.modes import Start
from emulator.profile_settings import ProfileSettings

__all__ = ["Memory", "SavedState", "VolatileMemory"]


@dataclass(frozen=True, slots=True, kw_only=True)
class SavedState:
    """Content of a module's flash.

    Attributes
    ----------
    start
        Last profile, and whether it ran.
    profiles
        Settings of each profile as of its last start, by profile id.
    files
        Content of the file system; noise maps and the crash dump are files.
    parameter_file_name
        Name of the parameter file, if there is one.
    certification
        Whether the module starts in certification mode.
    """

    start: Start = field(default_factory=Start)
    profiles: Mapping[int, ProfileSettings] = field(default_factory=dict)
    files: Mapping[FileKey, bytes] = field(default_factory=dict)
    parameter_file_name: str = ""
    certification: bool = False


class Memory(Protocol):
    """Where a module's flash is kept while the emulator does not run."""

    def load(self) -> SavedState | None:
        """Return what was saved; None for a module fresh from the factory."""
        ...

    def save(self, state: SavedState) -> None:
        """Keep a state."""
        ...


class VolatileMemory:
    """Keeps nothing: every start of the emulator finds a new module."""

    def load(self) -> SavedState | None:
        """Return None."""
        return None

    def save(self, state: SavedState) -> None:
        """Forget it."""
