"""Points that views look through, and points that no view can judge."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.scene import consistency
from pipelines.scene.consistency import consistent
from pipelines.scene.depth_views import DepthView, Pinhole
from tests.unit.pipelines.scene.synthetic_views import ring, sphere_view

CENTER = np.array([20.0, 5.0, -3.0])
LENS = Pinhole(80, 60, 75.0, 75.0, 40.0, 30.0)


def test_points_that_views_look_through_are_dropped() -> None:
    views = [sphere_view(LENS, pose, CENTER) for pose in ring(24, CENTER)]
    surface = np.concatenate([v.points()[v.smooth_mask()] for v in views])
    floating = CENTER + np.array([[0.0, 0.0, 1.25], [1.25, 0.0, 0.0]])
    both = np.concatenate((surface, floating, CENTER[None]))
    # The sphere's surroundings must be known for a view to look through them.
    known = [
        DepthView(v.lens, v.world_from_camera, v.rgb, np.where(v.z_depth > 0, v.z_depth, 9.0))
        for v in views
    ]
    fine = consistent(both, known)
    assert not fine[len(surface) : len(surface) + 2].any()
    assert fine[-1], "what no view can see is not contradicted"
    assert fine[: len(surface)].mean() > 0.9


def test_several_threads_say_what_one_does(monkeypatch: pytest.MonkeyPatch) -> None:
    """Verdicts of all views are counted, in whatever order they come."""
    rng = np.random.default_rng(2)
    views = [sphere_view(LENS, pose, CENTER) for pose in ring(24, CENTER)]
    points = np.concatenate(
        [CENTER + rng.normal(0.0, 0.7, (4000, 3)), *(v.points()[v.smooth_mask()] for v in views)]
    )
    answers = []
    for threads in (1, 2, 5):
        monkeypatch.setattr(consistency, "_MOST_THREADS", threads)
        answers.append(consistent(points, views))
    assert 0.0 < answers[0].mean() < 1.0
    assert all(np.array_equal(answers[0], other) for other in answers[1:])
