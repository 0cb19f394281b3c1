"""`serve --faults`, its truth log, and `ctl` on the running emulator, from outside."""

import json
import subprocess
import sys
from pathlib import Path

from hil_tests.device.serving import emulator, open_radar
from hil_tests.paths import FIXTURES
from xethru_protocol.driver.link import RawConfig

CTL = (sys.executable, "-m", "emulator.cli", "ctl")


def ctl(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [*CTL, *words],
        capture_output=True,
        text=True,
        check=False,
    )


def test_what_the_driver_counts_is_what_the_truth_log_says(tmp_path: Path) -> None:
    scenario = tmp_path / "gaps.toml"
    scenario.write_text(
        '[[fault]]\nkind = "missing_frames"\nevery = 10\ncount = 2\nparameters = { frames = 3 }\n'
    )
    truth = tmp_path / "truth.jsonl"
    arguments = ("serve", "--bare", "--faults", str(scenario), "--truth", str(truth))
    with emulator(*arguments) as served, open_radar(served.paths[0]) as radar:
        radar.configure_raw(RawConfig(frame_area_m=(0.4, 1.0)))
        radar.start(50.0)
        list(radar.frames(30))
        written = [json.loads(line) for line in truth.read_text().splitlines()]
        assert [record["kind"] for record in written] == ["missing_frames"] * 2
        assert radar.frames_lost == sum(record["parameters"]["frames"] for record in written)

        with subprocess.Popen(
            [*CTL, served.paths[0], "fault", "add", "counter_jump", "frames=5"],
            stderr=subprocess.PIPE,
            text=True,
        ) as adding:
            while adding.poll() is None:  # a port that nobody reads overflows
                next(radar.frames(1))
            assert adding.stderr is not None
            assert adding.returncode == 0, adding.stderr.read()
        list(radar.frames(50))
        assert radar.frames_lost == 6 + 5
        state = json.loads(ctl(served.paths[0], "state").stdout)
        (told,) = state["radars"].values()
        assert told["injected"] == {"missing_frames": 2, "counter_jump": 1}
        refused = ctl(served.paths[0], "fault", "add", "crc")
        assert (refused.returncode, refused.stdout) == (1, "")
        assert "no kind of fault is called 'crc'" in refused.stderr


def test_a_wrong_scenario_is_one_line(tmp_path: Path) -> None:
    scenario = tmp_path / "wrong.toml"
    scenario.write_text('[[fault]]\nkind = "stall"\nradar = ["nose"]\n')
    result = subprocess.run(
        [sys.executable, "-m", "emulator.cli", "serve", "--bare", "--faults", str(scenario)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 1
    assert result.stderr.count("\n") == 1
    assert "no radar is called 'nose'; there are radar_1" in result.stderr


def test_the_list_of_faults_is_json() -> None:
    result = subprocess.run(
        [sys.executable, "-m", "emulator.cli", "faults", "--json"],
        capture_output=True,
        text=True,
        check=True,
    )
    listed = json.loads(result.stdout)
    assert len(listed) >= 40
    assert {"kind", "layer", "parameters", "counted", "hidden", "example"} <= set(listed[0])


def test_a_playback_is_paused_and_goes_on() -> None:
    recording = FIXTURES / "recordings" / "float"
    with emulator("play", str(recording)) as served:
        for words, paused in ((("pause",), True), (("resume",), False)):
            done = ctl(served.paths[0], *words)
            assert done.returncode == 0, done.stderr
            (told,) = json.loads(ctl(served.paths[0], "state").stdout)["radars"].values()
            assert told["playback"]["paused"] is paused
