"""Every kind of fault, by name.

To add one, write an effect in the file of its layer and a row in that file's table; the scenario
files, the command line and the tests that go through the table then know it.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from emulator.faults import (
    bulk_layer,
    byte_layer,
    device_layer,
    environment_layer,
    frame_layer,
    stream_layer,
    time_layer,
    transaction_layer,
)
from emulator.faults.kind import Kind

__all__ = ["KINDS", "described"]

KINDS: Mapping[str, Kind] = MappingProxyType(
    {
        kind.name: kind
        for layer in (
            byte_layer,
            frame_layer,
            bulk_layer,
            transaction_layer,
            stream_layer,
            device_layer,
            time_layer,
            environment_layer,
        )
        for kind in layer.KINDS
    }
)
"""The catalogue, in the order of its layers."""

_LIMITS = {
    "minimum": "at_least",
    "maximum": "at_most",
    "exclusiveMinimum": "above",
    "exclusiveMaximum": "below",
    "enum": "one_of",
    "pattern": "pattern",
}


def described(kind: Kind) -> dict[str, Any]:
    """Return a kind as JSON-able values: what it does, its parameters, what is counted."""
    schema = kind.parameters.model_json_schema()
    return {
        "kind": kind.name,
        "layer": kind.layer.value,
        "acts_on": kind.target.value,
        "summary": kind.summary,
        "counted": kind.counted,
        "hidden": kind.hidden or None,
        "lasting": kind.lasting,
        "parameters": {
            name: _parameter(field) for name, field in schema.get("properties", {}).items()
        },
        "example": example(kind),
    }


def example(kind: Kind) -> str:
    """Return a scenario with one fault of a kind, as TOML."""
    parameters = kind.parameters().model_dump(exclude_none=True)
    lines = ["[[fault]]", f'kind = "{kind.name}"', "at_s = 2.0"]
    if parameters:
        inner = ", ".join(f"{name} = {_toml(value)}" for name, value in parameters.items())
        lines.append(f"parameters = {{ {inner} }}")
    return "\n".join(lines)


def _parameter(field: dict[str, Any]) -> dict[str, Any]:
    options = [option for option in field.get("anyOf", ()) if option.get("type") != "null"]
    limits = {**field, **(options[0] if options else {})}
    said = {"default": field.get("default"), "meaning": field.get("description", "")}
    return said | {ours: limits[name] for name, ours in _LIMITS.items() if name in limits}


def _toml(value: object) -> str:
    return f'"{value}"' if isinstance(value, str) else repr(value)
