"""Which radar is at which port: by serial numbers."""

from pathlib import Path

import pytest

from emulator.chip import Pace
from emulator.echo.echo import echo_source
from emulator.loopback import LoopbackTransport
from emulator.module.memory import Identity
from emulator.scene.scene import empty_room
from emulator.x4m300 import radar_device
from hil_tests.unit.xethru_protocol.scripted import ScriptedTransport
from slam.app.rig.rig_files import load_rig, write_rig
from slam.library.rig_files import RigFile, RigRadar
from slam.live import modules
from slam.live.errors import AppError
from slam.live.frame_sources import RadarLink
from slam.live.modules import are_emulated, open_modules
from xethru_protocol.driver.matching import Observer, ProtocolRecord
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.transport import PortInfo
from xethru_protocol.wire.errors import Disconnected, PortUnavailable

RIG = Path("robot.toml")
LEFT, RIGHT, OTHER = "000000000001", "000000000002", "000000000009"


class Bench:
    """Ports with emulated modules behind them, in place of `X4M300.open`."""

    def __init__(self) -> None:
        self.serials: dict[str, str] = {}
        self.lines: dict[str, LoopbackTransport] = {}
        self.heard: list[tuple[str, str]] = []
        self.notes: list[str] = []

    def open(self, port: str, *, observer: Observer) -> X4M300:
        if port not in self.serials:
            raise PortUnavailable(f"there is no port {port}")
        identity = Identity(serial=self.serials[port])
        device = radar_device(identity, echo_source(empty_room(), 0, 0), Pace.ASAP)
        line = self.lines[port] = LoopbackTransport(device, name=port)
        return X4M300(line, clock=line.clock_ns, observer=observer)

    def find(
        self, *ports: str, rig: RigFile | None = None, odometry_socket: str = ""
    ) -> tuple[RadarLink, ...]:
        return open_modules(
            rig or robot(),
            RIG,
            ports or None,
            self.hear,
            self.notes.append,
            odometry_socket=odometry_socket,
        )

    def hear(self, name: str, record: ProtocolRecord) -> None:
        self.heard.append((name, record.summary))

    def is_open(self, port: str) -> bool:
        try:
            self.lines[port].read(0.0)
        except Disconnected:
            return False
        return True


def robot() -> RigFile:
    mounts = {"left": (LEFT, 0.2, 90.0), "right": (RIGHT, -0.2, -90.0)}
    return RigFile(
        radars=tuple(
            RigRadar(
                name=name,
                serial=serial,
                x_m=0.0,
                y_m=y_m,
                yaw_deg=yaw,
                range_offset_m=0.01,
                gain_db=1.5,
            )
            for name, (serial, y_m, yaw) in mounts.items()
        )
    )


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    made = Bench()
    monkeypatch.setattr(X4M300, "open", made.open)
    monkeypatch.setattr(modules, "known_ports", lambda: tuple(made.serials))
    return made


@pytest.mark.parametrize("ports", [("a", "b"), ("b", "a")])
def test_mounts_follow_serial_numbers_whichever_cable_is_where(
    ports: tuple[str, ...], bench: Bench
) -> None:
    bench.serials = {"a": RIGHT, "b": LEFT}
    links = bench.find(*ports)
    assert [(link.mount.name, link.port, link.serial) for link in links] == [
        ("left", "b", LEFT),
        ("right", "a", RIGHT),
    ]
    assert [link.mount.range_offset_m for link in links] == [0.01, 0.01]
    assert [link.gain_db for link in links] == [1.5, 1.5]
    assert "radar left: serial number 000000000001, at b" in bench.notes
    asked = [(name, text) for name, text in bench.heard if "GET_INFO" in text]
    assert [name for name, _ in asked] == ["left", "right"]
    links[0].driver.ping()
    assert bench.heard[-1][0] == "left"
    for link in links:
        link.driver.close()


def test_a_missing_module_is_named_and_the_others_are_let_go(bench: Bench) -> None:
    bench.serials = {"a": LEFT}
    with pytest.raises(AppError) as refused:
        bench.find("a")
    assert str(refused.value) == (
        "robot.toml: radar right (serial number 000000000002) not found; "
        "there are 000000000001 at a: is it plugged in?"
    )
    assert not bench.is_open("a")


def test_a_foreign_module_is_refused_where_it_was_named_and_passed_over_elsewhere(
    bench: Bench,
) -> None:
    bench.serials = {"a": LEFT, "b": RIGHT, "c": OTHER}
    with pytest.raises(AppError, match="the module at c has serial number 000000000009, which"):
        bench.find("a", "b", "c")
    links = bench.find()
    assert [link.port for link in links] == ["a", "b"]
    assert not bench.is_open("c")
    (skipped,) = [note for note in bench.notes if note.startswith("passed over")]
    assert skipped == f"passed over, not of this rig: c (module {OTHER})"
    for link in links:
        link.driver.close()


SOMEBODYS = {"theirs/left": LEFT, "theirs/right": RIGHT}
OURS = {"ours/left": LEFT, "ours/right": RIGHT}


def test_ports_beside_the_odometry_are_taken_and_those_of_others_not_opened(bench: Bench) -> None:
    bench.serials = SOMEBODYS | OURS
    links = bench.find(odometry_socket="ours/odometry.sock")
    assert [link.port for link in links] == list(OURS)
    assert set(bench.lines) == set(OURS)
    for link in links:
        link.driver.close()


