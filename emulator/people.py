"""People in a scene: they walk along a path and breathe.

A person is a point reflector that moves: its echo falls with R**-2, and its range is the distance
to a point on its path less the chest's displacement ``breath_amplitude_m sin(2 pi f t)``, so the
carrier's phase follows every movement continuously. Limbs, the sway of walking, heartbeat,
shadowing and the body's extent are left out.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, StrictFloat, model_validator

__all__ = ["AMPLITUDE_OF_1_M2", "PersonSpec", "chest_displacement_m", "positions_m", "present"]

AMPLITUDE_OF_1_M2 = 0.06
"""Echo of 1 m**2 on boresight at 1 m, normalised units at TX power 2.

Assumed: a scene's rod of 0.015 is a cylinder of 1 cm radius seen over one Fresnel zone of 20 cm,
2 pi a h**2 / wavelength = 0.06 m**2, and amplitude goes with the root of the cross section."""


def _finite(value: object) -> object:
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError("must be a finite number")
    return value


_Metres = Annotated[StrictFloat, BeforeValidator(_finite), Field(ge=-1000, le=1000)]
_Seconds = Annotated[StrictFloat, BeforeValidator(_finite), Field(ge=0, le=86_400)]


class PersonSpec(BaseModel):
    """One person, in the world frame.

    It is in the scene from ``enters_s`` to ``leaves_s`` (for ever if that is left out), and walks
    from the moment it enters. ``walk`` says what happens at the last waypoint: ``once`` stays
    there, ``to_and_fro`` turns back, ``round`` goes on to the first one. One waypoint: it stands.
    ``rcs_m2`` is its radar cross section; breathing is ``breaths_per_min`` and the amplitude of
    the chest (half of its travel). The reflection phase is fixed by the name.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$", max_length=40)]
    waypoints_m: Annotated[
        tuple[tuple[_Metres, _Metres], ...], Field(min_length=1, max_length=1000)
    ]
    speed_mps: Annotated[StrictFloat, BeforeValidator(_finite), Field(ge=1e-3, le=10)] = 1.0
    walk: Literal["once", "to_and_fro", "round"] = "once"
    enters_s: _Seconds = 0.0
    leaves_s: _Seconds | None = None
    rcs_m2: Annotated[StrictFloat, BeforeValidator(_finite), Field(gt=0, le=100)] = 1.0
    breaths_per_min: Annotated[StrictFloat, BeforeValidator(_finite), Field(ge=0, le=60)] = 15.0
    breath_amplitude_m: Annotated[StrictFloat, BeforeValidator(_finite), Field(ge=0, le=0.05)] = (
        0.004
    )

    @model_validator(mode="after")
    def _leaves_after_it_enters(self) -> PersonSpec:
        if self.leaves_s is not None and self.leaves_s <= self.enters_s:
            raise ValueError("leaves_s: must be later than enters_s")
        return self


def positions_m(person: PersonSpec, t_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return where a person is, shape (n, 2) [m], world frame, at scene times of shape (n,)."""
    stops = list(person.waypoints_m)
    if person.walk == "round":
        stops.append(stops[0])
    elif person.walk == "to_and_fro":
        stops.extend(reversed(stops[:-1]))
    path = np.array(stops, dtype=np.float64)
    steps = np.diff(path, axis=0)
    ends_m = np.concatenate([[0.0], np.cumsum(np.sqrt(steps[:, 0] ** 2 + steps[:, 1] ** 2))])
    length_m = float(ends_m[-1])
    walked_m = np.maximum(t_ns / 1e9 - person.enters_s, 0.0) * person.speed_mps
    if person.walk != "once" and length_m > 0:
        walked_m = np.fmod(walked_m, length_m)
    at_x = np.interp(walked_m, ends_m, path[:, 0])
    at_y = np.interp(walked_m, ends_m, path[:, 1])
    return np.stack([at_x, at_y], axis=1)


def present(person: PersonSpec, t_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return whether a person is in the scene, shape (n,)."""
    t_s = t_ns / 1e9
    there: NDArray[np.bool_] = t_s >= person.enters_s
    return there if person.leaves_s is None else there & (t_s < person.leaves_s)


def chest_displacement_m(person: PersonSpec, t_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return how far the chest is out towards the radar, shape (n,) [m]."""
    turns = np.fmod(t_ns / 1e9 * (person.breaths_per_min / 60), 1.0)
    return np.asarray(person.breath_amplitude_m * np.sin(math.tau * turns), dtype=np.float64)
