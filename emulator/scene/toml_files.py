"""TOML files that a person writes, scenes and fault scenarios: models, and one-line errors."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, TypeGuard, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    StrictFloat,
)

from xethru_protocol.validation import choices, load_toml, matching

# Beside this package, in the repository and in the wheel alike. Not importlib.resources on the
# name "fixtures": a folder of that name in the user's own project would come first.
_FIXTURES = Path(__file__).parents[2] / "fixtures"


def finite(value: object) -> object:
    """Refuse TOML's inf and nan with a message that a person can act on."""
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError("must be a finite number")
    return value


Number = Annotated[StrictFloat, BeforeValidator(finite)]
SerialNumber = Annotated[str, AfterValidator(matching("[0-9]{12}", "12 digits"))]


class Table(BaseModel):
    """One TOML table: frozen, and an unknown key is an error."""

    model_config = ConfigDict(extra="forbid", frozen=True)


TableT = TypeVar("TableT", bound=Table)


def shipped_names(folder: str) -> tuple[str, ...]:
    """Return the names of the files of a folder of fixtures, sorted."""
    return tuple(sorted(path.stem for path in (_FIXTURES / folder).glob("*.toml")))


def is_name(path_or_name: str | Path) -> TypeGuard[str]:
    """Return whether it is the name of a shipped file: no path separator, and no ``.toml``."""
    return (
        isinstance(path_or_name, str)
        and not path_or_name.endswith(".toml")
        and "/" not in path_or_name
    )


def load_table(
    model: type[TableT],
    path_or_name: str | Path,
    *,
    folder: str,
    what: str,
    error: type[Exception],
    unknown: type[Exception],
) -> TableT:
    """Return the model in a TOML file, or in a shipped one of a folder of fixtures by its name.

    A string without a path separator and without ``.toml`` is a name. ``unknown`` is raised for a
    name that does not ship, ``error`` for everything else; the message is one line that begins
    with the name or path and calls the file ``what``.
    """
    text = str(path_or_name)
    source = Path(path_or_name)
    if is_name(path_or_name):
        if text not in shipped_names(folder):
            raise unknown(
                f"{text}: no such {what}, nor the path of a .toml file; "
                f"{choices(text, shipped_names(folder))}"
            )
        source = _FIXTURES / folder / f"{text}.toml"
    return load_toml(model, source, source=text, what=what, error=error)
