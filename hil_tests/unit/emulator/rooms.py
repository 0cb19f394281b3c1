"""Small worlds for tests of walls: one radar, no leakage, and what it hears as plain arrays."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emulator.chip.chip import CaptureSettings
from emulator.echo.echo import ScenePaths
from emulator.scene.scene import (
    MIRROR_AMPLITUDE_1M,
    LeakageSpec,
    NoiseSpec,
    ObjectSpec,
    RadarSpec,
    Scene,
    TargetSpec,
    WallSpec,
)

C_MPS = 299_792_458.0
WAVELENGTH_M = C_MPS / 7.29e9
WAVENUMBER = 2 * np.pi / WAVELENGTH_M


def wall(
    from_m: tuple[float, float],
    to_m: tuple[float, float],
    *,
    reflection: float = 0.5,
    transmission: float = 0.0,
    name: str = "wall",
) -> WallSpec:
    return WallSpec(
        name=name,
        from_m=from_m,
        to_m=to_m,
        amplitude_1m=reflection * MIRROR_AMPLITUDE_1M,
        transmission=transmission,
    )


def box(x_m: float, y_m: float, width_m: float, depth_m: float, **changes: Any) -> ObjectSpec:  # noqa: ANN401 - any field
    values = {"name": "box", "x_m": x_m, "y_m": y_m, "width_m": width_m, "depth_m": depth_m}
    return ObjectSpec.model_validate(values | {"amplitude_1m": 0.5 * MIRROR_AMPLITUDE_1M} | changes)


def target(x_m: float, y_m: float, kind: str = "point", **changes: Any) -> TargetSpec:  # noqa: ANN401 - fields of the spec
    values = {"name": "target", "kind": kind, "x_m": x_m, "y_m": y_m, "amplitude_1m": 0.01}
    return TargetSpec.model_validate(values | changes)


def radar_at(x_m: float, y_m: float, yaw_deg: float, **changes: Any) -> RadarSpec:  # noqa: ANN401 - fields of the spec
    values = {"name": "only", "serial": "000000000007", "x_m": x_m, "y_m": y_m, "yaw_deg": yaw_deg}
    return RadarSpec.model_validate(values | changes)


def room(radar: RadarSpec, **parts: Any) -> Scene:  # noqa: ANN401 - any table
    """Return a scene without leakage and noise; the robot stands at the origin."""
    return Scene(
        name="room",
        environment="lab",
        description="",
        radars=(radar,),
        noise=NoiseSpec(rf_sigma=0.0),
        leakage=LeakageSpec(amplitude=0.0),
        **parts,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Heard:
    range_m: NDArray[np.float64]
    amplitude: NDArray[np.float64]
    phase_rad: NDArray[np.float64]

    def at(self, range_m: float, within_m: float = 1e-9) -> NDArray[np.float64]:
        return self.amplitude[np.abs(self.range_m - range_m) <= within_m]

    def field(self) -> complex:
        """Return the sum of all paths at the carrier."""
        waves = self.amplitude * np.exp(1j * (self.phase_rad - 2 * WAVENUMBER * self.range_m))
        return complex(waves.sum())


def heard(radar: RadarSpec, *, t_ns: int = 0, **parts: Any) -> Heard:  # noqa: ANN401 - fields of the spec
    paths = ScenePaths(room(radar, **parts), radar, 0).reflections(np.array([t_ns]), WAVELENGTH_M)
    there = np.flatnonzero(paths.amplitude[0] > 0)
    there = there[np.argsort(paths.range_m[0, there], kind="stable")]
    phase_rad = np.broadcast_to(paths.phase_rad, paths.range_m.shape)
    return Heard(
        range_m=paths.range_m[0, there],
        amplitude=paths.amplitude[0, there],
        phase_rad=phase_rad[0, there],
    )


PAPER = CaptureSettings(
    first_sample_m=0.19929,
    n_samples=1431,
    iterations=16,
    pulses_per_step=300,
    dac_min=949,
    dac_max=1100,
    dac_step=0,
    tx_power=2,
    tx_center_frequency=3,
)
"""The paper's raw capture."""
