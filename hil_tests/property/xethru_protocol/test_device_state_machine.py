"""Random command sequences: the device answers what a small model of chapter 8 says."""

from __future__ import annotations

from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from hil_tests.property.device_model import (
    IDLE,
    MANUAL,
    OK,
    PRESENCE_2,
    REG,
    RUN,
    SILENCE,
    STOP,
    VOLATILE,
    ModuleModel,
    Verdict,
)
from hil_tests.unit.emulator.doubles import BareHost, ramp_device
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import X4Setting

SECOND = 1_000_000_000
REPLIES = (m.Ack, m.Error, m.Pong, m.ReplyByte, m.ReplyInt, m.ReplyFloat, m.System)
FEATURES = (*VOLATILE, 0x723BFA1E, 0x723BFA1F)


MODES = st.sampled_from([RUN, RUN, RUN, IDLE, IDLE, MANUAL, STOP, REG, 0x10])


class DeviceMachine(RuleBasedStateMachine):
    """Sends commands to a device and to the model, and compares the answers."""

    @initialize()
    def power_up(self) -> None:
        self.host = BareHost(ramp_device())
        self.model = ModuleModel()

    def expect(self, command: m.Command[m.Response], verdict: Verdict, reply: m.Response) -> None:
        self.host.send(command)
        heard = [message for message in self.host.hear(5) if isinstance(message, REPLIES)]
        if verdict == OK:
            assert heard == [reply]
        elif verdict == SILENCE:
            assert heard == []
        else:
            assert heard == [m.Error(code=int(verdict))]

    def restarted(self) -> None:
        self.host.now_ns += 3 * SECOND
        self.host.device.advance(self.host.now_ns)
        heard = self.host.hear(2)
        if self.model.bootloader:
            assert heard == []
        else:
            assert heard == [m.System(code=0x10), m.System(code=0x11)]

    @precondition(lambda self: not self.model.bootloader)
    @rule(mode=MODES)
    def set_mode(self, mode: int) -> None:
        self.expect(m.SetMode(mode=mode), self.model.set_mode(mode), m.Ack())

    @precondition(lambda self: not self.model.bootloader)
    @rule(profile_id=st.sampled_from([PRESENCE_2, PRESENCE_2, 0x064E57AD, 0]))
    def load(self, profile_id: int) -> None:
        self.expect(m.LoadApp(profile_id=profile_id), self.model.load(profile_id), m.Ack())

    @precondition(lambda self: not self.model.bootloader)
    @rule(value=st.integers(0, 12))
    def set_sensitivity(self, value: int) -> None:
        verdict = self.model.may_set()
        if verdict == OK and value > 9:
            verdict = 0x21
        self.expect(m.SetSensitivity(sensitivity=value), verdict, m.Ack())
        if verdict == OK:
            self.model.now.sensitivity = value

    @precondition(lambda self: not self.model.bootloader)
    @rule(value=st.integers(2, 5))
    def set_band(self, value: int) -> None:
        verdict = self.model.may_set()
        if verdict == OK and value not in (3, 4):
            verdict = 0x21
        self.expect(m.SetTxCenterFrequency(tx_center_frequency=value), verdict, m.Ack())
        if verdict == OK:
            self.model.now.band = value

    @precondition(lambda self: not self.model.bootloader)
    @rule(feature=st.sampled_from(FEATURES), bits=st.integers(0, 3))
    def set_output(self, feature: int, bits: int) -> None:
        verdict = self.model.may_output(feature)
        self.expect(m.OutputSetControl(feature=feature, control=bits), verdict, m.Ack())
        if verdict == OK:
            self.model.set_output(feature, bits)

    @precondition(lambda self: not self.model.bootloader)
    @rule()
    def load_and_run(self) -> None:
        self.load(PRESENCE_2)
        self.set_mode(RUN)

    @precondition(lambda self: not self.model.bootloader)
    @rule(fps=st.sampled_from([0.0, 17.0]))
    def stream(self, fps: float) -> None:
        """8.3: X4DRIVER works in every mode; 8.4: only MANUAL, or no modes, sends frames."""
        setting = X4Setting.FPS
        self.expect(m.X4DriverSet(setting=setting, value=fps), OK, m.Ack())
        frames = [heard for heard in self.host.hear(3) if isinstance(heard, m.DataFloat)]
        raw = self.model.mode == MANUAL
        assert bool(frames) == (raw and fps > 0)
        self.expect(m.X4DriverSet(setting=setting, value=0.0), OK, m.Ack())

    @precondition(lambda self: not self.model.bootloader)
    @rule()
    def reset(self) -> None:
        self.expect(m.ModReset(), OK, m.Ack())
        self.model.host_reset()
        self.restarted()

    @rule(times=st.sampled_from([1, 1, 1, 9, 6]))
    def crash(self, times: int) -> None:
        for _ in range(times):
            if self.model.bootloader:
                return
            self.host.device.module.crash("watchdog", self.host.now_ns)
            self.model.fault()
            self.restarted()

    @precondition(lambda self: self.model.bootloader)
    @rule()
    def leave_the_bootloader(self) -> None:
        self.host.send(m.BootloaderStartApp())
        assert len(self.host.hear(2)) == 1
        self.model.host_reset()
        self.restarted()

    @invariant()
    def tells_its_mode(self) -> None:
        if self.model.bootloader:
            self.expect(m.Ping(), SILENCE, m.Ack())
            return
        pong = 0xFFEEFEEF if self.model.safe else 0xAAEEAEEA
        self.expect(m.Ping(), OK, m.Pong(value=pong))
        verdict = 1 if self.model.safe else OK
        self.expect(m.GetMode(), verdict, m.ReplyByte(values=bytes([self.model.mode])))
        profile_id = PRESENCE_2 if self.model.loaded else 0
        self.expect(m.GetProfileId(), verdict, m.ReplyInt(values=(profile_id,)))

    @invariant()
    def tells_its_settings(self) -> None:
        if self.model.bootloader:
            return
        verdict = self.model.may_get(observed_silent=False)
        sensitivity = m.ReplyInt(content_id=0x10A5112B, values=(self.model.now.sensitivity,))
        self.expect(m.GetSensitivity(), verdict, sensitivity)
        band = m.ReplyInt(content_id=0x71AF2A2B, values=(self.model.now.band,))
        self.expect(m.GetTxCenterFrequency(), verdict, band)
        verdict = self.model.may_get(observed_silent=True)
        for feature in FEATURES:
            bits = self.model.now.outputs.get(feature, 0)
            self.expect(m.OutputGetControl(feature=feature), verdict, m.ReplyInt(values=(bits,)))


DeviceMachine.TestCase.settings = hypothesis_settings(max_examples=25, stateful_step_count=40)
TestDeviceMachine = DeviceMachine.TestCase
