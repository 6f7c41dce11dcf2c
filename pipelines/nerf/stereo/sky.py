"""The sky, at which nothing stands.

A patch of sky is plain, so matching carries onto it the depth of what it borders on, and many
views agree: sheets of sky hang around a statue. Nothing in two pictures speaks against them. So the
sky is told by what one picture shows and by what is far: a plain, bright and not warm patch at the
picture's border, all of it above the horizon, without a point of structure from motion in it; and
in the capture such patches border on what is far away, as walls and ceilings of rooms do not.

By day that is not asked: a facade has nothing behind it. Where a tenth of all pictures is blue as
air is, brighter or paler along a smooth slope, without a point, above the horizon and nowhere below
it, this is sky, and so is what is white beside it or at the top of other pictures.

An overcast sky is white, and so are ceilings. But where a camera exposes for what stands on the
ground such a sky is burnt out, which a ceiling hardly is; and of photos the exposures tell
(`daylight`). Either way what looks like sky is sky, wherever it borders.

Depth is along the camera's axis (z), 0 where unknown.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from skimage.measure import label

from pipelines.nerf.ahead import each_ahead
from pipelines.nerf.stereo.patch_colors import (
    Bools,
    Bytes,
    Floats,
    PatchColors,
    at_border,
    grown,
)
from pipelines.nerf.stereo.patches import Labels, shelved_patches
from pipelines.nerf.stereo.planes import ray_grid
from pipelines.nerf.stereo.shelves import ByView, Shelf
from pipelines.nerf.stereo.views import StereoView
from pipelines.nerf.stereo.void import is_measured

_MOST_SPREAD, _LEAST_BRIGHT, _LEAST_EACH, _MOST_WARM = 0.06, 0.8, 0.3, 0.03
"""Of colours: standard deviation; the mean of the brightest channel and of each; and how much more
red than blue."""
_HORIZON_DEG, _LOW_PERCENT = -3.0, 5
"""All but so few pixels of a patch are above the horizon, which is known to some degrees."""
_MOST_POINTS, _MOST_BEFORE_BLOWN = 1e-3, 5e-3
"""Points of structure from motion, a few of which are always wrong, per pixel of what is inside a
patch; and inside one that is burnt out, which can show none: they are hidden, or wrong."""
_RING_FROM_PX, _RING_TO_PX = 3, 12
_FAR, _FAR_PERCENT, _LEAST_FAR = 3.0, 90, 0.3
"""In that share of the views a tenth of what is known around their patches is so many times as far
as the median of all that they know. Not more of it: patches' own wrong depths lie there, too."""
_LEAST_VIEWS, _LEAST_SHARE = 3, 0.01
"""So many views show it, and so much of all pictures is it."""
_BLOWN_OUT, _LEAST_BLOWN = 250, 0.05
"""Of 255, the least channel of what is burnt out; and how much of all pictures is so, and looks
like sky, where it is an overcast one. Around a building it was .11; of windows behind a thing
.007."""

_LEAST_BLUE, _LEAST_GREEN, _MOST_UNEVEN = 0.12, 0.33, 0.05
"""Of a blue sky: by how much more blue than red it has; where its green lies between these two, 0
to 1, screens and paints mostly being lower; and what the smoothest slope leaves of its colours'
spread. Skies at hand have .13 to .37, .5 to .7 and .01 to .043."""
_LEAST_DAY_SHARE, _MOST_BELOW = 0.1, 0.25
"""So much of all pictures is blue sky by day; and for its area, so much alike reaches below the
horizon: walls and cloths do."""
_LEAST_OF_TOP = 0.3
"""Of the picture's upper border, that a white sky takes by day."""
_LEAST_CLOUD, _MOST_CLOUD = 0.5, 0.1
"""Brightest channel of what the sky surrounds and is sky, and how much of the picture one takes."""


@dataclass(frozen=True)
class Sky:
    """masks: what of each view's picture is sky, [H, W]; none where the capture shows no sky.

    share: of all pictures. num_views: that show some, or may. far: in what share of these it
    borders on what is far away. by_day: whether it is known to be sky for being blue. blown_out:
    what share of all pictures is so, and looks like sky.
    """

    masks: list[Bools]
    share: float
    num_views: int
    far: float
    by_day: bool = False
    blown_out: float = 0.0


