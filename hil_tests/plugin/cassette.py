"""Answers of a module, written down so that the emulator can be held against them ever after.

They change nothing that outlives a restart, send no frames, and end as they begin: stopped, without
a profile. A mask is a pattern for a field that differs from module to module; everything else of an
answer is compared byte for byte.

A cassette is JSON: who answered, and per question its payload, the payload of the answer (null:
silence), both decoded for people, and the masks under which answers count as the same.
"""

from __future__ import annotations

import datetime
import json
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from xethru_protocol.transport import Transport
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codec import decode_command, decode_response, describe, encode
from xethru_protocol.wire.codes import InfoItem, OutputFeature, ProfileId, SensorMode, X4Setting
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

_VERSION = r"[0-9]+\.[0-9]+\.[0-9]+.*"
_ANYTHING = r"(?s).*"
_NUMBERS = r"\[-?[0-9]+(, -?[0-9]+)*\]"


@dataclass(frozen=True, slots=True, kw_only=True)
class Transaction:
    """One question.

    Attributes
    ----------
    name
        What it is called in tables and cassettes; unique.
    command
        The question.
    masks
        Fields of the answer that may differ, each with a pattern that both values match.
    """

    name: str
    command: m.Command[m.Response]
    masks: Mapping[str, str] = field(default_factory=dict)


def _pings() -> Sequence[Transaction]:
    return [
        Transaction(name=f"ping {seed:08X}", command=m.Ping(seed=seed))
        for seed in (0xEEAAEAAE, 0, 0x7D7E7F7D)
    ]


def _identity() -> Sequence[Transaction]:
    masks = {
        InfoItem.XTID_SSIC_ITEMNUMBER: r"[0-9]{6}-[0-9]{3}",
        InfoItem.XTID_SSIC_FIRMWAREID: r"\w+",
        InfoItem.XTID_SSIC_VERSION: _VERSION,
        InfoItem.XTID_SSIC_BUILD: _VERSION,
        InfoItem.XTID_SSIC_SERIALNUMBER: r"[0-9]{12}",
        InfoItem.XTID_SSIC_VERSIONLIST: r".*XEP:.*",
        InfoItem.XTID_SSIC_SYSTEMCOREID: _ANYTHING,
        InfoItem.XTID_SSIC_BOOTLOADER: _ANYTHING,
    }
    told = [
        Transaction(
            name=f"info {item.name.removeprefix('XTID_SSIC_').lower()}",
            command=m.SystemGetInfo(item=item),
            masks={"value": masks[item]} if item in masks else {},
        )
        for item in InfoItem
    ]
    return [*told, Transaction(name="info unknown", command=m.SystemGetInfo(item=0x55))]


def _modes() -> Sequence[Transaction]:
    presence = ProfileId.XTS_ID_APP_PRESENCE_2
    return [
        Transaction(name="mode", command=m.GetMode()),
        Transaction(name="profile id without profile", command=m.GetProfileId()),
        Transaction(name="stop twice", command=m.SetMode(mode=SensorMode.XTID_SM_STOP)),
        Transaction(name="run without profile", command=m.SetMode(mode=SensorMode.XTID_SM_RUN)),
        Transaction(name="idle without profile", command=m.SetMode(mode=SensorMode.XTID_SM_IDLE)),
        Transaction(name="unknown mode", command=m.SetMode(mode=0x77)),
        Transaction(name="sensitivity without profile", command=m.GetSensitivity()),
        Transaction(name="zone without profile", command=m.GetDetectionZone()),
        Transaction(name="load unknown profile", command=m.LoadApp(profile_id=0x12345678)),
        Transaction(name="load presence", command=m.LoadApp(profile_id=presence)),
        Transaction(name="profile id", command=m.GetProfileId()),
        Transaction(name="mode with profile", command=m.GetMode()),
    ]


