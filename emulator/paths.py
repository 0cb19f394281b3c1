"""Every path on which a radar hears a scene: targets, people, leakage, walls, corners, ghosts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from emulator.ghosts import direct_share, ghost_reflections
from emulator.reflections import (
    Reflections,
    Viewpoint,
    direct_reflections,
    person_scatterer,
    reflection_phase_rad,
    target_scatterers,
    viewpoint,
)
from emulator.scene import Scene
from emulator.scene_tables import RadarSpec
from emulator.wall_echoes import corner_pairs, corner_reflections, face_reflections
from emulator.walls import faces_of

__all__ = ["ScenePaths"]


class ScenePaths:
    """The paths of one radar of a scene. What does not move is worked out once."""

    def __init__(self, scene: Scene, radar: RadarSpec) -> None:
        self._scene = scene
        self._radar = radar
        self._trajectory = scene.trajectory()
        self._targets = target_scatterers(scene.targets)
        self._leakage_phase_rad = np.array([reflection_phase_rad("leakage")])
        self._faces = faces_of(scene.walls, scene.objects)
        self._pairs = corner_pairs(self._faces)

    def reflections(self, t_ns: NDArray[np.int64], wavelength_m: float) -> Reflections:
        """Return all paths at true sample times of shape (n_frames,), int64.

        Amplitudes are at TX power 2 and before the receiver; a path that does not exist in a
        frame has amplitude 0.
        """
        view = viewpoint(self._radar, self._trajectory.poses(t_ns))
        scatterers = [
            self._targets,
            *(person_scatterer(person, t_ns) for person in self._scene.people),
        ]
        direct = [direct_reflections(each, view) for each in scatterers]
        if not len(self._faces):
            return _together([direct[0], self._leakage(len(t_ns)), *direct[1:]])

        behind: list[Reflections] = []
        for number, each in enumerate(scatterers):
            share = direct_share(self._faces, each, view, wavelength_m)
            direct[number] = replace(
                direct[number], amplitude=direct[number].amplitude * share * share
            )
            if self._scene.multipath.double_bounce:
                behind.append(ghost_reflections(self._faces, each, view, share, wavelength_m))
        return _together(
            [
                direct[0],
                self._leakage(len(t_ns)),
                *direct[1:],
                *self._of_walls(view, wavelength_m),
                *behind,
            ]
        )

    def _of_walls(self, view: Viewpoint, wavelength_m: float) -> list[Reflections]:
        found = [face_reflections(self._faces, view, wavelength_m)]
        if self._scene.multipath.corners:
            found.append(corner_reflections(self._faces, self._pairs, view, wavelength_m))
        return found

    def _leakage(self, n_frames: int) -> Reflections:
        leakage = self._scene.leakage
        return Reflections(
            range_m=np.full((n_frames, 1), leakage.range_m),
            amplitude=np.full((n_frames, 1), leakage.amplitude),
            phase_rad=self._leakage_phase_rad,
        )


def _together(terms: list[Reflections]) -> Reflections:
    phases = [term.phase_rad for term in terms]
    if any(phase.ndim > 1 for phase in phases):
        phases = [np.broadcast_to(term.phase_rad, term.range_m.shape) for term in terms]
    return Reflections(
        range_m=np.concatenate([term.range_m for term in terms], axis=1),
        amplitude=np.concatenate([term.amplitude for term in terms], axis=1),
        phase_rad=np.concatenate(phases, axis=-1),
    )
