"""What ran where, and what was skipped why: a table on the terminal, and JSON."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

import pytest

__all__ = ["SUMMARY", "Summary"]

_OUTCOMES = ("passed", "failed", "skipped")


class Summary:
    """Collects the reports of all tests that used radars, also those of workers.

    Attributes
    ----------
    trouble
        Why the JSON could not be written; "" where nothing is wrong.
    """

    def __init__(self) -> None:
        self.trouble = ""
        self._counts: dict[str, Counter[str]] = defaultdict(Counter)
        self._said: dict[str, str] = {}
        self._reasons: Counter[str] = Counter()
        self._tests: list[dict[str, Any]] = []
        self._pending: dict[str, str] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Take a report."""
        found: dict[str, Any] | None = getattr(report, "xethru_hil", None)
        if report.when != "teardown":
            if report.when == "call" or not report.passed:
                self._pending[report.nodeid] = report.outcome
            return
        outcome = self._pending.pop(report.nodeid, "passed")
        outcome = "failed" if report.failed else outcome
        if found is None or not found["names"]:
            return
        name = "+".join(found["names"])
        self._counts[name][outcome] += 1
        for radar in found["radars"]:
            if radar["identity"] or radar["name"] not in self._said:
                silent = "did not answer" if found["reason"] is None else "not asked"
                who = radar["identity"] or silent
                self._said[radar["name"]] = f"{who}; {radar['reached']}"
        if found["reason"] is not None:
            self._reasons[found["reason"]] += 1
        self._tests.append({"test": report.nodeid, "outcome": outcome, **found})

    def write_terminal(self, terminal: pytest.TerminalReporter) -> None:
        """Print the table."""
        if not self._counts:
            return
        terminal.section("radars")
        width = max(map(len, [*self._counts, "radar"]))
        terminal.line(f"{'radar':{width}}  passed  failed  skipped  what it is")
        for name, counts in self._counts.items():
            numbers = "  ".join(f"{counts[outcome]:{len(outcome)}}" for outcome in _OUTCOMES)
            terminal.line(f"{name:{width}}  {numbers}  {self._what(name)}")
        for reason, count in sorted(self._reasons.items()):
            terminal.line(f"{count:4} x {reason}")

    def _what(self, name: str) -> str:
        together = name.count("+") + 1
        unknown = "could not be had" if together == 1 else f"{together} radars together"
        return self._said.get(name, unknown)

    def write_json(self, path: Path) -> None:
        """Write every test with its radars, outcome and measurements."""
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(
            json.dumps({"radars": self._said, "tests": self._tests}, indent=2) + "\n", "utf-8"
        )


SUMMARY: pytest.StashKey[Summary] = pytest.StashKey()
