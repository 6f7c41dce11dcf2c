"""The order of the walk, from times, names or neighbourhood."""

from __future__ import annotations

import numpy as np

from pipelines.scene.capture_order import capture_order
from tests.unit.pipelines.scene.synthetic_views import arc


def test_order_is_by_time_then_by_natural_name() -> None:
    poses = arc(12)
    names = [f"{i}.jpg" for i in range(12)]
    backwards = [float(12 - i) for i in range(12)]
    assert capture_order(poses, names, backwards).tolist() == list(range(11, -1, -1))
    assert capture_order(poses, names, [None] * 12).tolist() == list(range(12))


def test_photos_named_at_random_are_ordered_by_neighbourhood() -> None:
    poses = arc(60)
    shuffled = np.random.default_rng(3).permutation(60)
    order = shuffled[capture_order(poses[shuffled], [f"{i}.jpg" for i in range(60)], [None] * 60)]
    assert order.tolist() in (list(range(60)), list(range(59, -1, -1)))


def test_of_the_views_of_a_panorama_the_first_is_in_the_order() -> None:
    """Else a flight along the capture would look four ways in turn."""
    poses = np.repeat(arc(12), 4, axis=0)
    names = [f"frame_{i:02d}_{view}.jpg" for i in range(12) for view in (1, 2, 3, 4)]
    times = [i / 10 for i in range(12) for _ in range(4)]
    assert capture_order(poses, names, times).tolist() == list(range(0, 48, 4))
    assert capture_order(poses, names, [None] * 48).tolist() == list(range(0, 48, 4))
