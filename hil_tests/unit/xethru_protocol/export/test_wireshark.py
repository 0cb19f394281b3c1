"""Debian's tshark, with our dissector, reads every golden vector as the vector says."""

import contextlib
import json
import math
import re
import shutil
import struct
import subprocess
from pathlib import Path
from typing import Any

import pytest

from hil_tests.golden.vectors import ABOUT, Vector, load, load_hand_made
from hil_tests.paths import FIXTURES
from xethru_protocol.cli import main as xethru
from xethru_protocol.recordings import WireCapture
from xethru_protocol.wire.codes import ElementType, FramePostprocessing, X4Setting

VECTORS = [v for v in (*load(), *load_hand_made()) if v.valid and not v.is_stream]
# What a dump computes from other fields or what identifies the message.
DERIVED = {"code_name", "mode_name", "decompressed", "image_checksum", "data_len", "sub_code"}
NAMELESS = {"doc_noescape_example", "opcode_unknown_EE", "bl_unknown_command"}
ENUMS = {member.name: member.value for member in (*X4Setting, *FramePostprocessing)}
ENUMS |= {kind.name.removeprefix("XTS_SPRD_").lower(): kind.value for kind in ElementType}
HEAD = "4d3cb2a1 0200 0400 00000000 00000000 00000400 93000000"


def converted(path: Path, pieces: list[tuple[str, bytes, int]]) -> Path:
    with WireCapture(path / "line.xtwire") as capture:
        for way, data, t_ns in pieces:
            capture.write("rx" if way == "rx" else "tx", data, t_ns)
    assert xethru(["convert", str(path / "line.xtwire"), str(path / "line.pcap")]) == 0
    return path / "line.pcap"


def dissected(capture: Path) -> list[dict[str, Any]]:
    layers = json.loads(tshark(capture, "-T", "json", "--no-duplicate-keys"))
    return [packet["_source"]["layers"]["xethru"] for packet in layers]


def tshark(capture: Path, *options: str) -> str:
    program = shutil.which("tshark")
    if program is None:
        pytest.skip("tshark is not installed: apt-get install tshark")
    script = capture.with_name("xethru.lua")
    assert xethru(["export", "wireshark", "--out", str(script)]) == 0
    command = [program, "-X", f"lua_script:{script}", "-r", str(capture), *options]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def expected_fields(vector: Vector) -> dict[str, Any]:
    """Return the vector's fields that are on the wire behind the identifying bytes."""
    found = {key: value for key, value in vector.decoded.items() if key not in ABOUT | DERIVED}
    if vector.name == "reply_system_test_x4_conn_pass":
        found["values"] = [1, *[0] * 255]
    if vector.message == "BOOTLOADER error":
        del found["code"]  # the identifying byte itself
    if found.get("length") == 0:
        del found["length"]  # it may be absent then
    return found


def same(shown: Any, expected: Any) -> bool:  # noqa: ANN401, PLR0911 - any JSON value, a return per type
    """Whether tshark's value, text or a list of texts, is the vector's; bytes are 01:0a."""
    if shown is None or shown == "" or expected is None:
        return not shown and expected in (None, [], "")
    if isinstance(expected, list):
        if isinstance(shown, str) and len(shown) == 3 * len(expected) - 1:
            with contextlib.suppress(ValueError):
                if list(bytes.fromhex(shown.replace(":", ""))) == expected:
                    return True
        values = shown if isinstance(shown, list) else [shown]
        return len(values) == len(expected) and all(map(same, values, expected))
    if isinstance(expected, float) or expected in {"NaN", "Infinity", "-Infinity"}:
        number, wanted = float(shown), float(expected)
        return math.isclose(number, wanted, rel_tol=1e-5) or math.isnan(number + wanted)
    if isinstance(expected, int):
        if ":" in shown:
            return int.from_bytes(bytes.fromhex(shown.replace(":", "")), "little") == expected
        return math.isclose(float(shown), expected, rel_tol=0 if shown.isdigit() else 1e-5)
    if expected.startswith("0x"):
        return int(shown) == int(expected, 16)
    if expected in ENUMS and shown.isdigit():
        return bool(int(shown) == ENUMS[expected])
    if expected in {shown, shown.replace(":", " ").upper()}:
        return True
    return ":" in shown and bytes.fromhex(shown.replace(":", "")).decode("latin-1") == expected


