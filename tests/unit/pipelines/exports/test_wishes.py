"""What a request for an export means beside the options of its job."""

from __future__ import annotations

from typing import Any

import pytest

from pipelines.exports.crop import crop_of
from pipelines.exports.kinds.video import VideoOptions
from pipelines.exports.mesh_options import MeshOptions
from pipelines.exports.requests import resolve_export
from pipelines.options import OptionsError, resolve_options, revise_options

BOX = {"shape": "box", "center": [0, 0, 1], "size": [1, 2, 3]}
REGION = {"center": [0.1, 0, 0.2], "size": [0.4, 0.5, 0.3], "rotation_deg": [0, 0, 12.5]}
"""As the report has it of a subject."""
KEYFRAMES = [
    {"position": [2, 0, 1], "look_at": [0, 0, 0]},
    {"position": [0, 2, 2], "look_at": [0, 0, 0]},
]
FILE = {
    "render_height": 64,
    "render_width": 96,
    "fps": 24,
    "camera_path": [
        {"camera_to_world": [1, 0, 0, x, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1], "fov": 50}
        for x in range(3)
    ],
}


def asked(kind: str, job: dict[str, Any], given: dict[str, Any]) -> dict[str, Any]:
    """The options of an export of a job that was given some of its own."""
    return resolve_export(kind, "preview", resolve_options("preview", {kind: job})[kind], given)


def film(job: dict[str, Any], given: dict[str, Any]) -> VideoOptions:
    return VideoOptions.model_validate(asked("video", job, given))


@pytest.mark.parametrize(
    ("job", "given", "frames"),
    [
        ({"seconds": 20}, {"num_frames": 96}, 96),
        ({"num_frames": 96}, {"seconds": 20}, 480),
        ({"seconds": 20}, {"turn_deg_per_s": 30}, None),
        ({"num_frames": 96}, {"min_seconds": 6}, None),
        ({"seconds": 20}, {"fps": 30}, 600),
        ({"seconds": 20}, {"seconds": None}, None),
    ],
)
def test_a_film_is_as_long_as_the_export_says(
    job: dict[str, Any], given: dict[str, Any], frames: int | None
) -> None:
    assert film(job, given).frames() == frames


@pytest.mark.parametrize(
    ("job", "given", "size"),
    [
        ({"width_px": 640, "height_px": 480}, {"long_side_px": 1920}, (1920, 1920)),
        ({"width_px": 640, "height_px": 480}, {"long_side_px": 960}, (960, 960)),
        ({"long_side_px": 1920}, {"width_px": 640, "height_px": 480}, (640, 480)),
        ({"width_px": 640, "height_px": 480}, {"height_px": 320}, (640, 320)),
    ],
)
def test_a_film_is_as_large_as_the_export_says(
    job: dict[str, Any], given: dict[str, Any], size: tuple[int, int]
) -> None:
    assert film(job, given).size() == size


@pytest.mark.parametrize("kind", ["mesh", "pointcloud"])
def test_the_extent_that_is_asked_for_takes_back_the_jobs_crop(kind: str) -> None:
    for extent in ("subject", "scene"):
        made = asked(kind, {"crop": BOX}, {"extent": extent})
        assert (made["crop"]["shape"], made["extent"]) == ("none", extent)
    made = asked(kind, {"extent": "subject"}, {"crop": BOX})
    assert (made["crop"]["shape"], made["extent"]) == ("box", "auto")
    both = asked(kind, {"crop": BOX}, {"extent": "scene", "crop": {"size": [1, 1, 1]}})
    assert (both["crop"]["shape"], both["extent"]) == ("box", "scene")
    assert asked(kind, {"crop": BOX}, {"max_distance": 3})["crop"]["shape"] == "box"


@pytest.mark.parametrize(
    ("kind", "given", "both"),
    [
        ("video", {"num_frames": 500, "seconds": 2}, ("num_frames", "seconds")),
        ("video", {"seconds": 2, "turn_deg_per_s": 20}, ("seconds", "turn_deg_per_s")),
        (
            "meshvideo",
            {"width_px": 64, "height_px": 64, "long_side_px": 80},
            ("width_px", "long_side_px"),
        ),
        ("mesh", {"extent": "subject", "crop": BOX}, ("extent", "crop")),
        ("pointcloud", {"extent": "subject", "crop": {"shape": "auto"}}, ("extent", "crop")),
    ],
)
def test_two_ways_in_one_request_are_refused_with_both_names(
    kind: str, given: dict[str, Any], both: tuple[str, str]
) -> None:
    for refused in (
        lambda: asked(kind, {}, given),
        lambda: resolve_options("preview", {kind: given}),
        lambda: revise_options("preview", resolve_options("preview", {}), {kind: given}),
    ):
        with pytest.raises(OptionsError) as caught:
            refused()
        ((path, problem),) = caught.value.errors
        assert path in {f"{kind}.{name}" for name in both}
        assert all(name in problem for name in both)


@pytest.mark.parametrize(
    ("kind", "job", "changed"),
    [
        ("video", {"seconds": 20}, {"path": "orbit"}),
        ("video", {}, {"seconds": 20}),
        ("video", {"width_px": 64, "height_px": 64}, {"width_px": 80}),
        ("mesh", {"crop": BOX}, {"triangles": 5000}),
        ("mesh", {"extent": "subject"}, {"triangles": 5000}),
        ("mesh", {"crop": {"shape": "sphere", "radius": 3}}, {"triangles": 5000}),
        ("video", {"path": "orbit", "orbit": {"turns": 3}}, {"path": "spiral"}),
        ("video", {"camera_path": FILE}, {"path": "smooth"}),
        ("views", {"cameras": "training"}, {"num_views": 3}),
    ],
)
def test_all_of_a_jobs_options_can_be_sent_again_with_one_changed(
    kind: str, job: dict[str, Any], changed: dict[str, Any]
) -> None:
    own = resolve_options("preview", {kind: job})[kind]
    assert resolve_export(kind, "preview", own, {**own, **changed}) == {**own, **changed}


