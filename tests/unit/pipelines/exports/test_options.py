"""Options of rendering, from a job's options to what the renderer is given."""

from __future__ import annotations

import pytest

from pipelines.exports.mesh_options import LEAST_TRIANGLES, Format, MeshOptions
from pipelines.exports.options import RenderingOptions, render_config
from pipelines.exports.requests import resolve_export
from pipelines.nerf.options.render import RenderConfig
from pipelines.options import (
    OptionsError,
    evaluate_config,
    resolve_options,
    revise_options,
    stage_options,
)

RENDERING_STAGES = ("video", "mesh", "pointcloud")


@pytest.mark.parametrize("stage", RENDERING_STAGES)
def test_a_stage_renders_with_its_own_options(stage: str) -> None:
    given = {"render": {"baked_cells": 0, "skip_below": 0.02}}
    resolved = resolve_options("preview", {stage: given})
    options = stage_options(stage, resolved[stage])
    assert isinstance(options, RenderingOptions)
    assert render_config(options) == RenderConfig(baked_cells=0, skip_below=0.02)
    others = {name for name in RENDERING_STAGES if name != stage}
    for name in others:
        untouched = stage_options(name, resolved[name])
        assert isinstance(untouched, RenderingOptions)
        assert render_config(untouched) == RenderConfig()


def test_the_evaluation_measures_what_the_stages_render_unless_told_otherwise() -> None:
    resolved = resolve_options("preview", {})
    assert evaluate_config(stage_options("evaluate", resolved["evaluate"])).render == RenderConfig()
    changed = resolve_options("preview", {"evaluate": {"render": {"color_weight": 0.0}}})
    config = evaluate_config(stage_options("evaluate", changed["evaluate"]))
    assert config.render == RenderConfig(color_weight=0.0)


def test_options_of_jobs_from_before_there_were_any_are_still_read() -> None:
    values = dict(resolve_options("preview", {})["video"])
    del values["render"]
    options = stage_options("video", values)
    assert isinstance(options, RenderingOptions)
    assert render_config(options) == RenderConfig()


@pytest.mark.parametrize("wrong", [{"baked_cells": -1}, {"early_stop": 0.9}, {"speed": 2}])
def test_wrong_values_are_refused_with_their_path(wrong: dict[str, object]) -> None:
    with pytest.raises(OptionsError) as caught:
        resolve_options("preview", {"mesh": {"render": wrong}})
    assert f"mesh.render.{next(iter(wrong))}" in str(caught.value)


@pytest.mark.parametrize(
    ("kind", "formats", "kept"),
    [
        ("mesh", ["stl"], ["stl"]),
        ("mesh", ["usdz", "obj", "usdz"], ["usdz", "obj"]),
        ("pointcloud", ["laz"], ["laz"]),
        ("pointcloud", ["colmap", "xyz"], ["colmap", "xyz"]),
    ],
)
def test_an_export_has_exactly_the_formats_asked_for(
    kind: str, formats: list[str], kept: list[str]
) -> None:
    own = resolve_options("preview", {})[kind]
    assert resolve_export(kind, "preview", own, {"formats": formats})["formats"] == kept
    assert resolve_options("preview", {kind: {"formats": formats}})[kind]["formats"] == kept


@pytest.mark.parametrize(
    ("stage", "wrong", "told"),
    [
        ("mesh", {"formats": []}, "at least 1"),
        ("mesh", {"formats": ["glb", "fbx"]}, "'glb', 'ply', 'obj', 'stl' or 'usdz'"),
        ("mesh", {"up_axis": "x"}, "'auto', 'z' or 'y'"),
        ("mesh", {"method": "ball_pivoting"}, "'poisson' or 'marching_cubes'"),
        ("pointcloud", {"formats": []}, "at least 1"),
        ("pointcloud", {"formats": ["ply", "e57"]}, "'las', 'laz', 'xyz' or 'colmap'"),
        ("pointcloud", {"spacing": -0.1}, "greater than or equal to 0"),
        ("mesh", {"triangles": -1}, "greater than or equal to 0"),
        ("mesh", {"triangles": 20}, "64 or more, or for 0"),
        ("mesh", {"crop": {"shape": "box", "size": [1.0, 0.0, 1.0]}}, "greater than 0"),
        ("mesh", {"crop": {"shape": "box", "rotation_deg": [0, 0, 400]}}, "or equal to 360"),
        ("pointcloud", {"crop": {"shape": "sphere", "radius": 0}}, "greater than 0"),
        ("pointcloud", {"crop": {"shape": "cone"}}, "'none', 'box', 'sphere' or 'auto'"),
    ],
)
def test_wrong_requests_are_refused_with_the_range(
    stage: str, wrong: dict[str, object], told: str
) -> None:
    with pytest.raises(OptionsError) as caught:
        resolve_options("preview", {stage: wrong})
    assert told in str(caught.value)
    assert f"{stage}.{next(iter(wrong))}" in str(caught.value)


