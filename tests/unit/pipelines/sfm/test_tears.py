"""Things that look the same from two sides: where a film's path is torn, and how it is mended."""

from __future__ import annotations

import functools
import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

from pipelines.options import PosesOptions
from pipelines.scene.cameras_file import Intrinsics
from pipelines.sfm import rungs
from pipelines.sfm.attempts import Ladder
from pipelines.sfm.checkpoint import Checkpoint
from pipelines.sfm.report import Outcome, build_report, path_warnings
from pipelines.sfm.rungs import RUNGS, Rung, Standing, too_few_registered
from pipelines.sfm.source import Source, read_source
from pipelines.sfm.tears import FilmOrder, impossible, tears
from pipelines.stage import StageContext
from pipelines.tools.colmap import Reconstructor
from pipelines.tools.colmap_results import SparseModel
from pipelines.workspace import Workspace
from tests.unit.pipelines.sfm.synthetic_can import around_poses, render
from tests.unit.pipelines.sfm.synthetic_room import save_photos, save_video_frames

NUM, PHOTOS, LONG = 48, 36, 100
"""Of a path without pictures, with them, and of a film that counts as long here."""
LENS = Intrinsics(400, 300, 380.0, 380.0, 200.0, 150.0)
OPENCV = np.diag([1.0, -1.0, -1.0])
Floats = npt.NDArray[np.float64]
Matches = dict[tuple[int, int], tuple[Floats, Floats]]


def true_poses(num: int = NUM, turn_deg: float = 360.0) -> Floats:
    """[num, 3, 4], OpenCV axes."""
    poses = around_poses(num, turn_deg)
    return np.concatenate([poses[:, :, :3] @ OPENCV, poses[:, :, 3:]], axis=2)


def model_of(poses: Floats, indices: tuple[int, ...] | None = None) -> SparseModel:
    num = len(poses)
    return SparseModel(
        indices=tuple(range(num)) if indices is None else indices,
        cameras=(LENS,),
        camera_of=(0,) * num,
        world_from_camera=poses,
        points=np.zeros((0, 3)),
        colors=np.zeros((0, 3), np.uint8),
        track_lengths=np.zeros(0, np.int64),
        error_px=0.5,
        angle_deg=10.0,
    )


def seen_from(pose: Floats, points: Floats) -> Floats:
    """[M, 2] pixels of points [M, 3]."""
    local = (points - pose[:, 3]) @ pose[:, :3]
    return 380.0 * local[:, :2] / local[:, 2:] + [200.0, 150.0]


