"""The README's Python examples run and print what it says; its diagram is the device's own."""

import doctest

import pytest

from emulator.module.modes import state_diagram
from hil_tests.paths import REPOSITORY

README = REPOSITORY / "README.md"


pytestmark = pytest.mark.skipif(not README.exists(), reason="the README lives in the source tree")


def test_the_examples_of_the_readme_are_true() -> None:
    # A closing fence would be read as expected output; the examples end with a blank line.
    results = doctest.testfile(str(README), module_relative=False)
    assert results.attempted > 5
    assert results.failed == 0


def test_the_state_diagram_is_that_of_the_emulated_module() -> None:
    assert f"```mermaid\n{state_diagram().rstrip()}\n```" in README.read_text()
