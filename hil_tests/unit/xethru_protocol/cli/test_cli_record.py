"""``xethru record`` with scripted modules: what is written, when it ends, what it says."""

import io
import itertools
import json
import re
import subprocess
import sys
import uuid
from collections.abc import Sequence
from pathlib import Path

import pytest

from hil_tests.unit.full_disk import child_on_full_disk
from hil_tests.unit.xethru_protocol.emulated import EmulatedModule
from hil_tests.unit.xethru_protocol.pty_module import PtyModule, Said, silent
from hil_tests.unit.xethru_protocol.recordings.messages import counters
from hil_tests.unit.xethru_protocol.scripted import frame
from xethru_protocol.cli import main
from xethru_protocol.cli.output import Progress
from xethru_protocol.cli.record.modes import RawFrames
from xethru_protocol.cli.record.session import Session
from xethru_protocol.recordings import (
    describe_recording,
    read_note,
    read_recording,
    recording_facts,
)
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import (
    FileType,
    InfoItem,
    OutputFeature,
    ProfileId,
    SensorMode,
    X4Setting,
)

Capture = pytest.CaptureFixture[str]
PRESENCE = m.PresenceSingle(counter=3, state=1, distance_m=1.5, direction=0, signal_quality=7)


def test_count_is_kept_to_the_message(module: PtyModule, tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "new" / "recording"
    assert main(["record", "--port", module.path, "--out", str(out), "--count", "5"]) == 0
    assert counters(out) == [0, 1, 2, 3, 4]
    printed, errors = capsys.readouterr()
    assert printed.startswith(f"{out}: 5 messages in ")
    assert printed.endswith(", 0 lost\n")
    assert errors == ""
    stop = m.X4DriverSet(setting=X4Setting.FPS, value=0.0)
    assert module.received[-2:] == [stop, m.SetMode(mode=SensorMode.XTID_SM_STOP)]


def test_duration_ends_it(
    module: PtyModule, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    of_the_frames = property(lambda session: 0.05 * session.modules[0].recorded)
    monkeypatch.setattr(Session, "elapsed_s", of_the_frames)
    out = tmp_path / "recording"
    arguments = ["--out", str(out), "--duration", "0.3", "--json", "--session-id", "first try"]
    assert main(["record", "--port", module.path, *arguments]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["ended_by"] == "duration"
    assert summary["directory"] == str(out)
    assert summary["wire"] is None
    assert counters(out) == list(range(summary["messages"]))
    assert summary["messages"] >= 6
    assert summary["link"]["frames_lost"] == 0
    assert b"first try" in (out / "xethru_recording_meta.dat").read_bytes()


def test_a_recording_is_overwritten_only_with_force(
    module: PtyModule, tmp_path: Path, capsys: Capture
) -> None:
    out, wire = tmp_path / "recording", tmp_path / "port.xtwire"
    command = ["record", "--port", module.path, "--out", str(out), "--wire", str(wire)]
    assert main([*command, "--count", "2"]) == 0
    before = {path: path.read_bytes() for path in [*out.iterdir(), wire]}
    asked = len(module.received)
    (out / "notes.txt").write_text("mine")
    capsys.readouterr()

    for only in (command[:5], [*command[:3], *command[5:]]):
        assert main([*only, "--count", "2"]) == 1
    assert len(module.received) == asked, "the module was left alone"
    assert {path: path.read_bytes() for path in before} == before

    assert main([*command, "--count", "3", "--force"]) == 0
    assert len(counters(out)) == 3
    assert len(list(out.glob("xethru_datafloat_*"))) == 1
    assert (out / "notes.txt").read_text() == "mine"


def test_force_takes_a_file_for_no_directory_and_back(tmp_path: Path, capsys: Capture) -> None:
    file, directory = tmp_path / "thesis", tmp_path / "recording"
    file.write_text("years of work")
    directory.mkdir()
    (directory / "xethru_recording_meta.dat").touch()
    for option, path in (("--out", file), ("--wire", directory)):
        assert main(["record", "--port", "p", option, str(path), "--force"]) == 1
    assert file.read_text() == "years of work"
    assert len(list(directory.iterdir())) == 1


def test_a_module_that_does_not_answer_costs_no_older_recording(
    module: PtyModule, tmp_path: Path, capsys: Capture
) -> None:
    out = tmp_path / "recording"
    assert main(["record", "--port", module.path, "--out", str(out), "--count", "2"]) == 0
    before = {path: path.read_bytes() for path in out.iterdir()}
    assert main(["record", "--port", str(tmp_path / "none"), "--out", str(out), "--force"]) == 1
    with PtyModule(silent) as deaf:
        assert main(["record", "--port", deaf.path, "--out", str(out), "--force"]) == 1
    assert {path: path.read_bytes() for path in out.iterdir()} == before


def test_a_file_that_cannot_be_made_leaves_nothing(
    module: PtyModule, tmp_path: Path, capsys: Capture
) -> None:
    out, wire = tmp_path / "recording", tmp_path / "none" / "port.xtwire"
    arguments = ["--out", str(out), "--wire", str(wire)]
    assert main(["record", "--port", module.path, *arguments]) == 1
    assert main(["record", "--port", str(tmp_path / "no port"), "--out", str(out)]) == 1
    assert list(tmp_path.iterdir()) == []


def test_a_wire_capture_within_the_directory(module: PtyModule, tmp_path: Path) -> None:
    out = tmp_path / "recording"
    arguments = ["--out", str(out), "--wire", str(out / "port.xtwire")]
    assert main(["record", "--port", module.path, *arguments, "--count", "2"]) == 0
    assert counters(out) == [0, 1]
    assert counters(out / "port.xtwire")[:2] == [0, 1]


def test_the_wire_alone(module: PtyModule, tmp_path: Path) -> None:
    wire = tmp_path / "port.xtwire"
    assert main(["record", "--port", module.path, "--wire", str(wire), "--count", "3"]) == 0
    assert counters(wire)[:3] == [0, 1, 2]
    assert read_note(wire) == {"port": module.path}
    # what the host sent is there, too: PING comes first (reference 4.1)
    assert bytes.fromhex("7D 01 AE EA AA EE") in wire.read_bytes()


def test_listening_sends_nothing(tmp_path: Path) -> None:
    out = tmp_path / "recording"
    with PtyModule(silent, unasked=frame(7)) as module:
        arguments = ["--out", str(out), "--profile", "none", "--count", "4"]
        assert main(["record", "--port", module.path, *arguments]) == 0
        assert module.received == []
    assert counters(out) == [7, 7, 7, 7]


def test_presence_is_loaded_run_and_recorded(tmp_path: Path, capsys: Capture) -> None:
    def answer(command: m.Message) -> Sequence[Said]:
        if isinstance(command, m.Ping):
            return [m.Pong(value=0xAAEEAEEA)]
        if isinstance(command, m.GetFileLength):
            return [m.Error(code=5)]  # not found: without a parameter file
        is_run = command == m.SetMode(mode=SensorMode.XTID_SM_RUN)
        return [m.Ack(), PRESENCE, PRESENCE] if is_run else [m.Ack()]

    out = tmp_path / "recording"
    with PtyModule(answer) as module:
        arguments = ["--out", str(out), "--profile", "presence", "--count", "2"]
        assert main(["record", "--port", module.path, *arguments]) == 0
        asked = [command for command in module.received if not isinstance(command, m.Ping)]
    assert asked == [
        m.SetMode(mode=SensorMode.XTID_SM_STOP),
        m.LoadApp(profile_id=ProfileId.XTS_ID_APP_PRESENCE_2),
        m.SystemGetInfo(item=InfoItem.XTID_SSIC_VERSIONLIST),  # whether it has files (17)
        m.GetFileLength(file_type=FileType.PARAMETER_FILE, identifier=0),
        m.SetMode(mode=SensorMode.XTID_SM_RUN),
    ]
    assert recording_facts(out).parameter_file is None
    messages = [message for message, _ in read_recording(out)]
    assert messages == [PRESENCE, PRESENCE]
    assert describe_recording(out).profile_id == 0x014D4AB8


def profile_module(received: EmulatedModule, *sent: m.Response) -> PtyModule:
    """Return an emulated module behind a port, which sends these when it is set running."""

    def answer(command: m.Message) -> Sequence[Said]:
        is_run = command == m.SetMode(mode=SensorMode.XTID_SM_RUN)
        return [*received(command), *(sent if is_run else ())]

    return PtyModule(answer)


def test_a_profile_is_set_up_as_asked(tmp_path: Path, capsys: Capture) -> None:
    emulated = EmulatedModule()
    emulated(m.LoadApp(profile_id=ProfileId.XTS_ID_APP_PRESENCE_2))
    emulated.module.files.replace((FileType.PARAMETER_FILE, 0), b"[Debug]\nlevel=0;\n")
    # a setting of before, which the module keeps
    emulated(m.OutputSetControl(feature=OutputFeature.PULSEDOPPLER_BYTE, control=1))
    out = tmp_path / "recording"
    setup = ["--output", "iq,movinglist,pulsedoppler,noisemap", "--zone", "0.4", "5"]
    with profile_module(emulated, PRESENCE) as module:
        arguments = ["--profile", "presence", *setup, "--sensitivity", "7", "--count", "1"]
        assert main(["record", "--port", module.path, "--out", str(out), *arguments]) == 0
    errors = capsys.readouterr().err
    assert re.fullmatch(
        r"xethru record: the detection zone is 0\.\d{3} \.\.\. [45]\.\d{3} m\n", errors
    )
    settings = emulated.module.profile
    assert {feature: control for feature, control in settings.outputs.items() if control} == {
        OutputFeature.BASEBAND_IQ: 1,
        OutputFeature.PRESENCE_MOVINGLIST: 1,
        OutputFeature.PULSEDOPPLER_FLOAT: 3,
        OutputFeature.NOISEMAP_FLOAT: 3,
    }
    assert settings.sensitivity == 7
    assert recording_facts(out).parameter_file == b"[Debug]\nlevel=0;\n"
    # the module snaps outward to its grid of 5.14 cm (4.4)
    assert settings.zone_m[0] <= 0.4
    assert 5.0 <= settings.zone_m[1] < 5.06


@pytest.mark.parametrize("firmware", ["sensor-1.0.7", "sensor-1.4.7"])
def test_old_firmware_records_what_it_can(tmp_path: Path, firmware: str) -> None:
    """Reference 17: 1.0.7 has no files, 1.4.7 none of the questions for outputs."""
    emulated = EmulatedModule(firmware=firmware, stopped=False)
    emulated(m.OutputSetControl(feature=OutputFeature.BASEBAND_IQ, control=1))
    with profile_module(emulated, PRESENCE) as module:
        arguments = ["--profile", "presence", "--output", "single", "--count", "1"]
        assert main(["record", "--port", module.path, "--out", str(tmp_path), *arguments]) == 0
    outputs = emulated.module.profile.outputs
    assert [feature for feature, control in outputs.items() if control] == [
        OutputFeature.PRESENCE_SINGLE
    ]


def test_outputs_that_exclude_each_other_are_warned_of(tmp_path: Path, capsys: Capture) -> None:
    emulated = EmulatedModule()
    with profile_module(emulated, PRESENCE) as module:
        arguments = ["--profile", "presence", "--output", "iq,ap,single", "--count", "1"]
        wire = ["--wire", str(tmp_path / "port.xtwire")]
        assert main(["record", "--port", module.path, *wire, *arguments]) == 0
    assert capsys.readouterr().err == (
        "xethru record: outputs iq and ap exclude each other; the module sends ap\n"
    )
    outputs = emulated.module.profile.outputs
    assert [feature for feature in OutputFeature if outputs.get(feature)] == [
        OutputFeature.PRESENCE_SINGLE,
        OutputFeature.BASEBAND_AMPLITUDE_PHASE,
    ]


def test_respiration_and_sleep_are_recorded_where_a_module_has_them(tmp_path: Path) -> None:
    sleep = m.SleepStatus(
        counter=1, state=0, rpm=14.5, distance_m=1.25, signal_quality=8, movement_slow=3.0,
        movement_fast=4.0,
    )  # fmt: skip
    asked: list[m.Message] = []

    def answer(command: m.Message) -> Sequence[Said]:
        asked.append(command)
        match command:
            case m.Ping():
                return [m.Pong(value=0xAAEEAEEA)]
            case m.OutputGetControl(feature=feature):
                return [m.ReplyInt(values=(int(feature == OutputFeature.RESP_STATUS),))]
            case m.SetMode(mode=SensorMode.XTID_SM_RUN):
                return [m.Ack(), sleep]
        return [m.Ack()]

    out = tmp_path / "recording"
    with PtyModule(answer) as module:
        arguments = ["--profile", "respiration", "--output", "sleep", "--count", "1"]
        assert main(["record", "--port", module.path, "--out", str(out), *arguments]) == 0
    assert m.LoadApp(profile_id=0x064E57AD) in asked
    assert [command for command in asked if isinstance(command, m.OutputSetControl)] == [
        m.OutputSetControl(feature=OutputFeature.RESP_STATUS, control=0),
        m.OutputSetControl(feature=OutputFeature.SLEEP_STATUS, control=1),
    ]
    assert [message for message, _ in read_recording(out)] == [sleep]


def test_a_module_without_the_profile_or_output_is_named(tmp_path: Path, capsys: Capture) -> None:
    def answer(command: m.Message) -> Sequence[Said]:
        match command:
            case m.Ping():
                return [m.Pong(value=0xAAEEAEEA)]
            case m.LoadApp(profile_id=0x064E57AD):
                return [m.Error(code=0x20)]
            case m.OutputSetControl():
                return [m.Error(code=0x21)]
            case m.OutputGetControl():
                return [m.ReplyInt(values=(0,))]
        return [m.Ack()]

    command = ["record", "--out", str(tmp_path / "recording"), "--count", "1", "--profile"]
    with PtyModule(answer) as module:
        assert main([*command, "respiration", "--port", module.path]) == 1
        errors = capsys.readouterr().err
        assert "does not load the profile respiration, which an X4M200 or X4M210 has: " in errors
        assert "error 32 (APP_INVALID)" in errors
        arguments = ["presence", "--output", "iq", "--port", module.path]
        assert main([*command, *arguments]) == 1
        assert "this module does not take output iq: " in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "arguments",
    [
        ["--profile", "presence", "--output", "sleep"],
        ["--profile", "respiration", "--output", "single"],
        ["--profile", "presence", "--output", "iq,radio"],
        ["--output", "iq"],
        ["--zone", "1", "2"],
        ["--profile", "none", "--sensitivity", "3"],
        ["--profile", "none", "--baseband"],
        ["--profile", "presence", "--frame-area", "1", "2"],
        ["--profile", "respiration", "--fps", "5"],
        ["--profile", "presence", "--zone", "3", "2"],
        ["--profile", "presence", "--sensitivity", "10"],
        ["--split-files", "10"],
        ["--split-files", "0s"],
        ["--split-directories", "daily@24"],
        ["--basename", "datafloat"],
        ["--basename", "datafloat=a/b"],
        ["--basename", "float=a"],
        ["--interval", "0"],
    ],
)
def test_options_that_make_no_sense_are_wrong_usage_and_named(
    arguments: list[str], tmp_path: Path, capsys: Capture
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["record", "--port", "p", "--out", str(tmp_path / "x"), *arguments])
    assert ended.value.code == 2
    message = capsys.readouterr().err.splitlines()[-1]
    assert any(word in message for argument in arguments for word in argument.split(","))


def test_options_of_the_format_need_a_directory(tmp_path: Path, capsys: Capture) -> None:
    for option in (["--new-directory"], ["--split-files", "1MB"], ["--interval", "1"]):
        with pytest.raises(SystemExit) as ended:
            main(["record", "--port", "p", "--wire", str(tmp_path / "x"), *option])
        assert ended.value.code == 2
        assert "options of the vendor's format need --out DIR" in capsys.readouterr().err


def test_files_are_split_named_and_headed(module: PtyModule, tmp_path: Path) -> None:
    out = tmp_path / "recording"
    options = ["--split-files", "2records", "--split-files", "1h", "--basename", "datafloat=lab"]
    arguments = [*options, "--user-header", "hütte", "--flush-on-write", "--count", "5"]
    assert main(["record", "--port", module.path, "--out", str(out), *arguments]) == 0
    files = sorted(out.glob("lab_2*.dat"))
    assert len(files) == 3
    assert len(list(out.iterdir())) == 5
    assert all(file.read_bytes().startswith("hütte".encode()) for file in files)
    assert counters(out) == [0, 1, 2, 3, 4]
    facts = recording_facts(out)
    assert facts.user_header == "hütte".encode()
    assert uuid.UUID(facts.session_id).version == 4
    # --force finds them by the index
    assert main(["record", "--port", module.path, "--out", str(out), "--count", "1"]) == 1
    arguments = ["--count", "1", "--force"]
    assert main(["record", "--port", module.path, "--out", str(out), *arguments]) == 0
    assert len(list(out.iterdir())) == 3


def test_directories_are_made_and_replaced(
    module: PtyModule, tmp_path: Path, capsys: Capture
) -> None:
    command = ["record", "--port", module.path, "--out", str(tmp_path), "--count", "3"]
    session = ["--session-id", "one", "--new-directory"]
    assert main([*command, *session, "--split-directories", "1records"]) == 0
    (out,) = tmp_path.iterdir()
    assert re.fullmatch(r"xethru_recording_\d{8}_\d{6}_one", out.name)
    assert capsys.readouterr().out.startswith(f"{out}: 3 messages")
    parts = sorted(path.name for path in out.iterdir())
    pattern = r"xethru_recording_\d{8}_\d{6}_one_"
    assert [re.sub(pattern, "", name) for name in parts] == ["xethru_radar.json", "0", "1", "2"]
    assert counters(out) == counters(tmp_path) == [0, 1, 2]
    command[4] = str(out)
    assert main(command) == 1
    assert main([*command, "--force"]) == 0
    assert sorted(path.suffix for path in out.iterdir()) == [".dat", ".dat", ".json"]


def test_an_interval_leaves_frames_out(module: PtyModule, tmp_path: Path) -> None:
    out = tmp_path / "recording"
    arguments = ["--interval", "0.02", "--count", "3"]
    assert main(["record", "--port", module.path, "--out", str(out), *arguments]) == 0
    times = [t_ns for _, t_ns in read_recording(out)]
    steps = [b - a for a, b in itertools.pairwise(times) if a is not None and b is not None]
    assert len(steps) == 2
    assert min(steps) >= 20_000_000 - 1_000_000


def test_nothing_to_record_leaves_nothing(tmp_path: Path, capsys: Capture) -> None:
    out, wire = tmp_path / "recording", tmp_path / "port.xtwire"
    with PtyModule(silent) as module:
        arguments = ["--out", str(out), "--wire", str(wire), "--profile", "none"]
        assert main(["record", "--port", module.path, *arguments, "--duration", "0.2"]) == 1
    assert list(tmp_path.iterdir()) == []


def test_a_module_that_falls_silent(
    module: PtyModule, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "recording"
    monkeypatch.setattr("xethru_protocol.cli.record.modes.RawFrames.start", lambda self, radar: 0.2)
    assert main(["record", "--port", module.path, "--out", str(out)]) == 1
    assert capsys.readouterr().err.count("\n") == 1


def test_a_full_disk_keeps_what_is_there(module: PtyModule, tmp_path: Path) -> None:
    out = tmp_path / "recording"
    command = [sys.executable, "-m", "xethru_protocol.cli", "record", "--port", module.path]
    result = subprocess.run(
        [*command, "--out", str(out), "--json"],
        capture_output=True,
        text=True,
        check=False,
        **child_on_full_disk(20_000),
    )
    assert result.returncode == 1
    (line,) = result.stderr.splitlines()
    assert "cannot be written: File too large; kept 3 messages in" in line
    assert json.loads(result.stdout)["ended_by"] == "failure"
    assert counters(out) == [0, 1, 2]
    assert describe_recording(out).faults == ()


# --- progress -------------------------------------------------------------------------------------


class Screen(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_progress_rewrites_one_line_on_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = Screen()
    monkeypatch.setattr(sys, "stderr", screen)
    times = iter([0.0, 0.05, 0.25, 0.3, 0.5, 0.6])
    progress = Progress("xethru record", lambda: next(times))
    for number in range(5):
        progress.show(f"{number} frames")
    progress.finish()
    assert screen.getvalue() == "\r1 frames\x1b[K\r3 frames\x1b[K\r4 frames\x1b[K\n"


def test_progress_is_a_line_now_and_then_elsewhere(capsys: Capture) -> None:
    times = iter([0.0, 5.0, 10.5, 15.0, 21.0])
    progress = Progress("xethru record", lambda: next(times))
    for number in range(4):
        progress.show(f"{number} frames")
    progress.finish()
    assert capsys.readouterr().err == "xethru record: 1 frames\nxethru record: 3 frames\n"


def test_an_error_that_nobody_expected_is_no_success(
    module: PtyModule, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def wait(*_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(RawFrames, "wait", wait)
    with pytest.raises(ZeroDivisionError):
        main(["record", "--port", module.path, "--out", str(tmp_path / "r"), "--duration", "5"])


def test_a_line_of_text_that_is_not_there_costs_no_older_file(
    module: PtyModule, tmp_path: Path, capsys: Capture
) -> None:
    older = tmp_path / "all.mcap"
    older.write_bytes(b"older")
    text = f"imu={tmp_path / 'none'}"
    port = f"a={module.path}"
    assert main(["record", "--port", port, "--text", text, "--out", str(older), "--force"]) == 1
    assert "none" in capsys.readouterr().err
    assert older.read_bytes() == b"older"
