"""The emulated robot as SLAM sees it: its rig, its radars on ports or in process, its truth."""

from __future__ import annotations

import contextlib
import json
import math
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from platform import python_version
from typing import IO, Self

import numpy as np
from numpy.typing import NDArray

from emulator import cli as emulator_cli
from emulator.chip import Pace
from emulator.echo.echo import echo_source
from emulator.loopback import LoopbackTransport
from emulator.module.memory import Identity
from emulator.scene.scene import Scene, SceneError, UnknownSceneError, load_scene
from emulator.x4m300 import radar_device
from slam.app.errors import EmulatorError, UsageError
from slam.app.rig.rig_files import rig_file_of
from slam.config import (
    UNUSED_PARTS,
    BackEnd,
    ConfigError,
    SlamConfig,
    WheelNoise,
    load_preset,
    override,
)
from slam.geometry import Rig, transform
from slam.live.errors import AppError
from slam.live.frame_sources import RadarLink, RecordObserver, RigSource, StreamBegins
from slam.live.odometry_track import NS_PER_S
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.operating_system import StopFlag, signal_at_parents_death
from xethru_protocol.validation import reason_of, shown
from xethru_protocol.wire.errors import XeThruError
from xethru_protocol.wire.x4 import real_frame_rate

READY_LIMIT_S = 30.0
_POLL_S = 0.2
END_LIMIT_S = 3.0


@dataclass(frozen=True, slots=True, kw_only=True)
class EmulatedDevice:
    """One emulated module, as the ready line names it; `start_skew_ns` is that of its samples."""

    name: str
    path: str
    serial: str
    start_skew_ns: int


