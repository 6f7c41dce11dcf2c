"""The frame `source` of captures of real formats: the world in which their files give the poses."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pipelines.exports.placement import placement_of
from tests.capture_writers import arkit_pose
from tests.unit.pipelines.captures.archives import (
    nerfstudio_files,
    polycam_files,
    record3d_files,
    scanner_app_files,
)
from tests.unit.pipelines.captures.ingesting import cameras, ingest

Files = dict[str, bytes | str]


@pytest.mark.parametrize("files", [polycam_files, record3d_files, scanner_app_files])
def test_of_an_app_it_is_arkits_world_y_up(tmp_path: Path, files: Callable[[], Files]) -> None:
    _, ctx = ingest(tmp_path, files())
    here = cameras(ctx)
    place = placement_of("source", here)
    for image, moved in zip(here.images, place.cameras(here).images, strict=True):
        wanted = arkit_pose(np.array(image.world_from_camera))
        np.testing.assert_allclose(moved.world_from_camera, wanted[:3], atol=1e-12)
    assert place.metric
    up = place.directions(np.array([[0.0, 0.0, 1.0]]))
    np.testing.assert_allclose(up, [[0.0, 1.0, 0.0]], atol=1e-12)


def test_of_nerfstudios_layout_it_is_what_the_file_was_made_from(tmp_path: Path) -> None:
    turn = [[1.0, 0.0, 0.0, 5.0], [0.0, 0.0, -1.0, 6.0], [0.0, 1.0, 0.0, 7.0]]
    _, ctx = ingest(tmp_path, nerfstudio_files(applied_transform=turn, applied_scale=2.0))
    here = cameras(ctx)
    own = placement_of("source", here).cameras(here)
    matrix = np.array(turn)
    for image, source in zip(here.images, own.images, strict=True):
        center = np.array(source.world_from_camera)[:, 3]
        wanted = 2.0 * (matrix[:, :3] @ center + matrix[:, 3])
        np.testing.assert_allclose(np.array(image.world_from_camera)[:, 3], wanted, atol=1e-9)
