"""Random command sequences at bare modules through real ports: no module is silent for long.

Independent on purpose: commands are bytes written down from the tables of the protocol reference
(chapter 4), framed and parsed here, without a line of the code under test. Every sequence follows
from its seed. A host sends one command at a time and reads all the while; each answer must come
within the time that the reference allows, be of the right class, and come once. At its end a
module must still send raw frames and, if it has profiles, presence messages. Then the emulator
gets SIGTERM right behind one more command.

    XETHRU_TEST_PATIENCE=1 python -m hil_tests.system.emulator.command_sequences --seed 0

With patience 1, for an idle machine, the limits are the reference's own.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import random
import selectors
import signal
import statistics
import struct
import subprocess
import sys
import time
import tty
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from hil_tests.patience import PATIENCE

COMMANDS = 200
MODULES = 16
EXIT_LIMIT_S = 1.0 * PATIENCE
ANSWER_S = 2.0 * PATIENCE  # 3: the vendor's host waits so long
SLOW_S = 5.0 * PATIENCE  # 3: SETMODE, LOADAPP, X4 INIT
WAIT_S = 0.5  # 3: RESET, START_BOOTLOADER and SETBAUDRATE put the command task to sleep
DELETE_S = 1.0  # 3: DELETE_FILE, at most
BOOT_S = 10.0 * PATIENCE  # 8.1
ACK, ERROR, REPLY, PONG, SYSTEM, APPDATA, DATA = 0x10, 0x20, 0x11, 0x01, 0x30, 0x50, 0xA0
BOOTLOADER_OK = 0xE0


def normal(payload: bytes) -> bytes:
    """Frame a payload: 1.1."""
    checksum = 0x7D
    for byte in payload:
        checksum ^= byte
    body = bytearray()
    for byte in (*payload, checksum):
        if byte in (0x7D, 0x7E, 0x7F):
            body.append(0x7F)
        body.append(byte)
    return b"\x7d" + bytes(body) + b"\x7e"


class Parser:
    """Cuts the module's bytes into payloads: 1.1 and 1.3. The line is clean, so nothing is lost."""

    def __init__(self) -> None:
        self._data = bytearray()

    def clear(self) -> None:
        self._data.clear()

    def payloads(self, data: bytes) -> Iterator[bytes]:
        self._data += data
        while self._data:
            if self._data[0] == 0x7C:
                if len(self._data) < 9:
                    return
                if self._data[:4] != b"\x7c\x7c\x7c\x7c":
                    raise AssertionError(f"no packet begins with {self._data[:9].hex()}")
                end = 9 + int.from_bytes(self._data[4:8], "little")
                if len(self._data) < end:
                    return
                yield bytes(self._data[9:end])
                del self._data[:end]
            elif self._data[0] == 0x7D:
                payload = self._normal()
                if payload is None:
                    return
                yield payload
            else:
                raise AssertionError(f"no packet begins with {self._data[:9].hex()}")

    def _normal(self) -> bytes | None:
        place, payload = 1, bytearray()
        while place < len(self._data):
            byte = self._data[place]
            if byte == 0x7E:
                del self._data[: place + 1]
                checksum = 0x7D
                for one in payload:
                    checksum ^= one
                assert checksum == 0, f"a damaged packet: {payload[:40].hex()}"
                return bytes(payload[:-1])
            if byte == 0x7F:
                place += 1
                if place == len(self._data):
                    return None
                byte = self._data[place]
            payload.append(byte)
            place += 1
        return None


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """Bytes to send, and what must come back.

    Attributes
    ----------
    answers
        First bytes that an answer may have; empty: nothing answers it.
    limit_s
        Until the answer.
    silence_s
        For how long after the answer the next command may wait for its own.
    pause_s
        For how long after the answer the host sends nothing.
    optional
        Whether the reference lets a module say nothing; what follows must be answered then.
    awaits
        What a module sends by itself afterwards, within the time that a start takes.
    deaf_s
        For how long the host reads nothing before it sends this.
    """

    data: bytes
    answers: tuple[int, ...] = (ACK, ERROR)
    limit_s: float = ANSWER_S
    silence_s: float = 0.0
    pause_s: float = 0.0
    optional: bool = False
    awaits: Callable[[bytes], bool] | None = None
    deaf_s: float = 0.0


