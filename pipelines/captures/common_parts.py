"""What all pictures of a size have in common is none of the scene: black rims, and what was laid
over them. It is masked."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from pipelines.captures.burned_in import find_burned_in
from pipelines.captures.pictures import Picture
from pipelines.captures.rims import common_rim
from pipelines.stage import StageContext

Bools = NDArray[np.bool_]

_BESIDE = 0.015
"""Of the longer side: so far what is burned in may be found beyond a rim that it is."""


@dataclass(frozen=True)
class CommonParts:
    """Masks by the picture's file, below the stage's folder as that is; how many pictures have a
    rim, and something laid over them, `shares` of each size."""

    masks: dict[str, str]
    num_rims: int
    num_burned_in: int
    shares: tuple[float, ...]

    def details(self) -> dict[str, Any]:
        """For the report; nothing where there is nothing."""
        counts = {"num_rims": self.num_rims, "num_burned_in": self.num_burned_in}
        return {name: count for name, count in counts.items() if count}

    def warnings(self) -> list[str]:
        """What the sender should know."""
        return [burned_in_warning(share) for share in self.shares]


def mask_common_parts(out: Path, pictures: Sequence[Picture], ctx: StageContext) -> CommonParts:
    """Masks written for what pictures of one size have in common. Raises Cancelled.

    pictures: in order, as written below `out`, without masks of their own.
    """
    sizes: dict[tuple[int, int], list[Picture]] = defaultdict(list)
    for picture in pictures:
        sizes[picture.width, picture.height].append(picture)
    masks: dict[str, str] = {}
    num_rims = num_burned_in = 0
    shares = []
    for alike in sizes.values():
        files = [out / picture.file for picture in alike]
        rim, burned_in = common_rim(files, ctx), find_burned_in(files, ctx)
        ignored = np.zeros((alike[0].height, alike[0].width), np.bool_)
        if rim is not None:
            num_rims += len(alike)
            ignored |= rim
        if burned_in is not None and not _is_within(burned_in.mask, rim):
            num_burned_in += len(alike)
            shares.append(burned_in.share)
            ignored |= burned_in.mask
        if ignored.any():
            for picture in alike:
                masks[picture.file] = write_mask(out, picture.file, ignored)
    return CommonParts(masks, num_rims, num_burned_in, tuple(shares))


def _is_within(mask: Bools, rim: Bools | None) -> bool:
    """Whether a mask [H, W] is the rim, or hardly more: both tell of what is black there."""
    if rim is None:
        return False
    grown = binary_dilation(rim, iterations=math.ceil(_BESIDE * max(rim.shape)))
    return not (mask & ~grown).any()


def write_mask(out: Path, file: str, ignored: Bools) -> str:
    """Write what is to be ignored [H, W] of the picture `file`; both lie below `out`."""
    mask = f"masks/{Path(file).stem}.png"
    (out / "masks").mkdir(exist_ok=True)
    PIL.Image.fromarray(np.where(ignored, np.uint8(0), np.uint8(255))).save(out / mask)
    return mask


def burned_in_warning(share: float, where: str = "") -> str:
    """What the sender should know of what lies over that share of pictures."""
    return (
        f"Something lies over all pictures{where} in one place, as a date, a logo or buttons do: "
        f"{max(share, 0.001):.1%} of them, which are ignored."
    )
