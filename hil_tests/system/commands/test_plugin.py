"""The plugin as a user runs it: pytest in an empty folder, radars of another process."""

import json
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import pytest

from hil_tests.device.emulator_process import emulator
from hil_tests.paths import FIXTURES

pytestmark = pytest.mark.slow  # each run of pytest takes seconds to start on a busy machine

# What CONTRIBUTING shows as a test of one's own.
OWN_TEST = """
import numpy as np

def test_my_reflector_is_there(radar, measure):
    radar.configure_raw()
    radar.start(5)
    frames = np.stack([frame.samples for frame in radar.frames(4)])
    measure("loudest_sample", np.abs(frames).max(), unit="of full scale", limit=(1e-4, 1.0))
"""

# A driver that forgets to escape 7F, and only that.
PLANTED = """
from xethru_protocol.wire import connection

def wrong(payload):
    checksum = 0x7D
    for byte in payload:
        checksum ^= byte
    out = bytearray(b"\\x7d")
    for byte in payload + bytes([checksum]):
        if byte in (0x7D, 0x7E):
            out.append(0x7F)
        out.append(byte)
    return bytes(out) + b"\\x7e"

connection.encode_normal = wrong
"""


LOUDEST = "measurement loudest_sample"
RIG_RADAR = '[[radars]]\nname = "{}"\nserial = "{}"\nx_m = 0.1\ny_m = 0.2\nyaw_deg = 90\n'


