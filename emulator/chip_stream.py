"""Radar frames as messages that fall due: the chip's timer under one of the two paces."""

from __future__ import annotations

from emulator.commands import Module
from emulator.module_clock import ModuleClock
from emulator.outbox import MessageStream
from emulator.pace import Pace
from xethru_protocol.codes import SensorMode
from xethru_protocol.messages import Command, DataFloat, Response

__all__ = ["ChipStream"]

_CLOCK_TOLERANCE_NS = 2


class ChipStream(MessageStream):
    """Frames of a module in MANUAL mode.

    Under `Pace.ASAP` the next frame is always due. Under `Pace.REALTIME` counter k is due at
    ``scene_time_zero_ns`` + the scene time at which the module's clock shows k's nominal time; a
    stream that starts late begins with the first counter still ahead, because the chip's counter
    runs on.

    Parameters
    ----------
    module
        The module whose chip makes the frames.
    pace
        Whether frames wait for their time.
    clock
        The module's own: its start skew and its rate error.
    scene_time_zero_ns
        Device time of scene time 0, ns.
    """

    def __init__(
        self, module: Module, *, pace: Pace, clock: ModuleClock, scene_time_zero_ns: int = 0
    ) -> None:
        self._module = module
        self._pace = pace
        self._zero_ns = scene_time_zero_ns
        self._clock = clock
        self._was_streaming = False
        self._known = False  # the due time, until a frame, a command or a restart changes it
        self._due_ns: int | None = None

    @property
    def streaming(self) -> bool:
        """Whether frames go to the host. Protocol reference 8.3 and 8.4."""
        module = self._module
        return module.modes.mode is SensorMode.XTID_SM_MANUAL and module.chip.running

    def next_due_ns(self) -> int | None:
        """Return when the next frame is due; 0, long past, under `Pace.ASAP`."""
        if not self._known:
            self._due_ns, self._known = self._next_due_ns(), True
        return self._due_ns

    def _next_due_ns(self) -> int | None:
        if not self.streaming:
            return None
        if self._pace is Pace.ASAP:
            return 0
        timeline = self._module.chip.timeline
        nominal_ns = timeline.scene_time_ns(timeline.next_counter)
        return self._zero_ns + self._clock.scene_time_ns(nominal_ns)

    def take(self) -> Response:
        """Return the next frame; its counter moves on."""
        self._known = False
        frame = self._module.chip.next_frame()
        return DataFloat(info=frame.counter, values=frame.values)

    def skip_due_before(self, time_ns: int) -> int:
        """Let the counter run past every frame due before a time."""
        due_ns = self.next_due_ns()
        if due_ns is None or due_ns >= time_ns or self._pace is Pace.ASAP:
            return 0
        timeline = self._module.chip.timeline
        # The clock's way back is exact to 1 ns: skip to just before, and go on one by one.
        nominal_ns = self._clock.nominal_ns(time_ns - self._zero_ns)
        skipped = timeline.skip_before(nominal_ns - _CLOCK_TOLERANCE_NS)
        while (due_ns := self._next_due_ns()) is not None and due_ns < time_ns:
            timeline.next_counter += 1
            skipped += 1
        self._known = False
        return skipped

    def command_done(self, command: Command[Response], now_ns: int) -> None:
        """Begin with the first frame still ahead when a command started the stream."""
        del command  # any command may have started or stopped it
        self._known = False
        streaming = self.streaming
        if streaming and not self._was_streaming:
            self.skip_due_before(now_ns)
        self._was_streaming = streaming

    def restarted(self, ready_ns: int) -> None:
        """Look again: the chip is off until a host sets a rate again."""
        self._known = False
