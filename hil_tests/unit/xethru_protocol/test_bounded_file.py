"""Files that never end are refused, not read."""

from __future__ import annotations

import errno
import os
import threading
from pathlib import Path

import pytest

from emulator.faults.plan import FaultPlanError, load_plan
from emulator.scene.scene import SceneError, load_scene
from slam.app.cli import main
from xethru_protocol.system import read_bounded

ENDLESS = "/dev/zero"


def test_a_file_of_the_most_bytes_is_read_and_one_more_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "f"
    path.write_bytes(bytes(2 << 20))
    assert len(read_bounded(path, 2 << 20)) == 2 << 20
    with pytest.raises(OSError, match="longer than 1 MiB") as caught:
        read_bounded(path, (2 << 20) - 1)
    assert caught.value.errno == errno.EFBIG


def test_a_pipe_is_read_to_its_end(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    writer = threading.Thread(target=pipe.write_bytes, args=(b"x" * 100_000,))
    writer.start()
    assert read_bounded(pipe) == b"x" * 100_000
    writer.join()


@pytest.mark.skipif(not Path(ENDLESS).exists(), reason=f"no {ENDLESS} here")
def test_what_never_ends_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SceneError, match="longer than"):
        load_scene(ENDLESS)
    with pytest.raises(FaultPlanError, match="longer than"):
        load_plan(ENDLESS)
    assert main(["demo", "--scene", ENDLESS, "--out", str(tmp_path)]) == 1
    assert "longer than" in capsys.readouterr().err
