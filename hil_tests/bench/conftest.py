"""Ends a benchmark run with what a README can quote: frames per second, and the machine."""

import platform
from pathlib import Path

import numpy as np
import pytest


def processor() -> str:
    """Name of the processor, as well as this system tells it."""
    listed = Path("/proc/cpuinfo")
    lines = listed.read_text().splitlines() if listed.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return f"{len(names)} x {names[0]}" if names else platform.processor() or "unknown processor"


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Print the frames per second that benchmarks noted as ``frames_per_s``."""
    # the plugin shows extra_info only in its JSON
    session = getattr(terminalreporter.config, "_benchmarksession", None)
    rates = {
        benchmark.name.removeprefix("test_"): benchmark.extra_info["frames_per_s"]
        for benchmark in getattr(session, "benchmarks", [])
        if "frames_per_s" in benchmark.extra_info
    }
    if not rates:
        return
    terminalreporter.section("frames per second, at the fastest round")
    terminalreporter.line(
        f"{processor()}, {platform.system()} {platform.machine()}, "
        f"Python {platform.python_version()}, numpy {np.__version__}"
    )
    width = max(map(len, rates))
    for name, rate in rates.items():
        terminalreporter.line(f"{name:{width}}  {rate:>9,.0f}")
