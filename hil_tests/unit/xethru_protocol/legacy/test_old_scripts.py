"""Scripts written anew with the calls of old ones, run by ``xethru legacy`` on emulated modules."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from emulator import emulated_port
from hil_tests.paths import FIXTURES
from hil_tests.patience import seconds

SCRIPTS = FIXTURES / "old_scripts"
BIN_M = 8 * 1.5e8 / 23.328e9  # Protocol reference 9.4, module metres
BASE_M = 0.18 + 2 * 96 * 1.5e8 / 23.328e9
START_M = BASE_M + np.floor((2 - BASE_M) / BIN_M) * BIN_M
END_M = BASE_M + np.ceil((6 - BASE_M) / BIN_M) * BIN_M
BINS = round((END_M - START_M) / BIN_M) + 1
ZONE_BINS = 49  # of 0.5 ... 3.0 m, 48.6 bins, outward to whole ones
SAME_RATE = 20.044079  # Protocol reference 9.6: what 20 frames/s really are


@pytest.fixture(scope="module")
def runtime(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Return the folder of running emulators: that of no other test."""
    folder = tmp_path_factory.mktemp("run")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(folder))
        yield folder


@pytest.fixture(scope="module")
def port(runtime: Path) -> Iterator[str]:
    with emulated_port() as port:
        yield port


def run(script: str, folder: Path, *arguments: str) -> tuple[int, list[str], str]:
    command = [sys.executable, "-P", "-m", "xethru_protocol.cli", "legacy", str(SCRIPTS / script)]
    done = subprocess.run(
        [*command, *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=seconds(20),
        check=False,
    )
    return done.returncode, done.stdout.splitlines(), done.stderr


def test_raw_frames(port: str, tmp_path: Path) -> None:
    code, lines, errors = run("raw_frames.py", tmp_path, port, "5")
    assert (code, errors) == (0, "")
    assert lines == [
        "pong 0xaaeeaeea",
        "firmware Annapurna",
        f"area {START_M:.6f} {END_M:.6f}",
        f"bins {BINS} fps {SAME_RATE}",
        f"frames 1 5 ({BINS},) complex128",
    ]


def test_presence(port: str, tmp_path: Path) -> None:
    code, lines, errors = run("presence.py", tmp_path, port, "2")
    assert (code, errors) == (0, "")
    assert lines == [
        "profile 0x14d4ab8 sensitivity 7",
        "noise map 2 led 0",
        f"steps {ZONE_BINS}.0",
        "presence 0 initializing 0.0 0 True",
        "presence 0 initializing 0.0 0 True",
        f"iq True {BIN_M:.4f}",
    ]


def test_record(port: str, tmp_path: Path) -> None:
    code, lines, errors = run("record.py", tmp_path, port)
    assert (code, errors) == (0, "")
    assert lines == [
        "started 0",
        "recording True",
        "file True True",
        "meta old script",
        f"opened 0 old script {1 << 10}",
        "records True True",
        "played True True",
        "duration True",
    ]


def test_files_and_registers(port: str, tmp_path: Path) -> None:
    """Protocol reference 4.10: a test answers 256 bytes. The chip's first registers are 0, FF."""
    code, lines, errors = run("files_and_registers.py", tmp_path)
    assert (code, errors) == (3, "")
    assert lines == [
        "listed True",
        "found [5]",
        "length 600",
        "same True",
        "part [9, 7, 8]",
        "gone ModuleConnectorError",
        "power 3 3 3",
        "zero and one 0 255",
        "pin 1 2",
        "test 256",
        "pointer 9",
    ]


@pytest.mark.rare
def test_respiration(runtime: Path, tmp_path: Path) -> None:
    with emulated_port(None, "--model", "x4m200") as port:
        code, lines, errors = run("respiration.py", tmp_path, port)
    assert (code, errors) == (0, "")
    assert lines == ["state True 0", "lists True"]


@pytest.mark.rare
def test_output_after_run(runtime: Path, tmp_path: Path) -> None:
    with emulated_port(None, "--model", "x4m200", "--pace", "asap") as port:
        code, lines, errors = run("output_after_run.py", tmp_path, port)
    assert (code, errors) == (0, "")
    assert lines == ["sleep True True"] * 2
