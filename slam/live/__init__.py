"""Scans of modules and of recorded sessions, as iterators, with their times.

Of what lies below the application only these know the driver.
"""

from typing import TYPE_CHECKING

from slam import loader

if TYPE_CHECKING:
    from slam.live.errors import AppError as AppError
    from slam.live.errors import OdometryError as OdometryError
    from slam.live.errors import RadarSilentError as RadarSilentError
    from slam.live.frame_sources import radar_frame as radar_frame
    from slam.live.odometry_track import OdometryTrack as OdometryTrack
    from slam.live.odometry_track import read_odometry_socket as read_odometry_socket
    from slam.live.rig import LiveRig as LiveRig
    from slam.live.rig import open_rig as open_rig
    from slam.live.session.reader import RecordedSession as RecordedSession
    from slam.live.session.reader import open_session as open_session
    from slam.live.session_records import Scan as Scan

_NAMES = {
    "slam.live.errors": ("AppError", "OdometryError", "RadarSilentError"),
    "slam.live.frame_sources": ("radar_frame",),
    "slam.live.odometry_track": ("OdometryTrack", "read_odometry_socket"),
    "slam.live.rig": ("LiveRig", "open_rig"),
    "slam.live.session.reader": ("RecordedSession", "open_session"),
    "slam.live.session_records": ("Scan",),
}

__all__ = sorted(name for names in _NAMES.values() for name in names)
__getattr__ = loader(_NAMES)
