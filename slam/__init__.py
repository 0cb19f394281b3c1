"""SLAM with UWB radars, as a library: `Slam` in a loop of your own.

Scans of modules and of recorded sessions are in `slam.live`.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from slam.config import ConfigError, SlamConfig, WheelNoise, load_preset, override
    from slam.evaluation import ate_rmse_m
    from slam.frames import Detection, Detector, RadarFrame, StepInputError
    from slam.geometry import Mount, Rig
    from slam.library.rig_files import RigFile, load_rig
    from slam.library.slam import Landmarks, Slam, SlamState
    from slam.results import SmoothedRun

_HOMES = {
    "ConfigError": "config",
    "Detection": "frames",
    "Detector": "frames",
    "Landmarks": "library.slam",
    "Mount": "geometry",
    "RadarFrame": "frames",
    "Rig": "geometry",
    "RigFile": "library.rig_files",
    "Slam": "library.slam",
    "SlamConfig": "config",
    "SlamState": "library.slam",
    "SmoothedRun": "results",
    "StepInputError": "frames",
    "WheelNoise": "config",
    "ate_rmse_m": "evaluation",
    "load_preset": "config",
    "load_rig": "library.rig_files",
    "override": "config",
}
"""Where each name is defined; a name is loaded when it is first used."""

__all__ = [
    "ConfigError",
    "Detection",
    "Detector",
    "Landmarks",
    "Mount",
    "RadarFrame",
    "Rig",
    "RigFile",
    "Slam",
    "SlamConfig",
    "SlamState",
    "SmoothedRun",
    "StepInputError",
    "WheelNoise",
    "ate_rmse_m",
    "load_preset",
    "load_rig",
    "override",
]


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = found = getattr(import_module(f"slam.{_HOMES[name]}"), name)
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
