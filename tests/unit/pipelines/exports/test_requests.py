"""Options of exports that are asked for on their own."""

from __future__ import annotations

from typing import Any

import pytest

from pipelines.exports.catalogue import KINDS
from pipelines.exports.requests import resolve_export
from pipelines.options import OptionsError, resolve_options
from pipelines.presets import PRESETS

FLIGHT: dict[str, Any] = {
    "render_height": 64,
    "render_width": 96,
    "fps": 24,
    "camera_path": [
        {"camera_to_world": [1, 0, 0, x, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1], "fov": 50}
        for x in range(3)
    ],
}


@pytest.mark.parametrize("preset", [name for name in PRESETS if name != "draft"])
@pytest.mark.parametrize("kind", KINDS)
def test_without_wishes_it_is_what_the_job_makes(kind: str, preset: str) -> None:
    own = resolve_options(preset, {})[kind]
    assert resolve_export(kind, preset, own, {}) == own


def test_wishes_are_laid_over_what_the_job_has() -> None:
    own = resolve_options("preview", {"mesh": {"crop": {"shape": "sphere", "radius": 2}}})["mesh"]
    made = resolve_export("mesh", "preview", own, {"crop": {"radius": 3}, "triangles": 77})
    assert made["crop"] == {**own["crop"], "radius": 3.0}
    assert (made["triangles"], made["render_long_side_px"]) == (77, 240)


@pytest.mark.parametrize("stale", [{"gone": 1}, {"max_faces": "many"}, {"max_faces": 10**12}])
def test_options_of_an_older_version_give_way_to_the_presets(stale: dict[str, Any]) -> None:
    own = {**resolve_options("preview", {})["mesh"], **stale}
    made = resolve_export("mesh", "preview", own, {"triangles": 500})
    assert made == {**resolve_options("preview", {})["mesh"], "triangles": 500}
    assert resolve_export("mesh", "a preset that is no more", own, {})["max_faces"] == 200_000


def test_a_file_takes_the_place_of_another_whole() -> None:
    job = resolve_options("preview", {"video": {"path": "camera_path", "camera_path": FLIGHT}})
    keyframes = [{"matrix": one["camera_to_world"], "fov": 40} for one in FLIGHT["camera_path"][:2]]
    other = {**FLIGHT, "camera_path": [], "keyframes": keyframes}
    del other["camera_path"]
    made = resolve_export("video", "preview", job["video"], {"camera_path": other})
    assert made["camera_path"]["camera_path"] == []
    assert len(made["camera_path"]["keyframes"]) == 2


def test_a_kind_that_the_job_leaves_out_is_made_where_it_is_asked_for() -> None:
    own = resolve_options("preview", {"dataset": {"enabled": False}})["dataset"]
    assert resolve_export("dataset", "preview", own, {})["enabled"] is True
    with pytest.raises(OptionsError, match=r"dataset\.enabled"):
        resolve_export("dataset", "preview", own, {"enabled": False})


def test_each_wrong_option_is_named() -> None:
    with pytest.raises(OptionsError) as caught:
        resolve_export("mesh", "preview", {}, {"triangles": -1, "crop": 5, "a": {}})
    assert {path for path, _ in caught.value.errors} == {"mesh.triangles", "mesh.crop", "mesh.a"}
    with pytest.raises(KeyError):
        resolve_export("nothing", "preview", {}, {})
