"""Under xdist, all tests of real radars go to one worker, one after the other.

The mark ``xdist_group`` would need ``--dist loadgroup``, and xdist 3.8 loses groups under pytest
9.2. A file of its own, since it imports xdist, which need not be installed.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

import pytest
from xdist.remote import Producer
from xdist.scheduler import LoadScopeScheduling

_GROUP = "tests of real radars"
_PARAMETERS = re.compile(r"\[(.*)\]", re.DOTALL)


class RealRadarScheduling(LoadScopeScheduling):  # type: ignore[misc]  # xdist is not typed
    """Sends each test to any worker, but those of real radars to the same one."""

    def __init__(self, config: pytest.Config, log: Producer | None, radars: Iterable[str]) -> None:
        super().__init__(config, log)
        self._radars = tuple(radars)

    def _split_scope(self, nodeid: str) -> str:
        return group_of(nodeid, self._radars)


def group_of(nodeid: str, radars: Iterable[str]) -> str:
    """Return the group that must stay on one worker; the test's id if it may go to any.

    >>> group_of("test_raw.py::test_frames[ttyACM0-1431]", ["ttyACM0"])
    'tests of real radars'
    >>> group_of("test_raw.py::test_frames[emu-1431]", ["ttyACM0"])
    'test_raw.py::test_frames[emu-1431]'
    """
    found = _PARAMETERS.search(nodeid)
    parameters = f"-{found[1]}-".replace("+", "-") if found else ""
    return _GROUP if any(f"-{name}-" in parameters for name in radars) else nodeid
