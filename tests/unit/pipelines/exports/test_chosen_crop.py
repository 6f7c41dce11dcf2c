"""The crop that is found by itself, told so that it can be asked for by hand."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import pytest

from pipelines.exports.chosen_crop import angles_of, box_of, chosen_crop
from pipelines.exports.crop import Crop, crop_of
from pipelines.exports.frame import FrameName
from pipelines.exports.options import CropShapeOptions
from pipelines.exports.placement import Placement, placement_of
from pipelines.exports.subject import Decision, Footprints, Thing
from pipelines.workspace import Workspace
from tests.unit.pipelines.exports.test_placement import MOVED, around
from tests.unit.pipelines.stages import tiny_job

LOG = logging.getLogger("nerfworks.stage")
NOBODY = Footprints(np.eye(3)[:, :2], np.zeros(3), 1.0, np.zeros((1, 1), np.int32))


def _walked_round(center: Any = (0.3, -0.2, 0.5), size: Any = (0.8, 0.5, 0.3)) -> Decision:
    turn = np.radians(35.0)
    axes = np.array(
        [[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0], [0.0, 0.0, 1.0]]
    )
    region = Crop(np.asarray(center, np.float64), axes, np.asarray(size) / 2.0)
    thing = Thing(region, region.center, None, NOBODY, 0.01, 0.05)
    return Decision("subject", "It is looked at.", {"arc_deg": 90.0}, thing)


def _never() -> Decision:
    raise AssertionError("nobody asked for the subject")


def test_angles_turn_a_box_back_to_its_axes_also_where_it_stands_on_end() -> None:
    rng = np.random.default_rng(4)
    angles = rng.uniform(-180.0, 180.0, (200, 3))
    for row, pitch in enumerate((90.0, -90.0, 90.0 - 1e-5, 1e-9)):
        angles[row, 1] = pitch
    for one in angles:
        made = crop_of(CropShapeOptions(shape="box", rotation_deg=tuple(one)))
        assert made is not None
        turns = angles_of(made.axes)
        assert np.abs(turns).max() <= 180.0
        again = crop_of(CropShapeOptions(shape="box", rotation_deg=tuple(turns)))
        assert again is not None
        np.testing.assert_allclose(again.axes, made.axes, atol=1e-7)


PLACES = {
    name: placement_of(name, around(notes=MOVED)) for name in ("gravity", "source", "normalised")
}


@pytest.mark.parametrize("name", PLACES)
@pytest.mark.parametrize("size", [1.0, 1e-4, 300.0])
def test_the_box_that_is_told_is_the_one_that_was_found(name: FrameName, size: float) -> None:
    place = PLACES[name]
    decision = _walked_round(size=size * np.array([0.8, 0.5, 0.3]))
    crop, told = chosen_crop(CropShapeOptions(shape="auto"), place, lambda: decision, LOG)
    assert crop is not None
    assert told is not None
    by_hand = CropShapeOptions(**told["used"])
    again, said = chosen_crop(by_hand, place, _never, LOG)
    assert again is not None
    assert said is not None
    assert said["used"] == told["used"]
    np.testing.assert_array_equal(again.center, crop.center)
    np.testing.assert_array_equal(again.axes, crop.axes)
    np.testing.assert_array_equal(again.half, crop.half)
    assert (told["asked"], said["asked"]) == ("auto", "box")
    assert told["measures"] == {"arc_deg": 90.0}
    # It holds what the thing's region does, but for a millionth.
    assert decision.thing is not None
    region = decision.thing.region
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    inner = region.center + 0.99999 * corners * region.half @ region.axes.T
    outer = region.center + 1.00001 * corners * region.half @ region.axes.T
    assert crop.contains(inner).all()
    assert not crop.contains(outer).any()


def test_a_box_in_map_coordinates_may_be_asked_for_by_hand() -> None:
    decision = _walked_round(center=(500_000.0, 5_800_000.0, 40.0))
    used = box_of(decision, PLACES["gravity"])
    assert used is not None
    assert used.center == (500_000.0, 5_800_000.0, 40.0)
    assert CropShapeOptions(**used.model_dump()) == used


def test_what_is_found_nowhere_crops_nothing_and_says_so(caplog: pytest.LogCaptureFixture) -> None:
    room = Decision("scene", "They look about.", {"looking": 0.3})
    asked = CropShapeOptions(shape="auto")
    crop, told = chosen_crop(asked, PLACES["gravity"], lambda: room, LOG)
    assert crop is None
    assert told == {
        "asked": "auto",
        "used": None,
        "why": "They look about.",
        "measures": {"looking": 0.3},
    }
    assert "They look about." in caplog.text
    # What stands in a place that was filmed is no subject of its own accord.
    assert box_of(Decision("scene", "", {}, _walked_round().thing), PLACES["gravity"]) is None


@pytest.mark.parametrize("shape", ["none", "box", "sphere"])
def test_what_is_cut_out_by_hand_is_not_sought(shape: Any) -> None:
    place: Placement = PLACES["source"]
    crop, told = chosen_crop(CropShapeOptions(shape=shape, radius=0.5), place, _never, LOG)
    assert (crop is None) == (told is None) == (shape == "none")
    if told is not None:
        assert (
            told["used"].keys()
            == {
                "box": {"shape", "center", "size", "rotation_deg"},
                "sphere": {"shape", "center", "radius"},
            }[shape]
        )


@pytest.mark.parametrize(("kind", "frame"), [("mesh", "normalised"), ("pointcloud", "gravity")])
def test_an_export_of_the_subject_is_that_of_its_box_byte_for_byte(
    job: Workspace, kind: str, frame: str
) -> None:
    found = tiny_job.run(job, kind, frame=frame, crop={"shape": "auto"})
    files = {file["path"]: file["sha256"] for file in found["files"]}
    told = found["summary"]["crop"]
    assert told["used"]["shape"] == "box", told
    by_hand = tiny_job.run(job, kind, frame=frame, crop=told["used"])
    assert {file["path"]: file["sha256"] for file in by_hand["files"]} == files
    assert by_hand["summary"]["crop"]["used"] == told["used"]
    larger = {**told["used"], "size": [1.5 * side for side in told["used"]["size"]]}
    other = tiny_job.run(job, kind, frame=frame, crop=larger)
    assert {file["path"]: file["sha256"] for file in other["files"]} != files
