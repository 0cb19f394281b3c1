"""The mode machine of an X4M300: profile loaded, running, paused, stopped, or raw radar.

| SETMODE | needs a profile | then |
|---|---|---|
| RUN | yes, else ERROR 20h | the profile runs; this state is what a reset restores |
| IDLE | yes, else ERROR 20h | the profile pauses, RUN resumes |
| MANUAL | no | radar frames go to the host |
| STOP | no | the profile is unloaded, messages stop |
| REG | no | certification modes; no frames |
| NORMAL, anything else | - | ERROR 1 |

LOADAPP sets the profile and leaves the module stopped. Direct jumps (RUN to MANUAL) are accepted,
which the reference leaves open; so is IDLE without a profile, refused here like RUN.

Source: protocol reference 4.2, 4.3, 8.2 and 8.3.
"""

from __future__ import annotations

from emulator.refusal import Refusal
from xethru_protocol.codes import ErrorCode, ProfileId, SensorMode

__all__ = ["ModeMachine"]

X4M300_PROFILES = frozenset({ProfileId.XTS_ID_APP_PRESENCE_2})

_NEEDS_PROFILE: dict[int, bool] = {
    SensorMode.XTID_SM_RUN: True,
    SensorMode.XTID_SM_IDLE: True,
    SensorMode.XTID_SM_MANUAL: False,
    SensorMode.XTID_SM_STOP: False,
    SensorMode.XTID_SM_REG: False,
}


class ModeMachine:
    """Mode and profile of one module, as a stock X4M300 powers up: its profile runs.

    Attributes
    ----------
    mode
        Current mode, as GETMODE answers it.
    profile_id
        Loaded profile, 0 for none.
    """

    def __init__(self, profiles: frozenset[ProfileId] = X4M300_PROFILES) -> None:
        self._profiles = profiles
        self._saved_profile_id: int = ProfileId.XTS_ID_APP_PRESENCE_2
        self._was_running = True
        self.power_up()

    def power_up(self) -> None:
        """Restore the profile that ran last; a module that was stopped stays stopped."""
        if self._was_running:
            self.profile_id: int = self._saved_profile_id
            self.mode = SensorMode.XTID_SM_RUN
        else:
            self.profile_id = ProfileId.XTS_ID_APP_NONE
            self.mode = SensorMode.XTID_SM_STOP

    def set_mode(self, mode: int) -> None:
        """Change the mode, or raise `Refusal`."""
        needs_profile = _NEEDS_PROFILE.get(mode)
        if needs_profile is None:
            raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
        if needs_profile and self.profile_id == ProfileId.XTS_ID_APP_NONE:
            raise Refusal(ErrorCode.XTS_SPRE_APP_INVALID)
        self.mode = SensorMode(mode)
        if self.mode is SensorMode.XTID_SM_RUN:
            self._saved_profile_id = self.profile_id
            self._was_running = True
        elif self.mode is SensorMode.XTID_SM_STOP:
            self.profile_id = ProfileId.XTS_ID_APP_NONE
            self._was_running = False

    def load_profile(self, profile_id: int) -> None:
        """Load a profile without running it, or raise `Refusal` for one this product lacks."""
        if profile_id not in self._profiles:
            raise Refusal(ErrorCode.XTS_SPRE_APP_INVALID)
        self.profile_id = profile_id
        self.mode = SensorMode.XTID_SM_STOP
        self._was_running = False