def find_sky(
    views: Sequence[StereoView],
    picture_of: Callable[[int], Bytes],
    depths: ByView[NDArray[np.float32]],
    up: Floats,
    points: Floats,
    measured: Sequence[NDArray[np.float32] | None] | None = None,
    patches: Shelf | None = None,
    on_share: Callable[[float], None] = lambda done: None,
    *,
    daylight: bool = False,
) -> Sky:
    """The sky in a capture's pictures.

    picture_of: each view's, in colour, [H, W, 3] uint8, sRGB. depths: what is known so far, wrong
    where the sky is. up: [3], unit. points: [P, 3], world, on what was told apart from anything
    else. measured: what a sensor saw, as `depths`, None for a view without; of the sky it sees
    nothing. patches: a shelf for the pictures' `patches_of`, or with them. on_share: told the share
    that is done; may raise. daylight: whether the pictures are known to be taken outdoors by day.
    """

    def look(index: int) -> _Found:
        parts = shelved_patches(views[index], index, patches)
        seen = _Look.at(views[index], picture_of(index), up, points, parts)
        return _found(seen, depths[index])

    found = []
    for one in each_ahead(look, range(len(views))):
        found.append(one)
        on_share(len(found) / len(views))
    is_far = [one.is_far for one in found if one.is_far is not None]
    far = float(np.mean(is_far)) if is_far else 0.0
    blown_out = float(np.mean([one.blown_out for one in found]))
    above, below = np.mean([one.blue for one in found], axis=0)
    by_day = bool(above >= _LEAST_DAY_SHARE and below <= _MOST_BELOW * above)
    masks = [one.by_day if by_day else one.pale for one in found]
    num_views = sum(bool(mask.any()) for mask in masks)
    share = float(np.mean([mask.mean() for mask in masks]))
    is_told = by_day or daylight or far >= _LEAST_FAR or blown_out >= _LEAST_BLOWN
    too_little = num_views < _LEAST_VIEWS or share < _LEAST_SHARE
    if not is_told or too_little or is_measured(masks, measured):
        masks, share, by_day = [np.zeros_like(mask) for mask in masks], 0.0, False
    return Sky(masks, share, num_views, far, by_day, blown_out)


@dataclass(frozen=True)
class _Found:
    """What of a picture may be sky: if pale [H, W], and if there is a blue one [H, W].

    is_far: whether what is pale borders on what is far; None where nothing is known of that. blue:
    `_Look.blue`. blown_out: what share of the picture is so, and pale.
    """

    pale: Bools
    by_day: Bools
    is_far: bool | None
    blue: tuple[float, float]
    blown_out: float


def _found(look: _Look, z: NDArray[np.float32]) -> _Found:
    pale = look.sky()
    is_far: bool | None = None
    if pale.any() and (z > 0).any():
        ring = grown(pale, _RING_TO_PX) & ~grown(pale, _RING_FROM_PX) & (z > 0)
        farthest = np.percentile(z[ring], _FAR_PERCENT) if ring.any() else 0.0
        is_far = bool(farthest >= _FAR * np.median(z[z > 0]))
    blown_out = float((pale & (look.seen.picture.min(axis=-1) >= _BLOWN_OUT)).mean())
    return _Found(pale, look.sky_by_day(), is_far, look.blue(), blown_out)


def like_sky(
    view: StereoView,
    picture: Bytes,
    up: Floats,
    points: Floats,
    patches: Labels | None = None,
    *,
    by_day: bool = False,
) -> Bools:
    """[H, W]: what of one picture may be sky, and is, where its capture shows any.

    As `find_sky`; patches: the picture's `patches_of`, where they are known. Small patches, and
    what the picture's border does not touch, are sky where they look like a patch of it that is
    found, and are as high. by_day: as `Sky`.
    """
    look = _Look.at(view, picture, up, points, patches)
    return look.sky_by_day() if by_day else look.sky()


