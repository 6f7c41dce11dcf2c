"""Light and what sRGB says of it (IEC 61966-2-1)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def linear_from_srgb(color: Floats) -> Floats:
    """Linear light in [0, 1] from sRGB in [0, 1]."""
    linear: Floats = np.where(
        color <= 0.04045, color / 12.92, ((np.maximum(color, 0.0) + 0.055) / 1.055) ** 2.4
    )
    return linear


def srgb_from_linear(linear: Floats) -> Floats:
    """The inverse of `linear_from_srgb`."""
    color: Floats = np.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0.0) ** (1 / 2.4) - 0.055
    )
    return color
