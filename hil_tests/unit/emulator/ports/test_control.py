"""Live control: what is asked is done, what cannot be done is one line with the remedy."""

import json
import selectors
import socket
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from emulator.cli import request_of
from emulator.echo.people import people_truth
from emulator.ports.control import LONGEST_LINE, Control, ControlSocket
from emulator.scene.people import PersonSpec
from hil_tests.faulty import FaultyLine
from hil_tests.patience import seconds
from hil_tests.unit.emulator.rooms import radar_at, room
from xethru_protocol.wire.errors import Disconnected


@pytest.fixture
def line() -> Iterator[FaultyLine]:
    line = FaultyLine()
    yield line
    line.forget()


def ask(line: FaultyLine, **asked: Any) -> dict[str, Any]:  # noqa: ANN401 - JSON
    control = Control({"radar_1": line.device})
    answer = control.answer(json.dumps(asked).encode(), line.clock_ns())
    assert answer.endswith(b"\n")
    said: dict[str, Any] = json.loads(answer)
    return said


def test_a_fault_is_added_listed_counted_and_cleared(line: FaultyLine) -> None:
    radar = line.streaming()
    fault = {"kind": "missing_frames", "count": 2, "every": 3, "parameters": {"frames": 1}}
    added = ask(line, verb="fault add", fault=fault)
    assert added == {"ok": True, "ids": {"radar_1": 1}}
    list(radar.frames(20))
    (listed,) = ask(line, verb="fault list")["faults"]["radar_1"]
    assert (listed["kind"], listed["injected"], listed["count"]) == ("missing_frames", 2, 2)
    assert radar.frames_lost == 2
    assert ask(line, verb="fault clear", id=1) == {"ok": True, "cleared": 1}
    state = ask(line, verb="state")["radars"]["radar_1"]
    assert state == {
        "present": True,
        "faults": [],
        "injected": {"missing_frames": 2},
        "playback": None,
        "stream": {"number": 0, "scene_time_ns": 0},
    }


def test_a_port_is_unplugged_and_plugged_again(line: FaultyLine) -> None:
    radar = line.streaming()
    ask(line, verb="unplug")
    assert not ask(line, verb="state")["radars"]["radar_1"]["present"]
    with pytest.raises(Disconnected):
        list(radar.frames(100))
    ask(line, verb="plug")
    assert ask(line, verb="state")["radars"]["radar_1"]["present"]


def test_a_port_that_is_unplugged_for_a_while_comes_back(line: FaultyLine) -> None:
    radar = line.streaming(reconnect_s=15.0)
    ask(line, verb="unplug", seconds=1.0)
    assert len(list(radar.frames(10))) == 10
    assert radar.reconnects == 1


def test_a_reset_is_a_reboot(line: FaultyLine) -> None:
    radar = line.radar()
    ask(line, verb="reset", radar="radar_1")
    line.sleep(5.0)
    radar.ping()
    assert radar.reboots == 1


def test_people_are_as_their_table_says(line: FaultyLine) -> None:
    """15 breaths a minute, 4 mm: the chest is out after 1 s, in after 3 s; it enters at 1 s."""
    stands = PersonSpec(name="somebody", waypoints_m=((3.0, 4.0),), enters_s=1.0)
    scene = room(radar_at(0, 0, 0), people=(stands,))
    zero_ns = 7_000_000_000
    control = Control(
        {"radar_1": line.device}, people=partial(people_truth, scene), zero_ns=zero_ns
    )

    def asked(now_ns: int, **keys: Any) -> dict[str, Any]:  # noqa: ANN401 - JSON
        said: dict[str, Any] = json.loads(
            control.answer(json.dumps({"verb": "people", **keys}).encode(), now_ns)
        )
        return said

    answer = asked(zero_ns + 3_000_000_000)
    assert answer["ok"]
    assert answer["t_s"] == 3.0
    (one,) = answer["people"]
    chest_m = pytest.approx(-0.004)
    assert one == {
        "name": "somebody",
        "present": True,
        "moves": False,
        "position_m": [3.0, 4.0],
        "breaths_per_min": 15.0,
        "mean_breaths_per_min": None,
        "chest_m": chest_m,
        "sleep_stage": "awake",
        "distance_m": {"radar_1": 5.0},
        "towards_m": {"radar_1": chest_m},
    }
    (later,) = asked(0, seconds=61.0, radar="radar_1")["people"]
    assert later["mean_breaths_per_min"] == pytest.approx(15.0)
    (before,) = asked(zero_ns, radar="radar_1")["people"]
    assert (before["present"], before["breaths_per_min"]) == (False, None)
    assert "radar: must be one of radar_1" in asked(zero_ns, radar="nose")["error"]
    assert "seconds: must be a number" in asked(zero_ns, seconds=1e9)["error"]


