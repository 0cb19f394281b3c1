"""A terminal that goes away, as when a connection breaks, costs no result.

Each command leads the session of a real terminal, which is closed under it. It then gets SIGHUP,
and every write is an error; or, as after `nohup`, it goes on to its end, and every write is one.
"""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from emulator.scene.scene import load_scene
from hil_tests.device.serving import emulator, open_radar
from hil_tests.patience import seconds
from hil_tests.system.recorded_session import record_session, write_shorter_scene
from hil_tests.system.short_scene import write_short_scene
from hil_tests.system.terminal import Command, in_terminal
from hil_tests.unit.slam.app.sessions import surviving_counters
from hil_tests.unit.xethru_protocol.pty_module import PtyModule
from slam.app.view.rerun_recording import count_rows
from xethru_protocol.recordings import describe_recording

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="needs /proc (Linux)"),
]

THOROUGH = partial(pytest.param, marks=pytest.mark.thorough)
UWB_SLAM, XETHRU, EMULATOR = "slam.app.cli", "xethru_protocol.cli", "emulator.cli"
RADAR = """
[[radars]]
name = "{name}"
serial = "{serial}"
x_m = {x_m}
y_m = {y_m}
yaw_deg = {yaw_deg}
"""
CTRL_S, CTRL_Q = b"\x13", b"\x11"
END_OF_PNG = b"IEND\xaeB`\x82"
RESULTS = ("summary.json", "map.png", "estimate.tum", "odometry.tum")


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recorded") / "session.mcap"
    record_session(path, "paper")
    return path


def end(command: Command, limit_s: float = 30) -> int:
    """Wait for the end; return the exit code."""
    code = command.process.wait(seconds(limit_s))
    assert command.tracebacks == ""
    return code


def has_results(out: Path) -> bool:
    """Whether all files of a run are there, whole by what others read them with."""
    assert not list(out.glob(".unfinished*"))
    if not all((out / name).exists() for name in RESULTS):
        return False
    summary = json.loads((out / "summary.json").read_text())
    n_states = len((out / "estimate.tum").read_text().splitlines())
    assert n_states == len((out / "odometry.tum").read_text().splitlines()) > 3
    assert (out / "map.png").read_bytes().endswith(END_OF_PNG)
    return bool(summary["frames"] > 0)


def is_finished(log: Path) -> bool:
    with log.open("rb") as stream:
        return make_reader(stream).get_summary() is not None


def counters(log: Path) -> list[int]:
    found = surviving_counters(log, "/radar/front_left/frame")
    assert found == list(range(1, len(found) + 1))
    return found


@pytest.mark.thorough
def test_a_demo_whose_terminal_closes_has_all_results(tmp_path: Path) -> None:
    out = tmp_path / "out"
    log = out / "session.mcap"
    arguments = ["demo", "--preset", "paper", "--scene", write_shorter_scene(tmp_path)]
    with in_terminal(UWB_SLAM, [*arguments, "--out", out], tmp_path / "crash") as command:
        command.read_until(lambda: log.exists() and log.stat().st_size > 500_000)
        command.hang_up()
        assert end(command) == 129
    assert is_finished(log)
    assert has_results(out)
    summary = json.loads((out / "summary.json").read_text())
    # the mark of the last scan may be missing, and a few scans more may have been there
    assert summary["frames"] == 4 * len(counters(log)) > 4 * 20


@dataclass(frozen=True)
class Robot:
    """A running emulator, and its rig file."""

    rig: Path
    odometry: str
    ports: tuple[str, ...]


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Robot]:
    folder = tmp_path_factory.mktemp("robot")
    scene = write_short_scene(folder, repeats=20)
    rig = folder / "robot.toml"
    rig.write_text("\n".join(RADAR.format(**vars(spec)) for spec in load_scene(scene).radars))
    with emulator("serve", scene, "--link-dir", folder / "ports") as served:
        assert served.odometry is not None
        yield Robot(rig=rig, odometry=served.odometry, ports=served.paths)


