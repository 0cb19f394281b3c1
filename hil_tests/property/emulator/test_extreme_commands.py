"""Commands with extreme fields, over every row of the message table: no bytes end a module.

In process and in virtual time, with the echo source of an empty room and saved flash, as
``xethru-emulator serve --bare --state-dir`` runs a module; a third of them with faults armed, as
`ctl` does, a third playing a recording, as `play` does. Fields are bytes made from the kinds of
the row, so values that no host of ours would encode are among them; some commands are cut or have
bytes behind them. Everything follows from the seed.

A death is an exception; a hang is a call that takes longer than `LONGEST_CALL_S` of processor time,
or a module that does not answer PING although it is awake.
"""

from __future__ import annotations

import random
import struct
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeVar

import pytest

from emulator.chip import Pace
from emulator.echo.echo import echo_source
from emulator.faults.faulty_device import FaultyDevice
from emulator.faults.kinds import KINDS
from emulator.faults.plan import FaultPlan, fault_spec
from emulator.module.memory import SavedState
from emulator.module.modes import ModuleState
from emulator.module.settings import MODELS, DeviceOptions
from emulator.playback import played_radars
from emulator.scene.scene import empty_room
from emulator.x4m300 import radar_device
from hil_tests.paths import FIXTURES
from hil_tests.unit.emulator.doubles import IDENTITY
from xethru_protocol.wire import fields as kinds
from xethru_protocol.wire.codes import FORMAT_KEY, BootloaderKey
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.framing import (
    NeedData,
    encode_no_escape,
    encode_normal,
)
from xethru_protocol.wire.messages import Ping, Pong
from xethru_protocol.wire.table import ROWS, Command

Result = TypeVar("Result")
LONGEST_CALL_S = 5.0
SECOND = 1_000_000_000
COMMANDS_PER_MODULE = 250
PACKETS = 6
"""Most that the host reads after a command."""
LARGEST_PACKET = 8000
"""Protocol reference 1.1: of a Normal packet, escapes included; radar frames have 6163 bytes."""
ROWS_OF_COMMANDS = [row for kind, row in ROWS.items() if issubclass(kind, Command)]

WORDS = (
    *(0, 1, 2, 3, 4, 16, 255, 256, 1000, 6976, 6977, 7000, 7984, 8192, 20_000, 0x47FFF, 0x48000),
    *(0x7FFFFFFE, 0x7FFFFFFF, 0x80000000, 0x80000001, 0xFFFFFFFE, 0xFFFFFFFF),
    *(FORMAT_KEY, BootloaderKey.CURRENT, BootloaderKey.OLD, 0x80000005, 115200, 600),
)
FLOATS = (
    *(0.0, -0.0, 1e-45, 1e-8, 0.2, 0.4, 1.0, 5.0, 9.4, 17.0, 400.0, 65536.0, 1e9, 3e38),
    *(-1e-45, -0.5, -17.0, -3e38, float("inf"), float("-inf"), float("nan")),
)
BYTES = (0, 1, 2, 3, 4, 5, 0x10, 0x11, 0x12, 0x13, 0x50, 0x7C, 0x7D, 0x7E, 0x7F, 0x80, 0xFF)
EXTREMES: dict[str, tuple[float, ...]] = {"I": WORDS, "i": WORDS, "f": FLOATS, "B": BYTES}
FILE_TYPES = (0x80000005, 0x80000005, 0x80000005, 0x037DD98C, 0x05F09BCA, 0x05F09BCB, 0x04554D50)
IDENTIFIERS = (0, 0, 0, 1, 0xFFFFFFFF)
USEFUL = tuple(
    bytes.fromhex(text.replace(" ", ""))
    for text in (
        "20 12",  # MANUAL
        "50 20",  # INIT
        "50 10 10000000 0000 8841",  # FPS 17
        "50 10 10000000 0000 7A43",  # FPS 250
        "50 10 14000000 CDCC4C3E 66661641",  # FRAMEAREA 0.2 ... 9.4
        "20 13",  # STOP
        "21 B84A4D01",  # PRESENCE_2
        "21 AD574E06",  # RESPIRATION_2
        "41 10 0C000000 01000000",  # baseband
        "41 10 10000000 03000000",  # pulse-Doppler
        "25 10 03000000",  # noise map: stored, else create
        "20 01",  # RUN
        "90 66 CA9BF005 00000000 00200000",  # a slow noise map's file
        "90 73 C9007F42",  # FORMAT_FILESYSTEM
    )
)


def _packed(code: str, value: float) -> bytes:
    if code == "f":
        return struct.pack("<f", value)
    size = struct.calcsize(f"<{code}")
    return (int(value) % (1 << 8 * size)).to_bytes(size, "little")


def _number(rng: random.Random, code: str, known: list[int]) -> bytes:
    if known and rng.random() < 0.7:
        return _packed(code, rng.choice(known))
    if rng.random() < 0.1:
        return rng.randbytes(struct.calcsize(f"<{code}"))
    return _packed(code, rng.choice(EXTREMES.get(code, BYTES)))


