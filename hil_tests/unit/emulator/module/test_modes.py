"""The tables of modes and permissions against those of protocol reference 8.3."""

import re
import subprocess
import sys

import pytest

from emulator.module.modes import PERMISSIONS, ModuleState, Verdict, state_diagram
from emulator.module.settings import DeviceOptions
from hil_tests.unit.emulator.doubles import BareHost, host_of
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import X4Setting

RUN, IDLE, MANUAL, STOP = 0x01, 0x11, 0x12, 0x13


def mode_of(host: BareHost) -> int:
    host.send(m.GetMode())
    (reply,) = (heard for heard in host.hear(3) if isinstance(heard, m.ReplyByte))
    return reply.values[0]


def test_the_diagram_shows_what_the_device_does() -> None:
    """Walk every printed arrow on a device; codes are those of 4.2 and 4.3."""
    commands: dict[str, m.Command[m.Ack]] = {
        "SETMODE RUN": m.SetMode(mode=RUN),
        "SETMODE IDLE": m.SetMode(mode=IDLE),
        "SETMODE MANUAL": m.SetMode(mode=MANUAL),
        "SETMODE STOP": m.SetMode(mode=STOP),
        "SETMODE REG": m.SetMode(mode=0x50),
        "LOADAPP": m.LoadApp(profile_id=0x014D4AB8),
    }
    modes = {"RUN": 1, "IDLE": 0x11, "LOADED": 0x13, "STOPPED": 0x13, "MANUAL": 0x12, "REG": 0x50}
    ways = {
        "RUN": [],
        "IDLE": ["SETMODE IDLE"],
        "LOADED": ["LOADAPP"],
        "STOPPED": ["SETMODE STOP"],
        "MANUAL": ["SETMODE STOP", "SETMODE MANUAL"],
        "REG": ["SETMODE STOP", "SETMODE REG"],
    }
    arrows = re.findall(r"^ +(\w+) --> (\w+): (.*)$", state_diagram(), re.MULTILINE)
    walked = 0
    for source, target, requests in arrows:
        for request in requests.split(", "):
            host = host_of(DeviceOptions())
            for step in [*ways[source], request]:
                assert host.ask(commands[step]) == m.Ack()
            assert mode_of(host) == modes[target]
            walked += 1
    refused = re.findall(r"note right of (\w+): (.*) get ERROR", state_diagram())
    for source, requests in refused:
        for request in requests.split(", "):
            host = host_of(DeviceOptions())
            for step in ways[source]:
                assert host.ask(commands[step]) == m.Ack()
            assert host.ask(commands[request]) == m.Error(code=0x20)
            walked += 1
    assert walked == len(ways) * len(commands), "every request in every state"


# 8.3, lower table, columns RUN, IDLE, loaded, none, MANUAL, safe mode; T taken, E some error,
# Q error or silence. OUTPUT control is two rows: presence messages and the others.
DOCUMENTED = {
    "ping, info": "TTTTTT",
    "modes and profiles": "TTTTTE",
    "profile settings": "EETEEE",
    "other profile GETs": "TTTQQE",
    "profile GETs of": "TTTEEE",
    "output control of baseband": "TTTEEE",
    "X4 driver": "TTTTTT",
}


@pytest.mark.parametrize("name", DOCUMENTED)
def test_the_permissions_are_those_of_the_reference(name: str) -> None:
    (verdicts,) = (PERMISSIONS[group] for group in PERMISSIONS if group.value.startswith(name))
    states = ("RUN", "IDLE", "LOADED", "STOPPED", "MANUAL", "SAFE")
    letters = {Verdict.TAKEN: "T", Verdict.NO_ANSWER: "Q"}
    told = "".join(letters.get(verdicts[ModuleState[state]], "E") for state in states)
    assert told == DOCUMENTED[name]


def test_the_diagram_can_be_printed() -> None:
    command = [sys.executable, "-m", "emulator.module.modes"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout == state_diagram() + "\n"


def test_x4_settings_between_two_stays_in_manual(host: BareHost) -> None:
    """15, question 4."""
    host.enter_manual()
    host.set(X4Setting.ITERATIONS, 77)
    for mode in (MANUAL, STOP, MANUAL):
        assert host.ask(m.SetMode(mode=mode)) == m.Ack()
    reply = host.ask(m.X4DriverGet(setting=X4Setting.ITERATIONS))
    assert reply == m.ReplyInt(content_id=0x12, values=(77,))


def test_a_command_larger_than_a_pool_block_is_dropped(host: BareHost) -> None:
    """1.1: 7000 bytes of payload; no reply."""
    assert host.ask(m.SetMode(mode=STOP)) == m.Ack()
    key = {"file_type": 0x80000000, "identifier": 1}
    assert host.ask(m.CreateFile(**key, length=8000)) == m.Ack()
    header = 2 + 4 * 4  # opcode, sub-code; type, identifier, offset, length
    fits = m.SetFileData(**key, offset=0, data=b"x" * (7000 - header))
    assert host.ask(fits) == m.Ack()
    host.send(m.SetFileData(**key, offset=0, data=b"x" * (7001 - header)))
    assert host.hear() == []
    assert host.ask(m.Ping()) == m.Pong(value=0xAAEEAEEA)


def test_noise_maps_are_stored_periodically_while_the_profile_runs(host: BareHost) -> None:
    """16."""
    minute = 60_000_000_000
    host.command(
        m.SetMode(mode=STOP),
        m.LoadApp(profile_id=0x014D4AB8),
        m.NoiseMapSetPeriodicStore(interval_min=2),
        m.SetMode(mode=RUN),
    )
    files = host.device.module.files
    host.device.module.advance(2 * minute - 1)
    assert files.names() == [(0x037DD98C, 0)]
    host.device.module.advance(2 * minute)
    assert files.names() == [(0x037DD98C, 0), (0x05F09BCA, 0), (0x05F09BCB, 0)]
