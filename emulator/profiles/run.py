"""One run of the profile: its frames in order, and the messages each of them brings.

A matrix is hundreds of messages, a range bin each; they are spread evenly over the frames until
the next one, so that the module's queue of 50 slots can take them. Pulse-Doppler matrices are sent
from when they are full, noise maps from when they are in use.

Frames nobody hears of are not synthesised: a run that must catch up with a long silence goes
through the frames that fill the matrices (and those that make the noise map), which leaves the
same state but for the noise map's adaptation.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from typing import Protocol

from emulator.module_clock import ModuleClock
from emulator.profiles.baseband import baseband_ap, baseband_iq
from emulator.profiles.doppler import MATRICES, SLOW, Matrix
from emulator.profiles.noise_map import Powers
from emulator.profiles.presence import PresenceProcessing
from emulator.profiles.reports import MATRIX_REPORTS, matrix_reports, moving_list, presence_single
from emulator.profiles.sweep import FRAMES_PER_TICK, ProfileSweep
from xethru_protocol.codes import MatrixControl, OutputFeature
from xethru_protocol.messages import Response

__all__ = ["OutputSettings", "ProfileRun"]

_BASEBAND = {
    OutputFeature.BASEBAND_IQ: baseband_iq,
    OutputFeature.BASEBAND_AMPLITUDE_PHASE: baseband_ap,
}
_PRESENCE = (OutputFeature.PRESENCE_SINGLE, OutputFeature.PRESENCE_MOVINGLIST)
_NOISE_MAPS = (OutputFeature.NOISEMAP_FLOAT, OutputFeature.NOISEMAP_BYTE)
# Ticks and the matrices' periods repeat after it, so leaving out multiples shifts nothing.
_CYCLE = SLOW.frames


class OutputSettings(Protocol):
    """What of the profile's settings a run obeys while it runs."""

    @property
    def outputs(self) -> Mapping[int, int]:
        """Control bits by message id; what is off is absent or 0."""
        ...

    @property
    def sensitivity(self) -> int:
        """0...9."""
        ...


