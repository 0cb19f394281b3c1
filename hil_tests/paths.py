"""Where the source tree and its data files are."""

from pathlib import Path

REPOSITORY = Path(__file__).parents[1]
FIXTURES = REPOSITORY / "fixtures"