def test_a_format_asked_for_twice_is_written_once() -> None:
    assert resolve_options("preview", {"mesh": {"formats": ["glb", "stl", "glb"]}})["mesh"][
        "formats"
    ] == ["glb", "stl"]


@pytest.mark.parametrize(
    ("asked", "up"),
    [
        ({}, {"obj": "y", "ply": "z", "stl": "z"}),
        ({"up_axis": "z"}, {"obj": "z", "ply": "z", "stl": "z"}),
        ({"up_axis": "y"}, {"obj": "y", "ply": "y", "stl": "y"}),
        ({"frame": "normalised"}, {"obj": "y", "ply": "z", "stl": "z"}),
        ({"frame": "source"}, {"obj": "z", "ply": "z", "stl": "z"}),
        ({"frame": "source", "up_axis": "y"}, {"obj": "y", "ply": "y", "stl": "y"}),
    ],
)
def test_each_format_has_up_what_programs_take_it_for_unless_asked_otherwise(
    asked: dict[str, str], up: dict[Format, str]
) -> None:
    options = MeshOptions.model_validate(asked)
    assert {name: options.up_in(name) for name in up} == up


@pytest.mark.parametrize("stored", ["z", "y"])
def test_a_stored_jobs_axis_stays_what_it_was(stored: str) -> None:
    """Jobs from before there was `auto` have one of these, `z` where they had not asked."""
    own = {**resolve_options("preview", {})["mesh"], "up_axis": stored}
    assert resolve_export("mesh", "preview", own, {"formats": ["obj"]})["up_axis"] == stored
    again = resolve_export("mesh", "preview", own, {"up_axis": "auto"})
    assert again["up_axis"] == "auto"


def test_a_stored_jobs_stl_stays_as_large_as_it_was() -> None:
    """Jobs from before `stl_unit` have none; their files had the frame's own unit."""
    own = {**resolve_options("preview", {})["mesh"]}
    assert own.pop("stl_unit") == "millimetre"
    assert resolve_export("mesh", "preview", own, {"formats": ["stl"]})["stl_unit"] == "frame"
    asked = resolve_export("mesh", "preview", own, {"stl_unit": "millimetre"})
    assert asked["stl_unit"] == "millimetre"
    assert stage_options("mesh", own).model_dump()["stl_unit"] == "frame"
    whole = {**resolve_options("preview", {}), "mesh": own}
    again = revise_options("preview", whole, {"pointcloud": {"formats": ["las"]}})
    assert again["mesh"]["stl_unit"] == "frame"


def test_a_stored_job_of_fewer_triangles_than_it_takes_now_goes_on() -> None:
    own = {**resolve_options("preview", {})["mesh"], "triangles": 10, "extent": "subject"}
    assert stage_options("mesh", own).model_dump()["triangles"] == LEAST_TRIANGLES
    asked = resolve_export("mesh", "preview", own, {"formats": ["stl"]})
    assert (asked["triangles"], asked["extent"]) == (LEAST_TRIANGLES, "subject")
    whole = {**resolve_options("preview", {}), "mesh": own}
    assert revise_options("preview", whole, {})["mesh"]["triangles"] == LEAST_TRIANGLES
    with pytest.raises(OptionsError, match="10 triangles"):
        resolve_export("mesh", "preview", own, {"triangles": 10})
