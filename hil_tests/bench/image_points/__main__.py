"""Tables of what images of emulated drives find: `python -m hil_tests.bench.image_points`.

    python -m hil_tests.bench.image_points --table aperture spacing
    python -m hil_tests.bench.image_points --scenes dense office --rooms 0-9 --stress clean slip

Rows are printed as Markdown as they come, and with --json FILE a line for each is appended, which
has every number. One lap of each scene is driven, as the bars are of one lap. Words are those of
`hil_tests.bench.image_points.scoring`.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hil_tests.bench.image_points.drives import Row
from hil_tests.bench.image_points.scoring import Score, rms, robust_sigma
from hil_tests.bench.image_points.tables import TABLES, rooms, stressed
from hil_tests.bench.image_points.truth import Kind
from slam.app.sweep import CLEAN, FAMILIES, STRESSES
from slam.live.errors import AppError


def number(value: float, scale: float = 1.0, digits: int = 2) -> str:
    return "" if math.isnan(value) else f"{scale * value:.{digits}f}"


def pair(errors: Sequence[NDArray[np.float64]], scale: float) -> str:
    """Return robust sigma and RMS."""
    return f"{number(robust_sigma(errors), scale, 1)} / {number(rms(errors), scale, 1)}"


SUMMED = ("dense", "fresh", "walls", "pillars", "scene")
"""Tables whose rows differ by the room alone: the last row has all of them."""

Columns = dict[str, Callable[[Score], str]]

POINTS: Columns = {
    "patches": lambda score: str(score.n_patches),
    "points a patch": lambda score: number(score.points_per_patch),
    "recall": lambda score: number(score.recall, digits=3),
    "precision": lambda score: number(score.precision, digits=3),
    "along [mm]": lambda score: pair(score.along_m, 1e3),
    "across [mrad]": lambda score: pair(score.across_rad, 1e3),
    "room recall": lambda score: number(score.room_recall, digits=3),
    "ms a scan": lambda score: number(score.ms_per_scan),
}


def recall_of(kind: Kind) -> Callable[[Score], str]:
    return lambda score: number(score.recall_of(kind))


BY_KIND: Columns = {
    **{f"{kind}s": recall_of(kind) for kind in Kind if kind is not Kind.EDGE},
    "lines": lambda score: number(score.line_share),
    "false lines": lambda score: number(score.false_line_share),
}
"""Of rooms with walls; under each kind its recall."""

NEAR_PEOPLE: Columns = {
    "false points": lambda score: str(score.n_false),
    "of them near people": lambda score: str(score.n_near_people),
}

MORE_COLUMNS = {"walls": BY_KIND, "pillars": BY_KIND, "scene": BY_KIND, "people": NEAR_PEOPLE}


def numbers_of(label: str, score: Score) -> dict[str, object]:
    """Return every number of a row, as JSON has them."""
    values = {
        "recall": score.recall,
        "precision": score.precision,
        "room_recall": score.room_recall,
        "along_m": [robust_sigma(score.along_m), rms(score.along_m)],
        "across_rad": [robust_sigma(score.across_rad), rms(score.across_rad)],
        "line_share": score.line_share,
        "false_line_share": score.false_line_share,
        "line_errors_m": [robust_sigma(score.line_errors_m), rms(score.line_errors_m)],
        "ms_per_scan": score.ms_per_scan,
    }
    counts = ("n_patches", "n_scans", "n_points", "n_late", "n_near_people", "processor_s")
    return {
        "label": label,
        **values,
        **{name: getattr(score, name) for name in counts},
        "lengths_m": [score.seen_m, score.found_m, score.line_m, score.false_line_m],
        "required": dict(score.required),
        "found": dict(score.found),
        "found_besides": dict(score.found_besides),
    }


def print_table(name: str, rows: Iterator[Row], out: Path | None) -> None:
    """Print a table as its rows come."""
    columns = POINTS | MORE_COLUMNS.get(name, {})
    heads = [name, *columns]
    sys.stdout.write(f"| {' | '.join(heads)} |\n|{' --- |' * len(heads)}\n")
    every: list[Score] = []

    def finish(label: str, score: Score) -> None:
        cells = [label, *(text(score) for text in columns.values())]
        sys.stdout.write(f"| {' | '.join(cells)} |\n")
        sys.stdout.flush()
        if out is not None:
            with out.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"table": name, **numbers_of(label, score)}) + "\n")

    for row in rows:
        scores = row.scores()
        every.extend(scores)
        finish(row.label, Score.together(scores))
    if name in SUMMED:
        finish("all", Score.together(every))


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m hil_tests.bench.image_points")
    parser.add_argument("--table", nargs="+", choices=TABLES, default=[])
    parser.add_argument("--scenes", nargs="+", default=[], help="scenes, rooms, or families")
    parser.add_argument("--rooms", default="0", help="of families: 3, or 0-9")
    parser.add_argument("--stress", nargs="+", choices=STRESSES, default=[CLEAN])
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--json", type=Path, help="file to append to")
    given = parser.parse_args(arguments)
    for name in given.table:
        print_table(name, TABLES[name](), given.json)
    scenes = [
        scene
        for name in given.scenes
        for scene in (rooms(name, given.rooms) if name in FAMILIES else [name])
    ]
    if scenes:
        asked = (
            stressed(scene, stress, given.seeds) for stress in given.stress for scene in scenes
        )
        print_table("scene", asked, given.json)
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except AppError as error:
        sys.exit(f"image_points: {error}")
