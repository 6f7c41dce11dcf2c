"""Settings of COLMAP's features, pairs and mapping, and pycolmap's options of them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import pycolmap

_SIFT_BYTES_PER_PX = 85
"""Measured: 75 to 87 per pixel, at 960 to 1,920 px, doubled or not, with one and two threads."""
_QUICK_GROWTH = 1.4
"""The model is adjusted as a whole each time it has grown by this factor; COLMAP's default 1.1
costs twice the time and ends at the same errors, since the last adjustment is of all."""
_ANY_OVERLAP = 1_000_000
_QUICK_TRIALS = 1000
"""Random samples of matches at most. COLMAP's 10,000 go to pairs that then fail all the same."""


@dataclass(frozen=True)
class CameraGroup:
    """Images, by index, that share one lens.

    lens: COLMAP's camera model. focal_px: known beforehand, or None; COLMAP then starts from it,
    and verifies pairs of images by a calibrated geometry.
    """

    indices: tuple[int, ...]
    lens: str
    focal_px: float | None = None


@dataclass(frozen=True)
class FeatureSettings:
    """Which SIFT features are found.

    max_image_px: long side at which they are found; positions are of the full image. num_features:
    most per image, the coarsest first. upsample: double the image before, which finds two to four
    times as many and places them a little better, for three times the work. num_threads: images
    worked on at a time, -1 for one per processor (see `extraction_threads`).
    """

    max_image_px: int
    num_features: int
    upsample: bool = True
    num_threads: int = -1


@dataclass(frozen=True)
class Thresholds:
    """What incremental mapping demands before it believes; the defaults are COLMAP's.

    min_num_matches: verified matches for a pair to count. init_*: of the pair that a model starts
    from. pose_*: of the points by which an image is placed.
    """

    min_num_matches: int = 15
    init_min_angle_deg: float = 16.0
    init_min_num_inliers: int = 100
    pose_min_num_inliers: int = 30
    pose_min_inlier_ratio: float = 0.25


@dataclass(frozen=True)
class MapperSettings:
    """How incremental mapping goes about it.

    thorough: bundle adjustment as often as COLMAP does by default, instead of after each growth by
    40 %, and models that overlap others as far as they lead. refine_distortion: False holds lenses
    as they start, without any. thresholds: lower ones are for captures that COLMAP's fail on.
    """

    refine_focal: bool = True
    refine_distortion: bool = True
    refine_principal_point: bool = False
    thorough: bool = False
    thresholds: Thresholds = field(default_factory=Thresholds)


def extraction_threads(settings: FeatureSettings, memory_mb: int, num_processors: int) -> int:
    """How many images SIFT may work on at a time within `memory_mb` (10^6 bytes), at least one.

    A thread holds the finest octave of the scale space, its differences and gradients:
    _SIFT_BYTES_PER_PX for each pixel of the image that it starts from, taken as 4:3.
    """
    wanted = num_processors if settings.num_threads < 0 else max(settings.num_threads, 1)
    side = settings.max_image_px * (2 if settings.upsample else 1)
    each = _SIFT_BYTES_PER_PX * side * side * 3 // 4
    return max(1, min(wanted, memory_mb * 1_000_000 // each))


def extraction_options(settings: FeatureSettings) -> Any:
    """pycolmap's options of finding features."""
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = settings.max_image_px
    options.num_threads = settings.num_threads
    options.sift.max_num_features = settings.num_features
    options.sift.first_octave = -1 if settings.upsample else 0
    return options


def verification_options(seed: int, *, thorough: bool) -> Any:
    """pycolmap's options of verifying pairs."""
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = seed
    if not thorough:
        options.ransac.min_num_trials = 30
        options.ransac.max_num_trials = _QUICK_TRIALS
        options.ransac.dyn_num_trials_multiplier = 1.0
    return options


def mapping_options(settings: MapperSettings, num_threads: int, seed: int) -> Any:
    """pycolmap's options of incremental mapping."""
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = num_threads
    options.random_seed = seed
    options.min_model_size = 3
    options.max_num_models = 10
    options.ba_refine_focal_length = settings.refine_focal
    options.mapper.abs_pose_refine_focal_length = settings.refine_focal
    options.ba_refine_extra_params = settings.refine_distortion
    options.mapper.abs_pose_refine_extra_params = settings.refine_distortion
    options.ba_refine_principal_point = settings.refine_principal_point
    if settings.thorough:
        # A later model may lead over an earlier one, and on: COLMAP ends it at 20 images of that.
        options.max_model_overlap = _ANY_OVERLAP
    else:
        options.ba_global_frames_ratio = options.ba_global_points_ratio = _QUICK_GROWTH
        options.ba_global_max_refinements = 2
        options.ba_local_max_refinements = 1
    wanted = settings.thresholds
    options.min_num_matches = wanted.min_num_matches
    options.mapper.init_min_tri_angle = wanted.init_min_angle_deg
    options.mapper.init_min_num_inliers = wanted.init_min_num_inliers
    options.mapper.abs_pose_min_num_inliers = wanted.pose_min_num_inliers
    options.mapper.abs_pose_min_inlier_ratio = wanted.pose_min_inlier_ratio
    return options
