"""Options as text: every field can be set, is listed, and a bad one is one clear line."""

import json

import pytest

from emulator.cli import main
from emulator.module.settings import DeviceOptions, option_of, option_texts


def test_every_field_is_listed_with_a_default_that_can_be_set() -> None:
    texts = {one.name: one for one in option_texts()}
    assert list(texts) == list(DeviceOptions.model_fields)
    changes = dict(option_of(f"{name}={one.default}") for name, one in texts.items())
    assert DeviceOptions.model_validate(changes) == DeviceOptions()
    assert all(one.meaning and one.allowed for one in texts.values())


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("bad_value=clamp", "clamp"),
        ("storage_bytes=0x18000", 0x18000),
        ("board_offset_m=-0.05", -0.05),
    ],
)
def test_values_are_typed_by_the_field(text: str, value: object) -> None:
    assert option_of(text) == (text.partition("=")[0], value)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("bad_valu=clamp", "bad_value"),
        ("bad_value", "refuse or clamp"),
        ("bad_value=", "refuse or clamp"),
        ("storage_bytes=-1", "a whole number >= 0"),
        ("storage_bytes=1e3", "a whole number >= 0"),
        ("board_offset_m=inf", "a number"),
    ],
)
def test_a_bad_option_is_one_line_that_names_what_is_allowed(
    text: str, named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["serve", "--bare", "--option", text])
    assert ended.value.code == 2
    last = capsys.readouterr().err.rstrip().splitlines()[-1]
    assert text.partition("=")[0] in last
    assert named in last


def test_options_are_listed_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["options", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert [one["name"] for one in listed] == list(DeviceOptions.model_fields)
    assert listed[0].keys() == {"name", "default", "allowed", "meaning"}
