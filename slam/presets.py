"""Presets and settings: where a configuration comes from, and one clear line where it cannot."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from slam.config import TEXT_ALLOWED, SlamConfig

# The top level of a preset file holds the values of this environment (paper, Table I).
BASE_ENVIRONMENT = "lab"


class ConfigError(ValueError):
    """A preset file or an override that cannot be used; one line with file, key and remedy."""


# Beside this package, in the repository and in the wheel alike; a folder named "fixtures" in the
# user's own project must not come first, as it would by that name.
_SHIPPED_PRESETS = Path(__file__).parent.parent / "fixtures" / "presets"

REMOVED_KEYS: Mapping[str, str | float] = {
    "leakage.filter": "none",
    "leakage.max_range_m": 0.45,
    "leakage.memory_frames": 50.0,
    "robust.calibrated_offset_sigma_m": 0.0,
    "trilateration.bearing": "ranges",
}
"""Settings that no longer exist, with their defaults in the last version that had them."""
_LAST_VERSION_WITH_THEM = "0.1.0"


def load_preset(name: str, environment: str = BASE_ENVIRONMENT) -> SlamConfig:
    """Return the preset ``fixtures/presets/<name>.toml`` for one environment.

    Raises
    ------
    ConfigError
        Unknown preset or environment, unreadable file, unknown key or value out of range.
    """
    known = sorted(file.stem for file in _SHIPPED_PRESETS.glob("*.toml"))
    if name not in known:
        raise ConfigError(f"unknown preset {name!r}; known: {', '.join(known)}")
    file = _SHIPPED_PRESETS / f"{name}.toml"
    source = f"preset {name}.toml"
    try:
        tables = tomllib.loads(file.read_text(encoding="utf-8"))
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{source}: not TOML: {error}") from error
    return config_from_tables(tables, environment=environment, source=source)


def config_from_tables(
    tables: Mapping[str, Any], *, environment: str = BASE_ENVIRONMENT, source: str
) -> SlamConfig:
    """Return the configuration that the tables of a preset file describe.

    Parameters
    ----------
    tables
        The parsed file: one table per part of SlamConfig, and ``environment.<name>`` with the
        values that differ there.
    environment
        "lab" is the top level itself; any other name must have its table, unless the file has
        none at all and so is the same everywhere. The tables of all environments are checked,
        whichever is asked for.
    source
        What to call the tables in an error message.
    """
    base = {key: value for key, value in tables.items() if key != "environment"}
    overrides = _table(tables.get("environment", {}), "environment", source)
    if "environment" not in tables:
        return _validated(base, source)
    if environment != BASE_ENVIRONMENT and environment not in overrides:
        allowed = ", ".join([BASE_ENVIRONMENT, *sorted(overrides)])
        raise ConfigError(f"{source}: no environment {environment!r}; known: {allowed}")
    configs = {BASE_ENVIRONMENT: _validated(base, source)}
    for name, values in overrides.items():
        key = f"environment.{name}"
        merged = dict(base)
        for part, changes in _table(values, key, source).items():
            general = merged.get(part, {})
            merged[part] = {**general, **_table(changes, f"{key}.{part}", source)}
        configs[name] = _validated(merged, f"{source}: {key}")
    return configs[environment]


def override(config: SlamConfig, settings: Mapping[str, object]) -> SlamConfig:
    """Return the configuration with dotted keys replaced; text is read as the key's type.

    >>> override(SlamConfig(), {"association.gate": "1.6"}).association.gate
    1.6
    """
    tables = config.model_dump()
    for key, value in settings.items():
        part, _, field = key.partition(".")
        if key in tables and not isinstance(tables[key], dict):
            tables[key] = value
            continue
        tables.setdefault(part, {})
        if not isinstance(tables[part], dict) or not field:
            raise ConfigError(f"setting {key!r}: write it as part.key; parts: {_parts()}")
        tables[part] = {**tables[part], field: value}
    return _validated(tables, "setting", context=TEXT_ALLOWED)


def without_removed_keys(tables: Mapping[str, Any], source: str) -> dict[str, Any]:
    """Return the tables of a configuration without the keys in `REMOVED_KEYS`.

    >>> without_removed_keys({"robust": {"calibrated_offset_sigma_m": 0.0}}, "old.toml")
    {'robust': {}}

    Raises
    ------
    ConfigError
        A removed key has another value than its default, so the run would not be the same.
    """
    kept = dict(tables)
    for removed, default in REMOVED_KEYS.items():
        part, _, field = removed.partition(".")
        table = kept.get(part)
        if not isinstance(table, dict) or field not in table:
            continue
        if not _is_same(table[field], default):
            raise ConfigError(
                f"{source}: {removed}: version {_LAST_VERSION_WITH_THEM} was the last with this "
                f"key; only its default {default!r} is still read (given: {table[field]!r})"
            )
        kept[part] = {key: value for key, value in table.items() if key != field}
        if not kept[part] and part not in SlamConfig.model_fields:
            del kept[part]
    return kept


def _is_same(value: object, default: str | float) -> bool:
    if isinstance(value, bool):
        return False
    if isinstance(value, str) and isinstance(default, float):  # from a command line
        try:
            return float(value) == default
        except ValueError:
            return False
    return value == default


def _table(value: object, key: str, source: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ConfigError(f"{source}: {key}: must be a table (given: {value!r})")
    return value


def _validated(tables: Mapping[str, Any], source: str, context: str | None = None) -> SlamConfig:
    tables = without_removed_keys(tables, source)
    try:
        return SlamConfig.model_validate(tables, context=context)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            raise ConfigError(f"{source}: unknown key {key}; allowed: {_siblings(key)}") from error
        message = first["msg"].removeprefix("Value error, ")
        given = f" (given: {first['input']!r})" if not isinstance(first["input"], dict) else ""
        raise ConfigError(f"{source}: {key}: {message}{given}") from error


def _parts() -> str:
    return ", ".join(SlamConfig.model_fields)


def _siblings(key: str) -> str:
    part, _, field = key.partition(".")
    model = SlamConfig.model_fields[part].annotation if field else SlamConfig
    assert isinstance(model, type)
    assert issubclass(model, BaseModel)
    return ", ".join(model.model_fields)
