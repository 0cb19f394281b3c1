"""What can be wrong apart from the ports themselves: one row per check."""

import json
from dataclasses import dataclass
from pathlib import Path

from xethru_protocol.cli.examination import Check
from xethru_protocol.ports import is_running


@dataclass(frozen=True, slots=True, kw_only=True)
class Machine:
    """A computer: ports found, and the folder in which emulators leave word."""

    ports: tuple[str, ...]
    run_directory: Path

    @property
    def stale(self) -> tuple[Path, ...]:
        """What emulators left that are not running any more."""
        return tuple(
            entry
            for entry in sorted(self.run_directory.glob("*"))
            if (pid := _process_id(entry)) is not None and not is_running(pid)
        )

    @property
    def damaged(self) -> tuple[Path, ...]:
        """Entries of running emulators that cannot be read."""
        return tuple(
            entry
            for entry in sorted(self.run_directory.glob("*.json"))
            if entry not in self.stale and not _is_readable(entry)
        )


def _process_id(entry: Path) -> int | None:
    """Process an entry belongs to: ``<pid>.json`` or ``ports-<pid>-...``; None if it is neither."""
    if entry.suffix == ".json":
        text = entry.stem
    elif entry.name.startswith("ports-"):
        text = entry.name.split("-")[1]
    else:
        return None
    return int(text) if text.isascii() and text.isdecimal() and len(text) < 20 else None


def _is_readable(entry: Path) -> bool:
    try:
        return isinstance(json.loads(entry.read_text()), dict)
    except (OSError, ValueError, RecursionError):
        return False


def _no_module(machine: Machine) -> str | None:
    if machine.ports:
        return None
    return "no module was found: none on USB, no emulator is running"


def _stale_entries(machine: Machine) -> str | None:
    if not machine.stale:
        return None
    return f"{machine.run_directory} still holds what emulators left that have died"


def _damaged_entries(machine: Machine) -> str | None:
    if not machine.damaged:
        return None
    return "what a running emulator says about its ports cannot be read"


MACHINE_CHECKS = (
    Check(
        name="modules found",
        looks_at="USB ids, and the word of running emulators",
        find=_no_module,
        remedy="plug one in, run xethru-emulator serve --bare, or name a port with --port",
    ),
    Check(
        name="no dead emulators",
        looks_at="processes named in the run directory",
        find=_stale_entries,
        remedy="start an emulator, which tidies up, or run: rm -r {stale}",
    ),
    Check(
        name="emulators' word readable",
        looks_at="entries of the run directory",
        find=_damaged_entries,
        remedy="stop that emulator and run: rm {damaged}",
    ),
)
