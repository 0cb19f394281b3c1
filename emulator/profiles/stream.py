"""The running profile as a stream of messages: it starts, pauses and ends with the mode.

The radar runs on the emulator's clock under both paces: a presence message a second is what makes
a profile useful to a host. Under `Pace.REALTIME` counter k is due at
``scene_time_zero_ns`` + the scene time at which the module's clock shows k's nominal time, and a
profile that starts begins with the first counter still ahead. Under `Pace.ASAP` the start of the
profile is scene time 0, so that what a host gets does not depend on when it starts it, and nothing
is dropped.

RUN after a pause fills the matrices anew (assumed) and keeps the noise map. A module that restarts
begins when it is ready.

Source: protocol reference 4.6, 8.1 to 8.3.
"""

from __future__ import annotations

import contextlib
from typing import Protocol

from emulator.echo_source import EchoSource
from emulator.filesystem import FileSystem
from emulator.modes import ModeMachine
from emulator.module_clock import ModuleClock
from emulator.options import DeviceOptions
from emulator.outbox import MessageStream
from emulator.pace import Pace
from emulator.profile_settings import ProfileSettings
from emulator.profiles.noise_map import (
    MapSource,
    NoiseMap,
    StoredMap,
    default_noise_map,
    map_source,
)
from emulator.profiles.presence import PresenceProcessing
from emulator.profiles.run import ProfileRun
from emulator.profiles.sweep import ProfileSweep
from emulator.refusal import Refusal
from xethru_protocol.codes import FileType, NoiseMapControl, SensorMode
from xethru_protocol.messages import Command, Response

__all__ = ["ProfileHost", "ProfileStream"]

_FILES = ((int(FileType.NOISEMAP_SLOW), 0), (int(FileType.NOISEMAP_FAST), 0))


class ProfileHost(Protocol):
    """What of a module its profile looks at."""

    @property
    def modes(self) -> ModeMachine:
        """The mode, and which profile is loaded."""
        ...

    @property
    def profile(self) -> ProfileSettings:
        """The settings of that profile."""
        ...

    @property
    def options(self) -> DeviceOptions:
        """How open questions are answered."""
        ...

    @property
    def files(self) -> FileSystem:
        """Where noise maps are kept over restarts."""
        ...

    def save(self) -> None:
        """Keep what the flash holds."""
        ...


class ProfileStream(MessageStream):
    """Messages of a module in RUN.

    Parameters
    ----------
    module
        Whose modes and settings to obey.
    source
        What its radar sees.
    pace
        Whether anything may be dropped.
    clock
        The module's own: its start skew and its rate error.
    scene_time_zero_ns
        Device time of scene time 0, and of power-up [ns].
    largest_block
        Most frames synthesised at once.
    """

    def __init__(
        self,
        module: ProfileHost,
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
    def running(self) -> ProfileRun | None:
        """The run whose messages go to the host."""
        return None if self._paused else self._run

    def next_due_ns(self) -> int | None:
        """Return when the next message is due; None while no profile runs, or says anything."""
        run = self.running
        return None if run is None else run.next_due_ns()

    def take(self) -> Response:
        """Return the next message; there must be one."""
        run = self.running
        assert run is not None
        message = run.take()
        self._keep_created_map()
        return message

    def skip_due_before(self, time_ns: int) -> int:
        """Give up every message due before a time; the radar sweeps on."""
        run = self.running
        if run is None or self._pace is Pace.ASAP:
            return 0
        skipped = run.skip_before(time_ns)
        self._keep_created_map()
        return skipped

    def command_done(self, command: Command[Response], now_ns: int) -> None:
        """Start, pause, resume or end as the mode says; catch up when an output is switched on."""
        mode = self._module.modes.mode
        if mode is SensorMode.XTID_SM_RUN:
            self._go_on(now_ns)
        elif mode is SensorMode.XTID_SM_IDLE:
            self._paused = True
        else:
            self._run = None
        del command  # the mode says all

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
            self._start(now_ns, run.processing.noise_map)
        elif self._was_silent:
            run.pass_before(now_ns)
            self._keep_created_map()
        self._was_silent = run.silent

    def _start(self, now_ns: int, noise_map: NoiseMap | None = None) -> None:
        settings = self._module.profile
        sweep = ProfileSweep(
            self._source,
            zone_m=settings.zone_m,
            tx_center_frequency=settings.tx_center_frequency,
            largest_block=self._largest_block,
        )
        clock = self._clock
        if self._pace is Pace.ASAP:
            zero_ns, first_counter = now_ns - clock.skew_ns, 0
        else:
            zero_ns = self._zero_ns
            first_counter = sweep.first_counter_from(clock.nominal_ns(now_ns - zero_ns))
        self._run = ProfileRun(
            sweep,
            PresenceProcessing(sweep, noise_map or self._first_map(sweep)),
            lambda: self._module.profile,
            first_counter=first_counter,
            zero_ns=zero_ns,
            clock=clock,
            sampling_hz=self._module.options.baseband_sampling_hz,
        )
        self._creating = not self._run.processing.noise_map.complete
        self._paused = False
        self._was_silent = self._run.silent

    def _first_map(self, sweep: ProfileSweep) -> NoiseMap:
        settings = self._module.profile
        stored = self._stored_map(sweep)
        match map_source(settings.noise_map_control, stored=stored is not None):
            case MapSource.STORED if stored is not None:
                return stored.noise_map
            case MapSource.DEFAULT:
                return default_noise_map(sweep.n_bins, settings.tx_center_frequency)
        return NoiseMap()

    def _stored_map(self, sweep: ProfileSweep) -> StoredMap | None:
        """Return the map in the module's files, if there is one of this zone and band."""
        slow, fast = (self._module.files.get(key) or b"" for key in _FILES)
        stored = StoredMap.of_files((slow, fast))
        zone_m = self._module.profile.zone_m
        if stored is None or not stored.fits(zone_m, sweep.tx_center_frequency, sweep.n_bins):
            return None
        return stored

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
                for key, data in zip(_FILES, current.files(), strict=True):
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
            noise_map=run.processing.noise_map.copy(),
        )
