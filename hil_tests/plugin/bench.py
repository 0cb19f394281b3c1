"""The radars of one test session: opened when first needed, brought to a known state per test."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import math
import os
import re
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from hil_tests.plugin.places import Place, PlaceError, WireTap, place_of, scene_radars
from hil_tests.plugin.specs import Kind, RadarSpec
from xethru_protocol.driver.link import BAUD_RATES, POWER_UP_BAUD
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.transport import Transport, set_rate
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import PongCode, SensorMode, X4Setting
from xethru_protocol.wire.errors import (
    DeviceError,
    Disconnected,
    PortUnavailable,
    ResponseTimeout,
    XeThruError,
)

_ANYBODY = 0o666
_LONGEST_NAME = 200  # file systems take 255


class PortBusyError(Exception):
    """Another test session has the radar; the message says which process."""


class PortLock:
    """The right to talk to a radar, until released or until this process ends.

    Keyed on the device behind links, so ``/dev/serial/by-id/...`` and ``/dev/ttyACM0`` are the same
    radar. The file stays behind; the lock does not.

    Parameters
    ----------
    target
        A path of a port, or any other name of a radar, such as an address.

    Raises
    ------
    PortBusyError
        If somebody else has it.
    OSError
        If the lock file cannot be opened, or is a link.
    """

    def __init__(self, target: str) -> None:
        device = os.path.realpath(target) if target.startswith("/") else target
        folder = Path(tempfile.gettempdir()) / "xethru-hil-locks"
        with contextlib.suppress(FileExistsError):
            folder.mkdir()
            folder.chmod(0o777)  # other users lock here, too
        name = re.sub(r"[^0-9A-Za-z.]+", "_", device).strip("_")
        if len(name) > _LONGEST_NAME:
            name = hashlib.blake2b(device.encode(errors="surrogateescape")).hexdigest()
        path = folder / f"{name}.lock"
        self._descriptor = _open(path)
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            owner = os.read(self._descriptor, 20).decode().strip() or "unknown"
            self.release()
            if owner == str(os.getpid()):
                raise PortBusyError(
                    f"{target} is in this session twice, under two names; name each radar once"
                ) from None
            raise PortBusyError(
                f"{target} is being tested by another session (process {owner}); wait for it, or "
                "end it"
            ) from None
        with contextlib.suppress(OSError):  # another user's file: locked all the same
            os.ftruncate(self._descriptor, 0)
            os.write(self._descriptor, f"{os.getpid()}\n".encode())

    def release(self) -> None:
        """Let others have it; calling it again does nothing."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


def _open(path: Path) -> int:
    """Return a descriptor of a lock file that anybody may open.

    Never of what a link leads to: where anybody may write, it could lead to a file of ours.
    """
    flags = os.O_CLOEXEC | os.O_NOFOLLOW
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | flags, _ANYBODY)
    except PermissionError:
        return os.open(path, os.O_RDONLY | flags)  # enough for flock
    with contextlib.suppress(OSError):
        os.fchmod(descriptor, _ANYBODY)  # whatever the umask
    return descriptor


RF_FRAME_BYTES = 5747  # 1431 bins (Protocol reference 9.5)
_SHARE = 0.8  # of a UART; the rest is for answers


def carried_rate_hz(wanted_hz: float, bytes_per_s: float) -> float:
    """Return the frame rate that a test asks for, or what a UART carries of 1431 bins, whole Hz.

    >>> carried_rate_hz(17.0, math.inf), carried_rate_hz(17.0, 11520.0)
    (17.0, 1.0)
    """
    if math.isinf(bytes_per_s):
        return wanted_hz
    return min(wanted_hz, float(max(math.floor(bytes_per_s * _SHARE / RF_FRAME_BYTES), 1)))


def matched(path: Path, drivers: Mapping[str, X4M300]) -> Mapping[str, X4M300]:
    """Return the drivers under the names of a rig file; the test fails if they are not its modules.

    Parameters
    ----------
    path
        Rig file of `uwb-slam calibrate --rig`: one ``[[radars]]`` table with name and serial each.
    drivers
        The radars there are, by the names of their specs.
    """
    from slam.app.errors import AppError
    from slam.app.rig.files import load_rig

    try:
        wanted = {radar.serial: radar.name for radar in load_rig(path).radars}
    except AppError as error:
        pytest.fail(str(error), pytrace=False)
    there = {name: driver.info().serial_number or "none told" for name, driver in drivers.items()}
    missing = {serial: name for serial, name in wanted.items() if serial not in there.values()}
    if missing:
        lost = ", ".join(f"{name} ({serial})" for serial, name in missing.items())
        others = ", ".join(f"{serial} at {name}" for name, serial in there.items())
        pytest.fail(f"{path}: missing {lost}; there are {others}", pytrace=False)
    strangers = [f"{serial} at {name}" for name, serial in there.items() if serial not in wanted]
    if strangers:
        pytest.fail(f"{path}: not of this rig: {', '.join(strangers)}", pytrace=False)
    return {wanted[serial]: drivers[name] for name, serial in there.items()}


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
