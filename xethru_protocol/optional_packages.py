"""The extras of the distribution: which of them installs a package that is missing."""

from __future__ import annotations

DISTRIBUTION = "xethru-hil"

PACKAGES = {
    "mcap": ("lz4", "mcap", "zstandard"),
    "emulator": ("pydantic", "scipy"),
    "slam": ("joblib", "matplotlib", "numba", "PIL", "rosbags", "sklearn", "threadpoolctl"),
    "live": ("pyarrow", "rerun", "rerun_cli"),
    "dask": ("distributed",),
    "gtsam": ("gtsam",),
}
"""Names as imported, by the extra of pyproject.toml that lists their distributions."""

INCLUDED = {
    "slam": ("emulator", "mcap"),
    "view": ("emulator", "live", "mcap", "slam"),
    "hil": ("emulator", "mcap"),
}
"""Extras that an extra includes."""


def install_command(extra: str) -> str:
    """Return the command that adds an extra to an installation."""
    return f"pip install '{DISTRIBUTION}[{extra}]'"


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
            return f"{package} is not installed: {install_command(named)}"
    return None