def step(payload: bytes, answers: tuple[int, ...] = (ACK, ERROR), **more: object) -> Step:
    return Step(data=normal(payload), answers=answers, **more)  # type: ignore[arg-type] # whatever Step takes


def u32(*values: int) -> bytes:
    return struct.pack(f"<{len(values)}I", *values)


def f32(*values: float) -> bytes:
    return struct.pack(f"<{len(values)}f", *values)


GET = (REPLY, ERROR)
PING = step(b"\x01" + u32(0xEEAAEAAE), (PONG,))
STOP, MANUAL = (step(bytes([0x20, mode]), limit_s=SLOW_S) for mode in (0x13, 0x12))
INIT = step(b"\x50\x20", limit_s=SLOW_S)
PRESENCE_2, PRESENCE_SINGLE = 0x014D4AB8, 0x723BFA1E
LOAD_PRESENCE = step(b"\x21" + u32(PRESENCE_2), limit_s=SLOW_S)
OUTPUTS = (PRESENCE_SINGLE, 0x723BFA1F, 0x0C, 0x0D, 0x10, 0x11, 0x12, 0x13)
ZONE, LIMITS, SENSITIVITY, BAND, LED = 0x96A10A1C, 0x96A10A1D, 0x10A5112B, 0x71AF2A2B, 0x71AF2A2C
FILE_TYPES = (0x80000005, 0x80000006, 0x037DD98C, 0x05F09BCA)
RESET, BOOT_KEY, FORMAT_KEY = b"\x22", 0xA2B96EF1, 0x427F00C9
FLOATS = (0.0, 0.2, 0.4, 1.0, 5.0, 9.4, 12.0, -0.5, math.nan, math.inf)
# no faster: sixteen modules share a core, and what waits when a module restarts is lost
RATES = (0.0, 0.0, 1.0, 5.0, 17.0, 35.0, 60.0, 1e-8, -1.0, math.nan)


def is_ready(payload: bytes) -> bool:
    return payload == b"\x30" + u32(0x11)


def is_presence(payload: bytes) -> bool:
    return payload[:5] == b"\x50" + u32(PRESENCE_SINGLE)


def is_first_frame(payload: bytes) -> bool:
    """Whether this is a DATA FLOAT of content 0 with counter 1: the first after INIT (6.1)."""
    return payload[:10] == b"\xa0\x12" + u32(0, 1)


def set_x4(rng: random.Random) -> Step:
    """SET of one of the settings of 4.9."""
    setting, value = rng.choice(
        (
            (0x10, f32(rng.choice(RATES))),
            (0x10, f32(rng.choice(RATES))),
            (0x11, u32(rng.choice((0, 1, 10, 300, 65536)))),
            (0x12, u32(rng.choice((0, 1, 8, 16, 64, 256)))),
            (0x13, bytes([rng.randrange(3)])),
            (0x14, f32(rng.choice(FLOATS), rng.choice(FLOATS))),
            (0x15, u32(rng.randrange(6))),
            (0x16, u32(rng.choice((0, 949, 1100, 2047, 2048)))),
            (0x17, u32(rng.choice((0, 949, 1100, 2047, 2048)))),
            (0x18, f32(rng.choice(FLOATS))),
            (0x19, bytes([rng.choice((0, 1, 1, 1))])),
            (0x20, bytes([rng.randrange(2, 6)])),
            (0x21, bytes([rng.randrange(5)])),
            (0x22, bytes([rng.randrange(256), rng.randrange(256)])),
            (0x23, bytes([rng.randrange(256), rng.randrange(256)])),
            (0x24, bytes([rng.randrange(8), rng.randrange(256)])),
            (0x25, bytes([rng.choice((0, 3, 4, 16, 255))])),
            (0x26, u32(5)),
        )
    )
    return step(b"\x50\x10" + u32(setting) + value)


