"""Cameras as pyramids: where they stand, where they look, which way is up."""

from __future__ import annotations

import dataclasses

import numpy as np

from pipelines.exports.surface.frusta import camera_frusta
from tests.unit.pipelines.exports.posed import FISHEYE, OPENCV, PINHOLE, posed


def test_each_pyramid_stands_in_its_camera_and_opens_to_what_it_sees() -> None:
    cameras = posed(PINHOLE, OPENCV, FISHEYE)
    mesh = camera_frusta(cameras)
    vertices = mesh.vertices.reshape(len(cameras.images), 6, 3)
    poses = np.asarray([image.world_from_camera for image in cameras.images])
    np.testing.assert_allclose(vertices[:, 0], poses[:, :, 3])
    local = np.einsum("nji,nvj->nvi", poses[:, :, :3], vertices - poses[:, None, :, 3])
    depth = -local[:, 1:, 2]
    np.testing.assert_allclose(depth, depth[0, 0])
    assert np.all(local[:, 5, 1] > local[:, 1:5, 1].max(axis=1)), "the tip is up in the picture"
    pinhole = local[::3] / depth[0, 0]
    np.testing.assert_allclose(pinhole[:, 1, 0], -PINHOLE.cx / PINHOLE.fl_x)
    np.testing.assert_allclose(pinhole[:, 3, 1], (PINHOLE.cy - PINHOLE.height) / PINHOLE.fl_y)


def test_held_out_cameras_have_another_colour() -> None:
    cameras = posed(PINHOLE)
    colors = camera_frusta(cameras).colors.reshape(len(cameras.images), 6, 3)
    held_out = np.array([image.split == "test" for image in cameras.images])
    assert len(np.unique(colors[held_out].reshape(-1, 3), axis=0)) == 1
    assert len(np.unique(colors.reshape(-1, 3), axis=0)) == 2


def test_cameras_in_one_place_can_still_be_seen() -> None:
    cameras = posed(PINHOLE)
    there = tuple((*row[:3], 2.0) for row in cameras.images[0].world_from_camera)
    images = tuple(dataclasses.replace(image, world_from_camera=there) for image in cameras.images)
    mesh = camera_frusta(dataclasses.replace(cameras, images=images))
    assert np.ptp(mesh.vertices, axis=0).max() > 0.01
