"""A texture out of photos, against colours that are known exactly."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from pipelines.errors import Cancelled
from pipelines.exports.mesh import TexturedMesh, TriangleMesh
from pipelines.exports.texture import bake, texels
from pipelines.exports.texture.bake import texture_from_photos
from pipelines.exports.texture.charts import MARGIN_PX
from pipelines.exports.texture.photos import Photos
from pipelines.exports.texture.told import skin_told
from pipelines.exports.void import Void
from pipelines.judging.asset_views import MeshCaster, Texture
from pipelines.scene.depth_views import Pinhole
from tests.unit.pipelines.exports.texture import painted_ball
from tests.unit.pipelines.exports.texture.painted_ball import CENTER, stripes


def surface_samples(mesh: TexturedMesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points inside every face, what the texture has there, and the faces' numbers."""
    weights = np.random.default_rng(0).dirichlet(np.ones(3), size=(len(mesh.faces), 4))
    points = np.einsum("fkc,fcd->fkd", weights, mesh.vertices[mesh.faces]).reshape(-1, 3)
    uv = np.einsum("fkc,fcd->fkd", weights, mesh.uv[mesh.faces]).reshape(-1, 2)
    found = Texture(mesh.uv, mesh.texture).colors(uv, np.ones(len(uv)))
    return points, found, np.repeat(np.arange(len(mesh.faces)), 4)


def on_ball(points: np.ndarray) -> np.ndarray:
    away = points - CENTER
    return CENTER + away / np.linalg.norm(away, axis=1, keepdims=True)


def test_stripes_finer_than_triangles_are_there_and_in_place(tmp_path: Path) -> None:
    photos = painted_ball.photos_of(
        tmp_path, painted_ball.write_photos(tmp_path, painted_ball.all_round())
    )
    mesh = painted_ball.ball()
    textured = texture_from_photos(mesh, photos, 1024)
    points, found, _ = surface_samples(textured)
    error = np.abs(found - stripes(on_ball(points)))
    assert error.mean() < 0.03
    assert np.percentile(error, 95) < 0.12
    assert len(textured.faces) == len(mesh.faces)
    assert np.allclose(textured.vertices[textured.faces], mesh.vertices[mesh.faces])
    assert (textured.uv >= 0).all()
    assert (textured.uv <= 1).all()


def test_a_corner_on_the_edge_of_a_photos_ball_brightens_no_face(tmp_path: Path) -> None:
    """There the photo shows half the dark ground; that is no difference in exposure."""
    photos = painted_ball.photos_of(
        tmp_path, painted_ball.write_photos(tmp_path, painted_ball.all_round())
    )
    textured = texture_from_photos(painted_ball.ball(24), photos, 1024)
    points, found, faces = surface_samples(textured)
    brighter = np.bincount(faces, (found - stripes(on_ball(points))).mean(axis=1)) / 4.0
    assert brighter.max() < 0.06


def test_a_lens_that_bends_is_heeded(tmp_path: Path) -> None:
    """The same photos said to be of a bending lens: the stripes end up elsewhere."""
    images = painted_ball.write_photos(tmp_path, painted_ball.all_round())
    bent = dataclasses.replace(painted_ball.LENS, model="OPENCV", k1=-0.3)
    errors = []
    for lens in (painted_ball.LENS, bent):
        photos = painted_ball.photos_of(tmp_path, images, lens)
        points, found, _ = surface_samples(texture_from_photos(painted_ball.ball(), photos, 1024))
        errors.append(np.abs(found - stripes(on_ball(points))).mean())
    assert errors[1] > 2.0 * errors[0]


def test_photos_of_other_exposure_make_no_seams(tmp_path: Path) -> None:
    gains = np.random.default_rng(0).uniform(0.8, 1.1, 12).tolist()
    poses = painted_ball.all_round()
    images = painted_ball.write_photos(tmp_path, poses, gains)
    textured = texture_from_photos(
        painted_ball.ball(), painted_ball.photos_of(tmp_path, images), 1024
    )
    texture = Texture(textured.uv, textured.texture)
    at_corners = texture.colors(textured.uv, np.ones(len(textured.uv)))
    _, vertex = np.unique(np.round(textured.vertices, 6), axis=0, return_inverse=True)
    order = np.argsort(vertex, kind="stable")
    same = vertex[order][1:] == vertex[order][:-1]
    assert same.sum() > 50, "there is no seam to look at"
    steps = np.abs(at_corners[order[1:]] - at_corners[order[:-1]])[same]
    assert np.median(steps) < 0.015
    points, found, _ = surface_samples(textured)
    truth = stripes(on_ball(points)) * np.mean(gains)
    assert np.abs(found - truth).mean() < 0.06


