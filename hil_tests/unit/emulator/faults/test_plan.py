"""Scenario files: what they may say, and one clear line about what they may not."""

from pathlib import Path

import pytest

from emulator.faults.kind import Target
from emulator.faults.kinds import KINDS
from emulator.faults.plan import (
    FaultPlanError,
    described,
    example,
    fault_spec,
    load_plan,
)
from emulator.scene.toml_files import shipped_names


def test_shipped_scenarios_load() -> None:
    plans = [load_plan(name) for name in shipped_names("faults")]
    assert len(plans) >= 3
    assert all(plan.description and plan.fault for plan in plans)


@pytest.mark.parametrize("kind", KINDS)
def test_the_example_of_every_kind_is_a_scenario(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "scenario.toml"
    path.write_text(example(KINDS[kind]))
    (spec,) = load_plan(path).fault
    assert spec.kind == kind
    assert spec.kind_parameters() == KINDS[kind].parameters()


@pytest.mark.parametrize("kind", KINDS)
def test_every_parameter_has_a_meaning_and_a_limit(kind: str) -> None:
    for name, parameter in described(KINDS[kind])["parameters"].items():
        assert parameter["meaning"], name
        assert len(parameter) > 2 or isinstance(parameter["default"], str), name


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("sed = 1", "sed: "),
        ("seed = -1", "seed: "),
        ("[[fault]]\nevery = 2", "fault[0].kind: "),
        ("[[fault]]\nkind = 'crc'", "fault[0].kind: "),
        ("[[fault]]\nkind = 'stall'\nwhen = 1", "fault[0].when: "),
        ("[[fault]]\nkind = 'stall'\nparameters = { time = 1 }", "fault[0]: parameters.time: "),
        (
            "[[fault]]\nkind = 'stall'\nparameters = { seconds = -1 }",
            "fault[0]: parameters.seconds: ",
        ),
        (
            f"[[fault]]\nkind = 'counter_jump'\nparameters = {{ frames = {2**31 - 1} }}",
            "fault[0]: parameters.frames: ",  # it would be a jump back
        ),
        ("[[fault]]\nkind = 'stall'\nprobability = 2", "fault[0].probability: "),
        ("[[fault]]\nkind = 'stall'\nat_s = nan", "fault[0].at_s: "),
        ("[[fault]]\nkind = 'nack'\ncommand = 'PIG'", '"PIG"'),
        ("[[fault]]\nkind = 'nack'\ncommand = 300", "0 ... 255"),
        ("[[fault]]\nkind = 'nack'\npacket = 'frame'", "packet: "),
        ("[[fault", "TOML"),
        ("a = " + "[" * 5000, ""),
        ("seed = 0x" + "f" * 5000, "seed: "),
        ("fault = 1", "fault: "),
        ("[[fault]]\nkind = 'stall'\nat_s = 2\nuntil_s = 2", "fault[0]: until_s: "),
    ],
)
def test_a_mistake_is_one_line_that_names_the_place(text: str, place: str, tmp_path: Path) -> None:
    path = tmp_path / "scenario.toml"
    path.write_text(text)
    with pytest.raises(FaultPlanError) as caught:
        load_plan(path)
    assert place in str(caught.value)
    assert "\n" not in str(caught.value).replace(text, "")
    assert str(caught.value).startswith(f"{path}: ")


@pytest.mark.parametrize(
    "kind", [name for name, row in KINDS.items() if row.target is Target.MOMENT]
)
def test_a_moment_without_end_needs_occasions(kind: str) -> None:
    """Else it would come again at every call, and a truth log would grow without end."""
    with pytest.raises(FaultPlanError, match="count: "):
        fault_spec(kind, count=0)
    with pytest.raises(FaultPlanError, match="count: "):
        fault_spec(kind, count=0, until_s=5.0)
    for occasion in ({"frame": 3}, {"every": 2}, {"probability": 0.5}, {"command": "PING"}):
        assert fault_spec(kind, count=0, **occasion).target is not Target.MOMENT


def test_what_cannot_be_read_is_refused(tmp_path: Path) -> None:
    (tmp_path / "binary.toml").write_bytes(b"\xff")
    for scenario in (tmp_path / "none.toml", "good_day", tmp_path / "binary.toml"):
        with pytest.raises(FaultPlanError):
            load_plan(scenario)


def test_what_is_no_key_of_a_fault_is_a_parameter() -> None:
    spec = fault_spec("missing_frames", frames=2, count=3)
    assert (spec.parameters, spec.count) == ({"frames": 2}, 3)
    with pytest.raises(FaultPlanError, match=r"parameters\.fames"):
        fault_spec("missing_frames", fames=2)


def test_a_number_of_frames_is_not_taken_for_the_frame_it_begins_at() -> None:
    with pytest.raises(FaultPlanError, match="frames=2"):
        fault_spec("missing_frames", frame=2)
    spec = fault_spec("missing_frames", frame=2, frames=1)
    assert (spec.frame, spec.parameters) == (2, {"frames": 1})
    assert fault_spec("bad_checksum", frame=2).frame == 2
