"""Procedures as methods: of a driver that blocks, and of one whose methods are awaited.

Its USB descriptor carries no serial number, so after a port vanished each port that may be the
module's is opened and the module behind it asked for its own (Protocol reference 4.10, 8.1, 10).
"""

import functools
import inspect
from collections.abc import Callable, Coroutine
from dataclasses import replace
from typing import Any, Concatenate, ParamSpec, TypeVar, get_args

from xethru_protocol.driver.link import (
    POWER_UP_BAUD,
    CloseLine,
    Identity,
    OpenLine,
    Procedure,
    ProfilePlan,
    RadarCore,
    RawPlan,
    Read,
    SetLineRate,
    Sleep,
    info_text,
    listen,
    ping,
    request,
    set_baud_rate,
)
from xethru_protocol.driver.profiles import apply_plan, run
from xethru_protocol.driver.raw_mode import apply, run_at
from xethru_protocol.wire.codes import ErrorCode, InfoItem, PongCode, SensorMode
from xethru_protocol.wire.errors import (
    DeviceError,
    Disconnected,
    PortUnavailable,
    RemoteProtocolError,
    ResponseTimeout,
)
from xethru_protocol.wire.messages import ModReset

RESTART_S = 15.0  # a restart takes 2 ... 9 s; the reference asks for at least 10
_BOOT_S = 3.0  # a module that keeps its port says READY by then
_ASK_S = 0.5  # one PING to a port that may be deaf yet
_LOOK_AGAIN_S = 0.2
_FOREIGN_NS = 3_000_000_000  # how long a port is left alone that was another module's
RECONNECTS_PER_CALL = 3  # then the module is in a restart loop, and the user should know

T = TypeVar("T")


def identify(core: RadarCore) -> Procedure[Identity]:
    """Ask once by what this module will be known when it comes back."""
    if core.identity is None:
        try:
            serial = (yield from info_text(core, InfoItem.XTID_SSIC_SERIALNUMBER)) or None
        except ResponseTimeout:
            serial = None
        core.identity = Identity(serial_number=serial)
        if serial is None:
            core.warn(
                "the module does not tell its serial number; "
                "should it vanish, it will be looked for at the same port only"
            )
    return core.identity


def reset(core: RadarCore, *, wait: bool = False, timeout_s: float = RESTART_S) -> Procedure[None]:
    """Restart the module; what was configured is gone.

    Parameters
    ----------
    wait
        False: return at its ACK; a USB port vanishes 0.5 s later. True: return when it is ready
        again, on a port of the same or another name.
    timeout_s
        How long to wait.

    Raises
    ------
    ResponseTimeout
        If it keeps its port and does not get ready in time.
    Disconnected
        If its port vanishes and it does not come back in time.

    Notes
    -----
    Protocol reference 8.1.
    """
    if wait:
        yield from identify(core)
    readies = core.conversation.readies
    yield from request(core, ModReset())
    core.raw_mode = False
    core.plan = None
    core.frames.new_stream()
    if wait:
        yield from await_restart(core, readies, timeout_s)


def await_restart(core: RadarCore, readies: int, timeout_s: float = RESTART_S) -> Procedure[None]:
    """Wait until a restarting module is ready: it says so, or answers PING, here or elsewhere.

    ``readies`` is how many READY had come before.
    """
    deadline_ns = core.conversation.deadline_ns(timeout_s)
    baudrate = core.baudrate
    if baudrate != POWER_UP_BAUD:
        yield SetLineRate(POWER_UP_BAUD)
        core.baudrate = POWER_UP_BAUD
    try:
        ready = yield from listen(
            core, lambda: core.conversation.readies > readies, min(_BOOT_S, timeout_s)
        )
        core.conversation.new_line(core.path)  # whatever was owed died with the module
        while not ready:  # READY may have been lost
            ready = yield from _answers(core)
            if not ready and core.left_s(deadline_ns) <= 0:
                raise core.conversation.silence("READY after the reset", timeout_s)
    except Disconnected:
        yield from _find_again(core, deadline_ns, timeout_s, _nothing)
    if baudrate != core.baudrate:
        yield from set_baud_rate(core, baudrate, force=True)


def reconnect(core: RadarCore, timeout_s: float = RESTART_S) -> Procedure[str]:
    """Find the module again at the same port or another, and restore what was configured.

    Frames that were read before it vanished stay in the queue; none is counted lost for the time
    it was away. Returns the port it was found at.

    Raises
    ------
    Disconnected
        If it does not come back in time.
    DeviceError
        If it came back and refuses its settings.
    """
    core.frames.break_off()
    deadline_ns = core.conversation.deadline_ns(timeout_s)
    yield from _find_again(core, deadline_ns, timeout_s, _restore)
    return core.path


