"""The mode machine of an X4M300: profile running, paused, loaded or unloaded, or raw radar.

`TRANSITIONS` is the machine; ``python -m emulator.modes`` prints it as a Mermaid state diagram.
The reference leaves open what follows here from assumptions: MANUAL and REG unload the profile
(their GETs answer as if none were loaded), IDLE pauses a profile that was loaded but never run,
and is refused like RUN when none is loaded. The direct jump from RUN to MANUAL is an option.

Source: protocol reference 4.2, 4.3, 8.2 and 8.3.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from emulator.options import DeviceOptions
from emulator.refusal import Refusal
from xethru_protocol.codes import ErrorCode, ProfileId, SensorMode

__all__ = ["TRANSITIONS", "ModeMachine", "Request", "Start", "State", "Step", "state_diagram"]


class State(Enum):
    """What a module is doing, as far as commands can tell."""

    RUN = "profile runs"
    IDLE = "profile paused"
    LOADED = "stopped, profile loaded"
    STOPPED = "stopped, no profile"
    MANUAL = "raw radar"
    REG = "certification"
    XEP = "base firmware"
    SAFE = "safe mode"
    BOOTLOADER = "bootloader"


class Request(Enum):
    """What asks for another state."""

    RUN = "SETMODE RUN"
    IDLE = "SETMODE IDLE"
    MANUAL = "SETMODE MANUAL"
    STOP = "SETMODE STOP"
    REG = "SETMODE REG"
    LOAD = "LOADAPP"


@dataclass(frozen=True, slots=True)
class Step:
    """Where a request leads, and which options say no to it.

    Attributes
    ----------
    target
        State entered; None if the request is always refused.
    refusal
        Name of the option that holds the ERROR of a refusal; empty if there is none.
    refused_if
        Option and value that make a step with a target a refusal.
    """

    target: State | None
    refusal: str = ""
    refused_if: tuple[str, str] | None = None


_NO_PROFILE = Step(None, "run_without_profile_error")
_JUMP = Step(State.MANUAL, "busy_profile_error", ("run_to_manual", "refuse"))
_ANYWHERE = {
    Request.STOP: Step(State.STOPPED),
    Request.LOAD: Step(State.LOADED),
    Request.REG: Step(State.REG),
}
_WITH_PROFILE = {Request.RUN: Step(State.RUN), Request.IDLE: Step(State.IDLE)}
_WITHOUT = {Request.RUN: _NO_PROFILE, Request.IDLE: _NO_PROFILE}
_RAW = {Request.MANUAL: Step(State.MANUAL)}

TRANSITIONS: dict[State, dict[Request, Step]] = {
    State.RUN: _ANYWHERE | _WITH_PROFILE | {Request.MANUAL: _JUMP},
    State.IDLE: _ANYWHERE | _WITH_PROFILE | {Request.MANUAL: _JUMP},
    State.LOADED: _ANYWHERE | _WITH_PROFILE | _RAW,
    State.STOPPED: _ANYWHERE | _WITHOUT | _RAW,
    State.MANUAL: _ANYWHERE | _WITHOUT | _RAW,
    State.REG: _ANYWHERE | _WITHOUT | _RAW,
}
"""The machine of the sensor firmware, by state and request; the other states know no modes."""

_REQUESTS: dict[int, Request] = {
    SensorMode.XTID_SM_RUN: Request.RUN,
    SensorMode.XTID_SM_IDLE: Request.IDLE,
    SensorMode.XTID_SM_MANUAL: Request.MANUAL,
    SensorMode.XTID_SM_STOP: Request.STOP,
    SensorMode.XTID_SM_REG: Request.REG,
}
_MODES: dict[State, SensorMode] = {
    State.RUN: SensorMode.XTID_SM_RUN,
    State.IDLE: SensorMode.XTID_SM_IDLE,
    State.LOADED: SensorMode.XTID_SM_STOP,
    State.STOPPED: SensorMode.XTID_SM_STOP,
    State.MANUAL: SensorMode.XTID_SM_MANUAL,
    State.REG: SensorMode.XTID_SM_REG,
    # without modes a module streams its radar frames, as in MANUAL
    State.XEP: SensorMode.XTID_SM_MANUAL,
    State.SAFE: SensorMode.XTID_SM_MANUAL,
    State.BOOTLOADER: SensorMode.XTID_SM_STOP,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Start:
    """What a module remembers of its modes over a reset.

    Attributes
    ----------
    state
        RUN, LOADED or STOPPED; what the next power-up enters.
    profile_id
        Profile that ran last.
    """

    state: State = State.RUN
    profile_id: int = int(ProfileId.XTS_ID_APP_PRESENCE_2)


class ModeMachine:
    """Mode and profile of one module, as a stock X4M300 powers up: its profile runs.

    Attributes
    ----------
    state
        Current state.
    profile_id
        Loaded profile, 0 for none.
    start
        What the next power-up enters.
    """

    def __init__(self, options: DeviceOptions | None = None, start: Start | None = None) -> None:
        self._options = options or DeviceOptions()
        self.start = start or Start()
        self.power_up(None)

    @property
    def mode(self) -> SensorMode:
        """Current mode, as GETMODE answers it."""
        return _MODES[self.state]

    def power_up(self, into: State | None) -> None:
        """Enter a state after a restart; None for the one that the start asks for."""
        self.state = into or self.start.state
        loaded = self.state in (State.RUN, State.LOADED)
        self.profile_id = self.start.profile_id if loaded else int(ProfileId.XTS_ID_APP_NONE)

    def set_mode(self, mode: int) -> None:
        """Change the mode, or raise `Refusal`."""
        request = _REQUESTS.get(mode)
        if request is None:
            raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
        self._enter(request)
        if self.state is State.RUN:
            self.start = Start(state=State.RUN, profile_id=self.profile_id)
        elif request is Request.STOP:
            self.start = Start(state=State.STOPPED, profile_id=self.start.profile_id)
        if self.state not in (State.RUN, State.IDLE):
            self.profile_id = int(ProfileId.XTS_ID_APP_NONE)

    def load_profile(self, profile_id: int) -> None:
        """Load a profile without running it, or raise `Refusal` for one this product lacks."""
        if profile_id not in self._options.profiles:
            raise Refusal(ErrorCode.XTS_SPRE_APP_INVALID)
        self._enter(Request.LOAD)
        self.profile_id = profile_id
        self.start = Start(state=State.STOPPED, profile_id=self.start.profile_id)

    def switches_profile(self, mode: int) -> bool:
        """Whether a SETMODE would run another profile than the last one."""
        return (
            mode == SensorMode.XTID_SM_RUN
            and self.state is State.LOADED
            and self.profile_id != self.start.profile_id
        )

    def restart_with_profile(self) -> None:
        """Let the next power-up find the loaded profile loaded."""
        self.start = Start(state=State.LOADED, profile_id=self.profile_id)

    def _enter(self, request: Request) -> None:
        step = TRANSITIONS[self.state][request]
        refused = step.refused_if is not None and (
            getattr(self._options, step.refused_if[0]) == step.refused_if[1]
        )
        if step.target is None or refused:
            raise Refusal(getattr(self._options, step.refusal))
        self.state = step.target


def state_diagram() -> str:
    """Return the machine as a Mermaid state diagram; refused requests are its notes.

    Examples
    --------
    >>> print(state_diagram().splitlines()[1])
        [*] --> RUN: power-up as shipped, or was running
    """
    lines = [
        "stateDiagram-v2",
        "    [*] --> RUN: power-up as shipped, or was running",
        "    [*] --> STOPPED: power-up, was stopped",
    ]
    notes: list[str] = []
    for state, steps in TRANSITIONS.items():
        by_target: dict[State, list[str]] = {}
        refused: list[str] = []
        for request, step in steps.items():
            if step.target is None:
                refused.append(request.value)
            else:
                condition = "" if step.refused_if is None else " (option)"
                by_target.setdefault(step.target, []).append(request.value + condition)
        lines += [
            f"    {state.name} --> {target.name}: {', '.join(requests)}"
            for target, requests in by_target.items()
        ]
        if refused:
            notes.append(f"    note right of {state.name}: {', '.join(refused)} get ERROR")
    return "\n".join(lines + notes)


if __name__ == "__main__":
    print(state_diagram())  # noqa: T201 - this is what running the module is for
