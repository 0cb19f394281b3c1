"""``xethru doctor``: each row of its tables finds its fault, names a remedy, disturbs nobody."""

import json
import math
import os
import shlex
import subprocess
import sys
import termios
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil_tests.golden.vectors import load
from hil_tests.unit.xethru_protocol.pty_module import (
    IDLE,
    MANUAL,
    NOT_READY,
    SAFE_MODE,
    STOP,
    Answer,
    PtyModule,
    Said,
    silent,
    stock,
)
from xethru_protocol.cli import main, port_probe
from xethru_protocol.cli.doctor import MACHINE_CHECKS, PORT_CHECKS
from xethru_protocol.cli.port_probe import port_users
from xethru_protocol.driver import link
from xethru_protocol.transport import SerialTransport
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.versions import XEP_VERSIONS

Capture = pytest.CaptureFixture[str]
FRAME = m.DataFloat(info=1, values=np.zeros(8, np.float32))
UNCHECKED = bytes.fromhex("7D 01 02 03 7E")  # XOR of 7D 01 02 is 7E, not 03


@pytest.fixture(autouse=True)
def only_own_emulators(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


@pytest.fixture
def hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait less for modules that never answer, and longer at a rate at which one may."""
    monkeypatch.setattr(port_probe, "_ANSWER_LIMIT_S", 0.3)
    monkeypatch.setattr(port_probe, "_REPLY_LIMIT_S", 1.0)
    monkeypatch.setattr(link, "_BAUD_PROBE_S", 1.0)


def examined(capsys: Capture, *arguments: str) -> tuple[int, list[dict[str, Any]]]:
    """Exit code, and the reports of one `doctor --json`."""
    code = main(["doctor", *arguments, "--json"])
    (line,) = capsys.readouterr().out.splitlines()
    result = json.loads(line)
    assert result["ok"] == (code == 0)
    return code, result["reports"]


def not_well(report: dict[str, Any]) -> list[dict[str, str]]:
    return [check for check in report["checks"] if check["level"] != "ok"]


def only_finding(capsys: Capture, path: str) -> tuple[int, dict[str, str]]:
    code, (report,) = examined(capsys, "--port", path)
    (finding,) = not_well(report)
    assert finding["remedy"]
    return code, finding


def test_a_module_as_it_comes_from_the_factory_is_well(capsys: Capture) -> None:
    with PtyModule(stock()) as module:
        code, (report,) = examined(capsys, "--port", module.path)
    assert (code, not_well(report)) == (0, [])
    assert [check["check"] for check in report["checks"]] == [
        row.name for row in PORT_CHECKS if not row.network
    ]
    assert report["about"] == (
        "X4M300, serial 123456789012, firmware 1.6.8, mode RUN, profile PRESENCE_2"
    )
    disturbing = (m.SetMode, m.X4DriverSet, m.X4DriverInit, m.LoadApp, m.ModReset)
    assert not any(isinstance(command, disturbing) for command in module.received)


# --- the module: name of the row, what the module does, level, a word of what is found ------------


def gone(command: m.Message) -> Sequence[Said]:
    return [b""]


def only_bootloader(command: m.Message) -> Sequence[Said]:
    is_known = isinstance(command, m.BootloaderGetDeviceInfo)
    return [BANNER.wire] if is_known else []


BANNER = next(vector for vector in load() if vector.name == "bl_reply_device_info")
MODULES = [
    ("not in the bootloader", lambda: PtyModule(only_bootloader), "fault", "bootloader"),
    ("speaks XeThru", lambda: PtyModule(silent, unasked=UNCHECKED), "fault", "no XeThru packets"),
    ("listens", lambda: PtyModule(silent, unasked=FRAME), "fault", "does not answer"),
    ("answers", lambda: PtyModule(silent), "fault", "nothing answers"),
    ("stays connected", lambda: PtyModule(gone), "fault", "went away"),
    ("no echo", lambda: PtyModule(silent, echoes=True), "fault", "sends back"),
    ("is a module", lambda: PtyModule(stock(pong=0x12345678)), "fault", "0x12345678"),
    ("ready", lambda: PtyModule(stock(pong=NOT_READY)), "fault", "not ready"),
    ("not in safe mode", lambda: PtyModule(stock(pong=SAFE_MODE)), "fault", "safe mode"),
    ("is an X4M300", lambda: PtyModule(stock(order_code="X4M200")), "note", "X4M200"),
    ("firmware", lambda: PtyModule(stock(version="1.5.10")), "fault", "lacks DELETE_NOISEMAP"),
    ("right profile", lambda: PtyModule(stock(profile=0x064E57AD)), "fault", "RESPIRATION_2"),
    ("transmitter on", lambda: PtyModule(stock(mode=MANUAL, tx_power=0)), "fault", "off"),
]
SILENT = {"not in the bootloader", "speaks XeThru", "listens", "answers"}


@pytest.mark.usefixtures("hurried")
def test_what_is_no_banner_is_no_bootloader(capsys: Capture) -> None:
    def answer(command: m.Message) -> Sequence[Said]:
        asked = isinstance(command, m.BootloaderGetDeviceInfo)
        return [m.UnknownMessage(code=0, payload=b"\x00")] if asked else []

    with PtyModule(answer) as module:
        _, finding = only_finding(capsys, module.path)
    assert finding["check"] == "answers"


@pytest.mark.parametrize(
    ("check", "make", "level", "word"), MODULES, ids=[row[0] for row in MODULES]
)
def test_what_is_wrong_with_a_module(
    check: str,
    make: Callable[[], PtyModule],
    level: str,
    word: str,
    *,
    capsys: Capture,
    request: pytest.FixtureRequest,
) -> None:
    if check in SILENT:
        request.getfixturevalue("hurried")
    with make() as module:
        code, finding = only_finding(capsys, module.path)
    assert (finding["check"], finding["level"]) == (check, level)
    assert code == (1 if level == "fault" else 0)
    assert word in finding["found"]


BARE_XEP = partial(stock, firmware_id="XEP", version="3.4.8")


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (partial(BARE_XEP, order_code=None, mode=None, profile=None), "bare XEP firmware"),
        (partial(BARE_XEP, order_code="X4M03", mode=None, profile=None), "bare XEP firmware"),
        (partial(BARE_XEP, order_code="X4M05"), "bare XEP firmware"),
        (partial(stock, order_code="X4M200", profile=0x064E57AD), "X4M200"),
    ],
)
def test_other_products_have_no_faults(
    make: Callable[[], Answer], word: str, capsys: Capture
) -> None:
    with PtyModule(make()) as module:
        code, finding = only_finding(capsys, module.path)
    assert (code, finding["check"], finding["level"]) == (0, "is an X4M300", "note")
    assert word in finding["found"]


@pytest.mark.parametrize(
    ("make", "mode"),
    [(partial(stock, mode=STOP, profile=0), "STOP"), (partial(stock, mode=IDLE), "IDLE")],
)
def test_a_module_that_stands_still_is_well(
    make: Callable[[], Answer], mode: str, capsys: Capture
) -> None:
    with PtyModule(make()) as module:
        code, (report,) = examined(capsys, "--port", module.path)
    assert (code, not_well(report)) == (0, [])
    assert f"mode {mode}" in report["about"]


@pytest.mark.usefixtures("hurried")
def test_frames_that_fill_a_uart_are_no_foreign_bytes(
    capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(SerialTransport, "bytes_per_s", 11520.0)
    with PtyModule(silent, unasked=UNCHECKED + Connection(Role.MODULE).send(FRAME)) as module:
        _, finding = only_finding(capsys, module.path)
        assert len([c for c in module.received if isinstance(c, m.Ping)]) <= 2  # no other rates
    assert finding["check"] == "listens"
    assert "115200 baud carry 2 a second" in finding["remedy"]


def test_the_newest_firmware_is_named_for_bare_xep_too(capsys: Capture) -> None:
    old_xep = stock(order_code=None, firmware_id="XEP", version="3.3.0", mode=None, profile=None)
    with PtyModule(old_xep) as module:
        _, (report,) = examined(capsys, "--port", module.path)
    _, finding = not_well(report)
    assert finding["check"] == "firmware"
    assert f"bare XEP: {XEP_VERSIONS[-1]}" in finding["remedy"]


@pytest.mark.parametrize("version", ["1.6.8", "1.6.10", "1.10.0", "2.0.0", "new"])
def test_firmware_that_is_not_stale(version: str, capsys: Capture) -> None:
    with PtyModule(stock(version=version)) as module:
        code, (report,) = examined(capsys, "--port", module.path)
    assert (code, not_well(report)) == (0, [])


@pytest.mark.usefixtures("hurried")
def test_a_module_at_another_baud_rate(capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SerialTransport, "bytes_per_s", 11520.0)
    with PtyModule(stock(), baudrate=termios.B460800) as module:
        code, finding = only_finding(capsys, module.path)
    assert (code, finding["check"]) == (1, "usual baud rate")
    assert finding["found"] == "it answers at 460800 baud, not at 115200"
    assert "--baudrate 460800" in finding["remedy"]


@pytest.mark.rare
@pytest.mark.usefixtures("hurried")
def test_only_uarts_are_tried_at_other_rates(
    capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried: list[int] = []
    monkeypatch.setattr(SerialTransport, "set_baudrate", lambda _, rate: tried.append(rate))
    for bytes_per_s, is_uart in ((math.inf, False), (11520.0, True)):
        monkeypatch.setattr(SerialTransport, "bytes_per_s", bytes_per_s)
        with PtyModule(silent) as module:
            only_finding(capsys, module.path)
        assert bool(tried) is is_uart


def test_a_module_that_stops_answering_half_way(capsys: Capture) -> None:
    healthy = stock()

    def answer(command: m.Message) -> Sequence[Said]:
        return [b""] if isinstance(command, m.GetProfileId) else healthy(command)

    with PtyModule(answer) as module:
        code, finding = only_finding(capsys, module.path)
    assert (code, finding["check"]) == (1, "right profile")
    assert "disconnected" in finding["found"]


# --- the port ---------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["radar", "my {radar} $(id)"], ids=["plain", "quoted"])
def test_a_link_to_nothing(name: str, tmp_path: Path, capsys: Capture) -> None:
    link = tmp_path / name
    link.symlink_to(tmp_path / "gone")
    code, finding = only_finding(capsys, str(link))
    assert (code, finding["check"]) == (1, "link leads to a port")
    assert str(tmp_path / "gone") in finding["found"]
    assert shlex.split(finding["remedy"])[-2:] == ["rm", str(link)]


def test_a_port_that_vanishes_while_it_is_examined(
    capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("os.path.exists", lambda path: True)
    _, finding = only_finding(capsys, "/dev/none")
    assert finding["check"] == "is a serial port"
    assert finding["found"] == "this could not be found out: No such file or directory"


@pytest.mark.parametrize(
    ("path", "check"),
    [
        ("/dev/none", "port exists"),
        *((path, "is a serial port") for path in (".", __file__, "/dev/null")),
    ],
)
def test_what_is_no_port(path: str, check: str, capsys: Capture) -> None:
    code, finding = only_finding(capsys, path)
    assert (code, finding["check"]) == (1, check)


@pytest.mark.parametrize(
    ("mode", "check", "remedy"),
    [(0o620, "group has rights", "udev"), (0o660, "user has rights", "usermod -aG")],
)
def test_no_rights(
    mode: int, check: str, remedy: str, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    with PtyModule(stock()) as module:
        os.chmod(module.path, mode)
        # root may open everything, and tests may run as root
        monkeypatch.setattr("os.access", lambda path, wanted: False)
        code, finding = only_finding(capsys, module.path)
        group = port_probe.PortProbe(module.path).group
    assert (code, finding["check"]) == (1, check)
    assert f"group {group}" in finding["found"]
    assert remedy in finding["remedy"]
    assert module.received == []


@contextmanager
def reader(path: str) -> Iterator[int]:
    """Another program that has a port open, without a lock; its process id."""
    code = "import os, sys; os.open(sys.argv[1], os.O_RDWR); print(flush=True); sys.stdin.read()"
    with subprocess.Popen(
        [sys.executable, "-c", code, path], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        yield process.pid
        process.kill()


needs_proc = pytest.mark.skipif(not Path("/proc/self/fdinfo").exists(), reason="asks Linux's /proc")


@needs_proc
def test_a_port_that_another_program_has_open_is_left_alone(
    capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []
    monkeypatch.setattr(port_probe, "open_line", opened.append)
    with PtyModule(stock()) as module, reader(module.path) as pid:
        code, finding = only_finding(capsys, module.path)
    assert (code, finding["check"]) == (1, "nobody else has it open")
    assert f"(pid {pid}) has it open" in finding["found"]
    assert opened == []


@needs_proc
def test_two_programs_that_split_the_stream(capsys: Capture) -> None:
    with PtyModule(stock()) as module, reader(module.path) as pid, reader(module.path) as other:
        code, finding = only_finding(capsys, module.path)
    assert (code, finding["check"]) == (1, "no two readers")
    assert f"pid {pid}" in finding["found"]
    assert f"pid {other}" in finding["found"]
    assert module.received == []


@needs_proc
def test_the_process_that_serves_a_port_is_not_its_user() -> None:
    with PtyModule(stock()) as module:
        assert port_users(module.path) == ()
        with reader(module.path) as pid:
            (user,) = port_users(module.path)
            assert user.startswith('"-c import os')
            assert user.endswith(f" (pid {pid})")
    assert port_users("/no/such/port") == ()
    assert port_users(__file__) == ()


def test_a_port_locked_by_a_program_that_cannot_be_seen(
    capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(port_probe, "port_users", lambda path: ())
    with PtyModule(stock()) as module:
        other = SerialTransport(module.path)
        code, finding = only_finding(capsys, module.path)
        other.close()
    assert (code, finding["check"]) == (1, "can be opened")
    assert "in use by another program" in finding["found"]
    assert f"sudo xethru doctor --port {module.path}" in finding["remedy"]


def test_many_readers_are_not_all_named(capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    users = tuple(f'"reader" (pid {number})' for number in range(10, 20))
    monkeypatch.setattr(port_probe, "port_users", lambda path: users)
    with PtyModule(stock()) as module:
        _, finding = only_finding(capsys, module.path)
    assert "(pid 13) and 6 more have it open" in finding["found"]


# --- the machine --------------------------------------------------------------------------------


def test_a_machine_without_modules(capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("xethru_protocol.cli.doctor.find_ports", lambda: ())
    code, (report,) = examined(capsys)
    (finding,) = not_well(report)
    assert (code, report["subject"], finding["check"]) == (1, "this machine", "modules found")


def test_all_found_ports_are_examined(
    tmp_path: Path, capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "xethru").mkdir(mode=0o700)
    with PtyModule(stock()) as module:
        device = {"path": module.path, "name": "left", "serial": "1", "tcp": None}
        word = json.dumps({"pid": os.getpid(), "ready": True, "devices": [device]})
        (tmp_path / "xethru" / f"{os.getpid()}.json").write_text(word)
        code, reports = examined(capsys)
    assert [report["subject"] for report in reports][-2:] == [module.path, "this machine"]
    assert reports[-2]["about"].startswith("emulated left, X4M300")
    assert code == (0 if len(reports) == 2 else code)


# --- the report -------------------------------------------------------------------------------


def test_every_row_about_a_port_has_a_test() -> None:
    elsewhere = {
        "link leads to a port",
        "port exists",
        "is a serial port",
        "group has rights",
        "user has rights",
        "no two readers",
        "nobody else has it open",
        "can be opened",
        "can be reached",
        "stays reachable",
        "usual baud rate",
    }
    tested = [*elsewhere, *(row[0] for row in MODULES)]
    assert sorted(tested) == sorted(row.name for row in PORT_CHECKS)
    assert all(row.looks_at and row.remedy for row in PORT_CHECKS)
    assert all(row.looks_at and row.remedy for row in MACHINE_CHECKS)
