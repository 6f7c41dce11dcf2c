"""A piece of a mesh ends where its box does, looks as it did, and carries no more texture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipelines.exports.crop import Crop
from pipelines.exports.cutting import clipped, cut_out, of_faces, with_own_texture, without_crumbs
from pipelines.exports.formats import glb
from pipelines.exports.mesh import TexturedMesh, TriangleMesh, joined
from pipelines.exports.subject import find_subject
from pipelines.exports.subject_files import PICTURE, SUBJECT, as_dict, save_subject
from pipelines.judging.asset_views import MeshCaster, Texture
from tests.gltf_validator import problems_of
from tests.unit.pipelines.exports.made_places import around, block, seen_from, sheet, table

TURN = np.radians(25.0)
AXES = np.array(
    [[np.cos(TURN), -np.sin(TURN), 0.0], [np.sin(TURN), np.cos(TURN), 0.0], [0.0, 0.0, 1.0]]
)
BOX = Crop(np.array([0.1, -0.05, 0.02]), AXES, np.array([0.33, 0.21, 0.3]))


def _area(mesh: TriangleMesh | TexturedMesh) -> float:
    corners = mesh.vertices[mesh.faces]
    crossed = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return float(np.linalg.norm(crossed, axis=1).sum() / 2.0)


def test_a_sheet_is_cut_exactly_at_the_sides_of_a_turned_box() -> None:
    mesh = table(1.0)
    cut = clipped(mesh, BOX)
    assert _area(cut) == pytest.approx(4.0 * BOX.half[0] * BOX.half[1], rel=1e-9)
    reach = np.abs((cut.vertices - BOX.center) @ AXES)[:, :2].max(axis=0)
    np.testing.assert_allclose(reach, BOX.half[:2], rtol=1e-12)
    corners = cut.vertices[cut.faces]
    up = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]
    assert (up > 0.0).all(), "faces keep their front"
    assert len(np.unique(cut.faces)) == len(cut.vertices)
    # Cut triangles share their new corners: only the outline is open.
    edges = np.sort(cut.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, times = np.unique(edges, axis=0, return_counts=True)
    assert times.max() == 2
    length = np.linalg.norm(
        np.diff(cut.vertices[np.unique(edges, axis=0)[times == 1]], axis=1), axis=-1
    ).sum()
    assert length == pytest.approx(4.0 * (BOX.half[0] + BOX.half[1]), rel=1e-6)


def test_a_mesh_inside_stays_as_it_is_and_one_outside_goes() -> None:
    mesh = block(BOX.center - 0.1, BOX.center + 0.1)
    cut = clipped(mesh, BOX)
    np.testing.assert_array_equal(cut.vertices[cut.faces], mesh.vertices[mesh.faces])
    far = clipped(block((2, 2, 2), (3, 3, 3)), BOX)
    assert (len(far.faces), len(far.vertices)) == (0, 0)


def test_one_large_triangle_is_cut_too() -> None:
    corners = np.array([[-9.0, -9.0, 0.0], [9.0, -9.0, 0.0], [0.0, 14.0, 0.0]])
    plain = np.full((3, 3), 0.5)
    cut = clipped(TriangleMesh(corners, np.array([[0, 1, 2]], np.int32), plain, plain), BOX)
    assert _area(cut) == pytest.approx(4.0 * BOX.half[0] * BOX.half[1], rel=1e-9)


def test_crumbs_go_and_vertices_apart_in_the_texture_alone_do_not_part_a_mesh() -> None:
    crumb = block((0.5, 0.5, 0.5), (0.51, 0.51, 0.51))
    sheets = [sheet((0, 0, 0), (1, 0, 0), (0, 1, 0)), sheet((1, 0, 0), (0.05, 0, 0), (0, 1, 0))]
    whole = joined([*sheets, crumb])
    kept = without_crumbs(whole, 0.1)
    # The narrow sheet is a twentieth, but one piece with the wide one, whose rim it shares.
    assert _area(kept) == pytest.approx(1.05)
    assert len(of_faces(whole, np.zeros(len(whole.faces), bool)).vertices) == 0


def _painted() -> TexturedMesh:
    """A sheet of four patches in a texture that has them far apart, all of it used by others."""
    rng = np.random.default_rng(1)
    picture = np.kron(rng.integers(0, 255, (128, 128, 3)), np.ones((8, 8, 1))).astype(np.uint8)
    parts, uvs, start = [], [], 0
    for index, (x, y) in enumerate([(0, 0), (1, 0), (0, 1), (1, 1)]):
        part = sheet((x, y, 0), (1, 0, 0), (0, 1, 0))
        place = (part.vertices[:, :2] - (x, y)) * 0.1 + (0.2 * index + 0.05, 0.7 - 0.2 * index)
        parts.append((part.vertices, part.faces + start, part.normals))
        uvs.append(place)
        start += len(part.vertices)
    return TexturedMesh(
        np.concatenate([part[0] for part in parts]),
        np.concatenate([part[1] for part in parts]).astype(np.int32),
        np.concatenate([part[2] for part in parts]),
        np.concatenate(uvs),
        picture,
    )


def _looked_at(mesh: TexturedMesh, places: np.ndarray) -> np.ndarray:
    caster = MeshCaster(mesh.vertices, mesh.faces, Texture(mesh.uv, mesh.texture))
    eyes = np.concatenate([places, np.ones((len(places), 1))], axis=1)
    down = np.broadcast_to([0.0, 0.0, -1.0], eyes.shape)
    seen = caster.along(eyes, down, (len(eyes), 1))
    assert seen.hit.all()
    return seen.color[:, 0]


def test_a_piece_with_a_texture_of_its_own_looks_as_it_did() -> None:
    whole = _painted()
    box = Crop(np.array([1.0, 1.0, 0.0]), AXES, np.array([0.4, 0.3, 0.1]))
    cut = clipped(whole, box)
    assert isinstance(cut, TexturedMesh)
    small = with_own_texture(cut)
    assert small.texture.size < whole.texture.size / 4
    places = np.random.default_rng(2).uniform(0.8, 1.2, (500, 2))
    np.testing.assert_allclose(_looked_at(cut, places), _looked_at(whole, places), atol=1e-3)
    np.testing.assert_allclose(_looked_at(small, places), _looked_at(cut, places), atol=1e-3)


def test_a_texture_that_cannot_be_smaller_stays() -> None:
    whole = _painted()
    full = with_own_texture(
        TexturedMesh(whole.vertices, whole.faces, whole.normals, whole.uv, whole.texture[::4, ::4])
    )
    assert full.texture.shape == (128, 128, 3)
    assert with_own_texture(full) is full


def test_what_is_delivered_lies_over_the_mesh_with_its_origin_under_the_thing(
    tmp_path: Path,
) -> None:
    thing = ((-0.2, -0.15, 0.4), (0.2, 0.15, 0.7))
    lamp = block((-0.9, 0.1, 0.4), (-0.5, 0.5, 1.0))
    mesh = joined([table(2.0, height=0.4), block(*thing), lamp])
    gaze = seen_from(around(360.0, radius=0.8, height=1.0), (0, 0, 0.55))
    decision = find_subject(mesh.vertices, mesh.faces, gaze)
    assert decision.thing is not None
    told = as_dict(decision) | save_subject(
        tmp_path, mesh, mesh, decision.thing, gaze, True, glb.GlbStyle(), lambda done: None
    )
    assert problems_of(tmp_path / SUBJECT) == []
    assert told["num_faces"] < 0.3 * len(mesh.faces)
    # Read back, it lies where the whole does; in the file, on the ground.
    found = glb.read_mesh(tmp_path / SUBJECT)
    np.testing.assert_allclose(_heights(found.vertices), [0.4, 0.7], atol=0.005)
    document, _ = glb._parts(tmp_path / SUBJECT)
    (low, high) = (document["accessors"][0][key] for key in ("min", "max"))
    assert high[1] == pytest.approx(0.3, abs=0.005), "glTF is Y up"
    assert low[1] == pytest.approx(0.0, abs=0.005)
    assert low[0] + high[0] == pytest.approx(0.0, abs=0.02)
    back = np.asarray(told["world_from_subject"])
    np.testing.assert_allclose(back @ [0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.4], atol=0.02)
    region = told["region"]
    again = Crop(np.asarray(region["center"]), np.eye(3), np.asarray(region["size"]) / 2.0)
    assert region["rotation_deg"][2] == pytest.approx(0.0, abs=1.0)
    assert again.contains(found.vertices * 0.999).all()
    assert (tmp_path / PICTURE).stat().st_size > 10_000


def _heights(points: np.ndarray) -> np.ndarray:
    return np.percentile(points[:, 2], [1, 99])


def test_what_stands_beside_a_thing_in_its_region_is_cut_off_it() -> None:
    post = block((0.30, -0.01, 0.0), (0.31, 0.01, 0.9))
    mesh = joined([table(2.0), block((-0.2, -0.15, 0.0), (0.2, 0.15, 0.3)), post])
    gaze = seen_from(around(360.0, radius=0.8), (0.0, 0.0, 0.15))
    thing = find_subject(mesh.vertices, mesh.faces, gaze).thing
    assert thing is not None
    cut = cut_out(mesh, thing)
    body = mesh.vertices[(np.abs(mesh.vertices[:, 0]) <= 0.2) & (mesh.vertices[:, 2] > 0.0)]
    kept = {tuple(place) for place in np.round(cut.vertices, 9)}
    assert {tuple(place) for place in np.round(body, 9)} <= kept
    assert cut.vertices[:, 2].max() <= 0.3 + 1e-9, "the post is higher"


def test_points_are_a_things_own_where_its_cut_would_keep_them() -> None:
    under = table(2.0, height=-0.5)
    post = block((0.30, -0.01, 0.0), (0.31, 0.01, 0.9))
    mesh = joined([table(2.0), block((-0.2, -0.15, 0.0), (0.2, 0.15, 0.3)), post, under])
    gaze = seen_from(around(360.0, radius=0.8), (0.0, 0.0, 0.15))
    thing = find_subject(mesh.vertices, mesh.faces, gaze).thing
    assert thing is not None
    middles = mesh.vertices[mesh.faces].mean(axis=1)
    held = of_faces(mesh, thing.holds(middles))
    cut = cut_out(mesh, thing)
    # Triangles across the box's sides go with their middles, or are cut.
    assert _area(held) == pytest.approx(_area(cut), rel=0.03)
    assert thing.region.contains(held.vertices * 0.9).all()
    assert (held.vertices[:, 2] < 0.3 + 1e-9).all(), "the post is higher"
    assert (held.vertices[:, 2] > -0.2).all(), "what is far below the table is not its top"
