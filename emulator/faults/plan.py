"""Scenario files: which faults hit which radar, when, how often; and the truth log.

A scenario is TOML that a person reads and writes; a mistake is one `FaultPlanError` line naming
file, key and what is allowed::

    seed = 7

    [[fault]]
    kind = "bad_checksum"      # see `xethru-emulator faults`
    radar = ["front"]          # all if left out
    command = "X4DRIVER_GET"   # only what answers, or is, this command; a name or an opcode
    at_s = 2.0                 # from 2 s after the start
    until_s = 10.0             # no longer than this
    frame = 120                # from this frame counter on
    every = 50                 # every 50th opportunity
    probability = 0.01         # each opportunity with this chance
    packet = "frame"           # faults of any packet: frame, reply, system or data only
    count = 3                  # how often; 1 if left out, 0: without end, at every opportunity;
                               # those of faults of a moment are the next frames
    parameters = { }           # of the kind

The truth log is JSON lines, one object per injected fault: ``t_ns`` (device time), ``radar``,
``kind``, ``parameters``, ``counter`` (of the last radar frame, null before the first), ``offset``
(bytes sent to the host before the packet that it hit).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BeforeValidator,
    Field,
    StrictInt,
    ValidationError,
    field_validator,
    model_validator,
)

from emulator.faults.kind import KindOfFault, Parameters, Target
from emulator.faults.kinds import KINDS
from emulator.scene.toml_files import Table, finite, load_table
from xethru_protocol.validation import choices, problem_text, shown
from xethru_protocol.wire.messages import Command
from xethru_protocol.wire.table import ROWS

_LIMITS = {
    "minimum": "at_least",
    "maximum": "at_most",
    "exclusiveMinimum": "above",
    "exclusiveMaximum": "below",
    "enum": "one_of",
    "pattern": "pattern",
}
_COMMANDS = frozenset(row.name for message, row in ROWS.items() if issubclass(message, Command))


def described(kind: KindOfFault) -> dict[str, Any]:
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


def example(kind: KindOfFault) -> str:
    parameters = kind.parameters().model_dump(exclude_none=True)
    lines = ["[[fault]]", f'kind = "{kind.name}"', "at_s = 2.0"]
    if parameters:
        inner = ", ".join(f"{name} = {_toml(value)}" for name, value in parameters.items())
        lines.append(f"parameters = {{ {inner} }}")
    return "\n".join(lines)


def _parameter(field: dict[str, Any]) -> dict[str, Any]:
    options = [option for option in field.get("anyOf", ()) if option.get("type") != "null"]
    limits = {**field, **(options[0] if options else {})}
    described = {"default": field.get("default"), "meaning": field.get("description", "")}
    return described | {ours: limits[name] for name, ours in _LIMITS.items() if name in limits}


def _toml(value: object) -> str:
    return f'"{value}"' if isinstance(value, str) else repr(value)


@dataclass(frozen=True, slots=True, kw_only=True)
class Injected:
    """One record of the truth log; see the module for the fields."""

    t_ns: int
    radar: str
    kind: str
    parameters: Mapping[str, Any]
    counter: int | None
    offset: int

    def line(self) -> str:
        return json.dumps(asdict(self), separators=(",", ":")) + "\n"


class FaultPlanError(ValueError):
    """A scenario that cannot be used; the message is one line with the remedy."""


Seconds = Annotated[float, BeforeValidator(finite), Field(ge=0, le=86_400 * 365)]
Seed = Annotated[StrictInt, Field(ge=0, lt=2**63)]


class FaultSpec(Table):
    """One fault of a scenario: what, to whom, when, how often; see the module for the keys."""

    kind: str
    radar: tuple[str, ...] = ()
    command: str | StrictInt | None = None
    at_s: Seconds = 0.0
    until_s: Seconds | None = None
    frame: Annotated[StrictInt, Field(ge=0, lt=2**32)] | None = None
    every: Annotated[StrictInt, Field(ge=1)] = 1
    probability: Annotated[float, BeforeValidator(finite), Field(gt=0, le=1)] = 1.0
    packet: Literal["any", "frame", "reply", "system", "data"] = "any"
    count: Annotated[StrictInt, Field(ge=0)] = 1
    seed: Seed | None = None
    parameters: dict[str, Any] = Field(default_factory=dict)

    @field_validator("kind")
    @classmethod
    def _known_kind(cls, kind: str) -> str:
        if kind not in KINDS:
            raise ValueError(f"no kind of fault is called {shown(kind)}; {choices(kind, KINDS)}")
        return kind

    @field_validator("command")
    @classmethod
    def _known_command(cls, command: str | int | None) -> str | int | None:
        if isinstance(command, str) and command not in _COMMANDS:
            known = choices(command, sorted(_COMMANDS))
            raise ValueError(f"no command is called {shown(command)}; {known}")
        if isinstance(command, int) and not 0 <= command <= 0xFF:
            raise ValueError(f"an opcode is 0 ... 255, not {command}")
        return command

    @model_validator(mode="after")
    def _has_time(self) -> FaultSpec:
        if self.until_s is not None and self.until_s <= self.at_s:
            raise ValueError(f"until_s: must be later than at_s, {self.at_s:g}; it never happens")
        return self

    @model_validator(mode="after")
    def _has_occasions(self) -> FaultSpec:
        if self.count == 0 and self.target is Target.MOMENT:
            raise ValueError(
                f"count: {self.kind} without end needs frame, every, probability or command, "
                "which say when it comes again"
            )
        return self

    @model_validator(mode="after")
    def _parameters_fit(self) -> FaultSpec:
        try:
            self.kind_parameters()
        except ValidationError as error:
            raise ValueError(
                f"parameters.{problem_text(error.errors(), self.row.parameters)}"
            ) from None
        if self.packet != "any" and self.row.target is not Target.PACKET:
            raise ValueError(f"packet: {self.kind} acts on {self.row.target.value} anyway")
        return self

    @property
    def row(self) -> KindOfFault:
        return KINDS[self.kind]

    @property
    def target(self) -> Target:
        """What it waits for: a moment may be that of a frame or of an answer."""
        if self.row.target is not Target.MOMENT:
            return self.row.target
        if self.command is not None:
            return Target.REPLY
        by_frame = self.frame is not None or self.every > 1 or self.probability < 1
        by_frame |= self.count > 1  # else all would be at one moment
        return Target.FRAME if by_frame else Target.MOMENT

    def kind_parameters(self) -> Parameters:
        return self.row.parameters.model_validate(self.parameters)


class FaultPlan(Table):
    """A scenario. ``seed`` is that of every fault without its own."""

    seed: Seed = 0
    description: str = ""
    fault: tuple[FaultSpec, ...] = ()


def fault_table(kind: str, **keys: Any) -> dict[str, Any]:  # noqa: ANN401 - any key
    """Return one fault as in a scenario; other keys than a fault's are parameters of its kind.

    Raises
    ------
    FaultPlanError
        If a number of frames was meant and a frame was named.
    """
    parameters = dict(keys.pop("parameters", {}))
    parameters |= {key: keys.pop(key) for key in set(keys) - set(FaultSpec.model_fields)}
    takes = KINDS[kind].parameters.model_fields if kind in KINDS else {}
    if "frame" in keys and "frames" in takes and "frames" not in parameters:
        raise FaultPlanError(
            f"fault: {kind} takes frames, how many; frame is the counter from which on it comes: "
            f"write frames={keys['frame']}, or frames=1 as well"
        )
    return {"kind": kind, "parameters": parameters, **keys}


def fault_spec(kind: str, **keys: Any) -> FaultSpec:  # noqa: ANN401 - any key, all validated
    """Return one fault, its keys as of `fault_table`.

    Raises
    ------
    FaultPlanError
        Naming the key and what is allowed.

    >>> fault_spec("missing_frames", frames=2, count=3).parameters
    {'frames': 2}
    """
    return parse_fault(fault_table(kind, **keys))


def parse_fault(table: object) -> FaultSpec:
    """Return a fault from a table; `FaultPlanError` if it is not one."""
    try:
        return FaultSpec.model_validate(table)
    except ValidationError as error:
        raise FaultPlanError(f"fault: {problem_text(error.errors(), FaultSpec)}") from None


def load_plan(path: Path | str) -> FaultPlan:
    """Return the plan of a scenario file, or of a shipped one by its name ("lossy_line").

    A string without a path separator and without ``.toml`` is a name.

    Raises
    ------
    FaultPlanError
        Name unknown, file missing or unreadable, TOML broken, key unknown, or value refused.
    """
    return load_table(
        FaultPlan,
        path,
        folder="faults",
        what="scenario",
        error=FaultPlanError,
        unknown=FaultPlanError,
    )