class EmulatorProcess:
    """Runs `xethru-emulator serve` in its own process group while it is entered.

    The group keeps Ctrl-C for us: we stop reading first and end the emulator afterwards. It removes
    its links when it ends; if it was killed, we remove them. `scene` is its name or its file.
    """

    def __init__(self, scene: str, seed: int) -> None:
        self._scene, self._seed = scene, seed
        self._cleanup = contextlib.ExitStack()
        self.devices: tuple[EmulatedDevice, ...] = ()
        self.odometry_socket = ""
        self.control_socket = ""

    def __enter__(self) -> Self:
        with self._cleanup:
            self._errors: IO[bytes] = self._cleanup.enter_context(tempfile.TemporaryFile())
            # -P: a folder "emulator" where the user happens to stand must not come first
            command = [sys.executable, "-P", "-m", "emulator.cli", "serve", self._scene]
            command += ["--pace", "asap", "--seed", str(self._seed)]
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=self._errors,
                process_group=0,
                preexec_fn=signal_at_parents_death(signal.SIGTERM),
            )
            self._cleanup.callback(self._end)
            self._cleanup = self._cleanup.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def end(self) -> None:
        """End the process, by force if it does not listen, and remove its links; only once."""
        self._cleanup.close()

    def ended(self) -> str | None:
        """Return how the process ended; None if it runs."""
        try:
            code = self._process.wait(timeout=_POLL_S)
        except subprocess.TimeoutExpired:
            return None
        how = f"by {signal.Signals(-code).name}" if code < 0 else f"with exit code {code}"
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").split("\n")
        messages = [line.strip() for line in lines if line.strip()]
        last = f": {messages[-1]}" if messages else ""
        return f"the emulator ended {how}{last}"

    def wait_until_ready(self, stop: StopFlag) -> None:
        """Read the ready line, which names ports and odometry socket.

        Raises EmulatorError if the process ended, or said nothing in time.
        """
        output = self._process.stdout
        assert output is not None
        line = b""
        give_up = time.monotonic() + READY_LIMIT_S
        while not line.endswith(b"\n"):
            stop.check()
            if time.monotonic() > give_up:
                raise EmulatorError(f"the emulator was not ready after {READY_LIMIT_S:g} s")
            if select.select([output], [], [], _POLL_S)[0]:
                part = os.read(output.fileno(), 65536)
                if not part:
                    raise EmulatorError(self.ended() or "the emulator closed its output")
                line += part
        try:
            ready = json.loads(line)
            keys = [field.name for field in fields(EmulatedDevice)]
            self.devices = tuple(
                EmulatedDevice(**{key: row[key] for key in keys}) for row in ready["devices"]
            )
            self.odometry_socket = ready["odometry"]
            self.control_socket = ready["control"]
        except (ValueError, KeyError, TypeError):
            raise EmulatorError(f"the emulator's ready line is unknown: {shown(line)}") from None

    def stream_begins_ns(self, radar: str) -> int:
        """Return where the newest stream of a radar begins in scene time [ns].

        Raises EmulatorError if the control socket does not say.
        """
        try:
            path = Path(self.control_socket)
            answer = json.loads(emulator_cli.ask(path, {"verb": "state", "radar": radar}))
            return int(answer["radars"][radar]["stream"]["scene_time_ns"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise EmulatorError(
                f"the emulator does not say when {radar} began: {reason_of(error)}"
            ) from None

    def _end(self) -> None:
        if self._process.stdout is not None:
            self._process.stdout.close()
        self._process.terminate()
        try:
            self._process.wait(timeout=END_LIMIT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        left = [Path(device.path) for device in self.devices]
        left += [Path(path) for path in (self.odometry_socket, self.control_socket) if path]
        for path in left:
            path.unlink(missing_ok=True)
        for folder in {path.parent for path in left}:
            with contextlib.suppress(OSError):  # gone already, or somebody else uses it
                folder.rmdir()


FRAME_RATE_HZ = 5
RAW_CONFIG = RawConfig(frame_area_m=(0.2, 9.4))
"""The paper's set-up: 1431 range bins from 0.2 to 9.4 module metres."""

_VERSIONED = ("xethru-hil", "numpy", "scipy", "scikit-learn", "mcap", "rosbags", "rerun-sdk")


def scene_and_config(scene: str, preset: str) -> tuple[Scene, SlamConfig]:
    """Load a scene and the preset with the values for its environment.

    Raises
    ------
    UsageError
        One of the names is not known; one line with those that are. Or the robot stands still.
    AppError
        The scene file cannot be read or is refused; one line with file, key and remedy.
    """
    try:
        loaded = load_scene(scene)
        config = load_preset(preset, loaded.environment)
    except (UnknownSceneError, ConfigError) as error:
        raise UsageError(str(error)) from None
    except SceneError as error:
        raise AppError(str(error)) from None
    if not loaded.trajectory().duration_ns:
        raise UsageError(
            f"{scene}: its robot stands still, so there is no way to map; take a scene in which it "
            "drives, such as lab"
        )
    return loaded, config


def with_settings(config: SlamConfig, settings: Iterable[tuple[str, str]]) -> SlamConfig:
    """Return a configuration with what `--set` names replaced: dotted keys, and values as text.

    Raises UsageError if a key is not known, or its value is refused.
    """
    try:
        return override(config, dict(settings))
    except ConfigError as error:
        raise UsageError(f"--set: {error}") from None


def with_settings_in_use(config: SlamConfig, settings: Sequence[tuple[str, str]]) -> SlamConfig:
    """Return what ``with_settings`` does, for a single run.

    Raises UsageError also if a key stands twice, or the back end does not use it.
    """
    replaced, keys = with_settings(config, settings), [key for key, _ in settings]
    for key in keys:
        if keys.count(key) > 1:
            raise UsageError(f"--set {key}: is given more than once; leave all but one out")
        if key.partition(".")[0] in UNUSED_PARTS[replaced.back_end]:
            (other,) = set(BackEnd) - {replaced.back_end}
            raise UsageError(
                f"--set {key}: back end {replaced.back_end} does not use it; leave it out, or take "
                f"--preset {other}"
            )
    return replaced


def rig_of(scene: Scene) -> Rig:
    """Return the nominal mounts of a scene's radars: what a user would write in a rig file.

    The modules' own range errors stay unknown to SLAM.
    """
    return rig_file_of(scene).rig


def wheels_of(scene: Scene) -> WheelNoise:
    """Return how the robot's odometry errs, from its specification in the scene file.

    Standard deviations, as a data sheet gives them; what was drawn for a run stays unknown.
    """
    return rig_file_of(scene).wheels.noise


def true_landmarks_m(scene: Scene) -> NDArray[np.float64]:
    """Return where the targets stand, shape (n, 2), world frame."""
    return np.array([(target.x_m, target.y_m) for target in scene.targets]).reshape(-1, 2)


def outlines_m(scene: Scene) -> tuple[NDArray[np.float64], ...]:
    """Return a line for each wall and a closed one for each box, shape (k, 2) [m], world frame."""
    walls = [np.array([wall.from_m, wall.to_m]) for wall in scene.walls]
    boxes = []
    for box in scene.objects:
        half = np.array([box.width_m, box.depth_m]) / 2
        corners = half * np.array([(1, 1), (-1, 1), (-1, -1), (1, -1), (1, 1)])
        boxes.append(transform(np.array([box.x_m, box.y_m, math.radians(box.yaw_deg)]), corners))
    return (*walls, *boxes)


def open_ports(
    devices: tuple[EmulatedDevice, ...],
    rig: Rig,
    observer: RecordObserver,
    begins: StreamBegins | None = None,
) -> RigSource:
    """Open emulated modules through their serial ports, as hardware would be.

    `begins` as in `RigSource`. Raises AppError if a port is missing or in use, or what answers
    there is no such radar.
    """
    links: list[RadarLink] = []
    by_name = {device.name: device for device in devices}
    with contextlib.ExitStack() as unless_it_works:
        for mount in rig.mounts:
            device = by_name.get(mount.name)
            if device is None:
                raise AppError(f"radar {mount.name}: the emulator serves {sorted(by_name)}")
            try:
                driver = X4M300.open(device.path, observer=partial(observer, mount.name))
            except XeThruError as error:
                raise AppError(f"radar {mount.name} at {device.path}: {error}") from error
            unless_it_works.callback(driver.close)
            links.append(
                RadarLink(
                    mount=mount,
                    port=device.path,
                    serial=device.serial,
                    driver=driver,
                    start_skew_ns=device.start_skew_ns,
                )
            )
        unless_it_works.pop_all()
    return RigSource(links, begins)


def open_loopback(scene: Scene, seed: int) -> RigSource:
    """Open the same emulated modules in this process: same driver, no ports, no waiting."""
    links = []
    for index, (radar, mount) in enumerate(zip(scene.radars, rig_of(scene).mounts, strict=True)):
        device = radar_device(
            Identity(serial=radar.serial),
            echo_source(scene, index, seed),
            Pace.ASAP,
            clock=radar.clock,
        )
        transport = LoopbackTransport(device, name=f"in process: {radar.name}")
        driver = X4M300(transport, clock=transport.clock_ns)
        links.append(
            RadarLink(
                mount=mount,
                port=transport.name,
                serial=radar.serial,
                driver=driver,
                start_skew_ns=radar.clock.skew_ns,
            )
        )
    return RigSource(links)


def end_tick(duration_ns: int, fps: float = FRAME_RATE_HZ) -> int:
    """Return the first tick after the end of the scene."""
    period_ns = NS_PER_S / real_frame_rate(fps)
    return int(duration_ns / period_ns) + 1


def versions() -> dict[str, str]:
    """Return the versions of Python and of what computes or records, where it is installed."""
    found = {"python": python_version()}
    for name in _VERSIONED:
        with contextlib.suppress(PackageNotFoundError):  # rerun-sdk is of an extra
            found[name] = version(name)
    return found
