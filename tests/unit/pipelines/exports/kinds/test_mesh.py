"""The mesh stage on a tiny trained model."""

from __future__ import annotations

import shutil
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import open3d
import pytest
import trimesh
from PIL import Image
from scipy.spatial import cKDTree

from pipelines.errors import Cancelled, ExportError
from pipelines.exports import mesh_shape
from pipelines.exports.formats.glb import read_mesh
from pipelines.exports.formats.ply import Ply, read_ply
from pipelines.exports.mesh import TexturedMesh, TriangleMesh
from pipelines.exports.mesh_options import MeshOptions
from pipelines.exports.mesh_shape import Plan, plan_of
from pipelines.exports.placement import placement_of
from pipelines.exports.surface import poisson, poisson_solver, tsdf
from pipelines.exports.surface.borders import border_loops
from pipelines.exports.surface.surface_file import SURFACE
from pipelines.exports.texture import charts, packing
from pipelines.judging.asset_views import Texture
from pipelines.manifest import RunHooks
from pipelines.registry import get_stage
from pipelines.scene import gaze
from pipelines.scene.cameras_file import CamerasFile
from pipelines.scene.trained_scene import TrainedScene
from pipelines.stage import StageContext
from pipelines.workspace import Workspace
from tests.gltf_validator import problems_of
from tests.unit.pipelines.stages import tiny_job

ROUGH: dict[str, Any] = {"method": "tsdf", "refine": "none"}
"""A surface made in a third of the time, for what is done with one."""
PLAIN: dict[str, Any] = {**ROUGH, "extent": "scene"}
"""And nobody looks for the subject."""


@pytest.fixture(scope="module")
def meshed(trained_job: Workspace, tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """A job whose mesh is made with the options that tests have by default; they must not change
    it."""
    root = tmp_path_factory.mktemp("meshed") / "job"
    shutil.copytree(trained_job.root, root)
    tiny_job.run(Workspace(root), "mesh")
    return Workspace(root)


def test_both_files_hold_the_same_coloured_mesh_in_their_own_axes(meshed: Workspace) -> None:
    job, summary = meshed, meshed.manifest("mesh")["summary"]
    mesh = read_ply(job.stage("mesh") / "mesh.ply")
    assert len(mesh.faces) == summary["num_faces"] <= 3000 * (1.0 + 0.25 * len(summary["shells"]))
    assert len(mesh.faces) > 50
    assert mesh.colors is not None
    assert mesh.colors.std() > 5.0
    assert mesh.normals is not None
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-4)
    _lie_within(mesh.points, [summary["bounds"], *summary["shells"]][-1])
    glb = np.asarray(open3d.io.read_triangle_mesh(job.stage("mesh") / "mesh.glb").vertices)
    np.testing.assert_allclose(glb[:, 1].min(), mesh.points[:, 2].min(), atol=1e-4)
    np.testing.assert_allclose(glb[:, 2].max(), -mesh.points[:, 1].min(), atol=1e-4)
    files = {path.name for path in job.stage("mesh").iterdir()}
    delivered = {"mesh.ply", "mesh.glb", "subject.glb", "subject.jpg"}
    assert files == {*delivered, SURFACE, "manifest.json"}


def test_what_is_delivered_is_what_was_asked_for_and_later_stages_have_theirs(
    job: Workspace,
) -> None:
    manifest = tiny_job.run(
        job, "mesh", method="poisson", refine="none", formats=("usdz", "stl", "usdz")
    )
    assert manifest["summary"]["method"] == "poisson"
    assert manifest["summary"]["formats"] == ["usdz", "stl"]
    files = {file["path"] for file in manifest["files"]}
    artifacts = {artifact.path for artifact in get_stage("mesh").artifacts}
    assert files & artifacts == {"mesh.usdz", "mesh.stl", "subject.glb", "subject.jpg"}
    assert files - artifacts == {"judged.glb", SURFACE}
    judged = read_mesh(job.stage("mesh") / "judged.glb")
    assert isinstance(judged, TexturedMesh)
    assert len(judged.faces) == manifest["summary"]["num_faces"]
    film = tiny_job.run(job, "meshvideo", num_frames=8)
    assert film["summary"]["num_frames"] == 8


