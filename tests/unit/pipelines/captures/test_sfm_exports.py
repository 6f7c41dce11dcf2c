"""The same photos as other programs reconstructed them: all must tell of the same cameras.

Needs NERFWORKS_CAPTURES. COLMAP's observations, which its model brings, serve as matches for all:
half a pixel of epipolar error in the photos of 2832x2128 is what such matches have.
"""

from __future__ import annotations

import io
import itertools
import os
from pathlib import Path

import numpy as np
import PIL.Image
import pycolmap
import pytest
import torch
from numpy.typing import NDArray

from pipelines.nerf.space import lenses as formulas
from pipelines.sample.align import path_extent, similarity
from pipelines.scene.cameras_file import Intrinsics
from tests.unit.pipelines.captures.ingesting import cameras, ingest, sources

pytestmark = [
    pytest.mark.captures,
    pytest.mark.skipif(
        "NERFWORKS_CAPTURES" not in os.environ,
        reason="real captures are NOT tested: NERFWORKS_CAPTURES does not name their folder",
    ),
]

Floats = NDArray[np.float64]
Posed = dict[str, tuple[Intrinsics, Floats]]

EXPORTS = {
    "colmap_text": "colmap",
    "colmap_binary": "colmap",
    "colmap_text_missing_cams_and_subfolders": "colmap",
    "opensfm": "opensfm",
    "visualsfm": "visualsfm",
}
LIMITS = {"opensfm": (0.006, 1.2, 1.1)}
"""Of the extent, degrees, pixels. OpenSfM was told the focal length and no distortion, and the
photos have some: its cameras are turned by up to 1.1 degrees to make up for it."""
OTHERS = (0.004, 0.2, 0.6)


def castle() -> Path:
    return Path(os.environ["NERFWORKS_CAPTURES"]) / "photos-sceaux-castle"


def flat(photo: Path) -> bytes:
    """A picture of a photo's size that packs well: importers do not look into it."""
    stream = io.BytesIO()
    with PIL.Image.open(photo) as image:
        PIL.Image.new("RGB", image.size, (90, 120, 60)).save(stream, "JPEG")
    return stream.getvalue()


@pytest.fixture(scope="module")
def imported(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Posed]:
    """Lens and pose of each photo, by the names of export and photo."""
    found: dict[str, Posed] = {}
    photos = {f"images/{p.name}": flat(p) for p in (castle() / "images").glob("*.JPG")}
    for name, kind in EXPORTS.items():
        folder = castle() / "sfm-exports" / name
        files = {f"{name}/{path.name}": path.read_bytes() for path in folder.iterdir()}
        summary, ctx = ingest(tmp_path_factory.mktemp(name), photos | files)
        assert summary["kind"] == kind
        assert summary["num_points"] > 5000
        assert (ctx.out / "points.ply").is_file()
        file = cameras(ctx)
        found[name] = {
            Path(source).name: (file.cameras[image.camera], np.array(image.world_from_camera))
            for image, source in zip(file.images, sources(ctx), strict=True)
        }
        ups = np.mean([pose[2, 1] for _, pose in found[name].values()])
        assert ups > 0.95, "photos taken upright, in a world that stands"
    return found


def test_all_photos_that_an_export_has_are_there(imported: dict[str, Posed]) -> None:
    counts = {name: len(posed) for name, posed in imported.items()}
    assert counts == dict.fromkeys(EXPORTS, 11) | {"colmap_text_missing_cams_and_subfolders": 9}


@pytest.mark.parametrize("pair", list(itertools.combinations(EXPORTS, 2)), ids="-".join)
def test_exports_agree_with_each_other(imported: dict[str, Posed], pair: tuple[str, str]) -> None:
    names = sorted(imported[pair[0]].keys() & imported[pair[1]].keys())
    ours, theirs = (np.array([imported[name][photo][1] for photo in names]) for name in pair)
    move = similarity(ours[:, :, 3], theirs[:, :, 3])
    moved = move.apply_to_cameras(ours)
    off = np.linalg.norm(moved[:, :, 3] - theirs[:, :, 3], axis=1) / path_extent(theirs[:, :, 3])
    cosines = (np.einsum("nij,nij->n", moved[:, :, :3], theirs[:, :, :3]) - 1) / 2
    turned = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    most_off, most_turned, _ = LIMITS["opensfm"] if "opensfm" in pair else OTHERS
    print(f"{pair}: centres {off.max():.3%} at most, rotations {turned.max():.2f} degrees")
    assert off.max() < most_off
    assert turned.max() < most_turned


def rays(lens: Intrinsics, pixels: Floats) -> Floats:
    """Directions [N, 3] in the OpenCV camera, z = 1, by the formulas that training uses."""
    row = [lens.k1, lens.k2, lens.k3, lens.k4, lens.p1, lens.p2]
    plane = torch.from_numpy((pixels - [lens.cx, lens.cy]) / [lens.fl_x, lens.fl_y])
    model = torch.full((len(pixels),), formulas.CAMERA_MODELS.index(lens.model))
    terms = torch.tensor([row] * len(pixels), dtype=torch.float64)
    directions: Floats = formulas.undistort(plane, terms, model).numpy()
    return directions / directions[:, 2:]


def epipolar_errors(posed: Posed) -> Floats:
    """Distances of matched pixels from each other's epipolar lines, pixels, all pairs."""
    model = pycolmap.Reconstruction(str(castle() / "sfm-exports" / "colmap_binary"))
    seen = {
        image.name: {point.point3D_id: point.xy for point in image.points2D if point.has_point3D()}
        for image in model.images.values()
    }
    errors = []
    for first, second in itertools.combinations(sorted(posed), 2):
        common = sorted(seen[first].keys() & seen[second].keys())[::5]
        if len(common) < 20:
            continue
        (lens, pose), (other, other_pose) = posed[first], posed[second]
        a = rays(lens, np.array([seen[first][point] for point in common]))
        b = rays(other, np.array([seen[second][point] for point in common]))
        flip = np.diag([1.0, -1.0, -1.0])
        rotation = (other_pose[:, :3] @ flip).T @ (pose[:, :3] @ flip)
        t = (other_pose[:, :3] @ flip).T @ (pose[:, 3] - other_pose[:, 3])
        cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
        lines = a @ (cross @ rotation).T
        errors.append(np.abs((b * lines).sum(1)) / np.hypot(*lines[:, :2].T) * other.fl_x)
    return np.concatenate(errors)


@pytest.mark.parametrize("name", EXPORTS)
def test_matches_lie_on_the_epipolar_lines_of_every_export(
    imported: dict[str, Posed], name: str
) -> None:
    errors = epipolar_errors(imported[name])
    print(f"{name}: epipolar error {np.median(errors):.2f} px (median of {len(errors)})")
    assert np.median(errors) < LIMITS.get(name, OTHERS)[2]
    # What a wrong convention would come to: the neighbour's pose.
    photos = sorted(imported[name])
    shifted = {
        photo: (imported[name][photo][0], imported[name][photos[n - 1]][1])
        for n, photo in enumerate(photos)
    }
    assert np.median(epipolar_errors(shifted)) > 5 * np.median(errors)
