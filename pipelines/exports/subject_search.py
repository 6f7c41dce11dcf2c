"""What was filmed, decided once for an export and in one way for all of them.

The rule (`pipelines.exports.subject`) wants a surface, and who makes what is within the thing's
region wants the region first. So a coarse surface is fused of a few small views, of the trained
scene or, before there is one, of depth maps. It depends on these and on the cameras alone, not on
what an export is asked for: neither on its kind, extent, size and rendering, nor on the maps that
vote in it. A mesh and a cloud of one job are of the same thing, at once and months later.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipelines.exports.subject import Decision, find_subject
from pipelines.exports.surface.shells import Subject, find_shells, fuse_shells
from pipelines.exports.surface.views import known_depths, render_views
from pipelines.scene.bounds import bounds_of_views
from pipelines.scene.depth_views import Pinhole
from pipelines.scene.gaze import Gaze, gaze_of, told_by_cameras

if TYPE_CHECKING:
    from pipelines.scene.depth_views import DepthView, ViewStore
    from pipelines.scene.trained_scene import TrainedScene
    from pipelines.stage import StageContext

SEARCH_SHARE = 0.1
"""Of an export's progress, where it searches before anything else."""
_NUM_VIEWS, _LONG_SIDE_PX = 32, 128
_NEAR, _FAR, _FINE = 2.0, 18.0, 1.0
"""How far shells reach, in the cameras' mean distances to what they look at."""
_RESOLUTION = 128
"""Voxels within 2 distances: around the focus, where they are half as large, a distance has 64 of
them, and the rule's cells are a fortieth."""
_MAX_FACES = 50_000
_RENDERED = 0.8


def look_at_one_place(scene: TrainedScene) -> bool:
    """Whether the cameras look at one place, from wherever, by the cameras alone."""
    return told_by_cameras(_gaze(scene)).at_one_place


def search_subject(
    scene: TrainedScene, probes: Sequence[DepthView], ctx: StageContext, insist: bool = False
) -> Decision:
    """Whether somebody walked round a thing, and where it is.

    probes: `scene.probe_views()`. insist: to look for what stands where the cameras look also where
    nobody walked round anything; what was filmed is decided as without it.
    """
    gaze = _gaze(scene)
    told = told_by_cameras(gaze)
    if told.why is not None and not insist:
        return Decision("scene", told.why, told.measures)
    plain = scene.by_default()
    if plain is not scene:
        probes = plain.probe_views(ctx.check_cancelled)
    images = plain.training_images(_NUM_VIEWS)
    lenses = [Pinhole.of(plain.lens_of(image), _LONG_SIDE_PX) for image in images]
    known = known_depths(ctx.workspace, "auto")
    rendered = _RENDERED * SEARCH_SHARE
    with tempfile.TemporaryDirectory(dir=ctx.out, prefix=".search-") as folder:
        words = "looking for the subject, view"
        store = render_views(
            plain, images, lenses, Path(folder), ctx, (0.0, rendered), known, words
        )
        return decide_on(
            store,
            probes,
            gaze,
            lambda done: ctx.progress(
                rendered + (SEARCH_SHARE - rendered) * done, "looking for the subject", None
            ),
            insist,
        )


def _gaze(scene: TrainedScene) -> Gaze:
    shown = scene.training_images()
    return gaze_of(shown, [scene.lens_of(image) for image in shown])


def decide_on(
    views: ViewStore,
    probes: Sequence[DepthView],
    gaze: Gaze,
    on_progress: Callable[[float], None],
    insist: bool,
) -> Decision:
    """The same by views that are there: of a trained scene, or depth maps.

    probes: some of them, or smaller ones. gaze: all cameras. on_progress: told the share that is
    done; may raise.
    """
    pixel = max(1.0 / view.lens.fl_x for view in views)
    shells = find_shells(
        lambda distance: bounds_of_views(probes, np.asarray(gaze.poses), distance),
        _NEAR,
        _FAR,
        _RESOLUTION,
        Subject(_FINE, pixel, probes),
    )
    if not shells:
        return Decision("scene", "The views show no surface.")
    mesh = fuse_shells(views, shells, _MAX_FACES, on_progress)
    if len(mesh.faces) == 0:
        return Decision("scene", "The views agree on no surface.")
    bounds = shells[0].bounds
    fallback = (bounds.focus, bounds.distance) if insist else None
    return find_subject(mesh.vertices, mesh.faces, gaze, fallback)
