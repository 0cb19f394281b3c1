"""Where the source tree, its data files and data too large for it are."""

import os
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]
FIXTURES = REPOSITORY / "fixtures"
SHARED_DATA = Path(os.environ.get("XETHRU_SHARED_DATA") or REPOSITORY.parent / "shared" / "data")


def real_recording() -> Path:
    """Return a recording of a standing X4, baseband of 2017; skip the test without it."""
    path = SHARED_DATA / "x4_baseband_iq_2017"
    if not path.is_dir():
        pytest.skip(f"no recording {path}: set XETHRU_SHARED_DATA to the folder that holds it")
    return path
