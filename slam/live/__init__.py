"""Scans of modules and of recorded sessions, as iterators, with their times.

Of what lies below the application only these know the driver.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from slam.live.errors import AppError, OdometryError, RadarSilentError
    from slam.live.frame_sources import radar_frame
    from slam.live.odometry_track import OdometryTrack, read_odometry_socket
    from slam.live.rig import LiveRig, open_rig
    from slam.live.session.reader import RecordedSession, open_session
    from slam.live.session_records import Scan

_HOMES = {
    "AppError": "errors",
    "LiveRig": "rig",
    "OdometryError": "errors",
    "OdometryTrack": "odometry_track",
    "RadarSilentError": "errors",
    "RecordedSession": "session.reader",
    "Scan": "session_records",
    "open_rig": "rig",
    "open_session": "session.reader",
    "radar_frame": "frame_sources",
    "read_odometry_socket": "odometry_track",
}
"""Where each name is defined; a name is loaded when it is first used."""

__all__ = [
    "AppError",
    "LiveRig",
    "OdometryError",
    "OdometryTrack",
    "RadarSilentError",
    "RecordedSession",
    "Scan",
    "open_rig",
    "open_session",
    "radar_frame",
    "read_odometry_socket",
]


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = found = getattr(import_module(f"slam.live.{_HOMES[name]}"), name)
    return found
