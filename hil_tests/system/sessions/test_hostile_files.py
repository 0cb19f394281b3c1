"""Files that a program of malice or chance wrote: a signal ends every command, no text harms."""

import importlib
import itertools
import json
import os
import signal
import struct
import threading
import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import zstandard

from hil_tests.patience import seconds
from hil_tests.unit.slam.app.session.mcap_files import chunks_of, rewrite
from hil_tests.unit.slam.app.sessions import (
    FRAME_NS,
    odometry,
    scan,
    session_info,
    snapshot,
    write_session,
)
from slam.app.cli import main
from slam.app.session.writer import SessionLog
from slam.config import WheelNoise, load_preset
from slam.live.session.description import settings_text
from slam.live.session_records import LogLine, SessionInfo
from xethru_protocol.recordings.mcap import pack_string

pytestmark = pytest.mark.slow

MODULES = {
    "replay": "slam.app.run.replay",
    "report": "slam.app.commands.report",
    "repair": "slam.app.session.repair",
    "view": "slam.app.commands.view",
    "calibrate": "slam.app.commands.calibrate",
    "convert": "slam.app.convert.convert",
}
THOROUGH = ("wheels", "unit", "settings", "frames")
N_BYTES = 255_000_000
N_CHUNKS = 200


def chunk(content: bytes) -> bytes:
    packed = zstandard.compress(content)
    body = struct.pack("<QQQI", 0, 0, len(content), zlib.crc32(content))
    body += struct.pack("<I4sQ", 4, b"zstd", len(packed)) + packed
    return struct.pack("<BQ", 6, len(body)) + body


