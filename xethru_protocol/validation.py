"""What is wrong with what a person wrote, a file or an option, in one line of plain English.

Problems are the plain dictionaries of pydantic's ``ValidationError.errors()``, and models are only
asked for their fields: scenes and settings of SLAM share this, and nothing here needs pydantic.
"""

from __future__ import annotations

import json
import math
import os.path
import re
from argparse import PARSER, REMAINDER, ArgumentParser, ArgumentTypeError
from collections.abc import Callable, Iterable, Mapping, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NoReturn, Protocol, Self, TypeVar

from xethru_protocol.operating_system import one_line, read_bounded

_MUST = {
    "string_type": "be text in quotes",
    "int_type": "be a whole number",
    "int_from_float": "be a whole number",
    "int_parsing": "be a whole number",
    "int_parsing_size": "be a smaller number",
    "float_type": "be a number",
    "float_parsing": "be a number",
    "finite_number": "be a finite number",
    "bool_type": "be true or false",
    "bool_parsing": "be true or false",
    "list_type": "be a list",
    "tuple_type": "be a list",
    "dict_type": "be a table",
    "model_type": "be a table",
    "model_attributes_type": "be a table",
    "literal_error": "be {expected}",
    "enum": "be {expected}",
    "greater_than": "be greater than {gt}",
    "greater_than_equal": "be at least {ge}",
    "less_than": "be less than {lt}",
    "less_than_equal": "be at most {le}",
    "string_too_short": "have at least {min_length} characters",
    "string_too_long": "have at most {max_length} characters",
    "too_short": "have at least {min_length} entries",
    "too_long": "have at most {max_length} entries",
}
"""By pydantic's type of a problem."""

Problem = Mapping[str, Any]
Location = tuple[int | str, ...]
_LONGEST = 60


def problem_text(problems: Sequence[Problem], model: Any) -> str:  # noqa: ANN401 - see the module
    """Describe the first problem: key, what is allowed, what is there, and how many more there are.

    ``model`` is the class of the table, whose ``model_fields`` name what is allowed.
    """
    # A refused row makes its list too short as well: that is not a problem of its own.
    refused = {each["loc"][:depth] for each in problems for depth in range(len(each["loc"]))}
    texts: dict[str, list[str]] = {}
    for each in problems:
        if each["type"] != "too_short" or each["loc"] not in refused:
            location, keys, table = _place(each["loc"], model)
            of_key = texts.setdefault(_key(location), [])
            text = _text(each, keys, table)
            if text not in of_key:
                of_key.append(text)
    key, first = next(iter(texts.items()))
    more = f" (and {len(texts) - 1} more)" if len(texts) > 1 else ""
    # several texts of one key: the value may be of several kinds, and is of none
    kinds = [each.partition(", not ")[0] for each in first[:-1]]
    text = " or ".join([*kinds, first[-1].removeprefix("must be ")]) if kinds else first[0]
    return f"{key}: {text}{more}" if key else f"{text}{more}"


class Model(Protocol):
    """A table that is checked, as pydantic's are."""

    @classmethod
    def model_validate(cls, obj: Any, /) -> Self: ...  # noqa: ANN401 - see the module


ModelT = TypeVar("ModelT", bound=Model)


def load_toml(
    model: type[ModelT], path: Path, *, source: str, what: str, error: type[Exception]
) -> ModelT:
    """Return the model in a TOML file.

    Raises ``error`` with one line that begins with ``source`` and calls the file ``what``.
    """
    import tomllib  # commands that read no such file start without it

    try:
        return model.model_validate(tomllib.loads(read_bounded(path).decode()))
    except OSError as problem:
        raise error(f"{source}: cannot read the {what} file: {problem.strerror}") from problem
    except UnicodeDecodeError as problem:
        raise error(f"{source}: not UTF-8 text at byte {problem.start}") from problem
    except RecursionError as problem:
        raise error(f"{source}: brackets are nested too deep") from problem
    except ValueError as problem:
        if (problems := getattr(problem, "errors", None)) is not None:  # the model refuses it
            raise error(f"{source}: {problem_text(problems(), model)}") from problem
        # not TOML, or an integer of thousands of digits
        raise error(f"{source}: not valid TOML: {problem}") from problem


