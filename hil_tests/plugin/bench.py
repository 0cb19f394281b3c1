"""The radars of one test session: opened when first needed, brought to a known state per test."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Sequence
from dataclasses import replace

from hil_tests.plugin.locks import PortBusyError, PortLock
from hil_tests.plugin.places import Place, PlaceError, place_of, scene_radars
from hil_tests.plugin.specs import Kind, RadarSpec
from hil_tests.plugin.tap import WireTap
from xethru_protocol import messages as m
from xethru_protocol.codes import PongCode, SensorMode, X4Setting
from xethru_protocol.core import POWER_UP_BAUD
from xethru_protocol.driver import X4M300
from xethru_protocol.errors import (
    DeviceError,
    Disconnected,
    PortUnavailable,
    ResponseTimeout,
    XeThruError,
)
from xethru_protocol.procedures import BAUD_RATES
from xethru_protocol.transport import Transport, set_rate

__all__ = ["Bench", "BrokenRadarError", "RadarAtPlace"]

_PATIENCE_NS = 10_000_000_000  # a restart takes 2 ... 9 s (Protocol reference 8.1)
_QUIET_S = 0.05
_LATE_READS = 10_000


class BrokenRadarError(Exception):
    """A radar that did not answer, in an earlier test: this one has not even tried."""


class RadarAtPlace:
    """One radar of the session.

    Attributes
    ----------
    place
        Where it is.
    identity
        What it says of itself; empty before it was first opened.
    broken
        Why nothing more is tried with it; None: it works.
    tap
        What passed over its line in the running test.
    drivers
        Those that the running test opened.
    """

    def __init__(self, spec: RadarSpec) -> None:
        place = place_of(spec)
        lock = place.lock_target
        self._lock = None if lock is None else PortLock(lock)
        try:
            place.explore()
        except BaseException:
            if self._lock is not None:
                self._lock.release()
            raise
        self.place: Place = place
        self.identity = ""
        self.broken: str | None = None
        self.tap = WireTap()
        self.drivers: list[X4M300] = []
        self._line: Transport | None = None

    @property
    def spec(self) -> RadarSpec:
        """What the user asked for."""
        return self.place.spec

    def begin_test(self) -> None:
        """Bring the radar to a known state: stopped, no profile loaded, nothing on the line.

        Raises
        ------
        BrokenRadarError
            If it failed here before.
        PortUnavailable, Disconnected, ResponseTimeout
            If it does not answer.
        """
        if self.broken is not None:
            raise BrokenRadarError(self.broken)
        self.place.begin_test()
        self.tap = WireTap(self.place.clock_ns)
        try:
            self._settle()
        except (XeThruError, PlaceError) as error:
            self.broken = f"{self.spec.name} did not answer in an earlier test: {error}"
            raise

    def open(self, *, reconnect_s: float = 0.0) -> X4M300:
        """Return a driver of the radar; it is closed at the end of the test."""
        # the line that was settled, or the adapter might take us for a second client
        line, self._line = self._line or self.tap.around(self.place.open_line()), None
        radar = self.place.driver(line, self.tap, reconnect_s=reconnect_s)
        self.drivers.append(radar)
        return radar

    def take_line(self) -> Transport:
        """Return the open line itself, for who speaks without a driver; closed with the test."""
        if self._line is None:
            self._line = self.tap.around(self.place.open_line())
        return self._line

    def end_test(self) -> None:
        """Close what the test opened."""
        while self.drivers:
            self.drivers.pop().close()
        if self._line is not None:
            self._line.close()
            self._line = None

    def close(self) -> None:
        """Release the radar."""
        self.place.close()
        if self._lock is not None:
            self._lock.release()

    def _settle(self) -> None:
        deadline_ns = self.place.clock_ns() + _PATIENCE_NS
        while True:
            try:
                line = self.tap.around(self.place.open_line())
            except PortUnavailable:
                # of a module that was there, it may come back: an earlier test may have reset it
                if not self.identity or self.place.clock_ns() > deadline_ns:
                    raise
                self.place.sleep(_QUIET_S)
                continue
            try:
                radar = self.place.driver(line, self.tap)
                self._wait_until_ready(radar, line, deadline_ns)
                _stop(radar)
                if not self.identity:
                    self._ask_who_it_is(radar)
            except Disconnected:  # an adapter that has not noticed yet that the last client left
                line.close()
                if self.place.clock_ns() > deadline_ns:
                    raise
                self.place.sleep(_QUIET_S)
            except BaseException:
                line.close()
                raise
            else:
                self._line = line
                return

    def _ask_who_it_is(self, radar: X4M300) -> None:
        info = radar.info()
        if info.order_code is None:  # the base firmware knows no product, and has no profiles
            self.place.capabilities -= {"profiles"}
        said = (info.order_code or "bare", info.serial_number, info.firmware_id, info.version)
        self.identity = " ".join(part for part in said if part)

    def _wait_until_ready(self, radar: X4M300, line: Transport, deadline_ns: int) -> None:
        while True:
            try:
                if radar.ping(1.0) is not PongCode.XTS_SPRP_NOTREADY:
                    return
            except ResponseTimeout:
                if self.place.clock_ns() > deadline_ns:
                    raise
                if "uart" in self.place.capabilities and self._found_at_another_rate(line):
                    continue
            self.place.sleep(_QUIET_S)

    def _found_at_another_rate(self, line: Transport) -> bool:
        """Whether the module was at another baud rate, where a test left it; it is back now."""
        for baudrate in reversed(BAUD_RATES):
            set_rate(line, baudrate)
            stray = self.place.driver(line, self.tap)  # that what came at a wrong rate is forgotten
            with contextlib.suppress(ResponseTimeout):
                stray.ping(0.3)
                stray.set_baud_rate(POWER_UP_BAUD)
                return True
        set_rate(line, POWER_UP_BAUD)
        return False


class Bench:
    """All radars of the session, by name."""

    def __init__(self, specs: Iterable[RadarSpec]) -> None:
        self.specs = {spec.name: spec for spec in specs}
        self._radars: dict[str, RadarAtPlace] = {}
        self._failed: dict[str, str] = {}

    def radar(self, name: str) -> RadarAtPlace:
        """Return a radar, made when first asked for.

        Raises
        ------
        PlaceError, PortBusyError, PortUnavailable
            If it cannot be had.
        BrokenRadarError
            If it could not be had before.
        """
        if name in self._failed:
            raise BrokenRadarError(self._failed[name])
        if name not in self._radars:
            try:
                self._radars[name] = RadarAtPlace(self.specs[name])
            except (PlaceError, PortBusyError, XeThruError) as error:
                self._failed[name] = f"{name} could not be opened in an earlier test: {error}"
                raise
        return self._radars[name]

    def rig(self, names: Sequence[str]) -> tuple[str, ...]:
        """Return the names of a rig; one emulated radar stands for all of its scene."""
        if len(names) != 1 or self.specs[names[0]].kind is not Kind.EMULATED:
            return tuple(names)
        spec = self.specs[names[0]]
        if "radar" in spec.options:
            return tuple(names)
        first, *others = scene_radars(spec)
        del first  # what the spec itself stands for
        for other in others:
            name = f"{spec.name}-{other}"
            self.specs.setdefault(
                name, replace(spec, options={**spec.options, "radar": other}, name=name)
            )
        return (spec.name, *(f"{spec.name}-{other}" for other in others))

    def close(self) -> None:
        """Release all radars."""
        with contextlib.ExitStack() as stack:
            for radar in self._radars.values():
                stack.callback(radar.close)
        self._radars.clear()


def _stop(radar: X4M300) -> None:
    """Stop frames and profile, and hear what was on its way."""
    for command in (
        m.X4DriverSet(setting=X4Setting.FPS, value=0.0),
        m.SetMode(mode=SensorMode.XTID_SM_STOP),
    ):
        with contextlib.suppress(DeviceError):  # bare XEP firmware has no modes
            radar.request(command, 10.0)
    before = -1
    for _ in range(_LATE_READS):
        if radar.statistics.bytes == before:
            return
        before = radar.statistics.bytes
        with contextlib.suppress(ResponseTimeout):
            radar.read_frame(_QUIET_S)
