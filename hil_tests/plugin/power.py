"""``--hil-power-cmd``: the command that switches the power of a real radar; see docs/testing.md.

It is cut into words as a shell does, and started without one.
"""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import signal
import subprocess
import tempfile
from collections.abc import Callable, Mapping

PLACEHOLDERS = ("action", "port", "serial")
LIMIT_S = 30.0


class PowerError(Exception):
    """The command cannot be used, or failed; the message is one line."""


class PowerCommand:
    """A command and how it is run; `PowerError` if it can be none.

    >>> PowerCommand("uhubctl -l 1-1 -p 2 -a {action}").words({"action": "off"})
    ['uhubctl', '-l', '1-1', '-p', '2', '-a', 'off']
    """

    def __init__(self, text: str) -> None:
        self.text = text
        try:
            self._words = shlex.split(text)
        except ValueError as error:
            raise PowerError(f"{text!r}: {error}") from None
        if not self._words:
            raise PowerError("the command is empty")
        self._placeholders = re.findall(r"\{(\w*)\}", text)
        for name in self._placeholders:
            if name not in PLACEHOLDERS:
                known = ", ".join(f"{{{known}}}" for known in PLACEHOLDERS)
                raise PowerError(f"{text!r}: {{{name}}} is unknown; there are {known}")

    def words(self, values: Mapping[str, str]) -> list[str]:
        return [re.sub(r"\{(\w*)\}", lambda found: values[found[1]], word) for word in self._words]

    def cycle(self, port: str, serial: str, off_s: float, sleep: Callable[[float], None]) -> None:
        """Take the power away for ``off_s`` and give it back; `PowerError` if that fails."""
        if "serial" in self._placeholders and not serial:
            raise PowerError(f"{self.text!r}: the module at {port} reports no serial number")
        values = {"port": port, "serial": serial}
        if "action" not in self._placeholders:
            _run(self.words(values))
            return
        _run(self.words({**values, "action": "off"}))
        try:
            sleep(off_s)
        finally:  # also after an interrupt
            _run(self.words({**values, "action": "on"}))


def _run(words: list[str]) -> None:
    shown = shlex.join(words)
    with tempfile.TemporaryFile() as output:  # a pipe could be held open by a process left behind
        try:
            process = subprocess.Popen(
                words,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise PowerError(f"{shown!r} cannot be started: {reason}") from None
        try:
            code = process.wait(LIMIT_S)
        except subprocess.TimeoutExpired:
            raise PowerError(f"{shown!r} did not end within {LIMIT_S:g} s") from None
        finally:
            if process.poll() is None:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)  # and what it started
                process.wait()
        if code:
            output.seek(0)
            *_, last = ["no output", *output.read().decode(errors="replace").strip().splitlines()]
            raise PowerError(f"{shown!r} ended with {code}: {last}")
