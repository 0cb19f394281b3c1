"""What a newcomer reads beside the map: the text of the view's first panel, as Markdown."""

from __future__ import annotations

import json

from slam.app.session import SessionInfo

_ABOUT = """\
# What you see

A robot drives through a room and maps it with {n_radars} short-range radars, which tell distances
only. {data}

* **Map** (left, metres, y up). {truth}Orange: where its *wheels* alone say it went. Blue: where
  *radar SLAM* says, with the robot as an arrow. Red dots: *landmarks* it found, each with the
  ellipse that should hold the truth in 95 % of cases.
* **Around the robot**: a grey wedge is what one radar can see. An echo has a distance but no
  direction, so it is an arc: **green** if it moved the estimate, **dim** if not. {points}
* **B-scan** (middle, a tab per radar): echoes of up to {block} frames, time downwards, range to
  the right, constant part removed. A landmark that the robot passes is a curved line.
* **Frame**: the newest raw frame, amplitude over range in metres; red bars are detections.
* **Position error** (below the map): distance to the truth, which SLAM never sees. **NIS**,
  **NEES**: how surprised the filter is by echoes, and how wrong by its own measure; an honest
  filter stays inside the grey 95 % band most of the time. Below it is too modest, above too sure.
* **Links** (right, below): the state of each serial link; losses and faults in the next tab,
  every command and answer under *Log*.

Move the cursor of the time line below. `device_time` is the radars' own time, `frame` their
frame counter, `host_time`, if there, when frames arrived.
"""

_TRUTH = "Grey: the *true* path, and crosses where the landmarks truly are. "
_POINTS = (
    "Yellow points are where two arcs cross (trilateration), of the last {states} states; red "
    "those that no cluster confirmed, large green ones what the clusters pass on."
)


def is_world_known(info: SessionInfo) -> bool:
    """Return whether a view may expect a true path: that of a scene, not of a robot's drive."""
    return len(info.true_landmarks_m) > 0 or len(info.outlines_m) > 0


def about(info: SessionInfo, *, block: int, states: int) -> str:
    """Return the guide for a run: frames in a B-scan, states whose points are on the map."""
    settings = json.loads(info.config_json or "{}")
    return _ABOUT.format(
        n_radars=len(info.radars),
        block=block,
        data="**All data here are simulated.**" if info.simulated else "All data are measured.",
        truth=_TRUTH if is_world_known(info) else "",
        points="" if settings.get("back_end") == "robust" else _POINTS.format(states=states),
    )
