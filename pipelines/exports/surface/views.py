"""Depth views of a trained scene for what is made from them: from which cameras, how large."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from pipelines.scene.bounds import SceneBounds
from pipelines.scene.cameras_file import Intrinsics, PosedImage
from pipelines.scene.depth_views import DepthView, Pinhole, ViewStore
from pipelines.scene.known_depths import KnownDepths
from pipelines.scene.stereo_views import unhidden
from pipelines.scene.trained_scene import TrainedScene
from pipelines.stage import StageContext
from pipelines.workspace import Workspace

_MIN_LONG_SIDE, _MAX_LONG_SIDE = 64, 4096
_OVERSAMPLING = 1.5
_MIN_VALID_SHARE = 0.05


def pixels_for_points(
    num_points: int, num_views: int, probes: Sequence[DepthView], bounds: SceneBounds
) -> float:
    """How many pixels each view needs for so many points in all, and some to choose from.

    probes: small views of the same scene, whose share of valid pixels is taken for all.
    """
    valid_share = float(np.mean([bounds.mask(view).mean() for view in probes]))
    return _OVERSAMPLING * num_points / max(valid_share, _MIN_VALID_SHARE) / num_views


def lens_of_pixels(lens: Intrinsics, pixels: float) -> Pinhole:
    """The undistorted lens, at the size that has so many pixels, within reason."""
    long_side = math.sqrt(pixels * max(lens.width, lens.height) / min(lens.width, lens.height))
    return Pinhole.of(lens, math.ceil(min(max(long_side, _MIN_LONG_SIDE), _MAX_LONG_SIDE)))


def render_views(
    scene: TrainedScene,
    images: Sequence[PosedImage],
    lenses: Sequence[Pinhole],
    folder: Path,
    ctx: StageContext,
    shares: tuple[float, float],
    known: KnownDepths | None = None,
    words: str = "view",
) -> ViewStore:
    """Depth views from the images' poses, each through its lens, in a store on disk. Nothing is
    known where an image's mask hides what was there: the field learnt nothing there from it.

    folder: for the store. shares: of the export's progress, before and after. known: the capture's
    own maps; what they say of an image is a view of its own beside the field's, with a vote of its
    own. words: what progress calls a view.
    """
    store = ViewStore(folder)
    begin, end = shares
    root = ctx.workspace.images_root
    started = time.monotonic()
    for done, (image, lens) in enumerate(zip(images, lenses, strict=True), start=1):
        view = scene.depth_view(lens, np.asarray(image.world_from_camera, np.float64))
        shown = unhidden(root, image, scene.lens_of(image), lens)
        if shown is not None:
            view = replace(view, z_depth=np.where(shown, view.z_depth, np.float32(0.0)))
        store.append(view)
        told = None if known is None else known.view_of(image.file, view)
        if told is not None:
            store.append(told)
        eta = (time.monotonic() - started) / done * (len(images) - done)
        made = begin + (end - begin) * done / len(images)
        ctx.progress(made, f"{words} {done}/{len(images)}", eta)
    return store


def known_depths(workspace: Workspace, wanted: str) -> KnownDepths | None:
    """The maps of the stage `depth`, where it ran and they are wanted: "auto", "on" or "off"."""
    if wanted == "off" or not workspace.is_complete("depth"):
        return None
    known = KnownDepths(workspace.stage("depth"))
    return known if wanted == "on" or known.measured or known.few else None
