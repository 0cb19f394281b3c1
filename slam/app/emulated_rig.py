"""The emulated robot as SLAM sees it: its rig, its radars on ports or in process, its truth."""

from __future__ import annotations

import math
from collections.abc import Callable
from importlib.metadata import version
from platform import python_version

import numpy as np
from numpy.typing import NDArray

from emulator.device import radar_device
from emulator.echo import echo_source
from emulator.identity import Identity
from emulator.loopback import LoopbackTransport
from emulator.pace import Pace
from emulator.scene import Scene, SceneError, UnknownSceneError, load_scene
from slam.app.emulator_process import EmulatedDevice
from slam.app.errors import AppError, UsageError
from slam.app.sources import RadarLink, RigSource
from slam.app.tum import NS_PER_S
from slam.config import SlamConfig
from slam.geometry import Mount, Rig
from slam.presets import ConfigError, load_preset
from slam.robust.parameters import WheelNoise
from xethru_protocol.driver import X4M300, ProtocolRecord, RawConfig
from xethru_protocol.errors import XeThruError
from xethru_protocol.x4 import real_frame_rate

FRAME_RATE_HZ = 5
RAW_CONFIG = RawConfig(frame_area_m=(0.2, 9.4))
"""The paper's set-up: 1431 range bins from 0.2 to 9.4 module metres."""

_VERSIONED = ("xethru-hil", "numpy", "scipy", "scikit-learn", "mcap", "rosbags", "rerun-sdk")

RecordObserver = Callable[[str, ProtocolRecord], None]
"""Gets a radar's name and what happened on its link."""


def scene_and_config(scene: str, preset: str) -> tuple[Scene, SlamConfig]:
    """Load a scene and the preset with the values for its environment.

    Raises
    ------
    UsageError
        One of the names is not known; one line with those that are.
    AppError
        The scene file cannot be read or is refused; one line with file, key and remedy.
    """
    try:
        loaded = load_scene(scene)
        return loaded, load_preset(preset, loaded.environment)
    except (UnknownSceneError, ConfigError) as error:
        raise UsageError(str(error)) from None
    except SceneError as error:
        raise AppError(str(error)) from None


def rig_of(scene: Scene) -> Rig:
    """Return the nominal mounts of a scene's radars: what a user would write in a rig file.

    The modules' own range errors stay unknown to SLAM.
    """
    return Rig(
        mounts=tuple(
            Mount(
                name=radar.name, x_m=radar.x_m, y_m=radar.y_m, yaw_rad=math.radians(radar.yaw_deg)
            )
            for radar in scene.radars
        )
    )


def wheels_of(scene: Scene) -> WheelNoise:
    """Return how the robot's odometry errs, from its specification in the scene file.

    Standard deviations, as a data sheet gives them; what was drawn for a run stays unknown.
    """
    spec = scene.odometry
    return WheelNoise(
        along_m_per_sqrt_m=spec.along_sigma_m_per_sqrt_m,
        across_m_per_sqrt_m=spec.across_sigma_m_per_sqrt_m,
        heading_rad_per_sqrt_m=spec.heading_sigma_rad_per_sqrt_m,
        heading_rad_per_rad=spec.heading_sigma_rad_per_rad,
        scale_sigma=spec.scale_sigma,
        turn_scale_sigma=spec.turn_scale_sigma,
        curvature_sigma_rad_per_m=spec.curvature_sigma_rad_per_m,
    )


def true_landmarks_m(scene: Scene) -> NDArray[np.float64]:
    """Return where the targets stand, shape (n, 2), world frame."""
    return np.array([(target.x_m, target.y_m) for target in scene.targets]).reshape(-1, 2)


def open_ports(
    devices: tuple[EmulatedDevice, ...], rig: Rig, observer: RecordObserver
) -> RigSource:
    """Open emulated modules through their serial ports, as hardware would be.

    Raises
    ------
    AppError
        A port is missing, in use, or what answers there is no such radar.
    """
    links: list[RadarLink] = []
    by_name = {device.name: device for device in devices}
    try:
        for mount in rig.mounts:
            device = by_name.get(mount.name)
            if device is None:
                raise AppError(f"radar {mount.name}: the emulator serves {sorted(by_name)}")
            try:
                driver = X4M300.open(device.path, observer=_named(observer, mount.name))
            except XeThruError as error:
                raise AppError(f"radar {mount.name} at {device.path}: {error}") from error
            links.append(
                RadarLink(
                    mount=mount,
                    port=device.path,
                    serial=device.serial,
                    driver=driver,
                    start_skew_ns=device.start_skew_ns,
                )
            )
    except BaseException:
        for link in links:
            link.driver.close()
        raise
    return RigSource(links)


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


def end_counter(duration_ns: int) -> int:
    """Return the first frame counter after the end of the scene."""
    period_ns = NS_PER_S / real_frame_rate(FRAME_RATE_HZ)
    return int(duration_ns / period_ns) + 1


def versions() -> dict[str, str]:
    """Return the versions a run depends on."""
    return {"python": python_version()} | {name: version(name) for name in _VERSIONED}


def _named(observer: RecordObserver, name: str) -> Callable[[ProtocolRecord], None]:
    return lambda record: observer(name, record)
