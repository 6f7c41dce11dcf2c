"""Pictures of one size, reduced, all at once: what they have in common is seen in these."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import PIL.Image
from numpy.typing import NDArray

from pipelines.stage import StageContext


def load_small(
    files: Sequence[Path], long_side_px: int, mode: Literal["L", "RGB"], ctx: StageContext
) -> NDArray[np.uint8]:
    """Pictures [N, h, w] or [N, h, w, 3] with at most that long side. Raises Cancelled."""
    return np.stack([small(file, long_side_px, mode, ctx) for file in files])


def small(
    file: Path, long_side_px: int, mode: Literal["L", "RGB"], ctx: StageContext
) -> NDArray[np.uint8]:
    """One of them, [h, w] or [h, w, 3]. Raises Cancelled."""
    ctx.check_cancelled()
    with PIL.Image.open(file) as opened:
        scale = min(1.0, long_side_px / max(opened.size))
        size = (max(1, round(opened.width * scale)), max(1, round(opened.height * scale)))
        opened.draft(mode, size)  # a JPEG is then decoded no finer than it is needed
        return np.asarray(opened.convert(mode).resize(size, PIL.Image.Resampling.BOX))