@pytest.fixture(scope="module")
def degenerate(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a session before whose first scan 51 GB of nothing come, in a file of a few MB.

    Each chunk is one well-formed schema, so that all of it has to be unpacked.
    """
    folder = tmp_path_factory.mktemp("degenerate")
    whole = write_session(folder / "whole.mcap", 3).read_bytes()
    at = chunks_of(whole)[0]
    nothing = chunk(struct.pack("<BQ", 3, N_BYTES - 9).ljust(N_BYTES, b"\0"))
    path = folder / "session.mcap"
    path.write_bytes(whole[:at] + nothing * N_CHUNKS + whole[at:])
    return path


@contextmanager
def signal_after(delay_s: float) -> Iterator[list[float]]:
    """Send this process SIGTERM; what is yielded gets the time at which it was sent."""
    sent: list[float] = []

    def send() -> None:
        sent.append(time.monotonic())
        os.kill(os.getpid(), signal.SIGTERM)

    timer = threading.Timer(delay_s, send)
    timer.start()
    try:
        yield sent
    finally:
        timer.cancel()
        timer.join()


@pytest.mark.parametrize(
    "command",
    [pytest.param(name, marks=() if name == "report" else pytest.mark.rare) for name in MODULES],
)
def test_a_signal_ends_the_reading_of_a_degenerate_file(
    command: str, degenerate: Path, tmp_path: Path
) -> None:
    options = {
        "replay": ["--out", str(tmp_path / "out")],
        "report": ["--out", str(tmp_path / "report.html")],
        "repair": ["--out", str(tmp_path / "repaired.mcap")],
        "view": ["--out", str(tmp_path / "view.rrd")],
        "calibrate": [],
        "convert": [str(tmp_path / "out.bag")],
    }[command]
    # while it imports, a signal ends the process, which is that of the tests here
    importlib.import_module(MODULES[command])
    with signal_after(0.5) as sent:
        code = main([command, str(degenerate), *options])
        ended = time.monotonic()
    assert code == 128 + signal.SIGTERM
    assert ended - sent[0] < seconds(1)
    assert not any(tmp_path.glob("*.*"))


def test_a_chunk_of_zeros_is_not_unpacked(degenerate: Path, tmp_path: Path) -> None:
    """Else two hundred of them would take a minute: what they hold are not records."""
    zeros = chunk(bytes(N_BYTES))
    path = tmp_path / "zeros.mcap"
    path.write_bytes(degenerate.read_bytes()[:31] + zeros * N_CHUNKS)
    before = time.process_time()
    assert main(["report", str(path)]) == 1
    assert time.process_time() - before < 0.1 * N_CHUNKS


# escape, bell, carriage return, C1's CSI, right-to-left override
PLANTED = "\x1b[m\x07\r\x9b\u202e"


def planted(text: str) -> str:
    return f"{text}{PLANTED}"


def hostile_info() -> SessionInfo:
    info = session_info()
    return replace(
        info,
        scene=planted("scene"),
        preset=planted("preset"),
        radars=tuple(
            replace(
                radar,
                name=planted(radar.name),
                serial=planted("serial"),
                port=planted("port"),
                settings={planted("key"): planted("value")},
            )
            for radar in info.radars
        ),
        versions={planted("package"): planted("1.0"), "xethru-hil": planted("0.9")},
        config_json=settings_text(load_preset("robust")),
        wheels=asdict(WheelNoise()),
        time_base=planted("arrival"),
        odometry_clock=planted("unix"),
        constants={planted("slam.constant"): 1.0},
    )


def write_hostile_session(path: Path, info: SessionInfo, n_scans: int = 20) -> Path:
    ticks = itertools.count(0, 150_000_000)  # so that a chunk holds half a dozen messages
    log = SessionLog(path, info, odometry(60), clock_ns=lambda: next(ticks))
    for way in ("rx", "tx"):
        log.on_wire(info.radars[0].name, way, b"\x7d\x01" + PLANTED.encode(), 5)
    for counter in range(n_scans):
        log.on_scan(scan(counter))
        # other states than SLAM will have, so that replay has reasons to give
        log.on_snapshot(snapshot(counter))
        who = planted("radar0") if counter % 2 else info.radars[0].name
        line = LogLine(
            t_ns=counter * FRAME_NS, radar=who, warning=True, text=planted("</pre><script>fault")
        )
        log.on_log(line)
    log.close()
    return path


def end_of(capfd: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str]:
    code = main([str(argument) for argument in arguments])
    captured = capfd.readouterr()
    printed = captured.out + captured.err
    for character in set(PLANTED) - set("[m"):
        assert character not in printed, (arguments[0], character, printed)
    assert all(line.isprintable() for line in printed.split("\n")), (arguments[0], printed)
    return code, printed


@pytest.mark.rare
def test_text_of_a_session_reaches_no_terminal_with_control_characters(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    session = write_hostile_session(tmp_path / "session.mcap", hostile_info())
    code, printed = end_of(capfd, "replay", session, "--out", tmp_path / "out")
    assert (code, "fault" in printed) == (0, True)
    code, _ = end_of(capfd, "report", session, "--out", tmp_path / "report.html")
    assert code == 0
    page = (tmp_path / "report.html").read_text()
    assert "<script>" not in page
    assert [part for part in page.split("\n") if not part.isprintable()] == []
    assert end_of(capfd, "view", session, "--out", tmp_path / "view.rrd")[0] == 0
    end_of(capfd, "calibrate", session)
    end_of(capfd, "calibrate", session, "--json")
    for name in ("ros.bag", "bytes.xtwire", "folder"):
        end_of(capfd, "convert", session, tmp_path / name)
    for number, at in enumerate((0.4, 0.7)):
        content = bytearray(session.read_bytes())
        content[int(len(content) * at)] ^= 0xFF
        damaged = tmp_path / f"damaged{number}.mcap"
        damaged.write_bytes(content)
        end_of(capfd, "replay", damaged, "--out", tmp_path / "refused")
        assert end_of(capfd, "repair", damaged)[0] == 0
        code, printed = end_of(capfd, "replay", damaged, "--out", tmp_path / f"out{number}")
        assert code == 0, printed
    for trajectory in (tmp_path / "out").glob("*.tum"):
        assert set(trajectory.read_text()) <= set("0123456789.-+e \n")


@pytest.mark.parametrize(
    "field",
    [
        "table",
        pytest.param("config", marks=pytest.mark.rare),
        *(pytest.param(each, marks=pytest.mark.thorough) for each in THOROUGH),
    ],
)
def test_errors_about_a_session_hold_no_control_characters(
    field: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    info = hostile_info()
    if field == "config":
        info = replace(info, config_json=json.dumps({planted("key"): {planted("x"): planted("y")}}))
    elif field == "wheels":
        info = replace(info, wheels={planted("wheel"): 1.0})
    elif field == "settings":
        info = replace(info, config_json=planted("{"))
    elif field == "frames":
        info = replace(info, radars=tuple(replace(radar, n_bins=7) for radar in info.radars))
    session = write_hostile_session(tmp_path / "session.mcap", info, n_scans=4)
    if field in {"table", "unit"}:
        rewrite_strings(session, field)
    for command, *options in (
        ("replay", "--out", tmp_path / "out"),
        ("report", "--out", tmp_path / "report.html"),
        ("view", "--out", tmp_path / "view.rrd"),
        ("calibrate",),
        ("convert", tmp_path / "ros.bag"),
        ("convert", tmp_path / "made.mcap"),
        ("repair", "--out", tmp_path / "repaired.mcap"),
    ):
        end_of(capfd, command, session, *options)


def rewrite_strings(path: Path, field: str) -> None:
    """Spoil the texts that describe a session, by mcap's own writer."""

    def spoilt(topic: str, data: bytes) -> bytes:
        of_radar = topic.startswith("/radar/") and "/info" in topic
        if field == "unit" and of_radar:
            change = {"length_unit": planted("furlong")}
        elif field == "table" and topic == "/session/info":
            change = {"seed": planted("7")}
        else:
            return data
        return pack_string(json.dumps(json.loads(data[8:].rstrip(b"\0")) | change))

    (source := path.with_suffix(".whole")).write_bytes(path.read_bytes())
    rewrite(
        source,
        path,
        spoilt,
        profile=planted("ros2"),
        library=planted("library"),
        with_metadata=False,
    )