def test_every_vector_is_shown_with_its_name_and_fields(tmp_path: Path) -> None:
    pieces = [("tx" if v.from_host else "rx", v.wire, n) for n, v in enumerate(VECTORS)]
    found = dissected(converted(tmp_path, pieces))
    assert len(found) == len(VECTORS)
    wrong = []
    for vector, layer in zip(VECTORS, found, strict=True):
        if vector.name in NAMELESS:
            assert layer["xethru.message"] == "UNKNOWN" or "malformed" in json.dumps(layer)
            continue
        if layer["xethru.message"] != vector.message:
            wrong.append(f"{vector.name}: {layer['xethru.message']}")
        shown = {
            key.removeprefix("xethru.").split(".")[1]: value
            for key, value in layer.items()
            if key.count(".") > 1
        }
        wrong += [
            f"{vector.name}.{key}: {shown.get(key)} != {value}"
            for key, value in expected_fields(vector).items()
            if not same(shown.get(key), value)
        ]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize(("message", "field"), [("SETMODE", "mode"), ("SYSTEM", "code")])
def test_values_have_the_names_of_the_vectors(message: str, field: str, tmp_path: Path) -> None:
    named = [v for v in VECTORS if v.message == message and v.decoded.get(f"{field}_name")]
    pieces = [("tx" if v.from_host else "rx", v.wire, n) for n, v in enumerate(named)]
    shown = tshark(converted(tmp_path, pieces), "-V")
    found = re.findall(rf"^    {field}: (\w+) ", shown, re.MULTILINE)
    assert len(found) == len(named) > 1
    for name, vector in zip(found, named, strict=True):  # which leaves the prefix out
        assert name.endswith(f"_{vector.decoded[f'{field}_name']}")


def test_a_pcap_has_the_bytes_of_its_format(tmp_path: Path) -> None:
    """Expected bytes by hand from the pcap format: nanoseconds, link type 147."""
    noise, ack = "01 02", "7D 10 6D 7E"
    ping = "7D 01 AE EA AA EE 7C 7E"
    pieces = [
        ("rx", bytes.fromhex(noise + "7D 10"), 3_000_000_001),
        ("tx", bytes.fromhex(ping), 3_000_000_002),
        ("rx", bytes.fromhex("6D 7E"), 4_000_000_005),
    ]
    records = [
        "03000000 02000000 09000000 09000000 3E" + ping,
        "04000000 05000000 03000000 03000000 3C" + noise,
        "04000000 05000000 05000000 05000000 3C" + ack,
    ]
    expected = bytes.fromhex(HEAD + "".join(records))
    assert converted(tmp_path, pieces).read_bytes() == expected


def test_damage_is_marked_and_a_long_frame_in_pieces_is_one_packet(tmp_path: Path) -> None:
    samples = struct.pack("<1431f", *range(1431))
    payload = bytes.fromhex("A0 12 00000000 07000000 97050000") + samples
    frame = bytes.fromhex("7C7C7C7C") + struct.pack("<I", len(payload)) + b"\0" + payload
    pieces = [("rx", frame[at : at + 1000], at) for at in range(0, len(frame), 1000)]
    pieces.append(("rx", bytes.fromhex("7D 10 6C 7E"), 9000))
    shown, damaged = dissected(converted(tmp_path, pieces))
    assert [float(value) for value in shown["xethru.data_float.data"]] == list(range(1431))
    assert "malformed" in json.dumps(damaged)


def test_a_record_without_bytes_and_a_packet_without_payload_are_no_errors(tmp_path: Path) -> None:
    empty = bytes.fromhex("7C7C7C7C 00000000 00")
    capture = converted(tmp_path, [("rx", empty, 1)])
    with capture.open("ab") as stream:
        stream.write(bytes(16))  # the head of a record of no bytes
    packet, nothing = dissected(capture)
    assert packet["xethru.framing"] == "noescape"
    assert "error" not in json.dumps([packet, nothing]).lower()


def test_a_recording_without_raw_bytes_is_refused(tmp_path: Path) -> None:
    source = FIXTURES / "recordings" / "single"
    assert xethru(["convert", str(source), str(tmp_path / "x.pcap")]) == 1
    assert not (tmp_path / "x.pcap").exists()
