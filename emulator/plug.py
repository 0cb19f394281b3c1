"""A port that goes away while its module restarts, and comes back, as USB does.

What a host sees is what a real unplug shows: its open port hangs up, the name is gone; later there
is a fresh port, under the same name or another one.
"""

from __future__ import annotations

import contextlib
import selectors
from collections.abc import Callable
from pathlib import Path

from emulator.link import LinkError, PtyLink
from emulator.port_watch import PortWatch
from emulator.server import Service
from emulator.tcp_link import TcpLink

__all__ = ["Plug"]

LOOK_AGAIN_NS = 20_000_000
"""How often to look whether the port is back; a host looks less often."""


class Plug(Service):
    """Takes the lines to one module away and brings them back: a service of the loop.

    Parameters
    ----------
    link
        The module's pseudo-terminal.
    present
        Whether the module's own port is there at a time, ns.
    tcp
        Its TCP port; a client is hung up on, and none admitted before the module is back.
    watch
        Who has the terminal open.
    renames
        Whether it returns under another name every time: NAME-2, NAME-3 and so on, so that a host
        finds the module by its serial number only.
    moved
        Called when the port is back.

    Attributes
    ----------
    pulled
        Set to take the port away, whatever the module does, and unset to allow it back.
    """

    def __init__(
        self,
        link: PtyLink,
        present: Callable[[int], bool],
        *,
        tcp: TcpLink | None = None,
        watch: PortWatch | None = None,
        renames: bool = False,
        moved: Callable[[], None],
    ) -> None:
        self._link = link
        self._present = present
        self._tcp = tcp
        self._watch = watch
        self._first_path = link.path
        self._renames = renames
        self._returns = 0
        self._moved = moved
        self._selector: selectors.BaseSelector | None = None
        self.pulled = False

    @property
    def is_in(self) -> bool:
        """Whether the port is there."""
        return self._link.fileno() >= 0

    def register(self, selector: selectors.BaseSelector) -> None:
        """Remember the loop's selector: a port that goes away is no longer waited for."""
        self._selector = selector

    def advance(self, now_ns: int) -> None:
        """Take the port away, or bring it back, when the time has come."""
        wanted = self._present(now_ns) and not self.pulled
        if self.is_in and not wanted:
            self._take_away()
        elif wanted and not self.is_in:
            self._bring_back()

    def wake_ns(self, now_ns: int) -> int | None:
        """Return when to look again; None while the port is there and nothing says when it goes."""
        return None if self.is_in else now_ns + LOOK_AGAIN_NS

    def _take_away(self) -> None:
        if self._selector is not None:
            with contextlib.suppress(KeyError):  # not waited for just now
                self._selector.unregister(self._link.fileno())
        self._link.close()
        if self._tcp is not None:
            self._tcp.hang_up()

    def _bring_back(self) -> None:
        path: Path = self._first_path
        if self._renames:
            path = path.with_name(f"{path.name}-{self._returns + 2}")
        try:
            self._link.reopen(path)
        except LinkError:
            return  # no terminal is free, or a file is in the way: look again
        self._returns += 1
        if self._watch is not None:
            self._watch.follow(self._link.terminal)
        self._moved()