def get_x4(rng: random.Random) -> Step:
    setting = rng.choice((*range(0x10, 0x1A), *range(0x20, 0x27)))
    return step(b"\x50\x11" + u32(setting) + bytes([rng.randrange(256)]), GET)


def set_mode(rng: random.Random) -> Step:
    mode = rng.choice((0x01, 0x01, 0x11, 0x12, 0x12, 0x13, 0x10, 0x50, 0x77))
    parameter = bytes([rng.randrange(8)]) if mode == 0x50 else b""
    return step(bytes([0x20, mode]) + parameter, limit_s=SLOW_S)


def output(rng: random.Random) -> Step:
    opcode, feature = rng.choice((0x41, 0x41, 0x41, 0x42)), rng.choice(OUTPUTS)
    if rng.random() < 0.2:
        return step(bytes([opcode, 0x11]) + u32(feature), GET, optional=True)
    return step(bytes([opcode, 0x10]) + u32(feature, rng.randrange(4)))


def file_command(rng: random.Random) -> Step:
    """4.11."""
    key = u32(rng.choice(FILE_TYPES), rng.randrange(3))
    size = rng.choice((0, 1, 100, 1000))
    return rng.choice(
        (
            step(b"\x90\x64" + key[:4], GET),
            step(b"\x90\x65", GET),
            step(b"\x90\x66" + key + u32(rng.choice((0, 1, 100, 9000, 60000)))),
            step(b"\x90\x66" + key + u32(1000)),
            step(b"\x90\x72" + key),
            step(b"\x90\x72" + key),
            step(b"\x90\x67" + key + u32(0, size) + rng.randbytes(size)),
            step(b"\x90\x68" + key + u32(1)),
            step(b"\x90\x68" + key + u32(1)),
            step(b"\x90\x69" + key, GET),
            step(b"\x90\x71" + key + u32(rng.choice((0, 50)), size), GET),
            step(b"\x90\x70" + key, limit_s=ANSWER_S + DELETE_S),
            step(b"\x90\x73" + u32(rng.choice((FORMAT_KEY, 1, 2, 3)))),
        )
    )


def profile_setting(rng: random.Random) -> Step:
    """4.4 to 4.6. A quiet GET without a profile may give nothing at all."""
    app = b"\x10\x10"
    return rng.choice(
        (
            step(app + u32(ZONE) + f32(rng.choice(FLOATS), rng.choice(FLOATS))),
            step(app + u32(SENSITIVITY, rng.randrange(11))),
            step(app + u32(BAND, rng.randrange(2, 6))),
            step(app + u32(LED) + bytes([rng.randrange(4), 0])),
            step(b"\x10\x11" + u32(rng.choice((SENSITIVITY, BAND))), GET),
            step(b"\x10\x11" + u32(rng.choice((ZONE, LIMITS, LED))), GET, optional=True),
            step(b"\x10" + bytes([rng.choice((0x12, 0x13, 0x14, 0x16))])),
            step(b"\x10" + bytes([rng.choice((0x15, 0x20))])),
            step(b"\x24" + bytes([rng.randrange(4), 50])),
            step(b"\xb0" + bytes([rng.randrange(11)])),
            step(b"\x25\x10" + u32(rng.randrange(9))),
            step(b"\x25\x11", GET, optional=True),
            step(b"\x25\x12" + u32(rng.randrange(3), 0)),
            step(b"\x25\x13", GET, optional=True),
        )
    )


