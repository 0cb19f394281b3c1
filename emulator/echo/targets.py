"""Targets as they are beyond one steady echo each: bodies, scintillation, floor and ceiling.

Each is off unless the scene's tables ask for it; formulas and sources are on the model page,
``emulator.echo.echo``.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from emulator.echo.paths import (
    NEAREST_M,
    RANGE_EXPONENT,
    Reflections,
    Scatterers,
    Viewpoint,
    beam_gain,
    curved_spread,
    mirrored_ways,
    reflection_phase_rad,
    target_scatterers,
)
from emulator.echo.receiver import KnotGrid, SlowNoise
from emulator.scene.philox import Purpose
from emulator.scene.scene import HeightsSpec, ScintillationSpec, TargetSpec

_INSTANTS_PER_KNOT = 16
_NEPERS_PER_DB = math.log(10) / 20


class Targets:
    """A scene's targets as scatterers; ``steady`` are those of one echo, before scintillation."""

    def __init__(self, targets: tuple[TargetSpec, ...], seed: int) -> None:
        whole = target_scatterers(targets)
        is_body = np.array([bool(target.points) for target in targets], dtype=np.bool_)
        self.steady = replace(whole, strength=np.where(is_body, 0.0, whole.strength))
        # scatterers, and which target each of them belongs to
        self._groups = [(self.steady, np.arange(len(targets)))]
        if is_body.any():
            self._groups.append(_scattering_points(targets))
        self._fades = [
            (number, Scintillation(target.scintillation, seed=seed, target=number))
            for number, target in enumerate(targets)
            if target.scintillation.law != "none"
        ]

    def scatterers(self, t_ns: NDArray[np.int64]) -> list[Scatterers]:
        """Return them at scene times of shape (n_frames,), int64: the targets, then their points.

        The first has a row for each target, of strength 0 for one that has points.
        """
        if not self._fades:
            return [scatterers for scatterers, _ in self._groups]
        factor = np.ones((len(t_ns), len(self.steady.x_m)))
        for number, fade in self._fades:
            factor[:, number] = fade.factors(t_ns)
        return [
            replace(scatterers, strength=scatterers.strength * factor[:, target])
            for scatterers, target in self._groups
        ]


def _scattering_points(
    targets: tuple[TargetSpec, ...],
) -> tuple[Scatterers, NDArray[np.int64]]:
    """Return the points of all bodies, k of them, and which target each belongs to."""
    rows: list[tuple[float, ...]] = []
    for number, target in enumerate(targets):
        yaw_rad = math.radians(target.yaw_deg)
        cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)
        phase_rad = reflection_phase_rad(target.name)
        rows.extend(
            (
                number,
                target.x_m + cosine * point.x_m - sine * point.y_m,
                target.y_m + sine * point.x_m + cosine * point.y_m,
                target.amplitude_1m * point.share,
                RANGE_EXPONENT[target.kind],
                phase_rad + math.radians(point.phase_deg),
            )
            for point in target.points
        )
    table = np.array(rows).reshape(-1, 6).T
    nothing = np.zeros(len(rows))
    points = Scatterers(
        x_m=table[1],
        y_m=table[2],
        strength=table[3],
        exponent=table[4],
        radius_m=nothing,
        swell_m=nothing,
        phase_rad=table[5],
    )
    return points, table[0].astype(np.int64)


class Scintillation:
    """How the echo of one target fades, alike for all radars."""

    def __init__(self, spec: ScintillationSpec, *, seed: int, target: int) -> None:
        self._spec = spec
        self._noise = SlowNoise(
            (KnotGrid.falling_in(spec.correlation_s, sigma=1.0),),
            2,
            instants_per_knot=_INSTANTS_PER_KNOT,
            seed=seed,
            serial=target,
            purpose=Purpose.SCINTILLATION,
        )

    def factors(self, t_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return factors on the amplitude at scene times, shape (n_frames,)."""
        x, y = self._noise.values_at(t_ns).T
        factors: NDArray[np.float64]
        if self._spec.law == "lognormal":
            factors = np.exp(_NEPERS_PER_DB * self._spec.sigma_db * x)
        else:
            factors = np.sqrt(0.5 * (x * x + y * y))
        return factors


def mirrored_reflections(
    scatterers: Scatterers,
    view: Viewpoint,
    spec: HeightsSpec,
    share: NDArray[np.float64] | float,
) -> Reflections:
    """Return echoes of scatterers by way of floor and ceiling, shape (n_frames, m).

    m is k times the number of ways: each way has the k scatterers in their order.

    Parameters
    ----------
    share
        Shape (n_frames, k), or 1 without walls: the share of the amplitude that they let pass on
        the straight leg, one way.
    """
    axis_m, cos_angle = view.towards(scatterers.x_m, scatterers.y_m)
    surface_m = np.maximum(axis_m - scatterers.swell_m, NEAREST_M)
    mirrors = [
        (height, reflection)
        for height, reflection in (
            (spec.antenna_m, spec.floor_reflection),
            (spec.ceiling_m - spec.antenna_m, spec.ceiling_reflection),
        )
        if reflection > 0
    ]
    is_point = np.broadcast_to(scatterers.exponent == RANGE_EXPONENT["point"], cos_angle.shape)
    # legs out and back, strength, number of mirrors
    ways: list[tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], int]] = []
    for height, reflection in mirrors:
        slant_m = np.sqrt(surface_m**2 + height * height)
        spread = np.where(
            scatterers.radius_m > 0,
            curved_spread(surface_m, scatterers.radius_m) / slant_m,
            1 / (surface_m * np.sqrt(slant_m)),
        )
        outside = axis_m > scatterers.radius_m
        strength = ~is_point * outside * reflection * scatterers.strength * spread
        ways.append((slant_m, slant_m, strength, 1))
    legs = [(0.0, 1.0), *((2 * height, reflection) for height, reflection in mirrors)]
    for one, other in mirrored_ways(len(legs)):
        (rise_out, out), (rise_back, back) = legs[one], legs[other]
        out_m, back_m = (np.sqrt(surface_m**2 + rise * rise) for rise in (rise_out, rise_back))
        # out by one and back by the other, and the reverse: equally long, so they add
        both_ways = 1.0 if one == other else 2.0
        strength = both_ways * out * back * scatterers.strength / (out_m * back_m)
        ways.append((out_m, back_m, is_point * strength, (one > 0) + (other > 0)))

    range_m, amplitude, phase_rad = [], [], []
    for out_m, back_m, strength, n_mirrors in ways:
        cos_out, cos_back = (cos_angle * surface_m / leg_m for leg_m in (out_m, back_m))
        antenna_m = (view.antenna_m(cos_out) + view.antenna_m(cos_back)) / 2
        range_m.append((out_m + back_m) / 2 + antenna_m)
        both_legs = np.sqrt(beam_gain(cos_out) * beam_gain(cos_back))
        amplitude.append(strength * both_legs * (share * share))
        phase_rad.append(scatterers.phase_rad + math.pi * n_mirrors)
    return Reflections(
        range_m=np.concatenate(range_m, axis=1),
        amplitude=np.concatenate(amplitude, axis=1),
        phase_rad=np.concatenate(phase_rad),
    )
