"""Extras: the table of their packages, and what programs print without them."""

import importlib.metadata
import re
import subprocess
import sys
import tomllib
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import pytest

from hil_tests.paths import REPOSITORY
from xethru_protocol.optional_packages import INCLUDED, PACKAGES, what_is_missing

_PROJECT = REPOSITORY / "pyproject.toml"
_NOT_INSTALLED = """\
import runpy, sys
for package in {packages}:
    sys.modules[package] = None
sys.argv[1:] = {arguments}
runpy.run_module("{program}", run_name="__main__")
"""


@cache  # it reads the files of all packages
def _installed() -> Mapping[str, list[str]]:
    return importlib.metadata.packages_distributions()


def _distribution(requirement: str) -> str:
    return re.split(r"[\[<>=]", requirement)[0]


@pytest.mark.skipif(not _PROJECT.exists(), reason="the requirements are in the source tree")
@pytest.mark.parametrize("extra", PACKAGES)
def test_the_table_agrees_with_the_requirements(extra: str) -> None:
    found = _installed()
    ours = {found[package][0] for package in PACKAGES[extra] if package in found}
    missing = [package for package in PACKAGES[extra] if package not in found]
    if missing:
        pytest.skip(f"not installed: {', '.join(missing)}")
    extras = tomllib.loads(_PROJECT.read_text())["project"]["optional-dependencies"]
    listed = {_distribution(requirement) for requirement in extras[extra]}
    assert ours == listed - {"xethru-hil"}


@pytest.mark.skipif(not _PROJECT.exists(), reason="the requirements are in the source tree")
@pytest.mark.parametrize("extra", INCLUDED)
def test_the_table_of_included_extras_agrees_with_the_requirements(extra: str) -> None:
    extras = tomllib.loads(_PROJECT.read_text())["project"]["optional-dependencies"]

    def included(name: str) -> set[str]:
        text = " ".join(extras[name])
        (names,) = re.findall(r"xethru-hil\[([\w,]+)\]", text) or ("",)
        direct = set(filter(None, names.split(",")))
        return direct.union(*map(included, direct))

    assert included(extra) == set(INCLUDED[extra])


@pytest.mark.parametrize(
    ("module", "own", "line"),
    [
        ("scipy.signal", "emulator", "scipy is not installed: pip install 'xethru-hil[emulator]'"),
        ("scipy", "slam", "scipy is not installed: pip install 'xethru-hil[slam]'"),
        ("mcap.writer", "slam", "mcap is not installed: pip install 'xethru-hil[slam]'"),
        ("mcap.writer", None, "mcap is not installed: pip install 'xethru-hil[mcap]'"),
        ("rerun", "slam", "rerun is not installed: pip install 'xethru-hil[view]'"),
        ("rerun", "live", "rerun is not installed: pip install 'xethru-hil[live]'"),
        ("rerun", None, "rerun is not installed: pip install 'xethru-hil[live]'"),
        ("PIL", "view", "PIL is not installed: pip install 'xethru-hil[view]'"),
        ("PIL", "slam", "PIL is not installed: pip install 'xethru-hil[slam]'"),
        ("xethru_protocol.nothing", "slam", None),
        (None, None, None),
    ],
)
def test_names_the_extra(module: str | None, own: str | None, line: str | None) -> None:
    assert what_is_missing(ModuleNotFoundError(name=module), extra=own) == line


@pytest.mark.parametrize(
    ("program", "arguments", "code", "line"),
    [
        (
            "xethru_protocol.cli",
            ["dump", "FILE"],
            1,
            "xethru dump: MCAP needs packages that are optional; "
            r"\w+ is not installed: pip install 'xethru-hil\[mcap\]'",
        ),
        (
            "emulator.cli",
            ["serve", "--bare"],
            2,
            r"xethru-emulator: \w+ is not installed: pip install 'xethru-hil\[emulator\]'",
        ),
        (
            "emulator.cli",
            ["faults"],
            2,
            r"xethru-emulator: \w+ is not installed: pip install 'xethru-hil\[emulator\]'",
        ),
        (
            "slam.app.cli",
            ["demo"],
            2,
            r"uwb-slam: \w+ is not installed: pip install 'xethru-hil\[slam\]'",
        ),
        (
            "slam.app.cli",
            ["replay", "FILE"],
            2,
            r"uwb-slam: \w+ is not installed: pip install 'xethru-hil\[slam\]'",
        ),
        (
            "slam.app.cli",
            ["view", "FILE"],
            2,
            r"uwb-slam: \w+ is not installed: pip install 'xethru-hil\[view\]'",
        ),
    ],
)
def test_programs_without_extras_name_what_to_install(
    program: str, arguments: list[str], code: int, line: str, tmp_path: Path
) -> None:
    session = tmp_path / "session.mcap"
    session.write_bytes(b"\x89MCAP0\r\n")
    packages = [package for added in PACKAGES.values() for package in added]
    script = _NOT_INSTALLED.format(
        packages=packages,
        arguments=[str(session) if argument == "FILE" else argument for argument in arguments],
        program=program,
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, cwd=tmp_path, check=False
    )
    assert re.fullmatch(line, done.stderr.strip())
    assert (done.returncode, done.stdout) == (code, "")
    assert list(tmp_path.iterdir()) == [session]