@dataclass(frozen=True)
class _Look:
    """A picture's patches, N of them.

    height: [H, W], degrees above the horizon. num_points: [H, W], of structure from motion.
    is_bare: [N], with hardly any.
    """

    seen: PatchColors
    height: Floats
    num_points: NDArray[np.int64]
    is_bare: Bools

    @classmethod
    def at(
        cls, view: StereoView, picture: Bytes, up: Floats, points: Floats, patches: Labels | None
    ) -> _Look:
        seen = PatchColors.of(view, picture, patches)
        num_points = np.zeros(seen.there.shape, np.int64)
        np.add.at(num_points, view.seen_at(points)[1:], 1)
        inside = np.bincount(
            seen.labels[seen.inside], num_points[seen.inside], minlength=len(seen.mean)
        )
        is_blown = seen.mean.min(axis=-1) >= _BLOWN_OUT / 255.0
        most = np.where(is_blown, _MOST_BEFORE_BLOWN, _MOST_POINTS)
        bare = (seen.area > 0) & (inside <= most * seen.num_inside)
        return cls(seen, _elevation(view, up), num_points, bare)

    def sky(self) -> Bools:
        """[H, W]: plain, bright, not warm."""
        seen = self.seen
        looks = self.is_bare & (seen.spread <= _MOST_SPREAD) & self._is_pale()
        lowest = self._lowest(looks)
        sure = looks & seen.is_large & (lowest > _HORIZON_DEG)
        if not sure.any():
            return np.zeros_like(seen.there)
        also = looks & seen.alike(sure) & (lowest >= lowest[sure].min())
        return seen.with_fringes(sure | also)

    def sky_by_day(self) -> Bools:
        """[H, W]: blue or white along a slope, and the clouds in it."""
        seen = self.seen
        lowest = self._lowest(self.is_smooth)
        sure = self.is_smooth & (lowest > _HORIZON_DEG)
        sure &= self._is_blue() | (self._of_top() >= _LEAST_OF_TOP)
        if not sure.any():
            return np.zeros_like(seen.there)
        plain = self.is_bare & (seen.spread <= _MOST_SPREAD) & (self._is_blue() | self._is_pale())
        also = plain & seen.alike(sure) & (self._lowest(plain) >= lowest[sure].min())
        return self._with_clouds(seen.with_fringes(sure | also, local=True))

    def blue(self) -> tuple[float, float]:
        """What shares of the picture are a blue sky, and alike but reach below the horizon."""
        smooth = self.is_smooth & self._is_blue()
        above = smooth & (self._lowest(smooth) > _HORIZON_DEG)
        area = self.seen.area / self.seen.there.size
        return float(area[above].sum()), float(area[smooth & ~above].sum())

    def _is_pale(self) -> Bools:
        mean = self.seen.mean
        bright = (mean.max(axis=-1) >= _LEAST_BRIGHT) & (mean.min(axis=-1) >= _LEAST_EACH)
        pale: Bools = bright & (mean[:, 0] - mean[:, 2] <= _MOST_WARM)
        return pale

    def _is_blue(self) -> Bools:
        red, green, blue = self.seen.mean.T
        more = blue - red
        azure: Bools = (
            (more >= _LEAST_BLUE) & (green <= blue) & (green - red >= _LEAST_GREEN * more)
        )
        return azure

    @functools.cached_property
    def is_smooth(self) -> Bools:
        """[N]: large, bare, blue or pale, with little but one slope of colours, quadratic."""
        seen = self.seen
        height, width = seen.there.shape
        smooth = np.zeros_like(self.is_bare)
        for patch in np.flatnonzero(
            seen.is_large & self.is_bare & (self._is_blue() | self._is_pale())
        ):
            own = seen.there & (seen.labels == patch)
            inside = own & seen.inside
            rows, columns = np.nonzero(inside if inside.any() else own)
            y, x = rows / height - 0.5, columns / width - 0.5
            terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
            colors = seen.picture[rows, columns] / 255.0
            slope = np.linalg.lstsq(terms, colors, rcond=None)[0]
            smooth[patch] = (colors - terms @ slope).std(axis=0).max() <= _MOST_UNEVEN
        return smooth

    def _lowest(self, of: Bools) -> Floats:
        """[N]: above which nearly all of each of those is; of the others nothing."""
        lowest = np.full(len(of), -np.inf)
        for patch in np.flatnonzero(of):
            pixels = self.seen.there & (self.seen.labels == patch)
            lowest[patch] = np.percentile(self.height[pixels], _LOW_PERCENT)
        return lowest

    def _of_top(self) -> Floats:
        """[N]: what share of the picture's upper border each takes."""
        border = at_border(self.seen.there)
        if not border.any():  # a mask may hide all of a picture
            return np.zeros(len(self.is_bare))
        low, high = self.height[border].min(), self.height[border].max()
        top = border & (self.height >= high - 0.25 * (high - low))
        share: Floats = np.bincount(self.seen.labels[top], minlength=len(self.is_bare)) / top.sum()
        return share

    def _with_clouds(self, sky: Bools) -> Bools:
        """[H, W]: with what is bright, not warm, bare, and touches nothing but sky and border."""
        label_all: Any = label
        parts = label_all(~sky & self.seen.there, connectivity=1)
        flat, num = parts.ravel(), int(parts.max()) + 1
        area = np.maximum(np.bincount(flat, minlength=num), 1)
        red, green, blue = (
            np.bincount(flat, channel.ravel() / 255.0, num) / area
            for channel in self.seen.picture.transpose(2, 0, 1)
        )
        low = np.full(num, np.inf)
        np.minimum.at(low, flat, self.height.ravel())
        clouds = (np.maximum(green, blue) >= _LEAST_CLOUD) & (red - blue <= _MOST_WARM)
        clouds &= low > np.percentile(self.height[sky], _LOW_PERCENT)
        clouds &= area <= _MOST_CLOUD * sky.size
        clouds &= np.bincount(flat, self.num_points.ravel(), num) <= _MOST_POINTS * area
        clouds[0] = False
        found: Bools = sky | clouds[parts]
        return found


def _elevation(view: StereoView, up: Floats) -> Floats:
    """[H, W], degrees above the horizon that each pixel looks."""
    x, y = ray_grid(view)
    a, b, c = up @ view.world_from_camera[:, :3]
    elevation: Floats = np.degrees(np.arcsin((x * a + y * b + c) / np.sqrt(x * x + y * y + 1.0)))
    return elevation
