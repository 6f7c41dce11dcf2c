"""Up to within a degree or two, by what is level: floors, tables, what lies on them.

Cameras tell which way is up only as well as people hold them level. Who goes all round holds them
aslant now to one side and now to another, and is off by some degrees; in an arc all of that stays.
Tables and floors are level. So of the directions near the one that cameras tell that is taken
across which most points lie on few planes, if it is clearly better; how near, goes by how much
cameras were turned: a lawn that slopes stays sloping to who has gone all round it.

Symbols: P points, N cameras.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pipelines.scene.pitch import FARTHEST, FEWEST_POINTS, LINE, share_on_lines

Array = npt.NDArray[np.float64]

_ASLANT_DEG, _MOST_DEG = 4.5, 20.0
"""How far off cameras are at most that were turned through a circle, times the root of a half; and
the most that is looked for of any."""
_STEP_DEG, _FINER, _PEAK = 1.0, 7, 8
"""Of the grid of directions; the best is the mean of so many squared around it, by this power."""
_LEAST_SHARE, _CLEAR, _BETTER = 0.2, 1.5, 1.05
"""Of the points, how many lie on few planes; how many times as many as in the median of the
directions; and as by the direction that cameras tell."""
_MOST_POINTS = 20_000


def straightened(points: Array, world_from_camera: Array, up: Array) -> Array | None:
    """The direction, [3] unit, near `up`, across which most of what is seen lies on few planes;
    None where none clearly is that.

    points: [P, 3]. world_from_camera: [N, 3, 4], OpenGL axes. up: [3] unit, as cameras tell it.
    """
    away = points - world_from_camera[:, :, 3].mean(axis=0)
    distance = np.linalg.norm(away, axis=1)
    usual = float(np.median(distance)) if len(points) else 0.0
    away = away[distance <= FARTHEST * usual]
    if len(away) < FEWEST_POINTS or not usual > 0.0:
        return None
    away = away[:: max(1, len(away) // _MOST_POINTS)]
    beside = _beside(up)
    steps = np.arange(-_MOST_DEG, _MOST_DEG + _STEP_DEG, _STEP_DEG)
    off_deg = np.hypot(steps[:, None], steps[None, :])
    shares = np.full(off_deg.shape, np.nan)
    for row, column in np.argwhere(off_deg <= _MOST_DEG):
        leant = _turned(up, beside, steps[row], steps[column])
        shares[row, column] = share_on_lines(away @ leant, LINE * usual)
    row, column = np.unravel_index(np.nanargmax(shares), shares.shape)
    if off_deg[row, column] > _reach_deg(world_from_camera):
        return None
    best, told = shares[row, column], shares[len(steps) // 2, len(steps) // 2]
    if best < _LEAST_SHARE or best < _CLEAR * np.nanmedian(shares) or best < _BETTER * told:
        return None
    finer = np.linspace(-_STEP_DEG, _STEP_DEG, _FINER)
    near = [_turned(up, beside, a, b) for a in steps[row] + finer for b in steps[column] + finer]
    weights = np.array([share_on_lines(away @ one, LINE * usual) for one in near]) ** _PEAK
    level = np.average(near, axis=0, weights=weights)
    found: Array = level / np.linalg.norm(level)
    return found


def _reach_deg(world_from_camera: Array) -> float:
    """How far off up may be as cameras [N, 3, 4] tell it, degrees: the less the more they turn."""
    turned = max(
        float(np.linalg.eigvalsh(axes.T @ axes / len(axes))[1]) ** 0.5
        for axes in (world_from_camera[:, :, 0], world_from_camera[:, :, 1])
    )
    return float(min(_ASLANT_DEG / max(turned, 1e-6), _MOST_DEG))


def _beside(up: Array) -> Array:
    """Two directions [2, 3] across it and each other."""
    first = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(up, first)])


def _turned(up: Array, beside: Array, a_deg: float, b_deg: float) -> Array:
    """`up` leant towards the two directions beside it, [3] unit."""
    leant: Array = up + np.tan(np.radians([a_deg, b_deg])) @ beside
    return leant / np.linalg.norm(leant)
