"""What passes a module's port, read along: which answer belongs to which command, which samples.

Reads only; the bytes go their own way.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from emulator.faults.packets import PacketClass, frame_counter, response_bytes
from xethru_protocol.codec import decode_command
from xethru_protocol.codes import SystemCode, X4Setting
from xethru_protocol.errors import LocalProtocolError
from xethru_protocol.framing import PacketReader
from xethru_protocol.lattice import Lattice
from xethru_protocol.messages import Command, Response, System, X4DriverInit, X4DriverSet
from xethru_protocol.packets import NeedData, Packet
from xethru_protocol.plausibility import Direction

__all__ = ["HostPiece", "Watch"]

_MOST_PENDING = 64  # a module takes no more commands than it can answer
_BOOTING = response_bytes(System(code=SystemCode.XTS_SPRS_BOOTING))
_LATTICE_SETTINGS = {
    X4Setting.ITERATIONS: "iterations",
    X4Setting.PULSESPERSTEP: "pulses_per_step",
    X4Setting.DACMIN: "dac_min",
    X4Setting.DACMAX: "dac_max",
    X4Setting.DACSTEP: "dac_step",
    X4Setting.DOWNCONVERSION: "downconversion",
    X4Setting.TXCENTERFREQUENCY: "tx_center_frequency",
}


class HostPiece(NamedTuple):
    """Bytes from the host; ``command`` is the one they are, None for damaged ones."""

    data: bytes
    command: Command[Response] | None


class _Pending(NamedTuple):
    command: Command[Response]
    silent: bool


class Watch:
    """Reads along at one port.

    Attributes
    ----------
    counter
        Of the last radar frame; None before the first.
    frame, previous_frame
        The last radar frame from the module and the one before it, as bytes.
    """

    def __init__(self) -> None:
        self.counter: int | None = None
        self.frame: bytes | None = None
        self.previous_frame: bytes | None = None
        self._settings: dict[str, int] = {}
        self._lattice: Lattice | None = None
        self._pending: deque[_Pending] = deque(maxlen=_MOST_PENDING)
        self._reader = PacketReader(Direction.FROM_HOST)
        self._unjudged = bytearray()

    @property
    def lattice(self) -> Lattice | None:
        """Values that samples have under the settings seen; None while one is not known."""
        if self._lattice is None and len(self._settings) == len(_LATTICE_SETTINGS):
            values = dict(self._settings)
            downconversion = bool(values.pop("downconversion"))
            try:
                self._lattice = Lattice.of(**values, downconversion=downconversion)
            except LocalProtocolError:
                self._settings.clear()  # until others are set
        return self._lattice

    @property
    def half_command(self) -> bytes:
        """Bytes from the host that are not judged yet."""
        return bytes(self._unjudged)

    def host_pieces(self, data: bytes) -> list[HostPiece]:
        """Cut what the host says into commands and what is none; the rest waits for more."""
        self._unjudged += data
        self._reader.receive_data(data)
        pieces = []
        while not isinstance(found := self._reader.next_packet(), NeedData):
            end = len(self._unjudged) - self._reader.buffered
            piece = bytes(self._unjudged[:end])
            del self._unjudged[:end]
            whole = isinstance(found, Packet)
            command = decode_command(found.payload) if isinstance(found, Packet) else None
            if piece or whole:
                pieces.append(HostPiece(piece, command))
        return pieces

    def command_sent(self, command: Command[Response], *, silent: bool = False) -> None:
        """Learn that the module got a command; ``silent`` if the host shall not see its answer."""
        self._pending.append(_Pending(command, silent))
        if isinstance(command, X4DriverInit):
            self._settings.clear()
            self._lattice = None
        elif isinstance(command, X4DriverSet) and isinstance(command.value, int):
            name = _LATTICE_SETTINGS.get(command.setting)
            if name is not None:
                self._settings[name] = command.value
                self._lattice = None

    def answered(self) -> tuple[Command[Response] | None, bool]:
        """Return the command that a reply answers, and whether the host shall not see it."""
        if not self._pending:
            return None, False
        pending = self._pending.popleft()
        return pending.command, pending.silent

    def sent(self, packet: bytes, packet_class: PacketClass) -> None:
        """Learn what the module sent."""
        if packet_class is PacketClass.FRAME:
            self.previous_frame, self.frame = self.frame, packet
            self.counter = frame_counter(packet)
        elif self.is_booting(packet):
            self.restarted()

    def restarted(self) -> None:
        """Learn that the module forgot everything."""
        self._pending.clear()
        self._settings.clear()
        self._lattice = None

    @staticmethod
    def is_booting(packet: bytes) -> bool:
        """Whether a packet says that the module restarted."""
        return packet == _BOOTING
