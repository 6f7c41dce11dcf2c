"""A ball in a large round room: fine around the ball, coarse walls beyond, nothing twice."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipelines.exports.mesh import TriangleMesh
from pipelines.exports.surface.shells import Shell, Subject, find_shells, fuse_shells, seen_share
from pipelines.scene.bounds import SceneBounds, bounds_of_views
from pipelines.scene.depth_views import DepthView, Pinhole, ViewStore
from tests.unit.pipelines.scene.synthetic_views import ring, sphere_view

CENTER = np.array([1000.0, -500.0, 7.0])
LENS = Pinhole(160, 120, 75.0, 75.0, 80.0, 60.0)
WALL = 20.0


def room_view(pose: np.ndarray, lens: Pinhole = LENS) -> DepthView:
    """The unit ball and, behind it, the inside of a ball of radius 20."""
    view = sphere_view(lens, pose, CENTER)
    world = lens.directions() @ pose[:, :3].T
    start = pose[:, 3] - CENTER
    a, b = (world**2).sum(axis=-1), (world * start).sum(axis=-1)
    far = (-b + np.sqrt(b * b - a * ((start**2).sum() - WALL**2))) / a
    return replace(view, z_depth=np.where(view.z_depth > 0, view.z_depth, far).astype(np.float32))


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> ViewStore:
    store = ViewStore(tmp_path_factory.mktemp("views"))
    for pose in ring(24, CENTER):
        store.append(room_view(pose))
    return store


def without_walls(view: DepthView) -> DepthView:
    return replace(view, z_depth=np.where(view.z_depth < 5.0, view.z_depth, 0.0))


def shells_of(
    views: ViewStore, far_distance: float, fine_distance: float = 0.0, pixel: float = 0.0
) -> list[Shell]:
    seen = list(views)
    poses = np.stack([view.world_from_camera for view in seen])
    return find_shells(
        lambda distance: bounds_of_views(seen, poses, distance),
        1.5,
        far_distance,
        64,
        Subject(fine_distance, pixel, [without_walls(view) for view in seen]),
    )


@pytest.fixture(scope="module")
def mesh(views: ViewStore) -> TriangleMesh:
    return fuse_shells(views, shells_of(views, 12.0), 20_000)


def test_voxels_grow_with_the_reach(views: ViewStore) -> None:
    shells = shells_of(views, 12.0)
    inner, outer = shells[0], shells[-1]
    assert inner.bounds.longest_side < 3.0
    assert outer.bounds.longest_side > 30.0
    assert inner.voxel == pytest.approx(inner.bounds.usual_side / 64)
    assert outer.voxel == pytest.approx(inner.voxel * 8.0)


def test_there_is_no_shell_where_there_is_nothing_new(views: ViewStore) -> None:
    assert len(shells_of(views, 1.5)) == 1
    assert len(shells_of(views, 1000.0)) == len(shells_of(views, 13.0))


def test_the_subject_has_voxels_half_as_large(views: ViewStore) -> None:
    plain, fine = shells_of(views, 12.0), shells_of(views, 12.0, fine_distance=1.0)
    assert fine[0].voxel == pytest.approx(0.5 * plain[0].voxel)
    assert fine[0].bounds.radius < fine[1].bounds.radius
    assert [shell.voxel for shell in fine[1:]] == [shell.voxel for shell in plain]
    assert [shell.is_far for shell in fine[:2]] == [False, False]
    assert all(shell.is_far for shell in fine[2:])


def test_no_voxel_is_smaller_than_a_pixel_at_its_shells_rim(views: ViewStore) -> None:
    plain = shells_of(views, 12.0)
    distance = plain[0].bounds.distance
    small = shells_of(views, 12.0, fine_distance=1.0, pixel=0.6 * plain[0].voxel / distance)
    assert small[0].voxel == pytest.approx(0.6 * plain[0].voxel)
    assert [shell.voxel for shell in small[1:]] == [shell.voxel for shell in plain]
    large = 1.1 * plain[0].voxel
    coarse = shells_of(views, 12.0, fine_distance=1.0, pixel=large / distance)
    assert coarse[0].voxel == pytest.approx(large)
    assert coarse[1].voxel == pytest.approx(1.5 * large)
    assert coarse[-1].voxel == pytest.approx(12.0 * large)


def test_a_subject_hardly_finer_than_its_surroundings_needs_no_shell(views: ViewStore) -> None:
    plain = shells_of(views, 12.0)
    pixel = 0.9 * plain[0].voxel / plain[0].bounds.distance
    found = shells_of(views, 12.0, fine_distance=1.3, pixel=pixel / 1.3)
    assert len(found) == len(plain) + 1
    found = shells_of(views, 12.0, fine_distance=0.0, pixel=pixel)
    assert len(found) == len(plain)


@pytest.mark.parametrize(("seen_from", "finer"), [(3.0, 1.0), (1.6, 1.0), (0.3, 5.0)])
def test_the_length_of_a_walk_makes_nothing_coarse(seen_from: float, finer: float) -> None:
    """Cameras up to 3 away from the middle that see things `seen_from` before them."""
    middle = SceneBounds(CENTER, 3.0, 6.0, CENTER - 6.4, CENTER + 6.4)
    pose = np.column_stack([np.eye(3), CENTER])
    near = np.full((120, 160), seen_from, np.float32)
    view = DepthView(LENS, pose, np.zeros((120, 160, 3), np.uint8), near)
    shell, *_ = find_shells(lambda _: middle, 2.0, 2.0, 128, Subject(0.0, 0.0, [view]))
    assert shell.voxel == pytest.approx(0.1 / finer)
    assert shell.distance == pytest.approx(3.0 / finer)
    wide, *_ = find_shells(lambda _: middle, 2.0, 2.0, 128, Subject(0.0, 0.1, [view]))
    assert wide.voxel == pytest.approx(0.1 * 3.0 / finer * 2.0), "no less than a pixel at its rim"


def test_a_small_ball_in_a_large_room_stays(tmp_path: Path) -> None:
    """A lamp whose cord is too thin: a fiftieth of a percent of the room, but all views show it."""
    lens, poses = Pinhole(160, 120, 110.0, 110.0, 80.0, 60.0), ring(16, CENTER)
    store = ViewStore(tmp_path)
    for pose in poses:
        store.append(room_view(pose, lens))
    seen = list(store)
    bounds = bounds_of_views(seen, poses, 12.0)
    assert bounds is not None
    mesh = fuse_shells(store, [Shell(bounds, 0.2)], 200_000)
    around = np.linalg.norm(mesh.vertices - CENTER, axis=1)
    assert (around < 1.3).any(), "the ball is there"
    assert (around > 15.0).any(), "and the walls"


def test_a_room_has_no_subject(views: ViewStore) -> None:
    """Where most of what cameras see is far walls, those are what people came for."""
    seen, plain = list(views), shells_of(views, 12.0)
    share = np.mean([(view.z_depth < 5.0).mean() for view in seen])
    assert seen_share(seen, plain[0].bounds) == pytest.approx(share, abs=0.02)
    assert share < 0.5
    poses = np.stack([view.world_from_camera for view in seen])
    found = find_shells(
        lambda distance: bounds_of_views(seen, poses, distance),
        1.5,
        12.0,
        64,
        Subject(1.0, 0.0, seen),
    )
    assert [shell.voxel for shell in found] == [shell.voxel for shell in plain]


def test_shells_that_cut_a_surface_leave_no_gap_and_no_second_one(views: ViewStore) -> None:
    """The lower half of the ball is in the fine shell, the upper one in the other."""
    inner = shells_of(views, 1.5)[0]
    top = np.array([*inner.bounds.box_max[:2], CENTER[2]])
    lower = Shell(replace(inner.bounds, box_max=top), 0.5 * inner.voxel)
    mesh = fuse_shells(views, [lower, inner], 200_000)
    off = mesh.vertices - CENTER
    lengths = np.linalg.norm(off[mesh.faces] - np.roll(off[mesh.faces], 1, axis=1), axis=-1)
    half = off[mesh.faces].mean(axis=1)[:, 2] < -0.1
    assert np.median(lengths[half]) < 0.7 * np.median(lengths[~half])
    corners = mesh.vertices[mesh.faces]
    twice_areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.linalg.norm(twice_areas, axis=1).sum()
    assert 0.99 * 4.0 * np.pi < area < 1.1 * 4.0 * np.pi


def test_the_ball_is_fine_and_the_walls_are_there(mesh: TriangleMesh) -> None:
    off = np.linalg.norm(mesh.vertices - CENTER, axis=1)
    ball, wall = np.abs(off - 1.0) < 0.1, np.abs(off - WALL) < 0.6
    assert (ball | wall).mean() > 0.999
    assert np.abs(off[ball] - 1.0).mean() < 0.01
    assert wall.sum() > 300
    directions = (mesh.vertices[wall] - CENTER) / off[wall, None]
    octants = (directions > 0) @ np.array([1, 2, 4])
    assert len(np.unique(octants)) == 8, "walls on all sides"


def test_no_surface_is_there_twice(mesh: TriangleMesh) -> None:
    """Coarse faces where the fine shell has its own would lie among them, too large by far."""
    corners = mesh.vertices[mesh.faces]
    on_ball = (np.linalg.norm(corners - CENTER, axis=-1) < 1.2).all(axis=1)
    sides = np.linalg.norm(corners[on_ball] - np.roll(corners[on_ball], 1, axis=1), axis=-1)
    area = 0.5 * np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    assert area[on_ball].sum() < 1.1 * 4.0 * np.pi
    assert sides.max() < 0.3


def test_progress_goes_through_all_shells(views: ViewStore) -> None:
    told: list[float] = []
    fuse_shells(views, shells_of(views, 12.0), 1000, told.append)
    assert told == sorted(told)
    assert told[-1] == 1.0


def test_views_without_surface_have_no_shells(tmp_path: Path) -> None:
    store = ViewStore(tmp_path)
    for pose in ring(4, CENTER):
        view = sphere_view(LENS, pose, CENTER)
        store.append(replace(view, z_depth=np.zeros_like(view.z_depth)))
    assert shells_of(store, 12.0) == []
    assert len(fuse_shells(store, [], 1000).faces) == 0
