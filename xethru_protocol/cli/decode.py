"""``xethru decode``: captured bytes to messages, packet by packet as they come."""

import json
import sys
from collections.abc import Iterable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import BinaryIO

from xethru_protocol.cli.output import print_json, warn
from xethru_protocol.codec import decode_command, decode_response, describe, encode
from xethru_protocol.codes import PongCode
from xethru_protocol.errors import LocalProtocolError, XeThruError
from xethru_protocol.framing import PacketReader
from xethru_protocol.messages import Ack, Message, Pong, UnknownMessage
from xethru_protocol.packets import Framing, FramingFault, Packet
from xethru_protocol.plausibility import Direction
from xethru_protocol.recordings.wire_capture import MAGIC as WIRE_CAPTURE
from xethru_protocol.statistics import LinkStatistics
from xethru_protocol.wire import hex_bytes

_CHUNK_BYTES = 65536


class DecodeError(XeThruError):
    """The input cannot be read as what it was said to be."""


def decode(file: str | None, *, is_hex: bool, sender: str, with_statistics: bool = False) -> int:
    """Print one JSON object per packet and per fault; totals at the end, on stderr, if wanted."""
    name = file or "standard input"
    statistics = LinkStatistics()
    if file is None and sys.stdin is None:
        raise DecodeError("standard input is closed; there is nothing to decode")
    try:
        with Path(file).open("rb") if file else nullcontext(sys.stdin.buffer) as source:
            if is_hex:
                for number, line in enumerate(source, start=1):
                    _print_all(iter((_from_hex(line, name, number),)), sender, statistics)
            else:
                _print_all(_chunks(source, name), sender, statistics)
    except BrokenPipeError:  # of stdout
        raise
    except OSError as error:
        raise DecodeError(f"{name} cannot be read: {error.strerror}") from None
    finally:
        if with_statistics:
            warn(json.dumps(statistics.summary()))
    return 0


def found_in(
    chunks: Iterable[bytes], sender: str, statistics: LinkStatistics
) -> Iterator[Packet | FramingFault]:
    """Packets and faults of a stream that comes in chunks, each as soon as it can be told."""
    direction = Direction.FROM_HOST if sender == "host" else Direction.FROM_MODULE
    reader = PacketReader(direction, statistics)
    for chunk in chunks:
        reader.receive_data(chunk)
        while isinstance(found := reader.next_packet(), Packet | FramingFault):
            yield found
    reader.end_data()
    while isinstance(found := reader.next_packet(), Packet | FramingFault):
        yield found


def message_of(packet: Packet, sender: str) -> Message:
    """Message of a packet from ``sender``: "host", "module", or "auto" to judge by structure.

    Of two readings the one that explains every byte wins. PING and PONG look alike: a value
    that modules answer with is a PONG. An ACK is its code alone: with more behind it the code
    is APPCOMMAND's, also if its content is not known.
    """
    payload = packet.payload
    if sender == "host":
        return decode_command(payload)
    response = decode_response(payload)
    if sender == "module" or packet.framing is Framing.NO_ESCAPE:
        return response
    command = decode_command(payload)
    if isinstance(response, Ack) and len(payload) == 1:
        return response
    if not _explains(command, payload):
        return command if isinstance(response, UnknownMessage | Ack) else response
    if isinstance(response, Pong):
        return response if response.value in set(PongCode) else command
    return response if _explains(response, payload) else command


def _explains(message: Message, payload: bytes) -> bool:
    try:
        return not isinstance(message, UnknownMessage) and encode(message, bulk=False) == payload
    except LocalProtocolError:
        return False


def _print_all(chunks: Iterable[bytes], sender: str, statistics: LinkStatistics) -> None:
    for found in found_in(chunks, sender, statistics):
        if isinstance(found, FramingFault):
            print_json({"fault": found.kind.value, "offset": found.offset})
            continue
        message = message_of(found, sender)
        statistics.unknown += isinstance(message, UnknownMessage)
        name, shown = describe(message)
        print_json(
            {
                "framing": found.framing.value,
                "payload_hex": hex_bytes(found.payload),
                "message": name,
                "fields": shown,
            }
        )


def _chunks(source: BinaryIO, name: str) -> Iterator[bytes]:
    read = getattr(source, "read1", source.read)  # read1 returns what there is, not a full chunk
    chunk = read(_CHUNK_BYTES)
    if chunk.startswith(WIRE_CAPTURE):
        raise DecodeError(f"{name} is a wire capture and no bare bytes; use xethru dump")
    while chunk:
        yield chunk
        chunk = read(_CHUNK_BYTES)


def _from_hex(line: bytes, name: str, number: int) -> bytes:
    try:
        return bytes.fromhex(line.decode("ascii"))
    except ValueError:
        text = line.strip()[:40].decode("ascii", "replace")
        raise DecodeError(
            f"{name} line {number} is not hexadecimal bytes: {text!r}; write them like 7D 10 6D 7E"
        ) from None
