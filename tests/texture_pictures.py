"""Pictures as textures are: like a photo, smooth, with hard edges; and how far two are apart."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]


def photo(side: int, seed: int = 5) -> Bytes:
    """Noise at all sizes, the finer the less of it, mostly of grey as in photos."""
    rng = np.random.default_rng(seed)
    across, down = np.fft.rfftfreq(side), np.fft.fftfreq(side)[:, None]
    falling = 1.0 / np.maximum(np.hypot(across, down), 1.0 / side) ** 1.4
    planes = [
        np.fft.irfft2(np.fft.rfft2(rng.standard_normal((side, side))) * falling) for _ in range(4)
    ]
    grey, *own = [plane / plane.std() for plane in planes]
    return _bytes(np.stack([120.0 + 38.0 * grey + 14.0 * one for one in own], axis=2))


def gradients(side: int) -> Bytes:
    """Each channel goes from one end to the other in a direction of its own."""
    row, column = np.mgrid[0:side, 0:side] / (side - 1)
    return _bytes(255.0 * np.stack([row, column, 0.5 * (row + 1.0 - column)], axis=2))


def edges(side: int) -> Bytes:
    """Two colours, with borders at every angle."""
    row, column = np.mgrid[0:side, 0:side] - side / 2.0
    fan = (np.floor(np.arctan2(row, column) / np.pi * 9.0) % 2)[..., None]
    return _bytes(fan * [230.0, 60.0, 20.0] + (1.0 - fan) * [20.0, 90.0, 200.0])


def psnr(found: NDArray[np.integer], wanted: NDArray[np.integer]) -> float:
    """In dB, of 255."""
    error = np.square(found.astype(np.float64) - wanted).mean()
    return float(10.0 * np.log10(255.0**2 / max(error, 1e-9)))


def _bytes(values: NDArray[np.float64]) -> Bytes:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)
