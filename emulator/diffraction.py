"""Edges of reflectors and of shadows: the Fresnel integral of a half-plane.

A wave that passes an edge by a detour of ``d`` (its way over the edge less its straight or
mirrored way) does so at ``v = sqrt(4 d / wavelength)`` Fresnel parameters from the edge: for a
wall at R with the edge h beside the foot that is ``sqrt(2) h / sqrt(wavelength R / 2)``, the
first Fresnel zone. What gets past the edge into its shadow is (Kirchhoff; Born and Wolf,
Principles of Optics, 8.7.3; ITU-R P.526, 4.1)

    E(v) = 1 / (1 - j) integral_v^inf exp(-j pi u**2 / 2) du,    E(-v) = 1 - E(v),  E(0) = 1/2.

With ``E(v) = Q(v) exp(-j pi v**2 / 2)`` and the exponential written as a delay, Q is the wave
that comes from the edge itself: 1/2 at the boundary, 1 / (sqrt(2) pi v) far from it. All is taken
at the carrier: over the pulse's bandwidth, v changes by a tenth.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import fresnel

__all__ = ["edge_wave", "past_edge"]


def edge_wave(
    detour_m: NDArray[np.float64], wavelength_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return magnitude and phase [rad] of Q for detours >= 0 of any shape."""
    f, g = _auxiliary(_parameter(detour_m, wavelength_m))
    # Q = (g - j f) / (1 - j)
    return np.sqrt(0.5 * (f * f + g * g)), np.arctan2(g - f, g + f)


def past_edge(
    detour_m: NDArray[np.float64], beyond: NDArray[np.bool_], wavelength_m: float
) -> NDArray[np.complex128]:
    """Return E: what passes an edge, at the carrier, any shape.

    Parameters
    ----------
    detour_m
        How much longer the way over the edge is, >= 0.
    beyond
        Whether the straight way is on the open side of the edge, so that v is negative.
    wavelength_m
        Of the carrier.
    """
    v = _parameter(detour_m, wavelength_m)
    sine, cosine = fresnel(v)
    dark = ((0.5 - cosine) - 1j * (0.5 - sine)) / (1 - 1j)
    return np.where(beyond, 1 - dark, dark)


def _parameter(detour_m: NDArray[np.float64], wavelength_m: float) -> NDArray[np.float64]:
    v: NDArray[np.float64] = np.sqrt(np.maximum(detour_m, 0.0) * (4 / wavelength_m))
    return v


def _auxiliary(v: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the auxiliary functions f and g of the Fresnel integrals (DLMF 7.4)."""
    sine, cosine = fresnel(v)
    turn = 0.5 * np.pi * v * v
    s, c = 0.5 - sine, 0.5 - cosine
    cos, sin = np.cos(turn), np.sin(turn)
    return s * cos - c * sin, c * cos + s * sin
