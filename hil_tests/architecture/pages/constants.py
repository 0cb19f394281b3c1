"""Write `docs/constants.md`, the robust back end's constants: `python -m` this, then commit."""

import ast
import inspect
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import get_args, get_type_hints

from hil_tests.architecture.pages.markdown import table, write
from hil_tests.paths import REPOSITORY
from slam.config import Origin, RobustConfig, load_preset
from slam.robust import parameters
from slam.robust.parameters import BackEndParameters

PAGE = REPOSITORY / "docs" / "constants.md"

MEANINGS = {
    Origin.DATA_SHEET: "specification of the robot or of a radar",
    Origin.MEASURED: "measured on the emulator or on a recording; the sentence says on which",
    Origin.QUANTILE: "follows from a probability",
    Origin.BUDGET: "limits time or memory, or how long something may take",
    Origin.CHOSEN: "chosen by looking at results of scenes",
}
# By the end of a constant's name, the first that fits; others say their unit beside their origin.
UNITS = {
    "_per_sqrt_m": "1/√m",
    "_m": "m",
    "_rad": "rad",
    "_deg": "°",
    "_nats": "nats",
    "sigmas": "σ",
}

HEAD = """# Constants of the robust back end

Every number that decides something in `slam/robust`: where it comes from and what it is. They are
the same in every scene. `slam/robust/parameters.py` says which numbers are no constants in this
sense. A session stores all numbers, these and the others.

This page is made of the source: `python -m hil_tests.architecture.pages.constants` writes it.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Constant:
    """One number that decides something."""

    name: str
    value: float
    unit: str
    origins: tuple[Origin, ...]  # one, unless the source is wrong
    sentence: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Group:
    """The constants of one class, or of the module that holds the classes."""

    title: str
    purpose: str
    constants: tuple[Constant, ...]


def groups() -> list[Group]:
    """Return all constants; settings have the values of preset robust."""
    rules = BackEndParameters()
    given = rules.wheels, rules.ranges, rules.jumps  # they come with the robot and the settings
    of_rules = [
        group_of(type(rule), {field.name: getattr(rule, field.name) for field in fields(rule)})
        for rule in (getattr(rules, field.name) for field in fields(rules))
        if rule not in given
    ]
    return [
        group_of(parameters, vars(parameters), "Shared", "What several rules use."),
        *of_rules,
        group_of(
            RobustConfig,
            load_preset("robust").robust.model_dump(),
            "Settings",
            "Table `[robust]` of preset robust (`slam.config.RobustConfig`), for users to change.",
        ),
    ]


def group_of(
    owner: ModuleType | type, values: Mapping[str, object], title: str = "", purpose: str = ""
) -> Group:
    """Return what a class, or a module, annotates as a number."""
    sentences = dict(_sentences(owner))
    found = []
    for name, hint in get_type_hints(owner, include_extras=True).items():
        value = values[name]
        if isinstance(value, bool) or not isinstance(value, int | float):
            continue
        notes = get_args(hint)[1:]
        origins = tuple(note for note in notes if isinstance(note, Origin))
        units = [note for note in notes if type(note) is str]
        units += [unit for end, unit in UNITS.items() if name.lower().endswith(end)]
        found.append(
            Constant(
                name=name,
                value=value,
                unit=[*units, ""][0],
                origins=origins,
                sentence=sentences.get(name, ""),
            )
        )
    return Group(
        title=title or owner.__name__,
        purpose=purpose or inspect.getdoc(owner) or "",
        constants=tuple(found),
    )


def _sentences(owner: ModuleType | type) -> Iterator[tuple[str, str]]:
    """Yield the names that a class or module annotates, with the string below each."""
    tree = ast.parse(inspect.getsource(owner))
    body = tree.body
    if isinstance(owner, type):
        body = next(part for part in body if isinstance(part, ast.ClassDef)).body
    for statement, below in pairwise(body):
        is_text = isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant)
        if is_text and isinstance(statement, ast.AnnAssign):
            text = ast.literal_eval(below.value)  # type: ignore[attr-defined]  # as is_text says
            yield ast.unparse(statement.target), " ".join(text.split())


def counts() -> Counter[Origin]:
    """Return how many constants there are of each origin."""
    return Counter(
        origin for group in groups() for constant in group.constants for origin in constant.origins
    )


def documents() -> dict[Path, str]:
    found = counts()
    kinds = [(str(origin), str(found[origin]), text) for origin, text in MEANINGS.items()]
    kinds.append(("all", str(found.total()), ""))
    parts = [HEAD, table(("origin", "constants", "meaning"), kinds, ["constants"])]
    for group in groups():
        rows = [
            (
                f"`{constant.name}`",
                f"{constant.value:.6g}",
                constant.unit,
                ", ".join(constant.origins),
                constant.sentence,
            )
            for constant in group.constants
        ]
        columns = ("name", "value", "unit", "origin", "what it is")
        parts += [f"## {group.title}\n", f"{group.purpose}\n", table(columns, rows, ["value"])]
    return {PAGE: "\n".join(parts)}


if __name__ == "__main__":
    write(documents())
