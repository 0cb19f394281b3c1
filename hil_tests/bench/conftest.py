"""Ends a benchmark run with what a README can quote: frames per second, and the machine."""

import platform
from pathlib import Path

import numpy as np
import pytest


def processor() -> str:
    listed = Path("/proc/cpuinfo")
    lines = listed.read_text().splitlines() if listed.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return f"{len(names)} x {names[0]}" if names else platform.processor() or "unknown processor"


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    # the plugin shows extra_info only in its JSON
    session = getattr(terminalreporter.config, "_benchmarksession", None)
    timed = [
        (benchmark.name.removeprefix("test_"), benchmark.extra_info, benchmark.stats)
        for benchmark in getattr(session, "benchmarks", [])
        if "frames" in benchmark.extra_info
    ]
    if not timed:
        return
    terminalreporter.section("frames per second")
    terminalreporter.line(
        f"{processor()}, {platform.system()} {platform.machine()}, "
        f"Python {platform.python_version()}, numpy {np.__version__}"
    )
    width = max(len(name) for name, _, _ in timed)
    terminalreporter.line(f"{'':{width}}  {'median':>9}  {'fastest':>9}")
    for name, info, stats in timed:
        frames = info["frames"]
        rates = f"{frames / stats.median:>9,.0f}  {frames / stats.min:>9,.0f}"
        beside = f"  {info['ratio']:.2f} x {info['beside']}" if "ratio" in info else ""
        terminalreporter.line(f"{name:{width}}  {rates}{beside}")
