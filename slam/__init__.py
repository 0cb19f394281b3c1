"""SLAM with UWB radars, as a library: `Slam` in a loop of your own.

::

    from slam import Slam, load_rig

    slam = Slam(load_rig("robot.toml"))
    for t_ns, pose, frames in robot:
        state = slam.step(t_ns, pose, frames=frames)
        print(state.pose, state.covariance, len(slam.landmarks))

Scans of modules and of recorded sessions are in `slam.live`. The names below are imported when they
are first used.
"""

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from slam.config import ConfigError as ConfigError
    from slam.config import SlamConfig as SlamConfig
    from slam.config import WheelNoise as WheelNoise
    from slam.config import load_preset as load_preset
    from slam.config import override as override
    from slam.frames import Detection as Detection
    from slam.frames import Detector as Detector
    from slam.frames import RadarFrame as RadarFrame
    from slam.frames import StepInputError as StepInputError
    from slam.geometry import Mount as Mount
    from slam.geometry import Rig as Rig
    from slam.library.evaluation import ate_rmse_m as ate_rmse_m
    from slam.library.rig_files import RigFile as RigFile
    from slam.library.rig_files import load_rig as load_rig
    from slam.library.saved_map import MapFile as MapFile
    from slam.library.saved_map import load_map as load_map
    from slam.library.slam import Landmarks as Landmarks
    from slam.library.slam import Slam as Slam
    from slam.library.slam import SlamState as SlamState
    from slam.results import MapChanges as MapChanges
    from slam.results import SmoothedRun as SmoothedRun

_NAMES = {
    "slam.config": ("ConfigError", "SlamConfig", "WheelNoise", "load_preset", "override"),
    "slam.library.evaluation": ("ate_rmse_m",),
    "slam.frames": ("Detection", "Detector", "RadarFrame", "StepInputError"),
    "slam.geometry": ("Mount", "Rig"),
    "slam.library.rig_files": ("RigFile", "load_rig"),
    "slam.library.saved_map": ("MapFile", "load_map"),
    "slam.library.slam": ("Landmarks", "Slam", "SlamState"),
    "slam.results": ("MapChanges", "SmoothedRun"),
}


def loader(names: Mapping[str, tuple[str, ...]]) -> Callable[[str], Any]:
    """Return the ``__getattr__`` of a package that imports names when they are first used."""
    homes = {name: home for home, of_home in names.items() for name in of_home}

    def load(name: str) -> Any:  # noqa: ANN401 - type checkers read the imports above
        if name not in homes:
            raise AttributeError(f"there is no name {name}; there are {', '.join(sorted(homes))}")
        return getattr(import_module(homes[name]), name)

    return load


__all__ = sorted(name for names in _NAMES.values() for name in names)
__getattr__ = loader(_NAMES)


def __dir__() -> list[str]:
    return __all__
