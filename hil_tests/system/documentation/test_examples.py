"""The examples run without hardware, print what they show, and write what they say they write."""

import ast
import doctest
import re
import runpy
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import pytest

from hil_tests.paths import REPOSITORY

FOLDER = REPOSITORY / "docs" / "examples"
EXAMPLES = sorted(FOLDER.glob("*.py"))
# The one of the default suite, and one of a cluster, which `commands/test_sweep.py` shows.
DEFAULT, THOROUGH = "01_read_frames", "12_sweep_on_dask"
# The first, as a reader starts it; one that only starts another; one whose workers import it.
OWN_PROCESS = {"01_read_frames", "06_emulator_in_a_test", "12_sweep_on_dask"}

MARKS = {DEFAULT: [], THOROUGH: [pytest.mark.thorough]}

pytestmark = pytest.mark.skipif(not FOLDER.exists(), reason="examples are in the source tree")


def imported(program: ast.Module) -> set[str]:
    """Return the top-level packages that a program imports."""
    names: set[str] = set()
    for node in ast.walk(program):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            names.add(node.module)
    return {name.partition(".")[0] for name in names}


@pytest.mark.slow
@pytest.mark.parametrize(
    "example",
    [pytest.param(path, marks=MARKS.get(path.stem, [pytest.mark.rare])) for path in EXAMPLES],
    ids=lambda path: path.stem,
)
def test_an_example_prints_what_it_shows(
    example: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    program = ast.parse(example.read_text("utf-8"))
    for name in sorted(imported(program)):
        if find_spec(name) is None:
            pytest.skip(f"{name} is not installed")
    (shown,) = re.findall(r"```text\n(.*?)```", ast.get_docstring(program) or "", re.DOTALL)
    if example.stem in OWN_PROCESS:
        ended = subprocess.run(
            [sys.executable, str(example)], cwd=tmp_path, stdout=subprocess.PIPE, text=True
        )
        assert ended.returncode == 0
        printed = ended.stdout
    else:  # here, where what examples import is loaded already
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [str(example)])
        mpl.use("Agg")
        capsys.readouterr()
        runpy.run_path(str(example), run_name="__main__")
        plt.close("all")
        printed = capsys.readouterr().out
    same = doctest.OutputChecker().check_output(shown, printed, doctest.ELLIPSIS)
    assert same, f"shown:\n{shown}\nprinted:\n{printed}"
    for path in re.findall(r"^wrote (\S+)$", printed, re.MULTILINE):
        assert (tmp_path / path).exists()


def test_every_example_is_in_the_table() -> None:
    assert EXAMPLES
    table = (FOLDER / "README.md").read_text("utf-8")
    assert re.findall(r"^\| \[\w+\.py\]\((.*?)\)", table, re.MULTILINE) == [
        path.name for path in EXAMPLES
    ]
