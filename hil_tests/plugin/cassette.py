"""Answers of a module, written down so that the emulator can be held against them ever after.

A cassette is JSON: who answered, and per question its payload, the payload of the answer (null:
silence), both decoded for people, and the masks under which answers count as the same.
"""

from __future__ import annotations

import datetime
import json
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hil_tests.plugin.transactions import TRANSACTIONS, Transaction
from xethru_protocol.codec import decode_command, decode_response, describe, encode
from xethru_protocol.framing import PacketReader, encode_normal
from xethru_protocol.messages import Ack, Error, Pong, ReplyByte, ReplyFloat, ReplyInt, ReplyString
from xethru_protocol.packets import FramingFault, NeedData
from xethru_protocol.plausibility import Direction
from xethru_protocol.transport import Transport

__all__ = ["Cassette", "CassetteError", "Exchange", "ask_all", "differences"]

FORMAT = 1
_ANSWERS = (Ack, Error, Pong, ReplyByte, ReplyInt, ReplyFloat, ReplyString)
_PATIENCE_S = 1.5  # the vendor's host waits 2 s; answers take milliseconds


class CassetteError(Exception):
    """A file that is no cassette; the message is one line."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Exchange:
    """A question and its answer.

    Attributes
    ----------
    name
        Of the transaction.
    command, reply
        Payloads; ``reply`` is None where nothing came.
    masks
        Fields that may differ, with a pattern for each.
    """

    name: str
    command: bytes
    reply: bytes | None
    masks: Mapping[str, str]

    def as_json(self) -> dict[str, Any]:
        """JSON-able, decoded for people beside the bytes."""
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
    """What one module answered.

    Attributes
    ----------
    recorded
        Who, where, when, with what; ``real_module`` says whether it was hardware.
    exchanges
        In order.
    """

    recorded: Mapping[str, Any]
    exchanges: Sequence[Exchange]

    def write(self, path: Path) -> None:
        """Write the file, replacing an older one."""
        path.parent.mkdir(parents=True, exist_ok=True)
        lines = ",\n  ".join(json.dumps(exchange.as_json()) for exchange in self.exchanges)
        recorded = json.dumps(self.recorded)
        path.write_text(
            f'{{"format": {FORMAT},\n "recorded": {recorded},\n "exchanges": [\n  {lines}\n ]}}\n',
            "utf-8",
        )

    @classmethod
    def read(cls, path: Path) -> Cassette:
        """Read a file; `CassetteError` if it is none."""
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
            raise CassetteError(f"{path} is no cassette: {error!r}") from None

    @property
    def transactions(self) -> Sequence[Transaction]:
        """The questions of the cassette, to be asked again."""
        return [
            Transaction(
                name=exchange.name, command=decode_command(exchange.command), masks=exchange.masks
            )
            for exchange in self.exchanges
        ]


def ask_all(
    line: Transport,
    clock_ns: Callable[[], int] = time.monotonic_ns,
    transactions: Sequence[Transaction] = TRANSACTIONS,
) -> Sequence[Exchange]:
    """Ask every question on an open line to a stopped module, past the driver: bytes count here.

    What a module sends of its own accord is passed over. The line is left open.
    """
    reader = PacketReader(Direction.FROM_MODULE)
    return [_ask(line, reader, clock_ns, one) for one in transactions]


def _ask(
    line: Transport, reader: PacketReader, clock_ns: Callable[[], int], asked: Transaction
) -> Exchange:
    payload = encode(asked.command)
    line.write(encode_normal(payload))
    deadline_ns = clock_ns() + round(_PATIENCE_S * 1e9)
    reply: bytes | None = None
    while reply is None and (left_ns := deadline_ns - clock_ns()) > 0:
        reader.receive_data(line.read(left_ns * 1e-9))
        while reply is None and not isinstance(found := reader.next_packet(), NeedData):
            if not isinstance(found, FramingFault) and isinstance(
                decode_response(found.payload), _ANSWERS
            ):
                reply = bytes(found.payload)
    return Exchange(name=asked.name, command=payload, reply=reply, masks=asked.masks)


def differences(recorded: Sequence[Exchange], now: Sequence[Exchange]) -> Sequence[str]:
    """Return a line for each answer that differs, through the masks of ``recorded``.

    Parameters
    ----------
    recorded
        The module's answers.
    now
        The emulator's, to the same questions.
    """
    lines = []
    for module, emulator in zip(recorded, now, strict=True):
        if module.command != emulator.command:
            lines.append(f"{module.name}: other questions were asked")
        elif not _same(module, emulator):
            lines.append(
                f"{module.name}: module {_said(module.reply)}, emulator {_said(emulator.reply)}"
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


def _said(reply: bytes | None) -> str:
    if reply is None:
        return "nothing"
    name, fields = describe(decode_response(reply))
    return f"{name} {json.dumps(fields)} ({reply.hex(' ').upper()})"


def today() -> str:
    """Return the date, ISO 8601, UTC."""
    return datetime.datetime.now(datetime.UTC).date().isoformat()
