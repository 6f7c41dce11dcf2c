"""A texture out of a field whose colours are known exactly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import binary_dilation

from pipelines.errors import Cancelled
from pipelines.exports.mesh import Floats, TexturedMesh, TriangleMesh, joined
from pipelines.exports.texture.field import pixels_on, seen_from, texture_from_field
from pipelines.exports.texture.packing import TextureFull
from pipelines.exports.texture.texels import texels_of
from pipelines.exports.texture.told import skin_told
from pipelines.exports.texture.unwrap import GUTTER_PX
from pipelines.judging.asset_views import Texture
from pipelines.nerf.renderer import RenderedImage, seen_within
from pipelines.scene.trained_scene import TrainedScene
from tests.unit.pipelines.exports.texture import painted_ball
from tests.unit.pipelines.exports.texture.glowing_ball import (
    WALL,
    GlowingBall,
    on_ball,
    scene_of,
)
from tests.unit.pipelines.exports.texture.painted_ball import CENTER, LENS, photos_of, stripes
from tests.unit.pipelines.exports.texture.test_bake import surface_samples

PIXEL = 0.012


def painted(
    mesh: TriangleMesh, scene: TrainedScene, side: int = 1024, pixel: float = PIXEL
) -> TexturedMesh:
    pixels = np.full(len(mesh.faces), pixel)
    return texture_from_field(mesh, scene.short_rays, pixels, mesh.normals, side)


@pytest.fixture(scope="module")
def ball() -> TexturedMesh:
    return painted(painted_ball.ball(), scene_of(GlowingBall()))


def red(begins: Floats, directions: Floats, length: float, on_part: Callable[..., Any]) -> Any:
    """A field of one colour everywhere."""
    del directions, length, on_part
    rgb = np.tile(np.array([1.0, 0.0, 0.0], np.float32), (len(begins), 1))
    nothing = np.zeros(len(begins), np.float32)
    return RenderedImage(rgb, nothing + 1, nothing, nothing)


def test_the_colours_of_the_field_are_there_and_in_place(ball: TexturedMesh) -> None:
    """Finer than the triangles, on a mesh that is coarser than the ball."""
    points, found, _ = surface_samples(ball)
    error = np.abs(found - stripes(on_ball(points)))
    assert error.mean() < 0.012
    assert error.max() < 0.12
    mesh = painted_ball.ball()
    assert np.allclose(ball.vertices[ball.faces], mesh.vertices[mesh.faces])


def test_no_texel_of_a_face_or_beside_one_is_bare() -> None:
    mesh = painted_ball.ball()
    blue = replace(mesh, colors=np.tile([0.0, 0.0, 1.0], (len(mesh.colors), 1)))
    skin = texture_from_field(blue, red, np.full(len(mesh.faces), PIXEL), blue.normals, 1024)
    height, width = skin.texture.shape[:2]
    covered = np.zeros((height, width), bool)
    for texels in texels_of(skin.uv * (width, height), skin.faces, (width, height)):
        covered[texels.rows] = texels.covered
    is_red = (skin.texture == [255, 0, 0]).all(axis=-1)
    assert covered.sum() > 10_000
    assert is_red[binary_dilation(covered, iterations=GUTTER_PX)].all()
    assert is_red.all(), "what lies on no face goes on with what is beside it"
    _, _, face = surface_samples(skin)
    weights = np.random.default_rng(1).dirichlet(np.ones(3), size=len(face))
    uv = np.einsum("nc,ncd->nd", weights, skin.uv[skin.faces[face]])
    texture = Texture(skin.uv, skin.texture)
    for footprint in (1.0, 2.0, 4.0):
        seen = texture.colors(uv, np.full(len(uv), footprint))
        assert np.allclose(seen, [1.0, 0.0, 0.0], atol=1e-6), f"a copy {footprint} times smaller"


def test_no_seam_shows_between_charts(ball: TexturedMesh) -> None:
    texture = Texture(ball.uv, ball.texture)
    _, vertex = np.unique(np.round(ball.vertices, 6), axis=0, return_inverse=True)
    order = np.argsort(vertex, kind="stable")
    same = vertex[order][1:] == vertex[order][:-1]
    assert same.sum() > 30, "there is no seam to look at"
    for footprint, most in ((1.0, 0.035), (2.0, 0.08)):
        colors = texture.colors(ball.uv, np.full(len(ball.uv), footprint))
        steps = np.abs(colors[order[1:]] - colors[order[:-1]])[same]
        assert np.median(steps) < most / 5.0
        assert np.percentile(steps, 95) < most


def test_a_ray_does_not_begin_behind_what_stands_before_it() -> None:
    """A wall 0.2 away, while rays reach 0.25 to either side."""
    y, z = np.array([-2.0, 2.0, 2.0, -2.0]), np.array([-2.0, -2.0, 2.0, 2.0])
    corners = CENTER + np.stack([np.full(4, 1.2), y, z], axis=1)
    wall = TriangleMesh(
        corners,
        np.array([[0, 2, 1], [0, 3, 2]], np.int32),
        np.full((4, 3), 0.5),
        np.tile([-1.0, 0.0, 0.0], (4, 1)),
    )
    mesh = joined([painted_ball.ball(12), wall])
    skin = painted(mesh, scene_of(GlowingBall(wall=True)), pixel=0.031)
    points, found, _ = surface_samples(skin)
    tip = points[:, 0] - CENTER[0]
    near = (tip > 0.9) & (tip < 1.1)
    assert near.sum() > 20
    assert np.abs(found - stripes(on_ball(points)))[near].max() < 0.2, "the wall's red is far off"
    assert np.abs(found[tip > 1.19] - WALL).max() < 0.02


def test_where_the_field_has_nothing_the_mesh_keeps_its_own_colours() -> None:
    mesh = painted_ball.ball()
    points, found, _ = surface_samples(painted(mesh, scene_of(GlowingBall(radius=0.7)), pixel=0.04))
    assert len(points) > 1000
    assert np.abs(found - 0.5).max() < 0.01, "grey, as the vertices are"


def test_rays_go_through_their_texels_from_where_they_were_looked_at() -> None:
    mesh = painted_ball.ball()
    up = np.tile([0.0, 0.0, 1.0], (len(mesh.vertices), 1))
    asked: list[tuple[Floats, Floats]] = []

    def look(begins: Floats, directions: Floats, length: float, on_part: Any) -> RenderedImage:
        asked.append((begins, directions))
        seen: RenderedImage = red(begins, directions, length, on_part)
        return seen

    texture_from_field(mesh, look, np.full(len(mesh.faces), 0.05), up, 1024)
    begins, ways = (np.concatenate(parts) for parts in zip(*asked, strict=True))
    down = ways[:, 2] < -0.999
    height = (begins - CENTER)[:, 2]
    assert down[height > 0.6].all(), "against what was given, not against the normal"
    below = ~down & (height < -0.2)
    assert below.sum() > 100
    outward = (begins - CENTER)[below] / np.linalg.norm((begins - CENTER)[below], axis=1)[:, None]
    assert (-(ways[below] * outward).sum(axis=1)).min() > 0.95, "from behind nothing shows"


def test_a_vertex_is_looked_at_from_the_cameras_that_see_it(tmp_path: Path) -> None:
    ball = painted_ball.ball()
    scene = scene_of(GlowingBall())
    one = scene.training_images()[1:2]
    eye = np.asarray(one[0].world_from_camera)[:, 3]
    toward = seen_from(ball, photos_of(tmp_path, one))
    way = eye - ball.vertices
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    facing = (way * ball.normals).sum(axis=1)
    assert np.allclose(toward[facing > 0.2], way[facing > 0.2], atol=1e-4)
    assert np.allclose(toward[facing < 0.0], ball.normals[facing < 0.0])
    before = replace(ball, vertices=CENTER + 0.3 * (ball.vertices - CENTER) + 0.5 * (eye - CENTER))
    hidden = seen_from(joined([ball, before]), photos_of(tmp_path, one))[: len(ball.vertices)]
    middle = facing > 0.95
    assert middle.sum() > 3
    assert np.allclose(hidden[middle], ball.normals[middle]), "what stands before it hides it"
    all_round = seen_from(ball, photos_of(tmp_path, scene.training_images()))
    assert np.allclose(np.linalg.norm(all_round, axis=1), 1.0)
    assert (all_round * ball.normals).sum(axis=1).min() > 0.5


def test_a_short_ray_ends_where_it_is_told_to_and_leaves_the_model_as_it_was() -> None:
    model = GlowingBall()
    scene = scene_of(model)
    begins = CENTER + np.array([[1.1, 0.0, 0.0], [1.1, 0.0, 0.0]])
    toward = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    seen = scene.short_rays(begins, toward, 0.3)
    assert seen.accumulation == pytest.approx([1.0, 0.0], abs=1e-3)
    assert seen.depth[0] == pytest.approx(0.1, abs=0.01)
    assert scene.short_rays(begins, toward, 0.05).accumulation.max() == 0.0
    short = seen_within(model, 0.01, 0.02)
    assert (model.config.near, model.config.far) == (0.05, 1000.0)
    assert short.anything is model.anything


def test_pixels_are_those_of_the_nearest_camera_that_looks_there() -> None:
    scene, mesh = scene_of(GlowingBall()), painted_ball.ball()
    images = scene.training_images()
    pixel = pixels_on(mesh, images, [LENS] * len(images), 80)
    centers = mesh.vertices[mesh.faces].mean(axis=1)
    eyes = np.stack([np.asarray(image.world_from_camera)[:, 3] for image in images])
    nearest = np.linalg.norm(centers[:, None] - eyes, axis=2).min(axis=1)
    assert pixel == pytest.approx(nearest / (LENS.fl_x / 2.0))
    away = [replace(image, world_from_camera=_turned(image)) for image in images]
    assert pixels_on(mesh, away[:1], [LENS], 80) == pytest.approx(
        pixels_on(mesh, images[:1], [LENS], 80)
    ), "where no camera looks it is as if the nearest one did"
    pair = pixels_on(mesh, [images[0], away[3]], [LENS] * 2, 80)
    assert pair == pytest.approx(pixels_on(mesh, images[:1], [LENS], 80))


def _turned(image: Any) -> Any:
    """The pose of a camera that looks the other way."""
    pose = np.asarray(image.world_from_camera) * [-1.0, 1.0, -1.0, 1.0]
    return tuple(tuple(map(float, row)) for row in pose)


def test_the_picture_is_as_large_as_the_field_is_fine_and_the_report_says_how_fine() -> None:
    mesh = painted_ball.ball()
    scene = scene_of(GlowingBall())
    sides = [max(painted(mesh, scene, 2048, pixel).texture.shape) for pixel in (0.08, 0.02)]
    assert sides[0] * 2 <= sides[1] < 2048
    told = skin_told(painted(mesh, scene, 2048, 0.08))
    assert told["texture_px"] == sides[0]
    assert told["texels_per_unit"] == pytest.approx(1.5 / 0.08, rel=0.1)
    assert told["num_faces"] == len(mesh.faces)


def test_a_mesh_that_does_not_fit_is_refused() -> None:
    corners = np.random.default_rng(0).normal(size=(1500, 3, 3)) + np.arange(1500)[:, None, None]
    vertices = corners.reshape(-1, 3)
    faces = np.arange(4500).reshape(-1, 3).astype(np.int32)
    soup = TriangleMesh(vertices, faces, np.full_like(vertices, 0.5), np.ones_like(vertices))
    with pytest.raises(TextureFull):
        texture_from_field(soup, red, np.full(1500, PIXEL), soup.normals, 256)


def test_it_tells_how_far_it_is_and_can_be_cancelled_anywhere() -> None:
    told: list[float] = []
    mesh, look = painted_ball.ball(), scene_of(GlowingBall()).short_rays
    pixel = np.full(len(mesh.faces), 4.0 * PIXEL)
    texture_from_field(mesh, look, pixel, mesh.normals, 1024, told.append)
    assert told == sorted(told)
    assert told[-1] == 1.0
    assert len(set(told)) > 8
    for stop_at in (1, len(told) // 2, len(told) - 2):
        heard: list[float] = []

        def on_progress(done: float, heard: list[float] = heard, last: int = stop_at) -> None:
            heard.append(done)
            if len(heard) == last:
                raise Cancelled("stopped")

        with pytest.raises(Cancelled):
            texture_from_field(mesh, look, pixel, mesh.normals, 1024, on_progress)
        assert len(heard) == stop_at
