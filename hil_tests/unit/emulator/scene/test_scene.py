"""Scene files load into frozen models, or say in one line what is wrong with them."""

from collections.abc import Callable
from pathlib import Path

import pytest
from pydantic import ValidationError

from emulator.scene.scene import Scene, SceneError, empty_room, load_scene
from emulator.scene.toml_files import shipped_names

RADAR = '[[radars]]\nname = "left"\nserial = "000000000001"\nx_m = 0.0\ny_m = 0.2\nyaw_deg = 90.0\n'
HEAD = 'name = "mine"\nenvironment = "lab"\ndescription = "a scene"\n'
GOOD = HEAD + RADAR
MOVER = '[[movers]]\nname = "fan"\nx_m = 1.0\ny_m = 0.0\nswing_m = 0.01\n'
PERSON = '[[people]]\nname = "a"\nwaypoints_m = [[1.0, 0.0]]\n'
FAR = '[path]\nwaypoints_m = [[0, 0], [1000, 0]]\nlaps = ["forward"]\n'
OUT_OF_BOUNDS = [
    ("path", "speed_mps", "0", "0.001"),
    ("path", "speed_mps", "1e-12", "0.001"),
    ("path", "speed_mps", "1e-310", "0.001"),
    ("path", "speed_mps", "1e300", "10"),
    ("path", "turn_rate_deg_per_s", "1e-310", "0.1"),
    ("path", "turn_rate_deg_per_s", "1e300", "3600"),
    ("odometry", "rate_hz", "1e-300", "0.1"),
    ("odometry", "rate_hz", "1001", "1000"),
    ("odometry", "scale_sigma", "1e300", "1"),
    ("odometry", "heading_sigma_rad_per_rad", "1.1", "1"),
    ("noise", "rf_sigma", "1e300", "1"),
    ("leakage", "amplitude", "1e300", "10"),
    ("leakage", "range_m", "-1e300", "-1000"),
]


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "mine.toml"
    path.write_text(text)
    return path


def test_the_shipped_scenes_are_known_by_name() -> None:
    assert {"lab", "classroom", "smoke"} <= set(shipped_names("scenes"))