def matching(pattern: str, what: str) -> Callable[[str], str]:
    """Return what refuses text that does not match, calling what it must be by its name."""

    def check(text: str) -> str:
        if not re.fullmatch(pattern, text):
            raise ValueError(f"must be {what}, not {shown(text)}")
        return text

    return check


def shown(value: object) -> str:
    """Write a value as a person would in TOML; lists and tables only by what they are.

    >>> print(shown("lab"), shown(True), shown([1.5]), shown(-0.5))
    "lab" true a list -0.5
    """
    if isinstance(value, bool | str):
        text = one_line(json.dumps(value, ensure_ascii=False))
    elif isinstance(value, dict):
        return "a table"
    elif isinstance(value, list | tuple):
        return "a list"
    elif value is None:
        return "nothing"
    elif isinstance(value, int) and value.bit_length() > math.log2(10) * _LONGEST:
        return "a number that long"
    else:
        text = str(value)
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST - 3]}..."


_FEW = 4
"""So many names may be listed in any case."""


def choices(name: str, names: Iterable[str]) -> str:
    """Return which name may be meant by an unknown one; all names where they are few, or none is.

    >>> choices("labb", ["lab", "store"]), choices("x", ["lab", "store"])
    ('did you mean lab? known are lab, store', 'known are lab, store')
    """
    known = list(names)
    close = [f"did you mean {each}?" for each in get_close_matches(name.lower(), known, n=1)]
    if not close or len(known) <= _FEW:
        close.append(f"known are {', '.join(known) or 'none'}")
    return " ".join(close)


_INVALID_CHOICE = re.compile(r"(.*invalid choice: '(.*)') \(choose from '?(.*?)'?\)", re.DOTALL)
_BETWEEN_CHOICES = re.compile("'?, '?")


class Parser(ArgumentParser):
    """A parser of a command line that asks which choice or option was meant by a misspelt one."""

    def parse_known_args(  # type: ignore[override] # only as the other methods call it
        self,
        args: Sequence[str] | None = None,
        namespace: Any = None,  # noqa: ANN401 - as the base
    ) -> tuple[Any, list[str]]:
        """Parse; an option that is not there is refused before one that is missing."""
        takes_all = any(action.nargs in {PARSER, REMAINDER} for action in self._actions)
        for word in () if takes_all or args is None else args:
            name = word.partition("=")[0]
            if name == "--":
                break
            options = self._option_string_actions
            if name.startswith("--") and not any(each.startswith(name) for each in options):
                close = get_close_matches(name, options, n=1)
                meant = f"; did you mean {close[0]}?" if close else ""
                self.error(f"there is no option {name}{meant}")
        return super().parse_known_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        if found := _INVALID_CHOICE.fullmatch(message):
            message = f"{found[1]}; {choices(found[2], _BETWEEN_CHOICES.split(found[3]))}"
        super().error(message)


def recording_at(text: str) -> str:
    """Return the path of a recording: of a run's folder that of its session.mcap."""
    session = os.path.join(text, "session.mcap")
    return session if os.path.isfile(session) else text


def reason_of(error: Exception) -> str:
    """Return why reading something failed, without Python's own words for what it met.

    >>> reason_of(KeyError("lap"))
    'lap is missing'
    """
    match error:
        case KeyError():
            return f"{error.args[0]} is missing"
        case TypeError() | AttributeError():
            return "a part of it is of another kind"
        case UnicodeDecodeError():
            return f"not UTF-8 text at byte {error.start}"
        case OSError(strerror=str(reason)):
            return reason
    return str(error) or type(error).__name__


def number(
    kind: Callable[[str], float], is_allowed: Callable[[float], bool], allowed: str
) -> Callable[[str], float]:
    """Return the type of an option that takes the ``allowed`` numbers, and refuses others."""

    def read(text: str) -> float:
        try:
            value = kind(text)
        except ValueError:
            value = math.nan
        if not is_allowed(value):
            raise ArgumentTypeError(f"{shown(text)} must be {allowed}")
        return value

    return read


