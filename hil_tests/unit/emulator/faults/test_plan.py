"""Scenario files: what they may say, and one clear line about what they may not."""

from __future__ import annotations

from pathlib import Path

import pytest

from emulator.faults.kinds import KINDS
from emulator.faults.plan import (
    FaultPlanError,
    described,
    example,
    fault_spec,
    load_plan,
    parse_plan,
    plan_names,
)


@pytest.mark.parametrize("name", plan_names())
def test_shipped_scenarios_load(name: str) -> None:
    plan = load_plan(name)
    assert plan.description
    assert plan.fault


def test_there_are_shipped_scenarios() -> None:
    assert len(plan_names()) >= 3


@pytest.mark.parametrize("kind", KINDS)
def test_the_example_of_every_kind_is_a_scenario(kind: str) -> None:
    (spec,) = parse_plan(example(KINDS[kind])).fault
    assert spec.kind == kind
    assert spec.kind_parameters() == KINDS[kind].parameters()


@pytest.mark.parametrize("kind", KINDS)
def test_every_parameter_has_a_meaning_and_a_limit(kind: str) -> None:
    for name, parameter in described(KINDS[kind])["parameters"].items():
        assert parameter["meaning"], name
        assert len(parameter) > 2 or isinstance(parameter["default"], str), name


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("sed = 1", "scenario: sed: unknown key; allowed are seed, description, fault"),
        ("seed = -1", "seed: Input should be greater than or equal to 0, got -1"),
        ("[[fault]]\nevery = 2", "fault[0].kind: missing; this key is required"),
        ("[[fault]]\nkind = 'crc'", "fault[0].kind: no kind of fault is called 'crc'; known are "),
        (
            "[[fault]]\nkind = 'stall'\nwhen = 1",
            "fault[0].when: unknown key; allowed are kind, radar, command, at_s,",
        ),
        (
            "[[fault]]\nkind = 'stall'\nparameters = { time = 1 }",
            "fault[0]: parameters.time: unknown key; allowed are seconds",
        ),
        (
            "[[fault]]\nkind = 'stall'\nparameters = { seconds = -1 }",
            "fault[0]: parameters.seconds: Input should be greater than 0, got -1",
        ),
        ("[[fault]]\nkind = 'stall'\nprobability = 2", "fault[0].probability: Input should be"),
        ("[[fault]]\nkind = 'stall'\nat_s = nan", "fault[0].at_s: must be a finite number"),
        ("[[fault]]\nkind = 'nack'\ncommand = 'PIG'", "no command is called 'PIG'; known are "),
        ("[[fault]]\nkind = 'nack'\ncommand = 300", "an opcode is 0 ... 255, not 300"),
        ("[[fault]]\nkind = 'nack'\npacket = 'frame'", "packet: nack acts on a command"),
        ("[[fault", "not valid TOML"),
        ("a = " + "[" * 5000, "scenario: "),
        ("seed = 0x" + "f" * 5000, "seed: Input should be less than"),
        ("fault = 1", "fault: Input should be a valid list, got 1"),
        (
            "[[fault]]\nkind = 'stall'\nat_s = 2\nuntil_s = 2",
            "fault[0]: until_s: must be later than at_s, 2; it never happens",
        ),
    ],
)
def test_a_mistake_is_one_line_with_the_remedy(text: str, said: str) -> None:
    with pytest.raises(FaultPlanError) as caught:
        parse_plan(text)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value).replace(text, "")
    assert str(caught.value).startswith("scenario: ")


def test_a_missing_file_and_an_unknown_name_are_told(tmp_path: Path) -> None:
    with pytest.raises(FaultPlanError, match="cannot read the scenario file: No such file"):
        load_plan(tmp_path / "none.toml")
    with pytest.raises(FaultPlanError, match="no such scenario; known are bad_day,"):
        load_plan("good_day")
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"\xff")
    with pytest.raises(FaultPlanError, match="not UTF-8 text at byte 0"):
        load_plan(binary)


def test_what_is_no_key_of_a_fault_is_a_parameter() -> None:
    spec = fault_spec("missing_frames", frames=2, count=3)
    assert (spec.parameters, spec.count) == ({"frames": 2}, 3)
    with pytest.raises(FaultPlanError, match=r"parameters\.fames: unknown key; allowed are frames"):
        fault_spec("missing_frames", fames=2)
