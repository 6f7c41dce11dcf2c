"""The room and the object: exact depth, gloss that depends on the view, exposure, ways to film."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.sample import tracing
from pipelines.sample.film import phone_camera, render_all, walk
from pipelines.sample.scene import (
    SAMPLE,
    Floats,
    Primitive,
    Scene,
    depth_image,
    pixel_rays,
    pose_matrix,
    raycast,
    render,
    surface_distance,
)
from pipelines.sample.scenes import cafe, exhibit, furniture, monument, room
from pipelines.sample.scenes import object as object_on_stand
from pipelines.sample.scenes.catalogue import TAKES
from pipelines.sample.takes import Take
from pipelines.scene.cameras_file import Intrinsics

NEW = (room.TAKE, object_on_stand.TAKE, furniture.TAKE, cafe.TAKE, monument.TAKE, exhibit.TAKE)


def _rays(take: Take, num: int) -> tuple[Floats, Floats]:
    """Rays from the way of the camera into all directions."""
    random = np.random.default_rng(0)
    origins = np.stack([take.pose(p)[:, 3] for p in random.random(num)])
    directions = random.normal(size=(num, 3))
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize("take", NEW, ids=lambda take: take.scene.name)
def test_every_hit_lies_on_the_surface_and_no_surface_before_it(take: Take) -> None:
    origins, directions = _rays(take, 6000)
    hits = raycast(origins, directions, take.scene)
    points = origins + hits.t[:, None] * directions
    assert surface_distance(points, take.scene).max() < 1e-8
    for share in (0.3, 0.7, 0.95):
        between = origins + share * hits.t[:, None] * directions
        inside = surface_distance(between, take.scene)
        assert inside.min() >= 0.0
    # March by the distance to the surface: slow and independent.
    t = np.zeros(800)
    for _ in range(600):
        gap = surface_distance(origins[:800] + t[:, None] * directions[:800], take.scene)
        t += np.where(gap > 1e-7, gap, 0.0)
    assert (t <= hits.t[:800] + 1e-8).all()
    assert np.mean(hits.t[:800] - t < 1e-4) > 0.98


@pytest.mark.parametrize("take", NEW, ids=lambda take: take.scene.name)
def test_all_things_are_seen_and_the_camera_stays_outside_them(take: Take) -> None:
    truth = walk(40, phone_camera(120), take=take)
    seen: set[int] = set()
    for image in truth.images:
        pose = pose_matrix(image)
        assert take.scene.room.contains(pose[None, :, 3]).all()
        assert surface_distance(pose[None, :, 3], take.scene)[0] > 0.15
        rotation = pose[:, :3]
        assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1.0)
        assert rotation[2, 1] > 0.6
        y, x = np.mgrid[0:120:3, 0:68:3]
        pixels = np.stack([x.ravel() + 0.5, y.ravel() + 0.5], axis=1)
        origins, directions = pixel_rays(truth.cameras[0], pose, pixels)
        seen |= set(raycast(origins, directions, take.scene).primitive.tolist())
    missing = set(range(len(take.scene.primitives))) - seen
    assert len(missing) <= 1, [take.scene.primitives[index] for index in missing]


def test_depth_of_a_wall_follows_the_closed_form() -> None:
    lens = Intrinsics(60, 40, 50.0, 50.0, 30.0, 20.0)
    # From the middle of the room towards -Y, above the shelf: z-depth of a plane is constant.
    level = np.array([[1.0, 0.0, 0.0, -0.3], [0.0, 0.0, 1.0, -0.4], [0.0, 1.0, 0.0, 1.9]])
    depth = depth_image(lens, level, room.SCENE)
    assert depth[:20] == pytest.approx(1.6, abs=1e-9)


def test_the_pole_is_one_percent_of_the_room_and_the_handle_is_thin() -> None:
    share = 2 * room.POLE_RADIUS_M / room.SCENE.subject.size
    assert share == pytest.approx(0.01, rel=0.01)
    origin = np.array([[0.0, -1.2, 1.5], [0.0, -1.2 - 0.026, 1.5]])
    hits = raycast(origin, np.array([[-1.0, 0.0, 0.0]] * 2), room.SCENE)
    assert hits.t[0] == pytest.approx(1.2 - room.POLE_RADIUS_M, abs=1e-9)
    assert hits.t[1] == pytest.approx(2.5, abs=0.1)


def test_a_ring_is_hit_on_its_near_side_and_through_its_hole_what_is_behind() -> None:
    scene = object_on_stand.SCENE
    ring = next(thing for thing in scene.primitives if thing.kind == tracing.TORUS)
    center = np.array(ring.center)
    ahead = np.array([[0.0, 1.0, 0.0]])
    far = 2.8 - (center[1] - 1.0)
    through = raycast(center[None] - [[0.0, 1.0, 0.0]], ahead, scene)
    assert through.t[0] > 1.2
    assert through.t[0] <= far
    top = np.add(center, [0.0, -1.0, ring.size[0]])
    onto = raycast(top[None], ahead, scene)
    assert onto.t[0] == pytest.approx(1.0 - ring.size[1], abs=1e-9)
    assert onto.normal[0] == pytest.approx([0.0, -1.0, 0.0], abs=1e-6)
    side = np.add(center, [0.0, -1.0, ring.size[0] + 0.5 * ring.size[1]])
    tube = raycast(side[None], ahead, scene)
    assert tube.t[0] == pytest.approx(1.0 - np.sqrt(0.75) * ring.size[1], abs=1e-9)


def test_ring_distance_equals_a_search_over_its_surface() -> None:
    ring = Primitive(tracing.TORUS, (0.1, -0.2, 0.5), (0.3, 0.05), 0.1, 0, 35.0)
    scene = Scene("ring", (SAMPLE.primitives[0], ring), SAMPLE.palettes, SAMPLE.light,
                  SAMPLE.subject, SAMPLE.things)  # fmt: skip
    a, b = np.meshgrid(np.linspace(0, 2 * np.pi, 400), np.linspace(0, 2 * np.pi, 120))
    rho = 0.3 + 0.05 * np.cos(b)
    local = np.stack([rho * np.cos(a), 0.05 * np.sin(b), rho * np.sin(a)], axis=-1).reshape(-1, 3)
    c, s = np.cos(np.radians(35.0)), np.sin(np.radians(35.0))
    surface = local @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]]) + ring.center
    assert surface_distance(surface, scene).max() < 1e-9
    random = np.random.default_rng(1)
    points = np.array(ring.center) + random.uniform(-0.4, 0.4, (50, 3))
    points = points[points[:, 2] > 0.2]
    searched = np.linalg.norm(points[:, None] - surface[None], axis=2).min(axis=1)
    exact = np.minimum(surface_distance(points, scene), 1e9)
    near = searched < points[:, 2] - 0.05
    assert exact[near] == pytest.approx(searched[near], abs=2e-3)
    # Rays onto the turned ring end on its surface, grazing ones too.
    origins = np.repeat([[0.1, -1.5, 0.6]], 4000, axis=0)
    ways = surface[random.choice(len(surface), 4000)] + random.normal(size=(4000, 3)) * 0.01
    ways = ways - origins
    hits = raycast(origins, ways / np.linalg.norm(ways, axis=1, keepdims=True), scene)
    onto = hits.primitive == 1
    assert onto.mean() > 0.7
    points = origins + hits.t[:, None] * ways / np.linalg.norm(ways, axis=1, keepdims=True)
    assert surface_distance(points[onto], scene).max() < 1e-6
    assert (np.einsum("nk,nk->n", hits.normal, ways)[onto] < 0).all()


def _colors_from(eyes: Floats, point: Floats, scene: Scene) -> Floats:
    ways = point - eyes
    return raycast(eyes, ways / np.linalg.norm(ways, axis=1, keepdims=True), scene).color


def test_gloss_depends_on_the_view_and_matt_paint_does_not() -> None:
    scene = object_on_stand.SCENE
    ball = next(thing for thing in scene.primitives if thing.gloss > 0)
    eyes = np.array([[0.5, -1.2, 1.3], [-0.6, -1.2, 1.2], [0.1, -1.4, 1.0]])
    on_ball = np.array(ball.center) + ball.size[0] * np.array([0.0, -0.8, 0.6])
    assert np.ptp(_colors_from(eyes, on_ball, scene), axis=0).max() > 0.02
    box = next(thing for thing in scene.primitives if thing.kind == tracing.BOX)
    on_box = np.add(box.center, [0.0, 0.0, box.size[2]])
    eyes = np.array([[0.3, 1.2, 1.3], [-0.6, 1.1, 1.2], [0.0, 1.3, 1.1]])
    assert np.ptp(_colors_from(eyes, on_box, scene), axis=0).max() < 1e-4


def test_walls_and_table_are_plain_and_the_window_is_clipped() -> None:
    scene = room.SCENE
    lens, pose = phone_camera(240), room.pose(0.97)
    towards = raycast(*_towards([(x, 1.975, 1.4) for x in (-0.9, -0.3)]), scene)
    assert (towards.color > 1.0).all()
    walls = raycast(*_towards([(2.5, y, 1.9) for y in (-1.0, -0.98, -0.96)]), scene)
    assert np.ptp(walls.color, axis=0).max() < 0.01
    assert walls.color.min() > 0.5
    dim, bright = (render(lens, pose, scene, gain).astype(float) for gain in (0.5, 1.0))
    unclipped = (bright < 250) & (bright > 20)
    ratio = (dim[unclipped] / bright[unclipped]).mean()
    assert ratio == pytest.approx(0.5 ** (1 / 2.2), abs=0.01)


def _towards(points: list[tuple[float, float, float]]) -> tuple[Floats, Floats]:
    """Rays from the middle of the room."""
    origins = np.repeat([[0.0, 0.0, 1.5]], len(points), axis=0)
    ways = np.array(points) - origins
    return origins, ways / np.linalg.norm(ways, axis=1, keepdims=True)


def test_the_rooms_exposure_drifts_smoothly_and_closes_at_the_window() -> None:
    progress = np.linspace(0, 1, 300)
    gains = np.array([room.gain(p) for p in progress])
    assert gains.max() / gains.min() > 1.8
    assert np.abs(np.diff(np.log2(gains))).max() < 0.05
    darkest = room.pose(float(progress[gains.argmin()]))
    to_window = np.array([-0.6, 2.0, 1.5]) - darkest[:, 3]
    assert -darkest[:, 2] @ to_window / np.linalg.norm(to_window) > 0.8
    notes = walk(5, phone_camera(64), take=room.TAKE).notes
    assert notes["gains"] == pytest.approx([room.gain(p) for p in np.linspace(0, 1, 5)])
    assert notes["scene"] == "room"


def test_pictures_of_a_take_are_of_its_scene_at_its_exposure() -> None:
    truth = walk(3, phone_camera(96), take=room.TAKE)
    for image, gain, picture in zip(
        truth.images, truth.notes["gains"], render_all(truth, 1, room.TAKE), strict=True
    ):
        expected = render(truth.cameras[0], pose_matrix(image), room.SCENE, gain)
        assert np.array_equal(picture, expected)


def test_all_round_is_all_round() -> None:
    for take in (room.TAKE, object_on_stand.TAKE):
        assert walk(60, phone_camera(64), take=take).notes["arc_deg"] > 355.0
    assert set(TAKES) == {"bowl", "room", "object", "furniture", "cafe", "monument", "exhibit"}
    gaze = np.array([-room.pose(p)[:, 2] for p in np.linspace(0, 1, 60)])
    outwards = np.array([room.pose(p)[:2, 3] for p in np.linspace(0, 1, 60)])
    assert (np.einsum("nk,nk->n", gaze[:, :2], outwards) > 0).all()
