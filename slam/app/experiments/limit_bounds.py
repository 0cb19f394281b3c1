"""What no front end can do better: bounds in closed form.

Positions in bins, s the envelope's standard deviation in bins, sigma the noise per RF sample.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import ncx2

from slam.close_echoes import KnownPulse
from slam.pulse_model import PulseModel

Array = NDArray[np.float64]


def known_pulse(bin_length_m: float) -> KnownPulse:
    """Return the emulator's pulse, as the joint fit wants it."""
    pulse = PulseModel()
    return KnownPulse(
        envelope_sigma_bins=pulse.sigma_bins(bin_length_m),
        carrier_rad_per_bin=pulse.carrier_rad(bin_length_m),
    )


def pair_covariance(
    distance: Array, ratio: float, turn_rad: Array, *, snr: float, envelope_sigma: float
) -> Array:
    """Return the Cramer-Rao bound of the positions of two echoes, amplitudes and phases unknown.

    With d the distance, r = exp(-d**2 / (4 s**2)) the overlap of the pulses, a complex amplitude c
    per echo (that of its envelope on a common carrier) and sums over n taken as integrals over
    Gaussians, the Fisher matrix of the positions once both amplitudes are fitted is

        J_kl = E / sigma**2 Re(conj(c_k) c_l) (M_kl - m_k^T R^-1 m_l),   E = s sqrt(pi) / 2
        M_11 = M_22 = 1 / (2 s**2),   M_12 = r (1 / (2 s**2) - d**2 / (4 s**4))
        R = [[1, r], [r, 1]],   m_1 = (0, q),  m_2 = (-q, 0),   q = r d / (2 s**2)

    with m_k the correlations of the derivative of pulse k by its position with both pulses.

    Parameters
    ----------
    distance
        Shape (n,), > 0: from the first echo to the second.
    ratio
        Amplitude of the second over the first.
    turn_rad
        Shape (n,): phase between the two on a common carrier.
    snr
        Amplitude of the first over sigma.
    envelope_sigma
        s.

    Returns
    -------
    Shape (n, 2, 2), squared bins.
    """
    s = envelope_sigma
    d = np.asarray(distance, dtype=np.float64)
    r = np.exp(-((d / (2 * s)) ** 2))
    own = np.full_like(d, 1 / (2 * s**2))
    cross = r * (1 / (2 * s**2) - d**2 / (4 * s**4))
    q = r * d / (2 * s**2)
    left = 1 - r**2
    # derivative by u_1 correlates with pulse 2 by +q, derivative by u_2 with pulse 1 by -q
    own -= q**2 / left
    cross -= q**2 * r / left
    amplitude = snr**2 * s * np.sqrt(np.pi) / 2
    information = np.empty((*d.shape, 2, 2))
    information[..., 0, 0] = amplitude * own
    information[..., 1, 1] = amplitude * ratio**2 * own
    information[..., 0, 1] = amplitude * ratio * np.cos(turn_rad) * cross
    information[..., 1, 0] = information[..., 0, 1]
    covariance: Array = np.linalg.inv(information)
    return covariance


def detection_probability(snr: Array, threshold_sigmas: float, envelope_sigma: float) -> Array:
    """Return how often the matched filter's output at the echo exceeds a threshold: Marcum's Q.

    Parameters
    ----------
    snr
        Amplitude over sigma, any shape.
    threshold_sigmas
        In standard deviations of one quadrature of the filter's output.
    envelope_sigma
        s; the filter gains s sqrt(pi) / 2 in power.
    """
    noncentrality = np.asarray(snr) ** 2 * envelope_sigma * np.sqrt(np.pi) / 2
    probability: Array = ncx2.sf(threshold_sigmas**2, 2, noncentrality)
    return probability
