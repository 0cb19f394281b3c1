"""The running profile as a stream of messages: it starts, pauses and ends with the mode.

Assumed where the reference is silent: counters of all messages are those of radar frames, of which
the first after the start of a profile has counter 1, and a pause stops the count; radar cross
sections are 0, because released firmware computes none; bytes begin at -130 dB and go in steps of
0.5 dB, rounded to the nearest. Samples are amplitude, not power (11, row 23).

A matrix is hundreds of messages, a range bin each; they are spread evenly over the frames until
the next one, so that the module's queue of 50 slots can take them. Pulse-Doppler matrices are sent
from when they are full, noise maps from when they are in use.

Every frame is a step of its own, due when its time has come, whether it brings a message or not;
no call does more than one. A profile whose outputs are all off takes no steps. When one is switched
on, the frames since then are due at once and send nothing, as are those of messages that a stalled
host lost; of many the run goes through the last that fill the matrices (and those that make the
noise map), which leaves the same state but for the noise map's adaptation.

The radar runs on the emulator's clock under both paces: a presence message a second is what makes
a profile useful to a host. Under `Pace.REALTIME` a frame is due at ``scene_time_zero_ns`` + the
scene time at which the module's clock shows its nominal time, and a profile that starts begins with
the first frame still ahead. Under `Pace.ASAP` the start of the profile is scene time 0, which
stands still in a pause, so that what a host gets does not depend on when it starts it, and nothing
is dropped.

RUN after a pause fills the matrices anew (assumed) and keeps the noise map. A module that restarts
begins when it is ready.

Source: protocol reference 4.6, 7.1 to 7.3, 8.1 to 8.3.
"""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable, Iterator
from itertools import pairwise, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emulator.chip import Pace
from emulator.chip.chip import NS_PER_S, EchoSource, ModuleClock, Refusal
from emulator.module.outbox import MessageStream
from emulator.module.settings import BASEBAND_SAMPLING_HZ, RESPIRATION_PROFILES
from emulator.module.state import NOISE_MAPS, Module
from emulator.profiles import respiration
from emulator.profiles.doppler import (
    FRAME_RATE_HZ,
    FRAMES_PER_TICK,
    MATRICES,
    SLOW,
    Matrix,
    NoiseMap,
    Powers,
    ProfileSweep,
    StoredMap,
    default_noise_map,
)
from emulator.profiles.presence import PresenceProcessing, ZoneState, signal_quality
from xethru_protocol.wire import messages as m
from xethru_protocol.wire import x4
from xethru_protocol.wire.codes import (
    MatrixControl,
    NoiseMapControl,
    OutputFeature,
    PresenceDirection,
    SensorMode,
)
from xethru_protocol.wire.messages import Command, Response

BYTE_START_DB = -130.0
BYTE_STEP_DB = 0.5

MATRIX_REPORTS: dict[int, Callable[..., m.Response]] = {
    OutputFeature.PULSEDOPPLER_FLOAT: m.PulseDopplerFloat,
    OutputFeature.PULSEDOPPLER_BYTE: m.PulseDopplerByte,
    OutputFeature.NOISEMAP_FLOAT: m.NoiseMapFloat,
    OutputFeature.NOISEMAP_BYTE: m.NoiseMapByte,
}
_BYTES = frozenset({OutputFeature.PULSEDOPPLER_BYTE, OutputFeature.NOISEMAP_BYTE})
_BASEBAND = (OutputFeature.BASEBAND_IQ, OutputFeature.BASEBAND_AMPLITUDE_PHASE)
_PRESENCE = (OutputFeature.PRESENCE_SINGLE, OutputFeature.PRESENCE_MOVINGLIST)
_RESPIRATION = (
    OutputFeature.RESP_STATUS,
    OutputFeature.SLEEP_STATUS,
    OutputFeature.VITAL_SIGNS,
    OutputFeature.RESPIRATION_MOVINGLIST,
    OutputFeature.RESPIRATION_DETECTIONLIST,
    OutputFeature.RESPIRATION_NORMALIZEDMOVEMENTLIST,
)
_NOISE_MAPS = (OutputFeature.NOISEMAP_FLOAT, OutputFeature.NOISEMAP_BYTE)
# Ticks and the matrices' periods repeat after it, so leaving out multiples shifts nothing.
_CYCLE = SLOW.frames
_CYCLES_KEPT = 2