@pytest.mark.parametrize(
    ("asked", "place"),
    [
        ({}, "verb: "),
        ({"verb": "sing"}, "verb: "),
        ({"verb": "state", "colour": 1}, "colour: "),
        ({"verb": "state", "radar": "nose"}, "radar: "),
        ({"verb": "fault add"}, "fault: "),
        ({"verb": "fault add", "fault": {"kind": "crc"}}, 'no kind of fault is called "crc"'),
        ({"verb": "fault add", "fault": {"kind": "stall", "radar": ["x"]}}, "must be some of"),
        ({"verb": "fault clear", "id": 9}, "id: "),
        ({"verb": "unplug", "seconds": -1}, "seconds: "),
        ({"verb": "unplug", "seconds": 10**400}, "seconds: "),
        ({"verb": "unplug", "seconds": float("nan")}, "seconds: "),
        ({"verb": "unplug", "seconds": float("inf")}, "seconds: "),
        ({"verb": "rate", "value": 10**400}, "value: "),
        ({"verb": "pause"}, "nothing is played here"),
        ({"verb": "people"}, "there is no scene here"),
        ({"verb": "rate", "value": "fast"}, "value: "),
        ({"verb": "loop", "value": 1}, "value: "),
    ],
)
def test_what_cannot_be_done_names_the_place(asked: dict[str, Any], place: str) -> None:
    answer = ask(FaultyLine(), **asked)
    assert answer["ok"] is False
    assert place in answer["error"]


@given(line=st.binary(max_size=200))
@example(line=b"[" * 100_000)
def test_no_line_breaks_it(line: bytes) -> None:
    answer = Control({"radar_1": FaultyLine().device}).answer(line, 0)
    assert json.loads(answer)["ok"] is False


@pytest.mark.parametrize(
    ("words", "request_line"),
    [
        ("state", {"verb": "state"}),
        ("unplug 2.5", {"verb": "unplug", "seconds": 2.5}),
        ("fault clear 3", {"verb": "fault clear", "id": 3}),
        ("rate 0", {"verb": "rate", "value": 0.0}),
        ("people", {"verb": "people"}),
        ("people 90", {"verb": "people", "seconds": 90.0}),
        ("loop off", {"verb": "loop", "value": False}),
    ],
)
def test_words_become_requests(words: str, request_line: dict[str, Any]) -> None:
    assert request_of(words.split()) == request_line


@pytest.mark.parametrize("words", ["sing", "rate fast", "fault add stall seconds", "loop maybe"])
def test_unknown_words_are_refused(words: str) -> None:
    with pytest.raises(
        ValueError, match=r"see xethru-emulator ctl --help|is not a number|must be KEY=VALUE"
    ):
        request_of(words.split())


def turn(selector: selectors.BaseSelector) -> None:
    for _ in range(20):
        for key, events in selector.select(0.0):
            key.data(events, 0)


def test_clients_of_the_socket_are_served_one_line_after_the_other(
    tmp_path: Path, line: FaultyLine
) -> None:
    path = tmp_path / "control.sock"
    offered = ControlSocket(path, Control({"radar_1": line.device}))
    selector = selectors.DefaultSelector()
    offered.register(selector)
    assert path.stat().st_mode & 0o077 == 0
    with socket.socket(socket.AF_UNIX) as one, socket.socket(socket.AF_UNIX) as flood:
        one.connect(str(path))
        flood.connect(str(path))
        one.settimeout(seconds(1))
        flood.setblocking(False)
        one.sendall(b'{"verb":"state"}\n{"verb":"reset"}\n{"verb":')
        turn(selector)
        answers = one.recv(65536).splitlines()
        assert [json.loads(answer)["ok"] for answer in answers] == [True, True]
        for _ in range(3 * LONGEST_LINE // 4096):
            try:
                flood.send(b"x" * 4096)
            except (BlockingIOError, BrokenPipeError):
                break
            turn(selector)
        one.sendall(b'"state"}\n')
        turn(selector)
        assert json.loads(one.recv(65536))["ok"]
    turn(selector)
    offered.close()
    assert not path.exists()
    assert list(selector.get_map().values())[1:] == []
    selector.close()
