"""Poses whose rotations carry a scale, or mirror: what is divided out, and what is told."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.unit.pipelines.captures.archives import nerfstudio_files, pose
from tests.unit.pipelines.captures.ingesting import cameras, failure, ingest, warning_with


def frames_with(rotations: list[np.ndarray]) -> list[dict[str, Any]]:
    """A frame each, turned by [3, 3] times what `pose` has."""
    frames = []
    for number, rotation in enumerate(rotations):
        matrix = np.array(pose(float(number)))
        matrix[:3, :3] = matrix[:3, :3] @ rotation
        frames.append({"file_path": f"images/{number}.jpg", "transform_matrix": matrix.tolist()})
    return frames


@pytest.mark.parametrize("scale", [1.7, 0.02, 300.0])
def test_a_scale_that_all_rotations_share_is_divided_out(tmp_path: Path, scale: float) -> None:
    frames = frames_with([scale * np.eye(3)] * 4)
    summary, ctx = ingest(tmp_path, nerfstudio_files(4, frames=frames))
    plain, other = ingest(tmp_path / "plain", nerfstudio_files(4))
    found, expected = (
        np.array([image.world_from_camera for image in cameras(one).images]) for one in (ctx, other)
    )
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert f"{scale:.4g} times" in warning_with(summary, "divided out")
    assert not any("divided out" in told for told in plain["warnings"])


def test_scales_that_differ_are_no_scale_of_the_whole(tmp_path: Path) -> None:
    frames = frames_with([scale * np.eye(3) for scale in (0.3, 1.7, 0.6, 2.9)])
    assert "no rotation" in failure(tmp_path, nerfstudio_files(4, frames=frames)).message


def test_one_pose_of_another_scale_is_left_out_by_name(tmp_path: Path) -> None:
    frames = frames_with([1.7 * np.eye(3)] * 19 + [np.eye(3)])
    summary, ctx = ingest(tmp_path, nerfstudio_files(20, frames=frames))
    assert len(cameras(ctx).images) == 19
    assert "19.jpg" in warning_with(summary, "no rotation")


def test_left_handed_axes_are_told_as_such(tmp_path: Path) -> None:
    frames = frames_with([np.diag([1.0, 1.0, -1.0])] * 4)
    error = failure(tmp_path, nerfstudio_files(4, frames=frames))
    assert error.code == "poses_malformed"
    assert "left-handed axes" in error.message
    assert "right-handed" in error.hint
    assert "pictures alone" in error.hint