def _field(rng: random.Random, name: str, kind: kinds.FieldKind, chosen: dict[str, int]) -> bytes:  # noqa: PLR0911 - one return per kind
    match kind:
        case kinds.Number(code=code, enum=enum):
            if name == "file_type":
                return _packed(code, rng.choice(FILE_TYPES))
            if name == "identifier":
                return _packed(code, rng.choice(IDENTIFIERS))
            return _number(rng, code, [] if enum is None else list(enum))
        case kinds.Member(enum=enum):
            data = _number(rng, "I", list(enum))
            chosen[name] = int.from_bytes(data, "little")
            return data
        case kinds.Spelling(codes=codes):
            return bytes([rng.choice(codes)])
        case kinds.OptionalByte():
            return rng.choice((b"", b"\x00", b"\xff", rng.randbytes(1)))
        case kinds.ShortForm():
            return b""
        case kinds.ByDiscriminator(field=of, layouts=layouts):
            letters, _ = layouts.get(chosen.get(of, -1), ("I", ()))
            return b"".join(_number(rng, letter, []) for letter in letters)
        case kinds.Count():
            chosen["count"] = rng.choice((0, 1, 5, 300, 7000, 0xFFFFFFFF))
            return _packed("I", chosen["count"])
    return rng.randbytes(min(chosen.get("count", rng.choice((0, 1, 8, 300, 7000))), 7500))


def payloads(rng: random.Random) -> list[bytes]:
    """Return one command's payload, or those of commands about one file."""
    chance = rng.random()
    if chance < 0.1:
        return [rng.choice(USEFUL)]
    if chance < 0.12:
        return [rng.randbytes(rng.randrange(1, 12))]
    if chance < 0.17:
        key = struct.pack("<II", rng.choice(FILE_TYPES), rng.choice(IDENTIFIERS))
        # CREATE, OPEN, GET_FILE_LENGTH, and parts of the file
        first = b"\x90\x66" + key + struct.pack("<I", rng.choice(WORDS))
        reads = [
            b"\x90\x71" + key + struct.pack("<II", rng.choice((0, 0, *WORDS)), rng.choice(WORDS))
            for _ in range(3)
        ]
        return [first, b"\x90\x72" + key, b"\x90\x69" + key, *reads]
    return [_payload(rng, chance)]


def _payload(rng: random.Random, chance: float) -> bytes:
    row, chosen = rng.choice(ROWS_OF_COMMANDS), dict[str, int]()
    data = row.prefix + b"".join(_field(rng, name, kind, chosen) for name, kind in row.kinds)
    if chance < 0.2:
        data = data[: rng.randrange(len(data) + 1)]
    elif chance < 0.23:
        data += rng.randbytes(rng.choice((1, 4, 100)))
    return data or b"\x01"


def framed(rng: random.Random, data: bytes) -> bytes:
    """Return a payload as it travels; one in fifty is damaged or comes behind junk."""
    chance = rng.random()
    if chance < 0.01:
        return encode_no_escape(data)
    packet = encode_normal(data[:7998])
    if chance < 0.02:
        return rng.randbytes(rng.randrange(1, 9)) + packet
    if chance < 0.03:
        at = rng.randrange(len(packet))
        return packet[:at] + rng.randbytes(1) + packet[at + 1 :]
    return packet


class KeptFlash:
    """Keeps a module's flash as the document that the emulator writes."""

    def __init__(self) -> None:
        self.text: str | None = None

    def load(self) -> SavedState | None:
        return None if self.text is None else SavedState.model_validate_json(self.text)

    def save(self, state: SavedState) -> None:
        self.text = state.model_dump_json(by_alias=True)


@dataclass
class Findings:
    """What a run found: one entry per death or hang."""

    commands: int = 0
    deaths: list[str] = field(default_factory=list)
    hangs: list[str] = field(default_factory=list)


