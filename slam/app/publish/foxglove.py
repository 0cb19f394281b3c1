"""The sink that serves the messages of a session to Foxglove and Lichtblick, while it happens."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace

import numpy as np
from foxglove import Channel, Context, Schema, start_server
from foxglove.websocket import Capability, ChannelView, Client, ServerListener

from slam.app.errors import UsageError
from slam.app.publish.sinks import Sink
from slam.app.session.viewer_topics import Topics
from slam.app.session.writer import SessionLog
from slam.live.errors import AppError
from slam.live.odometry_track import TumSample
from slam.live.session import cdr
from slam.live.session_records import LogLine, RadarImage, Scan, SessionInfo, Snapshot
from slam.results import SmoothedRun
from xethru_protocol.transport import host_and_port

DEFAULT_PORT = 8765
"""Where Foxglove and Lichtblick look for a server by default."""
_HOST = "127.0.0.1"


class _ServedTopics(Topics, ServerListener):
    """Sends messages, with session time, to those who subscribed to their topics.

    Whoever subscribes gets the last message of the topic at once: what is latched, and of the
    others what comes again in some seconds only. Those who had it get it again.
    """

    def __init__(self, context: Context) -> None:
        self._context = context
        self._channels: dict[str, Channel] = {}
        self._last: dict[str, tuple[int, bytes]] = {}

    def add_topic(self, topic: str, message_type: str, *, latched: bool = False) -> None:
        if topic not in self._channels:
            text = cdr.schema_text(message_type)
            schema = Schema(name=message_type, encoding="ros2msg", data=text)
            self._channels[topic] = Channel(
                topic, schema=schema, message_encoding="cdr", context=self._context
            )

    def write(
        self,
        topic: str,
        t_ns: int,
        data: bytes,
        *,
        sequence: int = 0,
        publish_ns: int | None = None,
    ) -> None:
        self._last[topic] = t_ns, data
        self._channels[topic].log(data, log_time=t_ns)

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:  # by the server's thread
        if (last := self._last.get(channel.topic)) is not None:
            t_ns, data = last
            self._channels[channel.topic].log(data, log_time=t_ns)


class FoxgloveSink(Sink):
    """Serves what a session holds, and the drawings of it, at `PORT` of this machine.

    With `HOST:PORT` it is that address of the machine, which others may reach. The wheels' poses in
    /odom are those of the states.
    """

    def __init__(self, text: str) -> None:
        address = host_and_port(text if ":" in text else f"{_HOST}:{text or DEFAULT_PORT}")
        if address is None:
            raise UsageError("must be foxglove, foxglove:PORT or foxglove:HOST:PORT")
        self._host, self._port = address
        self._ending = ExitStack()

    def open(self) -> None:
        """Start the server; topics are there once the run begins."""
        context = Context()
        self._topics = _ServedTopics(context)
        try:
            self._server = start_server(
                name="uwb-slam",
                host=self._host,
                port=self._port,
                capabilities=[Capability.Time],
                server_listener=self._topics,
                context=context,
            )
        except RuntimeError as error:
            raise AppError(
                f"--publish foxglove: port {self._port} of {self._host} cannot be opened: {error}; "
                "if another run is published there, choose another port with foxglove:PORT"
            ) from None
        self._ending.callback(self._server.stop)

    def begin(self, info: SessionInfo, start_ns: int, map_id: str) -> None:
        self._log = self._ending.enter_context(SessionLog(self._topics, info, start_ns=start_ns))

    def on_scan(self, scan: Scan) -> None:
        self._server.broadcast_time(scan.t_ns)
        self._log.on_scan(replace(scan, odom_frame=np.zeros(3)))  # /odom is of the states

    def on_snapshot(self, snapshot: Snapshot) -> None:
        x_m, y_m, *_, qz, qw = cdr.planar(snapshot.odometry)
        self._log.on_odometry(TumSample(t_ns=snapshot.t_ns, x_m=x_m, y_m=y_m, qz=qz, qw=qw))
        self._log.on_snapshot(snapshot)

    def on_smoothed(self, smoothed: SmoothedRun) -> None:
        self._log.on_smoothed(smoothed)

    def on_image(self, image: RadarImage) -> None:
        self._log.on_image(image)

    def on_log(self, line: LogLine) -> None:
        self._log.on_log(line)

    def close(self) -> None:
        """Send what is drawn at the end, and end the connections."""
        self._ending.close()
