"""The tables of results on `docs/results.md` and in README are those of the recorded sweeps."""

import pytest

from hil_tests.architecture.pages.results import PAGE, README, page, readme_with_table

pytestmark = pytest.mark.skipif(not README.exists(), reason="documents are in the source tree")


def test_the_page_is_that_of_the_baselines() -> None:
    """Else: python -m hil_tests.architecture.pages.results."""
    assert PAGE.read_text() == page()


def test_the_table_of_the_readme_is_that_of_the_baselines() -> None:
    readme = README.read_text()
    assert readme_with_table(readme) == readme
    assert len(readme.encode()) <= 10_000, "README is the front door; put the rest into docs/"
