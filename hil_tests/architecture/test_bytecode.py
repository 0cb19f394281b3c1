"""Tests on a full disk cut no bytecode: a cut file would break every later import of its module."""

import marshal
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from hil_tests.paths import REPOSITORY
from hil_tests.patience import seconds
from hil_tests.unit.full_disk import child_on_full_disk, full_disk

PRODUCT = ("emulator", "slam", "xethru_protocol")

IMPORT_ALL = """
import importlib, pathlib, sys
for package in sys.argv[1:]:
    for path in sorted(pathlib.Path(package).rglob("*.py")):
        name = ".".join(path.with_suffix("").parts)
        if path.stem != "__main__":
            importlib.import_module(name.removesuffix(".__init__"))
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a module that `import long` finds, whose bytecode takes more than 10 000 bytes."""
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.delenv("PYTHONPYCACHEPREFIX", raising=False)
    path = tmp_path / "long.py"
    path.write_text(f"text = {'x' * 10_000!r}\n")
    return path


def test_a_child_on_a_full_disk_writes_no_bytecode(module: Path) -> None:
    """Nor does a child of the child."""
    again = "import subprocess, sys; subprocess.run([sys.executable, '-c', 'import long'])"
    for code in ("import long", again):
        command = [sys.executable, "-c", code]
        subprocess.run(command, check=True, **child_on_full_disk(1_000))
        assert not (module.parent / "__pycache__").exists()


def test_a_process_on_a_full_disk_writes_no_bytecode(
    module: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = [sys.executable, "-c", "import long"]
    monkeypatch.syspath_prepend(module.parent)
    with full_disk(1_000):
        __import__("long")
        subprocess.run(command, check=True)
    assert not (module.parent / "__pycache__").exists()
    subprocess.run(command, check=True)
    assert (module.parent / "__pycache__").exists()


def test_the_disk_is_filled_in_one_place() -> None:
    """Where bytecode is thought of; the limits of memory and of open files cut no file."""
    named = {
        str(path.relative_to(REPOSITORY))
        for path in (REPOSITORY / "hil_tests").rglob("*.py")
        if re.search(r"RLIMIT_FSIZE\b|\bulimit\b", path.read_text()) and path != Path(__file__)
    }
    assert named == {"hil_tests/unit/full_disk.py"}


@pytest.mark.rare
@pytest.mark.slow
def test_the_tests_on_a_full_disk_leave_a_fresh_copy_whole(tmp_path: Path) -> None:
    for package in (*PRODUCT, "hil_tests", "fixtures"):
        ignored = shutil.ignore_patterns("*.pyc")  # compiled kernels are copied: it saves a minute
        shutil.copytree(REPOSITORY / package, tmp_path / package, ignore=ignored)
    shutil.copy(REPOSITORY / "pyproject.toml", tmp_path)
    files = [
        str(path.relative_to(REPOSITORY))
        for path in sorted((REPOSITORY / "hil_tests").rglob("test_*.py"))
        if "hil_tests.unit.full_disk import" in path.read_text() and path != Path(__file__)
    ]
    assert len(files) > 5
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    environment.pop("PYTHONPYCACHEPREFIX", None)
    tests = ["-m", "pytest", "-q", "-k", "full_disk", "-p", "no:xdist", *files]
    imports = ["-c", IMPORT_ALL, *PRODUCT]
    for words in (tests, imports):
        run = subprocess.run(
            [sys.executable, *words],
            cwd=tmp_path,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=seconds(100),
            check=False,
        )
        assert run.returncode == 0, run.stdout
    for path in tmp_path.rglob("*.pyc"):
        marshal.loads(path.read_bytes()[16:])  # behind the header
