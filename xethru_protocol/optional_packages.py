"""The extras of the distribution: which of them installs a package that is missing."""

from __future__ import annotations

import json
import os
import shutil
import sys
from pathlib import Path
from shlex import quote
from typing import Any
from urllib.parse import unquote, urlsplit

DISTRIBUTION = "xethru-hil"
_ORIGIN = "direct_url.json"

PACKAGES = {
    "mcap": ("lz4", "mcap", "zstandard"),
    "emulator": ("pydantic", "scipy"),
    "slam": ("joblib", "matplotlib", "numba", "PIL", "rosbags", "sklearn", "threadpoolctl"),
    "live": ("pyarrow", "rerun", "rerun_cli"),
    "foxglove": ("foxglove",),
    "dask": ("distributed",),
    "gtsam": ("gtsam",),
    "ros2": ("cyclonedds",),
}
"""Names as imported, by the extra of pyproject.toml that lists their distributions."""

_CALLED = {"live": "Rerun"}
"""What users call the packages of an extra, where a package's name would not tell them."""

INCLUDED = {
    "slam": ("emulator", "mcap"),
    "view": ("emulator", "live", "mcap", "slam"),
    "hil": ("emulator", "mcap"),
}
"""Extras that an extra includes."""


def install_command(extra: str) -> str:
    """Return the command that adds an extra to this installation.

    It names what the installation was made of, as pip recorded it (PEP 610): a clone, a wheel or a
    repository. A program that runs from its source tree names that tree.
    """
    origin = _origin()
    url = str(origin.get("url", ""))
    path = Path(unquote(urlsplit(url).path))
    option = ""
    if vcs := origin.get("vcs_info"):
        what = f"{DISTRIBUTION}[{extra}] @ {vcs['vcs']}+{url}"
    elif url.startswith("file:") and path.exists():
        option = "-e " if origin.get("dir_info", {}).get("editable") else ""
        what = f"{'.' if path == Path.cwd() else path}[{extra}]"
    else:
        what = f"{DISTRIBUTION}[{extra}]"
    return f"{_pip()} install {option}{quote(what)}"


def _origin() -> dict[str, Any]:
    source = Path(__file__).parents[1]
    if (source / "pyproject.toml").is_file():
        return {"url": source.as_uri(), "dir_info": {"editable": True}}
    from importlib.metadata import PackageNotFoundError, distribution  # 20 ms

    try:
        found: dict[str, Any] = json.loads(distribution(DISTRIBUTION).read_text(_ORIGIN) or "{}")
    except (PackageNotFoundError, ValueError):
        return {}
    return found


def _pip() -> str:
    """Return what calls the pip of this interpreter, which need not be the first on the path."""
    pip, python = shutil.which("pip"), Path(sys.executable)
    if pip is not None and Path(pip).parent == python.parent:
        return "pip"
    is_near = python.is_relative_to(Path.cwd())
    return f"{quote(os.path.relpath(python) if is_near else str(python))} -m pip"


def what_is_missing(error: ModuleNotFoundError, *, extra: str | None = None) -> str | None:
    """Return which package an import did not find and what installs it; None if no extra does.

    Parameters
    ----------
    extra
        The extra that the program needs in any case. One that includes both is named, if there is
        one, so that one command is enough.
    """
    package = (error.name or "").partition(".")[0]
    for found, packages in PACKAGES.items():
        if package in packages:
            own = extra or found
            wholes = (
                one for one in (own, *INCLUDED) if {own, found} <= {one, *INCLUDED.get(one, ())}
            )
            named = next(wholes, found)
            return f"{_CALLED.get(found, package)} is not installed: {install_command(named)}"
    return None