def _profile() -> Sequence[Transaction]:
    settings: list[Transaction] = [
        Transaction(name="zone limits", command=m.GetDetectionZoneLimits())
    ]
    for start_m, end_m in ((0.4, 5.0), (1.0, 2.0), (0.4, 9.4)):
        settings += [
            Transaction(
                name=f"set zone {start_m} {end_m}",
                command=m.SetDetectionZone(start_m=start_m, end_m=end_m),
            ),
            Transaction(name=f"zone {start_m} {end_m}", command=m.GetDetectionZone()),
        ]
    for value in (0, 9, 5):
        settings += [
            Transaction(
                name=f"set sensitivity {value}", command=m.SetSensitivity(sensitivity=value)
            ),
            Transaction(name=f"sensitivity {value}", command=m.GetSensitivity()),
        ]
    for band in (4, 3):
        command = m.SetTxCenterFrequency(tx_center_frequency=band)
        settings += [
            Transaction(name=f"set band {band}", command=command),
            Transaction(name=f"band {band}", command=m.GetTxCenterFrequency()),
        ]
    for control in (3, 6):
        settings += [
            Transaction(
                name=f"set noise map {control}", command=m.NoiseMapSetControl(control=control)
            ),
            Transaction(name=f"noise map {control}", command=m.NoiseMapGetControl()),
        ]
    for feature in (OutputFeature.BASEBAND_IQ, OutputFeature.BASEBAND_AMPLITUDE_PHASE):
        name = feature.name.lower()
        settings += [
            Transaction(
                name=f"set output {name}", command=m.OutputSetControl(feature=feature, control=1)
            ),
            Transaction(name=f"output {name}", command=m.OutputGetControl(feature=feature)),
        ]
    settings.append(
        Transaction(
            name="the other output is off",
            command=m.OutputGetControl(feature=OutputFeature.BASEBAND_IQ),
        )
    )
    settings.append(Transaction(name="unload", command=m.SetMode(mode=SensorMode.XTID_SM_STOP)))
    return settings


def _x4() -> Sequence[Transaction]:
    listed: list[Transaction] = [
        Transaction(name="manual", command=m.SetMode(mode=SensorMode.XTID_SM_MANUAL)),
        Transaction(name="x4 init", command=m.X4DriverInit()),
    ]
    registers = {X4Setting.SPIREGISTER, X4Setting.PIFREGISTER, X4Setting.XIFREGISTER}
    listed += [
        Transaction(name=f"default {setting.name.lower()}", command=m.X4DriverGet(setting=setting))
        for setting in X4Setting
        if setting not in registers
    ]
    listed += [
        Transaction(
            name=f"spi register {address}",
            command=m.X4DriverGet(setting=X4Setting.SPIREGISTER, address=address),
        )
        for address in range(4)
    ]
    values: Sequence[tuple[X4Setting, Sequence[m.X4Value]]] = (
        (X4Setting.PULSESPERSTEP, (0x7D, 0x7E, 0x7F, 300)),
        (X4Setting.ITERATIONS, (0x7D, 0x7E, 0x7F, 16)),
        (X4Setting.DACMIN, (0x7F, 949, 2048)),
        (X4Setting.DACMAX, (0x7F, 1100, 2048)),
        (X4Setting.DACSTEP, (3, 4, 0)),
        (X4Setting.TXPOWER, (0, 3, 4, 2)),
        (X4Setting.TXCENTERFREQUENCY, (4, 5, 3)),
        (X4Setting.PRFDIV, (4, 3, 16)),
        (X4Setting.FRAMEAREAOFFSET, (0.0, 0.2, 0.18)),
        (X4Setting.FRAMEAREA, ((5.0, 0.4), (0.0, 9.9), (-0.5, 5.0), (0.2, 9.4))),
        (X4Setting.DOWNCONVERSION, (1, 0)),
    )
    for setting, wanted in values:
        for value in wanted:
            name = f"{setting.name.lower()} {value}"
            listed += [
                Transaction(
                    name=f"set {name}", command=m.X4DriverSet(setting=setting, value=value)
                ),
                Transaction(name=name, command=m.X4DriverGet(setting=setting)),
                Transaction(
                    name=f"bins with {name}",
                    command=m.X4DriverGet(setting=X4Setting.FRAMEBINCOUNT),
                ),
            ]
    listed.append(Transaction(name="end", command=m.SetMode(mode=SensorMode.XTID_SM_STOP)))
    return listed


def _files() -> Sequence[Transaction]:
    return [
        Transaction(name="all files", command=m.FindAllFiles(), masks={"values": _ANYTHING}),
        Transaction(
            name="length of no file",
            command=m.GetFileLength(file_type=0x8000007D, identifier=0x7E7E7E7E),
        ),
        Transaction(
            name="read of no file",
            command=m.GetFileData(file_type=0x8000007D, identifier=0x7E7E7E7E, offset=0, length=16),
        ),
        Transaction(
            name="crash dump length", command=m.GetCrashDumpLength(), masks={"values": _NUMBERS}
        ),
        Transaction(name="format with a wrong key", command=m.FormatFilesystem(key=0)),
    ]


def _others() -> Sequence[Transaction]:
    return [
        Transaction(name="unhandled command", command=m.SystemGetDebugData(item=0)),
        Transaction(name="baud rate of no module", command=m.SetBaudRate(baudrate=300)),
        Transaction(name="debug level", command=m.DebugLevel(level=0)),
        Transaction(name="ping at the end", command=m.Ping()),
    ]


TRANSACTIONS: Sequence[Transaction] = (
    *_pings(),
    *_identity(),
    *_modes(),
    *_profile(),
    *_x4(),
    *_files(),
    *_others(),
)
"""In the order in which they are asked; later answers depend on earlier questions."""


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