@pytest.mark.parametrize(
    ("ini", "environment", "named"),
    [
        ("xethru_radar = serial=1", {}, "xethru_radars"),
        ("xethru_rigs = lab.toml", {}, "xethru_rig"),
        ("", {"XETHRU_RADAR": "auto"}, "XETHRU_RADARS"),
    ],
)
def test_a_misspelt_name_is_refused(
    ini: str,
    environment: dict[str, str],
    named: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Else the emulator would be tested in the place of somebody's radar."""
    (tmp_path / "pytest.ini").write_text(f"[pytest]\n{ini}\n")
    (tmp_path / "test_own.py").write_text(OWN_TEST)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    done = run(tmp_path, "-q")
    assert done.returncode == pytest.ExitCode.USAGE_ERROR
    assert f"did you mean {named}?" in done.stderr


def test_keys_of_other_tools_may_have_any_name(tmp_path: Path) -> None:
    """Every pytest of the machine loads the plugin."""
    (tmp_path / "pyproject.toml").write_text(
        '[project.scripts]\nxethru-radar = "radar:main"\n'
        "[tool.pytest.ini_options]\nxfail_strict = true\n"
        '[tool.uv.sources]\nxethru-rig = { path = "rig" }\n'
    )
    (tmp_path / "test_own.py").write_text("def test_nothing(): pass\n")
    assert run(tmp_path, "-q").returncode == 0


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    with emulator("serve", "--bare", "--count", "2", "--tcp", "0") as served:
        yield f"tcp://127.0.0.1:{served.tcp_ports[0]}"


def run(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )


def device(name: str) -> str:
    return f"hil_tests.device.{name}"


@pytest.mark.rare
def test_the_suite_runs_on_a_module_of_another_process(tmp_path: Path, address: str) -> None:
    done = run(
        tmp_path,
        *("--pyargs", device("test_identity"), device("test_settings"), "--radar", address),
        *("--hil-json", "ran.json", "--junitxml", "ran.xml", "--radar", "emu"),
    )
    assert done.returncode == 0, done.stdout
    name = address.replace("://", "-").replace(":", "-")
    assert re.search(rf"^{name} +\d+ +0 +0  X4M300 \d{{12}} Annapurna", done.stdout, re.MULTILINE)
    ran = json.loads((tmp_path / "ran.json").read_text())
    assert {one["names"][0] for one in ran["tests"]} == {name, "emu"}
    assert {one["outcome"] for one in ran["tests"]} == {"passed"}
    assert not (tmp_path / "hil-artifacts").exists()


@pytest.mark.rare
def test_strict_fails_where_a_capability_is_missing(tmp_path: Path, address: str) -> None:
    baud = ("--pyargs", device("test_restarts"), "-k", "baud", "--radar", address)
    assert run(tmp_path, *baud).returncode == 0
    done = run(tmp_path, *baud, "--hil-strict")
    assert done.returncode == 1
    assert "--hil-strict: tcp-127.0.0.1" in done.stdout
    assert "needs uart (USB, tcp:// and pseudo-terminals have no baud rate)" in done.stdout


@pytest.mark.rare
def test_a_planted_bug_is_caught_and_its_artefacts_show_it(tmp_path: Path, address: str) -> None:
    """7F without its escape: the checksum cannot fit, the module drops the command."""
    (tmp_path / "planted.py").write_text(PLANTED)
    done = run(
        tmp_path,
        *("-p", "planted", "--pyargs", device("test_settings"), "-k", "every_byte"),
        *("--radar", address),
    )
    assert done.returncode == 1, done.stdout
    (folder,) = (tmp_path / "hil-artifacts").iterdir()
    assert str(folder) in done.stdout
    log = (folder / "log.txt").read_text()
    assert "!! no command that the module can read ends here" in log
    unread = log.partition("!! no command that the module can read ends here")[0].splitlines()
    sent = next(line for line in reversed(unread) if "  tx  " in line)
    body = bytes.fromhex(sent.partition("  tx  ")[2])[1:-1]
    assert body.count(0x7F) == 1, "the special byte went out alone"
    assert "no answer to X4DRIVER_SET" in log
    about = json.loads((folder / "about.json").read_text())
    assert about["radars"][0]["spec"] == address
    dumped = subprocess.run(
        [sys.executable, "-m", "xethru_protocol.cli", "dump", str(folder / "wire.mcap")],
        capture_output=True,
        text=True,
        check=True,
    )
    assert "REPLY INT" in dumped.stdout
    assert (folder / "session.rrd").stat().st_size > 0


def test_ones_own_test_on_any_radar(tmp_path: Path) -> None:
    (tmp_path / "test_mine.py").write_text(OWN_TEST)
    (tmp_path / "pytest.ini").write_text("[pytest]\nxethru_radars =\n    emu:lab?seed=3\n    emu\n")
    done = run(tmp_path, "--junitxml", "ran.xml")
    assert done.returncode == 0, done.stdout
    properties = ElementTree.parse(tmp_path / "ran.xml").iter("property")
    measured = [one.attrib["value"] for one in properties if one.attrib["name"] == LOUDEST]
    assert len(measured) == 2
    assert all("of full scale (at least 0.0001, at most 1)" in value for value in measured)


@pytest.mark.rare
def test_radars_that_cannot_be_had_are_one_line(tmp_path: Path) -> None:
    (tmp_path / "test_mine.py").write_text(OWN_TEST)
    unknown = run(tmp_path, "--radar", "ttyACM0")
    assert unknown.returncode == 4
    assert "names no radar; allowed are emu" in unknown.stderr
    (tmp_path / "test_other.py").write_text(OWN_TEST)
    gone = run(tmp_path, "--radar", "/dev/no-such-port")
    assert gone.returncode == 1
    assert "there is no port /dev/no-such-port; 'xethru list' shows the ports" in gone.stdout
    assert "1 x no-such-port could not be opened in an earlier test" in gone.stdout
    assert "Traceback" not in gone.stdout
    elsewhere = run(tmp_path, "--radar", "emu:atlantis")
    assert elsewhere.returncode == 1
    assert "atlantis" in elsewhere.stdout


@pytest.mark.rare
def test_a_rig_file_names_the_modules_that_are_missing(tmp_path: Path) -> None:
    (tmp_path / "test_mine.py").write_text(
        "def test_rig(radar_rig):\n    assert set(radar_rig) == {'left', 'right'}\n"
    )
    rig = tmp_path / "rig.toml"
    specs = ("--radar", "emu:lab?radar=left_front", "--rig", str(rig))
    rig.write_text(
        RIG_RADAR.format("left", "202305070102") + RIG_RADAR.format("right", "202305079999")
    )
    done = run(tmp_path, *specs)
    assert done.returncode == 1
    assert "missing right (202305079999); there are 202305070102 at emu-lab" in done.stdout


@pytest.mark.rare
def test_the_modules_of_a_rig_file_are_found_by_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (tmp_path / "test_mine.py").write_text(
        "def test_rig(radar_rig):\n"
        "    told = {name: radar.info().serial_number for name, radar in radar_rig.items()}\n"
        "    assert told == {'left': '202305070104', 'right': '202305070102'}\n"
    )
    (tmp_path / "rig.toml").write_text(
        RIG_RADAR.format("right", "202305070102") + RIG_RADAR.format("left", "202305070104")
    )
    with emulator("serve", "lab"):
        done = run(tmp_path, "--rig", "rig.toml")
    assert done.returncode == 0, done.stdout
    assert "202305070102+202305070104" in done.stdout


@pytest.mark.thorough
def test_workers_share_emulated_radars_and_leave_real_ones_to_one_of_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    suite = ("--pyargs", device("test_identity"), "--radar", "auto", "--radar", "emu")
    nobody = run(tmp_path, *suite)
    assert nobody.returncode == 4
    assert "--radar auto: no module answers; 'xethru doctor' says why" in nobody.stderr
    with emulator("serve", "--bare"):
        done = run(tmp_path, *suite, "-n", "2", "-v")
        refused = run(tmp_path, *suite, "-n", "2", "--dist", "each")
    assert done.returncode == 0, done.stdout
    ran = [line for line in done.stdout.splitlines() if line.startswith("[gw")]
    of_real, of_emulated = ([line for line in ran if name in line] for name in ("[radar_1", "[emu"))
    assert len(of_real) == len(of_emulated) == len(ran) / 2
    (of_the_real_one,) = {line[:5] for line in of_real}
    # how many of the others go to the same worker depends on the load
    assert {line[:5] for line in of_emulated} - {of_the_real_one}
    assert refused.returncode == 4
    assert "all workers want this radar at once" in refused.stderr


@pytest.mark.thorough
def test_recordings_are_played(tmp_path: Path) -> None:
    recording = FIXTURES / "recordings" / "float"
    done = run(tmp_path, "--pyargs", device("test_stream"), "--radar", f"replay:{recording}")
    assert done.returncode == 0, done.stdout
    assert "replay-float       1       0        0" in done.stdout


@pytest.mark.thorough
def test_a_uart_left_at_another_rate_is_found_again(tmp_path: Path) -> None:
    (tmp_path / "test_mine.py").write_text(
        "def test_leaves_it(radar):\n    radar.set_baud_rate(921600)\n\n"
        "def test_finds_it(radar):\n    radar.ping()\n"
    )
    done = run(tmp_path, "--radar", "emu:?line=uart")
    assert done.returncode == 0, done.stdout


@pytest.mark.thorough
def test_artefacts_of_all_tests_where_asked(tmp_path: Path) -> None:
    (tmp_path / "test_mine.py").write_text(OWN_TEST)
    done = run(tmp_path, "--radar", "emu:lab?seed=3", "--hil-keep", "all", "--hil-artifacts", "a")
    assert done.returncode == 0, done.stdout
    (folder,) = (tmp_path / "a").iterdir()
    names = {path.name for path in folder.iterdir()}
    assert names == {"log.txt", "wire.mcap", "about.json", "scene.toml", "session.rrd"}
    about = json.loads((folder / "about.json").read_text())
    assert about["radars"][0]["seed"] == 3
    assert about["measurements"][0]["unit"] == "of full scale"
    assert 'name = "lab"' in (folder / "scene.toml").read_text()


@pytest.mark.thorough
def test_the_answers_of_a_module_become_a_cassette(tmp_path: Path, address: str) -> None:
    done = run(
        tmp_path,
        *("--pyargs", device("test_conformance"), "-k", "emulators", "--radar", address),
        *("--hil-diff", "--hil-cassette", "module.json"),
    )
    assert done.returncode == 0, done.stdout
    cassette = json.loads((tmp_path / "module.json").read_text())
    assert cassette["recorded"]["real_module"] is False
    assert cassette["exchanges"]


@pytest.mark.rare
def test_a_place_where_no_file_can_be_is_refused_before_tests_run(tmp_path: Path) -> None:
    (tmp_path / "test_own.py").write_text(OWN_TEST)
    for place in (".", "test_own.py/ran.json"):
        done = run(tmp_path, "test_own.py", "--hil-json", place)
        assert done.returncode == pytest.ExitCode.USAGE_ERROR
        assert "is there already; name a new file" in done.stderr
        assert "Traceback" not in done.stdout + done.stderr


@pytest.mark.rare
def test_a_fault_that_never_took_effect_fails_its_test(tmp_path: Path) -> None:
    (tmp_path / "test_mine.py").write_text(
        "def test_hit(radar, fault):\n"
        "    lost = fault('bad_checksum')\n"
        "    try:\n        radar.ping(0.5)\n    except Exception:\n        pass\n"
        "    assert lost.injected() == 1\n\n"
        "def test_missed(radar, fault):\n"
        "    fault('missing_frames', frames=2)\n    radar.ping()\n"
    )
    done = run(tmp_path, "--radar", "emu", "--radar", "emu:?line=pty")
    assert done.returncode == 1
    assert "2 failed, 2 passed" in done.stdout
    for name in ("emu", "emu-pty"):
        assert f"{name}: the fault 'missing_frames frames=2' never took effect" in done.stdout


@pytest.mark.rare
def test_a_radar_of_ones_own_by_a_hook(tmp_path: Path) -> None:
    (tmp_path / "conftest.py").write_text(
        "from hil_tests.plugin.radar_targets import RadarTarget\n"
        "from xethru_protocol.transport import open_line\n\n"
        "class Rack(RadarTarget):\n"
        "    def open_line(self, path=None, baudrate=115200):\n"
        "        return open_line(f\"tcp://127.0.0.1:{self.spec.options['port']}\")\n\n"
        "def pytest_xethru_radar_target(spec):\n"
        "    if spec.target.startswith('mylab:'):\n"
        "        return Rack(spec, frozenset({'settings'}), 'slot in the rack')\n"
    )
    (tmp_path / "test_mine.py").write_text("def test_answers(radar):\n    radar.ping()\n")
    with emulator("serve", "--bare", "--tcp", "0") as served:
        done = run(tmp_path, "--radar", f"mylab:rack3?port={served.tcp_ports[0]}")
    assert done.returncode == 0, done.stdout
    assert "slot in the rack" in done.stdout
    (tmp_path / "conftest.py").unlink()
    unknown = run(tmp_path, "--radar", "mylab:rack3")
    assert unknown.returncode == 4
    assert "--radar mylab:rack3: names no radar" in unknown.stderr


MARKED = """
import pytest

@pytest.mark.writes_flash
def test_flash(radar):
    radar.ping()

@pytest.mark.writes_factory_settings
def test_factory(radar):
    radar.ping()

@pytest.mark.slow_hw(seconds=30)
def test_slow(radar):
    radar.ping()
"""


@pytest.mark.rare
@pytest.mark.parametrize(
    ("options", "ran"),
    [
        ((), set()),
        (("--allow-flash",), {"test_flash"}),
        (("--allow-factory-reset", "--hil-slow"), {"test_factory", "test_slow"}),
    ],
    ids=["none", "flash", "others"],
)
def test_options_permit_what_markers_ask_for(
    options: tuple[str, ...], ran: set[str], tmp_path: Path, address: str
) -> None:
    """Of a real module; the emulated one, in virtual time, takes all three."""
    (tmp_path / "test_mine.py").write_text(MARKED)
    done = run(tmp_path, "-v", "--radar", address, "--radar", "emu", *options)
    assert done.returncode == 0, done.stdout
    passed = re.findall(r"::(test_\w+)\[(\w+).*\] PASSED", done.stdout)
    assert {test for test, radar in passed if radar == "emu"} == {
        *("test_flash", "test_factory", "test_slow")
    }
    assert {test for test, radar in passed if radar != "emu"} == ran


@pytest.mark.rare
def test_a_power_command_on_a_module_of_another_process(tmp_path: Path) -> None:
    (tmp_path / "test_mine.py").write_text(
        "def test_power(radar_place):\n"
        "    radar_place.open().x4.iterations = 32\n"
        "    assert radar_place.power_cycle().x4.iterations == 8\n"
    )
    with emulator("serve", "--bare", "--tcp", "0") as served:
        control = [
            sys.executable,
            "-m",
            "emulator.cli",
            "ctl",
            str(served.control),
            "unplug",
            "0.3",
        ]
        address = ("--radar", f"tcp://127.0.0.1:{served.tcp_ports[0]}")
        done = run(tmp_path, *address, "--hil-power-cmd", shlex.join(control))
        failed = run(tmp_path, *address, "--hil-power-cmd", "sh -c 'echo no hub; exit 3'")
    assert done.returncode == 0, done.stdout
    assert failed.returncode == 1
    assert "ended with 3: no hub" in failed.stdout
    refused = run(tmp_path, "--hil-power-cmd", "hub {colour}")
    assert refused.returncode == 4
    assert "{colour} is unknown" in refused.stderr


@pytest.mark.rare
def test_a_test_that_runs_again_gets_a_new_radar(tmp_path: Path, address: str) -> None:
    pytest.importorskip("pytest_rerunfailures")
    (tmp_path / "test_mine.py").write_text(
        "tries = []\n\ndef test_second_try(radar):\n    radar.ping()\n"
        "    tries.append(radar)\n    assert len(tries) == 2\n"
        "    assert tries[0] is not radar\n"
    )
    done = run(tmp_path, "--radar", address, "--reruns", "1", "--hil-keep", "all")
    assert done.returncode == 0, done.stdout
    assert "1 passed, 1 rerun" in done.stdout
    kept = sorted(path.name.rpartition("-")[2] for path in (tmp_path / "hil-artifacts").iterdir())
    assert len(kept) == 2
    assert kept[1] == "try2"


@pytest.mark.rare
def test_two_real_radars_are_tested_at_the_same_time(tmp_path: Path) -> None:
    """Each test waits for the other radar's, so one worker alone would never end."""
    (tmp_path / "test_mine.py").write_text(
        "import os\nfrom pathlib import Path\nfrom hil_tests.patience import wait_until\n\n"
        "def test_meets(radar, radar_name):\n"
        "    here = Path(os.environ['MEET'])\n    (here / radar_name).touch()\n"
        "    wait_until(lambda: len(list(here.iterdir())) == 2)\n"
    )
    (meet := tmp_path / "meet").mkdir()
    with emulator("serve", "--bare", "--count", "2", "--tcp", "0") as served:
        radars = [w for port in served.tcp_ports for w in ("--radar", f"tcp://127.0.0.1:{port}")]
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("MEET", str(meet))
            done = run(tmp_path, *radars, "-n", "2")
    assert done.returncode == 0, done.stdout
    assert "2 passed" in done.stdout
