"""Paths and links in the documents exist; `hil_tests/system/documentation` runs their blocks."""

import re
import shlex
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from emulator.module.modes import state_diagram
from hil_tests.paths import REPOSITORY

README = REPOSITORY / "README.md"
DOCS = REPOSITORY / "docs"
DOCUMENTS = [README, REPOSITORY / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md"))]

pytestmark = pytest.mark.skipif(not README.exists(), reason="documents are in the source tree")


def test_the_state_diagram_is_that_of_the_emulated_module() -> None:
    assert f"```mermaid\n{state_diagram().rstrip()}\n```" in (DOCS / "emulator.md").read_text()


def links_of(document: Path) -> list[Path]:
    """Return the files that a document links to or shows."""
    found = re.findall(r"\]\((?!https?:|#)([^)#]+)", document.read_text())
    return [(document.parent / link).resolve() for link in found]


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_every_path_and_link_in_a_document_exists(document: Path) -> None:
    folders = "xethru_protocol|emulator|slam|hil_tests|fixtures|docs"
    named = re.findall(rf"`((?:{folders})/[\w./]+)`", document.read_text())
    paths = [*(REPOSITORY / path for path in named), *links_of(document)]
    assert [str(path) for path in paths if not path.exists()] == []


def test_every_page_is_linked_from_another_document() -> None:
    pages = {page.resolve() for page in DOCS.rglob("*.md")}
    linked = {
        link for document in DOCUMENTS for link in links_of(document) if link != document.resolve()
    }
    assert pages - linked == set()


@pytest.mark.skipif(find_spec("mkdocs") is None, reason="mkdocs is of the extra docs")
def test_a_broken_link_fails_the_build_of_the_site(tmp_path: Path) -> None:
    (tmp_path / "mkdocs.yml").write_text("site_name: short\nplugins: []\n")
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "index.md").write_text("[a page](nowhere.md)\n")
    (options,) = re.findall(r"\tNO_.*/mkdocs (.*)", (REPOSITORY / "Makefile").read_text())
    command = [sys.executable, "-m", "mkdocs", *shlex.split(options)]
    built = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert built.returncode == 1
    assert "nowhere.md" in built.stderr
