"""The running profile takes small steps: whatever is switched when, no call does much work.

The radar's source is the witness: it counts the frames asked of it within one call of the device,
and the newest scene time. A profile that waits in a loop for a message that never comes asks for
frames without end; one that runs ahead asks for frames of the future.
"""

from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule
from numpy.typing import NDArray

from emulator.chip import Pace
from emulator.chip.chip import CaptureSettings
from emulator.x4m300 import REALTIME_BLOCK, Device, radar_device
from hil_tests.property.examples import examples
from hil_tests.unit.emulator.doubles import IDENTITY, RampSource
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import OutputFeature, SensorMode
from xethru_protocol.wire.connection import Connection, Role

SECOND = 1_000_000_000
PRESENCE_2 = 0x014D4AB8
FRAMES_PER_CALL = 2 * REALTIME_BLOCK
"""The eight steps of one visit of a queue end one block and begin another."""
AHEAD_NS = round(REALTIME_BLOCK / 17.049379 * SECOND)
"""By how much a block is ahead of its first frame."""
RUN, IDLE, MANUAL, STOP = (
    SensorMode.XTID_SM_RUN,
    SensorMode.XTID_SM_IDLE,
    SensorMode.XTID_SM_MANUAL,
    SensorMode.XTID_SM_STOP,
)
PRESENCE = (OutputFeature.PRESENCE_SINGLE, OutputFeature.PRESENCE_MOVINGLIST)
OTHERS = (
    OutputFeature.BASEBAND_IQ,
    OutputFeature.BASEBAND_AMPLITUDE_PHASE,
    OutputFeature.PULSEDOPPLER_FLOAT,
    OutputFeature.PULSEDOPPLER_BYTE,
    OutputFeature.NOISEMAP_FLOAT,
    OutputFeature.NOISEMAP_BYTE,
)


class CountingSource(RampSource):
    """A `RampSource` that fails when one call asks for more frames than a turn may make."""

    def __init__(self) -> None:
        super().__init__()
        self.frames_in_call = 0
        self.newest_ns = 0

    def rf_counters(
        self,
        capture: CaptureSettings,
        frame_counters: NDArray[np.int64],
        scene_times_ns: NDArray[np.int64],
    ) -> NDArray[np.int64]:
        self.frames_in_call += len(frame_counters)
        assert self.frames_in_call <= FRAMES_PER_CALL, "one call works without end"
        self.newest_ns = max(self.newest_ns, int(scene_times_ns.max()))
        return super().rf_counters(capture, frame_counters, scene_times_ns)


class Line:
    """The owner of a module's line: passes time, takes packets, and counts what a call costs."""

    def __init__(self, pace: Pace) -> None:
        self.source = CountingSource()
        self.device: Device = radar_device(IDENTITY, self.source, pace)
        self.lossless = pace is Pace.ASAP
        self.now_ns = 0
        self._host = Connection(Role.HOST)

    def ask(self, command: m.Command[Any]) -> None:
        self.source.frames_in_call = 0
        self.device.receive_data(self._host.send(command), self.now_ns)

    def turn(self) -> m.Message | None:
        self.source.frames_in_call = 0
        self.device.advance(self.now_ns)
        self.source.frames_in_call = 0
        packet = self.device.next_packet(self.now_ns)
        assert self.source.newest_ns <= self.now_ns + AHEAD_NS, "frames of the future"
        if packet is None:
            return None
        self._host.receive_data(packet)
        event = self._host.next_event()
        assert isinstance(event, m.Message), event
        return event

    def listen_until(self, end_ns: int) -> list[m.Message]:
        """Return what came until nothing more is due before a time."""
        heard = []
        for _ in range(20_000):
            message = self.turn()
            if message is not None:
                heard.append(message)
                continue
            wake_ns = self.device.wake_ns(self.now_ns)
            if wake_ns is None or wake_ns > end_ns:
                self.now_ns = end_ns
                return heard
            self.now_ns = max(wake_ns, self.now_ns)
        raise AssertionError("the device keeps its line busy and time stands still")

    def setup(self, control: int, outputs: dict[OutputFeature, int]) -> None:
        """Load the profile with these outputs only, and run it."""
        self.ask(m.SetMode(mode=STOP))
        self.ask(m.LoadApp(profile_id=PRESENCE_2))
        self.ask(m.NoiseMapSetControl(control=control))
        for feature in PRESENCE:
            self.ask(m.OutputSetControl(feature=feature, control=0))
        for feature, bits in outputs.items():
            self.ask(m.OutputSetControl(feature=feature, control=bits))
        self.ask(m.SetMode(mode=RUN))


