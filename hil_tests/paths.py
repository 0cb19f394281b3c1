"""Where the source tree, its data files, its studies and data too large for it are."""

import os
import sys
from functools import cache
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import pytest

REPOSITORY = Path(__file__).parents[1]
FIXTURES = REPOSITORY / "fixtures"
STUDIES = REPOSITORY / "docs" / "studies"
SHARED_DATA = Path(os.environ.get("XETHRU_SHARED_DATA") or REPOSITORY.parent / "shared" / "data")
NO_SHARED_DATA = (
    f"recordings of real modules are not in {SHARED_DATA}: set XETHRU_SHARED_DATA to their folder"
)


def shared_data(name: str) -> Path:
    """Return a file or folder of the data that is not in the tree; skip the test without it.

    The reason is the same for all, so that the report has one line, with the number of tests.
    """
    path = SHARED_DATA / name
    if not path.exists():
        pytest.skip(NO_SHARED_DATA)
    return path


def real_recording() -> Path:
    """Return a recording of a standing X4, BASEBAND_IQ of 2017; skip the test without it."""
    return shared_data("x4_baseband_iq_2017")


def real_raw_recording() -> Path:
    """Return a recording of an X4M03, DATA FLOAT of 2025; skip the test without it."""
    return shared_data("x4m03_rf_2025")


@cache
def study(name: str) -> ModuleType:
    """Return a script of `docs/studies` as a module; skip the test or file where there is none."""
    path = STUDIES / f"{name}.py"
    if not path.exists():
        pytest.skip("studies are in the source tree", allow_module_level=True)
    spec = spec_from_file_location(f"docs_studies_{name}", path)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[spec.name] = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
