"""How well what is delivered looks: views of the mesh or the cloud against photos.

PSNR of a radiance field says nothing of surfaces: colours that depend on the direction alone paint
a plain wall perfectly and leave no wall. These measures do: what is not there is a hole, counted.

Symbols: H x W pixels; `valid` is where the photo may be compared, all of it without a mask.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pipelines.judging.asset_views import AssetView
from pipelines.nerf.errors import NerfError
from pipelines.nerf.judging.metrics import psnr, ssim

MAX_PSNR = 100.0
HOLE = 0.5
"""The grey that stands for nothing where holes count."""
MEASURES = {"coverage": 4, "psnr": 4, "ssim": 5, "psnr_with_holes": 4}
"""What is measured, and the decimals kept."""
DEFINITIONS = (
    "coverage: share of usable pixels where there is something; the sky, the dark and the blank "
    "ground of cut-out pictures are not usable. psnr, ssim: on those pixels, against the photo; "
    "ssim with an 11x11 Gaussian window, sigma 1.5, around covered pixels, holes within the "
    "window showing the photo. "
    "psnr_with_holes: on all usable pixels, holes mid grey. "
    "Means over views; a view without a covered pixel has no psnr and no ssim."
)


def score_view(
    view: AssetView, photo: NDArray[np.float32], valid: NDArray[np.bool_] | None = None
) -> dict[str, float | None]:
    """The measures of one view; None for what cannot be measured.

    photo: [H, W, 3] in [0, 1]. valid: [H, W]. Raises ValueError where shapes differ or no pixel is
    usable.
    """
    if view.color.shape != photo.shape or (valid is not None and valid.shape != photo.shape[:2]):
        raise ValueError(f"a view of {view.color.shape} cannot be compared with {photo.shape}")
    usable = np.ones(photo.shape[:2], np.bool_) if valid is None else valid
    if not usable.any():
        raise ValueError("no pixel is usable: the mask leaves nothing to compare")
    covered = view.hit & usable
    truth = torch.from_numpy(np.ascontiguousarray(photo))
    shown = np.where(view.hit[..., None], view.color, photo).astype(np.float32)
    holed = np.where(view.hit[..., None], view.color, np.float32(HOLE)).astype(np.float32)
    part = torch.from_numpy(covered)
    found: dict[str, float | None] = {
        "coverage": float(covered.sum() / usable.sum()),
        "psnr": None,
        "ssim": None,
        "psnr_with_holes": min(
            psnr(torch.from_numpy(holed), truth, torch.from_numpy(usable)), MAX_PSNR
        ),
    }
    if covered.any():
        found["psnr"] = min(psnr(torch.from_numpy(shown), truth, part), MAX_PSNR)
        try:
            found["ssim"] = ssim(torch.from_numpy(shown), truth, part)
        except NerfError:  # a picture smaller than its window, or covered at its border alone
            found["ssim"] = None
    return rounded(found)


def rounded(values: dict[str, float | None]) -> dict[str, float | None]:
    """With the decimals of `MEASURES`."""
    return {
        name: None if value is None else round(value, MEASURES[name])
        for name, value in values.items()
    }


def mean_scores(rows: Sequence[dict[str, Any]]) -> dict[str, float | None]:
    """Means over views, each over those that have the value; None where none has."""
    means: dict[str, float | None] = {}
    for name in MEASURES:
        values = [row[name] for row in rows if row.get(name) is not None]
        means[name] = float(np.mean(values)) if values else None
    return rounded(means)


def picture_of(view: AssetView, photo: NDArray[np.float32]) -> NDArray[np.uint8]:
    """[H, 3 W, 3] uint8: photo | asset, holes magenta | holes alone, white."""
    shown = np.where(view.hit[..., None], view.color, np.array([1.0, 0.0, 1.0], np.float32))
    holes = np.repeat((~view.hit)[..., None], 3, axis=2).astype(np.float32)
    strip = np.concatenate([photo, shown, holes], axis=1)
    picture: NDArray[np.uint8] = np.rint(255.0 * np.clip(strip, 0.0, 1.0)).astype(np.uint8)
    return picture
