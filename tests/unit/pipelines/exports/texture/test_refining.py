"""A texture brought nearer to what all photos show, against slow twins and known colours."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from pipelines.errors import Cancelled
from pipelines.exports.mesh import Floats, TexturedMesh
from pipelines.exports.texture import bake, refining
from pipelines.exports.texture.bake import texture_from_photos
from pipelines.exports.texture.choice import NOBODY, choose_photos
from pipelines.exports.texture.refining import copies_of, mixing, refined_colors, solved
from pipelines.judging.asset_views import Texture
from pipelines.scene.picture_sampling import between_pixels
from tests.unit.pipelines.exports.texture import painted_ball
from tests.unit.pipelines.exports.texture.painted_ball import CENTER, stripes


def off_by(textured: TexturedMesh, of: slice = slice(None)) -> Floats:
    """How far the colours of points inside faces are from the ball's, [P, 3]."""
    weights = np.random.default_rng(0).dirichlet(np.ones(3), size=(len(textured.faces), 4))
    points = np.einsum("fkc,fcd->fkd", weights, textured.vertices[textured.faces]).reshape(-1, 3)
    uv = np.einsum("fkc,fcd->fkd", weights, textured.uv[textured.faces]).reshape(-1, 2)
    found = Texture(textured.uv, textured.texture).colors(uv, np.ones(len(uv)))
    away = points - CENTER
    truth = stripes(CENTER + away / np.linalg.norm(away, axis=1, keepdims=True))
    return (found - truth)[of]


def turned(pose: Floats, by: Floats) -> Floats:
    """A camera that looks a little elsewhere. by: [3], radians, small."""
    x, y, z = by
    turn = np.eye(3) + np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    axes, _, other = np.linalg.svd(pose[:, :3] @ turn)
    return np.concatenate([axes @ other, pose[:, 3:]], axis=1)


