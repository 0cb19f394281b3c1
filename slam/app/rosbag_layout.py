"""Topics of the paper's authors' data set, and where their radars sit.

Their bags hold, per radar, `/UWBradar<k>/readings` (in earlier ones `/UWBradar<k>`) with one frame
per message as std_msgs/Float32MultiArray, which has neither stamp nor counter; `/odom` as
nav_msgs/Odometry; and a pose by laser as truth: Hector SLAM's `/slam_out_pose`, a
geometry_msgs/PoseStamped. Radars 2 and 4 look to the left, 1 and 3 to the right, as their public
launch file pairs them; each data set says so in a file of its own, so a rig file can say otherwise.

What this program writes has two more kinds of topic, std_msgs/String with JSON, so that nothing is
lost on the way back: `/UWBradar<k>/info` and `/session`.
"""

from __future__ import annotations

import math
import re

from slam.geometry import Mount, Rig

ODOMETRY_TOPIC = "/odom"
TRUTH_TOPIC = "/slam_out_pose"
SESSION_TOPIC = "/session"

_FRAMES = re.compile(r"/?(UWBradar(\d+))(/readings)?")
_INFO = re.compile(r"/?(UWBradar(\d+))/info")

AUTHORS_RIG = Rig(
    mounts=(
        Mount(name="UWBradar1", x_m=0.1, y_m=-0.2, yaw_rad=-math.pi / 2),
        Mount(name="UWBradar2", x_m=-0.1, y_m=0.2, yaw_rad=math.pi / 2),
        Mount(name="UWBradar3", x_m=-0.1, y_m=-0.2, yaw_rad=-math.pi / 2),
        Mount(name="UWBradar4", x_m=0.1, y_m=0.2, yaw_rad=math.pi / 2),
    )
)
"""The paper's mounts under the names of their topics."""


def frames_topic(radar: int) -> str:
    """Return the topic of the frames of a radar by its index, from 0.

    >>> frames_topic(0)
    '/UWBradar1/readings'
    """
    return f"/UWBradar{radar + 1}/readings"


def info_topic(radar: int) -> str:
    """Return the topic that says what a radar is."""
    return f"/UWBradar{radar + 1}/info"


def radar_of_frames(topic: str) -> str | None:
    """Return the radar whose frames a topic holds, None for other topics.

    >>> radar_of_frames("UWBradar3"), radar_of_frames("/UWBradar3/readings"), radar_of_frames("/x")
    ('UWBradar3', 'UWBradar3', None)
    """
    found = _FRAMES.fullmatch(topic)
    return found[1] if found else None


def radar_of_info(topic: str) -> str | None:
    """Return the radar that a topic tells of, None for other topics."""
    found = _INFO.fullmatch(topic)
    return found[1] if found else None


def radar_order(name: str) -> int:
    """Return the number in a radar's name, by which radars are ordered."""
    return int(name.removeprefix("UWBradar"))
