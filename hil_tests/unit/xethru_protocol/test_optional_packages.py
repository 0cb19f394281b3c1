"""Extras: the table of their packages, and what programs print without them."""

import importlib.metadata
import json
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import pytest

from hil_tests.paths import REPOSITORY
from xethru_protocol.optional_packages import INCLUDED, PACKAGES, install_command, what_is_missing

_PROJECT = REPOSITORY / "pyproject.toml"
_OWN_FILE = "xethru_protocol.optional_packages.__file__"
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
    ("module", "own", "named"),
    [
        ("scipy.signal", "emulator", ("scipy", "emulator")),
        ("scipy", "slam", ("scipy", "slam")),
        ("mcap.writer", "slam", ("mcap", "slam")),
        ("mcap.writer", None, ("mcap", "mcap")),
        ("rerun", "slam", ("Rerun", "view")),
        ("rerun", "live", ("Rerun", "live")),
        ("rerun", None, ("Rerun", "live")),
        ("foxglove.websocket", "slam", ("foxglove", "foxglove")),
        ("PIL", "view", ("PIL", "view")),
        ("PIL", "slam", ("PIL", "slam")),
        ("xethru_protocol.nothing", "slam", None),
        (None, None, None),
    ],
)
def test_names_the_extra(
    module: str | None, own: str | None, named: tuple[str, str] | None
) -> None:
    line = None if named is None else f"{named[0]} is not installed: {install_command(named[1])}"
    assert what_is_missing(ModuleNotFoundError(name=module), extra=own) == line


GIT = {"vcs": "git", "commit_id": "f00d"}


@pytest.mark.parametrize(
    ("origin", "command"),
    [
        ({"url": "file://{clone}", "dir_info": {"editable": True}}, "-e '{clone}[slam]'"),
        ({"url": "file://{clone}", "dir_info": {}}, "'{clone}[slam]'"),
        ({"url": "file://{wheel}", "archive_info": {}}, "'{wheel}[slam]'"),
        (
            {"url": "https://example.org/x.git", "vcs_info": GIT},
            "'xethru-hil[slam] @ git+https://example.org/x.git'",
        ),
        ({"url": "file:///removed/since"}, "'xethru-hil[slam]'"),
        ({}, "'xethru-hil[slam]'"),
    ],
)
def test_the_command_names_what_was_installed(
    origin: dict[str, object], command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (clone := tmp_path / "a clone").mkdir()
    (wheel := tmp_path / "w.whl").touch()
    (information := tmp_path / "xethru_hil-1.dist-info").mkdir()
    (information / "METADATA").write_text("Name: xethru-hil\nVersion: 1\n")
    places = {"{clone}": str(clone), "{wheel}": str(wheel)}
    url, expected = str(origin.get("url", "")), command
    for word, place in places.items():
        url, expected = url.replace(word, Path(place).as_uri()[7:]), expected.replace(word, place)
    if origin:
        (information / "direct_url.json").write_text(json.dumps(origin | {"url": url}))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(
        "xethru_protocol.optional_packages.__file__",
        str(tmp_path / "site-packages" / "p" / "extras.py"),
    )
    monkeypatch.chdir(tmp_path)  # an interpreter below it would be named from there
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent))
    assert install_command("slam") == f"pip install {expected}"
    monkeypatch.setenv("PATH", "/nowhere")
    assert install_command("slam") == f"{shlex.quote(sys.executable)} -m pip install {expected}"


def test_in_a_clone_the_command_is_that_of_its_pages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "pyproject.toml").touch()
    monkeypatch.setattr(
        "xethru_protocol.optional_packages.__file__",
        str(tmp_path / "xethru_protocol" / "extras.py"),
    )
    monkeypatch.setenv("PATH", str(Path(sys.executable).parent))
    monkeypatch.chdir(tmp_path)
    assert install_command("view") == "pip install -e '.[view]'"


@pytest.mark.parametrize(
    ("program", "arguments", "code", "line"),
    [
        (
            "xethru_protocol.cli",
            ["dump", "FILE"],
            1,
            "xethru dump: MCAP needs packages that are optional; "
            r"\w+ is not installed: .*pip install .*\[mcap\]'",
        ),
        (
            "emulator.cli",
            ["serve", "--bare"],
            2,
            r"xethru-emulator: \w+ is not installed: .*pip install .*\[emulator\]'",
        ),
        (
            "emulator.cli",
            ["faults"],
            2,
            r"xethru-emulator: \w+ is not installed: .*pip install .*\[emulator\]'",
        ),
        (
            "slam.app.cli",
            ["demo"],
            2,
            r"uwb-slam: \w+ is not installed: .*pip install .*\[slam\]'",
        ),
        (
            "slam.app.cli",
            ["replay", "FILE"],
            2,
            r"uwb-slam: \w+ is not installed: .*pip install .*\[slam\]'",
        ),
        (
            "slam.app.cli",
            ["view", "FILE"],
            2,
            r"uwb-slam: \w+ is not installed: .*pip install .*\[view\]'",
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