class ProfileRun:
    """A profile from RUN to STOP, or from one pause to the next.

    Parameters
    ----------
    sweep
        Its radar.
    processing
        What it makes of the frames.
    settings
        Called for what to send; it may change at any time.
    first_counter
        Of its first frame.
    zero_ns
        Device time of scene time 0, ns.
    clock
        The module's own.
    sampling_hz
        Sampling frequency that baseband messages claim.
    """

    def __init__(
        self,
        sweep: ProfileSweep,
        processing: PresenceProcessing,
        settings: Callable[[], OutputSettings],
        *,
        first_counter: int,
        zero_ns: int,
        clock: ModuleClock,
        sampling_hz: float,
    ) -> None:
        self.sweep = sweep
        self.processing = processing
        self._settings = settings
        self._first_counter = first_counter
        self._zero_ns = zero_ns
        self._clock = clock
        self._sampling_hz = sampling_hz
        self._taken = 0  # frames so far
        self._ready: deque[Response] = deque()
        self._spread: dict[tuple[int, Matrix], deque[Response]] = {}

    @property
    def silent(self) -> bool:
        """Whether no output is on."""
        return self._next_index() is None and not self._ready

    def next_due_ns(self) -> int | None:
        """Return when the next message is due; None when no output is on."""
        if self._ready:
            return self._due_ns(self._taken - 1)
        index = self._next_index()
        return None if index is None else self._due_ns(index)

    def take(self) -> Response:
        """Return the next message; there must be one."""
        while not self._ready:
            self._frame()
        return self._ready.popleft()

    def skip_before(self, time_ns: int) -> int:
        """Give up every message due before a time; return how many."""
        skipped = 0
        while (due_ns := self.next_due_ns()) is not None and due_ns < time_ns:
            skipped += self._jump(time_ns)
            self.take()
            skipped += 1
        return skipped

    def pass_before(self, time_ns: int) -> None:
        """Go through every frame due before a time without a message."""
        while self._due_ns(self._taken) < time_ns:
            self._jump(time_ns)
            self._frame()
            self._ready.clear()

    def _due_ns(self, index: int) -> int:
        nominal_ns = self.sweep.scene_time_ns(self._first_counter + index)
        return self._zero_ns + self._clock.scene_time_ns(nominal_ns)

    def _on(self, feature: int) -> int:
        return self._settings().outputs.get(feature, 0)

    def _next_index(self) -> int | None:
        """Return the frame that brings the next message."""
        candidates: list[int] = []
        if any(map(self._on, _BASEBAND)) or any(self._spread.values()):
            candidates.append(self._taken)
        if any(map(self._on, _PRESENCE)):
            candidates.append(_next_multiple(self._taken, FRAMES_PER_TICK))
        for feature in MATRIX_REPORTS:
            for matrix in self._instances(feature):
                # not before the matrix is full, so that its first frame brings a message
                start = max(self._taken, matrix.frames - 1)
                candidates.append(_next_multiple(start, matrix.period))
        return min(candidates, default=None)

    def _instances(self, feature: int) -> list[Matrix]:
        control = MatrixControl(self._on(feature))
        wanted = (bool(control & MatrixControl.SLOW), control.fast)
        return [matrix for matrix in MATRICES if wanted[matrix.instance]]

    def _frame(self) -> None:
        """Take one frame, and make ready its messages."""
        index = self._taken
        counter = self._first_counter + index
        iq = self.sweep.frame(counter)
        self.processing.add(iq)
        self._taken += 1
        for feature, message in _BASEBAND.items():
            if self._on(feature):
                self._ready.append(message(self.sweep, counter, iq, self._sampling_hz))
        if self._taken % FRAMES_PER_TICK == 0:
            self._tick(counter)
        self._release()

    def _tick(self, counter: int) -> None:
        sensitivity = self._settings().sensitivity
        presence = self.processing.tick(sensitivity)
        if self._on(OutputFeature.PRESENCE_SINGLE):
            self._ready.append(presence_single(counter, presence, sensitivity))
        if self._on(OutputFeature.PRESENCE_MOVINGLIST):
            self._ready.append(moving_list(counter, presence))
        for feature in MATRIX_REPORTS:
            for matrix in self._instances(feature):
                power = self._powers(feature).get(matrix.instance)
                if power is not None and self._taken % matrix.period == 0:
                    self._spread[feature, matrix] = deque(
                        matrix_reports(
                            feature,
                            matrix,
                            self.sweep,
                            power.copy(),
                            counter=counter,
                            matrix_counter=self._taken // matrix.period,
                        )
                    )

    def _powers(self, feature: int) -> Powers:
        if feature not in _NOISE_MAPS:
            return self.processing.power
        noise_map = self.processing.noise_map
        return noise_map.power if noise_map.complete else {}

    def _release(self) -> None:
        """Make ready the share of the matrices that goes with one frame."""
        for (feature, matrix), waiting in self._spread.items():
            if matrix not in self._instances(feature):
                waiting.clear()
            share = -(-self.sweep.n_bins // matrix.period)
            for _ in range(min(share, len(waiting))):
                self._ready.append(waiting.popleft())

    def _jump(self, time_ns: int) -> int:
        """Leave out frames that nobody will hear of, if there are many; return their messages."""
        if not self.processing.noise_map.complete:
            return 0
        cycles = 0
        while self._due_ns(self._taken + (cycles + 3) * _CYCLE) < time_ns:
            cycles += 1
        if cycles == 0:
            return 0
        frames = cycles * _CYCLE
        baseband = sum(map(bool, map(self._on, _BASEBAND))) * frames
        presence = sum(map(bool, map(self._on, _PRESENCE))) * (frames // FRAMES_PER_TICK)
        self._taken += frames
        self.processing.refill()
        self._ready.clear()
        self._spread.clear()
        return baseband + presence


def _next_multiple(taken: int, period: int) -> int:
    """Return the index of the first frame, from `taken` on, that completes a period."""
    return taken + (-(taken + 1)) % period
