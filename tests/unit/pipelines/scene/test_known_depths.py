"""Depth maps brought to another lens, and laid over a field's depth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipelines.nerf.stereo.maps import DepthMap
from pipelines.scene.depth_maps_file import DepthMapsWriter
from pipelines.scene.depth_views import DepthView, Pinhole
from pipelines.scene.known_depths import KnownDepths, resampled

SMALL = Pinhole(30, 20, 25.0, 25.0, 15.0, 10.0)
LARGE = Pinhole(75, 50, 62.5, 62.5, 37.5, 25.0)


def tilted_plane(lens: Pinhole) -> np.ndarray:
    """Depths of a plane that is not across the axis: inverse depth is linear in the picture."""
    directions = lens.directions()
    return (1.0 / (0.4 + 0.06 * directions[..., 0] - 0.03 * directions[..., 1])).astype(np.float32)


@pytest.mark.parametrize("lens", [LARGE, SMALL, Pinhole(15, 10, 12.5, 12.5, 7.5, 5.0)])
def test_a_plane_stays_a_plane_at_any_size(lens: Pinhole) -> None:
    found = resampled(tilted_plane(SMALL), SMALL, lens)
    inner = (slice(2, -2), slice(2, -2))
    np.testing.assert_allclose(found[inner], tilted_plane(lens)[inner], rtol=1e-5)
    assert (found > 0).all()


def test_nothing_is_made_up_between_two_surfaces_or_where_nothing_is_known() -> None:
    z = np.full((20, 30), 1.0, np.float32)
    z[:, 15:] = 2.0
    z[:5] = 0.0
    found = resampled(z, SMALL, LARGE)
    assert set(np.unique(found)) == {0.0, 1.0, 2.0}
    assert not found[:11].any()
    assert (found[14:, 40:] == 2.0).all()


def test_a_wider_lens_knows_nothing_beyond_the_map() -> None:
    wide = Pinhole(60, 40, 25.0, 25.0, 30.0, 20.0)
    found = resampled(tilted_plane(SMALL), SMALL, wide)
    known = found > 0
    assert known[10:30, 15:45].all()
    assert known.sum() == 20 * 30


def test_a_map_is_a_view_of_its_own_image(tmp_path: Path) -> None:
    z = tilted_plane(SMALL)
    z[8:12] = 0.0
    writer = DepthMapsWriter(tmp_path)
    nothing = DepthMap(np.zeros_like(z), np.zeros(z.shape, np.uint8))
    writer.append("other.jpg", SMALL, nothing)
    writer.append("a.jpg", SMALL, DepthMap(z, np.full(z.shape, 3, np.uint8)))
    writer.close()
    rgb = np.zeros((20, 30, 3), np.uint8)
    view = DepthView(SMALL, np.eye(4)[:3], rgb, np.full((20, 30), 5.0, np.float32))
    known = KnownDepths(tmp_path)
    found = known.view_of("a.jpg", view)
    assert found is not None
    np.testing.assert_allclose(found.z_depth, z, rtol=1e-3)
    assert found.rgb is view.rgb
    assert known.view_of("held_out.jpg", view) is None
    assert known.view_of("other.jpg", view) is None, "a view that shows nothing"


def test_maps_keep_half_a_thousandth_in_files_at_any_scale(tmp_path: Path) -> None:
    for scale in (1e-6, 1.0, 1e6):
        writer = DepthMapsWriter(tmp_path)
        z = (tilted_plane(SMALL) * scale).astype(np.float32)
        z[0, 0] = 0.0
        writer.append("a.jpg", SMALL, DepthMap(z, np.ones(z.shape, np.uint8)))
        writer.close()
        rgb = np.zeros((20, 30, 3), np.uint8)
        view = DepthView(SMALL, np.eye(4)[:3], rgb, np.zeros((20, 30), np.float32))
        found = KnownDepths(tmp_path).view_of("a.jpg", view)
        assert found is not None
        assert found.z_depth[0, 0] == 0.0
        np.testing.assert_allclose(found.z_depth[1:], z[1:], rtol=1e-3)
