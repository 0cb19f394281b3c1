"""``fixtures/MANIFEST.toml`` names every data file, where it comes from, and its exact content."""

import hashlib
import tomllib

import pytest

from hil_tests.paths import FIXTURES

LISTED: list[dict[str, str]] = tomllib.loads((FIXTURES / "MANIFEST.toml").read_text())["file"]
ENTRIES = {entry["path"]: entry for entry in LISTED}


def data_files() -> list[str]:
    """Return the paths of all data files, relative and sorted; Python files are code."""
    files = (path for path in FIXTURES.rglob("*") if path.is_file())
    return sorted(
        path.relative_to(FIXTURES).as_posix()
        for path in files
        if path.suffix not in {".py", ".pyc"}
    )


def test_every_file_is_listed_once_and_every_entry_exists() -> None:
    assert sorted(entry["path"] for entry in LISTED) == [
        path for path in data_files() if path != "MANIFEST.toml"
    ]


@pytest.mark.parametrize("path", sorted(ENTRIES))
def test_an_entry_is_complete_and_true(path: str) -> None:
    entry = ENTRIES[path]
    assert set(entry) == {"path", "source", "licence", "sha256"}
    assert entry["source"]
    assert entry["licence"]
    content = (FIXTURES / path).read_bytes()
    got = hashlib.sha256(content).hexdigest()
    assert got == entry["sha256"], f'{path} has changed: its entry needs sha256 = "{got}"'
