"""Patches of a picture: plain ones are what stereo cannot match.

After Felzenszwalb, Huttenlocher, "Efficient graph-based image segmentation", IJCV 2004.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from skimage.segmentation import felzenszwalb

from pipelines.nerf.stereo.shelves import Shelf
from pipelines.nerf.stereo.views import StereoView

Labels = NDArray[np.int32]
Floats = NDArray[np.float64]

_SCALE, _SIGMA, _LEAST_PX = 100.0, 0.8, 60
_STEP = 0.012
"""Mean difference of brightness, in [0, 1], across what shading may divide."""
_LEAST_SHARED_PX = 8


def patches_of(picture: NDArray[np.float32]) -> Labels:
    """[H, W] numbers, from 0, of the patches of even brightness. picture: grey, in [0, 1]."""
    found: Labels = felzenszwalb(
        _shown(picture), scale=_SCALE, sigma=_SIGMA, min_size=_LEAST_PX
    ).astype(np.int32)
    return found


def shelved_patches(view: StereoView, index: int, shelf: Shelf | None) -> Labels:
    """`patches_of` a view's picture, found once where there is a shelf for them."""
    if shelf is None:
        return patches_of(view.picture)
    if not shelf.has(index):
        shelf[index] = patches_of(view.picture)
    found: Labels = shelf[index]
    return found


def even_patches(picture: NDArray[np.float32], patches: Labels | None = None) -> Labels:
    """The picture's `patches_of`, those that only shading divides joined.

    A wall that light falls on from one side comes in bands. Two patches are one where their
    brightness differs by less than 3 of 255 in the mean over the border that they share, two pixels
    from it on either side.
    """
    patches = patches_of(picture) if patches is None else patches
    num = int(patches.max()) + 1
    pairs, steps = zip(
        *(_steps(labels, shown, num) for labels, shown in _both_ways(patches, _shown(picture))),
        strict=True,
    )
    each, which = np.unique(np.concatenate(pairs), return_inverse=True)
    step = np.concatenate(steps)
    count = np.bincount(which, minlength=len(each))
    mean = np.bincount(which, step, len(each)) / np.maximum(count, 1)
    spread = np.bincount(which, np.abs(step), len(each)) / np.maximum(count, 1)
    same = (count >= _LEAST_SHARED_PX) & (np.abs(mean) < _STEP) & (spread < 2.0 * _STEP)
    joined: Labels = _joined(num, each[same] // num, each[same] % num)[patches]
    return joined


def _shown(picture: NDArray[np.float32]) -> Floats:
    return np.clip(picture, 0.0, 1.0).astype(np.float64)


def _both_ways(patches: Labels, shown: Floats) -> tuple[tuple[Labels, Floats], ...]:
    return (patches, shown), (patches.T, shown.T)


def _steps(patches: Labels, shown: Floats, num: int) -> tuple[NDArray[np.int64], Floats]:
    """Where rows go from one patch to another: the pair, as low * num + high, and high - low."""
    row, column = np.nonzero(patches[:-1] != patches[1:])
    above, below = np.maximum(row - 1, 0), np.minimum(row + 2, len(patches) - 1)
    one, two = patches[row, column].astype(np.int64), patches[row + 1, column].astype(np.int64)
    clear = (patches[above, column] == one) & (patches[below, column] == two)
    step = np.where(one < two, 1.0, -1.0) * (shown[below, column] - shown[above, column])
    return (np.minimum(one, two) * num + np.maximum(one, two))[clear], step[clear]


def _joined(num: int, one: NDArray[np.int64], two: NDArray[np.int64]) -> Labels:
    """[num] new numbers, from 0, the same for patches that pairs connect."""
    root = list(range(num))

    def root_of(patch: int) -> int:
        while root[patch] != patch:
            root[patch] = root[root[patch]]
            patch = root[patch]
        return patch

    for a, b in zip(one.tolist(), two.tolist(), strict=True):
        root[root_of(a)] = root_of(b)
    _, numbers = np.unique([root_of(patch) for patch in range(num)], return_inverse=True)
    return numbers.astype(np.int32)
