"""TOML files that a person writes, scenes and fault scenarios: models, and one-line errors."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, StrictFloat, ValidationError

from xethru_protocol.system import read_bounded

# Beside this package, in the repository and in the wheel alike. Not importlib.resources on the
# name "fixtures": a folder of that name in the user's own project would come first.
_FIXTURES = Path(__file__).parents[2] / "fixtures"


def finite(value: object) -> object:
    """Refuse TOML's inf and nan with a message that a person can act on."""
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError("must be a finite number")
    return value


Number = Annotated[StrictFloat, BeforeValidator(finite)]


class Table(BaseModel):
    """One TOML table: frozen, and an unknown key is an error."""

    model_config = ConfigDict(extra="forbid", frozen=True)


TableT = TypeVar("TableT", bound=Table)


def shipped_names(folder: str) -> tuple[str, ...]:
    """Return the names of the files of a folder of fixtures, sorted."""
    return tuple(sorted(path.stem for path in (_FIXTURES / folder).glob("*.toml")))


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
    if isinstance(path_or_name, str) and not text.endswith(".toml") and "/" not in text:
        if text not in shipped_names(folder):
            raise unknown(
                f"{text}: no such {what}; known are {', '.join(shipped_names(folder))}, "
                "or give the path of a .toml file"
            )
        source = _FIXTURES / folder / f"{text}.toml"
    try:
        content = read_bounded(source).decode()
    except OSError as problem:
        raise error(f"{text}: cannot read the {what} file: {problem.strerror}") from problem
    except UnicodeDecodeError as problem:
        raise error(f"{text}: not UTF-8 text at byte {problem.start}") from problem
    return parse_table(model, content, source=text, error=error)


def parse_table(model: type[TableT], text: str, *, source: str, error: type[Exception]) -> TableT:
    """Return the model in TOML text; raise ``error`` naming the source otherwise."""
    try:
        return model.model_validate(tomllib.loads(text))
    except ValidationError as problem:
        raise error(f"{source}: {one_line(problem, model)}") from problem
    except ValueError as problem:  # not TOML, or an integer of thousands of digits
        raise error(f"{source}: not valid TOML: {problem}") from problem
    except RecursionError as problem:
        raise error(f"{source}: brackets are nested too deep") from problem


def one_line(error: ValidationError, model: type[BaseModel]) -> str:
    """Describe the first problem in one line: key, what is allowed, and how many more there are."""
    found = error.errors(include_url=False)
    # A refused row makes its list too short as well: that is no problem of its own.
    refused = {each["loc"][:depth] for each in found for depth in range(len(each["loc"]))}
    problems = [e for e in found if e["type"] != "too_short" or e["loc"] not in refused]
    first = problems[0]
    location = first["loc"]
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in location)
    match first["type"]:
        case "extra_forbidden":
            allowed = ", ".join(_allowed_keys(model, location[:-1])) or "none"
            text = f"unknown key; allowed are {allowed}"
        case "tuple_type" if isinstance(first["input"], dict):
            name = location[-1]
            text = f"must be a list of tables; begin each with [[{name}]], not [{name}]"
        case "missing":
            text = "missing; this key is required"
        case "value_error":
            text = str(first["ctx"]["error"])
        case _:
            text = f"{first['msg'].replace('tuple', 'list')}, got {_short(first['input'])}"
    more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
    return f"{key.removeprefix('.')}: {text}{more}" if key else f"{text}{more}"


def _short(value: object) -> str:
    try:
        text = repr(value)
    except ValueError:  # an integer of thousands of digits
        return "a number of thousands of digits"
    return text if len(text) <= 60 else f"{text[:57]}..."


def _allowed_keys(model: type[BaseModel], location: tuple[int | str, ...]) -> list[str]:
    """Return the keys of the table at a location, by walking the models' fields."""
    for part in location:
        if isinstance(part, str):
            model = _table_type(model.model_fields[part].annotation)
    return list(model.model_fields)


def _table_type(annotation: Any) -> type[BaseModel]:  # noqa: ANN401 - any type expression
    """Return the table model inside ``Table`` or ``tuple[Table, ...]``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return _table_type(annotation.__args__[0])
