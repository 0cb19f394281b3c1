"""The import contracts of pyproject.toml hold and can fail; folders are small, help is light."""

import ast
import json
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from hil_tests.paths import REPOSITORY

PYPROJECT = REPOSITORY / "pyproject.toml"
PRODUCT = ("xethru_protocol", "emulator", "slam", "hil_tests/plugin")
HEAVY = {
    *("joblib", "matplotlib", "mcap", "numpy", "pydantic", "rerun", "rosbags", "scipy", "serial"),
    *("sklearn", "xdist"),
}

pytestmark = pytest.mark.skipif(
    not PYPROJECT.exists(), reason="contracts are in the source tree; run from a clone"
)

# Contract, a file, and an import that the contract forbids there.
PLANTED = {
    "house": ("xethru_protocol/wire/__init__.py", "import emulator"),
    "no-circles": ("xethru_protocol/wire/__init__.py", "import xethru_protocol.driver"),
    "protocol-light": ("xethru_protocol/cli/__init__.py", "import scipy"),
    "sans-io": ("emulator/chip/__init__.py", "import time"),
    "processing": ("xethru_protocol/processing/__init__.py", "import xethru_protocol.wire.x4"),
    "driver-transport": ("xethru_protocol/driver/__init__.py", "import socket"),
    "pyserial-once": ("emulator/ports/__init__.py", "import serial"),
    "emulator-light": ("emulator/echo/__init__.py", "import sklearn"),
    "slam-core": ("slam/front_end/__init__.py", "import xethru_protocol"),
    "slam-app-on-top": ("slam/robust/__init__.py", "import slam.app"),
    "pure": ("slam/paper/__init__.py", "import time"),
    "numba-once": ("slam/front_end/__init__.py", "import numba"),
    "rerun-once": ("slam/app/run/__init__.py", "import rerun"),
}

MOST_ENTRIES = 12
MARKERS = {"__init__.py", "__main__.py", "__pycache__", "conftest.py", "py.typed"}
SMALL_LINES = 80


def contracts() -> list[str]:
    settings = tomllib.loads(PYPROJECT.read_text())["tool"]["importlinter"]
    return [contract["id"] for contract in settings["contracts"]]


# One process for all of them: to start import-linter takes longer than to check a contract.
LINT = """
import contextlib, io, json, sys
from pathlib import Path
from importlinter.cli import lint_imports

def broken(*ids):
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        code = lint_imports(limit_to_contracts=ids)
    assert "Contracts: " in printed.getvalue(), printed.getvalue()
    return code != 0

found = {"": broken()}
for name, (file, line) in json.load(sys.stdin).items():
    whole = Path(file).read_text()
    Path(file).write_text(f"{whole}\\n{line}\\n")
    found[name] = broken(name)
    Path(file).write_text(whole)
print(json.dumps(found))
"""


def broken(folder: Path, planted: dict[str, tuple[str, str]]) -> dict[str, bool]:
    """Return which contracts import-linter finds broken when their imports are planted there.

    Under "" it is whether any is broken before.
    """
    linted = subprocess.run(
        [sys.executable, "-c", LINT],
        cwd=folder,
        env={"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"},
        input=json.dumps(planted),
        capture_output=True,
        text=True,
        check=False,
    )
    assert linted.returncode == 0, linted.stdout + linted.stderr
    found: dict[str, bool] = json.loads(linted.stdout)
    return found


@pytest.mark.slow
@pytest.mark.rare  # make check runs the linter itself
def test_every_contract_holds_and_fails_on_a_planted_violation(tmp_path: Path) -> None:
    pytest.importorskip("importlinter", reason="import-linter is in the extra dev")
    assert set(PLANTED) == set(contracts())
    for package in tomllib.loads(PYPROJECT.read_text())["tool"]["importlinter"]["root_packages"]:
        shutil.copytree(
            REPOSITORY / package, tmp_path / package, ignore=lambda _, names: ignored(names)
        )
    shutil.copy(PYPROJECT, tmp_path)
    assert broken(tmp_path, PLANTED) == {"": False, **dict.fromkeys(PLANTED, True)}


def ignored(names: list[str]) -> list[str]:
    return [name for name in names if "." in name and not name.endswith(".py")]


def test_no_folder_holds_more_than_12_entries() -> None:
    packages = {path.partition("/")[0] for path in PRODUCT}
    unit = REPOSITORY / "hil_tests" / "unit"
    crowded = {}
    for folder in {path.parent for name in packages for path in (REPOSITORY / name).rglob("*.py")}:
        entries = {
            path.name
            for path in folder.iterdir()
            if path.name not in MARKERS and (path.is_file() or any(path.rglob("*.py")))
        }
        if len(entries) > MOST_ENTRIES and not folder.is_relative_to(unit):
            crowded[str(folder.relative_to(REPOSITORY))] = len(entries)
    assert crowded == {}


