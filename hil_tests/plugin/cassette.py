"""Answers of a module, recorded so that the emulator can be compared with them later.

A cassette is a JSON file: identity, date and target of a module, and per question its name, its
payload, the payload of the answer (null: none), both decoded, and masks. A mask is a pattern for a
field that differs from module to module; everything else of an answer is compared byte for byte.

The questions are those of `EMULATED`, in its order; later answers depend on earlier questions. They
change nothing that outlives a restart and start no frames. Before and after them the module is
stopped, without a profile.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hil_tests.paths import FIXTURES
from xethru_protocol.transport import Transport
from xethru_protocol.wire.codec import decode_command, decode_response, describe
from xethru_protocol.wire.framing import (
    Direction,
    FramingFault,
    NeedData,
    PacketReader,
    encode_normal,
)
from xethru_protocol.wire.messages import (
    Ack,
    Error,
    Pong,
    ReplyByte,
    ReplyFloat,
    ReplyInt,
    ReplyString,
)

EMULATED = FIXTURES / "cassettes" / "emulated.json"
FORMAT = 1
_ANSWERS = (Ack, Error, Pong, ReplyByte, ReplyInt, ReplyFloat, ReplyString)
_ANSWER_LIMIT_S = 1.5  # the vendor's host waits 2 s; answers take milliseconds


class CassetteError(Exception):
    """A file is not a cassette; the message is one line."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Exchange:
    """The payloads of a question and its answer; ``reply`` is None if there was no answer."""

    name: str
    command: bytes
    reply: bytes | None
    masks: Mapping[str, str]

    def as_json(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "command": self.command.hex(),
            "asks": list(describe(decode_command(self.command))),
            "reply": None if self.reply is None else self.reply.hex(),
            "says": None if self.reply is None else list(describe(decode_response(self.reply))),
            "masks": dict(self.masks),
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class Cassette:
    """What one module answered, in order.

    ``recorded`` holds identity, date and target; its ``real_module`` is true for hardware.
    """

    recorded: Mapping[str, Any]
    exchanges: Sequence[Exchange]

    def write(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        lines = ",\n  ".join(json.dumps(exchange.as_json()) for exchange in self.exchanges)
        recorded = json.dumps(self.recorded)
        path.write_text(
            f'{{"format": {FORMAT},\n "recorded": {recorded},\n "exchanges": [\n  {lines}\n ]}}\n',
            "utf-8",
        )

    @classmethod
    def read(cls, path: Path) -> Cassette:
        """Read a file; `CassetteError` if it is not a cassette."""
        try:
            table = json.loads(path.read_text("utf-8"))
            if table["format"] != FORMAT:
                raise CassetteError(
                    f"{path} is a cassette of format {table['format']}, known is {FORMAT}"
                )
            return cls(
                recorded=table["recorded"],
                exchanges=[
                    Exchange(
                        name=entry["name"],
                        command=bytes.fromhex(entry["command"]),
                        reply=None if entry["reply"] is None else bytes.fromhex(entry["reply"]),
                        masks=entry["masks"],
                    )
                    for entry in table["exchanges"]
                ],
            )
        except OSError as error:
            raise CassetteError(f"{path}: {error.strerror}") from None
        except (ValueError, KeyError, TypeError) as error:
            raise CassetteError(f"{path} is not a cassette: {error!r}") from None


def ask_all(
    line: Transport, clock_ns: Callable[[], int], questions: Sequence[Exchange]
) -> Sequence[Exchange]:
    """Ask every question on an open line to a stopped module, without a driver.

    Messages that the module sends unasked are ignored. The line stays open.
    """
    reader = PacketReader(Direction.FROM_MODULE)
    return [
        replace(asked, reply=_answer(line, reader, clock_ns, asked.command)) for asked in questions
    ]


def _answer(
    line: Transport, reader: PacketReader, clock_ns: Callable[[], int], command: bytes
) -> bytes | None:
    line.write(encode_normal(command))
    deadline_ns = clock_ns() + round(_ANSWER_LIMIT_S * 1e9)
    while (left_ns := deadline_ns - clock_ns()) > 0:
        reader.receive_data(line.read(left_ns * 1e-9))
        while not isinstance(found := reader.next_packet(), NeedData):
            if not isinstance(found, FramingFault) and isinstance(
                decode_response(found.payload), _ANSWERS
            ):
                return bytes(found.payload)
    return None


def differences(recorded: Sequence[Exchange], now: Sequence[Exchange]) -> Sequence[str]:
    """Return a line per answer of the emulator that differs, by the masks of ``recorded``."""
    lines = []
    for module, emulator in zip(recorded, now, strict=True):
        if module.command != emulator.command:
            lines.append(f"{module.name}: other questions were asked")
        elif not _same(module, emulator):
            lines.append(
                f"{module.name}: module {_text(module.reply)}, emulator {_text(emulator.reply)}"
            )
    return lines


def _same(module: Exchange, emulator: Exchange) -> bool:
    if module.reply == emulator.reply:
        return True
    if module.reply is None or emulator.reply is None or not module.masks:
        return False
    name, fields = describe(decode_response(module.reply))
    other_name, other_fields = describe(decode_response(emulator.reply))
    if name != other_name or fields.keys() != other_fields.keys():
        return False
    return module.masks.keys() <= fields.keys() and all(
        _masked(module.masks[key], value, other_fields[key])
        if key in module.masks
        else value == other_fields[key]
        for key, value in fields.items()
    )


def _masked(pattern: str, one: object, other: object) -> bool:
    return all(re.fullmatch(pattern, str(value)) is not None for value in (one, other))


def _text(reply: bytes | None) -> str:
    if reply is None:
        return "nothing"
    name, fields = describe(decode_response(reply))
    return f"{name} {json.dumps(fields)} ({reply.hex(' ').upper()})"
