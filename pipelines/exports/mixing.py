"""One picture of a view from two: what the trained scene shows of it, and what its mesh does.

The trained scene knows gloss and what no mesh holds, but nothing finer than the pixels that it was
trained on, and few photos leave fog in it. The mesh has the photos' own detail, and ends where it
was not seen. They err apart from each other: the mean of both is nearer to held-out photos than
either (docs/exports.md). Where they show different things the mesh is taken to be wrong.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import interpolate, pad

from pipelines.judging.asset_views import AssetView

Floats = NDArray[np.floating[Any]]

_MESH_SHARE = 0.5
"""Of the mean, where both show the same."""
_DIFFERENT = 0.2
"""Of colours in [0, 1], the largest of the three channels: the mesh's share falls to its e-th."""
_AROUND = (0.054, 0.242, 0.408, 0.242, 0.054)
"""A Gaussian of one pixel, its sum 1: two edges that almost meet are no disagreement."""


def mixed(field: Floats, mesh: AssetView, *, around: bool = False) -> NDArray[np.float32]:
    """The picture [H, W, 3] of both, sRGB in [0, 1].

    field: [h, w, 3], the trained scene's, of the same view and no larger. mesh: [H, W]. around:
    whether its left border goes on at the right, as an equirectangular picture's does; then w and W
    are even.
    """
    size, small = mesh.hit.shape, field.shape[:2]
    trained, hit, color = _channels(field), torch.from_numpy(mesh.hit), _channels(mesh.color)
    if around:
        size, small = (size[0], 2 * size[1]), (small[0], 2 * small[1])
        trained, hit, color = _wrapped(trained), _wrapped(hit), _wrapped(color)
    scene = interpolate(trained, size, mode="bicubic", align_corners=False)
    both = torch.where(hit, color, scene)
    shrunk = interpolate(both, small, mode="area")
    apart = _smooth((shrunk - trained).abs().amax(dim=1, keepdim=True))
    share = _MESH_SHARE * torch.exp(-((apart / _DIFFERENT) ** 2))
    share = interpolate(share, size, mode="bilinear", align_corners=False)
    result = torch.lerp(scene, both, share)
    return _picture(_unwrapped(result) if around else result)


def enlarged(
    field: Floats, height: int, width: int, *, around: bool = False
) -> NDArray[np.float32]:
    """The trained scene's picture alone at a larger size. around: as for `mixed`."""
    if not around:
        shown = interpolate(_channels(field), (height, width), mode="bicubic", align_corners=False)
        return _picture(shown)
    wrapped = _wrapped(_channels(field))
    shown = interpolate(wrapped, (height, 2 * width), mode="bicubic", align_corners=False)
    return _picture(_unwrapped(shown))


def _wrapped(values: Tensor) -> Tensor:
    """[..., W] as [..., 2 W]: with the other half beyond each border."""
    half = values.shape[-1] // 2
    return torch.cat([values[..., half:], values, values[..., :half]], dim=-1)


def _unwrapped(values: Tensor) -> Tensor:
    """[..., 2 W] as [..., W]: what lies between."""
    quarter = values.shape[-1] // 4
    return values[..., quarter : 3 * quarter]


def _channels(picture: Floats) -> Tensor:
    """[H, W, 3] as [1, 3, H, W]."""
    return torch.from_numpy(np.asarray(picture, np.float32)).permute(2, 0, 1)[None]


def _picture(channels: Tensor) -> NDArray[np.float32]:
    """[1, 3, H, W] as [H, W, 3], in [0, 1]."""
    result: NDArray[np.float32] = channels[0].permute(1, 2, 0).clamp(0.0, 1.0).numpy()
    return result


def _smooth(values: Tensor) -> Tensor:
    """A map [1, 1, H, W] without its finest noise."""
    kernel = torch.tensor(_AROUND)
    reach = len(_AROUND) // 2
    padded = pad(values, (reach, reach, reach, reach), mode="replicate")
    across = torch.nn.functional.conv2d(padded, kernel.reshape(1, 1, 1, -1))
    return torch.nn.functional.conv2d(across, kernel.reshape(1, 1, -1, 1))
