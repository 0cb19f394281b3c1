"""CI repeats its examples of each property; `make test-explore` draws new ones from a seed."""

import re
import shutil
import subprocess
import sys

import pytest
from hypothesis import settings

from hil_tests.paths import REPOSITORY

pytestmark = pytest.mark.skipif(
    not (REPOSITORY / "Makefile").exists(), reason="the Makefile is in the source tree"
)


def commands(*words: str) -> str:
    """Return the commands that make would run."""
    if shutil.which("make") is None:
        pytest.skip("make is not installed")
    make = ["make", "--dry-run", "--always-make", "--no-print-directory"]
    make.append("PYTHON=" + sys.executable)  # else it looks for one before each command
    return subprocess.run(
        [*make, *words], cwd=REPOSITORY, capture_output=True, text=True, check=True
    ).stdout


def test_only_exploration_is_random() -> None:
    names = ("ci", "rare", "thorough", "explore")
    assert [settings.get_profile(name).derandomize for name in names] == [True, True, True, False]
    assert settings.get_profile("explore").print_blob


def test_the_seed_is_printed_used_and_new_each_time() -> None:
    seeds = set()
    for _ in range(2):
        printed = commands("test-explore")
        (seed,) = re.findall(r"--hypothesis-seed=(\d+)\b", printed)
        assert f"make test-explore SEED={seed} " in printed
        assert "HYPOTHESIS_PROFILE=explore" in printed
        seeds.add(seed)
    assert len(seeds) == 2
    assert "--hypothesis-seed=7 " in commands("test-explore", "SEED=7")


def test_ci_does_not_explore_and_has_all_examples() -> None:
    """CI runs `.ci/run`, and that two targets of make, the second with all examples."""
    script = (REPOSITORY / ".ci" / "run").read_text()
    targets = re.findall(r"^(?:exec )?make ([\w-]+)$", script, re.MULTILINE)
    assert targets == ["check", "test-rare"]
    for target in targets:
        printed = commands(target)
        assert "-m pytest" in printed
        assert not re.search(r"explore|hypothesis-seed", printed)
    assert "HYPOTHESIS_PROFILE=rare " in printed
    assert "-m '(rare or hypothesis) and not thorough'" in printed
    shares = [settings.get_profile(name).max_examples for name in ("ci", "rare")]
    assert shares == [20, 60]
    for workflow in (REPOSITORY / ".github" / "workflows").iterdir():
        assert not re.search(r"explore|HYPOTHESIS", workflow.read_text())


def test_nothing_reaches_into_hypothesis() -> None:
    """Its internal modules change without notice."""
    folder = REPOSITORY / "hil_tests"
    pattern = re.compile(r"hypothesis\.(internal|_\w+)")
    assert [p for p in folder.rglob("*.py") if pattern.search(p.read_text())] == []