@pytest.mark.rare
@pytest.mark.parametrize(("ignores_hangup", "code"), [(False, 129), THOROUGH(True, 1)])
def test_a_drive_whose_terminal_closes_has_all_results(
    ignores_hangup: bool, code: int, robot: Robot, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    log = out / "session.mcap"
    arguments = ["run", "--rig", robot.rig, "--odometry", robot.odometry, "--out", out]
    arguments += ["--ports", *robot.ports]
    if ignores_hangup:
        arguments += ["--duration", "3"]
    with in_terminal(
        UWB_SLAM, arguments, tmp_path / "crash", ignores_hangup=ignores_hangup
    ) as command:
        command.read_until(lambda: log.exists() and log.stat().st_size > 200_000)
        command.hang_up()
        assert end(command) == code
    assert is_finished(log)
    assert has_results(out)


@pytest.mark.parametrize(("ignores_hangup", "code"), [(False, 129), (True, 1)])
def test_a_recording_whose_terminal_closes_is_complete(
    ignores_hangup: bool, code: int, tmp_path: Path
) -> None:
    out = tmp_path / "recording"
    arguments: list[object] = ["record", "--out", out, "--count", "100", "--port"]
    with (
        PtyModule() as module,
        in_terminal(
            XETHRU, [*arguments, module.path], tmp_path / "crash", ignores_hangup=ignores_hangup
        ) as command,
    ):
        command.read_until(
            lambda: any(path.stat().st_size for path in out.glob("xethru_datafloat_*"))
        )
        command.hang_up()
        assert end(command) == code
        assert module.fps == 0, "the module was stopped"
    kept = describe_recording(out)
    assert kept.faults == ()
    assert kept.messages["DATA FLOAT"] == 100 or not ignores_hangup


@pytest.mark.thorough
@pytest.mark.parametrize(("ignores_hangup", "code"), [(False, 129), (True, 1)])
def test_a_stream_whose_terminal_closes_stops_the_module(
    ignores_hangup: bool, code: int, tmp_path: Path
) -> None:
    with (
        PtyModule() as module,
        in_terminal(
            XETHRU,
            ["stream", "--port", module.path],
            tmp_path / "crash",
            ignores_hangup=ignores_hangup,
        ) as command,
    ):
        command.read_until(lambda: b"strongest at" in command.printed)
        command.hang_up()
        assert end(command) == code
        assert module.fps == 0


@pytest.mark.parametrize("ignores_hangup", [False, THOROUGH(True)])
@pytest.mark.parametrize("verb", ["serve", THOROUGH("play"), THOROUGH("proxy")])
def test_an_emulator_whose_terminal_closes_ends_or_goes_on(
    verb: str, ignores_hangup: bool, session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    links = tmp_path / "links"
    with PtyModule() as module:
        what: dict[str, list[object]] = {
            "serve": ["--bare"],
            "play": [session],
            "proxy": ["--port", module.path],
        }
        arguments = [verb, *what[verb], "--link-dir", links]
        with in_terminal(
            EMULATOR, arguments, tmp_path / "crash", ignores_hangup=ignores_hangup
        ) as command:
            command.read_until(lambda: b'"ready":true' in command.printed)
            command.hang_up()
            if ignores_hangup:
                (link, *_) = (path for path in links.iterdir() if path.suffix != ".sock")
                with open_radar(str(link)) as radar:
                    radar.ping()
                command.process.terminate()
            assert end(command) == 0
    assert not links.exists()
    assert not list((tmp_path / "xethru").glob("*.json"))


@pytest.mark.thorough
def test_a_sweep_whose_terminal_closes_keeps_its_runs(tmp_path: Path) -> None:
    out, scene = tmp_path / "out.json", write_shorter_scene(tmp_path)
    arguments = ["sweep", "--preset", "paper", "--scene", scene, "--seeds", "50", "--jobs", "1"]
    with in_terminal(UWB_SLAM, [*arguments, "--json", out], tmp_path / "crash") as command:
        command.read_until(lambda: b"1 of 50: " in command.printed)
        command.hang_up()
        assert end(command) == 129
    assert not out.exists()
    part = out.with_name("out.json.part").read_text()
    assert part.count('"realtime_factor"') >= 1


@pytest.mark.thorough
def test_a_stopped_terminal_stops_no_demo(tmp_path: Path) -> None:
    """Ctrl-S holds back what is printed, until Ctrl-Q; the results are there before."""
    out = tmp_path / "out"
    arguments = ["demo", "--preset", "paper", "--scene", write_shorter_scene(tmp_path)]
    with in_terminal(UWB_SLAM, [*arguments, "--out", out], tmp_path / "crash") as command:
        command.wait_for_handlers()
        command.press(CTRL_S)
        command.read_until((out / "map.png").exists)
        assert command.process.poll() is None, "it waits for the terminal now"
        assert command.printed == b""
        command.press(CTRL_Q)
        command.read_until(lambda: b"SLAM ATE" in command.printed)
        assert end(command) == 0
    assert has_results(out)


def _has_two_runs(folder: Path) -> bool:
    return len(json.loads((folder / "out" / "sweep.json").read_text())["runs"]) == 2


def _is_page(folder: Path) -> bool:
    return (folder / "out" / "report.html").read_text().rstrip().endswith("</html>")


def _is_bag(folder: Path) -> bool:
    with AnyReader([folder / "out" / "bag"]) as bag:
        return sum(1 for _ in bag.messages()) == bag.message_count > 100


def _is_view(folder: Path) -> bool:
    return sum(count_rows(folder / "out" / "view.rrd").values()) > 100


def _is_demo(folder: Path) -> bool:
    return has_results(folder / "out") and is_finished(folder / "out" / "session.mcap")


COMMANDS: dict[str, tuple[str, Callable[[Path], bool]]] = {
    "demo": ("demo --preset paper --scene {scene} --out {out}", _is_demo),
    "sweep": (
        "sweep --preset paper --scene {scene} --seeds 2 --jobs 2 --json {out}/sweep.json",
        _has_two_runs,
    ),
    "replay": ("replay {session} --out {out}", lambda folder: has_results(folder / "out")),
    "report": ("report {session} --out {out}/report.html", _is_page),
    "convert": ("convert {session} {out}/bag", _is_bag),
    "view": ("view {session} --out {out}/view.rrd", _is_view),
    "calibrate": (
        "calibrate {session} --rig {out}/rig.toml",
        lambda folder: "[[radars]]" in (folder / "out" / "rig.toml").read_text(),
    ),
    "repair": (
        "repair {session} --out {out}/session.mcap",
        lambda folder: is_finished(folder / "out" / "session.mcap"),
    ),
}


@pytest.mark.rare
@pytest.mark.parametrize(
    "name", ["convert", *(THOROUGH(name) for name in COMMANDS if name != "convert")]
)
def test_a_terminal_that_is_gone_from_the_start_costs_no_result(
    name: str, session: Path, tmp_path: Path
) -> None:
    """As after `nohup`; that the table could not be printed is exit code 1."""
    line, is_whole = COMMANDS[name]
    (out := tmp_path / "out").mkdir()
    paths = {"session": session, "out": out, "scene": write_shorter_scene(tmp_path)}
    words = [word.format(**paths) for word in line.split()]
    with in_terminal(UWB_SLAM, words, tmp_path / "crash", ignores_hangup=True) as command:
        command.wait_for_handlers()
        command.hang_up()
        assert end(command) == 1
    assert is_whole(tmp_path)
