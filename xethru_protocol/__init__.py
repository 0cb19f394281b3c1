"""XeThru X4M300 radar modules: driver, serial protocol, recordings.

::

    from xethru_protocol import X4M300

    with X4M300.open("/dev/ttyACM0") as radar:
        radar.configure_raw()
        radar.start(17)
        frame = radar.read_frame()

``help(X4M300)`` goes on from here. The names below are imported when they are first used; all else
is in `driver`, `wire` (messages and codes), `recordings` and `transport`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from xethru_protocol.driver.async_radar import AsyncX4M300
    from xethru_protocol.driver.frames import Frame, FrameGeometry
    from xethru_protocol.driver.link import RawConfig
    from xethru_protocol.driver.radar import X4M300
    from xethru_protocol.recordings import Recorder, RecordingReader, load, read_recording
    from xethru_protocol.transport import find_ports
    from xethru_protocol.wire.codes import NoiseMapControl, OutputFeature, ProfileId
    from xethru_protocol.wire.errors import (
        DeviceError,
        Disconnected,
        LocalProtocolError,
        PortUnavailable,
        RemoteProtocolError,
        ResponseTimeout,
        XeThruError,
    )

__all__ = [
    "X4M300",
    "AsyncX4M300",
    "DeviceError",
    "Disconnected",
    "Frame",
    "FrameGeometry",
    "LocalProtocolError",
    "NoiseMapControl",
    "OutputFeature",
    "PortUnavailable",
    "ProfileId",
    "RawConfig",
    "Recorder",
    "RecordingReader",
    "RemoteProtocolError",
    "ResponseTimeout",
    "XeThruError",
    "find_ports",
    "load",
    "read_recording",
]

_HOMES = {
    "driver.radar": ("X4M300",),
    "driver.async_radar": ("AsyncX4M300",),
    "driver.frames": ("Frame", "FrameGeometry"),
    "driver.link": ("RawConfig",),
    "recordings": ("Recorder", "RecordingReader", "load", "read_recording"),
    "transport": ("find_ports",),
    "wire.codes": ("NoiseMapControl", "OutputFeature", "ProfileId"),
    "wire.errors": (
        *("DeviceError", "Disconnected", "LocalProtocolError", "PortUnavailable"),
        *("RemoteProtocolError", "ResponseTimeout", "XeThruError"),
    ),
}


def __getattr__(name: str) -> Any:  # noqa: ANN401 - type checkers read the imports above
    for home, names in _HOMES.items():
        if name in names:
            return getattr(import_module(f"{__name__}.{home}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