_SUFFIX = re.compile(r"\.([A-Za-z]{2}\w*|h5)")


def suffix_of(path: Path) -> str:
    """Return what a name to be written says about the format, "" for a directory that exists.

    A date or a number of a version behind a dot says nothing.

    >>> [suffix_of(Path(name)) for name in ("a.csv", "rec", "rec.2026-11-25", "rec.v2")]
    ['.csv', '', '', '']
    """
    return path.suffix if _SUFFIX.fullmatch(path.suffix) and not path.is_dir() else ""


def output(*suffixes: str, what: str = "a file") -> Callable[[str], Path]:
    """Return the type of an option that names what is written: with such a suffix, or without one.

    A name with the suffix of another format would promise that format.
    """

    def read(text: str) -> Path:
        found = suffix_of(Path(text))
        if found not in suffixes and found.lower() in suffixes:
            raise ArgumentTypeError(f"write {found} in small letters: {found.lower()}")
        if found and found not in suffixes:
            allowed = " or ".join(
                [*(f"that ends in {name}" for name in suffixes), "without suffix"]
            )
            raise ArgumentTypeError(f"this writes {what}, not {found[1:]}: give a name {allowed}")
        return Path(text)

    return read


def _text(problem: Problem, keys: Sequence[str], table: Any) -> str:  # noqa: ANN401 - as above
    """Describe a value in a table of these keys that should be a ``table``, None if no table."""
    kind, value, limits = problem["type"], problem.get("input"), problem.get("ctx", {})
    match kind:
        case "extra_forbidden":
            text = f"unknown key; {choices(str(problem['loc'][-1]), keys)}"
        case "tuple_type" if isinstance(value, dict) and table is not None:
            name = problem["loc"][-1]
            text = f"must be a list of tables; begin each with [[{name}]], not [{name}]"
        case "missing":
            is_entry = isinstance(problem["loc"][-1], int)
            text = "missing; " + ("the list is too short" if is_entry else "this key is required")
        case "value_error":
            text = str(limits["error"])
        case "too_short" | "string_too_short" if limits["min_length"] == 1:
            text = "must not be empty"
        case "too_short" | "too_long":
            text = f"must {_must(problem)}, not {len(value or ())}"
        case _:
            text = f"must {_must(problem)}, not {shown(value)}"
    return text


def _must(problem: Problem) -> str:
    if problem["type"] not in _MUST:
        return str(problem["msg"]).removeprefix("Input should ")
    limits = {name: _plain(limit) for name, limit in problem.get("ctx", {}).items()}
    return _MUST[problem["type"]].format_map(limits).replace("'", '"')


def _plain(limit: object) -> object:
    return int(limit) if isinstance(limit, float) and limit.is_integer() else limit


def _place(location: Location, model: Any) -> tuple[Location, list[str], Any]:  # noqa: ANN401 - as above
    """Follow a location: without the kinds of value that were tried, and its table's keys.

    Third comes the model of what is there, None if that is not a table.
    """
    keys: list[str] = []
    for depth, part in enumerate(location):
        if isinstance(part, int):
            continue
        fields = getattr(model, "model_fields", None)
        if fields is None:
            return location[:depth], keys, None
        keys = list(fields)
        if part not in fields:
            return location[: depth + 1], keys, None
        model = _table_of(fields[part].annotation)
    return location, keys, model


def _table_of(annotation: Any) -> Any:  # noqa: ANN401 - any type expression
    """Return the table in ``Table``, ``tuple[Table, ...]`` or ``Table | None``, else None."""
    if hasattr(annotation, "model_fields"):
        return annotation
    inside = getattr(annotation, "__args__", ())
    return next((table for each in inside if (table := _table_of(each)) is not None), None)


def _key(location: Location) -> str:
    parts = (f"[{part}]" if isinstance(part, int) else f".{part}" for part in location)
    return "".join(parts).removeprefix(".")