def module_command(rng: random.Random) -> Step:
    """4.1, 4.3, 4.8, 4.10, and what no firmware knows."""
    pin = rng.choice((0, 1, 3, 6, 7, 99))
    code = rng.choice((0x11, 0x18, 0x19, 0x1C, 0x1F, 0x10, 0x33))
    damaged = normal(b"\x26")[:-2] + b"\x00\x7e"
    junk = rng.randbytes(3).translate(None, b"\x51\x7c")  # 1.2: these begin other packets
    return rng.choice(
        (
            PING,
            step(b"\x26", GET),
            step(b"\x90\x74", GET),
            step(
                b"\x21" + u32(rng.choice((PRESENCE_2, PRESENCE_2, 0x064E57AD, 7))), limit_s=SLOW_S
            ),
            step(b"\x90\x58" + bytes([rng.randrange(12)]), GET),
            step(b"\x90\x50" + bytes([code]), (REPLY, ACK, ERROR)),
            step(b"\x90\x61", GET),
            step(b"\x90\x62"),
            step(b"\x90\x59\x00", (REPLY, ACK, ERROR)),
            step(b"\x40\x10" + u32(pin, rng.randrange(16), rng.randrange(7))),
            step(b"\x40\x11" + u32(pin), GET),
            step(b"\x40\x20" + u32(pin, 1)),
            step(b"\x40\x21" + u32(pin), GET),
            step(b"\x90\x80" + u32(rng.choice((115200, 921600, 5))), silence_s=WAIT_S),
            step(b"\xa0" + rng.randbytes(4), (ERROR,)),
            step(bytes([rng.choice((0x05, 0x51, 0x66, 0xC5))]) + rng.randbytes(3), (ERROR,)),
            step(b"\x02" + u32(0xA2B95EF0), (ERROR,)),
            Step(data=damaged, answers=GET, optional=True),
            Step(data=junk + b"\x7d", answers=(ERROR,), optional=True),
            step(b"\x52\x10" + u32(rng.choice((0x10, 0x12, 0x13, 0x14))), GET),
            step(b"\x50\x12" + u32(0x22) + bytes([rng.randrange(256)]) + rng.randbytes(5)),
            step(b"\x50\x13" + u32(0x22) + bytes([rng.randrange(256)]) + u32(64), GET),
            step(b"\x50\x20", limit_s=SLOW_S),
        )
    )


def bootloader_visit(rng: random.Random) -> list[Step]:
    """4.12: into the bootloader, an image of one page, and out of it."""
    image = rng.randbytes(512)
    pages = (b"\x00\x00", u32(sum(image))), (b"\x00\x80", image)
    ok = (BOOTLOADER_OK,)
    return [
        step(b"\x02" + u32(BOOT_KEY), (ACK,), pause_s=WAIT_S + 3.0),
        step(b"\xc0\x00", ok),
        step(b"\xc0\x01", ok),
        step(b"\xc0\xef" + b"\xe0abc", (0xEF,)),
        *(
            step(b"\xc0\x10" + page + b"\x00" + data.ljust(512, b"\xff"), ok)
            for page, data in pages
        ),
        step(b"\xc0\x20", ok, limit_s=SLOW_S, awaits=is_ready),
    ]


GROUPS: tuple[tuple[float, Callable[[random.Random], Step]], ...] = (
    (0.22, set_x4),
    (0.06, get_x4),
    (0.14, set_mode),
    (0.16, output),
    (0.14, file_command),
    (0.14, profile_setting),
    (0.14, module_command),
)


def sequence(rng: random.Random, *, sensor: bool) -> list[Step]:
    """Return 200 random steps and the proof that the module still works."""
    weights, groups = zip(*GROUPS, strict=True)
    steps: list[Step] = []
    while len(steps) < COMMANDS:
        chance = rng.random()
        if chance < 0.003:
            steps.append(step(RESET, (ACK,), awaits=is_ready))
        elif chance < 0.0035:
            steps += bootloader_visit(rng)
        elif chance < 0.006:
            steps.append(Step(data=PING.data, answers=(PONG,), deaf_s=1.2))
        else:
            steps.append(rng.choices(groups, weights)[0](rng))
    steps += [STOP, MANUAL, INIT] if sensor else [INIT]
    steps.append(step(b"\x50\x10" + u32(0x10) + f32(17.0), (ACK,), awaits=is_first_frame))
    if sensor:
        switched_on = step(b"\x41\x10" + u32(PRESENCE_SINGLE, 1), (ACK,))
        steps += [STOP, LOAD_PRESENCE, switched_on]
        steps.append(step(b"\x20\x01", (ACK,), limit_s=SLOW_S, awaits=is_presence))
    return [*steps, PING]