def baseband(
    feature: int,
    sweep: ProfileSweep,
    iq: NDArray[np.complex128],
    *,
    counter: int,
) -> m.BasebandIq | m.BasebandAp:
    """Return a frame as I and Q, or as amplitude and phase [rad, -pi ... pi]."""
    header: dict[str, Any] = {
        "counter": counter & 0xFFFFFFFF,
        "num_bins": sweep.n_bins,
        "bin_length_m": x4.BASEBAND_BIN_M,
        "sampling_frequency_hz": BASEBAND_SAMPLING_HZ,
        "carrier_frequency_hz": sweep.carrier_hz,
        "range_offset_m": float(sweep.range_m[0]),
    }
    if feature == OutputFeature.BASEBAND_IQ:
        return m.BasebandIq(**header, i=iq.real.astype(np.float32), q=iq.imag.astype(np.float32))
    return m.BasebandAp(
        **header,
        amplitude=np.hypot(iq.real, iq.imag).astype(np.float32),
        phase=np.arctan2(iq.imag, iq.real).astype(np.float32),
    )


def presence_single(counter: int, presence: ZoneState, sensitivity: int) -> m.PresenceSingle:
    """Return the nearest thing to one person: the first detection; quality 0 without presence."""
    strongest = presence.detections[0] if presence.detections else None
    quality = 0 if strongest is None else signal_quality(strongest, sensitivity)
    return m.PresenceSingle(
        counter=counter & 0xFFFFFFFF,
        state=presence.state,
        distance_m=0.0 if strongest is None else strongest.distance_m,
        direction=PresenceDirection.STILL if strongest is None else strongest.direction,
        signal_quality=quality,
    )


def moving_list(counter: int, presence: ZoneState) -> m.PresenceMovingList:
    nothing = (0.0,) * len(presence.detections)
    return m.PresenceMovingList(
        counter=counter & 0xFFFFFFFF,
        state=presence.state,
        movement_slow=presence.movement_slow,
        movement_fast=presence.movement_fast,
        detection_distance_m=tuple(found.distance_m for found in presence.detections),
        detection_rcs=nothing,
        detection_velocity=nothing,
    )


def matrix_reports(
    feature: int,
    matrix: Matrix,
    sweep: ProfileSweep,
    power: NDArray[np.float64],
    *,
    counter: int,
    matrix_counter: int,
    splits: tuple[int, ...] = (),
) -> Iterator[m.Response]:
    """Yield the messages of one matrix, a range bin each, or one of its parts.

    Parameters
    ----------
    power
        Shape (n_bins, matrix.pulses), of pulse-Doppler or noise map; a snapshot.
    counter
        Of the newest frame in it.
    matrix_counter
        Matrices of this kind since the profile started.
    splits
        Indices of frequencies at which another message begins.
    """
    message = MATRIX_REPORTS[feature]
    levels = None
    if feature in _BYTES:
        decibels = 10 * np.log10(np.maximum(power, np.finfo(np.float64).tiny))
        steps = np.rint((decibels - BYTE_START_DB) / BYTE_STEP_DB)
        levels = np.clip(steps, 0, 255).astype(np.uint8)
    parts = list(pairwise((0, *splits, matrix.pulses)))
    for (index, range_m), (first, end) in product(enumerate(sweep.range_m.tolist()), parts):
        content = (
            {"power": power[index, first:end].astype(np.float32)}
            if levels is None
            else {
                "levels": levels[index, first:end].tobytes(),
                "byte_step_start_db": BYTE_START_DB,
                "byte_step_size_db": BYTE_STEP_DB,
            }
        )
        yield message(
            counter=counter & 0xFFFFFFFF,
            matrix_counter=matrix_counter & 0xFFFFFFFF,
            range_idx=index,
            range_bins=sweep.n_bins,
            frequency_count=end - first,
            pulsedoppler_instance=int(matrix.instance),
            fps=FRAME_RATE_HZ,
            fps_decimated=matrix.rate_hz,
            frequency_start_hz=matrix.start_hz + first * matrix.step_hz,
            frequency_step_hz=matrix.step_hz,
            range_m=range_m,
            **content,
        )