def test_what_no_photo_shows_keeps_its_vertices_colours(tmp_path: Path) -> None:
    above = [pose for pose in painted_ball.all_round(24) if pose[2, 3] > CENTER[2] + 1.0]
    photos = painted_ball.photos_of(tmp_path, painted_ball.write_photos(tmp_path, above))
    textured = texture_from_photos(painted_ball.ball(), photos, 1024)
    points, found, _ = surface_samples(textured)
    below = points[:, 2] < CENTER[2] - 0.8
    assert below.sum() > 100
    assert np.abs(found[below] - 0.5).max() < 0.01, "grey, as the vertices are"
    on_top = points[:, 2] > CENTER[2] + 0.6
    assert np.abs(found - stripes(on_ball(points)))[on_top].mean() < 0.05


def test_a_masked_part_of_the_photos_colours_nothing(tmp_path: Path) -> None:
    mask = np.full((painted_ball.SIDE, painted_ball.SIDE), 255, np.uint8)
    mask[:, : painted_ball.SIDE // 2] = 0
    poses = [painted_ball.all_round()[1]]
    photos = painted_ball.photos_of(tmp_path, painted_ball.write_photos(tmp_path, poses, mask=mask))
    textured = texture_from_photos(painted_ball.ball(), photos, 1024)
    points, found, _ = surface_samples(textured)
    pixels, shown = photos.pixels(0, photos.frame.scene_from_world(points))
    hidden = shown & (pixels[:, 0] < painted_ball.SIDE / 2 - 12)
    assert hidden.sum() > 100
    assert np.abs(found[hidden] - 0.5).max() < 0.01


@pytest.mark.parametrize("k1", [0.0, -0.25])
def test_what_of_a_photo_is_void_colours_nothing(tmp_path: Path, k1: float) -> None:
    """Told in the undistorted picture, of a part of it on the left."""
    lens = dataclasses.replace(painted_ball.LENS, model="OPENCV", k1=k1)
    image = painted_ball.write_photos(tmp_path, [painted_ball.all_round()[1]])[0]
    plain, edge = Pinhole.of(lens, 64), 20
    left = np.broadcast_to(np.arange(64) < edge, (64, 64))
    photos = Photos(
        tmp_path, [image], [lens], [Void(image.file, plain, left, np.zeros((64, 64), np.float32))]
    )
    textured = texture_from_photos(painted_ball.ball(48), photos, 2048)
    points, found, _ = surface_samples(textured)
    _, shown = photos.pixels(0, photos.frame.scene_from_world(points))
    pose = np.asarray(image.world_from_camera)
    x, _, z = ((points - pose[:, 3]) @ pose[:, :3]).T
    column = plain.cx - plain.fl_x * x / z
    colored = np.abs(found - 0.5).max(axis=-1) > 0.02
    hidden, kept = shown & (column < edge - 4), shown & (column > edge + 3)
    facing = ((points - CENTER) * (pose[:, 3] - points)).sum(axis=-1) > 0.5
    assert (hidden & facing).sum() > 100
    assert not colored[hidden].any()
    assert colored[kept & facing].mean() > 0.9


def off_in_copies(textured: TexturedMesh, which: np.ndarray, copy: int) -> np.ndarray:
    """How far colours inside some faces are in a copy of the texture, of 1 / 2^copy of its size,
    from what they are in the texture: [P], the mean of the channels."""
    weights = np.random.default_rng(0).dirichlet(np.ones(3), size=(len(which), 4))
    uv = np.einsum("fkc,fcd->fkd", weights, textured.uv[textured.faces[which]]).reshape(-1, 2)
    texture = Texture(textured.uv, textured.texture)
    full, small = (texture.colors(uv, np.full(len(uv), 2.0**k)) for k in (0, copy))
    off: np.ndarray = np.abs(small - full).mean(axis=1)
    return off


def two_colored(resolution: int = 48) -> TriangleMesh:
    """The ball, its vertices red above and dark blue below, its faces in any order, as those of
    surfaces are: what lies beside what in the picture tells."""
    mesh = painted_ball.ball(resolution)
    above = (mesh.vertices[:, 2] > CENTER[2])[:, None]
    colors = np.where(above, [0.9, 0.2, 0.1], [0.1, 0.1, 0.4])
    faces = np.random.default_rng(0).permutation(mesh.faces)
    return dataclasses.replace(mesh, faces=faces, colors=colors)


@pytest.mark.parametrize("refined", [False, True])
def test_small_copies_show_faces_without_a_photo_in_their_own_colours(
    tmp_path: Path, refined: bool
) -> None:
    """Viewers take them as soon as the thing is small, or turns away."""
    photos = painted_ball.photos_of(
        tmp_path, painted_ball.write_photos(tmp_path, painted_ball.all_round()[:1])
    )
    textured = texture_from_photos(two_colored(), photos, 1024, refined=refined)
    away = photos.frame.world_from_scene(photos.eye(0)[None])[0] - CENTER
    middle = textured.vertices[textured.faces].mean(axis=1) - CENTER
    behind = np.flatnonzero((middle @ away < 0.0) & (np.abs(middle[:, 2]) > 0.1))
    assert len(behind) > 1000
    for copy, most in ((1, 0.001), (2, 0.004), (3, 0.03)):
        assert off_in_copies(textured, behind, copy).mean() < most


def test_what_lies_on_no_face_goes_on_with_what_lies_beside_it(tmp_path: Path) -> None:
    photos = painted_ball.photos_of(
        tmp_path, painted_ball.write_photos(tmp_path, painted_ball.all_round())
    )
    textured = texture_from_photos(painted_ball.ball(), photos, 1024)
    assert textured.texture.min() > 20, "nothing of the photos' black ground, nor of no colour"
    everything = np.arange(len(textured.faces))
    assert off_in_copies(textured, everything, 1).mean() < 0.01
    assert off_in_copies(textured, everything, 2).mean() < 0.03


def test_a_picture_is_as_large_as_its_charts_need_and_not_more(tmp_path: Path) -> None:
    photos = painted_ball.photos_of(
        tmp_path, painted_ball.write_photos(tmp_path, painted_ball.all_round())
    )
    textured = texture_from_photos(painted_ball.ball(), photos, 4096)
    height, width = textured.texture.shape[:2]
    assert width in (height, 2 * height)
    assert skin_told(textured)["texture_filled"] > 0.25
    assert skin_told(textured)["texture_size_px"] == [width, height]


def test_a_picture_too_small_is_filled_with_less_detail(tmp_path: Path) -> None:
    photos = painted_ball.photos_of(
        tmp_path, painted_ball.write_photos(tmp_path, painted_ball.all_round())
    )
    small = texture_from_photos(painted_ball.ball(), photos, 256)
    assert small.texture.shape == (256, 256, 3)
    points, found, _ = surface_samples(small)
    assert np.abs(found - stripes(on_ball(points))).mean() < 0.12


def test_a_cancel_is_heeded_between_photos(tmp_path: Path) -> None:
    photos = painted_ball.photos_of(
        tmp_path, painted_ball.write_photos(tmp_path, painted_ball.all_round())
    )
    told: list[float] = []

    def on_progress(done: float) -> None:
        told.append(done)
        if len(told) == 3:
            raise Cancelled("stopped")

    with pytest.raises(Cancelled):
        texture_from_photos(painted_ball.ball(), photos, 1024, on_progress)
    assert told == sorted(told)


def test_from_afar_a_texture_is_looked_up_in_a_smaller_copy() -> None:
    """A checkerboard of single texels is grey from afar, not one of its two colours."""
    board = (np.indices((64, 64)).sum(axis=0) % 2 * 255).astype(np.uint8)
    picture = np.repeat(board[..., None], 3, axis=2)
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    caster = MeshCaster(vertices, faces, Texture(vertices[:, :2], picture))
    spots = np.random.default_rng(0).uniform(0.2, 0.8, (200, 2))
    eyes = np.column_stack([spots, np.ones(200)])
    ways = np.broadcast_to([0.0, 0.0, -1.0], eyes.shape)
    near = caster.along(eyes, ways, (10, 20), angle=0.0).color
    far = caster.along(eyes, ways, (10, 20), angle=4.0 / 64).color
    assert near.std() > 0.15
    assert np.abs(far - 0.5).max() < 0.01


def test_levelling_is_heard_of_and_can_be_stopped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a large mesh it takes longer than all that a person waits for a sign of life."""
    photos = painted_ball.photos_of(
        tmp_path, painted_ball.write_photos(tmp_path, painted_ball.all_round())
    )

    def on_progress(done: float) -> None:
        told.append(done)
        if len(told) - len([one for one in told if one <= bake._COPY_SHARE]) > 8:
            raise Cancelled("enough")

    told: list[float] = []
    monkeypatch.setattr(bake, "_level", lambda *_: pytest.fail("levelling was not stopped"))
    with pytest.raises(Cancelled):
        texture_from_photos(painted_ball.ball(), photos, 1024, on_progress)


def test_what_is_done_moves_on_to_the_end(tmp_path: Path) -> None:
    """A large picture is gone over for half a minute when all photos were copied."""
    photos = painted_ball.photos_of(
        tmp_path, painted_ball.write_photos(tmp_path, painted_ball.all_round())
    )
    told: list[float] = []
    made = texture_from_photos(painted_ball.ball(), photos, 1024, told.append)
    assert told == sorted(told)
    assert told[-1] == 1.0
    last = [one for one in told if one > bake._LEVEL_SHARE]
    assert len(last) >= len(made.texture) // texels.ROWS + 4 * MARGIN_PX
    assert len(set(last)) == len(last), "it says something new each time"
