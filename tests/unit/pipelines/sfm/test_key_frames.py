"""A long film is mapped by its key frames, and the others are placed on what those show."""

from __future__ import annotations

import itertools
import json
import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipelines.options import PosesOptions
from pipelines.scene.orientation import opengl_from_opencv
from pipelines.sfm.attempts import KEY_FRAMES, Ladder
from pipelines.sfm.checkpoint import Checkpoint
from pipelines.sfm.key_frames import (
    LONG_FILM,
    NUM_KEYS,
    clips_of_keys,
    first_keys,
    following,
    is_worth_it,
    key_pairs,
    missing_keys,
    placing_pairs,
)
from pipelines.sfm.report import Outcome
from pipelines.sfm.rungs import RUNGS, Matches, Rung, Standing, always, not_yet_enough
from pipelines.sfm.source import read_source
from pipelines.stage import StageContext
from pipelines.tools.colmap import Reconstructor
from pipelines.tools.colmap_results import PairStatistics
from pipelines.tools.colmap_settings import MapperSettings
from pipelines.workspace import Workspace
from tests.benchmarks.pose_accuracy import compare
from tests.unit.pipelines.sfm.synthetic_room import arc_poses, render, save_video_frames

OPTIONS = PosesOptions(num_features=800, max_image_px=400, upsample="off", min_registered=4)
BY_KEYS = (
    Rung("keys", always, Matches("colmap", key_frames=True), MapperSettings()),
    Rung("all", not_yet_enough, Matches("colmap"), MapperSettings()),
)


def statistics(
    num: int, shared: dict[tuple[int, int], int], features: int = 1000
) -> PairStatistics:
    rows = [(i, j, count) for (i, j), count in shared.items()]
    return replace(
        PairStatistics.nothing(num),
        num_features=np.full(num, features),
        verified=np.array(rows, np.int64).reshape(-1, 3),
    )


@pytest.mark.parametrize("lengths", [(150,), (1000,), (4999,), (100, 1, 99), (2, 700)])
def test_key_frames_are_few_and_hold_each_clips_ends(lengths: tuple[int, ...]) -> None:
    edges = [0, *itertools.accumulate(lengths)]
    clips = [range(a, b) for a, b in itertools.pairwise(edges)]
    keys = first_keys(clips)
    assert keys == sorted(set(keys))
    assert {i for clip in clips for i in (clip[0], clip[-1])} <= set(keys)
    assert len(keys) <= NUM_KEYS + 2 * len(clips)
    assert is_worth_it(keys, edges[-1])
    assert all(clip.start <= i < j < clip.stop for i, j in following(keys, clips) for clip in clips
               if i in clip)  # fmt: skip
    assert len(following(keys, clips)) == len(keys) - len(clips)


def test_where_key_frames_share_too_little_the_frame_between_is_one_too() -> None:
    followers = [(0, 8), (8, 16), (16, 24), (24, 25)]
    shared = {(0, 8): 400, (8, 16): 299, (24, 25): 0}
    assert missing_keys(followers, statistics(26, shared)) == [12, 20]
    # Of pictures with few features a share of them is too few matches.
    assert missing_keys([(0, 8)], statistics(9, {(0, 8): 149}, features=300)) == [4]
    assert missing_keys([(0, 8)], statistics(9, {(0, 8): 150}, features=300)) == []


def test_each_other_frame_is_matched_with_the_key_frames_of_its_clip_around_it() -> None:
    clips = [range(12), range(12, 20)]
    keys = [0, 4, 8, 11, 12, 16, 19]
    assert clips_of_keys(keys, clips) == [range(4), range(4, 7)]
    pairs = placing_pairs(keys, clips)
    partners = {i: {b if a == i else a for a, b in pairs if i in (a, b)} for i in range(20)}
    assert partners[5] == {0, 4, 8, 11}
    assert partners[9] == {4, 8, 11}
    assert partners[13] == {12, 16, 19}
    assert {i for i in range(20) if i not in keys} == {
        i for pair in pairs for i in pair if i not in keys
    }
    assert all(i in keys or j in keys for i, j in pairs), "no two others with each other"


def test_key_frames_of_different_clips_are_no_neighbours() -> None:
    clips = [range(100), range(100, 200)]
    keys = list(range(0, 200, 4))
    near = [(i, j) for i, j in key_pairs(keys, clips, 2) if j - i <= 8]
    spread = {(96, 100), (96, 104), (92, 100)}
    assert {(0, 4), (0, 8)} <= set(near)
    assert not spread & set(near)


