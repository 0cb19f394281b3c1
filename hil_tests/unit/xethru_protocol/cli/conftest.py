"""A module at a port."""

from collections.abc import Iterator

import pytest

from hil_tests.unit.xethru_protocol.pty_module import PtyModule


@pytest.fixture
def module() -> Iterator[PtyModule]:
    with PtyModule() as module:
        yield module
