"""The page of the protocol is that of the message table."""

import pytest

from hil_tests.architecture.pages.protocol import PAGE, page


@pytest.mark.skipif(not PAGE.exists(), reason="docs are in the source tree")
def test_the_page_is_that_of_the_source() -> None:
    """Else: python -m hil_tests.architecture.pages.protocol."""
    assert PAGE.read_text("utf-8") == page()
