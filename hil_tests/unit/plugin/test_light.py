"""The plugin is loaded by every pytest of a machine: it brings nothing heavy."""

from __future__ import annotations

import subprocess
import sys


def test_loading_the_plugin_loads_no_library() -> None:
    program = (
        "import sys, pytest, hil_tests.plugin.hooks\n"
        "heavy = {'emulator', 'mcap', 'numpy', 'pydantic', 'rerun', 'scipy', 'serial', 'slam',\n"
        "         'xdist', 'xethru_protocol'}\n"
        "assert not heavy & {name.partition('.')[0] for name in sys.modules}"
    )
    subprocess.run([sys.executable, "-c", program], check=True)
