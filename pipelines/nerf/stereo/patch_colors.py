"""How the patches of a picture look: what the sky and the dark are told by.

Symbols: N patches. Colours are sRGB in [0, 1].
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from skimage.filters import gaussian
from skimage.morphology import dilation, erosion
from skimage.segmentation import expand_labels

from pipelines.nerf.stereo.patches import Labels, even_patches
from pipelines.nerf.stereo.views import StereoView

Bools = NDArray[np.bool_]
Bytes = NDArray[np.uint8]
Floats = NDArray[np.float64]

_INSIDE_PX, _BORDER_PX = 4, 6
_LEAST_AREA = 0.005
"""Of the picture: patches that are told by themselves. Smaller ones are told by them."""
_ALIKE, _FRINGE_PX = 0.08, 4
"""Two colours are alike; pixels so near to a patch that have its colour belong to it."""


@dataclass(frozen=True)
class PatchColors:
    """A picture's patches: labels [H, W]; there [H, W], where there is a picture.

    inside: [H, W], what is not near another patch. mean [N, 3] and spread [N], the largest standard
    deviation, of the colours inside. area: [N], pixels; num_inside: [N], of them inside. is_large:
    [N], at the picture's border and not small.
    """

    picture: Bytes
    labels: Labels
    there: Bools
    inside: Bools
    mean: Floats
    spread: Floats
    area: NDArray[np.int64]
    num_inside: NDArray[np.int64]
    is_large: Bools

    @classmethod
    def of(cls, view: StereoView, picture: Bytes, patches: Labels | None = None) -> PatchColors:
        """picture: the view's in colour, [H, W, 3]. patches: its `patches_of`, if known."""
        there = view.picture >= 0.0
        labels = even_patches(view.picture, patches)
        num = int(labels.max()) + 1
        area = np.bincount(labels[there], minlength=num)
        inside = there & (_shrunk_labels(labels) == labels)
        num_inside = np.bincount(labels[inside], minlength=num)
        # What stands before a patch frays into it: its colours are those of its inside, if any.
        told = inside | (there & (num_inside == 0)[labels])
        mean, spread = _colors_of(labels[told], picture[told], num)
        touching = np.bincount(labels[there & at_border(there)], minlength=num) > 0
        is_large = touching & (area >= _LEAST_AREA * there.size)
        return cls(picture, labels, there, inside, mean, spread, area, num_inside, is_large)

    def alike(self, chosen: Bools) -> Bools:
        """[N]: which patches have the colour of one of those chosen [N]."""
        if not chosen.any():
            return np.zeros_like(chosen)
        apart = np.abs(self.mean[:, None] - self.mean[None, chosen]).max(axis=-1).min(axis=-1)
        near: Bools = apart <= _ALIKE
        return near

    def with_fringes(self, chosen: Bools, *, local: bool = False) -> Bools:
        """[H, W]: the patches chosen [N], and what has their colour beside them.

        Patches end before the things that they surround do. local: the colour that they have
        there, where one is not the same all over.
        """
        found: Bools = chosen[self.labels] & self.there
        expand: Any = expand_labels
        own = expand(np.where(found, self.labels + 1, 0), _FRINGE_PX)
        color = self._near(found) if local else self.mean[np.maximum(own - 1, 0)]
        off = np.abs(self.picture / 255.0 - color).max(axis=-1)
        fringed: Bools = found | (self.there & (own > 0) & (off <= _ALIKE))
        return fringed

    def _near(self, found: Bools) -> Floats:
        """[H, W, 3]: the mean colour of what is found near each pixel."""
        smooth: Any = gaussian
        weight = smooth(found.astype(np.float64), _FRINGE_PX)
        channels = (self.picture / 255.0 * found[..., None]).transpose(2, 0, 1)
        sums = np.stack([smooth(channel, _FRINGE_PX) for channel in channels], axis=-1)
        near: Floats = sums / np.maximum(weight, 1e-6)[..., None]
        return near


def grown(mask: Bools, radius: int) -> Bools:
    """[H, W], with what is so near to it, px."""
    larger: Bools = dilation(mask, _square(radius))
    return larger


def shrunk(mask: Bools, radius: int) -> Bools:
    """[H, W], without what is so near to its border, px; the picture's own is none."""
    padded = np.pad(~mask, radius, mode="edge")
    smaller: Bools = ~grown(padded, radius)[radius:-radius, radius:-radius]
    return smaller


def _colors_of(labels: Labels, colors: Bytes, num: int) -> tuple[Floats, Floats]:
    """Mean colour [num, 3] of each patch, and the largest standard deviation [num].

    labels: [K]. colors: [K, 3], sRGB.
    """
    count = np.maximum(np.bincount(labels, minlength=num), 1)
    channels = (colors / 255.0).T
    mean = np.stack([np.bincount(labels, c, num) / count for c in channels], axis=-1)
    square = np.stack([np.bincount(labels, c * c, num) / count for c in channels], axis=-1)
    return mean, np.sqrt(np.maximum(square - mean**2, 0.0)).max(axis=-1)


def at_border(there: Bools) -> Bools:
    """[H, W]: what lies at the border of what a picture has."""
    padded = np.pad(there, _BORDER_PX)
    inner: Bools = shrunk(padded, _BORDER_PX)[_BORDER_PX:-_BORDER_PX, _BORDER_PX:-_BORDER_PX]
    return there & ~inner


def _shrunk_labels(labels: Labels) -> Labels:
    """The labels, -1 where another one is near."""
    square = _square(_INSIDE_PX)
    alone = dilation(labels, square) == erosion(labels, square)
    inner: Labels = np.where(alone, labels, -1).astype(np.int32)
    return inner


def _square(radius: int) -> Bytes:
    return np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