def run_profile(core: RadarCore) -> Procedure[None]:
    """Run the loaded profile; its settings are saved in the module by that.

    A module that must restart to change its profile is waited for and set up again.
    """
    readies = core.conversation.readies
    try:
        yield from run(core)
    except DeviceError as error:
        plan = core.plan
        if error.code != ErrorCode.XTS_SPRE_RESTARTING or not isinstance(plan, ProfilePlan):
            raise
        core.warn("the module restarts to change its profile")
        yield from await_restart(core, readies)
        core.plan = replace(plan, mode=SensorMode.XTID_SM_RUN)
        yield from apply_plan(core, core.plan)


def resilient(core: RadarCore, procedure: Callable[[], Procedure[T]]) -> Procedure[T]:
    """Run a procedure; if the line breaks meanwhile and the user wants so, reconnect and repeat."""
    if core.reconnect_s > 0:
        yield from identify_quietly(core)
    for _ in range(RECONNECTS_PER_CALL):
        generation = core.generation
        try:
            return (yield from procedure())
        except Disconnected as error:
            yield from recover(core, generation, error)
    return (yield from procedure())


def identify_quietly(core: RadarCore) -> Procedure[None]:
    """Ask by what to know the module, unless its line is gone already."""
    try:
        yield from identify(core)
    except Disconnected:
        return  # the procedure itself will see it


def recover(core: RadarCore, generation: int, error: Disconnected) -> Procedure[None]:
    """Reconnect after ``error`` on the line of ``generation``, unless somebody else has."""
    if core.reconnect_s <= 0 or core.closed:
        raise error
    if core.generation == generation:
        core.warn(f"{error}; looking for the module for {core.reconnect_s:g} s")
        yield from reconnect(core, core.reconnect_s)


# --- inside -------------------------------------------------------------------------------------


def _nothing(core: RadarCore) -> Procedure[None]:
    return
    yield


def _restore(core: RadarCore) -> Procedure[None]:
    plan = core.plan
    try:
        if isinstance(plan, RawPlan):
            yield from apply(core, plan.config)
            if plan.fps is not None:
                yield from run_at(core, plan.fps)
        elif plan is not None:
            yield from apply_plan(core, plan)
    finally:
        core.plan = plan  # also if the module vanished meanwhile


def _find_again(
    core: RadarCore,
    deadline_ns: int,
    timeout_s: float,
    restore: Callable[[RadarCore], Procedure[None]],
) -> Procedure[None]:
    lost = core.path
    foreign: dict[str, int] = {}
    why = "no port of it"
    while True:
        for path in _where_to_look(core):
            asked_ns = foreign.get(path)
            if asked_ns is not None and core.clock() - asked_ns < _FOREIGN_NS:
                continue
            yield CloseLine()
            try:
                if (yield from _open_ours(core, path)):
                    yield from restore(core)
                    _note_return(core, lost, path)
                    return
                foreign[path] = core.clock()
                why = f"at {path} is another module"
            except PortUnavailable as error:
                if path in {lost, core.home}:
                    why = str(error)
            except (Disconnected, ResponseTimeout, RemoteProtocolError) as error:
                why = str(error)  # it may boot yet, or vanish once more
            except DeviceError as error:
                if error.code != ErrorCode.XTS_SPRE_RESTARTING:
                    raise
                why = str(error)
        yield CloseLine()
        left_s = core.left_s(deadline_ns)
        if left_s <= 0 or core.closed:
            raise Disconnected(
                f"the module of {lost} did not come back within {timeout_s:g} s: {why}"
            )
        yield Sleep(min(_LOOK_AGAIN_S, left_s))


def _where_to_look(core: RadarCore) -> tuple[str, ...]:
    first = (core.path, core.home)
    known = core.identity is not None and core.identity.serial_number is not None
    return tuple(dict.fromkeys((*first, *core.candidates()) if known else first))