@pytest.mark.parametrize("name", shipped_names("scenes"))
def test_every_shipped_scene_loads_under_its_own_name(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert load_scene(name).name == name


@pytest.mark.parametrize("as_text", [str, Path])
def test_a_file_loads_by_its_path(tmp_path: Path, as_text: type[str] | type[Path]) -> None:
    scene = load_scene(as_text(write(tmp_path, GOOD.replace("90.0", "90"))))
    assert scene.name == "mine"
    assert scene.radars[0].yaw_deg == 90.0
    assert (scene.radars[0].range_offset_m, scene.radars[0].start_skew_ms) == (0.0, 0.0)
    assert scene.trajectory().duration_ns == 0


def test_a_scene_is_frozen() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        load_scene("lab").name = "other"  # type: ignore[misc] # assigning is what is tested


@pytest.mark.parametrize(
    ("text", "place"),
    [
        (GOOD + "speed = 1\n", "radars[0].speed"),
        ("colour = 1\n" + GOOD, "colour: unknown key"),
        (GOOD + "[path]\nspede_mps = 0.1\n", "path.spede_mps"),
        (HEAD, "radars: missing"),
        (GOOD.replace('"lab"', '"office"'), "environment"),
        (GOOD.replace("90.0", '"90"'), "radars[0].yaw_deg"),
        (GOOD.replace("90.0", "900.0"), "radars[0].yaw_deg"),
        (GOOD.replace("0.2", "nan"), "radars[0].y_m"),
        (GOOD.replace("0.2", "inf"), "radars[0].y_m"),
        (GOOD.replace("0.2", "true"), "radars[0].y_m"),
        (GOOD.replace("000000000001", "1"), "radars[0].serial"),
        (GOOD + RADAR, "radars.name"),
        (GOOD + RADAR.replace("left", "right"), "radars.serial"),
        (HEAD + "radars = []\n", "radars"),
        (
            GOOD + "[path.carried]\nat_s = 1.0\nskips_s = 2.0\n",
            "path.carried: the robot is set down 3 s into a drive of 0 s",
        ),
        (GOOD + "[path.carried]\nat_s = 1.0\nskips_s = 2.0\nfor_s = 1.0\n", "path.carried.for_s"),
        (GOOD + "[path]\nspeed_mps = 1e400\n", "path.speed_mps"),
        (GOOD + f"[path]\nspeed_mps = 1{'0' * 400}\n", "path.speed_mps"),
        (GOOD + f"[path]\nspeed_mps = 1{'0' * 5000}\n", "not valid TOML"),
        # 2 km at 2 mm/s are 277.8 h
        (GOOD + FAR + "speed_mps = 0.002\n", "path: the drive takes 277.8 h"),
        # 2 km at 1 m/s and a U-turn of 1 s at the far end
        (
            GOOD + FAR + "speed_mps = 1\nturn_rate_deg_per_s = 180\n[odometry]\nrate_hz = 1000\n",
            "odometry.rate_hz: 2001001 lines",
        ),
        (GOOD + '[path]\nlaps = ["up"]\n', "path.laps[0]"),
        (GOOD + "[path]\nwaypoints_m = [[1.0, 0.0]]\n", "path.waypoints_m"),
        (GOOD + "[path]\nwaypoints_m = [[0, 0], [0, 1]]\n", "waypoints_m"),
        (GOOD + "[path]\nwaypoints_m = [[0, 0, 0]]\n", "path.waypoints_m[0]"),
        (GOOD + "[path]\nwaypoints_m = []\n", "path.waypoints_m"),
        (GOOD + "[noise]\nrf_sigma = -1.0\n", "noise.rf_sigma"),
        (GOOD + "[noise]\niterations = 1.5\n", "noise.iterations"),
        (GOOD + '[[targets]]\nname = "Bad Name"\n', "targets[0].name"),
        (GOOD + "[path\n", "not valid TOML"),
        ("a = " + "[" * 100_000, "brackets are nested too deep"),
        ("radars = 3\n" + HEAD, "radars"),
        ("", "missing"),
        (GOOD + '[walls]\nname = "w"\n', "walls: must be a list"),
        (GOOD + PERSON + "pulse = 70", "people[0].pulse: unknown key; known are name, way"),
        (GOOD + PERSON + "leaves_s = 2.0\nenters_s = 2.0", "people[0]: leaves_s: must be later"),
        (GOOD + PERSON + PERSON, "people.name: each must be unique"),
        (GOOD + PERSON + 'posture = "flat"', 'people[0].posture: must be "upright", "supine", '),
        (
            GOOD + PERSON + "[people.sleep]\n",
            "people[0]: posture: who sleeps must be supine, prone",
        ),
        (GOOD + PERSON + "apnoea.lasts_s = 9\n", "people[0].apnoea.every_s: missing"),
        (GOOD + MOVER + "rate_hz = 0\n", "movers[0].rate_hz: must be greater than 0, not 0"),
        (GOOD + 2 * (MOVER + "rate_hz = 1\n"), "movers.name: each must be unique"),
    ],
)
def test_a_bad_scene_is_one_line_that_names_the_place(
    tmp_path: Path, text: str, place: str
) -> None:
    path = write(tmp_path, text)
    with pytest.raises(SceneError) as caught:
        load_scene(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    assert place in message


@pytest.mark.parametrize(("table", "key", "value", "limit"), OUT_OF_BOUNDS)
def test_a_value_out_of_bounds_is_refused_with_its_limit(
    table: str, key: str, value: str, limit: str, tmp_path: Path
) -> None:
    path = write(tmp_path, GOOD + f"[{table}]\n{key} = {value}\n")
    with pytest.raises(SceneError, match=rf"{table}\.{key}: must be at (least|most) {limit}, not"):
        load_scene(path)


def test_one_bad_value_is_one_problem(tmp_path: Path) -> None:
    """That the only radar is refused is not reported as a second problem of the list of radars."""
    with pytest.raises(SceneError, match=r'not "1"$'):
        load_scene(write(tmp_path, GOOD.replace("000000000001", "1")))


def test_an_unknown_name_lists_the_known_ones() -> None:
    message = r"labb: no such scene, nor the path of .*; did you mean lab\?"
    with pytest.raises(SceneError, match=message):
        load_scene("labb")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda path: None, "cannot read the scene file: "),
        (Path.mkdir, "cannot read the scene file: "),
        (
            lambda path: path.write_bytes(GOOD.encode() + b"\xff"),
            f"not UTF-8 text at byte {len(GOOD)}",
        ),
    ],
    ids=["missing", "folder", "not text"],
)
def test_an_unreadable_file_is_one_clear_line(
    tmp_path: Path, make: Callable[[Path], object], message: str
) -> None:
    path = tmp_path / "mine.toml"
    make(path)
    with pytest.raises(SceneError, match=f"mine.toml: {message}") as caught:
        load_scene(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("count", [1, 4, 9])
def test_an_empty_room_has_modules_and_nothing_else(count: int) -> None:
    scene = empty_room(count)
    assert len(scene.radars) == count
    assert not scene.targets
    assert scene.trajectory().duration_ns == 0
    assert Scene.model_validate(scene.model_dump()) == scene
