"""A report as one HTML page: no script, no link to anywhere, pictures inside."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape

_STYLE = """\
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, "DejaVu Sans", sans-serif; color: #20242a; background: #fff;
       max-width: 62rem; margin: 2rem auto; padding: 0 1.2rem; }
h1 { font-size: 1.6rem; margin: 0 0 .2rem; }
h2 { font-size: 1.15rem; margin: 2.2rem 0 .6rem; border-bottom: 1px solid #dfe3e8; }
p.note { color: #6a707a; margin: .3rem 0 .8rem; }
p.origin { display: inline-block; padding: .1rem .6rem; border-radius: .6rem; margin: .3rem 0;
           background: #fff3d6; color: #6b4b00; font-weight: 600; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
div.wide { overflow-x: auto; }
th, td { text-align: left; padding: .25rem .9rem .25rem 0; vertical-align: top; }
th { color: #6a707a; font-weight: 500; border-bottom: 1px solid #dfe3e8; }
td.value { font-weight: 600; }
div.wide td, div.wide th, td.value { white-space: nowrap; }
img { max-width: 100%; height: auto; display: block; margin: .6rem 0; }
pre { background: #f6f7f9; padding: .8rem; overflow-x: auto; font-size: .82rem; line-height: 1.35; }
details { margin: .5rem 0; }
summary { cursor: pointer; }
"""


@dataclass(slots=True)
class Page:
    """Collects the parts of a page, in order.

    Parameters
    ----------
    title
        Of window and page.
    """

    title: str
    _parts: list[str] = field(default_factory=list)

    def heading(self, text: str) -> None:
        """Begin a section."""
        self._parts.append(f"<h2>{escape(text)}</h2>")

    def note(self, text: str) -> None:
        """Add a sentence that explains."""
        self._parts.append(f'<p class="note">{escape(text)}</p>')

    def origin(self, text: str) -> None:
        """Say where all data come from, so that nobody misses it."""
        self._parts.append(f'<p class="origin">{escape(text)}</p>')

    def picture(self, svg: str, alt: str) -> None:
        """Add a picture, as part of the page."""
        data = base64.b64encode(svg.encode()).decode()
        self._parts.append(
            f'<img alt="{escape(alt, quote=True)}" src="data:image/svg+xml;base64,{data}">'
        )

    def numbers(self, rows: Sequence[tuple[str, str, str]]) -> None:
        """Add rows of name, value and note."""
        lines = [
            f'<tr><td>{escape(name)}</td><td class="value">{escape(value)}</td>'
            f"<td>{escape(note)}</td></tr>"
            for name, value, note in rows
        ]
        self._parts.append(f"<table>{''.join(lines)}</table>")

    def table(self, names: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """Add a table with a line of column names."""
        head = "".join(f"<th>{escape(name)}</th>" for name in names)
        lines = [f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows]
        self._parts.append(
            f'<div class="wide"><table><tr>{head}</tr>{"".join(lines)}</table></div>'
        )

    def details(self, summary: str, text: str) -> None:
        """Add text that is shown on demand."""
        self._parts.append(
            f"<details><summary>{escape(summary)}</summary><pre>{escape(text)}</pre></details>"
        )

    def settings(self, summary: str, values: Mapping[str, object]) -> None:
        """Add settings, a line each, shown on demand; those inside others with a dotted name."""
        self.details(summary, "\n".join(f"{key} = {value}" for key, value in _flat("", values)))

    def text(self) -> str:
        """Return the page."""
        title = escape(self.title)
        return (
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            f"<title>{title}</title>\n<style>\n{_STYLE}</style>\n</head>\n<body>\n"
            f"<h1>{title}</h1>\n" + "\n".join(self._parts) + "\n</body>\n</html>\n"
        )


def _flat(prefix: str, values: Mapping[str, object]) -> list[tuple[str, object]]:
    rows: list[tuple[str, object]] = []
    for key, value in values.items():
        if isinstance(value, Mapping):
            rows += _flat(f"{prefix}{key}.", value)
        else:
            rows.append((f"{prefix}{key}", value))
    return rows
