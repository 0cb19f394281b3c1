"""``xethru decode`` on the golden vectors and on bad input."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from hil_tests.golden.test_protocol_vectors import KNOWN
from hil_tests.golden.vectors import ABOUT, Vector, load
from hil_tests.unit.xethru_protocol.scripted import framed
from xethru_protocol.cli import main

VECTORS = load()
PING = "7D 01 AE EA AA EE 7C 7E"
ACK = bytes.fromhex("7D 10 6D 7E")


def decoded(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, lines: list[str], *options: str
) -> list[dict[str, Any]]:
    file = tmp_path / "bytes.txt"
    file.write_text("\n".join(lines) + "\n")
    assert main(["decode", "--hex", *options, str(file)]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    return [json.loads(line) for line in out.splitlines()]


def fields_of(vector: Vector) -> dict[str, Any]:
    fields = {key: value for key, value in vector.decoded.items() if key not in ABOUT}
    if vector.name == "reply_system_test_x4_conn_pass":
        fields["values"] = [1, *[0] * 255]
    if vector.name == "data_float_baseband_181bins":
        fields["data"] = [(k - 90) / 1024 for k in range(362)]
    return fields


@pytest.mark.parametrize("explicit", [False, True], ids=["auto", "from"])
def test_every_known_vector_in_both_directions(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, explicit: bool
) -> None:
    for from_host in (True, False):
        vectors = [v for v in KNOWN if v.from_host is from_host]
        options = ["--from", "host" if from_host else "module"] if explicit else []
        objects = decoded(capsys, tmp_path, [v.wire.hex(" ") for v in vectors], *options)
        assert len(objects) == len(vectors)
        for vector, found in zip(vectors, objects, strict=True):
            assert found["message"] == vector.message, vector.name
            assert found["fields"] == fields_of(vector), vector.name
            assert found["framing"] == vector.decoded["framing"], vector.name
            assert list(found) == ["framing", "payload_hex", "message", "fields"]
            if vector.payload is not None:
                assert bytes.fromhex(found["payload_hex"]) == vector.payload


def test_corrupted_packet_is_a_fault(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    corrupted = PING.replace("EA", "EB", 1)
    assert decoded(capsys, tmp_path, [corrupted]) == [{"fault": "wrong checksum", "offset": 0}]
    assert decoded(capsys, tmp_path, [PING[:-3]]) == [
        {"fault": "packet cut off by the end of the data", "offset": 0}
    ]


@pytest.mark.parametrize(
    ("payload", "sender", "message"),
    [
        ("10", "auto", "ACK"),
        ("10", "host", "UNKNOWN"),
        ("10 10 1C 0A A1 96 CD CC CC 3E 00 00 A0 40", "auto", "APP_SET DETECTION_ZONE"),
        ("10 10 99 99 99 99 01", "auto", "UNKNOWN"),
        ("10 10 99 99 99 99 01", "module", "ACK"),
    ],
)
def test_an_ack_is_its_code_alone(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, payload: str, sender: str, message: str
) -> None:
    wire = framed(bytes.fromhex(payload))
    (found,) = decoded(capsys, tmp_path, [wire.hex()], "--from", sender)
    assert found["message"] == message


def test_statistics_are_one_json_object_on_standard_error(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    file = tmp_path / "bytes"
    unknown = framed(b"\x99\x01")
    file.write_bytes(ACK + b"\x00\x01" + bytes.fromhex("7D 10 6C 7E") + unknown + ACK)
    assert main(["decode", "--statistics", str(file)]) == 0
    out, err = capsys.readouterr()
    assert len(out.splitlines()) == 5  # two ACK, one unknown; two faults
    assert json.loads(err) == {
        "bytes": 19,
        "packets": 3,
        "junk_bytes": 6,
        "resyncs": 1,
        "checksum_failures": 1,
        "unknown": 1,
        "frames_lost": 0,
        "off_lattice_samples": 0,
        "faults": {"bytes between packets": 1, "wrong checksum": 1},
    }


def test_lines_are_streams_of_their_own(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    found = decoded(capsys, tmp_path, ["7C 7C 7C 7C 1A 00 00 00 00 A0 12", "", PING])
    assert [item.get("message", item.get("fault")) for item in found] == [
        "packet cut off by the end of the data",
        "PING",
    ]


def test_not_a_number_is_still_json(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    nan = "7C 7C 7C 7C 12 00 00 00 00 A0 12 00 00 00 00 01 00 00 00 01 00 00 00 00 00 C0 7F"
    (found,) = decoded(capsys, tmp_path, [nan])
    assert found["fields"]["data"] == ["NaN"]


def test_packets_are_printed_as_they_come() -> None:
    command = [sys.executable, "-m", "xethru_protocol.cli", "decode"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(ACK)
        process.stdin.flush()
        assert json.loads(process.stdout.readline())["message"] == "ACK"  # input is still open
        process.stdin.close()
        assert process.wait() == 0
