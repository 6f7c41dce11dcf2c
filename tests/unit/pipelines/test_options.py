"""Presets: complete, consistent, and clear about what they leave out."""

from __future__ import annotations

from typing import Any

import pytest

from pipelines.nerf.training.state import learning_rates
from pipelines.options import (
    ON_REQUEST,
    STAGE_OPTIONS,
    OptionsError,
    resolve_options,
    revise_options,
    stage_options,
    stages_skipped,
    train_config,
)
from pipelines.presets import PRESETS
from pipelines.registry import STAGE_NAMES, STAGES, skipped_stages

NEEDED_WHERE_THERE = {"report"}
"""Stages that take what there is of what they read."""


@pytest.mark.parametrize("preset", PRESETS)
def test_a_preset_has_options_for_every_stage_it_keeps(preset: str) -> None:
    resolved = resolve_options(preset, {})
    assert set(resolved) == set(STAGE_OPTIONS) == set(STAGE_NAMES)
    assert set(PRESETS[preset].overrides) <= set(STAGE_NAMES)


@pytest.mark.parametrize("preset", PRESETS)
def test_a_preset_leaves_out_no_stage_that_another_needs(preset: str) -> None:
    without = PRESETS[preset].without
    assert without < set(STAGE_NAMES)
    for stage in STAGES:
        if stage.name not in without | NEEDED_WHERE_THERE:
            assert not without & {*stage.reads, *stage.after}, stage.name


def test_a_job_skips_for_its_preset_and_for_its_capture() -> None:
    assert stages_skipped("preview", "video") == ON_REQUEST == {"views", "meshvideo"}
    assert stages_skipped("preview", "video", {"views": {}}) == {"meshvideo"}
    assert stages_skipped("preview", "video", {"views": {}, "meshvideo": {}}) == frozenset()
    assert stages_skipped("preview", "polycam") == skipped_stages("polycam") | ON_REQUEST
    assert "views" in stages_skipped("draft", "video", {"views": {}})
    kept = set(STAGE_NAMES) - stages_skipped("draft", "video")
    assert kept == {"ingest", "frames", "poses", "check", "depth", "draft", "report"}
    assert kept - stages_skipped("draft", "polycam") == kept - {"frames"}
    checked = set(STAGE_NAMES) - stages_skipped("check", "video")
    assert checked == {"ingest", "frames", "poses", "check", "report"}
    with pytest.raises(KeyError):
        stages_skipped("ultra", "video")


def test_a_draft_takes_every_image_and_must_give_a_mesh() -> None:
    resolved = resolve_options("draft", {"draft": {"resolution": 64}})
    assert resolved["depth"]["held_out"]["eval_mode"] == "none"
    assert (resolved["draft"]["resolution"], resolved["draft"]["required"]) == (64, True)
    preview = resolve_options("preview", {})
    assert preview["draft"]["required"] is False
    assert all(resolved[name] == preview[name] for name in ("ingest", "frames", "poses"))


@pytest.mark.parametrize(
    ("given", "paths"),
    [
        ({"train": {"max_steps": 9}}, ["train"]),
        ({"mesh": {"resolution": 64}, "video": {"num_frames": 8}}, ["mesh", "video"]),
        ({"train": {}}, []),
    ],
)
def test_options_of_a_stage_that_the_preset_leaves_out_are_refused(
    given: dict[str, Any], paths: list[str]
) -> None:
    if not paths:
        assert resolve_options("draft", given) == resolve_options("draft", {})
        return
    with pytest.raises(OptionsError, match="draft has no such stage") as caught:
        resolve_options("draft", given)
    assert sorted(path for path, _ in caught.value.errors) == paths


def test_a_mesh_can_be_painted_with_the_field_and_a_draft_which_has_none_cannot() -> None:
    assert resolve_options("preview", {"mesh": {"texture": "field"}})["mesh"]["texture"] == "field"
    for stage in ("draft", "mesh"):
        wrong = "field" if stage == "draft" else "paint"
        with pytest.raises(OptionsError, match=rf"{stage}\.texture"):
            resolve_options("preview", {stage: {"texture": wrong}})


@pytest.mark.parametrize(
    "wrong", [{"method": "cubes"}, {"density_level": 0.0}, {"density_level": 1.0}]
)
def test_a_surface_of_the_density_is_somewhere_within_it(wrong: dict[str, Any]) -> None:
    given = {"method": "marching_cubes", "density_level": 0.9}
    assert resolve_options("preview", {"mesh": given})["mesh"]["density_level"] == 0.9
    with pytest.raises(OptionsError, match=f"mesh.{next(iter(wrong))}"):
        resolve_options("preview", {"mesh": wrong})


@pytest.mark.parametrize("max_steps", [300, 1500, 3000])
def test_previews_rate_falls_to_nothing_at_the_runs_end_however_long_that_is(
    max_steps: int,
) -> None:
    resolved = resolve_options("preview", {"train": {"max_steps": max_steps}})
    config = train_config(stage_options("train", resolved["train"]))
    first, middle, last = (
        learning_rates(config, step)["networks"] for step in (0, max_steps // 2, max_steps)
    )
    assert last < 1e-3 * first
    assert 0.4 * first < middle < 0.6 * first


def test_a_job_that_an_older_version_stored_still_has_its_options() -> None:
    """`around` was the default until it was `unknown`: such jobs wait and are retried."""
    resolved = resolve_options("preview", {})
    stored = {**resolved["train"], "flat": {**resolved["train"]["flat"], "when": "around"}}
    assert train_config(stage_options("train", stored)).flat.when == "unknown"
    assert revise_options("preview", {**resolved, "train": stored}, {}) == resolved
    for wrong in ("aroundd", ["around"], None):
        with pytest.raises(OptionsError, match=r"train\.flat\.when"):
            resolve_options("preview", {"train": {"flat": {"when": wrong}}})
