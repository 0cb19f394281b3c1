"""How `doctor` works: a table of checks, carried out in order on whatever is examined."""

import shlex
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Generic, TypeVar

from xethru_protocol.errors import XeThruError

PatientT = TypeVar("PatientT")


class Level(Enum):
    """How bad a finding is."""

    OK = "ok"
    NOTE = "note"  # as it should be for some users, not for others
    FAULT = "fault"


@dataclass(frozen=True, slots=True, kw_only=True)
class Check(Generic[PatientT]):
    """A row of a table.

    Attributes
    ----------
    name
        What is all right if nothing is found.
    looks_at
        Where the evidence comes from.
    find
        Returns what is wrong, None if nothing is.
    remedy
        What to do about it; ``{...}`` may name any attribute of the patient, which is quoted as
        a shell needs it.
    level
        NOTE for what is a fault only to some users.
    ends
        Whether this finding ends the examination: it leaves nothing that later rows could look
        at, or they would disturb another program.
    """

    name: str
    looks_at: str
    find: Callable[[PatientT], str | None]
    remedy: str
    level: Level = Level.FAULT
    ends: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """What a check came to; ``found`` and ``remedy`` are empty if all is well."""

    check: str
    looks_at: str
    level: Level
    found: str = ""
    remedy: str = ""


def examine(patient: PatientT, checks: Sequence[Check[PatientT]]) -> Iterator[Finding]:
    """Carry out checks in order, until one ends the examination."""
    for check in checks:
        try:
            found = check.find(patient)
        except (XeThruError, OSError) as error:  # a module that answered, a port that was there
            yield Finding(
                check=check.name,
                looks_at=check.looks_at,
                level=Level.FAULT,
                found=f"this could not be found out: {getattr(error, 'strerror', None) or error}",
                remedy="try again; if this stays, take the module's power away for some seconds",
            )
            return
        if found is None:
            yield Finding(check=check.name, looks_at=check.looks_at, level=Level.OK)
            continue
        yield Finding(
            check=check.name,
            looks_at=check.looks_at,
            level=check.level,
            found=found,
            remedy=check.remedy.format_map(_Attributes(patient)),
        )
        if check.ends:
            return


class _Attributes(dict[str, object]):
    """The attributes of an object, quoted for a shell; each is asked for only when named."""

    def __init__(self, named: object) -> None:
        super().__init__()
        self._named = named

    def __missing__(self, name: str) -> object:
        value = getattr(self._named, name)
        if isinstance(value, tuple):
            return shlex.join(map(str, value))
        return shlex.quote(value) if isinstance(value, str) else value
