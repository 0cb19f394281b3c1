"""The only way to GTSAM (BSD licence): an optional extra, imported by who needs it when it does."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from slam.app.errors import AppError


def load_gtsam(purpose: str) -> Any:  # noqa: ANN401 - types must not depend on an optional package
    """Return the module ``gtsam``.

    Raises
    ------
    AppError
        It is not installed; one line that says what it was wanted for and how to get it.
    """
    try:
        return import_module("gtsam")
    except ImportError:
        raise AppError(
            f"{purpose} needs GTSAM, which is not installed: pip install 'xethru-hil[gtsam]'"
        ) from None
