"""Driver of one X4M300, blocking (`X4M300`) or with asyncio (`async_radar.AsyncX4M300`)."""

from xethru_protocol.driver.frames import Frame, FrameGeometry
from xethru_protocol.driver.link import (
    Listener,
    ModuleInfo,
    Observer,
    ProtocolRecord,
    RawConfig,
    RawListener,
)
from xethru_protocol.driver.radar import X4M300, known_ports

__all__ = [
    "X4M300",
    "Frame",
    "FrameGeometry",
    "Listener",
    "ModuleInfo",
    "Observer",
    "ProtocolRecord",
    "RawConfig",
    "RawListener",
    "known_ports",
]