def test_the_table_maps_long_films_by_key_frames_and_nothing_else() -> None:
    def first(standing: Standing) -> str:
        return next(rung.name for rung in RUNGS if rung.when(standing))

    assert first(Standing(LONG_FILM, 0, 0.8, is_film=True)) == "key frames"
    assert first(Standing(LONG_FILM - 1, 0, 0.8, is_film=True)) == "quick"
    assert first(Standing(5000, 0, 0.8, is_film=False)) == "quick"
    assert first(Standing(LONG_FILM, 0, 0.0, is_film=False)) == "quick"
    again = [rung.name for rung in RUNGS if rung.when(Standing(300, 239, 0.8))]
    assert again[0] == "quick", "where key frames were not enough, all frames are mapped"
    assert "quick" not in [r.name for r in RUNGS if r.when(Standing(300, 240, 0.8))]


def climb(
    root: Path, pictures: list[Image.Image], options: PosesOptions = OPTIONS
) -> tuple[Outcome, list[float]]:
    """The attempts at a film of these frames, and the progress on the way."""
    save_video_frames(root, pictures)
    workspace = Workspace(root)
    fractions: list[float] = []
    ctx = StageContext(
        "poses",
        workspace,
        root,
        workspace.checkpoint("poses"),
        on_progress=lambda fraction, _message, _eta: fractions.append(fraction),
    )
    source = read_source(workspace)
    checkpoint = Checkpoint(ctx, source, options)
    reconstructor = Reconstructor(
        checkpoint.database("colmap"), source.paths, root / "scratch", num_threads=1
    )
    return Ladder(reconstructor, checkpoint, source, options, ctx, BY_KEYS).climb(), fractions


def test_features_found_without_masks_are_not_those_of_masked_frames(tmp_path: Path) -> None:
    """A film whose overlay an earlier version had not found has the same frames, and now masks."""
    save_video_frames(tmp_path, [render(pose) for pose in arc_poses(3)])
    workspace = Workspace(tmp_path)
    ctx = StageContext("poses", workspace, tmp_path, workspace.checkpoint("poses"))
    source = read_source(workspace)
    first = Checkpoint(ctx, source, OPTIONS)
    first.database("colmap").touch()
    first.save("colmap features")
    assert Checkpoint(ctx, source, OPTIONS).has("colmap features")
    (source.root / "hidden.png").write_bytes(b"mask")
    masked = replace(source, masks=("hidden.png", None, None))
    assert not Checkpoint(ctx, masked, OPTIONS).has("colmap features")


def test_frames_between_key_frames_lie_where_they_were_taken(tmp_path: Path) -> None:
    truth = arc_poses(24)
    pictures = [render(pose) for pose in truth]
    pictures[9] = Image.new("RGB", pictures[9].size, (90, 90, 90))
    outcome, fractions = climb(tmp_path, pictures)
    assert [attempt.rung.name for attempt in outcome.attempts] == ["keys"]
    assert outcome.attempts[0].matcher == KEY_FRAMES
    model = outcome.chosen.best
    assert model is not None
    assert model.indices == tuple(i for i in range(24) if i != 9)
    errors = compare(opengl_from_opencv(model.world_from_camera), truth[list(model.indices)])
    assert errors.center_90_percent < 0.5
    assert errors.rotation_90_deg < 0.2
    assert fractions == sorted(fractions)
    # Less was matched than neighbours of all frames would be.
    assert outcome.statistics.num_pairs < 24 * 23 / 2 * 0.75
    # What only frames between see has a colour, too.
    assert model.colors.max(axis=1).min() > 0
    assert model.stored is not None
    assert model.agreement is not None
    assert model.agreement > 0.9


def test_a_film_that_key_frames_cannot_hold_together_is_mapped_whole(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Two frames of a room and two of its mirror image by turns: no key frame shows what the next
    one does, nor what the frame between does for both."""
    pictures = [render(pose) for pose in arc_poses(20)]
    for i in (2, 3, 6, 7, 10, 11, 14, 15, 18, 19):
        pictures[i] = pictures[i].transpose(Image.Transpose.FLIP_LEFT_RIGHT)
    with caplog.at_level(logging.INFO):
        outcome, _ = climb(tmp_path, pictures)
    assert [attempt.rung.name for attempt in outcome.attempts] == ["all"]
    assert "differ too much" in caplog.text


def test_an_attempt_that_was_cut_short_chooses_the_same_key_frames(tmp_path: Path) -> None:
    # So many that a pair that COLMAP verifies less of by chance does not make all of them keys.
    pictures = [render(pose) for pose in arc_poses(24)]
    first, _ = climb(tmp_path / "job", pictures)
    steps = tmp_path / "job" / ".checkpoint" / "poses" / "state.json"
    assert "colmap key frames" in json.loads(steps.read_text("utf-8"))["steps"]
    (tmp_path / "job" / "frames").rename(tmp_path / "frames")
    second, _ = climb(tmp_path / "job", pictures)
    a, b = first.chosen.best, second.chosen.best
    assert a is not None
    assert b is not None
    assert a.indices == b.indices
    np.testing.assert_allclose(a.world_from_camera, b.world_from_camera, atol=1e-6)
    assert first.statistics.num_pairs == second.statistics.num_pairs