def test_a_retry_takes_back_what_its_options_replace() -> None:
    present = resolve_options("preview", {"video": {"seconds": 20}, "mesh": {"crop": BOX}})
    made = revise_options(
        "preview", present, {"video": {"num_frames": 96}, "mesh": {"extent": "subject"}}
    )
    assert (made["video"]["num_frames"], made["video"]["seconds"]) == (96, None)
    assert (made["mesh"]["crop"]["shape"], made["mesh"]["extent"]) == ("none", "subject")
    again = revise_options("preview", made, {"train": {"max_steps": 7}})
    assert {name: again[name] for name in again if name != "train"} == {
        name: made[name] for name in made if name != "train"
    }


@pytest.mark.parametrize(
    ("job", "crop", "shape"),
    [
        ({}, REGION, "box"),
        ({}, {"radius": 0.2}, "sphere"),
        ({}, {"center": [0, 0, 1], "radius": 0.2}, "sphere"),
        ({"crop": {"shape": "auto"}}, REGION, "box"),
        ({"crop": {"shape": "sphere"}}, {"size": [1, 1, 1]}, "box"),
        ({"crop": {"shape": "sphere"}}, {"center": [0, 0, 1]}, "sphere"),
        ({"crop": BOX}, {"rotation_deg": [0, 0, 9]}, "box"),
        ({"crop": BOX}, {"shape": "none", "size": [1, 1, 1]}, "none"),
    ],
)
def test_the_numbers_of_a_crop_tell_its_shape(
    job: dict[str, Any], crop: dict[str, Any], shape: str
) -> None:
    made = MeshOptions.model_validate(asked("mesh", job, {"crop": crop})).crop
    assert made.shape == shape
    assert (crop_of(made) is None) == (shape == "none")
    for name, value in crop.items():
        assert made.model_dump(mode="json")[name] == value


@pytest.mark.parametrize(
    ("job", "crop", "told"),
    [
        ({}, {"center": [0, 0, 1]}, ("crop.shape", "center")),
        ({}, {"rotation_deg": [0, 0, 9]}, ("crop.shape", "size")),
        ({}, {**REGION, "radius": 0.3}, ("crop.shape", "radius")),
        ({}, {"shape": "sphere", "size": [1, 2, 3], "radius": 0.3}, ("crop.size", "sphere")),
        ({}, {"shape": "box", "radius": 0.3}, ("crop.radius", "box")),
        ({}, {"shape": "auto", "size": [1, 2, 3]}, ("crop.size", "auto")),
    ],
)
def test_numbers_that_tell_no_shape_or_another_are_refused(
    job: dict[str, Any], crop: dict[str, Any], told: tuple[str, str]
) -> None:
    with pytest.raises(OptionsError, match=told[1]) as caught:
        asked("pointcloud", job, {"crop": crop})
    assert [path for path, _ in caught.value.errors] == [f"pointcloud.{told[0]}"]
    with pytest.raises(OptionsError, match=told[1]):
        resolve_options("preview", {"pointcloud": {"crop": crop}})


@pytest.mark.parametrize("kind", ["video", "meshvideo", "views"])
@pytest.mark.parametrize(
    ("given", "path"),
    [
        ({"keyframes": KEYFRAMES}, "keyframes"),
        ({"orbit": {"turns": 2}}, "orbit"),
        ({"orbit": {"turns": 1}}, "orbit"),
        ({"spiral": {"radius": 0.2}}, "spiral"),
        ({"camera_path": FILE}, "camera_path"),
        ({"path": "keyframes", "keyframes": KEYFRAMES}, "keyframes"),
        ({"path": "interpolate", "tension": 1}, "interpolate"),
        ({"keyframes": []}, "smooth"),
    ],
)
def test_the_options_of_one_path_tell_the_path(kind: str, given: dict[str, Any], path: str) -> None:
    for made in (asked(kind, {}, given), resolve_options("preview", {kind: given})[kind]):
        assert made["path"] == path
        assert made.get("cameras", "path") == ("training" if path == "smooth" else "path") or (
            kind != "views"
        )
    assert asked(kind, {"path": "spiral"}, given)["path"] == (
        "spiral" if path == "smooth" else path
    )


@pytest.mark.parametrize(
    "given",
    [
        {"orbit": {"turns": 2}, "keyframes": KEYFRAMES},
        {"path": "smooth", "keyframes": KEYFRAMES},
        {"path": "orbit", "spiral": {"turns": 3}},
    ],
)
def test_options_of_another_path_are_refused(given: dict[str, Any]) -> None:
    with pytest.raises(OptionsError, match="path"):
        asked("video", {}, given)


@pytest.mark.parametrize("crop", [5, [], "box", {"shape": 3}, {"shape": ["box"]}, {"a": {}}])
def test_whatever_json_is_given_is_answered(crop: Any) -> None:
    for given in ({"crop": crop}, {"crop": crop, "extent": "subject"}, {"extent": crop}):
        with pytest.raises(OptionsError, match=r"mesh\."):
            asked("mesh", {"crop": BOX}, given)
