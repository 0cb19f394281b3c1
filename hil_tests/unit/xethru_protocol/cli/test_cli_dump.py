"""``xethru dump`` and ``convert`` on recordings that the vendor's own library wrote."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hil_tests.unit.emulator.test_playback_control import samples, write_session
from hil_tests.unit.xethru_protocol.recordings.messages import RECORDINGS, dumped, write_capture
from hil_tests.unit.xethru_protocol.scripted import framed
from xethru_protocol.cli import main
from xethru_protocol.recordings import RecordingError, convert, read_recording
from xethru_protocol.wire import messages as m

Capture = pytest.CaptureFixture[str]
IQ = RECORDINGS / "iq"
IQ_FILE = "xethru_baseband_iq_20261121_003557.dat"


def test_arrays_are_cut_unless_asked_for(capsys: Capture) -> None:
    assert main(["dump", str(IQ)]) == 0
    short = capsys.readouterr().out
    assert "range_offset=0.4 i=[0.044, 0.088, 0.132, ... 10 in all] q=[-0.088, " in short
    assert main(["dump", str(IQ), "--samples"]) == 0
    whole = capsys.readouterr().out
    assert "i=[0.044, 0.088, 0.132, 0.176, 0.22, 0.264, 0.308, 0.352, 0.396, 0.44] q=[" in whole
    assert "in all" not in whole


def test_as_json_each_message_has_the_shape_of_decode_and_its_time(capsys: Capture) -> None:
    messages = dumped(capsys, IQ)
    assert len(messages) == 40
    # protocol reference 7.1: 50, id 0C, counter 44, 10 bins, then the floats; 1 + 4 + 24 + 80 bytes
    first = messages[0]
    assert first["payload_hex"].startswith("50 0C 00 00 00 2C 00 00 00 0A 00 00 00")
    assert len(bytes.fromhex(first["payload_hex"])) == 109
    assert (first["framing"], first["message"]) == ("noescape", "BASEBAND_IQ")
    assert first["t_ns"] == 1795221357928 * 1_000_000
    assert first["fields"]["counter"] == 44
    assert list(first) == ["framing", "payload_hex", "message", "fields", "t_ns"]
    np.testing.assert_allclose(first["fields"]["i"], np.arange(1, 11) * 0.044, rtol=1e-6)


def test_decode_reads_the_payloads_that_dump_prints(tmp_path: Path, capsys: Capture) -> None:
    """Framed by hand, as reference 1.1 says, `decode` shows of them what `dump` did."""
    messages = dumped(capsys, RECORDINGS / "single")
    assert {message["framing"] for message in messages} == {"normal"}
    packets = [framed(bytes.fromhex(message["payload_hex"])) for message in messages[:5]]
    file = tmp_path / "packets"
    file.write_text("\n".join(packet.hex() for packet in packets))
    assert main(["decode", "--hex", str(file)]) == 0
    decoded = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert decoded == [
        {key: value for key, value in message.items() if key != "t_ns"} for message in messages[:5]
    ]


def test_a_damaged_recording_is_read_as_far_as_it_goes(tmp_path: Path, capsys: Capture) -> None:
    cut = tmp_path / "cut"
    shutil.copytree(IQ, cut)
    data = (cut / IQ_FILE).read_bytes()
    (cut / IQ_FILE).write_bytes(data[:-50])
    for option in ([], ["--json"]):
        assert main(["dump", str(cut), *option]) == 1
        printed, errors = capsys.readouterr()
        assert (
            sum('BASEBAND_IQ"' in line or " counter=" in line for line in printed.split("\n")) == 39
        )
        assert errors == (
            f"xethru dump: {IQ_FILE}: the last record is cut: 54 bytes of it are there "
            "(at byte 4056)\n"
        )


def test_answers_and_unknown_messages_in_a_wire_capture(tmp_path: Path, capsys: Capture) -> None:
    wire = tmp_path / "port.xtwire"
    unknown = m.UnknownMessage(code=0x77, payload=b"\x77" * 50)
    frame = m.DataFloat(info=1, values=np.array([np.nan, np.inf]))
    write_capture(wire, [(m.Ack(), 2_000_000_000), (unknown, 2_000_000_001), (frame, None)])
    assert main(["dump", str(wire)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-3] == "    0.000000  ACK"
    assert lines[-2].startswith("    0.000000  UNKNOWN code=119 payload=77 77 77")
    assert lines[-2].endswith("...")
    assert lines[-1].startswith("           -  DATA FLOAT")
    found = dumped(capsys, wire)
    assert [message["t_ns"] for message in found] == [2_000_000_000, 2_000_000_001, None]
    assert found[1]["payload_hex"] == " ".join(["77"] * 50)
    assert found[2]["fields"]["data"] == ["NaN", "Infinity"]


# --- convert --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["c.mcap", "c.xtwire", "c"])
def test_every_format_gives_the_same_messages_back(
    name: str, tmp_path: Path, capsys: Capture
) -> None:
    """Of other recordings, see `test_vendor_recordings_survive_every_way_around`."""
    target = tmp_path / name
    assert main(["convert", str(IQ), str(target)]) == 0
    assert capsys.readouterr() == (f"{target}: 40 messages\n", "")
    assert dumped(capsys, target) == dumped(capsys, IQ)


def test_a_target_is_overwritten_only_with_force(tmp_path: Path, capsys: Capture) -> None:
    for name in ("c.mcap", "c"):
        target = tmp_path / name
        assert main(["convert", str(IQ), str(target)]) == 0
        assert main(["convert", str(RECORDINGS / "single"), str(target)]) == 1
        assert capsys.readouterr().err.count("\n") == 1
        assert len(dumped(capsys, target)) == 40
        assert main(["convert", str(RECORDINGS / "single"), str(target), "--force"]) == 0
        capsys.readouterr()
        assert {message["message"] for message in dumped(capsys, target)} == {"PRESENCE_SINGLE"}


def test_what_was_left_out_and_what_was_damaged_is_reported(
    tmp_path: Path, capsys: Capture
) -> None:
    wire = tmp_path / "port.xtwire"
    frame = m.DataFloat(info=1, values=np.zeros(8, np.float32))
    write_capture(wire, [(m.Ack(), 10**18), (frame, 10**18), (frame, 10**18)])
    wire.write_bytes(wire.read_bytes()[:-4])
    assert main(["convert", str(wire), str(tmp_path / "c"), "--json"]) == 1
    printed, errors = capsys.readouterr()
    result = json.loads(printed)
    assert (result["messages"], result["skipped"]) == (1, {"ACK": 1})
    assert [fault["file"] for fault in result["faults"]] == ["port.xtwire"]
    assert "1 ACK left out: the format has no place for them" in errors
    assert "the last chunk is cut" in errors


def test_a_conversion_that_fails_leaves_nothing(
    tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(source: object, target: str, show: object, **given: object) -> None:
        Path(target).write_bytes(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr("xethru_protocol.cli.recordings.convert_recording", stopped)
    assert main(["convert", str(IQ), str(tmp_path / "c.mcap")]) == 130
    assert list(tmp_path.iterdir()) == []


def test_of_hundreds_of_faults_some_are_reported(tmp_path: Path, capsys: Capture) -> None:
    (tmp_path / "xethru_sleep_20261121_003557.csv").write_bytes(b"no;such;row\n" * 200)
    for command in (["dump", str(tmp_path)], ["convert", str(tmp_path), f"{tmp_path}.mcap"]):
        assert main(command) == 1
        lines = capsys.readouterr().err.splitlines()
        assert len([line for line in lines if "a line cannot be read" in line]) < 11
        assert lines[-1].startswith(f"xethru {command[0]}: and ")
        assert lines[-1].endswith(" faults more")


def test_a_pipe_is_not_waited_for(tmp_path: Path, capsys: Capture) -> None:
    os.mkfifo(tmp_path / "pipe")
    for command in (["dump", f"{tmp_path}/pipe"], ["convert", f"{tmp_path}/pipe", "target.mcap"]):
        assert main(command) == 1
        assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("name", ["copy.mcap", "copy"])
def test_a_conversion_that_fails_brings_the_older_one_back(
    name: str, tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / name
    assert main(["convert", str(RECORDINGS / "single"), str(target)]) == 0
    before = snapshot(tmp_path)

    def fails(source: str, target: str, on_progress: object, **given: object) -> None:
        convert(IQ, target)
        raise RecordingError("the disk is full")

    with monkeypatch.context() as patched:
        patched.setattr("xethru_protocol.cli.recordings.convert_recording", fails)
        assert main(["convert", str(IQ), str(target), "--force"]) == 1
    assert snapshot(tmp_path) == before
    assert main(["convert", str(IQ), str(target), "--force"]) == 0
    after = snapshot(tmp_path)
    assert after != before
    assert not [path for path in after if path.name.endswith(".old")]


@pytest.mark.parametrize(
    "name", [pytest.param("new/copy.mcap", marks=pytest.mark.rare), "new/copy"]
)
def test_a_conversion_that_is_killed_leaves_the_older_one_and_no_half_of_its_own(
    name: str, tmp_path: Path
) -> None:
    code = (
        "import os, sys\n"
        "from xethru_protocol.cli import main, recordings\n"
        "convert = recordings.convert_recording\n"
        "def killed(*arguments, **options):\n"
        "    convert(*arguments, **options)\n"
        "    os.kill(os.getpid(), 9)\n"
        "recordings.convert_recording = killed\n"
        "main(sys.argv[1:])\n"
    )
    target = tmp_path / name
    target.parent.mkdir()
    command = ["convert", str(RECORDINGS / "single"), str(target)]
    for _ in range(2):
        before = snapshot(tmp_path)
        killed = subprocess.run([sys.executable, "-c", code, *command, "--force"], check=False)
        assert killed.returncode == -9
        after = snapshot(tmp_path)
        assert all(after[path] == content for path, content in before.items())
        assert all(
            ".unfinished" in str(path.relative_to(tmp_path)) for path in after.keys() - before
        )
        assert main([*command, "--force"]) == 0
        assert len(list(read_recording(target))) == 40
        assert not list(tmp_path.rglob(".unfinished*"))


@pytest.mark.parametrize(
    "n_renamed", [1, *(pytest.param(number, marks=pytest.mark.rare) for number in (0, 2))]
)
def test_a_conversion_that_is_killed_between_renames_leaves_one_of_both_files(
    n_renamed: int, tmp_path: Path
) -> None:
    code = (
        "import os, pathlib, sys\n"
        "from xethru_protocol.cli import main\n"
        "rename, renamed = pathlib.Path.replace, []\n"
        "def killed(path, target):\n"
        "    if len(renamed) == int(sys.argv[1]):\n"
        "        os.kill(os.getpid(), 9)\n"
        "    renamed.append(path)\n"
        "    return rename(path, target)\n"
        "pathlib.Path.replace = killed\n"
        "sys.exit(main(sys.argv[2:]))\n"
    )
    target = tmp_path / "kept.mcap"
    assert main(["convert", str(IQ), str(target)]) == 0
    command = ["convert", str(RECORDINGS / "single"), str(target), "--force"]
    subprocess.run([sys.executable, "-c", code, str(n_renamed), *command], check=False)
    assert len(list(read_recording(target))) == 40


def test_a_part_of_a_recording_is_not_converted_into_it(tmp_path: Path, capsys: Capture) -> None:
    own = tmp_path / "own"
    shutil.copytree(IQ, own)
    before = snapshot(own)
    (tmp_path / "link").symlink_to(own)
    for source in (own, own / IQ_FILE, own / "xethru_recording_meta.dat"):
        for target in (own, tmp_path / "link"):
            assert main(["convert", str(source), str(target), "--force"]) == 1
    assert snapshot(own) == before
    assert main(["convert", str(own), str(tmp_path / "copy.mcap")]) == 0
    assert main(["convert", str(tmp_path / "copy.mcap"), str(tmp_path)]) == 0


def snapshot(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_one_radar_of_a_session_is_dumped_and_converted(tmp_path: Path, capsys: Capture) -> None:
    session = tmp_path / "session.mcap"
    write_session(session, {name: 10**9 for name in ("left", "middle", "right")}, n_frames=3)
    expected = [samples(1, counter).tolist() for counter in range(3)]
    assert main(["dump", str(session), "--radar", "middle", "--json"]) == 0
    told = [json.loads(line)["fields"] for line in capsys.readouterr().out.splitlines()]
    assert [fields["data"] for fields in told] == [pytest.approx(row) for row in expected]
    assert main(["dump", str(session), "--radar", "middle"]) == 0
    assert "  3 DATA FLOAT" in capsys.readouterr().out.splitlines()
    target = session.with_suffix(".xtwire")
    assert main(["convert", str(session), str(target), "--radar", "middle"]) == 0
    rows = [
        message.values.tolist()
        for message, _ in read_recording(target)
        if isinstance(message, m.DataFloat)
    ]
    assert rows == expected
