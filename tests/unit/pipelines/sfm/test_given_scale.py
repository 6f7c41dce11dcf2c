"""The scale of refined poses by their path and by a sensor, on a made wall with a box before it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipelines.scene.cameras_file import Intrinsics
from pipelines.scene.sensor_depth import save_sensor_depth
from pipelines.sfm.given_depth import Beside, between, one_surface, points_beside
from pipelines.sfm.given_refinement import Refined, onto
from pipelines.sfm.given_scale import Scale, path_uncertainty, scaled, sensor_uncertainty, weighed
from pipelines.sfm.tracks import Observations

NUM = 30
LENS = Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0)
WIDE, HIGH = 160, 120
FAR, NEAR = 3.0, 1.5
"""Metres to the wall, and to the box before it, whose edges are at whole metres."""
Floats = np.ndarray


def true_poses() -> Floats:
    """[NUM, 3, 4], OpenCV axes: past the wall."""
    poses = np.tile(np.eye(3, 4), (NUM, 1, 1))
    along = np.linspace(0.0, 4.0, NUM)
    poses[:, :, 3] = np.stack([along, 0.3 * np.sin(along), 0.1 * np.cos(along)], 1)
    return poses


TRUTH = true_poses()
EXTENT = float(np.linalg.norm(np.ptp(TRUTH[:, :, 3], axis=0)))


def is_near(x: Floats) -> Floats:
    """Whether the box is there."""
    return np.floor(x).astype(int) % 2 == 0


def true_depth(pose: Floats) -> Floats:
    """[HIGH, WIDE]: the wall and the box, which has no sides."""
    u, _ = np.meshgrid((np.arange(WIDE) + 0.5) * 4, (np.arange(HIGH) + 0.5) * 4)
    ahead = (u - LENS.cx) / LENS.fl_x
    near, far = NEAR - pose[2, 3], FAR - pose[2, 3]
    return np.where(is_near(pose[0, 3] + ahead * near), near, far)


def flying(z: Floats) -> Floats:
    """With what a sensor makes of edges: depths that nothing has, over three pixels."""
    mixed = z.copy()
    edge = np.abs(np.diff(z, axis=1)) > 0.5
    for shift in (-1, 0, 1):
        rows, columns = np.nonzero(edge)
        columns = np.clip(columns + shift, 0, WIDE - 1)
        mixed[rows, columns] = NEAR + 0.8 * (FAR - NEAR) * np.linspace(0.9, 1.1, len(rows))
    return mixed


def places(num: int = 400, at_edges: bool = False) -> Floats:
    """Points [num, 3] on wall and box, all on the box's edges or anywhere."""
    random = np.random.default_rng(4)
    x, y = random.uniform(-0.8, 4.8, num), random.uniform(-0.6, 0.6, num)
    if at_edges:
        x = np.round(x) - np.where(is_near(np.round(x)), -0.01, 0.01)
    return np.stack([x, y, np.where(is_near(x), NEAR, FAR)], 1)


def found(points: Floats, given: Floats | None = None) -> Refined:
    """What refinement finds: the true shape, moved onto the given poses as a whole."""
    poses = TRUTH if given is None else onto(given, TRUTH, TRUTH)
    factor = np.linalg.norm(np.ptp(poses[:, :, 3], axis=0)) / EXTENT
    local = points[None] - TRUTH[:, None, :, 3]
    pixels = local[..., :2] / local[..., 2:] * LENS.fl_x + (LENS.cx, LENS.cy)
    inside = ((pixels > 0) & (pixels < (LENS.width, LENS.height))).all(axis=2)
    box = NEAR - TRUTH[:, None, 2, 3]
    before = TRUTH[:, None, 0, 3] + local[..., 0] / local[..., 2] * box
    is_hidden = (points[None, :, 2] == FAR) & is_near(before)
    image, track = np.nonzero(inside & ~is_hidden)
    order = np.argsort(track, kind="stable")
    image, track = image[order], track[order]
    turn = poses[0, :, :3] @ TRUTH[0, :, :3].T
    moved = factor * (points - TRUTH[0, :, 3]) @ turn.T + poses[0, :, 3]
    every, none = np.ones(NUM, bool), np.zeros(NUM, bool)
    seen = Observations(track, image, pixels[image, track])
    lengths = np.bincount(track, minlength=len(points))
    return Refined(poses, (LENS,) * NUM, every, none, moved, lengths, seen)


def drifted(size: float, scale: float = 1.0) -> Floats:
    """Given poses that waver by so many metres, and as a whole are so much larger."""
    along = np.linspace(0.0, 2 * np.pi, NUM)
    waves = np.stack([np.sin(3 * along), np.cos(2 * along), np.sin(2 * along + 1)], 1)
    poses = TRUTH.copy()
    middle = poses[:, :, 3].mean(axis=0)
    poses[:, :, 3] = middle + scale * (poses[:, :, 3] - middle) + size * waves
    return poses