class Trial:
    """One module and a host that sends it extreme commands."""

    def __init__(
        self, seed: int, pace: Pace, firmware: str, findings: Findings, *, what: str
    ) -> None:
        self._rng = random.Random(seed)
        self._name = f"seed {seed}, {pace}, {firmware}, {what}"
        self._pace = pace
        self._what = what
        changes: dict[str, object] = {
            "firmware": firmware,
            "after_damage": self._rng.choice(("answer", "error")),
            "matrix_messages": self._rng.choice(("whole", "halves")),
            "model": self._rng.choice(list(MODELS)),
        }
        self._options = DeviceOptions.model_validate(changes)
        self._flash = KeptFlash()
        self._findings = findings
        self._now_ns = 0
        self._coming: list[bytes] = []
        self._sent: list[bytes] = []
        self._start()

    def _start(self) -> None:
        if self._what == "played":
            (played,) = played_radars(FIXTURES / "recordings" / "single", on_fault=print, loop=True)
            self._module = played.device
        else:
            self._module = radar_device(
                IDENTITY,
                echo_source(empty_room(1), 0, 0),
                self._pace,
                options=self._options,
                memory=self._flash,
            )
        plan = FaultPlan(seed=self._rng.getrandbits(62))
        self._device = FaultyDevice(self._module, "radar", plan)
        self._module.port_opened(self._now_ns)
        for kind in self._rng.choices(list(KINDS), k=2 if self._what == "faults" else 0):
            self._device.add(fault_spec(kind, count=0, probability=self._rng.choice((0.1, 0.9))))

    def run(self, commands: int) -> None:
        """Send commands until one ends the module or makes it hang."""
        try:
            for _ in range(commands):
                self._command()
                self._findings.commands += 1
            self._ping()
        except Exception:
            last = [data[:40].hex() for data in self._sent[-4:]]
            self._findings.deaths.append(f"{self._name}, after {last}:\n{traceback.format_exc()}")

    def _command(self) -> None:
        rng = self._rng
        self._now_ns += rng.choice((0, 0, 1_000, 1_000_000, 60_000_000, SECOND, 3 * SECOND))
        if not self._module.listens or self._module.module.state is ModuleState.BOOTLOADER:
            self._come_back()
        if not self._coming:
            self._coming = payloads(rng)
        data = framed(rng, self._coming.pop(0))
        self._sent.append(data)
        self._timed(lambda: self._device.advance(self._now_ns))
        self._timed(lambda: self._device.receive_data(data, self._now_ns))
        for _ in range(rng.randrange(PACKETS)):
            if not self._read():
                break

    def _read(self) -> bytes | None:
        packet = self._timed(lambda: self._device.next_packet(self._now_ns))
        if packet is None:
            wake_ns = self._timed(lambda: self._device.wake_ns(self._now_ns))
            if wake_ns is not None and wake_ns <= self._now_ns + SECOND:
                self._now_ns = max(wake_ns, self._now_ns)
                self._timed(lambda: self._device.advance(self._now_ns))
            return None
        assert packet
        assert len(packet) <= LARGEST_PACKET or self._what == "faults"
        return packet

    def _come_back(self) -> None:
        """Wait for a start; give power anew to one that sleeps; leave the bootloader."""
        self._now_ns += 3 * SECOND
        self._timed(lambda: self._device.advance(self._now_ns))
        if self._module.module.state is ModuleState.BOOTLOADER and self._rng.random() < 0.7:
            return
        if self._rng.random() < 0.5 and self._module.module.state is not ModuleState.BOOTLOADER:
            self._timed(lambda: self._module.power_cycle(self._now_ns))
            self._now_ns += 3 * SECOND
        else:
            if self._module.module.state is ModuleState.BOOTLOADER:
                self._flash = KeptFlash()
            self._start()
        self._timed(lambda: self._device.advance(self._now_ns))

    def _ping(self) -> None:
        """Ask for a sign of life, behind bytes that end whatever was begun."""
        self._device.clear()
        self._device.plug(self._now_ns)
        self._now_ns += 10 * SECOND
        self._timed(lambda: self._device.advance(self._now_ns))
        line, host = Connection(Role.HOST), Connection(Role.HOST)
        for _ in range(3000):  # a false NoEscape start may wait for as many bytes
            # A command that waited behind a slow one may start the bootloader now.
            while not self._module.listens or self._module.module.state is ModuleState.BOOTLOADER:
                self._come_back()
            if self._device.wants_data:
                self._timed(lambda: self._device.receive_data(line.send(Ping()), self._now_ns))
            for _ in range(60):
                packet = self._read()
                if packet is None:
                    break
                host.receive_data(packet)
                while not isinstance(event := host.next_event(), NeedData):
                    if isinstance(event, Pong):
                        return
            self._now_ns += 100_000_000
        self._findings.hangs.append(f"{self._name}: no PONG")

    def _timed(self, call: Callable[[], Result]) -> Result:
        begin_s = time.process_time()
        result = call()
        took_s = time.process_time() - begin_s
        if took_s > LONGEST_CALL_S:
            self._findings.hangs.append(f"{self._name}: {took_s:.1f} s for {self._sent[-1][:40]!r}")
        return result


def run(count: int, seed: int) -> Findings:
    """Send ``count`` commands; both paces and both firmwares take turns."""
    findings, number = Findings(), 0
    while findings.commands < count:
        pace = list(Pace)[number % 2]
        firmware = ("sensor", "xep")[number // 2 % 2]
        most = min(COMMANDS_PER_MODULE, count - findings.commands)
        what = ("plain", "faults", "played")[number // 4 % 3]
        trial = Trial(seed * 1_000_000 + number, pace, firmware, findings, what=what)
        trial.run(most)
        number += 1
        if len(findings.deaths) > 20:
            break
    return findings


@pytest.mark.parametrize(
    "count",
    [
        12 * COMMANDS_PER_MODULE,  # both paces, both firmwares, with faults, a recording
        pytest.param(100_000, marks=[pytest.mark.rare, pytest.mark.timeout(0)]),
    ],
)
def test_no_command_ends_a_module_or_makes_it_hang(count: int) -> None:
    findings = run(count, seed=1)
    assert findings.deaths == []
    assert findings.hangs == []
    assert findings.commands == count
