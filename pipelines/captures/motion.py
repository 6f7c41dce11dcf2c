"""How fast the picture of a film moves, and how its exposure changes, frame by frame.

Measured between frames that follow each other closely, on thumbnails: the shift by which one fits
onto the other, found by phase correlation (Kuglin and Hines, "The phase correlation image alignment
method", 1975), and the ratio of brightness where they overlap after it. A camera that is turned
quickly shows as a speed whatever its shutter does; a change of exposure shows whatever comes into
view. Nothing is known of what the camera does along its gaze.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipelines.captures.video_frames import Frame

Floats = npt.NDArray[np.float32]

THUMBNAIL_PX = 96
"""Long side of the thumbnails: a shift is known to about half a percent of the picture."""
_MIN_PEAK = 0.15
"""Height of the correlation's peak below which two thumbnails show nothing in common. Unrelated
parts of a noisy wall reach 0.12, of a blurred pan by a third of the picture's side a frame 0.22."""
_MIN_OVERLAP = 0.3
_DARK = 4.0
"""Luma below which brightness has no ratio worth the name."""


@dataclass(frozen=True)
class Step:
    """From one frame to the next.

    speed: long sides of the picture per second; None where nothing in common is found.
    gain_ev: by how many stops the same things became brighter; None where that is not known.
    """

    speed: float | None
    gain_ev: float | None


class MotionMeter:
    """Compares each frame with the one before."""

    def __init__(self) -> None:
        self._before: Floats | None = None
        self._before_s = math.nan

    def take(self, frame: Frame) -> Step | None:
        """The step to this frame; None for the first, and where times are not known."""
        small, time_s = thumbnail(frame.luma), frame.time_s
        before, elapsed_s = self._before, time_s - self._before_s
        self._before, self._before_s = small, time_s
        if before is None or not elapsed_s > 0:
            return None
        found = shift_between(before, small)
        if found is None:
            return Step(None, None)
        shift = math.hypot(*found) / max(small.shape)
        return Step(shift / elapsed_s, gain_between(before, small, found))


def thumbnail(luma: npt.NDArray[np.uint8]) -> Floats:
    """luma [H, W] averaged to blocks, the long side THUMBNAIL_PX or the next that divides."""
    factor = max(1, round(max(luma.shape) / THUMBNAIL_PX))
    rows, columns = (size // factor for size in luma.shape)
    cropped = luma[: rows * factor, : columns * factor]
    blocks = cropped.reshape(rows, factor, columns, factor)
    small: Floats = blocks.mean(axis=(1, 3), dtype=np.float32)
    return small


def shift_between(before: Floats, after: Floats) -> tuple[float, float] | None:
    """(rows, columns) by which things moved, pixels; None where the two have nothing in common."""
    rows, columns = before.shape
    window = np.outer(np.hanning(rows), np.hanning(columns)).astype(np.float32)
    spectra = [np.fft.rfft2((one - one.mean()) * window) for one in (before, after)]
    cross = spectra[1] * np.conj(spectra[0])
    size = np.abs(cross)
    if size.max(initial=0.0) < 1e-6:
        return None
    white = cross / np.maximum(size, 1e-9 * size.max())
    correlation = np.fft.irfft2(white, s=before.shape).astype(np.float32)
    row, column = np.unravel_index(int(correlation.argmax()), correlation.shape)
    if correlation[row, column] < _MIN_PEAK:
        return None
    down, right = correlation[:, column], correlation[row, :]
    return _place(down, int(row)), _place(right, int(column))


def _place(line: Floats, peak: int) -> float:
    """Where a peak of a periodic line lies, between -half and half of its length, by the centre of
    gravity of the peak and its two neighbours."""
    length = len(line)
    around = np.array([max(float(line[(peak + i) % length]), 0.0) for i in (-1, 0, 1)])
    at = peak + float(around[2] - around[0]) / float(around.sum())
    return at if at <= length / 2 else at - length


def gain_between(before: Floats, after: Floats, shift: tuple[float, float]) -> float | None:
    """Stops by which what both show became brighter, the median; None where little is shared."""
    rows, columns = (round(value) for value in shift)
    old = before[_kept(-rows, before.shape[0]), _kept(-columns, before.shape[1])]
    new = after[_kept(rows, after.shape[0]), _kept(columns, after.shape[1])]
    known = (old > _DARK) & (new > _DARK)
    if known.sum() < _MIN_OVERLAP * before.size:
        return None
    return float(np.median(np.log2(new[known] / old[known])))


def _kept(shift: int, length: int) -> slice:
    """What of a side is still in view after a shift, seen from the picture that moved."""
    return slice(shift, length) if shift >= 0 else slice(0, length + shift)
