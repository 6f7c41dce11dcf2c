"""Smooth ways through poses at given times: cubic Hermite splines with tension.

K poses at times `t` [K], increasing. Between two of them each value is the cubic that has their
values and the slopes that their neighbours give, times 1 - tension (Kochanek and Bartels, 1984,
without bias and continuity). Slopes count for the uneven times between poses.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.exports.paths.flight import Flight
from pipelines.scene.rotations import quaternions, rotation_matrices

Floats = NDArray[np.float64]


def through(
    poses: Floats,
    fov_deg: Floats | None,
    durations: Floats,
    num_frames: int,
    *,
    tension: float = 0.0,
    loop: bool = False,
) -> Flight:
    """A flight through poses [K, 3, 4], K >= 2, evenly in time.

    fov_deg: [K], or None. durations: [K - 1], or [K] with the way back where `loop`, all above 0.
    The first frame is the first pose; the last one the last, or one step before the first again.
    Positions and the focal length's logarithm are splines; so are quaternions, of which each is
    the nearer of its two signs to the one before, brought to length 1.
    """
    q = _on_one_side(quaternions(poses[:, :, :3]))
    columns = [poses[:, :, 3], q]
    if fov_deg is not None:
        columns.append(-np.log(np.tan(np.radians(fov_deg) / 2.0))[:, None])
    values = np.concatenate(columns, axis=1)
    if loop:
        again = values[:1].copy()
        if values[-1, 3:7] @ again[0, 3:7] < 0.0:
            again[:, 3:7] *= -1.0
        values = np.concatenate((values, again))
    t = np.concatenate(([0.0], np.cumsum(durations)))
    at = np.linspace(0.0, t[-1], num_frames, endpoint=not loop)
    found = hermite(values, t, at, _slopes(values, t, loop) * (1.0 - tension))
    turns = rotation_matrices(found[:, 3:7])
    path: Floats = np.concatenate((turns, found[:, :3, None]), axis=2)
    if fov_deg is None:
        return Flight(path)
    return Flight(path, np.degrees(2.0 * np.arctan(np.exp(-found[:, 7]))))


def hermite(values: Floats, t: Floats, at: Floats, slopes: Floats) -> Floats:
    """[M, D] at times `at` [M], from values and slopes [K, D] at times `t` [K]."""
    index = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
    width = (t[index + 1] - t[index])[:, None]
    u = (at - t[index])[:, None] / width
    begin, end = values[index], values[index + 1]
    found: Floats = (
        (2 * u**3 - 3 * u**2 + 1) * begin
        + (u**3 - 2 * u**2 + u) * width * slopes[index]
        + (-2 * u**3 + 3 * u**2) * end
        + (u**3 - u**2) * width * slopes[index + 1]
    )
    return found


def _slopes(values: Floats, t: Floats, loop: bool) -> Floats:
    """[K, D]: those of the parabola through each value and its two neighbours.

    At the ends those of the way to the only neighbour; of a loop, whose last value is its first
    again, the neighbours are across the end.
    """
    width = np.diff(t)[:, None]
    rate = np.diff(values, axis=0) / width
    inner = (rate[1:] * width[:-1] + rate[:-1] * width[1:]) / (width[1:] + width[:-1])
    if not loop:
        return np.concatenate((rate[:1], inner, rate[-1:]))
    last = rate[-1:].copy()
    if values[-1, 3:7] @ values[0, 3:7] < 0.0:
        last[:, 3:7] *= -1.0  # the same turn by its other sign
    first = (rate[:1] * width[-1:] + last * width[:1]) / (width[:1] + width[-1:])
    end = first.copy()
    if values[-1, 3:7] @ values[0, 3:7] < 0.0:
        end[:, 3:7] *= -1.0
    return np.concatenate((first, inner, end))


def _on_one_side(q: Floats) -> Floats:
    """Quaternions [K, 4], each with the sign that is nearer to the one before."""
    turned = q.copy()
    for index in range(1, len(q)):
        if turned[index] @ turned[index - 1] < 0.0:
            turned[index] *= -1.0
    return turned
