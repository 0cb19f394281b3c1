"""Messages over a byte stream, without I/O and without a clock.

``receive_data`` takes bytes from the peer, ``next_event`` returns what they mean,
``send`` gives the bytes for a message. What one side sends is what the other's events are.
"""

from enum import Enum

from xethru_protocol.wire.codec import decode_command, decode_response_at, encode
from xethru_protocol.wire.errors import LocalProtocolError
from xethru_protocol.wire.framing import (
    Direction,
    Framing,
    FramingFault,
    LinkStatistics,
    NeedData,
    PacketReader,
    encode_no_escape,
    encode_normal,
    is_misread,
)
from xethru_protocol.wire.table import ROWS, Command, Message, Response, UnknownMessage


class Role(Enum):
    """Which end of the line we are."""

    HOST = "host"
    MODULE = "module"


Event = Response | Command[Response] | FramingFault | NeedData


class Connection:
    """One end of the line: HOST sends commands and receives responses, MODULE the reverse.

    ``statistics`` may be those of an earlier connection, to count on from there.

    >>> from xethru_protocol.wire.messages import Ping, Pong
    >>> host, module = Connection(Role.HOST), Connection(Role.MODULE)
    >>> module.receive_data(host.send(Ping()))
    >>> module.next_event()
    Ping(seed=4004178606)
    >>> host.receive_data(module.send(Pong(value=0xAAEEAEEA)))
    >>> host.next_event()
    Pong(value=2867769066)
    """

    def __init__(self, role: Role, statistics: LinkStatistics | None = None) -> None:
        self.role = role
        self._is_host = role is Role.HOST
        direction = Direction.FROM_MODULE if self._is_host else Direction.FROM_HOST
        self._reader = PacketReader(direction, statistics)
        self.statistics = self._reader.statistics
        self._next_span = self._reader.next_span

    def receive_data(self, data: bytes) -> None:
        self._reader.receive_data(data)

    def count_in(self, statistics: LinkStatistics) -> None:
        """Count in ``statistics`` from now on, also what was received and not judged yet."""
        statistics.bytes += self.buffered
        self.statistics = self._reader.statistics = statistics

    def next_event(self) -> Event:
        """Next message or `FramingFault`; NEED_DATA if more bytes are needed.

        Unknown and malformed payloads come as `UnknownMessage`. Never raises on what was
        received.
        """
        span = self._next_span()
        if isinstance(span, tuple):
            _, buffer, start, end, _ = span
            message = (
                decode_response_at(buffer, start, end)
                if self._is_host
                else decode_command(buffer[start:end])
            )
            if type(message) is UnknownMessage:
                self.statistics.unknown += 1
            return message
        return span

    @property
    def buffered(self) -> int:
        """Bytes received that have not led to an event yet."""
        return self._reader.buffered

    def send(self, message: Message, framing: Framing | None = None) -> bytes:
        """Bytes that carry ``message``.

        ``framing`` None: as a real module or host frames this message (Protocol reference 1.3).
        Raises `LocalProtocolError` if a field does not fit its place on the wire, or if a module
        would misread the packet (`is_misread`).
        """
        row = ROWS.get(type(message))  # an `UnknownMessage` has none
        usual_bulk = row is not None and row.bulk
        bulk = usual_bulk if framing is None else framing is Framing.NO_ESCAPE
        payload = encode(message, bulk=bulk)
        if self._is_host and not bulk and is_misread(payload):
            raise LocalProtocolError(
                f"{row.name if row else 'an unknown message'} has four bytes 7C in a row, or three "
                "and its checksum; a module takes them for the start of another packet and answers "
                "no more"
            )
        return encode_no_escape(payload) if bulk else encode_normal(payload)
