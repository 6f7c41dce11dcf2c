"""Which photo colours a face."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipelines.exports.mesh import joined
from pipelines.exports.texture import photos as photos_module
from pipelines.exports.texture.choice import NOBODY, Surface, choose_photos, neighbours_of
from tests.unit.pipelines.exports.texture import painted_ball


def surface_of(photos: object, mesh: object) -> Surface:
    return Surface(
        photos.frame.scene_from_world(mesh.vertices),  # type: ignore[attr-defined]
        mesh.faces,  # type: ignore[attr-defined]
        mesh.normals,  # type: ignore[attr-defined]
    )


def test_neighbours_share_an_edge_and_borders_have_none() -> None:
    faces = np.array([[0, 1, 2], [2, 1, 3], [3, 1, 4]], np.int32)
    assert neighbours_of(faces).tolist() == [[-1, 1, -1], [0, 2, -1], [1, -1, -1]]


def test_a_face_is_coloured_by_a_photo_that_looks_at_it(tmp_path: Path) -> None:
    poses = painted_ball.all_round()
    photos = painted_ball.photos_of(tmp_path, painted_ball.write_photos(tmp_path, poses))
    surface = surface_of(photos, painted_ball.ball())
    choice = choose_photos(surface, photos)
    assert (choice != NOBODY).mean() > 0.98
    eyes = np.stack([photos.eye(index) for index in range(len(photos))])
    seen = choice != NOBODY
    toward = eyes[choice[seen]] - surface.centers[seen]
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    assert ((toward * surface.face_normals[seen]).sum(axis=1) > 0.15).all()
    around = neighbours_of(surface.faces)
    alike = (choice[around] == choice[:, None])[around >= 0].mean()
    assert alike > 0.85, "the surface falls into crumbs"


def test_what_lies_behind_something_is_not_coloured_through_it(tmp_path: Path) -> None:
    """Two balls in a row before one camera: the farther one has none of its photo."""
    pose = painted_ball.all_round()[1]
    photos = painted_ball.photos_of(tmp_path, painted_ball.write_photos(tmp_path, [pose]))
    near = painted_ball.ball()
    away = near.vertices.mean(axis=0) - pose[:, 3]
    far = painted_ball.ball()
    both = joined(
        [
            near,
            type(far)(far.vertices + 1.2 * away, far.faces, far.colors, far.normals),
        ]
    )
    choice = choose_photos(surface_of(photos, both), photos)
    count = len(near.faces)
    assert (choice[:count] != NOBODY).mean() > 0.15
    shown_behind = (choice[count:] != NOBODY).mean()
    assert shown_behind < 0.02


def test_coarse_ground_does_not_hide_itself_for_a_fine_thing_on_it() -> None:
    """What is asked from a little before a face is asked by its own size, whatever others have."""
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.arange(13.0), np.arange(13.0), indexing="ij")
    first = (np.arange(12)[:, None] * 13 + np.arange(12)).ravel()
    ground = np.concatenate(
        [
            np.column_stack([first, first + 13, first + 14]),
            np.column_stack([first, first + 14, first + 1]),
        ]
    )
    places = np.column_stack([x.ravel(), y.ravel(), 0.2 * rng.normal(size=169)])
    thing = painted_ball.ball()
    small = 0.01 * (thing.vertices - thing.vertices.mean(axis=0)) + np.array([6.0, 6.0, 5.0])
    normals = np.tile([0.0, 0.0, 1.0], (169, 1))
    eye = np.array([6.0, -14.0, 8.0])

    def shown(fine: bool) -> int:
        parts = (small, thing.faces + 169, thing.normals) if fine else ()
        surface = Surface(
            np.concatenate([places, *parts[:1]]),
            np.concatenate([ground, *parts[1:2]]).astype(np.int32),
            np.concatenate([normals, *parts[2:]]),
        )
        return int(surface.unhindered(eye, np.arange(len(ground))).sum())

    assert len(thing.faces) > 3 * len(ground)
    assert shown(fine=True) == shown(fine=False) > 0


@pytest.mark.parametrize("glance_px", [640, 80])
def test_a_hand_in_one_photo_is_voted_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, glance_px: int
) -> None:
    monkeypatch.setattr(photos_module, "_GLANCE_SIDE", glance_px)
    poses = painted_ball.all_round()
    images = painted_ball.write_photos(tmp_path, poses)
    with Image.open(tmp_path / images[4].file) as opened:
        spoiled = np.asarray(opened).copy()
    hand = np.zeros(spoiled.shape[:2], bool)
    hand[60:100, 60:100] = True
    # Sharper than the others, so that it would be chosen for its looks.
    spoiled[hand] = np.where(np.indices((40, 40)).sum(axis=0).reshape(-1, 1) % 2, 255, 190)
    Image.fromarray(spoiled).save(tmp_path / images[4].file)
    photos = painted_ball.photos_of(tmp_path, images)
    surface = surface_of(photos, painted_ball.ball())
    choice = choose_photos(surface, photos)
    pixels, shown = photos.pixels(4, surface.centers)
    column, row = np.clip(pixels, 0, painted_ball.SIDE - 1).astype(int).T
    covered = shown & hand[row, column] & (choice == 4)
    toward = photos.eye(4) - surface.centers
    covered &= (toward * surface.face_normals).sum(axis=1) > 0
    assert covered.sum() <= 2
    assert (choice == 4).any() or len(np.unique(choice)) > 6
