"""The numbers that SLAM runs with beyond its settings: constants of its modules and its rules.

Settings are in the presets and in the session's own table. What is here has one value for every
scene and preset, and changes from version to version only.
"""

from __future__ import annotations

import ast
import inspect
import json
import math
import pkgutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass, replace
from functools import cache
from importlib import import_module
from numbers import Real
from types import ModuleType
from typing import TypeAlias, TypeVar

import numpy as np

from slam.robust.parameters import BackEndParameters

Json: TypeAlias = "float | list[Json] | dict[str, Json]"

_PACKAGES = ("slam.front_end", "slam.paper", "slam.robust")
_MODULES = ("slam.config", "slam.frames", "slam.geometry", "slam.results")


def slam_constants() -> dict[str, Json]:
    """Return every number by its dotted name, such as ``slam.robust.parameters.MapRule.hit``.

    Numbers that a module assigns, and defaults of its dataclasses; those in tuples, arrays and
    tables of numbers, too. Where a module only imports a number, it is not repeated.
    """
    return dict(_collected())


@cache
def _collected() -> Mapping[str, Json]:
    return {name: number for module in _modules() for name, number in _numbers_of(module)}


def _modules() -> Iterator[ModuleType]:
    for name in _PACKAGES:
        package = import_module(name)
        for found in pkgutil.walk_packages(package.__path__, f"{name}."):
            yield import_module(found.name)
    yield from map(import_module, _MODULES)


def _numbers_of(module: ModuleType) -> Iterator[tuple[str, Json]]:
    for name in _assigned(module):
        yield from _entry(f"{module.__name__}.{name}", vars(module)[name])
    for name, value in vars(module).items():
        if inspect.isclass(value) and value.__module__ == module.__name__:
            for key, default in _defaults(value):
                yield from _entry(f"{module.__name__}.{name}.{key}", default)


def _assigned(module: ModuleType) -> Iterator[str]:
    """Yield the names that a module assigns; its namespace has those that it imports, too."""
    for statement in ast.parse(inspect.getsource(module)).body:
        if isinstance(statement, ast.Assign | ast.AnnAssign):
            for part in ast.walk(statement):
                if isinstance(part, ast.Name) and isinstance(part.ctx, ast.Store):
                    yield part.id


def _defaults(kind: type) -> Iterator[tuple[str, object]]:
    if not is_dataclass(kind):
        yield from ((name, value) for name, value in vars(kind).items() if name[0] != "_")
        return
    for field in fields(kind):
        if field.default is not MISSING:
            yield field.name, field.default


def _entry(name: str, value: object) -> Iterator[tuple[str, Json]]:
    number = _as_json(value)
    if number not in (None, [], {}):
        yield name, number


def _as_json(value: object) -> Json | None:
    """Return what JSON can hold of a value that is made of numbers only; None for any other."""
    if isinstance(value, np.ndarray):  # complex ones as pairs
        array = np.ascontiguousarray(value)
        value = (array.view(np.float64) if np.iscomplexobj(array) else array).tolist()
    if isinstance(value, slice):
        value = [bound for bound in (value.start, value.stop, value.step) if bound is not None]
    if is_dataclass(value) and not isinstance(value, type):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    if isinstance(value, Mapping):
        table = {str(key): _as_json(part) for key, part in value.items()}
        whole = {key: part for key, part in table.items() if part is not None}
        return whole if len(whole) == len(table) else None
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        parts = [_as_json(part) for part in value]
        row = [part for part in parts if part is not None]
        return row if len(row) == len(parts) else None
    if isinstance(value, int):  # bool, too
        return value
    if isinstance(value, Real):  # NaN stands for none
        return None if math.isnan(value) else float(value)
    return None


_RULES = [rule for rule in fields(BackEndParameters) if rule.name not in {"wheels", "ranges"}]
"""Those that a run takes as they are; noise comes from its settings."""


def recorded_rules(constants: Mapping[str, object]) -> BackEndParameters:
    """Return the back end's rules with the recorded numbers, for those that are recorded."""
    rules = BackEndParameters()
    return replace(
        rules, **{rule.name: _recorded(getattr(rules, rule.name), constants) for rule in _RULES}
    )


_Rule = TypeVar("_Rule")


def _recorded(rule: _Rule, constants: Mapping[str, object]) -> _Rule:
    changes = {}
    for field in fields(rule):  # type: ignore[arg-type]  # every rule is a dataclass
        default = getattr(rule, field.name)
        value = constants.get(f"{type(rule).__module__}.{type(rule).__qualname__}.{field.name}")
        if isinstance(value, list):
            value = tuple(value)
        if type(value) is type(default):
            changes[field.name] = value
    return replace(rule, **changes)  # type: ignore[type-var]  # as above


def different_constants(recorded: Mapping[str, object]) -> list[str]:
    """Return where a session's numbers differ from those that its replay has, a text each.

    The rules that `recorded_rules` takes over are not among them; nor is any number of a session
    that holds none.
    """
    if not recorded:
        return []
    present = slam_constants()
    taken_over = recorded_rules(recorded)
    for rule in _RULES:
        values = getattr(taken_over, rule.name)
        kind = type(values)
        for field in fields(kind):
            number = _as_json(getattr(values, field.name))
            if number is not None:
                present[f"{kind.__module__}.{kind.__qualname__}.{field.name}"] = number
    return [
        f"{name} {_text(recorded.get(name))}, here {_text(present.get(name))}"
        for name in sorted({*recorded, *present})
        if _text(recorded.get(name)) != _text(present.get(name))
    ]


def _text(value: object) -> str:
    return "none" if value is None else json.dumps(value)
