"""A module that restarts or vanishes is waited for, found again and set up again.

Its USB descriptor carries no serial number, so after a port vanished each port that may be the
module's is opened and the module behind it asked for its own (Protocol reference 4.10, 8.1, 10).
"""

import math
from collections.abc import Callable
from typing import TypeAlias, TypeVar

from xethru_protocol.driver.link import (
    CloseLine,
    Link,
    OpenLine,
    Read,
    SetLineRate,
    Sleep,
    Steps,
)
from xethru_protocol.wire.codes import POWER_UP_BAUD, ErrorCode, InfoItem, PongCode
from xethru_protocol.wire.errors import (
    DeviceError,
    Disconnected,
    PortUnavailable,
    RemoteProtocolError,
    ResponseTimeout,
)
from xethru_protocol.wire.messages import ModReset

RESTART_S = 15.0  # a restart takes 2 ... 9 s; the reference asks for at least 10
_BOOT_S = 3.0  # a module that keeps its port sends READY by then
_ASK_S = 0.5  # one PING to a port that may not answer yet
_LOOK_AGAIN_S = 0.2
_FOREIGN_NS = 3_000_000_000  # how long a port is left alone that was another module's
RECONNECTS_PER_CALL = 3  # then the module is in a restart loop, and the user should know

T = TypeVar("T")
Recognise: TypeAlias = Callable[[Link, str], Steps[bool]]
"""Asks what answers at an open port whether it is the module that is looked for."""


def identify(link: Link) -> Steps[None]:
    """Read the serial number, once: the module is known by it when it comes back."""
    if link.identified:
        return
    try:
        # bare XEP does not report it, and is looked for at the same port
        serial = (yield from link.info_text(InfoItem.XTID_SSIC_SERIALNUMBER)) or None
    except ResponseTimeout:
        serial = None
        link.warn(
            "the module does not answer what its serial number is; "
            "if it vanishes, it is looked for at the same port only"
        )
    except Disconnected:
        return  # the next command will see it
    link.identified, link.serial_number = True, serial


def reset(link: Link, *, wait: bool = False, timeout_s: float = RESTART_S) -> Steps[None]:
    if wait:
        yield from identify(link)
    readies = link.conversation.readies
    yield from link.request(ModReset())
    link.raw_mode = False
    link.plan = None
    link.frames.clear()
    if wait:
        yield from await_restart(link, readies, timeout_s)


def await_restart(link: Link, readies: int, timeout_s: float = RESTART_S) -> Steps[None]:
    """Wait until a restarting module sends READY or answers PING, at this port or another.

    ``readies`` is how many READY had come before.
    """
    deadline_ns = link.conversation.deadline_ns(timeout_s)
    baudrate = link.baudrate
    if baudrate != POWER_UP_BAUD:
        yield SetLineRate(POWER_UP_BAUD)
        link.baudrate = POWER_UP_BAUD
    try:
        ready = yield from link.listen(
            lambda: link.conversation.readies > readies, min(_BOOT_S, timeout_s)
        )
        link.conversation.new_line(link.path)  # it will not answer earlier requests
        while not ready:  # READY may have been lost
            ready = yield from _answers(link)
            if not ready and link.left_s(deadline_ns) <= 0:
                raise link.conversation.silence("READY after the reset", timeout_s)
    except Disconnected:
        yield from find_again(link, deadline_ns, timeout_s, restore=False)
    if baudrate != link.baudrate:
        yield from link.set_baud_rate(baudrate, force=True)


def reconnect(link: Link, timeout_s: float = RESTART_S) -> Steps[str]:
    link.frames.interrupt()
    deadline_ns = link.conversation.deadline_ns(timeout_s)
    yield from find_again(link, deadline_ns, timeout_s, restore=True)
    return link.path


def resilient(link: Link, procedure: Callable[[], Steps[T]]) -> Steps[T]:
    """Run a procedure; if the line breaks and reconnecting is on, reconnect and repeat it."""
    if link.reconnect_s > 0:
        yield from identify(link)
    for _ in range(RECONNECTS_PER_CALL):
        reconnects = link.reconnects
        try:
            return (yield from procedure())
        except Disconnected as error:
            yield from recover(link, reconnects, error)
    return (yield from procedure())


