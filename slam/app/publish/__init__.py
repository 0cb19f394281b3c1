"""Where a run is published while it happens, a file per kind of sink.

Importing this package loads nothing heavy: the module of a sink is imported when one is asked for.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple


class SinkKind(NamedTuple):
    """A row of the table of sinks: "module:class" of a `Sink`, and what users write."""

    sink: str
    help: str


SINKS: Mapping[str, SinkKind] = {
    "jsonl": SinkKind(
        "slam.app.publish.json_lines:JsonLinesSink",
        "jsonl:FILE or jsonl:- (standard output): a line of JSON for every pose",
    ),
    "udp": SinkKind("slam.app.publish.udp:UdpSink", "udp://HOST:PORT: the same as datagrams"),
    "foxglove": SinkKind(
        "slam.app.publish.foxglove:FoxgloveSink",
        "foxglove or foxglove:[HOST:]PORT: a server for Foxglove and Lichtblick",
    ),
    "ros2": SinkKind(
        "slam.app.publish.ros2:Ros2Sink",
        "ros2 or ros2:NAMESPACE: topics and tf of ROS 2; with ,frames behind it frames of the "
        "radars, too",
    ),
}
"""By what stands before the first colon of a SINK; the class gets what stands behind it."""
