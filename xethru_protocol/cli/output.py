"""Lines on stdout and stderr."""

import json
import math
import sys
from typing import Any


def print_json(value: dict[str, Any]) -> None:
    """Write one JSON object on a line of its own, at once; NaN and infinities become null."""
    try:
        text = json.dumps(value, allow_nan=False)
    except ValueError:
        text = json.dumps(_without_nan(value))
    print_line(text)


def print_line(text: str) -> None:
    """Write a result line, at once: whoever reads a pipe gets each as it comes."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def warn(text: str) -> None:
    """Write a line for people."""
    sys.stderr.write(text + "\n")


def _without_nan(value: Any) -> Any:  # noqa: ANN401 - any JSON value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_without_nan(item) for item in value]
    return value
