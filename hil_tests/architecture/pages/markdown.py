"""Documents of Markdown that are made by a program, and their tables."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path


def table(columns: Sequence[str], rows: Iterable[Sequence[str]], numbers: Iterable[str]) -> str:
    """Return a table; the columns that are ``numbers`` are aligned to the right."""
    right = set(numbers)
    rules = ["---:" if column in right else "---" for column in columns]
    lines = [f"| {' | '.join(cells)} |" for cells in (columns, *rows)]
    lines.insert(1, f"|{'|'.join(rules)}|")
    return "\n".join(lines) + "\n"


def with_part(document: str, name: str, part: str) -> str:
    """Return a document with another text between ``<!-- name -->`` and ``<!-- /name -->``."""
    begin, end = f"<!-- {name} -->\n", f"<!-- /{name} -->"
    before, rest = document.split(begin)
    return f"{before}{begin}{part}{end}{rest.split(end)[1]}"


def write(documents: Mapping[Path, str]) -> None:
    for path, text in documents.items():
        path.write_text(text, "utf-8")
