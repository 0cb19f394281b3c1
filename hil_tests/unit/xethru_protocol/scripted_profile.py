"""A module's presence profile, written from Protocol reference 4.2-4.7, 7.3, 8.2 and 8.3."""

import math
from collections.abc import Sequence

from hil_tests.unit.xethru_protocol.scripted import READY
from xethru_protocol.wire import messages as m

STEP_M = 0.0514403  # grid of zones
STOP, RUN, IDLE = 0x13, 0x01, 0x11


class ProfileModule:
    """A stopped module that knows PRESENCE_2; ``said_on_run`` is what running sends at once."""

    def __init__(self) -> None:
        self.profile = 0
        self.mode = STOP
        self.zone = (0.4, 9.4)
        self.sensitivity = 5
        self.band = 3
        self.led = 2
        self.noise_map = 7
        self.outputs: dict[int, int] = {}
        self.said_on_run: tuple[m.Message, ...] = ()
        self.run_errors: list[int] = []
        self.received: list[m.Message] = []

    def __call__(  # noqa: PLR0911 - one return per command
        self, command: m.Message
    ) -> Sequence[m.Message | bytes]:
        self.received.append(command)
        match command:
            case m.Ping():
                return [READY]
            case m.SystemGetInfo():
                return [m.ReplyString(content_id=0x58, info=6, text="123456789012")]
            case m.GetProfileId():
                return [m.ReplyInt(values=(self.profile,))]
            case m.LoadApp(profile_id=profile):
                if profile != 0x014D4AB8:
                    return [m.Error(code=0x20)]
                self.profile = profile
                return [m.Ack()]
            case m.SetMode(mode=mode):
                return self._set_mode(mode)
        if not self.profile:
            return []  # several questions get no answer at all then
        return [self._setting(command)]

    def _set_mode(self, mode: int) -> Sequence[m.Message]:
        if mode == STOP:
            self.profile = 0
        elif not self.profile:
            return [m.Error(code=0x20)]
        elif mode == RUN and self.run_errors:
            return [m.Error(code=self.run_errors.pop(0))]
        self.mode = mode
        return [m.Ack(), *self.said_on_run] if mode == RUN else [m.Ack()]

    def _setting(self, command: m.Message) -> m.Response:
        answer = self._get(command)
        if answer is not None:
            return answer
        if self.mode == RUN and not isinstance(command, m.OutputSetControl):
            return m.Error(code=0x21)
        match command:
            case m.SetDetectionZone(start_m=start, end_m=end):
                begin = math.floor((start - 0.4) / STEP_M + 1e-6) * STEP_M + 0.4
                self.zone = (begin, math.ceil((end - 0.4) / STEP_M - 1e-6) * STEP_M + 0.4)
            case m.SetSensitivity(sensitivity=value):
                self.sensitivity = value
            case m.SetTxCenterFrequency(tx_center_frequency=value):
                self.band = value
            case m.AppSetLedControl(mode=value):
                self.led = value
            case m.NoiseMapSetControl(control=value):
                self.noise_map = value
            case m.OutputSetControl(feature=feature, control=value):
                self.outputs[feature] = value
            case m.StoreNoiseMap() | m.LoadNoiseMap() | m.DeleteNoiseMap() | m.FactoryPreset():
                pass
            case _:
                return m.Error(code=1)
        return m.Ack()

    def _get(self, command: m.Message) -> m.Response | None:  # noqa: PLR0911 - one return per command
        match command:
            case m.GetDetectionZoneLimits():
                return m.ReplyFloat(values=(0.4, 9.4, STEP_M))
            case m.GetDetectionZone():
                return m.ReplyFloat(values=self.zone)
            case m.GetSensitivity():
                return m.ReplyInt(values=(self.sensitivity,))
            case m.GetTxCenterFrequency():
                return m.ReplyInt(values=(self.band,))
            case m.AppGetLedControl():
                return m.ReplyByte(values=bytes([self.led]))
            case m.NoiseMapGetControl():
                return m.ReplyInt(values=(self.noise_map,))
            case m.OutputGetControl(feature=feature):
                return m.ReplyInt(values=(self.outputs.get(feature, 0),))
        return None


def presence(counter: int, state: int) -> m.PresenceSingle:
    return m.PresenceSingle(
        counter=counter, state=state, distance_m=1.5, direction=1, signal_quality=4
    )
