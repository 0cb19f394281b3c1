"""What `xethru record` made, `dump` prints and `xethru-emulator play` sends, byte for byte."""

import json
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from hil_tests.device.emulator_process import emulator
from hil_tests.patience import seconds, wait_until
from hil_tests.unit.xethru_protocol.recordings.messages import dumped, xethru
from xethru_protocol.cli import main
from xethru_protocol.recordings import recording_facts

pytestmark = pytest.mark.slow

Capture = pytest.CaptureFixture[str]
XETHRU = [sys.executable, "-m", "xethru_protocol.cli"]
FRAMES = 30
SERVED = ("serve", "smoke", "--pace", "asap")


@pytest.fixture(autouse=True)
def own_run_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


def payloads(messages: Sequence[dict[str, Any]]) -> list[str]:
    return [message["payload_hex"] for message in messages]


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param([], id="rf"),
        pytest.param(["--baseband"], id="baseband", marks=pytest.mark.thorough),
    ],
)
def test_identical_messages(kind: list[str], tmp_path: Path, capsys: Capture) -> None:
    first, listened, again = (tmp_path / name for name in ("first", "listened", "again"))
    count = ("--count", str(FRAMES))
    with emulator(*SERVED) as served:
        xethru(capsys, "record", "--port", served.paths[0], "--out", first, *count, *kind)
    messages = dumped(capsys, first)
    assert len(messages) == FRAMES
    assert [message["fields"]["info"] for message in messages] == list(range(1, FRAMES + 1))
    assert len(set(payloads(messages))) == FRAMES

    with emulator("play", first, "--rate", "0") as played:
        port = played.paths[0]
        xethru(capsys, "record", "--port", port, "--out", listened, *count, "--profile", "none")
        xethru(capsys, "record", "--port", port, "--out", again, *count, *kind)
        lines = xethru(capsys, "stream", "--port", port, *count, *kind, "--samples").splitlines()
    for copy in (listened, again):
        assert payloads(dumped(capsys, copy)) == payloads(messages)
    for frame, message in zip(map(json.loads, lines), messages, strict=True):
        assert frame["counter"] == message["fields"]["info"]
        samples = frame["i"] + frame["q"] if kind else frame["samples"]
        assert samples == message["fields"]["data"]


def test_wire_capture_holds_the_same_messages(tmp_path: Path, capsys: Capture) -> None:
    vendor, wire = tmp_path / "vendor", tmp_path / "port.xtwire"
    with emulator(*SERVED) as served:
        port = served.paths[0]
        xethru(
            capsys,
            "record",
            "--port",
            port,
            "--out",
            vendor,
            "--wire",
            wire,
            "--count",
            str(FRAMES),
        )
    messages = dumped(capsys, vendor)
    heard = [message for message in dumped(capsys, wire) if message["message"] == "DATA FLOAT"]
    assert payloads(heard)[:FRAMES] == payloads(messages)
    assert all(
        abs(one["t_ns"] - other["t_ns"]) < 10**9
        for one, other in zip(heard[:FRAMES], messages, strict=True)
    )


@pytest.mark.rare
def test_outputs_of_a_profile(tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "recording"
    outputs = "iq,ap,single,movinglist,pulsedoppler,noisemap"
    setup = ["--zone", "0.4", "5", "--sensitivity", "5", "--output", outputs]
    with emulator("serve", "visitor", "--pace", "asap") as served:
        command = ["record", "--port", served.paths[0], "--out", str(out), "--profile", "presence"]
        assert main([*command, *setup, "--count", "600"]) == 0
    errors = capsys.readouterr().err
    assert "outputs iq and ap exclude each other; the module sends ap" in errors
    kinds = {message["message"] for message in dumped(capsys, out)}
    # a noise map is sent when it is made, two minutes after the start
    assert kinds == {
        "BASEBAND_AP",
        "PRESENCE_SINGLE",
        "PRESENCE_MOVINGLIST",
        "PULSEDOPPLER_FLOAT",
    }


@pytest.mark.rare
def test_respiration_of_an_x4m200(tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "recording"
    setup = ["--profile", "respiration", "--output", "status,movinglist", "--zone", "0.4", "2"]
    with emulator("serve", "--bare", "--model", "x4m200", "--pace", "asap") as served:
        command = ["record", "--port", served.paths[0], "--out", str(out)]
        assert main([*command, *setup, "--count", "4"]) == 0
        # what an X4M300 has and this one has not
        capsys.readouterr()
        assert main([*command, "--profile", "presence", "--force"]) == 1
    assert "does not load the profile presence, which an X4M300 has" in capsys.readouterr().err
    messages = dumped(capsys, out)
    assert [message["message"] for message in messages] == [
        *("RESP_STATUS", "RESPIRATION_MOVINGLIST"),
        *("RESP_STATUS", "RESPIRATION_MOVINGLIST"),
    ]
    facts = recording_facts(out)
    assert facts.profile_id == 0x064E57AD
    assert facts.parameter_file


@pytest.mark.rare
def test_unplugging_keeps_what_came(tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / "recording"
    with emulator(*SERVED) as served:
        command = [*XETHRU, "record", "--port", served.paths[0], "--out", str(out)]
        with subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as process:
            files = "xethru_datafloat_*"
            wait_until(
                lambda: any(path.stat().st_size > 50_000 for path in out.glob(files)), process
            )
            served.process.kill()
            printed, errors = process.communicate(timeout=seconds(10))
    assert (process.returncode, printed) == (1, "")
    (line,) = errors.splitlines()
    assert line.startswith(f"xethru record: {served.paths[0]} was disconnected")
    kept = re.search(rf"; kept (\d+) messages in {out}$", line)
    assert kept
    counters = [message["fields"]["info"] for message in dumped(capsys, out)]
    assert counters == list(range(1, int(kept[1]) + 1))
