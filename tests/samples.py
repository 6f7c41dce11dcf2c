"""The sample capture as the tests use it, and options below `preview` for whole jobs.

The thresholds that go with `SMALL` are those of the tests: lower than the product's, high enough
that a broken stage misses them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pipelines.sample.film import film_capture

SMALL: dict[str, Any] = {
    "frames": {"num_frames": 32, "long_side_px": 480},
    "poses": {"max_image_px": 480, "num_features": 2048},
    "depth": {"long_side_px": 160, "num_planes": 64},
    "train": {
        "max_steps": 400,
        "rays_per_step": 512,
        "data": {"long_side_px": 240},
        "checkpoint_seconds": 5.0,
        "model": {
            "num_proposal_samples": [32, 24],
            "num_nerf_samples": 16,
            "grid": {"log2_table_size": 15, "max_res": 256},
        },
    },
    "pointcloud": {"num_points": 20_000},
    "mesh": {
        "resolution": 96,
        "num_views": 16,
        "render_long_side_px": 128,
        "texture_px": 512,
    },
    "video": {"num_frames": 16, "long_side_px": 160},
}

PLAIN: dict[str, Any] = {
    "draft": {"texture": "none", "resolution": 64, "num_views": 12},
    "evaluate": {"floaters": False},
    "mesh": {
        "resolution": 64,
        "num_views": 12,
        "render_long_side_px": 96,
        "texture": "none",
        "refine": "none",
    },
    "video": {"num_frames": 8, "long_side_px": 96},
}
"""For whole jobs of tests that look at no mesh and no video."""


def sample_clip(folder: Path) -> tuple[Path, Path]:
    """Film the analytic scene, small; its frames are twice as many as `SMALL` keeps, and larger.

    Returns the clip and its true cameras (cameras.json).
    """
    clip, truth = folder / "sample.mp4", folder / "truth.json"
    film_capture(clip, num_frames=64, long_side_px=560).save(truth)
    return clip, truth
