"""The clone, and `.venv` in it, may lie at a path with blanks."""

import re
from pathlib import Path

import pytest

from hil_tests.paths import REPOSITORY

pytestmark = pytest.mark.skipif(
    not (REPOSITORY / "Makefile").exists(), reason="the Makefile is in the source tree"
)


def test_no_text_has_the_path_of_python_without_quotes() -> None:
    """Neither for a shell, nor cut into words; `shlex.join` or quotes keep it whole."""
    unquoted = re.compile(r"""(?<!["'])\{sys\.executable\}|#!\{""")
    files = (path for path in (REPOSITORY / "hil_tests").rglob("*.py") if path != Path(__file__))
    assert [path for path in files if unquoted.search(path.read_text())] == []


def test_the_makefile_quotes_the_python_that_it_is_given() -> None:
    """All other paths of its recipes are relative."""
    text = (REPOSITORY / "Makefile").read_text()
    assert re.findall(r"^\t[^#\n]*\$\(PYTHON\).*", text, re.MULTILINE)
    assert not re.findall(r'^\t[^#\n]*(?<!")\$\(PYTHON\)', text, re.MULTILINE)
    assert "$(CURDIR)" not in text
