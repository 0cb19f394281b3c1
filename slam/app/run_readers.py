"""Threads that read ports and odometry while SLAM computes, so that neither waits for the other.

Each thread owns what it reads from and tells the main loop through one queue. A radar that falls
silent or vanishes is looked for until it is back or the run ends.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from queue import SimpleQueue
from types import TracebackType
from typing import Literal, Self

from slam.app.errors import OdometryError
from slam.app.odometry_source import LineSource, read_lines
from slam.app.run_events import (
    Event,
    FrameCame,
    OdometryEnded,
    OdometryLine,
    RadarBack,
    RadarLost,
    WireCame,
)
from slam.app.sources import RadarLink
from xethru_protocol.errors import ResponseTimeout, XeThruError

SILENCE_S = 3.0
"""Many frame periods; a module that is silent for so long has stopped streaming."""
_POLL_S = 0.2
_LOOK_S = 2.0
_LOOK_AGAIN_S = 1.0
_JOIN_S = 10.0
"""More than a look for a module takes; whoever still reads then hangs in the system."""

Inbox = SimpleQueue[Event]


class Readers:
    """Reads all radars and the odometry while it is entered.

    Parameters
    ----------
    links
        Radars that stream, in the order of the rig; their drivers are the threads' own meanwhile.
    source
        Where odometry comes from.
    inbox
        Gets everything.
    """

    def __init__(self, links: Sequence[RadarLink], source: LineSource, inbox: Inbox) -> None:
        self._stopped = threading.Event()
        self._inbox = inbox
        self._threads = [
            threading.Thread(
                target=_read_radar,
                args=(index, link, inbox, self._stopped),
                name=f"radar {link.mount.name}",
                daemon=True,
            )
            for index, link in enumerate(links)
        ]
        self._threads.append(
            threading.Thread(
                target=_read_odometry,
                args=(source, inbox, self._stopped),
                name="odometry",
                daemon=True,
            )
        )

    def __enter__(self) -> Self:
        """Start the threads."""
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """End the threads; afterwards the drivers may be used again."""
        self._stopped.set()
        give_up = time.monotonic() + _JOIN_S
        for thread in self._threads:
            thread.join(max(give_up - time.monotonic(), 0.0))


def tap_wire(link: RadarLink, inbox: Inbox) -> None:
    """Let every byte of a radar's port pass the inbox."""

    def tell(way: Literal["rx", "tx"], data: bytes, host_ns: int) -> None:
        inbox.put(WireCame(radar=link.mount.name, way=way, data=data, host_ns=host_ns))

    link.driver.raw_listener = tell


def _read_radar(radar: int, link: RadarLink, inbox: Inbox, stopped: threading.Event) -> None:
    try:
        _follow_radar(radar, link, inbox, stopped)
    except Exception as error:  # a bug; the run must hear of it, not lose a radar without a word
        inbox.put(RadarLost(radar=radar, text=f"its reader failed: {error!r}"))
        raise


def _follow_radar(radar: int, link: RadarLink, inbox: Inbox, stopped: threading.Event) -> None:
    heard = time.monotonic()
    while not stopped.is_set():
        trouble = ""
        try:
            inbox.put(FrameCame(radar=radar, frame=link.driver.read_frame(_POLL_S)))
            heard = time.monotonic()
        except ResponseTimeout:
            if time.monotonic() - heard > SILENCE_S:
                trouble = f"no frame for {SILENCE_S:g} s"
        except XeThruError as error:
            trouble = str(error)
        if trouble:
            inbox.put(RadarLost(radar=radar, text=trouble))
            if _found_again(link, stopped.is_set, stopped.wait):
                inbox.put(RadarBack(radar=radar, port=link.driver.port))
            heard = time.monotonic()


def _found_again(
    link: RadarLink, is_stopped: Callable[[], bool], wait: Callable[[float], bool]
) -> bool:
    while not is_stopped():
        try:
            link.driver.reconnect(_LOOK_S)
        except XeThruError:
            wait(_LOOK_AGAIN_S)
        else:
            return True
    return False


def _read_odometry(source: LineSource, inbox: Inbox, stopped: threading.Event) -> None:
    trouble = ""
    try:
        for text, arrival_ns in read_lines(source, stopped.is_set):
            inbox.put(OdometryLine(text=text, arrival_ns=arrival_ns))
    except OdometryError as error:
        trouble = str(error)
    except Exception as error:  # a bug, as above
        inbox.put(OdometryEnded(trouble=f"its reader failed: {error!r}"))
        raise
    inbox.put(OdometryEnded(trouble=trouble))
