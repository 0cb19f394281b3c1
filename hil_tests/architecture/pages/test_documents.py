"""The documents' Python examples run and print what they show; paths and links in them exist."""

import doctest
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest

from emulator.chip import Pace
from emulator.device import radar_device
from emulator.echo.echo import echo_source
from emulator.loopback import LoopbackTransport
from emulator.module.memory import Identity
from emulator.module.modes import state_diagram
from emulator.scene.scene import load_scene
from hil_tests.paths import REPOSITORY
from xethru_protocol import X4M300

README = REPOSITORY / "README.md"
DOCS = REPOSITORY / "docs"
DOCUMENTS = [README, REPOSITORY / "CONTRIBUTING.md", *sorted(DOCS.glob("*.md"))]

pytestmark = pytest.mark.skipif(not README.exists(), reason="documents are in the source tree")


def test_the_example_of_the_driver_is_true() -> None:
    # A closing fence would be read as expected output; the examples end with a blank line.
    results = doctest.testfile(str(DOCS / "driver.md"), module_relative=False)
    assert results.attempted > 5
    assert results.failed == 0


@pytest.mark.parametrize("document", [README, DOCS / "driver.md"], ids=["README", "driver"])
def test_a_frame_is_plotted_in_five_lines(document: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first Python that they show, on an emulated module in the same process."""
    scene = load_scene("lab")
    device = radar_device(Identity(serial="123456789012"), echo_source(scene, 0, seed=0), Pace.ASAP)
    line = LoopbackTransport(device)
    opened = X4M300(line, clock=line.clock_ns)
    monkeypatch.setattr(X4M300, "open", lambda path: opened)
    (program, *_) = re.findall(r"```python\n(import.*?)```", document.read_text(), re.DOTALL)
    assert len([row for row in program.splitlines() if row and "import" not in row]) == 5
    matplotlib.use("Agg")
    names: dict[str, Any] = {}
    exec(program, names)
    (curve,) = plt.gca().get_lines()
    ranges_m, samples = map(np.asarray, curve.get_data())
    plt.close("all")
    assert np.array_equal(samples, names["frame"].samples)
    assert (len(ranges_m), round(ranges_m[0], 4), round(ranges_m[-1], 4)) == (1431, 0.1993, 9.3942)


def test_the_test_of_the_readme_passes_on_an_emulated_module(tmp_path: Path) -> None:
    (program,) = re.findall(r"```python\n(def test_.*?)```", README.read_text(), re.DOTALL)
    (tmp_path / "test_mine.py").write_text(program)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_mine.py"]
    ended = subprocess.run(
        [*command, "--radar", "emu:lab"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert "1 passed" in ended.stdout


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
    pages = {page.resolve() for page in DOCS.glob("*.md")}
    linked = {
        link for document in DOCUMENTS for link in links_of(document) if link != document.resolve()
    }
    assert pages - linked == set()