def _open_ours(core: RadarCore, path: str) -> Procedure[bool]:
    """Open a port; whether our module answers there."""
    wanted = core.baudrate
    rates = (wanted,) if core.unlimited or wanted == POWER_UP_BAUD else (POWER_UP_BAUD, wanted)
    for baudrate in rates:
        if baudrate != rates[0]:
            yield CloseLine()
        yield OpenLine(path, baudrate)
        core.conversation.new_line(path)
        try:
            ours = yield from _is_ours(core, path)
        except ResponseTimeout:
            if baudrate == rates[-1]:
                raise
            continue
        if ours and baudrate != wanted:
            core.baudrate = baudrate
            yield from set_baud_rate(core, wanted, force=True)
        return ours
    return False


def _is_ours(core: RadarCore, path: str) -> Procedure[bool]:
    state = yield from ping(core, _ASK_S)
    if state is PongCode.XTS_SPRP_NOTREADY:
        raise ResponseTimeout(f"the module at {path} is not ready yet")
    serial = yield from info_text(core, InfoItem.XTID_SSIC_SERIALNUMBER)
    wanted = core.identity.serial_number if core.identity else None
    if wanted is None or (state is PongCode.XTS_SPRP_SAFEMODE and serial is None):
        # A module that does not tell its number is known by its port only.
        if path in {core.path, core.home}:
            core.warn(f"the module at {path} is taken for the one that vanished by its port only")
            return True
        return False
    return serial == wanted


def _note_return(core: RadarCore, lost: str, path: str) -> None:
    core.path = path
    core.generation += 1
    core.reconnects += 1
    moved = "" if path == lost else f", formerly at {lost}"
    core.conversation.tell("warning", f"the module is back at {path}{moved}")


def _answers(core: RadarCore) -> Procedure[bool]:
    try:
        ready = (yield from ping(core, _ASK_S)) is not PongCode.XTS_SPRP_NOTREADY
    except ResponseTimeout:
        return False
    if not ready:
        yield Read(_ASK_S)
    return ready


P = ParamSpec("P")
_Written = Callable[Concatenate[RadarCore, P], Procedure[T]]
_MethodT = TypeVar("_MethodT", bound=Callable[..., Any])


def _documented_as(procedure: Callable[..., Procedure[Any]]) -> Callable[[_MethodT], _MethodT]:
    """Give a method the name and text of its procedure, and the signature that its user sees."""

    def document(method: _MethodT) -> _MethodT:
        functools.update_wrapper(method, procedure)
        signature = inspect.signature(procedure)
        core, *parameters = signature.parameters.values()
        whole = signature.replace(
            parameters=[core.replace(name="self", annotation=core.empty), *parameters],
            return_annotation=get_args(signature.return_annotation)[2],  # of Generator
        )
        method.__signature__ = whole  # type: ignore[attr-defined]  # as inspect looks for it
        return method

    return document


def blocking(procedure: _Written[P, T]) -> Callable[Concatenate[Any, P], T]:
    """Make a method that returns the procedure's result; repeated after a reconnect, if on."""

    @_documented_as(procedure)
    def method(self: Any, /, *args: P.args, **kwargs: P.kwargs) -> T:  # noqa: ANN401 - any part of a driver
        core: RadarCore = self._core
        if core.reconnect_s > 0:
            whole = resilient(core, lambda: procedure(core, *args, **kwargs))
        else:
            whole = procedure(core, *args, **kwargs)
        result: T = self._run(whole)
        return result

    return method


def blocking_once(procedure: _Written[P, T]) -> Callable[Concatenate[Any, P], T]:
    """Do the same, but never repeat: a broken line is the caller's business."""

    @_documented_as(procedure)
    def method(self: Any, /, *args: P.args, **kwargs: P.kwargs) -> T:  # noqa: ANN401 - as above
        result: T = self._run(procedure(self._core, *args, **kwargs))
        return result

    return method


def awaited(procedure: _Written[P, T]) -> Callable[Concatenate[Any, P], Coroutine[Any, Any, T]]:
    """Make a coroutine method; repeated after a reconnect, if that is on."""

    @_documented_as(procedure)
    async def method(self: Any, /, *args: P.args, **kwargs: P.kwargs) -> T:  # noqa: ANN401 - as above
        core: RadarCore = self._core
        result: T = await self._run(resilient(core, lambda: procedure(core, *args, **kwargs)))
        return result

    return method


def awaited_once(
    procedure: _Written[P, T],
) -> Callable[Concatenate[Any, P], Coroutine[Any, Any, T]]:
    """Do the same, but never repeat."""

    @_documented_as(procedure)
    async def method(self: Any, /, *args: P.args, **kwargs: P.kwargs) -> T:  # noqa: ANN401 - as above
        result: T = await self._run(procedure(self._core, *args, **kwargs))
        return result

    return method
