"""What the threads of a run tell its main loop, in the order they learnt of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

from xethru_protocol.driver import Frame, ProtocolRecord


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameCame:
    """A frame of a radar of the rig; it knows when it arrived."""

    radar: int
    frame: Frame


@dataclass(frozen=True, slots=True, kw_only=True)
class RadarLost:
    """A radar sends no more; `text` says why. It is looked for."""

    radar: int
    text: str


@dataclass(frozen=True, slots=True, kw_only=True)
class RadarBack:
    """A radar that was lost sends again, from a port."""

    radar: int
    port: str


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkSaid:
    """A line of the protocol log of a radar."""

    radar: str
    record: ProtocolRecord


@dataclass(frozen=True, slots=True, kw_only=True)
class WireCame:
    """Bytes as they went over a radar's port."""

    radar: str
    way: Literal["rx", "tx"]
    data: bytes
    host_ns: int


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryLine:
    """A line of the odometry's source, and the host's time when it came."""

    text: str
    arrival_ns: int


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryEnded:
    """No more lines will come; `trouble` says why, "" where the source just ended."""

    trouble: str


Event: TypeAlias = (
    FrameCame | RadarLost | RadarBack | LinkSaid | WireCame | OdometryLine | OdometryEnded
)
