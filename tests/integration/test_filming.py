"""Films with one fault each, through ingest, frames, poses and check: the fault is what is told.

An analytic room corner, filmed from known places; the clean film says which notes belong to the
scene itself.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pipelines.errors import PosesError
from pipelines.filming.around import look_around
from pipelines.manifest import run_stage
from pipelines.options import resolve_options
from pipelines.registry import get_stage
from pipelines.workspace import Workspace
from tests.unit.pipelines.sfm.synthetic_room import HEIGHT, WIDTH, arc_poses, render, turning_poses
from tests.unit.pipelines.tools.clips import ffmpeg

RATE, NUM, KEPT = 16, 72, 24
SMALL = {
    "frames": {"num_frames": KEPT, "candidates_per_frame": 3},
    "poses": {"num_features": 1200, "max_image_px": 300, "retry_below_ratio": 0.3},
}
Pictures = list[np.ndarray]


@cache
def clean() -> tuple[np.ndarray, ...]:
    """The film without a fault, in 4.5 s: an arc of 50 degrees around the room's corner, which
    is 72 around the point that the camera looks at, and 92 with what is seen to either side."""
    return tuple(np.asarray(render(pose)) for pose in arc_poses(NUM))


def whipped() -> Pictures:
    """The camera turns aside and back within a second, by up to 40 pixels a frame, the shutter open
    for half of that."""
    pictures = list(clean())
    beat = range(28, 44)
    turned = 100.0 * (1.0 - np.cos(2 * np.pi * np.arange(len(beat) + 1) / len(beat)))
    for place, index in enumerate(beat):
        start, speed = turned[place], turned[place + 1] - turned[place]
        steps = [round(start + speed * part) for part in np.linspace(0.0, 0.5, 12)]
        views = [np.roll(clean()[index], -step, axis=1) for step in steps]
        pictures[index] = np.mean(views, axis=0).astype(np.uint8)
    return pictures


def blank() -> Pictures:
    """A second in front of a plain wall."""
    pictures = list(clean())
    shade = np.linspace(150, 170, WIDTH)[None, :, None]
    for index in range(30, 42):
        pictures[index] = np.broadcast_to(shade, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    return pictures


def cut() -> Pictures:
    """The last seconds were filmed elsewhere: mirrored pictures match no others."""
    return [one[:, ::-1] if index >= 57 else one for index, one in enumerate(clean())]


def darkened() -> Pictures:
    """The camera turns its exposure down by a good stop."""
    return [
        (one * 0.45).astype(np.uint8) if index >= 40 else one for index, one in enumerate(clean())
    ]


def turning() -> Pictures:
    """From one place."""
    return [np.asarray(render(pose)) for pose in turning_poses(NUM)]


@dataclass
class Checked:
    """What a job left. error: of the stage that failed."""

    report: dict[str, Any]
    page: str
    error: PosesError | None

    @property
    def codes(self) -> set[str]:
        return {finding["code"] for finding in self.report["findings"]}


def checked(folder: Path, pictures: Pictures) -> Checked:
    """Film, and run the stages that a check has."""
    shots = folder / "pictures"
    shots.mkdir()
    for index, picture in enumerate(pictures):
        Image.fromarray(picture).save(shots / f"{index:03d}.png")
    workspace = Workspace(folder / "job")
    workspace.capture_file.parent.mkdir(parents=True)
    film = folder / "film.mp4"
    quality = ("-crf", "16", "-pix_fmt", "yuv420p")
    ffmpeg("-framerate", str(RATE), "-i", shots / "%03d.png", *quality, film)
    film.rename(workspace.capture_file)
    options = resolve_options("check", SMALL)
    error = None
    try:
        for name in ("ingest", "frames", "poses", "check"):
            run_stage(get_stage(name), options[name], workspace)
    except PosesError as raised:
        error = raised
    left = workspace.stage("check") if error is None else workspace.failed("poses")
    return Checked(
        json.loads((left / "capture-report.json").read_text("utf-8")),
        (left / "capture-report.html").read_text("utf-8"),
        error,
    )


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Checked:
    return checked(tmp_path_factory.mktemp("clean"), list(clean()))


def test_a_clean_film_is_good(good: Checked) -> None:
    assert (good.error, good.report["verdict"]) == (None, "good")
    assert good.codes <= {"part_unseen"}
    assert good.report["lost"] == {"num": 0, "seconds": 0.0, "spans": []}
    assert len(good.report["timeline"]) == len(good.report["path"]) == KEPT
    assert good.report["parallax_deg"] > 5
    truth = look_around(arc_poses(NUM))
    assert truth is not None
    assert good.report["around"]["covered_deg"] == pytest.approx(truth.covered_deg, abs=3)
    assert 'class="lost"' not in good.page


def test_a_whip_pan_is_told_with_its_time(tmp_path: Path, good: Checked) -> None:
    found = checked(tmp_path, whipped())
    assert found.codes - good.codes <= {"moved_too_fast", "soft_moving", "few_placed"}
    told = [
        finding
        for finding in found.report["findings"]
        if finding["code"] in ("moved_too_fast", "soft_moving")
    ]
    assert told
    assert max(finding["measured"]["max_speed"] for finding in told) > 0.6
    spans = [span for finding in told for span in finding["spans"]]
    assert all(1.5 < span["from_s"] <= span["to_s"] < 3.0 for span in spans), spans


def test_a_plain_wall_is_told_with_its_time(tmp_path: Path, good: Checked) -> None:
    found = checked(tmp_path, blank())
    assert found.codes - good.codes == {"too_few_features", "few_placed"}
    (span,) = found.report["lost"]["spans"]
    assert 1.6 < span["from_s"] < span["to_s"] < 2.8
    assert found.report["lost"]["seconds"] == pytest.approx(0.75, abs=0.3)
    assert 'class="lost"' in found.page


def test_a_part_from_elsewhere_does_not_hang_together_with_the_rest(
    tmp_path: Path, good: Checked
) -> None:
    found = checked(tmp_path, cut())
    new = found.codes - good.codes
    assert new & {"broken_apart", "no_overlap"}
    assert new <= {"broken_apart", "no_overlap", "few_placed", "few_pictures"}
    assert all(span["from_s"] > 3.3 for span in found.report["lost"]["spans"])


def test_a_change_of_exposure_is_told_with_its_time(tmp_path: Path, good: Checked) -> None:
    found = checked(tmp_path, darkened())
    assert found.codes - good.codes == {"exposure_jump"}
    (jump,) = (one for one in found.report["findings"] if one["code"] == "exposure_jump")
    assert jump["measured"]["max_ev"] == pytest.approx(1.15, abs=0.3)
    assert 2.2 < jump["spans"][0]["from_s"] < 2.9


def test_a_camera_that_turns_on_the_spot_makes_the_capture_unusable(tmp_path: Path) -> None:
    found = checked(tmp_path, turning())
    assert found.error is not None
    assert found.codes == {"no_parallax"}
    assert found.report["verdict"] == "unusable"
    assert found.error.details["check"]["verdict"] == "unusable"
    assert "Move sideways" in found.report["advice"][0]
    assert "Unusable" in found.page
