"""The README's Python examples run and print what it says; its diagram is the device's own."""

import doctest
import re
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


pytestmark = pytest.mark.skipif(not README.exists(), reason="the README lives in the source tree")


def test_the_examples_of_the_readme_are_true() -> None:
    # A closing fence would be read as expected output; the examples end with a blank line.
    results = doctest.testfile(str(README), module_relative=False)
    assert results.attempted > 5
    assert results.failed == 0


def test_a_frame_is_plotted_in_five_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first Python that the README shows, on an emulated module in the same process."""
    scene = load_scene("lab")
    device = radar_device(Identity(serial="123456789012"), echo_source(scene, 0, seed=0), Pace.ASAP)
    line = LoopbackTransport(device)
    opened = X4M300(line, clock=line.clock_ns)
    monkeypatch.setattr(X4M300, "open", lambda path: opened)
    (program, *_) = re.findall(r"```python\n(import.*?)```", README.read_text(), re.DOTALL)
    assert len([row for row in program.splitlines() if row and "import" not in row]) == 5
    matplotlib.use("Agg")
    names: dict[str, Any] = {}
    exec(program, names)
    (curve,) = plt.gca().get_lines()
    ranges_m, samples = map(np.asarray, curve.get_data())
    plt.close("all")
    assert np.array_equal(samples, names["frame"].samples)
    assert (len(ranges_m), round(ranges_m[0], 4), round(ranges_m[-1], 4)) == (1431, 0.1993, 9.3942)


def test_the_state_diagram_is_that_of_the_emulated_module() -> None:
    assert f"```mermaid\n{state_diagram().rstrip()}\n```" in README.read_text()


@pytest.mark.parametrize("document", ["README.md", "CONTRIBUTING.md"])
def test_every_path_in_a_document_exists(document: str) -> None:
    text = (REPOSITORY / document).read_text()
    folders = "xethru_protocol|emulator|slam|hil_tests|fixtures|docs"
    paths = re.findall(rf"`((?:{folders})/[\w./]+)`", text)
    assert len(paths) > 3
    assert [path for path in paths if not (REPOSITORY / path).exists()] == []
