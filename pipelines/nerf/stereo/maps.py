"""Depth maps of a capture from its pictures alone: plane sweep, aggregation, votes.

Symbols: V views. Depth is along the camera's axis (z), world units, 0 where it is not known. Who
computes: `stereo.engines`. What maps are used for: docs/surfaces.md.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from pipelines.nerf.options.stereo import StereoConfig
from pipelines.nerf.stereo.agreement import AGREE, IN_PICTURE, SEE_THROUGH
from pipelines.nerf.stereo.engines import KERNELS, Engine, homographies_to
from pipelines.nerf.stereo.neighbours import choose_neighbours, depth_range, spread_apart
from pipelines.nerf.stereo.shelves import MEMORY, ByView, Shelf, Shelves
from pipelines.nerf.stereo.views import StereoView, camera_extent

Floats = NDArray[np.float64]
Progress = Callable[[float, str], None]

_MAX_POINTS, _PER_VIEW = 4000, 25
_PROBE_VIEWS, _PROBE_LONG_SIDE, _PROBE_NEIGHBOURS, _PROBE_PLANES = 32, 160, 6, 160
_PROBE_NEAREST = 0.1
"""The nearest surface tried where nothing is known, in units of the cameras' extent."""
_PROBE_FARTHEST = 100.0
_PROBE_SHARE = 0.15
_VOTE_SHARE = 0.1
FEW_PHOTOS, _LONELY = 40, 0.2
"""Photos are few below that number, or where that share of what they show has one neighbour."""


VOID = 255
"""Votes of a pixel that has no depth because nothing stands there, as in the sky."""


@dataclass(frozen=True)
class DepthMap:
    """z: [H, W] float32, 0 where unknown. votes: [H, W] uint8, views that agree with each depth;
    `VOID` where nothing stands.
    """

    z: NDArray[np.float32]
    votes: NDArray[np.uint8]

    @property
    def is_void(self) -> NDArray[np.bool_]:
        """[H, W]: where nothing stands."""
        void: NDArray[np.bool_] = (self.z == 0) & (self.votes == VOID)
        return void


class MapShelf:
    """The depth maps of a capture on two shelves: `z` and `votes`. name: that they are kept by."""

    def __init__(self, z: Shelf, votes: Shelf, name: str = "") -> None:
        self.z, self.votes, self.name = z, votes, name

    @classmethod
    def kept(cls, shelves: Shelves, name: str, count: int, *, fresh: bool = False) -> MapShelf:
        """See `Shelves`."""
        z, votes = (shelves.kept(part, count, fresh=fresh) for part in cls.parts_of(name))
        return cls(z, votes, name)

    @classmethod
    def of(cls, maps: Sequence[DepthMap]) -> MapShelf:
        """Those maps, in memory."""
        held = cls.kept(MEMORY, "", len(maps))
        for index, found in enumerate(maps):
            held[index] = found
        return held

    @staticmethod
    def parts_of(name: str) -> tuple[str, str]:
        """The names of the two shelves."""
        return f"{name}-z", f"{name}-votes"

    def __len__(self) -> int:
        return len(self.z)

    def __iter__(self) -> Iterator[DepthMap]:
        return (self[index] for index in range(len(self)))

    def has(self, index: int) -> bool:
        """Whether that view's map lies there."""
        return self.z.has(index) and self.votes.has(index)

    def __getitem__(self, index: int, /) -> DepthMap:
        return DepthMap(self.z[index], self.votes[index])

    def __setitem__(self, index: int, found: DepthMap, /) -> None:
        self.z[index] = found.z
        self.votes[index] = found.votes


def depths_of(maps: ByView[DepthMap]) -> ByView[NDArray[np.float32]]:
    """The maps' depths alone."""
    return maps.z if isinstance(maps, MapShelf) else [found.z for found in maps]