class ProfileTurns(RuleBasedStateMachine):
    @initialize(
        pace=st.sampled_from(list(Pace)),
        control=st.sampled_from([6, 7]),
        output=st.sampled_from((*PRESENCE, *OTHERS)),
    )
    def begin(self, pace: Pace, control: int, output: OutputFeature) -> None:
        self.line = Line(pace)
        self.line.setup(control, {output: 3 if output in OTHERS else 1})

    @rule(feature=st.sampled_from((*PRESENCE, *OTHERS)), bits=st.integers(0, 3))
    def switch(self, feature: OutputFeature, bits: int) -> None:
        self.line.ask(m.OutputSetControl(feature=feature, control=bits))

    @rule(mode=st.sampled_from([RUN, RUN, IDLE, STOP, MANUAL]))
    def set_mode(self, mode: SensorMode) -> None:
        self.line.ask(m.SetMode(mode=mode))

    @rule(outputs=st.dictionaries(st.sampled_from(PRESENCE), st.integers(0, 1)))
    def run_anew(self, outputs: dict[OutputFeature, int]) -> None:
        self.line.setup(7, outputs)

    @rule()
    def reset(self) -> None:
        self.line.ask(m.ModReset())

    @rule(seconds=st.sampled_from([0.0, 0.06, 1.0, 3.0]))
    def listen(self, seconds: float) -> None:
        self.line.listen_until(self.line.now_ns + round(seconds * SECOND))

    @rule(seconds=st.sampled_from([0.5, 2.0, 130.0, 4000.0]))
    def the_owner_sleeps(self, seconds: float) -> None:
        if self.line.lossless:  # all its messages come later, hundreds for every second
            seconds = min(seconds, 20.0)
        self.line.now_ns += round(seconds * SECOND)
        self.line.turn()

    def teardown(self) -> None:
        line = getattr(self, "line", None)
        if line is None:
            return
        line.listen_until(line.now_ns + 5 * SECOND)
        line.ask(m.Ping())
        assert any(isinstance(message, m.Pong) for message in line.listen_until(line.now_ns))


TestProfileTurns = pytest.mark.slow(ProfileTurns.TestCase)
TestProfileTurns.settings = settings(
    max_examples=examples(16, 40),
    stateful_step_count=16,
    deadline=None,
    phases=(Phase.explicit, Phase.reuse, Phase.generate),  # a shrunk sequence takes minutes
)


@pytest.mark.parametrize("pace", list(Pace))
def test_a_module_answers_when_its_last_output_is_switched_off(pace: Pace) -> None:
    line = Line(pace)
    line.setup(6, {OutputFeature.PULSEDOPPLER_FLOAT: 3})
    line.listen_until(21 * SECOND)
    line.ask(m.OutputSetControl(feature=OutputFeature.PULSEDOPPLER_FLOAT, control=0))
    line.ask(m.Ping())
    assert isinstance(line.listen_until(line.now_ns + SECOND)[-1], m.Pong)


@pytest.mark.parametrize("pace", list(Pace))
def test_a_noise_map_alone_comes_when_it_is_there(pace: Pace) -> None:
    """Protocol reference 4.6: a map that is created takes 120 s, and is not sent before."""
    line = Line(pace)
    line.setup(7, {OutputFeature.NOISEMAP_FLOAT: 2})
    line.listen_until(118 * SECOND)
    heard = line.listen_until(122 * SECOND)
    rows = [message for message in heard if isinstance(message, m.NoiseMapFloat)]
    assert rows
    assert rows[0].range_idx == 0
