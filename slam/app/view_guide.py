"""What a newcomer reads beside the map: the text of the view's first panel, as Markdown."""

ABOUT = """\
# What you see

* **Map** (left, metres, y up): the robot's *true* path in grey, *wheel odometry* in orange, the
  path *estimated* by radar SLAM in blue. Grey crosses are the true landmarks; red dots are the
  estimated ones, each with the ellipse that should hold the truth in 95 % of cases.
* **B-scan** (middle, top): echoes of one radar, range to the right, time downwards; each picture
  is {block} frames with the constant part removed. Landmarks are the curved lines.
* **Frame** (middle): the newest raw frame of one radar, all its range bins.
* **Pose error** compares with the truth, which SLAM never sees. **NIS** is the mean surprise of
  gated associations only, in units of what the filter expected; far below 1 with Table I's noise.
* **Link**: commands, answers and faults on the serial ports.

Move the time cursor below; `device_time` is the radar's own time, `frame` its frame counter.
All data of this file are {origin}.
"""