def test_small_files_with_one_importer_are_part_of_it() -> None:
    """But for those that the pages of the Python API name: their importers are users."""
    api = "".join(page.read_text() for page in (REPOSITORY / "docs" / "api").glob("*.md"))
    grimp = pytest.importorskip("grimp", reason="import-linter is in the extra dev")
    graph = grimp.build_graph("xethru_protocol", "emulator", "slam", "hil_tests", cache_dir=None)
    prefixes = tuple(f"{path.replace('/', '.')}." for path in PRODUCT)
    found = set()
    for package in PRODUCT:
        for path in (REPOSITORY / package).rglob("*.py"):
            file = path.relative_to(REPOSITORY)
            module = ".".join(file.with_suffix("").parts)
            if path.name in MARKERS or len(path.read_text().splitlines()) >= SMALL_LINES:
                continue
            if f"::: {module}." in api:
                continue
            importers = graph.find_modules_that_directly_import(module)
            if sum(f"{importer}.".startswith(prefixes) for importer in importers) == 1:
                found.add(file.as_posix())
    assert found == set()


# What a distribution is imported as, where that is another name.
IMPORTED_AS = {
    "foxglove-sdk": "foxglove",
    "pillow": "PIL",
    "pyserial": "serial",
    "pytest-timeout": "pytest_timeout",
    "pytest-xdist": "xdist",
    "rerun-sdk": "rerun",
    "scikit-learn": "sklearn",
}


def imported(path: Path) -> set[str]:
    """Return the packages that a file imports, anywhere in it."""
    found: set[str] = set()
    nodes: list[ast.AST] = [ast.parse(path.read_text("utf-8"))]
    for node in nodes:  # blocks are looked into, expressions are not
        if isinstance(node, ast.Import):
            found |= {name.name.split(".")[0] for name in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found.add(node.module.split(".")[0])
        for block in ("body", "orelse", "finalbody", "handlers", "cases"):
            inner = getattr(node, block, None)
            nodes += inner if isinstance(inner, list) else []
    return found


def test_every_imported_package_is_declared() -> None:
    project = tomllib.loads(PYPROJECT.read_text())["project"]
    extras = project["optional-dependencies"]
    wanted = [*project["dependencies"], *(name for extra in extras.values() for name in extra)]
    names = [re.split(r"[\[<>=~!;]", requirement)[0] for requirement in wanted]
    declared = {IMPORTED_AS.get(name, name) for name in names} | {"_typeshed"}  # types only
    ours = {"emulator", "hil_tests", "slam", "xethru_protocol"}
    for package in PRODUCT:
        for path in (REPOSITORY / package).rglob("*.py"):
            missing = imported(path) - declared - ours - sys.stdlib_module_names
            assert not missing, f"{path} imports {missing}, which pyproject.toml does not declare"


def loaded(program: str) -> set[str]:
    """Run Python; return the names of the packages that it loaded."""
    script = (
        f"{program}\nimport sys; print('LOADED', *{{m.partition('.')[0] for m in sys.modules}})"
    )
    run = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True)
    return set(run.stdout.rpartition("LOADED")[2].split())


def test_importing_the_protocol_loads_no_heavy_library() -> None:
    assert not loaded("import xethru_protocol") & HEAVY
    assert not loaded("import xethru_protocol.recordings") & HEAVY - {"numpy"}
    # decode, dump and convert need no port
    assert not loaded("import xethru_protocol.cli.recordings") & {"serial", "asyncio"}


def test_loading_the_plugin_loads_no_library() -> None:
    packages = {"emulator", "slam", "xethru_protocol"}
    assert not loaded("import pytest, hil_tests.plugin.hooks") & (HEAVY | packages)


# Asks a parser for the help of each command and of each command's commands.
EVERY_HELP = """
import argparse, contextlib, io, sys
found = []
remember = argparse.ArgumentParser.parse_known_args
def commands(parser):
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for name, command in action.choices.items():
                yield [name]
                yield from ([name, *rest] for rest in commands(command))
def note(parser, *arguments, **named):
    found.extend(commands(parser))
    return remember(parser, *arguments, **named)
argparse.ArgumentParser.parse_known_args = note
from {module} import main
def help_of(words):
    with contextlib.redirect_stdout(io.StringIO()) as shown:
        try:
            code = main([*words, "--help"])
        except SystemExit as end:
            code = end.code
    assert code in (0, None), (words, code)
    assert shown.getvalue().startswith("usage: "), words
help_of([])
argparse.ArgumentParser.parse_known_args = remember
print(len(found))
for words in found:
    help_of(words)
"""


@pytest.mark.parametrize(
    ("module", "own"),
    [
        ("xethru_protocol.cli", {"xethru_protocol"}),
        ("emulator.cli", {"emulator", "xethru_protocol"}),
        ("slam.app.cli", {"slam", "xethru_protocol"}),
    ],
)
def test_help_of_every_command_loads_no_heavy_library(module: str, own: set[str]) -> None:
    others = {"emulator", "slam", "xethru_protocol"} - own
    assert not loaded(EVERY_HELP.replace("{module}", module)) & (HEAVY | others)