def find_depth_maps(
    views: Sequence[StereoView],
    config: StereoConfig,
    points: Floats | None = None,
    on_progress: Progress = lambda fraction, message: None,
    engine: Engine = KERNELS,
    shelves: Shelves = MEMORY,
) -> MapShelf:
    """A depth map for each view, agreed upon by others; empty where a view has no neighbours.

    points: [P, 3], world: what is known of the scene, as from structure from motion; None has a
    coarse pass over some views look for them. on_progress: fraction and message; may raise.
    shelves: what lies there of points, the views' own depths and maps is not sought again; it is of
    the same views, points, options and engine.
    """
    begun = 0.0
    if points is None or len(points) < _MAX_POINTS // 100:
        probed = shelves.kept("points", 1)
        if not probed.has(0):
            probed[0] = find_points(
                views, config, lambda f, text: on_progress(_PROBE_SHARE * f, text), engine
            )
        points, begun = probed[0], _PROBE_SHARE
    points = thinned(points, _most_points(len(views)))
    neighbours = choose_neighbours(views, points, config.num_neighbours, config.best_angle_deg)
    ranges = [depth_range(view, points) for view in views]
    known = [item for item in ranges if item is not None]
    typical = (
        (float(np.median([near for near, _ in known])), float(np.median([far for _, far in known])))
        if known
        else None
    )
    raw = shelves.kept("raw", len(views))
    for index, view in enumerate(views):
        if not raw.has(index):
            limits = ranges[index] or typical
            others = [views[other] for other in neighbours[index]]
            raw[index] = _sweep(view, others, limits, config, engine)
        share = (index + 1) / len(views) * (1.0 - begun - _VOTE_SHARE)
        on_progress(begun + share, f"depth {index + 1}/{len(views)}")
    maps = MapShelf.kept(shelves, "matched", len(views))
    few = len(views) < FEW_PHOTOS or lonely_share(views, points, neighbours) >= _LONELY
    for index in range(len(views)):
        if not maps.has(index):
            maps[index] = agreed(
                index, views, raw, neighbours[index], config, engine, few_photos=few
            )
        on_progress(1.0 - _VOTE_SHARE * (1.0 - (index + 1) / len(views)), "comparing depths")
    return maps


def lonely_share(
    views: Sequence[StereoView], points: Floats, neighbours: Sequence[Sequence[int]]
) -> float:
    """How much of what views show lies in the picture of at most one of their neighbours, [0, 1].

    points: [P, 3], of what they show, also where something hides it.
    """
    shown = np.array([view.seen(points)[1] for view in views])
    others = np.zeros(shown.shape, np.int64)
    for index, chosen in enumerate(neighbours):
        others[index] = shown[list(chosen)].sum(axis=0)
    return float((others[shown] <= 1).mean()) if shown.any() else 0.0


def find_points(
    views: Sequence[StereoView],
    config: StereoConfig,
    on_progress: Progress,
    engine: Engine = KERNELS,
) -> Floats:
    """Some points [P, 3] on the scene's surfaces, from small pictures of some views."""
    picked = np.unique(np.linspace(0, len(views) - 1, _PROBE_VIEWS).round().astype(int))
    longest = max(views[0].picture.shape)
    factor = max(1, round(longest / _PROBE_LONG_SIDE))
    some = [views[index].reduced(factor) for index in picked]
    neighbours = spread_apart(some, _PROBE_NEIGHBOURS)
    near = _PROBE_NEAREST * camera_extent(some)
    coarse = StereoConfig(num_planes=_PROBE_PLANES, agree_within=2 * config.agree_within)
    raw = []
    for index, view in enumerate(some):
        others = [some[other] for other in neighbours[index]]
        limits = near, _PROBE_FARTHEST * near / _PROBE_NEAREST
        raw.append(_sweep(view, others, limits, coarse, engine))
        on_progress((index + 1) / len(some), f"looking for surfaces {index + 1}/{len(some)}")
    found = [np.zeros((0, 3))]
    for index, view in enumerate(some):
        kept = agreed(index, some, raw, neighbours[index], coarse, engine)
        found.append(back_project(view, kept.z))
    return np.concatenate(found)