@pytest.mark.parametrize(
    ("socket", "serials"),
    [
        ("", SOMEBODYS | OURS),
        ("elsewhere/odometry.sock", SOMEBODYS | OURS),
        ("ours/odometry.sock", SOMEBODYS | {"ours/left": LEFT}),  # a port there is missing
    ],
)
def test_two_emulators_of_one_scene_are_told_apart_by_their_ports(
    socket: str, serials: dict[str, str], bench: Bench
) -> None:
    bench.serials = serials
    with pytest.raises(AppError, match=LEFT) as refused:
        bench.find(odometry_socket=socket)
    assert "--ports" in str(refused.value)
    assert not any(bench.is_open(port) for port in bench.lines)
    for link in bench.find(*SOMEBODYS, odometry_socket=socket):
        link.driver.close()


def test_what_the_ports_beside_the_odometry_lack_is_looked_for_elsewhere(bench: Bench) -> None:
    bench.serials = {"theirs/right": RIGHT, "ours/left": LEFT, "theirs/other": OTHER}
    links = bench.find(odometry_socket="ours/odometry.sock")
    assert [link.port for link in links] == ["ours/left", "theirs/right"]
    for link in links:
        link.driver.close()


def test_ports_in_the_way_cost_one_line_and_are_closed(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.serials = {"a": LEFT, "b": RIGHT, "c": OTHER, "d": "000000000008"}
    mute = ScriptedTransport(lambda command: [])  # never answers
    monkeypatch.setattr(modules, "known_ports", lambda: ("mute", "a", "c", "no", "d", "b"))

    def open_port(port: str, *, observer: Observer) -> X4M300:
        if port != "mute":
            return bench.open(port, observer=observer)
        return X4M300(mute, clock=mute.clock, observer=observer)

    monkeypatch.setattr(X4M300, "open", open_port)
    for link in bench.find():
        link.driver.close()
    skipped = [note for note in bench.notes if "passed over" in note]
    assert len(skipped) == 2
    assert skipped[0].count("no module answers") == 1
    assert all(port in skipped[0] for port in ("mute (no", "c (module", "d (module"))
    assert skipped[1] == "passed over, in use or not to be opened: no"
    assert not any(bench.is_open(port) for port in bench.serials)
    assert mute.closed


def test_a_port_in_use_is_not_called_a_module_that_does_not_answer(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.serials = {"a": LEFT}
    monkeypatch.setattr(modules, "known_ports", lambda: ("a", "busy"))
    with pytest.raises(AppError) as refused:
        bench.find()
    assert bench.notes == ["passed over, in use or not to be opened: busy"]
    assert str(refused.value).endswith(
        "is it plugged in? (`xethru doctor` says who has the ports that were passed over)"
    )


def test_a_rig_file_names_ports_itself(bench: Bench, tmp_path: Path) -> None:
    bench.serials = {"tcp://pi:5000": RIGHT, "b": LEFT, "c": OTHER}
    left, right = robot().radars
    networked = right.model_copy(update={"port": "tcp://pi:5000"})
    path = tmp_path / "rig.toml"
    write_rig(path, RigFile(radars=(left, networked)))
    rig = load_rig(path)
    assert [radar.port for radar in rig.radars] == [None, "tcp://pi:5000"]
    links = bench.find(rig=rig)
    assert [link.port for link in links] == ["b", "tcp://pi:5000"]
    for link in links:
        link.driver.close()
    local = left.model_copy(update={"port": "b"})
    for link in bench.find(rig=RigFile(radars=(local, networked))):  # c is not even opened
        link.driver.close()
    assert bench.notes.count(f"passed over, not of this rig: c (module {OTHER})") == 1
    elsewhere = right.model_copy(update={"port": "tcp://nowhere:1"})
    with pytest.raises(AppError, match="tcp://nowhere:1: there is no port"):
        bench.find(rig=RigFile(radars=(left, elsewhere)))


@pytest.mark.parametrize(
    ("port", "is_one"),
    [
        ("tcp://127.0.0.1:5000", True),
        ("socket://localhost:5000", True),
        ("tcp://127.0.0.1:5001", False),
        ("tcp://pi:5000", False),
        ("/dev/ttyACM0", False),
    ],
)
def test_an_emulated_module_is_known_at_its_tcp_port_too(
    port: str, is_one: bool, bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A drive with it is not called a real one."""
    found = PortInfo(path="/x/left", kind="emulated", description="", serial=LEFT, tcp=5000)
    monkeypatch.setattr(modules, "find_ports", lambda: (found,))
    bench.serials = {port: LEFT, "b": RIGHT}
    links = bench.find(port, "b")
    assert are_emulated(links) is is_one
    for link in links:
        link.driver.close()


def test_foreign_modules_with_one_number_are_passed_over(bench: Bench) -> None:
    """Bare emulated modules all have the same number unless another is given."""
    bench.serials = {"a": LEFT, "b": OTHER, "c": OTHER, "d": RIGHT}
    links = bench.find()
    assert [link.port for link in links] == ["a", "d"]
    for link in links:
        link.driver.close()


@pytest.mark.parametrize(
    ("serials", "ports", "words"),
    [
        (
            {"a": LEFT, "b": OTHER},
            "a b",
            r"radar right .* there is 000000000009 at b: if a",
        ),
        ({"a": LEFT, "b": LEFT, "c": RIGHT}, "a b c", f"the serial number {LEFT}, at a and b"),
        ({"a": LEFT}, "a nowhere", "nowhere: there is no port nowhere"),
        ({}, "", "no modules and no running emulators on this machine"),
    ],
)
def test_what_does_not_match_is_named_and_let_go(
    bench: Bench, serials: dict[str, str], ports: str, words: str
) -> None:
    bench.serials = serials
    with pytest.raises(AppError, match=words):
        bench.find(*ports.split())
    assert not any(map(bench.is_open, bench.lines))
