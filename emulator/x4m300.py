"""One emulated X4M300 without I/O and without a clock: bytes and times in, bytes out.

`Device` joins the parts: the connection turns bytes into commands, `commands` answers them, a
`MessageStream` makes unsolicited messages, an `Outbox` holds what waits for the line.

A reset: ACK, half a second later the module restarts, receives nothing for two seconds, then sends
BOOTING and READY. Whatever owns the port asks `Device.port_present` whether it is there meanwhile.

Source: protocol reference 8.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from emulator.chip import Pace
from emulator.chip.chip import Chip, EchoSource, ModuleClock
from emulator.module.commands import answer
from emulator.module.memory import Identity, Memory
from emulator.module.modes import STREAMING, Group, ModuleState, group_of
from emulator.module.outbox import (
    FirmwareOutbox,
    LosslessOutbox,
    MessageKind,
    MessageStream,
    Outbox,
    StreamBegin,
)
from emulator.module.settings import DeviceOptions
from emulator.module.state import ACK_WAIT_NS, Module
from emulator.profiles.running_profile import ProfileStream
from xethru_protocol.wire.codec import decode_response, encode
from xethru_protocol.wire.codes import ErrorCode, SystemCode
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.framing import FaultKind, Framing, FramingFault, NeedData
from xethru_protocol.wire.messages import (
    BasebandAp,
    BasebandIq,
    Command,
    DataFloat,
    DataString,
    Error,
    InjectFrame,
    PresenceSingle,
    Response,
    SetFileData,
    SetParameterFile,
    System,
    UnknownMessage,
    X4DriverWrite,
    X4DriverWriteI2c,
)
from xethru_protocol.wire.versions import (
    BAUD_RATE,
    BOARD_CONFIGURATION,
    Q_SIGN,
    firmware_named,
)
from xethru_protocol.wire.x4 import DEFAULT_OFFSET_M, FIRST_COUNTER

MOST_WAITING_BYTES = 2 * 7000 + 10 * 100
"""Of commands while one takes its time: as many as the firmware's message pool has (1.1)."""
RESET_TO_READY_NS = 2_000_000_000
"""Until the transmitter starts and the queued BOOTING and READY leave. Protocol reference 8.1."""
NORMAL_START = 0x7D
NORMAL_BUFFER = 8000
"""Bytes of a Normal packet, escapes included, that a module can send (protocol reference 1.1)."""
LARGEST_POOL_BLOCK = 7000
"""Payload bytes of the largest command that a module processes (protocol reference 1.1)."""
LARGEST_REPLY = LARGEST_POOL_BLOCK - 24 + 15
"""Payload bytes of the largest answer: its elements lie behind 24 bytes in a block of the message
pool, and have 15 around them on the line. A larger one is not sent (protocol reference 1.1)."""
BASE_FIRMWARE_FRAMES = 2
"""Radar frames that find a block in the base firmware's message pool (protocol reference 1.1)."""
COMMANDS_AT_ONCE = 16
"""How many commands one visit carries out; the modules beside this one have their turn then."""
_LONG_COMMANDS = (
    InjectFrame,
    SetFileData,
    SetParameterFile,
    UnknownMessage,
    X4DriverWrite,
    X4DriverWriteI2c,
)

ASAP_BLOCK = 32
# Radars in step refill at the same moment: four blocks of 16 cost 3 ms, four of 32 cost 7 ms.
# In blocks of 8 a frame costs half as much again.
REALTIME_BLOCK = 16
_CLOCK_TOLERANCE_NS = 2


