"""Nonsense in any place of a file: one line in plain words, with nothing of Python in it."""

import json
import math
import re
import tomllib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from emulator.faults.plan import FaultPlanError, load_plan
from emulator.scene.scene import SceneError, load_scene
from slam.app.rig.rig_files import load_rig
from slam.config import ConfigError, SlamConfig, config_from_tables, override
from slam.live.errors import AppError
from xethru_protocol.validation import shown

FIXTURES = Path(__file__).parents[3] / "fixtures"
RIG = """
radars = [{name = "a", serial = "000000000001", x_m = 1.0, y_m = 0.0, yaw_deg = 90.0}]
wheels = {scale_sigma = 0.1}
"""
NONSENSE: tuple[object, ...] = (
    "nonsense",
    "",
    1.5,
    -1,
    10**30,
    math.nan,
    math.inf,
    True,
    [],
    {},
    [1, 2],
    {"zz": 1},
)
# what pydantic and Python would write
THEIRS = re.compile(
    r"Input should|pydantic|instance of|dictionary|\^\[|tuple|validation|\bstr\b|parse|<class|"
    r"\bTrue\b|\bFalse\b|\bNone\b|\[\]|\{\}|'[a-z_]*'|Spec\b"
)
REFUSALS = (SceneError, AppError, FaultPlanError, ConfigError)


def refusal(attempt: Callable[[], object]) -> str:
    """Return the message of a refusal, empty if there is none."""
    try:
        attempt()
    except REFUSALS as error:
        return str(error)
    return ""


def preset(path: Path) -> SlamConfig:
    return config_from_tables(tomllib.loads(path.read_text()), source=str(path))


def places(value: object, at: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Yield the paths of a document; of a list only the last entry's."""
    if at:
        yield at
    if isinstance(value, dict):
        for key in value:
            yield from places(value[key], (*at, key))
    elif isinstance(value, list) and value:
        yield from places(value[-1], (*at, len(value) - 1))


def replaced(value: Any, at: tuple[str | int, ...], new: object) -> object:  # noqa: ANN401 - TOML
    if not at:
        return new
    if isinstance(value, dict):
        return {k: replaced(v, at[1:], new) if k == at[0] else v for k, v in value.items()}
    return [replaced(v, at[1:], new) if k == at[0] else v for k, v in enumerate(value)]


def toml(value: object) -> str:
    if isinstance(value, dict):
        return f"{{{', '.join(f'{json.dumps(k)} = {toml(v)}' for k, v in value.items())}}}"
    if isinstance(value, list):
        return f"[{', '.join(map(toml, value))}]"
    return json.dumps(value) if isinstance(value, str | bool) else str(value)


@pytest.mark.parametrize(
    ("load", "text"),
    [
        (load_scene, (FIXTURES / "scenes/visitor.toml").read_text()),
        (load_rig, RIG),
        (load_plan, (FIXTURES / "faults/lossy_line.toml").read_text()),
        (preset, (FIXTURES / "presets/robust.toml").read_text()),
    ],
    ids=["visitor", "rig", "lossy_line", "robust"],
)
def test_nonsense_in_any_place_is_one_plain_line(
    load: Callable[[Path], object], text: str, tmp_path: Path
) -> None:
    path = tmp_path / "mine.toml"
    tables = tomllib.loads(text)
    refused = 0
    for at in places(tables):
        for new in NONSENSE:
            document = replaced(tables, at, new)
            assert isinstance(document, dict)
            path.write_text("\n".join(f"{key} = {toml(value)}" for key, value in document.items()))
            line = refusal(lambda: load(path))
            refused += bool(line)
            assert not line or line.startswith(f"{path}: "), line
            assert "\n" not in line
            assert not THEIRS.search(line.removeprefix(str(path))), line
    assert refused > 5 * len(list(places(tables)))


def test_nonsense_of_set_is_one_plain_line() -> None:
    tables = SlamConfig().model_dump(mode="json")
    keys = [f"{part}.{key}" for part in tables if part != "back_end" for key in tables[part]]
    for key in (*keys, "back_end", "detection", "zz", "detection.zz", ".", "back_end.zz"):
        for new in ("", "nonsense", "-1", "1e400", "nan", "[1]", "1.5", "9" * 30, "x" * 200):
            line = refusal(partial(override, SlamConfig(), {key: new}))
            assert not THEIRS.search(line), line
            assert len(line) < 600


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("a\n\x1b[2J", '"a\\n\\u001b[2J"'),
        ("x" * 200, '"' + "x" * 56 + "..."),
        (10**5000, "a number that long"),
        ("\udcff\x9b", '"\\udcff\\x9b"'),  # bytes of a shell that are not text
        (None, "nothing"),
        ({"a": 1}, "a table"),
        (math.nan, "nan"),
    ],
    ids=["control", "long", "digits", "bytes", "none", "table", "nan"],
)
def test_a_value_is_shown_as_a_person_would_write_it(value: object, expected: str) -> None:
    assert shown(value) == expected