def back_project(view: StereoView, z: NDArray[np.float32]) -> Floats:
    """World points [P, 3] of the pixels whose depth is known."""
    x, y = view.rays()
    row, column = np.nonzero(z > 0)
    depth = z[row, column].astype(np.float64)
    local = np.stack([x[column] * depth, y[row] * depth, depth], axis=-1)
    world: Floats = local @ view.world_from_camera[:, :3].T + view.center
    return world


def surface_points(
    views: Sequence[StereoView], depths: ByView[NDArray[np.float32] | None]
) -> Floats:
    """Some points [P, 3], world, on what the depth maps know; None for a view without a map."""
    found = [
        thinned(back_project(view, z))
        for view, z in zip(views, depths, strict=True)
        if z is not None
    ]
    most = _most_points(len(views))
    return thinned(np.concatenate(found), most) if found else np.zeros((0, 3))


def _most_points(num_views: int) -> int:
    """Of the scene that are looked at: many views may have been taken in many rooms."""
    return max(_MAX_POINTS, _PER_VIEW * num_views)


def thinned(points: Floats, most: int = _MAX_POINTS) -> Floats:
    """At most so many of the points [P, 3], evenly picked."""
    if len(points) <= most:
        return points
    thinned: Floats = points[np.linspace(0, len(points) - 1, most).astype(int)]
    return thinned


def _sweep(
    view: StereoView,
    others: Sequence[StereoView],
    limits: tuple[float, float] | None,
    config: StereoConfig,
    engine: Engine,
) -> NDArray[np.float32]:
    """The view's own opinion, [H, W] float32, before others are asked."""
    if not others or limits is None:
        return np.zeros(view.picture.shape, np.float32)
    near, far = limits
    inverse = torch.linspace(1.0 / far, 1.0 / near, config.num_planes, dtype=torch.float64)
    homographies = homographies_to(view, others, inverse.numpy())
    pictures = _together([other.picture for other in others])
    reference = np.maximum(view.picture, 0.0)
    planes = engine.best_planes(reference, pictures, homographies, config)
    step = float(inverse[1] - inverse[0])
    z = 1.0 / (float(inverse[0]) + planes.astype(np.float64) * step)
    return np.where(view.picture >= 0.0, z, 0.0).astype(np.float32)


def _together(pictures: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
    """Pictures of any sizes as one block [N, H, W]; what a smaller one has not is no picture."""
    height, width = np.max([picture.shape for picture in pictures], axis=0)
    block = np.full((len(pictures), height, width), -1.0, np.float32)
    for place, picture in zip(block, pictures, strict=True):
        place[: picture.shape[0], : picture.shape[1]] = picture
    return block


def agreed(
    index: int,
    views: Sequence[StereoView],
    depths: ByView[NDArray[np.float32]],
    neighbours: Sequence[int],
    config: StereoConfig,
    engine: Engine = KERNELS,
    *,
    few_photos: bool = False,
) -> DepthMap:
    """A view's depths that enough neighbours confirm, and not more see through; averaged.

    few_photos: whether one is enough where a single one has the place in its picture.
    """
    depth = depths[index]
    votes, sums = votes_of_others(depth, index, views, depths, neighbours, config, engine)
    enough = np.full(depth.shape, config.min_agreeing)
    if few_photos:
        enough[votes[IN_PICTURE] == 1] = min(1, config.min_agreeing)
    kept = (depth > 0) & (votes[AGREE] >= enough) & (votes[AGREE] > votes[SEE_THROUGH])
    mean = (depth + sums) / (1.0 + votes[AGREE])
    return DepthMap(
        np.where(kept, mean, 0.0).astype(np.float32),
        np.where(kept, votes[AGREE], 0).astype(np.uint8),
    )


def votes_of_others(
    depth: NDArray[np.float32],
    index: int,
    views: Sequence[StereoView],
    depths: ByView[NDArray[np.float32]],
    neighbours: Sequence[int],
    config: StereoConfig,
    engine: Engine = KERNELS,
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """What its neighbours' depths say of a view's `depth`; see `Engine.votes`."""
    others = [(views[other], depths[other]) for other in neighbours]
    return engine.votes(views[index], depth, others, config.agree_within)