def recover(link: Link, reconnects: int, error: Disconnected) -> Steps[None]:
    """Reconnect after ``error``, unless another task has since ``reconnects`` were counted."""
    if link.reconnect_s <= 0 or link.closed:
        raise error
    if link.reconnects == reconnects:
        link.warn(f"{error}; looking for the module for {link.reconnect_s:g} s")
        yield from reconnect(link, link.reconnect_s)


# --- inside -------------------------------------------------------------------------------------


def find_again(
    link: Link,
    deadline_ns: int,
    timeout_s: float,
    *,
    restore: bool,
    is_ours: Recognise | None = None,
    everywhere: bool | None = None,
) -> Steps[None]:
    """Open ports until the module answers at one.

    ``is_ours`` recognises it, by default by its serial number; ``everywhere``: also at ports where
    it never was, by default if the serial number is known.
    """
    everywhere = link.serial_number is not None if everywhere is None else everywhere
    lost, plan = link.path, link.plan
    foreign: dict[str, int] = {}
    why = "no port of it"
    while True:
        elsewhere = link.candidates() if everywhere else ()
        for path in dict.fromkeys((link.path, link.home, *elsewhere)):
            asked_ns = foreign.get(path)
            if asked_ns is not None and link.clock() - asked_ns < _FOREIGN_NS:
                continue
            try:
                if (yield from _open_ours(link, path, is_ours or _is_ours)):
                    if restore and plan is not None:
                        try:
                            yield from plan.restore(link)
                        finally:
                            link.plan = plan  # also if the module vanished meanwhile
                    link.path = path
                    link.reconnects += 1
                    moved = "" if path == lost else f", formerly at {lost}"
                    link.conversation.report("warning", f"the module is back at {path}{moved}")
                    return
                foreign[path] = link.clock()
                why = f"at {path} is another module"
            except PortUnavailable as error:
                if path in {lost, link.home}:
                    why = str(error)
            except (Disconnected, ResponseTimeout, RemoteProtocolError) as error:
                why = str(error)  # it may boot yet, or vanish once more
            except DeviceError as error:
                if error.code != ErrorCode.XTS_SPRE_RESTARTING:
                    raise
                why = str(error)
        yield CloseLine()
        left_s = link.left_s(deadline_ns)
        if left_s <= 0 or link.closed:
            raise Disconnected(
                f"the module of {lost} did not come back within {timeout_s:g} s: {why}"
            )
        yield Sleep(min(_LOOK_AGAIN_S, left_s))


def _open_ours(link: Link, path: str, is_ours: Recognise) -> Steps[bool]:
    """Open a port; returns whether our module answers there, and leaves it open only then."""
    wanted = link.baudrate
    rates = (
        (wanted,)
        if math.isinf(link.bytes_per_s) or wanted == POWER_UP_BAUD
        else (POWER_UP_BAUD, wanted)
    )
    ours = False
    for baudrate in rates:
        yield OpenLine(path, baudrate)
        link.conversation.new_line(path, is_known=False)
        try:
            ours = yield from is_ours(link, path)
        except ResponseTimeout:
            if baudrate == rates[-1]:
                raise
            continue
        except GeneratorExit:
            raise
        except BaseException:  # an interrupt: the next read must not be of another module
            yield CloseLine()
            raise
        if ours and baudrate != wanted:
            link.baudrate = baudrate
            yield from link.set_baud_rate(wanted, force=True)
        break
    if ours:
        link.conversation.recognise()
    else:
        yield CloseLine()
    return ours


def _is_ours(link: Link, path: str) -> Steps[bool]:
    state = yield from link.ping(_ASK_S)
    if state is PongCode.XTS_SPRP_NOTREADY:
        raise ResponseTimeout(f"the module at {path} is not ready yet")
    serial = yield from link.info_text(InfoItem.XTID_SSIC_SERIALNUMBER)
    wanted = link.serial_number
    if wanted is None or (state is PongCode.XTS_SPRP_SAFEMODE and serial is None):
        # without a number it is known by its port only
        if path in {link.path, link.home}:
            link.warn(f"the module at {path} is taken for the one that vanished by its port only")
            return True
        return False
    return serial == wanted


def _answers(link: Link) -> Steps[bool]:
    try:
        ready = (yield from link.ping(_ASK_S)) is not PongCode.XTS_SPRP_NOTREADY
    except ResponseTimeout:
        return False
    if not ready:
        yield Read(_ASK_S)
    return ready
