"""The radars of one test session: opened when first needed, reset to a known state per test."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import re
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from hil_tests.plugin.radar_specs import RadarArgument, RadarKind
from hil_tests.plugin.radar_targets import (
    RadarTarget,
    TargetError,
    WireTap,
    scene_radars,
    target_of,
)
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.operating_system import one_line
from xethru_protocol.transport import Transport
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import POWER_UP_BAUD, PongCode, SensorMode, X4Setting
from xethru_protocol.wire.errors import (
    DeviceError,
    Disconnected,
    PortUnavailable,
    ResponseTimeout,
    XeThruError,
)

_ALL_USERS = 0o666
_LONGEST_NAME = 200  # file systems take 255


class PortBusyError(Exception):
    """Another test session uses the radar; the message names its process."""


class PortLock:
    """An exclusive lock on a radar, until released or until this process ends.

    The target is a port or another name of a radar, such as an address. Links are resolved, so
    ``/dev/serial/by-id/...`` and ``/dev/ttyACM0`` are the same radar. The lock file remains.
    Raises `PortBusyError` if another session has the lock.
    """

    def __init__(self, target: str) -> None:
        device = os.path.realpath(target) if target.startswith("/") else target
        folder = Path(tempfile.gettempdir()) / "xethru-hil-locks"
        with contextlib.suppress(FileExistsError):
            folder.mkdir()
        if folder.is_symlink() or not folder.is_dir():
            raise PortBusyError(f"{folder}: must be a folder, for locks; remove it")
        with contextlib.suppress(PermissionError):  # another user's
            # other users lock here, too, and remove no lock of others (the sticky bit)
            folder.chmod(0o1777)
        name = re.sub(r"[^0-9A-Za-z.]+", "_", device).strip("_")
        if len(name) > _LONGEST_NAME:
            name = hashlib.blake2b(device.encode(errors="surrogateescape")).hexdigest()
        path = folder / f"{name}.lock"
        self._descriptor = _open(path)
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            written = os.read(self._descriptor, 20).strip()
            owner = written.decode() if written.isdigit() else "unknown"
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
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


def _open(path: Path) -> int:
    """Return a descriptor of a lock file that every user may open.

    Links are refused: in a folder that every user may write, one could point to a private file.
    """
    flags = os.O_CLOEXEC | os.O_NOFOLLOW
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | flags, _ALL_USERS)
    except PermissionError:  # Linux may create nothing over another user's file in such a folder
        try:
            return os.open(path, os.O_RDWR | flags)
        except PermissionError:
            return os.open(path, os.O_RDONLY | flags)  # enough for flock
    with contextlib.suppress(OSError):
        os.fchmod(descriptor, _ALL_USERS)  # whatever the umask
    return descriptor


def matched(path: Path, drivers: Mapping[str, X4M300]) -> Mapping[str, X4M300]:
    """Return the drivers, named as the specs, under the names of a rig file.

    The test fails if they are not its modules.
    """
    from slam.app.rig.rig_files import load_rig
    from slam.live.errors import AppError

    try:
        wanted = {radar.serial: radar.name for radar in load_rig(path).radars}
    except AppError as error:
        pytest.fail(str(error), pytrace=False)
    there = {name: driver.info().serial_number or "unknown" for name, driver in drivers.items()}
    missing = {serial: name for serial, name in wanted.items() if serial not in there.values()}
    if missing:
        lost = ", ".join(f"{name} ({serial})" for serial, name in missing.items())
        others = ", ".join(f"{serial} at {name}" for name, serial in there.items())
        pytest.fail(f"{path}: missing {lost}; there are {others}", pytrace=False)
    foreign = [f"{serial} at {name}" for name, serial in there.items() if serial not in wanted]
    if foreign:
        pytest.fail(f"{path}: not of this rig: {', '.join(foreign)}", pytrace=False)
    return {wanted[serial]: drivers[name] for name, serial in there.items()}


_RESTART_LIMIT_NS = 10_000_000_000  # a restart takes 2 ... 9 s (Protocol reference 8.1)
_QUIET_S = 0.05
_LATE_READS = 10_000


class BrokenRadarError(Exception):
    """The radar did not answer in an earlier test; this test did not try again."""


class RadarUnderTest:
    """One radar of the session.

    Attributes
    ----------
    identity
        Order code, serial number and firmware; empty before it was first opened.
    broken
        Why later tests do not try it again; None: it works.
    tap, drivers
        What passed over its line in the running test, and the drivers that this test opened.
    """

    def __init__(self, place: RadarTarget) -> None:
        self.place = place
        with contextlib.ExitStack() as held:
            if self.place.lock_target is not None:
                held.callback(PortLock(self.place.lock_target).release)
            self.place.explore()
            self._lock = held.pop_all()
        self.identity = ""
        self.broken: str | None = None
        self.tap = WireTap()
        self.drivers: list[X4M300] = []
        self._line: Transport | None = None

    @property
    def spec(self) -> RadarArgument:
        return self.place.spec

    def begin_test(self) -> None:
        """Bring the radar to a known state: stopped, no profile loaded, nothing on the line.

        Raises `BrokenRadarError` if it failed to answer in an earlier test.
        """
        if self.broken is not None:
            raise BrokenRadarError(self.broken)
        self.place.begin_test()
        self.tap = WireTap(self.place.clock_ns)
        try:
            self._settle()
        except (XeThruError, TargetError) as error:
            self.broken = f"{self.spec.name} did not answer in an earlier test: {error}"
            raise

    def open(self, *, reconnect_s: float = 0.0) -> X4M300:
        """Return a driver of the radar; it is closed at the end of the test."""
        # the line that was settled: an adapter might refuse a second client
        line, self._line = self._line or self.tap.around(self.place.open_line()), None
        radar = self.place.driver(line, self.tap, reconnect_s=reconnect_s)
        self.drivers.append(radar)
        return radar

    def take_line(self) -> Transport:
        """Return the open line, for tests without a driver; closed with the test."""
        if self._line is None:
            self._line = self.tap.around(self.place.open_line())
        return self._line

    def power_cycle(self, off_s: float = 1.0) -> X4M300:
        """Cut the power for ``off_s``; return a new driver once the module answers again.

        The drivers and lines of this test are closed before. The module is left as it starts: its
        profile may run. The test fails, with one line, if the power cannot be switched.
        """
        self.end_test()
        failure = ""
        try:
            self.place.cut_power(off_s)
            self._settle(stop=False)
        except TargetError as error:
            failure = str(error)
        except XeThruError as error:
            failure = f"does not answer after a power cut: {error}"
            self.broken = f"{self.spec.name} {failure}"
        if failure:  # not above, where pytest would show both errors
            pytest.fail(f"{self.spec.name}: {failure}", pytrace=False)
        return self.open()

    def end_test(self) -> None:
        while self.drivers:
            self.drivers.pop().close()
        if self._line is not None:
            self._line.close()
            self._line = None

    def close(self) -> None:
        self.place.close()
        self._lock.close()

    def _settle(self, *, stop: bool = True) -> None:
        deadline_ns = self.place.clock_ns() + _RESTART_LIMIT_NS
        while True:
            try:
                line = self.tap.around(self.place.open_line())
            except PortUnavailable:
                # an earlier test may have reset a module that was there
                if not self.identity or self.place.clock_ns() > deadline_ns:
                    raise
                self.place.sleep(_QUIET_S)
                continue
            try:
                radar = self.place.driver(line, self.tap)
                self._wait_until_ready(radar, line, deadline_ns)
                if stop:
                    _stop(radar)
                if not self.identity:
                    self._identify(radar)
            except Disconnected:  # an adapter may still hold the last client
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

    def _identify(self, radar: X4M300) -> None:
        info = radar.info()
        self.place.serial_number = info.serial_number or ""
        if info.order_code is None:  # base firmware, without profiles
            self.place.capabilities -= {"profiles", "presence"}
        elif info.order_code.startswith("X4M2"):
            self.place.capabilities -= {"presence"}
        known = (info.order_code or "bare", info.serial_number, info.firmware_id, info.version)
        self.identity = one_line(" ".join(part for part in known if part))

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
        """Find a module that a test left at another baud rate and set it back; False if none."""
        stray = self.place.driver(line, self.tap)
        if stray.find_baud_rate() is None:
            return False
        with contextlib.suppress(ResponseTimeout):  # it may be starting: it is asked again
            stray.set_baud_rate(POWER_UP_BAUD)
            return True
        return False


class Bench:
    """All radars of the session, by name; ``reach`` returns the target of a spec."""

    def __init__(
        self,
        specs: Iterable[RadarArgument],
        reach: Callable[[RadarArgument], RadarTarget] = target_of,
    ) -> None:
        self.specs = {spec.name: spec for spec in specs}
        self._reach = reach
        self._radars: dict[str, RadarUnderTest] = {}
        self._failed: dict[str, str] = {}

    def radar(self, name: str, *, again: bool = False) -> RadarUnderTest:
        """Return a radar, opened on first use; `BrokenRadarError` if it could not be earlier.

        With ``again``, one that failed earlier is tried once more.
        """
        if again:
            self._failed.pop(name, None)
            if name in self._radars:
                self._radars[name].broken = None
        if name in self._failed:
            raise BrokenRadarError(self._failed[name])
        if name not in self._radars:
            try:
                self._radars[name] = RadarUnderTest(self._reach(self.specs[name]))
            except (TargetError, PortBusyError, XeThruError) as error:
                self._failed[name] = f"{name} could not be opened in an earlier test: {error}"
                raise
        return self._radars[name]

    def rig(self, names: Sequence[str]) -> tuple[str, ...]:
        """Return the names of a rig; one emulated radar stands for all of its scene."""
        if len(names) != 1 or self.specs[names[0]].kind is not RadarKind.EMULATED:
            return tuple(names)
        spec = self.specs[names[0]]
        if "radar" in spec.options:
            return tuple(names)
        _, *others = scene_radars(spec)  # the spec itself is the first
        for other in others:
            name = f"{spec.name}-{other}"
            self.specs.setdefault(
                name, replace(spec, options={**spec.options, "radar": other}, name=name)
            )
        return (spec.name, *(f"{spec.name}-{other}" for other in others))

    def close(self) -> None:
        with contextlib.ExitStack() as stack:
            for radar in self._radars.values():
                stack.callback(radar.close)
        self._radars.clear()


def _stop(radar: X4M300) -> None:
    """Stop frames and profile, and read what was on its way."""
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