@dataclass
class Findings:
    """What a run found.

    Attributes
    ----------
    waits_s
        From each command to its answer.
    exits_s
        From each SIGTERM to the end of the process.
    problems
        One line each: where, what was sent, what was wrong.
    """

    sequences: int = 0
    waits_s: list[float] = field(default_factory=list)
    exits_s: list[float] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


class Host:
    """Runs one sequence at one port; `turn` never waits."""

    def __init__(self, name: str, path: str, steps: list[Step], findings: Findings) -> None:
        self.name = name
        self._findings = findings
        self._steps = steps
        self._place = -1
        self._parser = Parser()
        self._unsent = b""
        self._sent_s = self._deaf_until_s = self._paused_until_s = self._silent_until_s = 0.0
        self._answered = False
        self._probing = False  # a PING follows something that may stay unanswered
        self._seen = True
        self.done = False
        self.fd = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        tty.setraw(self.fd)
        self._next(time.monotonic())

    @property
    def listens(self) -> bool:
        return time.monotonic() >= self._deaf_until_s

    def turn(self) -> None:
        now_s = time.monotonic()
        if self.done:
            return
        if self._unsent and now_s >= max(self._deaf_until_s, self._paused_until_s):
            if not self._sent_s:
                self._sent_s = now_s
            with contextlib.suppress(BlockingIOError):
                self._unsent = self._unsent[os.write(self.fd, self._unsent) :]
            return
        if self._unsent:
            return
        one = self._steps[self._place]
        limit_s = BOOT_S if self._answered else one.limit_s
        if now_s - max(self._sent_s, self._silent_until_s) > limit_s:
            self._fail("no answer" if not self._answered else "what should follow does not come")

    def receive(self) -> None:
        try:
            data = os.read(self.fd, 65536)
        except BlockingIOError:
            return
        except OSError as error:
            self._fail(f"the port failed: {error}")
            return
        try:
            for payload in self._parser.payloads(data):
                self._take(payload)
                if self.done:
                    return
        except AssertionError as error:
            self._fail(str(error))

    def _take(self, payload: bytes) -> None:
        one = self._steps[self._place]
        kind = payload[0] if payload else 0
        if kind in (SYSTEM, APPDATA, DATA):
            if self._answered and one.awaits is not None and one.awaits(payload):
                self._next(time.monotonic())
            return
        if self._unsent or self._answered or not self._sent_s:
            self._fail(f"answered twice: {payload[:16].hex()}")
        elif self._probing and kind == PONG:
            self._is_answered(one)
        elif self._probing and not self._seen and kind in one.answers:
            self._seen = True
        elif not self._probing and kind in one.answers:
            self._is_answered(one)
        else:
            self._fail(f"the wrong answer: {payload[:16].hex()}")

    def _is_answered(self, one: Step) -> None:
        now_s = time.monotonic()
        self._findings.waits_s.append(now_s - self._sent_s)
        self._silent_until_s, self._paused_until_s = now_s + one.silence_s, now_s + one.pause_s
        if one.awaits is None:
            self._next(now_s)
        else:
            self._answered, self._sent_s = True, now_s

    def _next(self, now_s: float) -> None:
        self._place += 1
        self._answered, self._sent_s = False, 0.0
        if self._place == len(self._steps):
            self.done = True
            return
        one = self._steps[self._place]
        self._probing, self._seen = one.optional, False
        self._unsent = one.data + (PING.data if one.optional else b"")
        self._deaf_until_s = now_s + one.deaf_s

    def _fail(self, what: str) -> None:
        sent = self._steps[min(self._place, len(self._steps) - 1)].data
        before = [one.data.hex() for one in self._steps[max(self._place - 3, 0) : self._place]]
        self._findings.problems.append(
            f"{self.name}, command {self._place}: {what} to {sent[:24].hex()}, after {before}"
        )
        self.done = True