def maps(
    folder: Path, *, bias: float = 1.0, noise: float = 0.0, unsteady: float = 0.0
) -> list[Path]:
    """The sensor's depth of each picture, in files. noise: of each pixel. unsteady: of each map."""
    random = np.random.default_rng(5)
    files = []
    for index, pose in enumerate(TRUTH):
        z = bias * flying(true_depth(pose)) * np.exp(unsteady * random.normal())
        z = z * np.exp(noise * random.normal(size=z.shape))
        files.append(folder / f"{index:05d}.npz")
        save_sensor_depth(files[-1], z.astype(np.float32))
    return files


def length_of(scale: Scale, refined: Refined) -> float:
    """The path's length in that of the true one, once it was scaled."""
    poses = scaled(refined, scale.factor, np.zeros(3)).poses
    return float(np.linalg.norm(np.ptp(poses[:, :, 3], axis=0)) / EXTENT)


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_path_that_drift_made_smaller_gets_its_scale_from_the_sensor(
    tmp_path: Path, noise: float
) -> None:
    given = drifted(0.08, 0.98)
    refined = found(places(), given)
    assert length_of(Scale(1.0, "", 0.0), refined) < 0.985
    beside = points_beside(refined, [LENS] * NUM, maps(tmp_path, noise=noise))
    scale = weighed(given, refined, beside)
    assert abs(length_of(scale, refined) - 1.0) < 0.005
    assert scale.weight > 0.5
    assert not scale.is_contradicted
    assert scale.as_dict()["believed"] == "path and sensor"


@pytest.mark.parametrize(
    ("sensor", "is_told"),
    [
        ({"bias": 1000.0}, True),
        ({"bias": 0.001}, True),
        ({"bias": 1.05}, True),
        ({"bias": 0.95, "noise": 0.01}, True),
        ({"unsteady": 0.12}, False),
    ],
)
def test_a_sensor_that_cannot_be_right_is_not_believed(
    tmp_path: Path, sensor: dict[str, float], is_told: bool
) -> None:
    given = drifted(0.02, 0.995)
    refined = found(places(), given)
    beside = points_beside(refined, [LENS] * NUM, maps(tmp_path, **sensor))
    assert beside is not None
    scale = weighed(given, refined, beside)
    assert scale.factor == 1.0
    assert scale.as_dict()["believed"] == "path"
    assert scale.is_contradicted is is_told
    if "bias" in sensor:
        assert scale.by_sensor == pytest.approx(
            sensor["bias"] / length_of(Scale(1.0, "", 0.0), refined), rel=0.003
        )


def test_a_path_that_hardly_drifts_keeps_its_scale_beside_a_sensor_that_is_a_little_off(
    tmp_path: Path,
) -> None:
    given = drifted(0.003)
    refined = found(places(), given)
    scale = weighed(given, refined, points_beside(refined, [LENS] * NUM, maps(tmp_path, bias=1.01)))
    assert abs(length_of(scale, refined) - 1.0) < 0.002


def test_points_at_the_edges_of_things_are_not_compared_with_depths_that_nothing_has(
    tmp_path: Path,
) -> None:
    both = np.concatenate([places(60), places(340, at_edges=True)])
    beside = points_beside(found(both), [LENS] * NUM, maps(tmp_path))
    assert beside is not None
    assert beside.ratio == pytest.approx(1.0, abs=0.002)
    assert beside.spread < 0.005
    assert points_beside(found(places(400, at_edges=True)), [LENS] * NUM, maps(tmp_path)) is None


def test_points_that_were_seen_from_one_direction_only_say_nothing(tmp_path: Path) -> None:
    refined = found(places())
    standing = np.tile(TRUTH[:1, :, 3:], (NUM, 1, 1))
    one_way = replace(refined, poses=np.concatenate([TRUTH[:, :, :3], standing], axis=2))
    assert points_beside(one_way, [LENS] * NUM, maps(tmp_path)) is None


@pytest.mark.parametrize("which", ["few points", "few maps", "no maps", "broken maps", "noise"])
def test_too_little_depth_leaves_the_path_its_scale(tmp_path: Path, which: str) -> None:
    files: list[Path | None] = list(maps(tmp_path, noise=0.2 if which == "noise" else 0.0))
    if which == "few maps":
        files = [path if index < 4 else None for index, path in enumerate(files)]
    if which == "no maps":
        files = [None] * NUM
    if which == "broken maps":
        for path in maps(tmp_path):
            path.write_bytes(b"no map")
    given = drifted(0.08, 0.98)
    refined = found(places(8 if which == "few points" else 400), given)
    beside = points_beside(refined, [LENS] * NUM, files)
    assert beside is None
    scale = weighed(given, refined, beside)
    assert (scale.factor, scale.by_sensor) == (1.0, None)
    assert not scale.is_contradicted


