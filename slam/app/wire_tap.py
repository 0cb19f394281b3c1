"""The raw bytes of the radars' ports on their way into a session."""

from __future__ import annotations

from typing import Literal, Protocol

from slam.app.sources import RigSource


class WireSink(Protocol):
    """What takes the bytes; `SessionLog` does."""

    def on_wire(self, radar: str, way: Literal["rx", "tx"], data: bytes, host_ns: int) -> None:
        """Take bytes as a radar's port gave (rx) or took (tx) them, at a host time [ns]."""


class WireTap:
    """Listens at every port of a rig and keeps the bytes until somebody takes them.

    Modules answer for their settings before there is a log, which is told of these answers; the
    bytes of that time wait here.

    Parameters
    ----------
    source
        Radars whose drivers have not been used yet.
    """

    def __init__(self, source: RigSource) -> None:
        self._waiting: list[tuple[str, Literal["rx", "tx"], bytes, int]] = []
        self._sink: WireSink | None = None
        source.listen(self._on_bytes)

    def attach(self, sink: WireSink) -> None:
        """Pass on what came so far, and everything from now on."""
        self._sink = sink
        waiting, self._waiting = self._waiting, []
        for radar, way, data, host_ns in waiting:
            sink.on_wire(radar, way, data, host_ns)

    def _on_bytes(self, radar: str, way: Literal["rx", "tx"], data: bytes, host_ns: int) -> None:
        if self._sink is None:
            self._waiting.append((radar, way, data, host_ns))
        else:
            self._sink.on_wire(radar, way, data, host_ns)
