"""The subject sought beforehand, on a coarse surface: for exports that are to hold it alone.

The rule (`pipelines.exports.subject`) wants a surface, and what is made within the thing's region
wants the region first. So small views of the trained scene are fused once, the same for every kind
of export, whatever its extent and size: a mesh and a cloud of one job find the same thing in the
same place.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from pipelines.exports.subject import Decision, find_subject
from pipelines.exports.subject_files import gaze_of
from pipelines.exports.surface.shells import Subject, find_shells, fuse_shells
from pipelines.exports.surface.views import render_views
from pipelines.scene.depth_views import Pinhole

if TYPE_CHECKING:
    from collections.abc import Sequence

    from pipelines.scene.depth_views import DepthView
    from pipelines.scene.known_depths import KnownDepths
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


def search_subject(
    scene: TrainedScene,
    probes: Sequence[DepthView],
    known: KnownDepths | None,
    ctx: StageContext,
    insist: bool = False,
) -> Decision:
    """Whether somebody walked round a thing, and where it is.

    probes: `scene.probe_views()`. known: maps that vote beside the field. insist: to look for what
    stands where the cameras look also where nobody walked round anything.
    """
    images = scene.training_images(_NUM_VIEWS)
    lenses = [Pinhole.of(scene.lens_of(image), _LONG_SIDE_PX) for image in images]
    shells = find_shells(
        lambda distance: scene.bounds(distance, ctx.check_cancelled, probes),
        _NEAR,
        _FAR,
        _RESOLUTION,
        Subject(_FINE, max(1.0 / lens.fl_x for lens in lenses), probes),
    )
    if not shells:
        return Decision("scene", "The views show no surface.")
    rendered = _RENDERED * SEARCH_SHARE
    with tempfile.TemporaryDirectory(dir=ctx.out, prefix=".search-") as folder:
        words = "looking for the subject, view"
        store = render_views(
            scene, images, lenses, Path(folder), ctx, (0.0, rendered), known, words
        )
        mesh = fuse_shells(
            store,
            shells,
            _MAX_FACES,
            lambda done: ctx.progress(
                rendered + (SEARCH_SHARE - rendered) * done, "looking for the subject", None
            ),
        )
    if len(mesh.faces) == 0:
        return Decision("scene", "The views agree on no surface.")
    shown = scene.training_images()
    bounds = shells[0].bounds
    return find_subject(
        mesh.vertices,
        mesh.faces,
        gaze_of(shown, [scene.lens_of(image) for image in shown]),
        (bounds.focus, bounds.distance) if insist else None,
    )
