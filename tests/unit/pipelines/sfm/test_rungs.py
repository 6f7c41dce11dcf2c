"""The ladder is a table: what it says is climbed, and in that order."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from PIL import Image

from pipelines.options import PosesOptions
from pipelines.sfm import attempts
from pipelines.sfm.attempts import Ladder
from pipelines.sfm.checkpoint import Checkpoint
from pipelines.sfm.rungs import RUNGS, Matches, Rung, Standing, always, too_few_registered
from pipelines.sfm.source import read_source
from pipelines.stage import StageContext
from pipelines.tools.colmap import Reconstructor
from pipelines.tools.colmap_settings import MapperSettings, Thresholds
from pipelines.workspace import Workspace
from tests.unit.pipelines.sfm.synthetic_room import arc_poses, render, save_video_frames


def test_names_tell_rungs_and_databases_apart() -> None:
    assert len({rung.name for rung in RUNGS}) == len(RUNGS)
    matches = {rung.matches for rung in RUNGS}
    features = {(each.database, each.doubled) for each in matches}
    assert len({database for database, _ in features}) == len(features), "who shares features"
    steps = {(each.database, each.key_frames, each.reach) for each in matches}
    assert len(steps) == len(matches)
    assert any(rung.when(Standing(10, 0, 0.0)) for rung in RUNGS)
    assert [rung.is_relaxed for rung in RUNGS] == [False, False, False, True]


@pytest.mark.parametrize(("registered", "more"), [(7, True), (8, False), (10, False)])
def test_the_next_rung_is_for_captures_that_lack_images(registered: int, more: bool) -> None:
    assert too_few_registered(Standing(10, registered, 0.8)) is more


def test_pairs_lead_to_others_where_all_would_be_many(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a film of 16 pictures with one neighbour planned each way, and the most alike."""
    monkeypatch.setattr(attempts, "FEW_ENOUGH_FOR_ALL", 10)
    save_video_frames(tmp_path, [render(pose) for pose in arc_poses(16)])
    workspace = Workspace(tmp_path)
    ctx = StageContext("poses", workspace, tmp_path, workspace.checkpoint("poses"))
    options = PosesOptions(
        num_features=800,
        max_image_px=400,
        upsample="off",
        matcher="sequential",
        sequential_overlap=1,
        retrieval_neighbours=1,
    )
    source = read_source(workspace)
    checkpoint = Checkpoint(ctx, source, options)
    reconstructor = Reconstructor(
        checkpoint.database("few"), source.paths, tmp_path / "scratch", num_threads=1
    )
    numbers = {}
    for reach in ("planned", "led", "all"):
        rungs = (Rung(reach, always, Matches(reach, reach=reach), MapperSettings()),)
        outcome = Ladder(reconstructor, checkpoint, source, options, ctx, rungs).climb()
        assert outcome.chosen.num_registered == 16
        numbers[reach] = outcome.statistics.num_pairs
        assert (
            outcome.chosen.matcher
            == {
                "planned": "sequential",
                "led": attempts.TRANSITIVE,
                "all": "exhaustive",
            }[reach]
        )
    assert numbers["planned"] < numbers["led"] < numbers["all"] == 120
    steps = json.loads((ctx.checkpoint / "state.json").read_text("utf-8"))["steps"]
    assert "led transitive" in steps


def test_one_line_more_is_one_attempt_more_on_the_same_matches(tmp_path: Path) -> None:
    pictures = [render(pose) for pose in arc_poses(6)]
    pictures[3] = Image.new("RGB", pictures[3].size, (90, 90, 90))
    save_video_frames(tmp_path, pictures)
    workspace = Workspace(tmp_path)
    fractions: list[float] = []
    ctx = StageContext(
        "poses",
        workspace,
        tmp_path,
        workspace.checkpoint("poses"),
        on_progress=lambda fraction, _message, _eta: fractions.append(fraction),
    )
    options = PosesOptions(
        num_features=800, max_image_px=400, upsample="off", min_registered=4, retry_below_ratio=1.0
    )
    first = Matches("first")
    rungs = (
        Rung("one", always, first, MapperSettings()),
        Rung("two", too_few_registered, first, MapperSettings(thorough=True)),
        Rung("never", lambda _standing: False, Matches("unused"), MapperSettings()),
        Rung(
            "four",
            too_few_registered,
            first,
            MapperSettings(thresholds=Thresholds(pose_min_num_inliers=12)),
        ),
    )
    source = read_source(workspace)
    checkpoint = Checkpoint(ctx, source, options)
    reconstructor = Reconstructor(
        checkpoint.database("first"), source.paths, tmp_path / "scratch", num_threads=1
    )
    outcome = Ladder(reconstructor, checkpoint, source, options, ctx, rungs).climb()
    assert [attempt.rung.name for attempt in outcome.attempts] == ["one", "two", "four"]
    assert [attempt.num_registered for attempt in outcome.attempts] == [5, 5, 5]
    assert sorted(path.name for path in ctx.checkpoint.glob("*.db")) == ["first.db"]
    folders = [attempt.best.stored for attempt in outcome.attempts if attempt.best]
    assert len(set(folders)) == 3, "a later attempt does not overwrite the model of an earlier one"
    assert fractions == sorted(fractions)
