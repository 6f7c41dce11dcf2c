"""The COLMAP model, read back by COLMAP itself: from the binary files and from the text."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch

from pipelines.errors import ExportError
from pipelines.exports.formats.colmap import write_colmap
from pipelines.nerf.space.cameras import SceneTransform
from pipelines.scene.cameras_file import CamerasFile, Intrinsics
from pipelines.scene.trained_scene import nerf_cameras
from tests.unit.pipelines.exports.posed import FISHEYE, FULL, OPENCV, PINHOLE, posed


def read_back(cameras: CamerasFile, folder: Path, kind: str) -> pycolmap.Reconstruction:
    """What pycolmap reads when only the files of one kind are there."""
    write_colmap(folder / "colmap.zip", cameras)
    with zipfile.ZipFile(folder / "colmap.zip") as archive:
        for name in archive.namelist():
            if name.endswith(kind):
                archive.extract(name, folder)
    return pycolmap.Reconstruction(str(folder / "sparse" / "0"))


@pytest.mark.parametrize("kind", [".bin", ".txt"])
def test_poses_and_lenses_come_back_exactly(tmp_path: Path, kind: str) -> None:
    cameras = posed(PINHOLE, OPENCV, FISHEYE, FULL)
    model = read_back(cameras, tmp_path, kind)
    assert model.num_reg_images() == len(cameras.images)
    assert model.num_points3D() == 0
    by_name = {image.name: image for image in model.images.values()}
    for image in cameras.images:
        found = by_name[image.file.removeprefix("images/")]
        world_from_camera = np.linalg.inv(
            np.vstack((found.cam_from_world().matrix(), [0.0, 0.0, 0.0, 1.0]))
        )[:3]
        # COLMAP's +Y is down and +Z the gaze.
        ours = world_from_camera * np.array([1.0, -1.0, -1.0, 1.0])
        np.testing.assert_allclose(ours, image.world_from_camera, atol=1e-12)
        lens, camera = cameras.cameras[image.camera], found.camera
        assert (camera.width, camera.height) == (lens.width, lens.height)
        wanted = {
            PINHOLE: ("PINHOLE", ()),
            OPENCV: ("OPENCV", (lens.k1, lens.k2, lens.p1, lens.p2)),
            FISHEYE: ("OPENCV_FISHEYE", (lens.k1, lens.k2, lens.k3, lens.k4)),
            FULL: ("FULL_OPENCV", (lens.k1, lens.k2, lens.p1, lens.p2, lens.k3, 0.0, 0.0, 0.0)),
        }[lens]
        assert camera.model.name == wanted[0]
        assert tuple(camera.params) == (lens.fl_x, lens.fl_y, lens.cx, lens.cy, *wanted[1])


@pytest.mark.parametrize("lens", [PINHOLE, OPENCV, FISHEYE, FULL])
def test_colmap_sees_a_point_in_the_pixel_from_which_our_ray_goes_to_it(
    tmp_path: Path, lens: Intrinsics
) -> None:
    """Axes, pixel centres and distortion at once: our rays against COLMAP's projection."""
    cameras = posed(lens)
    model = read_back(cameras, tmp_path, ".bin")
    poses = [image.world_from_camera for image in cameras.images]
    ours = nerf_cameras([lens] * len(poses), poses, SceneTransform((0.0, 0.0, 0.0), 1.0))
    shares = torch.tensor([[0.3, 0.4], [0.5, 0.5], [0.7, 0.35]])
    pixels = shares * torch.tensor([lens.width, lens.height])
    by_name = {image.name: image for image in model.images.values()}
    for row, image in enumerate(cameras.images):
        rays = ours.generate_rays(torch.full((3,), row), pixels)
        points = (rays.origins + 2.5 * rays.directions).double().numpy()
        found = by_name[image.file.removeprefix("images/")]
        seen = [found.project_point(point) for point in points]
        np.testing.assert_allclose(seen, pixels.numpy(), atol=2e-3)


def test_the_same_cameras_give_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.zip", "b.zip"):
        write_colmap(tmp_path / name, posed(PINHOLE))
    assert (tmp_path / "a.zip").read_bytes() == (tmp_path / "b.zip").read_bytes()


def test_a_lens_that_colmap_has_no_model_for_is_refused(tmp_path: Path) -> None:
    eighth = Intrinsics(800, 600, 700.0, 690.0, 410.0, 290.0, "OPENCV", k4=0.01)
    with pytest.raises(ExportError, match="k4") as caught:
        write_colmap(tmp_path / "colmap.zip", posed(eighth))
    assert caught.value.code == "format_cannot_hold"
    assert not list(tmp_path.iterdir())
