"""What a request for an export means beside the options of its job."""

from __future__ import annotations

from typing import Any

import pytest

from pipelines.exports.kinds.video import VideoOptions
from pipelines.exports.requests import resolve_export
from pipelines.options import OptionsError, resolve_options, revise_options

BOX = {"shape": "box", "center": [0, 0, 1], "size": [1, 2, 3]}


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


@pytest.mark.parametrize("crop", [5, [], "box", {"shape": 3}, {"shape": ["box"]}, {"a": {}}])
def test_whatever_json_is_given_is_answered(crop: Any) -> None:
    for given in ({"crop": crop}, {"crop": crop, "extent": "subject"}, {"extent": crop}):
        with pytest.raises(OptionsError, match=r"mesh\."):
            asked("mesh", {"crop": BOX}, given)