class ChipStream(MessageStream):
    """Frames of a module in MANUAL mode.

    Under `Pace.ASAP` the next frame is always due, and scene time stands still between two frames,
    whatever happens between them: a stream after INIT or a reset begins where the one before it
    ended. Under `Pace.REALTIME` a frame is due at ``scene_time_zero_ns`` + the scene time at which
    the module's clock shows its nominal time; a stream begins with the first frame still ahead.
    """

    def __init__(
        self, module: Module, *, pace: Pace, clock: ModuleClock, scene_time_zero_ns: int = 0
    ) -> None:
        self._module = module
        self._pace = pace
        self._zero_ns = scene_time_zero_ns
        self._clock = clock
        self._was_running = self._was_streaming = False
        self._reached_ns = 0  # nominal scene time of the frame after the last one taken
        self._begin: StreamBegin | None = None

    @property
    def streaming(self) -> bool:
        """Whether frames go to the host. Protocol reference 8.3 and 8.4."""
        module = self._module
        return module.state in STREAMING and module.chip.running

    @property
    def begin(self) -> StreamBegin | None:
        return self._begin

    def next_due_ns(self) -> int | None:
        """Return when the next frame is due; 0, long past, under `Pace.ASAP`."""
        if not self.streaming:
            return None
        return 0 if self._pace is Pace.ASAP else self._next_ns()

    def take(self) -> Response:
        chip = self._module.chip
        message = chip.next_frame()
        self._reached_ns = chip.timeline.scene_time_ns(chip.timeline.next_index)
        self._note_running()  # a transmitter that saw nothing for long is off now
        return message

    def skip_due_before(self, time_ns: int) -> None:
        if self.streaming and self._pace is not Pace.ASAP:
            chip = self._module.chip
            first_index = chip.timeline.next_index
            self._move_on(time_ns, chip.timeline.skip_before)
            chip.pass_over(first_index)
            self._note_running()

    def command_done(self, command: Command[Response], now_ns: int) -> None:
        """Begin with the first frame still ahead when a command started the stream."""
        timeline = self._module.chip.timeline
        if self._module.chip.running and not self._was_running:
            if self._pace is Pace.ASAP:
                timeline.pause_until(self._reached_ns)
            else:
                self._move_on(now_ns, timeline.pause_until)
            if timeline.next_counter == FIRST_COUNTER:
                number = 0 if self._begin is None else self._begin.number + 1
                begin_ns = timeline.scene_time_ns(timeline.next_index)
                self._begin = StreamBegin(number=number, scene_time_ns=begin_ns)
        elif self.streaming and not self._was_streaming:
            self.skip_due_before(now_ns)  # sweeps that went nowhere
        self._note_running()

    def restarted(self, ready_ns: int) -> None:
        self._note_running()

    def _note_running(self) -> None:
        self._was_running, self._was_streaming = self._module.chip.running, self.streaming

    def _next_ns(self) -> int:
        timeline = self._module.chip.timeline
        nominal_ns = timeline.scene_time_ns(timeline.next_index)
        return self._zero_ns + self._clock.scene_time_ns(nominal_ns)

    def _move_on(self, time_ns: int, move_to: Callable[[int], None]) -> None:
        """Move on to the first frame due at a time or later."""
        timeline = self._module.chip.timeline
        # The clock's way back is exact to 1 ns: move to just before, and go on one by one.
        nominal_ns = self._clock.nominal_ns(time_ns - self._zero_ns)
        move_to(nominal_ns - _CLOCK_TOLERANCE_NS)
        while self._next_ns() < time_ns:
            move_to(timeline.scene_time_ns(timeline.next_index) + 1)


class CombinedStream(MessageStream):
    """Messages of a module in any mode; at most one of its two streams has any.

    When the next step is due changes with a step, a restart, and commands that change modes or
    settings, so it is computed then and kept.
    """

    def __init__(self, raw: ChipStream, profile: ProfileStream) -> None:
        self._raw = raw
        self._profile = profile
        self._due_ns: int | None
        self._choose()

    @property
    def begin(self) -> StreamBegin | None:
        return self._raw.begin

    def next_due_ns(self) -> int | None:
        return self._due_ns

    def take(self) -> Response | None:
        message = self._active.take()
        self._choose()
        return message

    def skip_due_before(self, time_ns: int) -> None:
        if self._due_ns is not None and self._due_ns < time_ns:
            self._active.skip_due_before(time_ns)
            self._due_ns = self._active.next_due_ns()

    def command_done(self, command: Command[Response], now_ns: int) -> None:
        # a silent profile notes the time of every command
        if self._due_ns is not None and group_of(command) is Group.BASIC:
            return
        self._raw.command_done(command, now_ns)
        self._profile.command_done(command, now_ns)
        self._choose()

    def restarted(self, ready_ns: int) -> None:
        self._raw.restarted(ready_ns)
        self._profile.restarted(ready_ns)
        self._choose()

    def _choose(self) -> None:
        self._active = self._raw if self._raw.streaming else self._profile
        self._due_ns = self._active.next_due_ns()


