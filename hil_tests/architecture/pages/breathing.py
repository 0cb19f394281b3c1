"""Write the tables of `docs/breathing.md`: `python -m` this.

They are made from `fixtures/baselines/breathing.json`, which `python -m hil_tests.bench.breathing`
measures anew.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hil_tests.architecture.pages.markdown import table, with_part, write
from hil_tests.paths import FIXTURES, REPOSITORY

PAGE = REPOSITORY / "docs" / "breathing.md"
BASELINE = FIXTURES / "baselines" / "breathing.json"

AT_REST = (
    ("rest", "facing", "faces the radar"),
    ("rest", "side", "turned by 90 degrees"),
    ("rest", "back", "turned away"),
    ("rest", "supine", "lies on the back"),
    ("rest", "on a side", "lies on a side"),
    ("rf", "facing", "faces the radar, RF frames"),
    ("fidgets", "facing", "fidgets: two shifts a minute"),
)
NOBODY = (
    ("empty room", "nobody"),
    ("walking", "somebody walks, 0.2 to 1.4 m/s"),
    ("fan", "nobody, a fan of 1 to 8 blades a second"),
    ("curtain", "nobody, a curtain that swings 2 to 5 times a minute"),
    ("fast fan", "nobody, a fan of 9 to 40 blades a second"),
)


def documents() -> dict[Path, str]:
    """Return the page with both tables made anew, between their comments."""
    found, page = json.loads(BASELINE.read_text()), PAGE.read_text("utf-8")
    for name, made in (("at rest", rest_table(found)), ("nobody", nobody_table(found))):
        page = with_part(page, name, f"\n{made}\n")
    return {PAGE: page}


def rest_table(found: Mapping[str, Any]) -> str:
    """Return right answers, then wrong ones, of how many windows, by posture and range."""
    cells = {(cell["row"], cell["column"], cell["range_m"]): cell for cell in found["cells"]}
    ranges_m = sorted({range_m for row, _, range_m in cells if row == "rest"})
    titles = [f"{range_m:g} m" for range_m in ranges_m]
    rows = [
        [text, *(_rest_text(cells[row, column, range_m]) for range_m in ranges_m)]
        for row, column, text in AT_REST
    ]
    return table(["somebody who", *titles], rows, titles)


def _rest_text(cell: Mapping[str, int]) -> str:
    count = cell["right"] + cell["wrong"] + cell["none"]
    wrong = f", {cell['wrong']} wrong" if cell["wrong"] else ""
    return f"{cell['right']} of {count}{wrong}"


def nobody_table(found: Mapping[str, Any]) -> str:
    """Return false answers by what is in the room."""
    cells = {cell["column"]: cell for cell in found["cells"] if cell["row"] == "nobody"}
    rows = []
    for column, text in NOBODY:
        cell = cells[column]
        count = cell["wrong"] + cell["none"]
        rows.append([text, str(count), str(cell["wrong"]), f"{100 * cell['wrong'] / count:.1f} %"])
    columns = ("windows", "false answers", "share")
    return table(["in the room", *columns], rows, columns)


if __name__ == "__main__":
    write(documents())
