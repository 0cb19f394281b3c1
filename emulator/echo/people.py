"""People and things that swing, as a radar receives them, and the truth about people.

Where they are and how they move: `emulator.scene.people` and `emulator.scene.motion`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emulator.echo.paths import (
    RANGE_EXPONENT,
    Scatterers,
    Viewpoint,
    reflection_phase_rad,
    viewpoint,
)
from emulator.scene.motion import AMPLITUDE_OF_1_M2, MoverSpec, swings
from emulator.scene.people import (
    CHEST_SHARES,
    CROSS_SECTION_SHARES,
    PersonSpec,
    breathing_rate_per_min,
    chest_displacement_m,
    facing_cosines,
    mean_breathing_rate_per_min,
    moves,
    positions_m,
    present,
    share_seen,
    sleep_stages,
)
from emulator.scene.scene import Scene


def person_scatterer(
    person: PersonSpec, t_ns: NDArray[np.int64], view: Viewpoint, seed: int = 0
) -> Scatterers:
    """Return a person at scene times of shape (n_frames,), int64: k = 1."""
    position = positions_m(person, t_ns, seed)
    strength = np.where(present(person, t_ns), AMPLITUDE_OF_1_M2 * math.sqrt(person.rcs_m2), 0.0)
    swell_m = chest_displacement_m(person, t_ns, seed)
    way_m = np.concatenate([view.x_m, view.y_m], axis=1) - position
    cosines = facing_cosines(person, t_ns, way_m, seed)
    if cosines is not None:
        strength = strength * np.sqrt(share_seen(CROSS_SECTION_SHARES, cosines))
        swell_m = swell_m * share_seen(CHEST_SHARES, cosines)
    return Scatterers(
        x_m=position[:, :1],
        y_m=position[:, 1:],
        strength=strength[:, np.newaxis],
        exponent=np.array([RANGE_EXPONENT["point"]]),
        radius_m=np.array([0.0]),
        swell_m=swell_m[:, np.newaxis],
        phase_rad=np.array([reflection_phase_rad(person.name)]),
    )


def mover_scatterer(mover: MoverSpec, t_ns: NDArray[np.int64]) -> Scatterers:
    """Return a mover at scene times of shape (n_frames,), int64: k = 1."""
    position, factor = swings(mover, t_ns)
    return Scatterers(
        x_m=position[:, :1],
        y_m=position[:, 1:],
        strength=(mover.amplitude_1m * factor)[:, np.newaxis],
        exponent=np.array([RANGE_EXPONENT["point"]]),
        radius_m=np.array([0.0]),
        swell_m=np.array([0.0]),
        phase_rad=np.array([reflection_phase_rad(mover.name)]),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PersonTruth:
    """What is true of one person at n scene times, and of it before m radars.

    Attributes
    ----------
    present, moves
        Shape (n,), bool: whether it is in the scene; whether it walks, shifts or turns over.
    position_m
        Shape (n, 2), world frame.
    breaths_per_min, mean_breaths_per_min
        Shape (n,): now, and over the window that ends now; NaN where nobody breathes, or not
        during the whole window.
    chest_m
        Shape (n,): how far the chest is out.
    sleep_stage
        Shape (n,): `emulator.scene.people.SleepDepth`.
    distance_m
        Shape (n, m): from the radar to the person, true metres, without the chest's displacement.
    towards_m
        Shape (n, m): the chest's displacement that the radar sees; the echo comes from
        ``distance_m - towards_m``.
    """

    name: str
    t_ns: NDArray[np.int64]
    present: NDArray[np.bool_]
    moves: NDArray[np.bool_]
    position_m: NDArray[np.float64]
    breaths_per_min: NDArray[np.float64]
    mean_breaths_per_min: NDArray[np.float64]
    chest_m: NDArray[np.float64]
    sleep_stage: NDArray[np.int64]
    distance_m: NDArray[np.float64]
    towards_m: NDArray[np.float64]


def people_truth(
    scene: Scene, t_ns: NDArray[np.int64], *, seed: int = 0, window_s: float = 60.0
) -> tuple[PersonTruth, ...]:
    """Return the truth about all people of a scene at scene times of shape (n,), int64.

    Radars are those of the scene, in its order; ``window_s`` is that of the mean rate.
    """
    poses = scene.trajectory().poses(t_ns)
    views = [viewpoint(radar, poses) for radar in scene.radars]
    found = []
    for person in scene.people:
        seen = [person_scatterer(person, t_ns, view, seed) for view in views]
        found.append(
            PersonTruth(
                name=person.name,
                t_ns=t_ns,
                present=present(person, t_ns),
                moves=moves(person, t_ns, seed),
                position_m=positions_m(person, t_ns, seed),
                breaths_per_min=breathing_rate_per_min(person, t_ns, seed),
                mean_breaths_per_min=mean_breathing_rate_per_min(person, t_ns, window_s, seed),
                chest_m=chest_displacement_m(person, t_ns, seed),
                sleep_stage=sleep_stages(person, t_ns),
                distance_m=np.concatenate(
                    [
                        view.towards(one.x_m, one.y_m)[0]
                        for view, one in zip(views, seen, strict=True)
                    ],
                    axis=1,
                ),
                towards_m=np.concatenate([one.swell_m for one in seen], axis=1),
            )
        )
    return tuple(found)