def _is_oversized(command: Command[Response]) -> bool:
    """Whether a command fits no block of the firmware's message pool; it drops those silently."""
    return isinstance(command, _LONG_COMMANDS) and len(encode(command)) > LARGEST_POOL_BLOCK


class ByteDevice(Protocol):
    """What the owner of a line needs of a device; all times are of one monotonic clock.

    `wake_ns` is when time alone changes something.
    """

    @property
    def wants_data(self) -> bool: ...

    def receive_data(self, data: bytes, now_ns: int) -> None: ...

    def advance(self, now_ns: int) -> None: ...

    def next_packet(self, now_ns: int) -> bytes | None: ...

    def wake_ns(self, now_ns: int) -> int | None: ...


class PortDevice(ByteDevice, Protocol):
    """A device whose port may go away."""

    def port_present(self, now_ns: int) -> bool: ...


class Device:
    """A module as its port sees it.

    The owner of the port calls `receive_data` with what arrived, `advance` when the time named
    by `wake_ns` has come, and `next_packet` whenever the port takes more. Times are monotonic
    and only compared with each other, so any clock will do.

    Attributes
    ----------
    faults_seen
        Damaged packets received so far; like the firmware, the module does not answer them.
    """

    def __init__(self, module: Module, stream: MessageStream, outbox: Outbox) -> None:
        self.module = module
        self._stream = stream
        self._outbox = outbox
        self._start_line()
        self._reset_ns: int | None = None
        self._ready_ns: int | None = None
        # until when the command task sleeps, and the reply it sends then; commands wait behind it
        self._held: tuple[int, Response | None] | None = None
        self._backlog = False  # of received commands, for the next visit
        self._waiting_bytes = 0
        self.faults_seen = 0

    @property
    def wants_data(self) -> bool:
        """Whether more commands should be read now; a host that never reads is held back."""
        room = self._waiting_bytes < MOST_WAITING_BYTES
        return room and not self._backlog and self._outbox.takes_replies

    @property
    def stream_begin(self) -> StreamBegin | None:
        """Where the newest stream of radar frames begins in scene time."""
        return self._stream.begin

    @property
    def listens(self) -> bool:
        """Whether it receives: not while it starts or sleeps."""
        return self._ready_ns is None and not self.module.asleep

    def crash(self, reason: str, now_ns: int) -> None:
        """Fail as by a watchdog or a hard fault and restart at once; the module counts it."""
        self.advance(now_ns)
        self.module.crash(reason, now_ns)
        self.advance(now_ns)

    def power_cycle(self, now_ns: int) -> None:
        """Restart at once, as after a power cut."""
        self.advance(now_ns)
        self.module.power_cycle(now_ns)
        self.advance(now_ns)

    def port_present(self, now_ns: int) -> bool:
        """Whether the port is there; a restart takes it away if the options say so."""
        if self.module.options.port_on_reset == "stay":
            return True
        if self._reset_ns is not None and now_ns >= self._reset_ns:
            return now_ns >= self._reset_ns + RESET_TO_READY_NS
        return self._ready_ns is None or now_ns >= self._ready_ns

    def receive_data(self, data: bytes, now_ns: int) -> None:
        """Take bytes from the host and carry out commands they complete, the first few at once."""
        self.advance(now_ns)
        if not self.listens:
            return
        if self.module.state is ModuleState.BOOTLOADER:
            for payload in self.module.receive_in_bootloader(data):
                self._outbox.put(MessageKind.REPLY, decode_response(payload), now_ns)
            self._plan_restart(now_ns)
            return
        self._connection.receive_data(data)
        if self._held is not None:
            self._waiting_bytes += len(data)
        self._carry_out_commands(now_ns)

    def _start_line(self) -> None:
        self._connection = Connection(Role.MODULE)
        self._damaged = False  # by a wrong checksum, since the last command

    def _carry_out_commands(self, now_ns: int) -> None:
        left = COMMANDS_AT_ONCE
        while self._takes_commands and left:
            event = self._connection.next_event()
            if isinstance(event, NeedData):
                self._backlog = False
                return
            if isinstance(event, Command):
                left -= 1
                if not _is_oversized(event):
                    self._carry_out(event, now_ns)
            else:
                self.faults_seen += 1
                if isinstance(event, FramingFault) and event.kind is FaultKind.CHECKSUM:
                    self._damaged = True
        waits = self._held is not None or self.module.asleep
        self._backlog = self._connection.buffered > 0 and not waits

    @property
    def _takes_commands(self) -> bool:
        return self._held is None and not self.module.asleep and self._outbox.takes_replies

    def _carry_out(self, command: Command[Response], now_ns: int) -> None:
        reply: Response | None
        if self._damaged and self.module.options.after_damage == "error":
            reply = Error(code=ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
        else:
            reply = answer(self.module, command)
        self._damaged = False
        for notice in self.module.notices:
            is_text = isinstance(notice, DataString)
            self._outbox.put(MessageKind.DEBUG if is_text else MessageKind.REPLY, notice, now_ns)
        self.module.notices.clear()
        if reply is not None and len(encode(reply)) > LARGEST_REPLY:
            reply = None
        wait, self.module.wait = self.module.wait, None
        replies_now = wait is None or not wait.before_reply
        if reply is not None and replies_now:
            self._outbox.put(MessageKind.REPLY, reply, now_ns)
        if wait is not None:
            self._held = now_ns + wait.duration_ns, None if replies_now else reply
        self._plan_restart(now_ns)
        self._stream.command_done(command, now_ns)

    def _plan_restart(self, now_ns: int) -> None:
        restart = self.module.restart
        if restart is None:
            return
        if restart.at_ns is not None:
            self._reset_ns = restart.at_ns
        elif self._reset_ns is None:
            self._reset_ns = now_ns + ACK_WAIT_NS

    def advance(self, now_ns: int) -> None:
        """Let time pass: restart when due, and queue the frames that fell due."""
        self.module.advance(now_ns)
        self._plan_restart(now_ns)
        if self._reset_ns is not None and now_ns >= self._reset_ns:
            self._restart(self._reset_ns)
        if self._ready_ns is not None and now_ns >= self._ready_ns:
            self._ready_ns = None
            if self.module.state is not ModuleState.BOOTLOADER:
                for code in (SystemCode.XTS_SPRS_BOOTING, SystemCode.XTS_SPRS_READY):
                    self._outbox.put(MessageKind.REPLY, System(code=code), now_ns)
        if self._held is not None and now_ns >= self._held[0]:
            (_, reply), self._held = self._held, None
            self._waiting_bytes = 0
            self._backlog = True
            if reply is not None:
                self._outbox.put(MessageKind.REPLY, reply, now_ns)
        if self._backlog:
            self._carry_out_commands(now_ns)
        if self._sends:
            self._outbox.refill_on_time(self._stream, now_ns)

    def _restart(self, reset_ns: int) -> None:
        restart = self.module.restart
        self._ready_ns = reset_ns + RESET_TO_READY_NS
        self._reset_ns = None
        self._held = None
        self._backlog = False
        self._waiting_bytes = 0
        self._outbox.clear()
        self._start_line()
        self.module.power_up(into_bootloader=restart is not None and restart.into_bootloader)
        self._stream.restarted(self._ready_ns)

    @property
    def _sends(self) -> bool:
        return not self.module.asleep and self.module.state is not ModuleState.BOOTLOADER

    def next_packet(self, now_ns: int) -> bytes | None:
        """Return the next packet for the line, complete; None if there is nothing to send now."""
        if self._sends:
            self._outbox.refill_on_demand(self._stream, now_ns)
        message = self._outbox.take(now_ns)
        if message is None:
            return None
        if isinstance(message, PresenceSingle):
            self.module.pins.follow(message.state, message.direction)
        packet = self._connection.send(message, self._framing(message))
        # the firmware escapes into a buffer and loses what does not fit
        return packet[:NORMAL_BUFFER] if packet[0] == NORMAL_START else packet

    def _framing(self, message: Response) -> Framing | None:
        """Return how old firmware frames baseband; None: as usual."""
        if BAUD_RATE.is_in(self.module.firmware):
            return None
        raw = isinstance(message, DataFloat) and self.module.chip.settings.is_baseband
        return Framing.NORMAL if raw or isinstance(message, (BasebandIq, BasebandAp)) else None

    def wake_ns(self, now_ns: int) -> int | None:
        """Return when `advance` (and then `next_packet`) should be called next; None if never.

        What merely waits for the line to take it needs no waking and is not counted.
        """
        candidates = [self._reset_ns, self._ready_ns]
        candidates.append(None if self._held is None else self._held[0])
        if self.module.restart is not None and self._reset_ns is None:
            candidates.append(now_ns)  # a fault from outside
        if self._backlog and self._takes_commands:
            candidates.append(now_ns)
        if self._sends:
            candidates.append(self._outbox.wake_ns(self._stream, now_ns))
        return min((time_ns for time_ns in candidates if time_ns is not None), default=None)

    def port_opened(self, now_ns: int) -> None:
        self._stream.port_opened(now_ns)

    def port_closed(self, now_ns: int) -> None:
        self._stream.port_closed(now_ns)


def radar_device(
    identity: Identity,
    source: EchoSource,
    pace: Pace,
    *,
    scene_time_zero_ns: int = 0,
    clock: ModuleClock | None = None,
    options: DeviceOptions | None = None,
    memory: Memory | None = None,
) -> Device:
    """Return a stock X4M300 that sees what an echo source synthesises.

    Parameters
    ----------
    pace
        `Pace.ASAP`: nothing is dropped, frames are made as the line takes them.
        `Pace.REALTIME`: frames at absolute deadlines, firmware overflow.
    scene_time_zero_ns
        Device time of scene time 0 (`Pace.REALTIME`), ns.
    clock
        The module's own, which the source must know, too; one without error if None.
    memory
        Where its flash is kept; None forgets it with the device.
    """
    largest_block = ASAP_BLOCK if pace is Pace.ASAP else REALTIME_BLOCK
    # neighbours in a series of modules take turns in making blocks
    block_phase = None if pace is Pace.ASAP else int(identity.serial) % largest_block
    options = options or DeviceOptions()
    firmware = firmware_named(options.firmware)
    stored = BOARD_CONFIGURATION.is_in(firmware)
    chip = Chip(
        source,
        largest_block,
        block_phase,
        options.board_offset_m if stored else DEFAULT_OFFSET_M,
        negates_q=Q_SIGN.is_in(firmware),
    )
    module = Module(identity, chip, options, memory)
    clock = clock or ModuleClock()
    profile = ProfileStream(
        module,
        source,
        pace=pace,
        clock=clock,
        scene_time_zero_ns=scene_time_zero_ns,
        largest_block=REALTIME_BLOCK,
    )
    module.noise_maps = profile.noise_map_files
    chip_stream = ChipStream(module, pace=pace, clock=clock, scene_time_zero_ns=scene_time_zero_ns)
    stream = CombinedStream(chip_stream, profile)
    # of the sensor firmware's pool nothing is known: as many frames wait as the queue has slots
    frames = BASE_FIRMWARE_FRAMES if firmware.sensor is None else FirmwareOutbox.SLOTS
    outbox = LosslessOutbox() if pace is Pace.ASAP else FirmwareOutbox(frames)
    return Device(module, stream, outbox)
