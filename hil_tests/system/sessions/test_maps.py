"""A map that one run saves is begun with by the next, recorded with it, and replayed."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from slam.app.cli import main
from slam.library.saved_map import MapFile, load_map, save_map

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def days(demo: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with two days of one room; the second began on the map of the first."""
    folder = tmp_path_factory.mktemp("days")
    (folder / "one").symlink_to(demo / "out")
    (folder / "one.json").symlink_to(demo / "map.json")
    second = ["--seed", "6", "--out", str(folder / "two"), "--save-map", str(folder / "two.json")]
    begins = ["--map", str(folder / "one.json"), "--start", "0", "0", "0"]
    assert main(["demo", "--scene", str(demo / "short.toml"), "--lean", *second, *begins]) == 0
    return folder


def summary_of(folder: Path) -> dict[str, object]:
    summary: dict[str, object] = json.loads((folder / "summary.json").read_text())
    del summary["realtime_factor"]
    return summary


def test_the_second_day_sees_the_landmarks_of_the_first(days: Path) -> None:
    assert "map" not in summary_of(days / "one")
    found = summary_of(days / "two")["map"]
    assert isinstance(found, dict)
    one, two = load_map(days / "one.json"), load_map(days / "two.json")
    assert found["id"] == one.id
    assert found["landmarks"] == len(one.map.landmarks) > 0
    assert len(found["seen"]) + len(found["gone"]) > 0
    assert found["lost_share"] == 0.0
    assert found["found_after_m"] == 0.0
    assert found["error_rmse_m"] < 0.2
    kept = {each.id for each in two.map.landmarks}
    assert kept >= set(found["seen"])
    assert not kept & set(found["gone"])
    assert one.world_from_map == two.world_from_map == (0.0, 0.0, 0.0)
    assert dict(two.made)["seed"] == "6"


def test_replay_begins_on_the_recorded_map(
    days: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    moved = tmp_path / "again.json"
    words = ["replay", str(days / "two"), "--out", str(tmp_path), "--save-map", str(moved)]
    assert main(words) == 0
    assert "came again, to the last bit, and so did the smoothed path" in capsys.readouterr().err
    assert summary_of(tmp_path) == summary_of(days / "two")
    assert load_map(moved).map == load_map(days / "two.json").map


@pytest.mark.rare
def test_a_session_is_localised_in_a_map_that_stays_as_it_is(days: Path, tmp_path: Path) -> None:
    saved = tmp_path / "same.json"
    options = ["--map", str(days / "one.json"), "--start", "0", "0", "0", "--localise"]
    words = ["replay", str(days / "two"), "--out", str(tmp_path), "--save-map", str(saved)]
    assert main([*words, *options]) == 0
    assert load_map(saved).map == load_map(days / "one.json").map


def test_maps_are_shown_converted_and_joined(
    days: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one, two = str(days / "one.json"), str(days / "two.json")
    file = load_map(one)
    assert main(["map", "show", one]) == 0
    said = capsys.readouterr().out
    assert file.id in said
    assert all(f"landmark {each.id}" in said for each in file.map.landmarks)
    assert main(["map", "convert", one, str(tmp_path / "one.geojson")]) == 0
    places = json.loads((tmp_path / "one.geojson").read_text())["features"]
    assert [
        each["geometry"]["coordinates"] for each in places if each["geometry"]["type"] == "Point"
    ] == [[each.x_m, each.y_m] for each in file.map.landmarks]
    assert main(["map", "convert", one, str(tmp_path / "map.yaml")]) == 2
    # a room of two landmarks lies on itself in more than one way
    few = tmp_path / "few.json"
    saved = load_map(two).map
    save_map(few, MapFile(map=replace(saved, landmarks=saved.landmarks[:2])))
    capsys.readouterr()
    assert main(["map", "join", one, str(few), "--out", str(tmp_path / "no.json")]) == 1
    assert not (tmp_path / "no.json").exists()