def run_process(
    seed: int, count: int, findings: Findings, *, pace: str, firmware: str, most: int | None = None
) -> None:
    """Run one emulator of `count` modules, up to `most` steps at each, and end it by SIGTERM."""
    rng, sensor = random.Random(seed), firmware == "sensor"
    name = f"seed {seed}, {pace}, {firmware}"
    command = [sys.executable, "-m", "emulator.cli", "serve", "--bare", "--count", str(count)]
    command += ["--pace", pace, "--option", f"firmware={firmware}", "--seed", str(seed)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            devices = json.loads(process.stdout.readline())["devices"]
            hosts = []
            for number, device in enumerate(devices):
                steps = sequence(random.Random(rng.getrandbits(64)), sensor=sensor)[:most]
                hosts.append(Host(f"{name}, module {number}", device["path"], steps, findings))
            run_hosts(hosts)
            findings.sequences += len(hosts) if most is None else 0
            last = sequence(rng, sensor=sensor)[: rng.randrange(1, 6)]
            for host in hosts:
                with contextlib.suppress(OSError):
                    os.write(host.fd, b"".join(one.data for one in last))
            if process.poll() is not None:
                findings.problems.append(f"{name}: the emulator died")
            asked_s = time.monotonic()
            process.send_signal(signal.SIGTERM)
            try:
                code = process.wait(10 * EXIT_LIMIT_S)
            except subprocess.TimeoutExpired:
                code = None
            took_s = time.monotonic() - asked_s
            findings.exits_s.append(took_s)
            if code != 0 or took_s > EXIT_LIMIT_S:
                findings.problems.append(f"{name}: SIGTERM ends it with {code} in {took_s:.2f} s")
            for host in hosts:
                os.close(host.fd)
        finally:
            process.kill()


def run_hosts(hosts: list[Host]) -> None:
    with selectors.DefaultSelector() as selector:
        for host in hosts:
            selector.register(host.fd, selectors.EVENT_READ, host)
        while waiting := [host for host in hosts if not host.done]:
            for key, _ in selector.select(0.005):
                # one that is done reads on, so that its module does not wait for room
                if key.data.done:
                    with contextlib.suppress(OSError):
                        os.read(key.fd, 65536)
                elif key.data.listens:
                    key.data.receive()
            for host in waiting:
                host.turn()


KINDS = (
    ("asap", "sensor"),
    ("realtime", "sensor"),
    ("asap", "xep"),
    ("realtime", "xep"),
    ("asap", "sensor"),
    ("realtime", "sensor"),
)


def run(
    count: int, seed: int, *, exits: int = 0, report: Callable[[str], None] = lambda text: None
) -> Findings:
    """Run `count` sequences, and the beginnings of others that end with SIGTERM `exits` times.

    Both paces and both firmwares take turns.
    """
    findings, number = Findings(), 0
    while findings.sequences < count or exits > 0:
        before = len(findings.problems)
        pace, firmware = KINDS[number % len(KINDS)]
        modules, most = min(MODULES, count - findings.sequences), None
        if not modules:
            modules, most, exits = 2, random.Random(seed + number).randrange(1, 40), exits - 1
        run_process(seed + number, modules, findings, pace=pace, firmware=firmware, most=most)
        for problem in findings.problems[before:]:
            report(problem)
        number += 1
        report(f"{findings.sequences} sequences, {len(findings.problems)} problems")
    return findings


def _report(text: str) -> None:
    sys.stderr.write(f"{text}\n")


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--count", type=int, default=1000, help="sequences (default 1000)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--exits", type=int, default=100, help="further ends (default 100)")
    asked = parser.parse_args()
    started_s = time.monotonic()
    findings = run(asked.count, asked.seed, exits=asked.exits, report=_report)
    waits_ms = [1000 * wait_s for wait_s in findings.waits_s]
    exits_s = findings.exits_s
    sys.stdout.write(
        f"{findings.sequences} sequences, {len(waits_ms)} answers in "
        f"{time.monotonic() - started_s:.0f} s; "
        f"median {statistics.median(waits_ms):.2f} ms, longest {max(waits_ms):.0f} ms; SIGTERM "
        f"{len(exits_s)} times, median {statistics.median(exits_s):.2f} s, longest "
        f"{max(exits_s):.2f} s; {len(findings.problems)} problems\n"
    )
    return 1 if findings.problems else 0


if __name__ == "__main__":
    sys.exit(main())
