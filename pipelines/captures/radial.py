"""Radial distortion that a program states the other way round, as the terms of our lens."""

from __future__ import annotations

import numpy as np

_SAMPLES = 200
_FARTHEST = 1e3
"""Focal lengths from the middle of a picture to its corner; that of a wide lens is 5 away."""


def inverse_terms(r: float, reach: float) -> tuple[float, float, float, float]:
    """k1 to k4, so that u (1 + k1 u^2 + ... + k4 u^8) = m wherever u = m (1 + r m^2).

    reach: the largest m, in focal lengths. Least squares of the error in m over all m up to it.
    Raises ValueError where the lens folds over before that, and for a reach that no lens has.
    """
    if not 0.0 < reach < _FARTHEST:
        raise ValueError(f"the picture reaches out to {reach:g} focal lengths")
    m = np.linspace(0.0, reach, _SAMPLES + 1)[1:]
    if not np.isfinite(r) or 1.0 + 3.0 * r * reach**2 <= 0.0:
        raise ValueError(f"the distortion r = {r:g} folds the picture over")
    u = m * (1.0 + r * m**2)
    powers = u[:, None] ** np.array([3, 5, 7, 9])
    scale = powers[-1]
    k = np.linalg.lstsq(powers / scale, m - u, rcond=None)[0] / scale
    return float(k[0]), float(k[1]), float(k[2]), float(k[3])
