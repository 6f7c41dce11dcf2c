"""VisualSFM models: poses, the distortion that runs the other way, broken files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipelines.captures.sniff import sniff
from pipelines.exports.formats.ply import read_ply
from pipelines.scene.cameras_file import Intrinsics
from tests.sfm_writers import nvm_text, pictures_of, sparse_points, walked
from tests.unit.pipelines.captures.archives import picture, write_zip
from tests.unit.pipelines.captures.ingesting import (
    assert_poses,
    cameras,
    failure,
    ingest,
    warning_with,
)

TRUTH = walked(Intrinsics(64, 48, 61.5, 61.5, 32.0, 24.0))
PICTURES = pictures_of(TRUTH)


@pytest.mark.parametrize("name", ["model.nvm", "sfm/out.NVM", "a/b/c.txt"])
def test_poses_and_points_are_those_that_were_written(tmp_path: Path, name: str) -> None:
    files = PICTURES | {name: nvm_text(TRUTH).encode()}
    assert sniff(write_zip(tmp_path / "c.zip", files), "c").kind == "visualsfm"
    summary, ctx = ingest(tmp_path / "job", files)
    assert (summary["num_posed"], summary["metric"], summary["warnings"]) == (10, False, [])
    assert_poses(ctx, TRUTH)
    assert cameras(ctx).cameras == TRUTH.cameras
    cloud = read_ply(ctx.out / "points.ply")
    np.testing.assert_allclose(cloud.points, sparse_points()[0], atol=1e-6)
    np.testing.assert_array_equal(cloud.colors, sparse_points()[1])


@pytest.mark.parametrize("r", [0.17, -0.1, 0.5])
def test_distortion_is_the_inverse_of_what_the_file_says(tmp_path: Path, r: float) -> None:
    """m (1 + r m^2) = u, for every m in the picture, to a hundredth of a pixel of 64."""
    _, ctx = ingest(tmp_path, PICTURES | {"a.nvm": nvm_text(TRUTH, r=r).encode()})
    (lens,) = cameras(ctx).cameras
    m = np.linspace(0.0, np.hypot(32, 24) / 61.5, 50)
    u = m * (1 + r * m**2)
    shown = u * (1 + lens.k1 * u**2 + lens.k2 * u**4 + lens.k3 * u**6 + lens.k4 * u**8)
    np.testing.assert_allclose(shown * lens.fl_x, m * lens.fl_x, atol=1e-2)
    assert lens.model == "OPENCV"


def test_the_largest_of_several_models_is_read(tmp_path: Path) -> None:
    first = nvm_text(walked(*TRUTH.cameras, num=3)).split("\n0\n")[0]
    second = nvm_text(TRUTH).removeprefix("NVM_V3 \n")
    summary, ctx = ingest(tmp_path, PICTURES | {"a.nvm": (first + "\n" + second).encode()})
    assert_poses(ctx, TRUTH)
    assert warning_with(summary, "has 2 models", "10 cameras", "those with 3")


def test_without_pictures_it_says_which_it_wants(tmp_path: Path) -> None:
    error = failure(tmp_path, {"a.nvm": nvm_text(TRUTH)})
    assert (error.code, "images/IMG_9.jpg" in error.message) == ("poses_missing", True)


@pytest.mark.parametrize(
    ("old", "new", "code", "words"),
    [
        ("\n10\n", "\n0\n", "poses_missing", "no cameras"),
        ("\n10\n", "\nten\n", "poses_malformed", "Line 3"),
        ("\n10\n", "\n200001\n", "poses_malformed", "more than 200000 cameras"),
        (
            "\n10\n",
            "\n10" + " " * (1 << 20) + "\n",
            "poses_malformed",
            "Line 3 of a.nvm is endless",
        ),
        ("\n10\n", "\n11\n", "poses_malformed", "Line 15"),
        ("\n40\n", "\n99\n", "poses_malformed", "no point"),
        ("61.5", "nan", "poses_malformed", "Line 4"),
        ("61.5", "0.0", "poses_malformed", "focal length"),
        ("61.5", "", "poses_malformed", "Line 4"),
        (" 0 \n", " \n", "poses_malformed", "Line 4"),
        (" 0.0 0 \n", " -9.0 0 \n", "poses_malformed", "folds the picture over"),
        (" 0.0 0 \n", " nan 0 \n", "poses_malformed", "Line 4"),
    ],
)
def test_faults_are_refused_by_name(
    tmp_path: Path, old: str, new: str, code: str, words: str
) -> None:
    text = nvm_text(TRUTH)
    assert old in text
    error = failure(tmp_path, PICTURES | {"a.nvm": text.replace(old, new).encode()})
    assert error.code == code
    assert words in error.message


@pytest.mark.parametrize("focal", [1e-200, 1e-320, 1e-60, 0.01])
@pytest.mark.parametrize("r", [0.1, -0.1, 1e11])
def test_a_focal_length_that_no_lens_has_is_refused(tmp_path: Path, focal: float, r: float) -> None:
    text = nvm_text(TRUTH, r=r).replace("61.5", str(focal))
    error = failure(tmp_path, PICTURES | {"a.nvm": text.encode()})
    assert error.code == "poses_malformed"
    assert "focal lengths" in error.message


def test_reduced_pictures_are_refused_as_the_file_has_no_sizes(tmp_path: Path) -> None:
    half = {name: picture(32, 24, seed=n) for n, name in enumerate(PICTURES)}
    text = nvm_text(TRUTH).replace("1 6 30.5", "1 6 17.5")
    assert ingest(tmp_path / "a", PICTURES | {"a.nvm": text.encode()})[0]["num_posed"] == 10
    many = text
    for camera in range(10):
        many = many.replace("3 0 5 1.5", f"3 {camera} 5 17.5", 1)
    error = failure(tmp_path / "b", {**half, "a.nvm": many})
    assert error.code == "poses_malformed"
    assert "made of a larger one" in error.message


def test_a_file_that_is_cut_off_is_refused(tmp_path: Path) -> None:
    text = nvm_text(TRUTH)
    error = failure(tmp_path, PICTURES | {"a.nvm": text[: len(text) // 4].encode()})
    assert error.code == "poses_malformed"
