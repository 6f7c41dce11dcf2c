"""Depth maps in files: read back as they were written, but for what no file can hold."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from pipelines.nerf.stereo.maps import DepthMap
from pipelines.scene.depth_maps_file import DepthMapsFile, DepthMapsWriter
from pipelines.scene.depth_views import Pinhole

LENS = Pinhole(8, 6, 7.0, 7.0, 4.0, 3.0)


def kept(folder: Path, z: np.ndarray) -> np.ndarray:
    writer = DepthMapsWriter(folder)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        writer.append("a.jpg", LENS, DepthMap(z.astype(np.float32), np.ones(z.shape, np.uint8)))
    writer.close()
    return DepthMapsFile(folder).read(0).z


def test_depth_comes_back_within_half_a_thousandth_in_any_unit(tmp_path: Path) -> None:
    z = np.random.default_rng(1).uniform(0.3, 40.0, (6, 8))
    z[0, :3] = 0.0
    for unit in (1e-6, 1.0, 1e6):
        np.testing.assert_allclose(kept(tmp_path / str(unit), unit * z), unit * z, rtol=5e-4)


def test_what_is_ten_thousand_times_as_far_as_the_rest_is_unknown_and_never_infinite(
    tmp_path: Path,
) -> None:
    """A floor that is laid up to its horizon: a film of a roof before a plain had such pixels."""
    z = np.full((6, 8), 3.0)
    z[0] = [9e3, 2.9e4, 3.1e4, 3e5, 3e9, np.inf, np.nan, 3.0]
    found = kept(tmp_path, z)
    assert np.isfinite(found).all()
    assert list(found[0] > 0.0) == [True, True, False, False, False, False, False, True]
    np.testing.assert_allclose(found[1:], 3.0, rtol=5e-4)
    z[:5] = np.inf
    found = kept(tmp_path / "mostly", z)
    assert (found[:5] == 0.0).all()
    np.testing.assert_allclose(found[5:], 3.0, rtol=5e-4)
