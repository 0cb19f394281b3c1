"""The README's Python examples run and print what it says; its diagram is the device's own."""

import doctest
import re

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


@pytest.mark.parametrize("document", ["README.md", "CONTRIBUTING.md"])
def test_every_path_in_a_document_exists(document: str) -> None:
    text = (REPOSITORY / document).read_text()
    folders = "xethru_protocol|emulator|slam|hil_tests|fixtures|docs"
    paths = re.findall(rf"`((?:{folders})/[\w./]+)`", text)
    assert len(paths) > 3
    assert [path for path in paths if not (REPOSITORY / path).exists()] == []
