"""A session holds all numbers that SLAM ran with; the source text is the oracle."""

import ast
import json
from collections.abc import Iterator
from pathlib import Path

import pytest

import slam
from slam.app.session.constants import slam_constants

_SLAM = Path(slam.__file__).parent
_FILES = [
    *(file for part in ("front_end", "paper", "robust") for file in (_SLAM / part).rglob("*.py")),
    *(_SLAM / f"{name}.py" for name in ("frames", "geometry", "results")),
]


def name_of(file: Path) -> str:
    return ".".join(("slam", *file.relative_to(_SLAM).with_suffix("").parts)).removesuffix(
        ".__init__"
    )


def has_number(node: ast.AST | None) -> bool:
    return node is not None and any(
        isinstance(part, ast.Constant) and isinstance(part.value, int | float | complex)
        for part in ast.walk(node)
    )


def named_numbers(body: list[ast.stmt], prefix: str) -> Iterator[str]:
    """Yield the dotted names of assignments with a number in them, in a module or a class."""
    for statement in body:
        if isinstance(statement, ast.ClassDef):
            yield from named_numbers(statement.body, f"{prefix}.{statement.name}")
        elif isinstance(statement, ast.Assign | ast.AnnAssign) and has_number(statement.value):
            targets = statement.targets if isinstance(statement, ast.Assign) else [statement.target]
            for target in targets:
                for part in ast.walk(target):
                    if isinstance(part, ast.Name):
                        yield f"{prefix}.{part.id}"


@pytest.mark.parametrize("file", _FILES, ids=name_of)
def test_every_number_that_a_module_of_slam_names_is_collected(file: Path) -> None:
    tree = ast.parse(file.read_text())
    expected = set(named_numbers(tree.body, name_of(file)))
    assert expected <= set(slam_constants())


def test_the_numbers_are_those_of_the_source() -> None:
    found = slam_constants()
    assert found["slam.robust.parameters.MapRule.miss"] == 1.5
    assert found["slam.robust.parameters.TAIL_PROBABILITY"] == 1e-3
    assert found["slam.robust.state.POSITION"] == [1, 3]
    assert found["slam.config.WheelNoise.along_m_per_sqrt_m"] == 2e-3
    assert found["slam.robust.branches._IDS_APART"] == 1000
    assert found["slam.front_end.kernels._ECHO_LEVEL"] == 12.25
    assert found["slam.front_end.pulse._SPEED_OF_LIGHT_MPS"] == 299_792_458.0
    assert len(found) >= 190
    assert json.loads(json.dumps(found)) == found


def test_a_number_has_one_name() -> None:
    """`overlapping` defines TINY and `matched_filter` may import it."""
    tails = [name for name in slam_constants() if name.endswith(".TINY")]
    assert tails == ["slam.front_end.overlapping.TINY"]


_OF_FORMULAS = {0.0, 0.25, 0.5, 1.0, 2.0, 3.0, 6.0, 24.0}
"""Numbers of mathematics and of thirds and halves; whatever else is a choice, and has a name."""


@pytest.mark.parametrize("file", _FILES, ids=name_of)
def test_no_choice_hides_within_a_function_of_slam(file: Path) -> None:
    """Such a number would be in no session."""
    hidden = [
        f"line {part.lineno}: {part.value}"
        for function in ast.walk(ast.parse(file.read_text()))
        if isinstance(function, ast.FunctionDef)
        for part in ast.walk(function)
        if isinstance(part, ast.Constant)
        and isinstance(part.value, float)
        and part.value not in _OF_FORMULAS
    ]
    if file.name == "geometry.py":  # the mounts of the paper's rig, which a session has
        hidden = [line for line in hidden if not line.endswith((" 0.1", " 0.2"))]
    assert hidden == []
