"""Rig files: where each radar sits on a robot, who it is, and how the robot's odometry errs.

`uwb-slam calibrate --rig` writes them, and `load_rig` reads them. Lengths in true metres, body
frame x forward and y left, yaw in degrees counter-clockwise from forward; `range_offset_m` is what
the module measures too long, `phase_offset_deg` what it adds to an echo's carrier phase
(`Mount.phase_offset_rad`; no command estimates it), `gain_db` how much stronger its echoes are than
the mean of the rig. `port` is for a module that is not found by itself, such as one at
`tcp://HOST:PORT`.

A module whose pulse differs from that of the data sheet has a table `pulse` after its other keys:
`real` and `imaginary`, samples of the pulse's complex envelope, `step_m` of range apart, the middle
one where an echo's range is and about 1; `relative_error`, the norm of their error over their own.

    [radars.pulse]
    step_m = 0.0388
    relative_error = 0.02
    real = [0.0, 0.061, 0.332, 0.761, 1.0, 0.782, 0.351, 0.08, 0.003]
    imaginary = [0.0, 0.0, 0.01, 0.003, 0.0, -0.012, -0.01, 0.009, 0.0]
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, StrictFloat, model_validator

from slam.config import ConfigError, WheelNoise
from slam.geometry import Mount, ReceivedPulse, Rig
from xethru_protocol.validation import load_toml, matching

_Sigma = Annotated[StrictFloat, Field(ge=0, le=10, allow_inf_nan=False)]
_Sample = Annotated[StrictFloat, Field(ge=-2, le=2)]
_Envelope = Annotated[tuple[_Sample, ...], Field(min_length=5, max_length=201)]
_SerialNumber = Annotated[str, AfterValidator(matching("[0-9]{12}", "12 digits"))]
_Number = Annotated[StrictFloat, Field(ge=-1000, le=1000, allow_inf_nan=False)]
# Least height of the middle of a pulse, as a share of its largest sample
_LEAST_MIDDLE = 0.7


class _RigTable(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class RigPulse(_RigTable):
    """The pulse that a module receives, where it is not that of the data sheet; `ReceivedPulse`."""

    step_m: Annotated[StrictFloat, Field(ge=1e-3, le=0.05)]
    relative_error: Annotated[StrictFloat, Field(ge=0, lt=1)]
    real: _Envelope
    imaginary: _Envelope

    @model_validator(mode="after")
    def _is_a_pulse(self) -> Self:
        received = self.received
        heights = list(map(math.hypot, received.real, received.imaginary))
        middle = heights[len(heights) // 2]
        if middle < _LEAST_MIDDLE * max(*heights, 1.0):
            raise ValueError(
                "the middle sample must be about 1, where the pulse is high; "
                f"it is {middle:.3g} of at most {max(heights):.3g}"
            )
        return self

    @property
    def received(self) -> ReceivedPulse:
        return ReceivedPulse(**self.model_dump())


class RigRadar(_RigTable):
    """One radar: who it is, where it sits, what is known of its errors."""

    name: Annotated[str, Field(min_length=1, max_length=80)]
    serial: _SerialNumber
    x_m: _Number
    y_m: _Number
    yaw_deg: _Number
    range_offset_m: _Number = 0.0
    phase_offset_deg: _Number = 0.0
    gain_db: _Number = 0.0
    port: Annotated[str, Field(min_length=1, max_length=300)] | None = None
    pulse: RigPulse | None = None


_WHITE = {
    "along_sigma_m_per_sqrt_m": "along_m_per_sqrt_m",
    "across_sigma_m_per_sqrt_m": "across_m_per_sqrt_m",
    "heading_sigma_rad_per_sqrt_m": "heading_rad_per_sqrt_m",
    "heading_sigma_rad_per_rad": "heading_rad_per_rad",
}
"""What `WheelNoise` calls the white noise of a rig file; the other keys are the same."""


class RigWheels(_RigTable):
    """How the robot's odometry errs, from its data sheet or a test drive; see `WheelNoise`.

    The keys are those of a scene's table ``odometry``. White noise grows with the square root of
    the way and with the angle turned; the three other standard deviations are of errors that stay.
    """

    along_sigma_m_per_sqrt_m: _Sigma = WheelNoise().along_m_per_sqrt_m
    across_sigma_m_per_sqrt_m: _Sigma = WheelNoise().across_m_per_sqrt_m
    heading_sigma_rad_per_sqrt_m: _Sigma = WheelNoise().heading_rad_per_sqrt_m
    heading_sigma_rad_per_rad: _Sigma = WheelNoise().heading_rad_per_rad
    scale_sigma: _Sigma = WheelNoise().scale_sigma
    turn_scale_sigma: _Sigma = WheelNoise().turn_scale_sigma
    curvature_sigma_rad_per_m: _Sigma = WheelNoise().curvature_sigma_rad_per_m

    @classmethod
    def of(cls, noise: WheelNoise) -> Self:
        """Return the keys of a noise that a file can hold."""
        return cls(**{key: getattr(noise, _WHITE.get(key, key)) for key in cls.model_fields})

    @property
    def noise(self) -> WheelNoise:
        return WheelNoise(**{_WHITE.get(key, key): value for key, value in self})


class RigFile(_RigTable):
    """The whole file: one `[[radars]]` table per radar, and `[wheels]` where more is known."""

    radars: Annotated[tuple[RigRadar, ...], Field(min_length=1, max_length=64)]
    wheels: RigWheels = RigWheels()

    @property
    def rig(self) -> Rig:
        return Rig(
            mounts=tuple(
                Mount(
                    name=radar.name,
                    x_m=radar.x_m,
                    y_m=radar.y_m,
                    yaw_rad=math.radians(radar.yaw_deg),
                    range_offset_m=radar.range_offset_m,
                    phase_offset_rad=math.radians(radar.phase_offset_deg),
                    pulse=None if radar.pulse is None else radar.pulse.received,
                )
                for radar in self.radars
            )
        )


def load_rig(path: str | Path) -> RigFile:
    """Read a rig file.

    Raises
    ------
    ConfigError
        It cannot be read, or is not a rig file; one line with file, key and what is allowed.
    """
    found = load_toml(RigFile, Path(path), source=str(path), what="rig", error=ConfigError)
    for key in ("name", "serial"):
        values = [getattr(radar, key) for radar in found.radars]
        twice = sorted({value for value in values if values.count(value) > 1})
        if twice:
            raise ConfigError(f"{path}: radars.{key}: must be unique, {twice[0]} is used twice")
    return found
