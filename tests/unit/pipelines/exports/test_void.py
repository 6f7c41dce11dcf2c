"""What exports leave out because photos show that nothing stands there."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.exports.void import void_of_photos
from pipelines.nerf.stereo.maps import VOID, DepthMap
from pipelines.scene.depth_maps_file import DepthMapsWriter
from pipelines.scene.depth_views import Pinhole
from pipelines.workspace import MANIFEST, Workspace

LENS = Pinhole(4, 5, 5.0, 5.0, 2.0, 2.5)


def mapped(root: Path, told: dict[str, Any]) -> Workspace:
    """A capture of two photos, above in which nothing stands."""
    workspace = Workspace(root)
    folder = workspace.stage("depth")
    z, votes = np.full((5, 4), 2.0, np.float32), np.full((5, 4), 3, np.uint8)
    z[:2], votes[0] = 0.0, VOID  # but for its rim, of which nothing is known
    writer = DepthMapsWriter(folder)
    for number in range(2):
        writer.append(f"images/{number}.jpg", LENS, DepthMap(z, votes))
    writer.close()
    (folder / MANIFEST).write_text(json.dumps({"summary": told}), "utf-8")
    return workspace


@pytest.mark.parametrize("kind", ["sky", "blank"])
def test_the_sky_and_a_blank_ground_are_left_out(tmp_path: Path, kind: str) -> None:
    found = list(void_of_photos(mapped(tmp_path, {kind: {"share": 0.3}})))
    assert [one.file for one in found] == ["images/0.jpg", "images/1.jpg"]
    assert all(one.lens == LENS for one in found)
    assert all(one.is_void[:2].all() and not one.is_void[2:].any() for one in found)


@pytest.mark.parametrize(
    "told", [{}, {"sky": {"share": 0.0}}, {"dark": {"share": 0.4}, "sky": {"share": 0.0}}]
)
def test_nothing_is_left_out_of_others_nor_before_the_dark(
    tmp_path: Path, told: dict[str, Any]
) -> None:
    """What is dark may be something that nobody saw lit."""
    assert list(void_of_photos(mapped(tmp_path, told))) == []


def test_a_job_without_depth_leaves_nothing_out(tmp_path: Path) -> None:
    assert list(void_of_photos(Workspace(tmp_path))) == []