def test_a_pixel_mixes_texels_of_the_copy_it_asks_as_a_viewer_does() -> None:
    random = np.random.default_rng(0)
    texture = random.random((32, 64, 3)).astype(np.float32)
    places = random.uniform(0.0, 1.0, (300, 2)) * (64.0, 32.0)
    level = random.integers(0, 3, 300)
    found = mixing(places, level, (32, 64)) @ copies_of(texture)
    for k, side in enumerate((32, 16, 8)):
        copy = texture.reshape(side, 32 // side, 2 * side, 32 // side, 3).mean(axis=(1, 3))
        mine = level == k
        wanted = between_pixels(copy, *(places[mine] / 2**k).T)
        assert np.allclose(found[mine], wanted, atol=1e-5)


def test_what_a_copy_misses_goes_to_the_texels_that_made_it() -> None:
    """Gathering is the adjoint of copying: <copies(t), y> = <t, gathered(y)>."""
    random = np.random.default_rng(1)
    texture = random.random((16, 32, 3)).astype(np.float32)
    copies = copies_of(texture)
    sums = random.random((len(copies), 4)).astype(np.float32)
    gathered = refining._gathered(sums, (16, 32))
    assert np.vdot(copies, sums[:, :3]) == pytest.approx(np.vdot(texture, gathered[..., :3]), 1e-5)


def test_pixels_that_agree_are_met_and_one_that_is_far_off_hardly_counts() -> None:
    random = np.random.default_rng(2)
    truth = random.uniform(0.3, 0.7, (16, 16, 3)).astype(np.float32)
    places = random.uniform(0.0, 16.0, (6000, 2))
    seen = mixing(places, np.zeros(6000, np.int64), (16, 16))
    color = np.rint(255.0 * (seen @ copies_of(truth))).astype(np.uint8)
    begun = np.clip(truth + 0.04, 0.0, 1.0).astype(np.float32)
    step, known = solved(begun, [(seen[:3000], color[:3000]), (seen[3000:], color[3000:])])
    assert known.all()
    assert np.abs(begun + step - truth).mean() < 0.004
    wrong = color.copy()
    wrong[::20] = 255
    misled, _ = solved(begun, [(seen, wrong)])
    assert np.abs(begun + misled - truth).mean() < 0.01


def test_a_texel_that_no_pixel_sees_stays() -> None:
    places = np.full((50, 2), 4.0)
    seen = mixing(places, np.zeros(50, np.int64), (16, 16))
    step, known = solved(
        np.full((16, 16, 3), 0.5, np.float32), [(seen, np.zeros((50, 3), np.uint8))]
    )
    assert known.sum() == 4
    assert (step[~known] == 0.0).all()
    assert (step[known] < -0.1).all()


def test_a_pixel_at_a_jump_of_depth_or_a_hole_does_not_count() -> None:
    distance = np.full((5, 6), 2.0, np.float32)
    distance[:, 4:] = 3.0
    distance[0, 0] = np.inf
    even = refining._even(distance)
    assert not even[:, 3:5].any()
    assert not even[0, 0]
    assert not even[0, 1]
    assert not even[1, 0]
    assert even[1:, 1:3].all()
    assert even[:, 5].all()


def test_where_photos_contradict_each_other_the_texture_is_nearer_to_the_truth(
    tmp_path: Path,
) -> None:
    """Each photo's pose is off by a pixel or so: one alone is wrong, their mean is less so."""
    random = np.random.default_rng(3)
    poses = painted_ball.all_round(20)
    images = painted_ball.write_photos(tmp_path, poses)
    rows = [turned(pose, random.normal(0.0, 1.5 / 170.0, 3)) for pose in poses]
    images = [
        type(image)(image.file, 0, tuple(tuple(map(float, row)) for row in pose))
        for image, pose in zip(images, rows, strict=True)
    ]
    photos = painted_ball.photos_of(tmp_path, images)
    one = texture_from_photos(painted_ball.ball(), photos, 1024, refined=False)
    all_of_them = texture_from_photos(painted_ball.ball(), photos, 1024)
    assert np.square(off_by(all_of_them)).mean() < 0.6 * np.square(off_by(one)).mean()
    again = texture_from_photos(painted_ball.ball(), photos, 1024)
    assert (again.texture == all_of_them.texture).all(), "the same bytes each time"


def test_vertices_of_faces_without_a_photo_go_towards_what_photos_show_of_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    images = painted_ball.write_photos(tmp_path, painted_ball.all_round())
    photos = painted_ball.photos_of(tmp_path, images)
    ball = painted_ball.ball()
    grey = replace(ball, colors=np.full_like(ball.colors, 0.5))
    alone = np.arange(len(ball.faces)) % 3 == 0

    def without_a_third(*given: Any) -> NDArray[np.int32]:
        return np.where(alone, NOBODY, choose_photos(*given)).astype(np.int32)

    monkeypatch.setattr(bake, "choose_photos", without_a_third)
    faces = np.repeat(alone, 4)
    as_they_were = texture_from_photos(grey, photos, 1024, refined=False)
    moved = texture_from_photos(grey, photos, 1024)
    before, after = (np.square(off_by(of)[faces]).mean() for of in (as_they_were, moved))
    assert after < 0.25 * before
    # And as good as vertices can be: those of the truth.
    ends = ball.vertices - CENTER
    truth = stripes(CENTER + ends / np.linalg.norm(ends, axis=1, keepdims=True))
    best = texture_from_photos(replace(ball, colors=truth), photos, 1024, refined=False)
    assert after < 1.2 * np.square(off_by(best)[faces]).mean()


def test_a_vertex_that_no_pixel_sees_keeps_its_colour() -> None:
    random = np.random.default_rng(4)
    weights = random.dirichlet(np.ones(3), 500).astype(np.float32)
    corners = np.tile(np.array([0, 1, 2], np.int32), (500, 1))
    truth = np.array([[0.2, 0.4, 0.6], [0.5, 0.5, 0.5], [0.7, 0.3, 0.4], [0.9, 0.9, 0.9]])
    color = np.rint(255.0 * (weights @ truth[:3])).astype(np.uint8)
    begun = np.clip(truth + 0.05, 0.0, 1.0).astype(np.float32)
    told: list[float] = []
    looks = [(refining._of_corners(corners, weights, 4), color)]
    found = refined_colors(begun, looks, told.append)
    assert told == sorted(set(told)), "each round is heard of"
    assert told[-1] == 1.0
    assert np.abs(found[:3] - truth[:3]).max() < 0.01
    assert (found[3] == begun[3]).all()


def test_a_passer_by_in_a_photo_stays_out(tmp_path: Path) -> None:
    images = painted_ball.write_photos(tmp_path, painted_ball.all_round(16))
    photos = painted_ball.photos_of(tmp_path, images)
    clean = texture_from_photos(painted_ball.ball(), photos, 1024)
    with Image.open(tmp_path / images[5].file) as opened:
        photo = np.array(opened)
    photo[60:100, 60:100] = 255, 255, 0
    Image.fromarray(photo).save(tmp_path / images[5].file)
    passed = texture_from_photos(painted_ball.ball(), photos, 1024)
    assert np.abs(off_by(passed)).mean() < np.abs(off_by(clean)).mean() + 0.004


def test_of_too_many_pixels_an_even_choice_is_looked_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    images = painted_ball.write_photos(tmp_path, painted_ball.all_round())
    photos = painted_ball.photos_of(tmp_path, images)
    counts = []

    def counted(begun: Floats, looks: list, on_progress: object) -> tuple[Floats, Floats]:  # type: ignore[type-arg]
        counts.append(sum(len(color) for _, color in looks))
        return np.zeros_like(begun), np.zeros(begun.shape[:2], np.bool_)

    monkeypatch.setattr(refining, "solved", counted)
    for most in (refining._PIXELS, 12 * painted_ball.SIDE**2 // 4):
        monkeypatch.setattr(refining, "_PIXELS", most)
        texture_from_photos(painted_ball.ball(), photos, 1024)
    assert counts[1] == pytest.approx(counts[0] / 4, rel=0.05)


@pytest.mark.parametrize("stride", [1, 2, 3, 4, 5, 7])
def test_an_even_choice_leaves_no_column_and_no_row_out(stride: int) -> None:
    """960 is a multiple of 2, 3, 4 and 5: one of so many in a row would be one below the other."""
    for first in range(stride):
        chosen = refining._even_choice(960, 720, stride, first).reshape(720, 960)
        assert chosen.any(axis=0).all()
        assert chosen.any(axis=1).all()
        assert chosen.mean() == pytest.approx(1.0 / stride, rel=0.01)
    together = [refining._even_choice(960, 720, stride, first) for first in range(stride)]
    assert (np.sum(together, axis=0) == 1).all(), "each photo another part"


def test_it_is_heard_of_and_can_be_stopped(tmp_path: Path) -> None:
    images = painted_ball.write_photos(tmp_path, painted_ball.all_round())
    photos = painted_ball.photos_of(tmp_path, images)
    told: list[float] = []

    def on_progress(done: float) -> None:
        told.append(done)
        if done > 0.9:
            raise Cancelled("stopped")

    with pytest.raises(Cancelled):
        texture_from_photos(painted_ball.ball(), photos, 1024, on_progress)
    assert told == sorted(told)
    assert len([done for done in told if done > 0.55]) > 12, "each photo is told of"