def test_what_a_path_is_uncertain_by_is_what_drift_does_to_its_scale() -> None:
    """Random drift: its errors of scale, in what each time was said of them, have a spread of 1."""
    random = np.random.default_rng(8)
    parts = []
    for _ in range(200):
        given = TRUTH.copy()
        steps = np.cumsum(random.normal(size=(NUM, 3)), axis=0) / np.sqrt(NUM)
        given[:, :, 3] += 0.01 * EXTENT * steps
        refined = found(places(4), given)
        off = float(np.log(np.linalg.norm(np.ptp(refined.poses[:, :, 3], axis=0)) / EXTENT))
        parts.append(off / path_uncertainty(given, refined.poses, np.ones(NUM, bool)))
    assert 0.5 < np.sqrt(np.mean(np.square(parts))) < 1.5


def test_path_and_sensor_together_err_less_than_either_alone() -> None:
    random = np.random.default_rng(9)
    by_path: list[float] = []
    by_sensor: list[float] = []
    by_both: list[float] = []
    for _ in range(300):
        given = TRUTH.copy()
        steps = np.cumsum(random.normal(size=(NUM, 3)), axis=0) / np.sqrt(NUM)
        given[:, :, 3] += random.uniform(0.001, 0.015) * EXTENT * steps
        refined = found(places(4), given)
        path = float(np.linalg.norm(np.ptp(refined.poses[:, :, 3], axis=0))) / EXTENT
        sensor = float(np.exp(0.007 * random.normal()))
        scale = weighed(given, refined, Beside(path / sensor, 0.01, 2.0, 900, NUM))
        for errors, length in (
            (by_path, path),
            (by_sensor, sensor),
            (by_both, path * scale.factor),
        ):
            errors.append(float(np.log(length)))
    spread = [np.sqrt(np.mean(np.square(errors))) for errors in (by_path, by_sensor, by_both)]
    assert spread[2] < 0.9 * min(spread[:2])
    assert np.mean(np.abs(by_both) > 0.01) < 0.5 * np.mean(np.abs(by_path) > 0.01)


def test_a_row_mixed_up_says_nothing_of_the_path() -> None:
    given = drifted(0.02)
    plain = path_uncertainty(given, TRUTH, np.ones(NUM, bool))
    given[[4, 20]] = given[[20, 4]]
    assert path_uncertainty(given, TRUTH, np.ones(NUM, bool)) == pytest.approx(plain, rel=0.2)
    assert path_uncertainty(given, TRUTH, np.arange(NUM) < 2) == np.inf
    assert path_uncertainty(TRUTH[:1].repeat(NUM, 0), TRUTH[:1].repeat(NUM, 0), np.ones(NUM, bool))


def test_a_sensor_close_by_is_less_certain(tmp_path: Path) -> None:
    beside = points_beside(found(places()), [LENS] * NUM, maps(tmp_path))
    assert beside is not None
    close = Beside(1.0, beside.spread, 0.3, beside.num_places, beside.num_images)
    assert sensor_uncertainty(close) > 2 * sensor_uncertainty(beside)


def test_depth_between_pixels_is_that_of_a_slanted_plane() -> None:
    u, v = np.meshgrid(np.arange(20) + 0.5, np.arange(12) + 0.5)
    z = (1.0 / (0.4 + 0.01 * u - 0.006 * v)).astype(np.float32)
    xy = np.random.default_rng(2).uniform((0.5, 0.5), (19.5, 11.5), (50, 2))
    wanted = 1.0 / (0.4 + 0.01 * xy[:, 0] - 0.006 * xy[:, 1])
    np.testing.assert_allclose(between(z, xy), wanted, rtol=1e-5)
    z[5, 7] = 0.0
    assert between(z, np.array([[7.6, 5.4], [9.6, 5.4]])).tolist()[0] == 0.0
    assert between(z, np.array([[9.6, 5.4]]))[0] > 0


def test_a_step_and_its_neighbours_are_no_surface() -> None:
    z = np.full((9, 12), 2.0, np.float32)
    z[:, 6:] = 3.0
    z[4, 2] = 0.0
    kept = one_surface(z) > 0
    assert not kept[:, 5:7].any()
    assert not kept[3:6, 1:4].any()
    assert kept[1:-1, 8:-1].all()
    assert not kept[0].any()
    slanted = np.tile(np.linspace(2.0, 2.5, 12, dtype=np.float32), (9, 1))
    assert (one_surface(slanted) > 0)[1:-1, 1:-1].all()
