"""Each advice appears for its cause, and for no other."""

from __future__ import annotations

import ast
from dataclasses import replace
from pathlib import Path

import pytest

from pipelines.filming.findings import CAPTURE_FAULTS, Thresholds, find, verdict_of
from pipelines.filming.looks import Look
from pipelines.filming.shots import DOUBTS, Clip, Take
from tests.unit.pipelines.filming.takes import (
    NUM,
    SHARP,
    SMEARED,
    SOFT,
    good_take,
    ring,
    spoiled,
)

ROOT = Path(__file__).resolve().parents[4]
LOST = {"is_placed": False, "group": None}
PART = range(24, 27)


def codes(take: Take) -> list[str]:
    return [finding.code for finding in find(take)]


def the_one(take: Take, code: str) -> str:
    """What is said of the only finding, which must have that code."""
    (finding,) = find(take)
    assert finding.code == code
    assert finding.measured
    assert finding.advice
    return finding.what


def test_a_good_capture_has_no_advice() -> None:
    for is_film in (True, False):
        take = good_take(is_film=is_film)
        assert find(take) == []
        assert verdict_of(take, []) == (
            "good",
            [f"{NUM} of {NUM} {'frames' if is_film else 'photos'} have a pose."],
        )


def test_a_whip_pan() -> None:
    take = spoiled(good_take(), PART, look=SMEARED, speed=1.4, best_inliers=3, **LOST)
    said = the_one(take, "moved_too_fast")
    assert said.startswith("From 0:12 to 0:13 you turned faster than the shutter")
    assert "1.4 times" in said
    assert "3 of 40 frames have no pose" in said
    assert "slower, keeping the subject in view" in find(take)[0].advice
    assert verdict_of(take, find(take))[0] == "usable"


def test_a_pan_too_fast_to_be_measured_shows_in_its_streaks() -> None:
    take = spoiled(good_take(), PART, look=SMEARED, speed=None, **LOST)
    assert "smeared over about 9 of 640 pixels by motion" in the_one(take, "moved_too_fast")


def test_fast_and_sharp_is_told_where_it_lost_the_overlap_alone() -> None:
    fast = {"speed": 1.4, "look": SHARP}
    take = spoiled(good_take(), PART, best_inliers=3, **fast, **LOST)
    assert codes(take) == ["moved_too_fast"]
    assert codes(spoiled(good_take(), PART, **fast)) == []


def in_clips(take: Take, *lengths: int, apart: tuple[int, ...] = ()) -> Take:
    """The film as clips of so many frames each."""
    number = [n for n, length in enumerate(lengths) for _ in range(length)]
    shots = [replace(shot, clip=clip) for shot, clip in zip(take.shots, number, strict=True)]
    clips = tuple(
        Clip(f"take {n}.mp4", 0.5 * number.index(n), 0.5 * length, n in apart, 11)
        for n, length in enumerate(lengths)
    )
    return replace(take, shots=tuple(shots), clips=clips)


def said_of(take: Take, code: str) -> str:
    """What is said of the one finding with that code, whatever else is."""
    (finding,) = [one for one in find(take) if one.code == code]
    return finding.what


def test_a_clip_that_joins_no_other_is_told_with_its_own_times() -> None:
    take = in_clips(good_take(), 20, 8, 12, apart=(1,))
    for lost in ({"group": 1}, {"group": None, "best_inliers": 12}, {"group": None}):
        said = said_of(spoiled(take, range(20, 28), **(LOST | lost)), "clip_apart")
        assert said.startswith("In clip 2 (take 1.mp4) from 0:00 to 0:03 the pictures show nothing")
        assert "11 details at most" in said
        assert "8 of 40 frames have no pose in common" in said
    moved = spoiled(take, range(20, 28), look=SMEARED, speed=1.4, best_inliers=3, **LOST)
    assert "clip_apart" not in codes(moved), "what can be measured of the frames comes first"


