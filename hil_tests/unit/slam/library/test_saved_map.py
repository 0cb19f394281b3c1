"""Map files: whole, to the last bit, or refused in one line."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam.config import ConfigError
from slam.library.saved_map import MapFile, load_map, map_text, parse_map, save_map
from slam.results import SavedLandmark, SavedMap, SavedRadar, SavedWall

RADAR = SavedRadar(
    name="left",
    x_m=0.1,
    y_m=0.2,
    yaw_rad=math.pi / 2,
    range_offset_m=0.0,
    offset_m=1e-3,
    moved_m=(0.0, -2e-3),
)


def map_of(numbers: list[float]) -> SavedMap:
    """Return a map of one landmark and one wall at these places, known as `numbers` say."""
    unknowns = ("offset left", "x 3", "y 3", "radius 3", "phi 4", "d 4")
    rng = np.random.default_rng(0)
    A = rng.standard_normal((6, 6)) * np.abs(numbers[:6])[:, None]
    P = A @ A.T
    return SavedMap(
        radars=(RADAR,),
        landmarks=(
            SavedLandmark(
                id=3,
                x_m=numbers[6],
                y_m=numbers[7],
                radius_m=0.01,
                added_sigma_m=0.0,
                hits=9,
                label=12,
            ),
        ),
        walls=(
            SavedWall(
                id=4, phi_rad=0.1, d_m=numbers[8], added_sigma_m=3e-3, hits=30, cells=(-2, -1, 5)
            ),
        ),
        unknowns=unknowns,
        covariance=tuple(tuple(P[row, : row + 1].tolist()) for row in range(6)),
        start=(0.0, numbers[6], 0.5),
        next_id=7,
    )


FILE = MapFile(
    map=map_of([0.1] * 6 + [1.0, 2.0, 3.0]), made={"scene": "a"}, world_from_map=(1.0, 0.1, 2.0)
)

_NUMBER = st.floats(-1e3, 1e3)


@given(st.lists(_NUMBER, min_size=9, max_size=9))
def test_what_is_read_is_what_was_written_to_the_last_bit(numbers: list[float]) -> None:
    file = replace(FILE, map=map_of(numbers))
    read = parse_map(map_text(file), "a")
    assert read == file
    assert read.id == file.id
    np.testing.assert_array_equal(read.map.full_covariance(), file.map.full_covariance())


def test_a_file_is_written_whole_and_names_what_it_holds(tmp_path: Path) -> None:
    path = tmp_path / "map.json"
    path.write_text("before")
    save_map(path, FILE)
    assert load_map(path) == FILE
    assert [each.name for each in tmp_path.iterdir()] == ["map.json"]
    tables = json.loads(path.read_text())
    assert tables["format"] == "xethru-hil map"
    assert tables["id"] == FILE.id
    with pytest.raises(OSError, match="No such file"):
        save_map(tmp_path / "no" / "map.json", FILE)


def test_the_covariance_of_landmarks_is_a_part_of_the_whole() -> None:
    P = FILE.map.full_covariance()
    np.testing.assert_array_equal(P, P.T)
    np.testing.assert_array_equal(FILE.map.landmarks_covariance(), P[1:3, 1:3])
    other = replace(FILE, map=replace(FILE.map, next_id=8))
    assert other.id != FILE.id


TEXT = map_text(FILE)
DAMAGED = {
    "cut": TEXT[:200],
    "empty": "",
    "deep": "[" * 100_000,
    "list": "[]",
    "other": '{"format": "another map", "version": 1}',
    "newer": TEXT.replace('"version": 1', '"version": 2'),
    "text": TEXT.replace('"hits": 9', '"hits": "many"'),
    "missing": TEXT.replace('"x_m"', '"z_m"'),
    "name": TEXT.replace('"x 3"', '"z 3"'),
    "id": TEXT.replace('"id": 4', '"id": 3'),
    "next_id": TEXT.replace('"next_id": 7', '"next_id": 4'),
    "nan": TEXT.replace('"x_m": 1.0', '"x_m": NaN'),
    "nan of a radar": TEXT.replace('"x_m": 0.1,', '"x_m": NaN,'),
    "beyond all numbers": TEXT.replace('"world_from_map": [1.0', '"world_from_map": [1e999'),
    "too far": TEXT.replace('"x_m": 1.0', '"x_m": 1e9'),
    "twins": json.dumps(json.loads(TEXT) | {"radars": 2 * json.loads(TEXT)["radars"]}),
    "added": TEXT.replace('"added_sigma_m": 0.003', '"added_sigma_m": -1.0'),
    "hits": TEXT.replace('"hits": 9', '"hits": -9'),
    "cells": TEXT.replace("[-2, -1, 5]", f"[{-(2**70)}]"),
    "label": json.dumps(
        json.loads(TEXT)
        | {
            "landmarks": [json.loads(TEXT)["landmarks"][0] | {"id": id_} for id_ in (2, 3)],
            "unknowns": ["x 2", "y 2", "x 3", "y 3", "phi 4", "d 4"],
        }
    ),
    "rows": TEXT.replace('"radius 3", ', ""),
    "negative": json.dumps(json.loads(TEXT) | {"covariance": [[-1.0], *FILE.map.covariance[1:]]}),
}


@pytest.mark.parametrize("text", DAMAGED.values(), ids=DAMAGED)
def test_what_is_no_map_is_refused_in_one_line(text: str, tmp_path: Path) -> None:
    path = tmp_path / "map.json"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_map(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    assert path.read_text() == text


def test_a_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    (tmp_path / "bytes.json").write_bytes(b"\xff\xfe")
    for name in ("none.json", "bytes.json", "."):
        with pytest.raises(ConfigError, match=str(tmp_path / name)):
            load_map(tmp_path / name)
