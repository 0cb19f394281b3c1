"""Tables of Markdown."""

from collections.abc import Iterable, Sequence


def table(columns: Sequence[str], rows: Iterable[Sequence[str]], numbers: Iterable[str]) -> str:
    """Return a table; the columns that are ``numbers`` are aligned to the right."""
    right = set(numbers)
    rules = ["---:" if column in right else "---" for column in columns]
    lines = [f"| {' | '.join(cells)} |" for cells in (columns, *rows)]
    lines.insert(1, f"|{'|'.join(rules)}|")
    return "\n".join(lines) + "\n"