def matches_of(poses: Floats, *, alike: bool = True, apart: int = 6) -> Matches:
    """What pairs of frames share: neighbours what is there; opposite ones, too, if alike, what
    looks the same on the other side."""
    random = np.random.default_rng(5)
    half = np.diag([-1.0, -1.0, 1.0])
    found: Matches = {}
    for i in range(len(poses)):
        for j in range(i + 1, len(poses)):
            facing = np.arctan2(poses[i, 1, 3], poses[i, 0, 3])
            angles = facing + random.uniform(-0.4, 0.4, 40)
            points = np.stack(
                [0.4 * np.cos(angles), 0.4 * np.sin(angles), random.uniform(0, 1, 40)], axis=1
            )
            if j - i <= apart:
                found[i, j] = seen_from(poses[i], points), seen_from(poses[j], points)
            elif alike and abs(j - i - len(poses) // 2) <= 3:
                found[i, j] = seen_from(poses[i], points), seen_from(poses[j], points @ half.T)
    return found


def folded(poses: Floats) -> Floats:
    """The second half of the way laid over the first."""
    half = np.diag([-1.0, -1.0, 1.0])
    second = np.arange(len(poses)) >= len(poses) // 2
    return np.where(second[:, None, None], half @ poses, poses)


def test_a_path_is_torn_where_it_jumps_to_the_other_side() -> None:
    poses = true_poses()
    order = FilmOrder.of([range(NUM)])
    matches = matches_of(poses)
    assert tears(model_of(folded(poses)), matches, order) == ((NUM // 2 - 1, NUM // 2),)
    assert tears(model_of(poses), matches, order) == ()


def test_the_place_is_found_though_images_beside_it_are_missing() -> None:
    poses = true_poses()
    left = tuple(i for i in range(NUM) if i not in (10, NUM // 2 - 1, NUM // 2))
    torn = tears(
        model_of(folded(poses)[list(left)], left), matches_of(poses), FilmOrder.of([range(NUM)])
    )
    assert torn == ((NUM // 2 - 2, NUM // 2 + 1),)


def test_a_cut_between_clips_is_no_tear_and_neither_is_a_place_without_matches() -> None:
    poses, matches = folded(true_poses()), matches_of(true_poses())
    clips = FilmOrder.of([range(NUM // 2), range(NUM // 2, NUM)])
    assert tears(model_of(poses), matches, clips) == ()
    half = NUM // 2
    lonely = {pair: found for pair, found in matches.items() if not pair[0] < half <= pair[1]}
    assert tears(model_of(poses), lonely, FilmOrder.of([range(NUM)])) == ()
    first, second = matches[half - 1, half]
    few = {**lonely, (half - 1, half): (first[:20], second[:20])}
    assert tears(model_of(poses), few, FilmOrder.of([range(NUM)])) == (), "20 matches are few"


def test_pairs_that_see_a_thing_from_two_sides_are_impossible() -> None:
    poses = true_poses()
    matches = matches_of(poses)
    order = FilmOrder.of([range(NUM)])
    far = {pair for pair in matches if order.is_far(pair)}
    near = set(matches) - far
    assert len(far) > 100
    assert impossible(model_of(poses), matches, far) == far
    assert impossible(model_of(poses), matches, near) == frozenset()
    across = {(i, j) for i, j in far if i < NUM // 2 <= j}
    assert impossible(model_of(folded(poses)), matches, across) == frozenset(), "the trap"
    without = model_of(poses[1:], tuple(range(1, NUM)))
    assert (0, NUM // 2) in far
    assert (0, NUM // 2) not in impossible(without, matches, far), "nothing is known of image 0"


def test_what_came_round_again_is_possible() -> None:
    poses = true_poses(NUM, 720.0)
    matches = {
        (i, i + NUM // 2): found
        for i in range(NUM // 2)
        for found in [matches_of(poses[[i, i + NUM // 2]], alike=False)[0, 1]]
    }
    assert impossible(model_of(poses), matches, set(matches)) == frozenset()


@pytest.mark.parametrize(("num", "window"), [(12, 2), (32, 4), (72, 8), (300, 8)])
def test_near_in_time_is_an_eighth_of_a_clip_at_most(num: int, window: int) -> None:
    order = FilmOrder.of([range(num), range(num, 2 * num)])
    assert order.is_near((0, window))
    assert order.is_far((0, window + 1))
    assert not order.is_near((num - 1, num)), "of two clips"
    assert not order.is_far((0, 2 * num - 1))
    assert not order.is_far((0, 5 * num)), "of none"


@functools.cache
def walked_round(num: int) -> list[Image.Image]:
    """Pictures of the can from all around."""
    return [render(pose) for pose in around_poses(num, 360.0)]


def climbed(root: Path, rungs: tuple[Rung, ...] = RUNGS) -> tuple[Outcome, Source]:
    workspace = Workspace(root)
    ctx = StageContext("poses", workspace, root, workspace.checkpoint("poses"))
    options = PosesOptions(num_features=800, max_image_px=400, upsample="off")
    source = read_source(workspace)
    checkpoint = Checkpoint(ctx, source, options)
    reconstructor = Reconstructor(
        checkpoint.database(RUNGS[0].matches.database), source.paths, root / "scratch"
    )
    return Ladder(reconstructor, checkpoint, source, options, ctx, rungs).climb(), source


def turns_off_deg(model: SparseModel, poses: Floats) -> Floats:
    """[N]: by how much each camera is turned wrongly, as against the first."""
    known = poses[list(model.indices), :, :3]
    found = model.world_from_camera[:, :, :3]
    off = np.einsum("nji,njk->nik", known[0].T @ known, found[0].T @ found)
    cosine = (np.trace(off, axis1=1, axis2=2) - 1) / 2
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


@pytest.mark.parametrize("kind", ["film", "photos", "long film"])
def test_a_can_with_its_label_on_it_twice_is_found_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    monkeypatch.setattr(rungs, "LONG_FILM", LONG)
    num = LONG if kind == "long film" else PHOTOS
    pictures = walked_round(num)
    if kind == "photos":
        save_photos(tmp_path, pictures)
    else:
        save_video_frames(tmp_path, pictures)
    outcome, source = climbed(tmp_path)
    chosen = outcome.chosen
    assert chosen.best is not None
    assert chosen.left_out, "mapped at first as if the can had one side: else this shows nothing"
    assert chosen.torn == ()
    assert chosen.num_registered == num
    assert turns_off_deg(chosen.best, true_poses(num)).max() < 3.0
    told = build_report(outcome, source)["attempts"][-1]
    assert (told["matcher"] == "key frames") is (kind == "long film")
    assert (told["torn"], told["pairs_left_out"]) == ([], len(chosen.left_out))


def test_a_film_that_cannot_be_mended_is_told_as_torn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without its far pairs nothing of it is placed, here by force: the path stays torn."""
    save_video_frames(tmp_path, walked_round(PHOTOS))
    whole = Reconstructor.without_pairs
    monkeypatch.setattr(
        Reconstructor,
        "without_pairs",
        lambda self, pairs: whole(self, list(itertools.combinations(range(PHOTOS), 2))),
    )
    quick = tuple(rung for rung in RUNGS if rung.name == "quick")
    outcome, source = climbed(tmp_path, quick)
    chosen = outcome.chosen
    assert chosen.torn
    assert chosen.weight <= PHOTOS / 2
    assert chosen.is_contradicted
    assert replace(chosen, torn=()).is_contradicted is False
    assert too_few_registered(Standing(PHOTOS, PHOTOS, 0.8, is_contradicted=True)), "more is tried"
    told = build_report(outcome, source)["attempts"][0]["torn"]
    assert told == [[source.files[i], source.files[j]] for i, j in chosen.torn]
    (warning,) = path_warnings(outcome, source)
    assert warning["code"] == "path_torn"
    assert f"{0.5 * chosen.torn[0][0]:.1f} s" in warning["message"]


def test_a_whole_path_is_no_warning(tmp_path: Path) -> None:
    save_video_frames(tmp_path, [render(pose) for pose in around_poses(10, 60.0)])
    outcome, source = climbed(tmp_path)
    assert outcome.chosen.num_registered == 10
    assert path_warnings(outcome, source) == []