def test_times_are_those_of_each_clip_and_no_stretch_goes_over_its_end() -> None:
    take = in_clips(good_take(), 20, 20)
    said = said_of(spoiled(take, range(18, 24), best_inliers=3, **LOST), "no_overlap")
    assert said.startswith("In clip 1 (take 0.mp4) at 0:09 and in clip 2 (take 1.mp4) ")
    assert "clip 2 (take 1.mp4) from 0:00 to 0:01 the pictures share too little" in said
    whole = spoiled(good_take(), range(18, 24), best_inliers=3, **LOST)
    assert said_of(whole, "no_overlap").startswith("From 0:09 to 0:11 ")


def test_blur_without_motion() -> None:
    take = spoiled(good_take(), PART, look=SOFT, num_features=40, best_inliers=0, **LOST)
    assert "blurred over about 6 of 640 pixels" in the_one(take, "blurred")
    photos = spoiled(good_take(is_film=False), PART, look=SMEARED, **LOST)
    assert "IMG_24.jpg to IMG_26.jpg" in the_one(photos, "blurred")


def test_a_blank_wall() -> None:
    plain = Look(blur_px=None, streak=1.0, luma=0.6, dark=0.0, bright=0.0)
    take = spoiled(good_take(), PART, look=plain, num_features=12, best_inliers=0, **LOST)
    assert "12 details a picture" in the_one(take, "too_few_features")


def test_a_gap() -> None:
    take = spoiled(good_take(), PART, best_inliers=9, **LOST)
    assert "9 details at most" in the_one(take, "no_overlap")


def test_parts_that_do_not_hang_together() -> None:
    assert codes(spoiled(good_take(), PART, is_placed=False, group=1)) == ["broken_apart"]


def test_pictures_that_fit_nowhere() -> None:
    assert codes(spoiled(good_take(), PART, **LOST)) == ["does_not_fit"]


def test_a_jump_of_exposure() -> None:
    take = spoiled(good_take(), range(20, NUM), gain_ev=-1.3)
    assert "1.3 stops" in the_one(take, "exposure_jump")
    assert find(take)[0].what.startswith("At 0:10 ")
    drifting = good_take()
    shots = tuple(replace(shot, gain_ev=0.1 * i) for i, shot in enumerate(drifting.shots))
    assert codes(replace(drifting, shots=shots)) == []
    cut = [replace(shot, clip=int(i >= 20)) for i, shot in enumerate(take.shots)]
    assert codes(replace(take, shots=tuple(cut))) == [], "clips have exposures of their own"


def test_soft_pictures_that_have_a_pose() -> None:
    assert codes(spoiled(good_take(), PART, look=SMEARED, speed=0.9)) == ["soft_moving"]
    assert codes(spoiled(good_take(), PART, look=SOFT)) == ["soft"]
    half = spoiled(good_take(), range(24), look=SOFT)
    assert verdict_of(half, find(half))[0] == "poor"


def test_sides_that_were_not_seen() -> None:
    take = replace(good_take(), poses=ring(NUM, around_deg=120.0))
    assert "137 of 360" in the_one(take, "part_unseen")
    assert verdict_of(take, find(take))[0] == "good"
    assert codes(replace(take, poses=ring(NUM, around_deg=30.0))) == ["few_directions"]
    assert codes(replace(take, poses=ring(NUM, elevation_deg=0.0))) == ["one_height"]


def test_little_parallax() -> None:
    assert "2.6 degrees" in the_one(replace(good_take(), angle_deg=2.6), "little_parallax")


@pytest.mark.parametrize(
    ("look", "code"),
    [
        (replace(SHARP, luma=0.08, dark=0.6), "too_dark"),
        (replace(SHARP, luma=0.85, bright=0.4), "overexposed"),
    ],
)
def test_light(look: Look, code: str) -> None:
    assert the_one(spoiled(good_take(), range(NUM), look=look), code)


