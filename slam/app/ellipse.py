"""Covariances as figures: the 95 % contour of a planar Gaussian, rotated as it lies."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

# Chi-square quantile for two degrees of freedom, in closed form.
CHI2_95_TWO_DOF = -2.0 * math.log(1.0 - 0.95)


def ellipse_95(
    center_m: NDArray[np.float64], covariance_m2: NDArray[np.float64], n_points: int = 33
) -> NDArray[np.float64]:
    """Return the closed 95 % contour of a planar Gaussian.

    Parameters
    ----------
    center_m
        Shape (2,).
    covariance_m2
        Shape (2, 2). Its root comes from the eigenvectors, so a singular one gives a line.
    n_points
        Number of points, the first repeated at the end.

    Returns
    -------
    Shape (n_points, 2), same frame as the arguments.

    Examples
    --------
    >>> outline = ellipse_95(np.zeros(2), np.diag([4.0, 1.0]), n_points=5)
    >>> np.abs(outline).max(axis=0).round(3)
    array([4.895, 2.448])
    """
    variances, axes = np.linalg.eigh(covariance_m2)
    angle_rad = np.linspace(0.0, 2.0 * np.pi, n_points)
    circle = np.stack([np.cos(angle_rad), np.sin(angle_rad)], axis=-1)
    half_axes_m = np.sqrt(CHI2_95_TWO_DOF * np.maximum(variances, 0.0))
    return np.asarray(center_m + (circle * half_axes_m) @ axes.T)


def rotate_covariances(
    heading_rad: float, covariances_m2: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Turn covariances, shape (n, 2, 2), by a heading, as when changing the frame they are in."""
    cosine, sine = math.cos(heading_rad), math.sin(heading_rad)
    rotation = np.array([[cosine, -sine], [sine, cosine]])
    return np.asarray(rotation @ covariances_m2 @ rotation.T)