class ProfileRun:
    """A profile from RUN to STOP, or from one pause to the next.

    ``zero_ns`` is the device time of scene time 0, ``first_index`` that of the first frame in scene
    time, ``first_counter`` what the chip calls it.
    """

    def __init__(
        self,
        module: Module,
        sweep: ProfileSweep,
        noise_map: NoiseMap,
        *,
        first_index: int,
        first_counter: int,
        zero_ns: int,
        clock: ModuleClock,
    ) -> None:
        self.processing = PresenceProcessing(sweep, noise_map)
        self._module = module
        self._sweep = sweep
        self._first_index = first_index
        self._first_counter = first_counter
        self._zero_ns = zero_ns
        self._clock = clock
        self._taken = 0  # frames so far
        self._muted_before_ns = zero_ns
        self._ready: deque[Response] = deque()
        self._spread: dict[tuple[int, Matrix], deque[Response]] = {}

    def next_due_ns(self) -> int | None:
        """Return when the next step is due: a message that is ready, or a frame."""
        if self._ready:
            return self._due_ns(self._taken - 1)
        return None if self.silent else self._due_ns(self._taken)

    @property
    def next_index(self) -> int:
        return self._first_index + self._taken

    @property
    def next_counter(self) -> int:
        return self._first_counter + self._taken

    @property
    def silent(self) -> bool:
        """Whether all outputs are off."""
        matrices = any(map(self._instances, MATRIX_REPORTS))
        return not (matrices or any(map(self._on, (*_BASEBAND, *self._reports))))

    @property
    def _reports(self) -> tuple[OutputFeature, ...]:
        """What the loaded profile says once a tick, if it is on."""
        breathing = self._module.modes.profile_id in RESPIRATION_PROFILES
        return _RESPIRATION if breathing else _PRESENCE

    def take(self) -> Response | None:
        """Take one step: return a message that is ready, or go through one frame first."""
        if not self._ready:
            self._skip_far_behind()
            muted = self._due_ns(self._taken) < self._muted_before_ns
            self._frame()
            if muted:
                self._ready.clear()
        return self._ready.popleft() if self._ready else None

    def mute_before(self, time_ns: int) -> None:
        """Send nothing of frames that were due before a time."""
        self._muted_before_ns = max(time_ns, self._muted_before_ns)
        if self._ready and self._due_ns(self._taken - 1) < time_ns:
            self._ready.clear()

    def _due_ns(self, index: int) -> int:
        nominal_ns = self._sweep.timeline.scene_time_ns(self._first_index + index)
        return self._zero_ns + self._clock.scene_time_ns(nominal_ns)

    def _on(self, feature: int) -> int:
        return self._module.profile.outputs.get(feature, 0)

    def _instances(self, feature: int) -> list[Matrix]:
        control = MatrixControl(self._on(feature))
        wanted = (bool(control & MatrixControl.SLOW), control.fast)
        return [matrix for matrix in MATRICES if wanted[matrix.instance]]

    def _frame(self) -> None:
        counter = self._first_counter + self._taken
        iq = self._sweep.frame(self._first_index + self._taken)
        self.processing.add(iq)
        self._taken += 1
        for feature in filter(self._on, _BASEBAND):
            self._ready.append(baseband(feature, self._sweep, iq, counter=counter))
        if self._taken % FRAMES_PER_TICK == 0:
            self._tick(counter)
        self._release()

    def _tick(self, counter: int) -> None:
        sensitivity = self._module.profile.sensitivity
        presence = self.processing.tick(sensitivity)
        for report in filter(self._on, self._reports):
            self._ready.append(self._report(report, counter & 0xFFFFFFFF, presence, sensitivity))
        for feature in MATRIX_REPORTS:
            for matrix in self._instances(feature):
                power = self._powers(feature).get(matrix.instance)
                if power is not None and self._taken % matrix.period == 0:
                    self._spread[feature, matrix] = deque(
                        matrix_reports(
                            feature,
                            matrix,
                            self._sweep,
                            power.copy(),
                            counter=counter,
                            matrix_counter=self._taken // matrix.period,
                            splits=(matrix.pulses // 2,) if self._halves else (),
                        )
                    )

    @property
    def _halves(self) -> bool:
        return self._module.options.matrix_messages == "halves"

    def _report(
        self, feature: OutputFeature, counter: int, presence: ZoneState, sensitivity: int
    ) -> Response:
        match feature:
            case OutputFeature.PRESENCE_SINGLE:
                return presence_single(counter, presence, sensitivity)
            case OutputFeature.PRESENCE_MOVINGLIST:
                return moving_list(counter, presence)
            case OutputFeature.RESPIRATION_MOVINGLIST:
                return respiration.moving_list(counter, presence)
            case OutputFeature.RESPIRATION_DETECTIONLIST:
                return respiration.detection_list(counter, presence)
            case OutputFeature.RESPIRATION_NORMALIZEDMOVEMENTLIST:
                return respiration.normalized_movement_list(counter, self.processing, self._sweep)
        return self._breathing(feature, counter, presence, sensitivity)

    def _breathing(
        self, feature: OutputFeature, counter: int, presence: ZoneState, sensitivity: int
    ) -> Response:
        now = respiration.respiration(presence, self.processing, self._sweep)
        match feature:
            case OutputFeature.SLEEP_STATUS:
                return respiration.sleep_status(counter, now, presence, sensitivity)
            case OutputFeature.VITAL_SIGNS:
                return respiration.vital_signs(counter, now, self.processing, self._sweep)
        return respiration.status(counter, now, sensitivity)

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
            share = -(-self._sweep.n_bins * (1 + self._halves) // matrix.period)
            for _ in range(min(share, len(waiting))):
                self._ready.append(waiting.popleft())

    def _skip_far_behind(self) -> None:
        """Leave out whole cycles of muted frames, but for the last that fill the matrices."""
        if not self.processing.noise_map.complete:
            return
        behind_ns = self._muted_before_ns - self._due_ns(self._taken)
        cycles = int(behind_ns * FRAME_RATE_HZ / NS_PER_S) // _CYCLE - _CYCLES_KEPT
        if cycles > 0:
            self._taken += cycles * _CYCLE
            self.processing.refill()
            self._spread.clear()


class ProfileStream(MessageStream):
    """Messages of a module in RUN; ``scene_time_zero_ns`` is the device time of power-up, too."""

    def __init__(
        self,
        module: Module,
        source: EchoSource,
        *,
        pace: Pace,
        clock: ModuleClock,
        scene_time_zero_ns: int = 0,
        largest_block: int = 8,
    ) -> None:
        self._module = module
        self._source = source
        self._pace = pace
        self._zero_ns = scene_time_zero_ns
        self._clock = clock
        self._largest_block = largest_block
        self._run: ProfileRun | None = None
        self._paused = False
        self._was_silent = False
        self._creating = False
        self.restarted(scene_time_zero_ns)

    @property
    def _running(self) -> ProfileRun | None:
        """The run whose messages go to the host."""
        return None if self._paused else self._run

    def next_due_ns(self) -> int | None:
        run = self._running
        return None if run is None else run.next_due_ns()

    def take(self) -> Response | None:
        run = self._running
        assert run is not None
        message = run.take()
        self._keep_created_map()
        return message

    def skip_due_before(self, time_ns: int) -> None:
        run = self._running
        if run is not None and self._pace is not Pace.ASAP:
            run.mute_before(time_ns)

    def command_done(self, command: Command[Response], now_ns: int) -> None:
        """Start, pause, resume or end with the mode; catch up when an output is switched on."""
        mode = self._module.modes.mode
        if mode is SensorMode.XTID_SM_RUN:
            self._go_on(now_ns)
        elif mode is SensorMode.XTID_SM_IDLE:
            self._paused = True
        else:
            self._run = None

    def restarted(self, ready_ns: int) -> None:
        """Begin anew at a time, if the module is in RUN then."""
        self._run = None
        if self._module.modes.mode is SensorMode.XTID_SM_RUN:
            self._start(ready_ns)

    def noise_map_files(self) -> tuple[bytes, bytes]:
        """Return what the slow and the fast noise map's files would hold now; empty without map."""
        current = self._current_map()
        return (b"", b"") if current is None else current.files()

    def _go_on(self, now_ns: int) -> None:
        run = self._run
        if run is None:
            self._start(now_ns)
            return
        if self._paused:
            self._start(now_ns, paused=run)
        elif self._was_silent:
            run.mute_before(now_ns)
        self._was_silent = run.silent

    def _start(self, now_ns: int, paused: ProfileRun | None = None) -> None:
        settings = self._module.profile
        sweep = ProfileSweep(
            self._source,
            zone_m=settings.zone_m,
            tx_center_frequency=settings.tx_center_frequency,
            largest_block=self._largest_block,
        )
        clock = self._clock
        if self._pace is Pace.ASAP:
            first_index = 0 if paused is None else paused.next_index
            zero_ns = now_ns - clock.scene_time_ns(sweep.timeline.scene_time_ns(first_index))
        else:
            zero_ns = self._zero_ns
            first_index = sweep.first_index_from(clock.nominal_ns(now_ns - zero_ns))
        self._run = ProfileRun(
            self._module,
            sweep,
            self._first_map(sweep) if paused is None else paused.processing.noise_map,
            first_index=first_index,
            first_counter=x4.FIRST_COUNTER if paused is None else paused.next_counter,
            zero_ns=zero_ns,
            clock=clock,
        )
        self._creating = not self._run.processing.noise_map.complete
        self._paused = False
        self._was_silent = self._run.silent

    def _first_map(self, sweep: ProfileSweep) -> NoiseMap:
        settings = self._module.profile
        control, band = settings.noise_map_control, settings.tx_center_frequency
        slow, fast = (self._module.files.get(key) or b"" for key in NOISE_MAPS)
        stored = StoredMap.of_files((slow, fast))
        usable = stored is not None and stored.fits(settings.zone_m, band, sweep.n_bins)
        if stored is not None and usable and not control & NoiseMapControl.IGNORE_STORED:
            return stored.noise_map
        if control & NoiseMapControl.NO_DEFAULT:
            return NoiseMap()
        return default_noise_map(sweep.n_bins, band)

    def _keep_created_map(self) -> None:
        """Store a map that has just been created, if stored maps are in use."""
        control = self._module.profile.noise_map_control
        wanted = control & NoiseMapControl.NO_DEFAULT and not (
            control & NoiseMapControl.IGNORE_STORED
        )
        current = self._current_map() if self._creating else None
        if current is None:
            return
        self._creating = False
        if wanted:
            with contextlib.suppress(Refusal):  # no room: the next start creates one again
                for key, data in zip(NOISE_MAPS, current.files(), strict=True):
                    self._module.files.replace(key, data)
            self._module.save()

    def _current_map(self) -> StoredMap | None:
        run = self._run
        if run is None or not run.processing.noise_map.complete:
            return None
        settings = self._module.profile
        return StoredMap(
            zone_m=settings.zone_m,
            tx_center_frequency=settings.tx_center_frequency,
            noise_map=run.processing.noise_map,
        )
