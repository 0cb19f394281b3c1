"""The emulated world is the same on every machine and after every change that does not mean to.

The hash is over integer chip counters (int64, little-endian, frame by frame), the last exact
numbers before float32 normalisation. The cases stand in ``fixtures/baselines/chip_counters.toml``.
"""

import hashlib
import importlib
import json
import os
import subprocess
import sys
import tomllib
from typing import Any

import numpy as np
import pytest

from emulator.chip.chip import CaptureSettings
from emulator.echo.echo import echo_source
from emulator.scene.scene import load_scene
from hil_tests.paths import FIXTURES
from slam.app.sweep import STRESSES
from slam.app.sweep.run import stressed_scene

BASELINE = FIXTURES / "baselines" / "chip_counters.toml"
CASES: list[dict[str, Any]] = tomllib.loads(BASELINE.read_text())["case"]

PRINT_DIGESTS = (
    "import json, sys; from hil_tests.golden.test_emulated_bytes import CASES, digest; "
    "sys.stdout.write(json.dumps([digest(case) for case in CASES]))"
)


def digest(case: dict[str, Any]) -> str:
    """Return the SHA-256 of a case's counters: all radars, in the scene's order."""
    scene = stressed_scene(load_scene(case["scene"]), STRESSES[case["stress"]], case["seed"])
    capture = CaptureSettings(**case["capture"])
    counters = np.arange(case["frames"], dtype=np.int64) * case["every"]
    times = counters * 200_000_000
    total = hashlib.sha256()
    for radar in range(len(scene.radars)):
        frames = echo_source(scene, radar, case["seed"]).rf_counters(capture, counters, times)
        total.update(frames.astype("<i8").tobytes())
    return total.hexdigest()


@pytest.mark.parametrize("case", CASES, ids=[case["name"] for case in CASES])
def test_chip_counters_are_those_of_the_baseline(case: dict[str, Any]) -> None:
    got = digest(case)
    assert got == case["sha256"], (
        f"emulated counters of {case['name']!r} changed to {got}; if that is meant, "
        f"update {BASELINE} and say why in CHANGELOG.md"
    )


def test_counters_do_not_depend_on_the_processors_vector_units() -> None:
    """Repeat every case in a process whose NumPy may not use AVX."""
    # NumPy tells which features it would use on this processor in this module only.
    cpu = importlib.import_module("numpy._core._multiarray_umath")
    features = [name for name in cpu.__cpu_dispatch__ if cpu.__cpu_features__[name]]
    if not features:
        pytest.skip("this processor offers NumPy no features beyond its baseline")
    environment = os.environ | {"NPY_DISABLE_CPU_FEATURES": " ".join(features)}
    plain = subprocess.run(
        [sys.executable, "-W", "error", "-c", PRINT_DIGESTS],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    assert json.loads(plain.stdout) == [case["sha256"] for case in CASES]