def test_nothing_is_painted_where_no_file_carries_a_texture(job: Workspace) -> None:
    """It is judged by the colours that its vertices have, which are those of PLY."""
    for formats, extent, painted in (
        (("stl", "ply"), "scene", False),
        (("stl", "ply"), "auto", True),  # for subject.glb
        (("stl", "obj"), "scene", True),
    ):
        told: list[str] = []
        hooks = RunHooks(on_progress=lambda fraction, message, eta_s, to=told: to.append(message))
        manifest = tiny_job.run_with(
            job, "mesh", hooks, formats=formats, **ROUGH | {"extent": extent}
        )
        assert ("painting" in told) == painted, formats
        judged = read_mesh(job.stage("mesh") / "judged.glb")
        textured = "obj" in formats
        assert isinstance(judged, TexturedMesh) == textured
        assert (manifest["summary"]["texture_px"] is not None) == textured
        if isinstance(judged, TriangleMesh):
            colors = read_ply(job.stage("mesh") / "mesh.ply").colors
            assert colors is not None
            np.testing.assert_allclose(255.0 * judged.colors, colors, atol=1.0)
        if extent == "auto":
            assert isinstance(read_mesh(job.stage("mesh") / "subject.glb"), TexturedMesh)


def test_the_method_is_that_of_where_the_cameras_look(
    meshed: Workspace, job: Workspace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever is asked for of it: at a bowl here, and be it from one side."""
    assert meshed.manifest("mesh")["summary"]["method"] == "poisson"
    crop = {"shape": "sphere", "center": (0.0, 0.0, 0.0), "radius": 2.0}
    for asked in ({"extent": "scene"}, {"crop": crop}):
        assert _plan(job, tmp_path, **asked).method == "poisson", asked
    monkeypatch.setattr(gaze, "LEAST_ARC_DEG", 400.0)  # nobody walks round anything so far
    made = _plan(job, tmp_path)
    assert made.decision is not None
    assert (made.method, made.decision.kind) == ("poisson", "scene")
    monkeypatch.setattr(gaze, "LEAST_LOOKING", 1.1)  # nor do so many look at one place
    plain = {"texture": "none", "refine": "none"}
    assert tiny_job.run(job, "mesh", **plain)["summary"]["method"] == "tsdf"
    assert _plan(job, tmp_path, method="poisson").method == "poisson"


def _plan(job: Workspace, out: Path, **changes: Any) -> Plan:
    """What the stage would look at, and how."""
    scene = TrainedScene.load(job.stage("train") / "model.zip")
    options = MeshOptions(**tiny_job.options_of("mesh", **changes))
    ctx = StageContext(workspace=job, stage="mesh", out=out, checkpoint=out)
    return plan_of(scene, options, placement_of(options.frame, scene.cameras), ctx)


def test_there_is_a_mesh_also_where_the_solver_fails(
    job: Workspace, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(poisson_solver, "__file__", "/nowhere/poisson_solver.py")
    monkeypatch.setattr(poisson, "LARGE", 0)
    wanted = PLAIN | {"method": "poisson", "texture": "none"}
    summary = tiny_job.run(job, "mesh", **wanted)["summary"]
    assert summary["method"] == "tsdf"
    assert summary["num_faces"] > 500
    assert "No Poisson surface" in caplog.text


def test_the_glb_is_painted_with_the_photos_unless_told_not_to_or_full(
    meshed: Workspace,
    job: Workspace,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    summary = meshed.manifest("mesh")["summary"]
    painted = read_mesh(meshed.stage("mesh") / "mesh.glb")
    assert isinstance(painted, TexturedMesh)
    mesh = read_ply(meshed.stage("mesh") / "mesh.ply")
    assert len(painted.faces) == len(mesh.faces)
    assert list(painted.texture.shape[1::-1]) == summary["texture_size_px"]
    assert max(summary["texture_size_px"]) == summary["texture_px"]
    assert 0.02 < summary["texture_filled"] < 1.0
    corners = painted.vertices[painted.faces]
    assert np.abs(corners - mesh.points[mesh.faces]).max() < 1e-4
    for spoil in ({"texture": "none"}, {"texture_px": 512}):
        full = "texture_px" in spoil
        if full:
            monkeypatch.setattr(packing, "_LEAST_SCALE", 1.0)
            monkeypatch.setattr(charts, "MARGIN_PX", 40)
        plain = tiny_job.run(job, "mesh", **PLAIN, **spoil)["summary"]
        assert plain["texture_px"] is None
        assert not isinstance(read_mesh(job.stage("mesh") / "mesh.glb"), TexturedMesh)
        assert ("keeps the colours of its vertices" in caplog.text) == full


def test_every_file_with_a_picture_can_have_it_from_the_field(job: Workspace) -> None:
    wanted = {"formats": ("glb", "obj", "usdz", "ply"), "lods": 1, "max_faces": 1500, **ROUGH}
    messages: list[str] = []
    hooks = RunHooks(on_progress=lambda fraction, message, eta_s: messages.append(message))
    told = tiny_job.run_with(job, "mesh", hooks, texture="field", **wanted)["summary"]
    assert messages.count("painting") > 10
    folder = job.stage("mesh")
    mesh, coarse = read_mesh(folder / "mesh.glb"), read_mesh(folder / "mesh-lod1.glb")
    assert isinstance(mesh, TexturedMesh)
    assert isinstance(coarse, TexturedMesh)
    assert max(mesh.texture.shape) == told["texture_px"]
    assert told["texels_per_unit"] > 10.0
    assert max(coarse.texture.shape) <= 2048
    plain = read_ply(folder / "mesh.ply")
    assert plain.colors is not None
    own = plain.colors[plain.faces].mean(axis=1) / 255.0
    texture = Texture(mesh.uv, mesh.texture)
    painted = texture.colors(mesh.uv[mesh.faces].mean(axis=1), np.ones(len(mesh.faces)))
    assert len(painted) == len(own), "faces are in the same order"
    assert np.abs(painted - own).mean() < 0.12, "the field's colours, as the vertices have them"
    assert problems_of(folder / "mesh.glb") == []
    with zipfile.ZipFile(folder / "mesh.obj.zip") as opened, opened.open("mesh.png") as file:
        assert np.asarray(Image.open(file)).shape == mesh.texture.shape
    with zipfile.ZipFile(folder / "mesh.usdz") as opened:
        assert any(name.endswith((".png", ".jpg")) for name in opened.namelist())


def test_marching_cubes_find_the_field_where_its_depth_is_and_a_crop_holds(job: Workspace) -> None:
    plain = {"refine": "none", "texture": "none", "extent": "scene"}
    faint = {"method": "marching_cubes", "density_level": 0.1}  # so little training leaves fog
    fused = tiny_job.run(job, "mesh", **plain)["summary"]
    depth = read_ply(job.stage("mesh") / "mesh.ply")
    told = tiny_job.run(job, "mesh", **plain, **faint)["summary"]
    assert told["method"] == "marching_cubes"
    field = read_ply(job.stage("mesh") / "mesh.ply")
    assert len(field.faces) > 500
    off, _ = cKDTree(depth.points).query(field.points)
    assert np.median(off) < 2.0 * fused["voxel"]
    assert field.colors is not None
    assert field.colors.std() > 5.0
    low, high = np.percentile(field.points, (20, 80), axis=0)
    crop = {"shape": "box", "center": ((low + high) / 2).tolist(), "size": (high - low).tolist()}
    wanted = plain | faint | {"texture": "field"}
    few = tiny_job.run(job, "mesh", crop=crop, **wanted)["summary"]
    cut = read_mesh(job.stage("mesh") / "mesh.glb")
    assert isinstance(cut, TexturedMesh)
    assert 20 < len(cut.faces) == few["num_faces"] < len(field.faces)
    assert (cut.vertices > low - 1e-4).all()
    assert (cut.vertices < high + 1e-4).all()
    with pytest.raises(ExportError) as caught:
        tiny_job.run(job, "mesh", crop=crop | {"center": (1e5, 0.0, 0.0)}, **wanted)
    assert caught.value.code == "export.empty"


def test_the_mesh_has_the_triangles_asked_for_painted_all_the_same(job: Workspace) -> None:
    whole = {"method": "tsdf", "extent": "scene"}
    before = tiny_job.run(job, "mesh", texture="none", **whole)["summary"]
    full = read_ply(job.stage("mesh") / "mesh.ply")
    third = before["num_faces"] // 3
    after = tiny_job.run(job, "mesh", triangles=third, **whole)["summary"]
    assert after["num_faces"] == pytest.approx(before["num_faces"] / 3, rel=0.05)
    few = read_ply(job.stage("mesh") / "mesh.ply")
    painted = read_mesh(job.stage("mesh") / "mesh.glb")
    assert isinstance(painted, TexturedMesh)
    assert len(painted.faces) == len(few.faces) == after["num_faces"]
    # It lies on the full one; and is where that one is, but for splinters, of which a model of a
    # few steps has many: they go whole.
    voxel = before["voxel"]
    coarsest = max(voxel, *(shell["voxel"] for shell in before["shells"]))
    to_full, _ = cKDTree(_spots(full)).query(_spots(few))
    to_few, _ = cKDTree(_spots(few)).query(_spots(full))
    assert np.quantile(to_full, 0.99) < voxel
    assert np.median(to_few) < voxel
    assert np.quantile(to_few, 0.75) < coarsest


def _spots(mesh: Ply) -> np.ndarray:
    """Points on a mesh, evenly by area."""
    shape = trimesh.Trimesh(mesh.points, mesh.faces, process=False)
    return np.asarray(shape.sample(20_000, seed=0))


def _lie_within(points: np.ndarray, bounds: dict[str, Any]) -> None:
    low, high = (np.asarray(bounds[key]) for key in ("box_min", "box_max"))
    assert np.all(points >= low - 1e-3)
    assert np.all(points <= high + 1e-3)


def test_the_subject_alone_ends_where_its_bounds_do(job: Workspace) -> None:
    near = {"max_distance": 0.6, "max_faces": 3000, "texture": "none"}
    subject = tiny_job.run(job, "mesh", extent="subject", **near)["summary"]
    assert subject["shells"] == []
    alone = read_ply(job.stage("mesh") / "mesh.ply")
    _lie_within(alone.points, subject["bounds"])
    scene = tiny_job.run(job, "mesh", extent="scene", **near)["summary"]
    whole = read_ply(job.stage("mesh") / "mesh.ply")
    assert scene["bounds"] == subject["bounds"]
    assert len(scene["shells"]) >= 1
    assert np.ptp(whole.points, axis=0).max() > 1.2 * np.ptp(alone.points, axis=0).max()


def test_who_walked_round_a_thing_gets_it_besides_the_mesh(job: Workspace) -> None:
    plain = tiny_job.run(job, "mesh", extent="scene", frame="normalised")["summary"]
    assert plain["subject"] is None
    assert not (job.stage("mesh") / "subject.glb").exists()
    whole = (job.stage("mesh") / "mesh.glb").read_bytes()
    found = tiny_job.run(job, "mesh", frame="normalised")["summary"]["subject"]
    assert (job.stage("mesh") / "mesh.glb").read_bytes() == whole, "it covers what was filmed"
    assert (found["kind"], found["file"]) == ("subject", "subject.glb"), found
    path = job.stage("mesh") / "subject.glb"
    assert problems_of(path) == []
    cut, mesh = read_mesh(path), read_mesh(job.stage("mesh") / "mesh.glb")
    assert isinstance(cut, TexturedMesh)
    assert 100 < len(cut.faces) == found["num_faces"] < len(mesh.faces)
    # In the file it stands in the world's axes; read back it lies over the mesh.
    region = found["region"]
    away = cut.vertices - np.asarray(region["center"])
    turn = -np.radians(region["rotation_deg"][2])
    away = away @ np.array(
        [[np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0], [0, 0, 1]]
    )
    assert (np.abs(away) <= np.asarray(region["size"]) / 2.0 + 1e-4).all()
    off, _ = cKDTree(mesh.vertices).query(cut.vertices)
    assert np.median(off) < 1e-3
    back = np.asarray(found["world_from_subject"])
    y_up = np.asarray(open3d.io.read_triangle_mesh(path).vertices)
    z_up = np.stack([y_up[:, 0], -y_up[:, 2], y_up[:, 1]], axis=1)
    np.testing.assert_allclose(
        np.sort(z_up + back[:, 3], axis=0), np.sort(cut.vertices, axis=0), atol=1e-4
    )
    with Image.open(job.stage("mesh") / "subject.jpg") as picture:
        assert picture.width == 4 * picture.height


def test_a_subject_asked_for_is_the_mesh_and_a_crop_overrides_it(job: Workspace) -> None:
    found = tiny_job.run(job, "mesh", extent="subject", texture="none")["summary"]["subject"]
    assert found["file"] is None
    assert not (job.stage("mesh") / "subject.glb").exists()
    mesh = read_mesh(job.stage("mesh") / "mesh.glb")
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    size, center = np.asarray(found["region"]["size"]), np.asarray(found["region"]["center"])
    assert (np.abs(mesh.vertices[:, 2] - center[2]) <= size[2] / 2.0 + 1e-4).all()
    assert (high - low)[:2].max() <= np.hypot(*size[:2])
    crop = {"shape": "box", "center": center.tolist(), "size": (0.8 * size).tolist()}
    by_hand = tiny_job.run(job, "mesh", crop=crop, texture="none")["summary"]
    assert by_hand["subject"] is None
    assert not (job.stage("mesh") / "subject.glb").exists()


def test_a_crop_that_holds_nothing_is_an_error(job: Workspace) -> None:
    with pytest.raises(ExportError) as caught:
        tiny_job.run(job, "mesh", max_distance=1e-6, extent="subject")
    assert caught.value.code == "empty_mesh"
    assert "max_distance" in caught.value.hint
    assert not job.stage("mesh").exists()


def test_a_cancel_ends_the_stage(job: Workspace) -> None:
    with pytest.raises(Cancelled):
        tiny_job.run_with(job, "mesh", RunHooks(is_cancelled=lambda: True))
    assert not job.stage("mesh").exists()


@pytest.mark.parametrize(
    ("part", "changes"),
    [
        ("fusing depth", {"method": "poisson"}),
        ("fusing depth", {"method": "marching_cubes"}),
        ("moving outlines", {"refine": "photos"}),
        ("painting", {}),
        ("painting", {"texture": "field"}),
        ("cutting out the subject", {"extent": "auto"}),
    ],
)
def test_a_cancel_is_noticed_at_the_next_word_of_any_part(
    job: Workspace, part: str, changes: dict[str, Any]
) -> None:
    messages: list[str] = []
    hooks = RunHooks(
        on_progress=lambda fraction, message, eta_s: messages.append(message),
        is_cancelled=lambda: part in messages,
    )
    with pytest.raises(Cancelled):
        tiny_job.run_with(job, "mesh", hooks, lods=1, **PLAIN | changes)
    assert messages.count(part) == 1, "it says no more after the cancel"
    assert not job.stage("mesh").exists()


def test_levels_of_detail_are_coarser_copies_in_the_same_place(job: Workspace) -> None:
    wanted = {"extent": "scene", "refine": "none", "lods": 2}
    summary = tiny_job.run(job, "mesh", **wanted)["summary"]
    full = read_mesh(job.stage("mesh") / "mesh.glb")
    size, triangles = np.ptp(full.vertices, axis=0).max(), len(full.faces)
    tensor: Any = open3d.core.Tensor  # its stubs refuse its own documented calls
    surface = open3d.t.geometry.RaycastingScene()
    surface.add_triangles(
        tensor(full.vertices.astype(np.float32)), tensor(full.faces.astype(np.uint32))
    )
    assert [level["file"] for level in summary["levels"]] == ["mesh-lod1.glb", "mesh-lod2.glb"]
    for level in summary["levels"]:
        coarse = read_mesh(job.stage("mesh") / level["file"])
        assert isinstance(coarse, TexturedMesh)
        assert len(coarse.faces) == level["num_faces"] == pytest.approx(triangles / 4, rel=0.1)
        assert max(coarse.texture.shape) == level["texture_px"]
        off = surface.compute_distance(tensor(coarse.vertices.astype(np.float32))).numpy()
        assert np.percentile(off, 95) < 0.02 * size
        triangles = len(coarse.faces)
    artifacts = {artifact.name for artifact in get_stage("mesh").artifacts}
    assert {path.name for path in job.stage("mesh").glob("*.glb")} <= artifacts
    assert not (job.stage("mesh") / "mesh-lod3.glb").exists()


def test_every_glb_can_have_its_picture_as_a_ktx2(job: Workspace) -> None:
    wanted = {"glb_texture": "ktx2", "glb_compressed": True, "lods": 1, "texture_px": 1024, **ROUGH}
    told: list[tuple[str, float]] = []
    hooks = RunHooks(on_progress=lambda share, message, eta_s: told.append((message, share)))
    summary = tiny_job.run_with(job, "mesh", hooks, **wanted)["summary"]
    written = [
        share for message, share in told if message in ("writing", "cutting out the subject")
    ]
    assert written == sorted(written)
    assert len([share for share in written if 0.96 < share < 0.98]) > 8
    assert len([share for share in written if share > 0.98]) > 4
    for name in ("mesh.glb", "mesh-lod1.glb", "subject.glb"):
        data = (job.stage("mesh") / name).read_bytes()
        assert b'"extensionsRequired":["KHR_mesh_quantization","EXT_meshopt_compression",' in data
        assert b'"KHR_texture_basisu"]' in data
        assert b"image/jpeg" not in data
        found = read_mesh(job.stage("mesh") / name)
        assert isinstance(found, TexturedMesh)
        if name == "mesh.glb":
            assert max(found.texture.shape) == summary["texture_px"]
            assert found.texture.std() > 5.0


def test_a_mesh_for_which_memory_has_no_room_is_coarser_and_says_so(
    job: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = {"extent": "scene", "refine": "none", "texture": "none"}
    fine = tiny_job.run(job, "mesh", **plain)["summary"]
    assert fine["coarser"] is None
    monkeypatch.setattr(tsdf, "MOST_BLOCKS", 40)
    coarse = tiny_job.run(job, "mesh", **plain)["summary"]
    assert coarse["coarser"]["asked_voxel"] == fine["voxel"]
    assert coarse["voxel"] > 1.2 * fine["voxel"]
    assert "mesh.resolution" in coarse["coarser"]["reason"]
    assert coarse["num_faces"] < fine["num_faces"]


def test_holes_up_to_a_stated_size_are_closed_and_the_report_says_how_many(job: Workspace) -> None:
    plain = {"texture": "none", "extent": "scene", "method": "tsdf"}
    torn = tiny_job.run(job, "mesh", close_holes=0.0, **plain)["summary"]
    before = read_ply(job.stage("mesh") / "mesh.ply")
    assert torn["holes"] == {"closed": 0, "left_open": {}}
    closed = tiny_job.run(job, "mesh", close_holes=0.5, **plain)["summary"]
    after = read_ply(job.stage("mesh") / "mesh.ply")
    assert closed["holes"]["closed"] > 0
    assert set(closed["holes"]["left_open"]) <= {"outer", "seen_through", "occupied", "tangled"}
    assert len(border_loops(after.faces)) < len(border_loops(before.faces))
    assert len(after.faces) > len(before.faces)
    # The rest stays. Outlines are moved afterwards, and those that a hole was beside otherwise.
    moved = cKDTree(after.points).query(before.points)[0]
    assert np.quantile(moved, 0.9) < 0.01 * closed["voxel"]
    assert np.quantile(moved, 0.99) < closed["voxel"]


def test_a_subject_to_be_printed_is_watertight_and_others_are_told_not_to_be(
    job: Workspace, caplog: pytest.LogCaptureFixture
) -> None:
    wanted = {"texture": "none", "refine": "none", "extent": "subject", "formats": ("stl",)}
    for watertight in (False, True):
        found = tiny_job.run(job, "mesh", watertight=watertight, **wanted)["summary"]
        assert found["watertight"] is watertight
        read = trimesh.load_mesh(job.stage("mesh") / "mesh.stl")
        assert read.is_watertight is watertight
        assert read.is_winding_consistent
    assert "not watertight" not in caplog.text
    monkey = pytest.MonkeyPatch()
    with monkey.context() as patch:
        patch.setattr(mesh_shape, "made_watertight", lambda mesh, *others: mesh)
        found = tiny_job.run(job, "mesh", watertight=True, **PLAIN, texture="none")["summary"]
    assert found["watertight"] is False
    assert "The mesh is not watertight" in caplog.text


def test_where_a_camera_was_is_nothing_whether_its_photo_was_held_out_or_not(
    job: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Asked from a third of the photos, and from the others' places."""
    places: list[list[np.ndarray]] = []

    def record(mesh: Any, views: Any, poll: Any) -> Any:
        places.append([view.world_from_camera[:3, 3] for part in views for view in part])
        assert all((view.z_depth > 0.0).mean() > 0.2 for part in views for view in part)
        return mesh

    monkeypatch.setattr(mesh_shape, "unblocked", record)
    tiny_job.run(job, "mesh", num_views=8, formats=("ply",), **PLAIN)
    cameras = CamerasFile.load(job.stage("train") / "cameras.json")
    eyes = np.asarray([image.world_from_camera for image in cameras.images])[:, :3, 3]
    assert len(eyes) == tiny_job.NUM_IMAGES
    (asked,) = places
    np.testing.assert_allclose(np.sort(np.asarray(asked), axis=0), np.sort(eyes, axis=0), atol=1e-6)