def given(*codes: str) -> Take:
    """A take whose poses came along, with warnings."""
    told = [
        {"code": code, "message": "They do not.", "hint": "Look.", "details": {"error_px": 9.0}}
        for code in codes
    ]
    return replace(good_take(), given={"warnings": told})


def test_given_poses_that_the_pictures_contradict() -> None:
    take = given("given_poses_contradicted")
    assert verdict_of(take, find(take))[0] == "poor"
    assert the_one(take, "given_poses_contradicted")
    assert verdict_of(given(), find(given()))[0] == "good"
    unknown = given("given_poses_unverified")
    assert verdict_of(unknown, find(unknown))[0] == "good"


@pytest.mark.parametrize("code", DOUBTS)
def test_poses_that_are_doubted_as_a_whole(code: str) -> None:
    told = {"code": code, "message": "They are not.", "hint": "Look.", "details": {"share": 0.1}}
    take = replace(good_take(), doubts=(told,))
    (found,) = [one for one in find(take) if one.code == code]
    is_sure = code != "lenses_unsettled"
    assert (found.severity, found.advice) == ("severe" if is_sure else "moderate", "Look.")
    assert verdict_of(take, find(take))[0] == ("poor" if is_sure else "usable")


def test_few_pictures() -> None:
    assert codes(replace(good_take(num=12), poses=ring(0), posed=())) == ["few_pictures"]


def test_how_many_have_a_pose_decides_however_the_causes_are_spread() -> None:
    take = good_take()
    for start, changes in ((0, {}), (8, {"best_inliers": 3}), (16, {"num_features": 5})):
        take = spoiled(take, range(start, start + 6), **changes, **LOST)
    found = find(take)
    assert found[0].code == "few_placed"
    assert verdict_of(take, found)[0] == "poor"
    lenient = find(take, Thresholds(good_ratio=0.5, usable_ratio=0.3))
    assert "few_placed" not in [finding.code for finding in lenient]


def failed(take: Take, stage: str, code: str) -> Take:
    error = {"stage": stage, "code": code, "message": "It failed.", "hint": "Do better."}
    return replace(take, error=error)


def test_a_camera_that_only_turned() -> None:
    lost = spoiled(good_take(), range(NUM), **LOST)
    take = failed(lost, "poses", "no_parallax")
    assert codes(take) == ["no_parallax"], "not a word on each picture"
    assert verdict_of(take, find(take)) == ("unusable", ["It failed."])


def test_where_matching_never_began_nothing_is_said_of_overlap() -> None:
    take = spoiled(good_take(), range(NUM), best_inliers=0, **LOST)
    take = spoiled(take, range(30), num_features=8)
    take = failed(take, "poses", "no_features")
    assert codes(take) == ["no_features", "too_few_features"]


def test_a_fault_of_the_machine_is_no_verdict_on_the_capture() -> None:
    unknown = good_take()
    shots = tuple(replace(shot, is_placed=None, group=None) for shot in unknown.shots)
    take = failed(replace(unknown, shots=shots), "poses", "out_of_memory")
    assert find(take) == []
    assert verdict_of(take, [])[0] is None
    late = failed(good_take(), "depth", "out_of_memory")
    assert verdict_of(late, find(late))[0] == "good"


def test_every_fault_that_stages_find_in_a_capture_is_known() -> None:
    found = set()
    files = [*(ROOT / "pipelines/captures").rglob("*.py"), *(ROOT / "pipelines/sfm").rglob("*.py")]
    files += [ROOT / f"pipelines/stages/{name}.py" for name in ("ingest", "frames", "poses")]
    for path in files:
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "").endswith(
                ("CaptureError", "PosesError")
            ):
                found |= {
                    word.value.value
                    for word in node.keywords
                    if word.arg == "code" and isinstance(word.value, ast.Constant)
                }
    assert len(found) > 10
    ours = {"capture_missing"}  # the upload is gone: no fault of who filmed it
    assert found - ours - CAPTURE_FAULTS == set()
