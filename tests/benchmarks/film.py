"""What a film's pictures are worth: from the trained scene, from the mesh, and from both.

    python -m tests.benchmarks.film JOB... [--long-side 960] [--shrink 2 3] [--views 4]
        [--json out/film.json] [--pictures out/film]

JOB is the folder of a finished job, which is only read. Held-out photos at the film's size, each
half in the light that the other tells (as the stage `assess` does), beside: the scene rendered at
that size; the scene rendered smaller by each --shrink and enlarged; the mesh, its holes filled with
that; and both mixed as the export `video` does (`pipelines.exports.mixing`). PSNR and SSIM of whole
pictures, means over the views, and the median seconds of a picture. With --pictures a PNG per job:
photo, scene, mesh, mixed, of the first views.
"""

from __future__ import annotations

import argparse
import statistics
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from pipelines.exports.formats.glb import read_mesh
from pipelines.exports.judged import mesh_of
from pipelines.exports.mixing import enlarged, mixed
from pipelines.exports.shots import MeshStudio
from pipelines.judging.asset_views import AssetView
from pipelines.nerf.judging.metrics import psnr, ssim
from pipelines.options import AssessOptions
from pipelines.scene.cameras_file import Intrinsics
from pipelines.scene.trained_scene import TrainedScene, as_array, as_uint8
from pipelines.stages.assess import Views, load_views
from pipelines.workspace import Workspace
from tests.benchmarks.machine import describe, heading
from tests.benchmarks.tables import markdown_table, number, write_json

HEADER = ("job", "size", "picture", "PSNR", "SSIM", "s a picture")
_SHOWN = 3

Picture = NDArray[np.float32]


@dataclass
class Row:
    """psnr_db, ssim: means over the views. picture_s: median of the time of one."""

    job: str
    size: str
    picture: str
    psnr_db: float
    ssim: float
    picture_s: float


def _sized(lens: Intrinsics, width: int, height: int) -> Intrinsics:
    """The lens of a picture of another size."""
    x, y = width / lens.width, height / lens.height
    return replace(
        lens,
        width=width,
        height=height,
        fl_x=lens.fl_x * x,
        fl_y=lens.fl_y * y,
        cx=lens.cx * x,
        cy=lens.cy * y,
    )


def pictures_of(
    scene: TrainedScene, mesh: MeshStudio, lens: Intrinsics, pose: Any, shrinks: list[int]
) -> dict[str, tuple[Picture, float]]:
    """Each way's picture of a view, and its seconds."""
    long_side = max(lens.width, lens.height)
    started = time.perf_counter()

    def seconds() -> float:
        """Since it was last asked."""
        nonlocal started
        since, started = started, time.perf_counter()
        return started - since

    def field(side: int) -> Picture:
        shown: Picture = as_array(scene.render(lens, pose, side).rgb).astype(np.float32)
        return shown

    found = {"scene": (field(long_side), seconds())}
    seen = mesh.view(lens, pose)
    cast_s = seconds()
    for shrink in shrinks:
        small = field(round(long_side / shrink))
        small_s = seconds()
        large = enlarged(small, lens.height, lens.width)
        filled = np.where(seen.hit[..., None], seen.color, large)
        seconds()
        both = mixed(small, seen)
        both_s = cast_s + small_s + seconds()
        found[f"scene 1/{shrink}"] = large, small_s
        found[f"mesh, scene 1/{shrink} in its holes"] = filled, cast_s + small_s
        found[f"mixed 1/{shrink}"] = both, both_s
    return found


def measure(
    job: Workspace, long_side: int, shrinks: list[int], num_views: int, pictures: Path | None
) -> list[Row]:
    """The rows of one job."""
    scene = TrainedScene.load(job.stage("train") / "model.zip")
    mesh = MeshStudio(read_mesh(mesh_of(job.stage("mesh"))))
    views = load_views(job, AssessOptions(long_side_px=long_side, num_views=num_views))
    scores: dict[str, list[tuple[float, float, float]]] = {}
    shown: list[Picture] = []
    for index, image in enumerate(views.posed):
        width, height = views.cameras.size[index].tolist()
        lens = _sized(views.lenses[index], width, height)
        pose = np.asarray(image.world_from_camera, np.float64)
        found = pictures_of(scene, mesh, lens, pose, shrinks)
        for name, (picture, seconds) in found.items():
            lit = _lit(views, picture, index)
            scores.setdefault(name, []).append((*_scores(views, lit, index), seconds))
        if index < _SHOWN:
            shown.append(np.concatenate([views.photo(index), *(p for p, _ in found.values())], 1))
    if pictures is not None:
        pictures.mkdir(parents=True, exist_ok=True)
        narrow = min(row.shape[1] for row in shown)
        sheet = np.concatenate([row[:, :narrow] for row in shown])
        Image.fromarray(as_uint8(sheet)).save(pictures / f"{job.root.name}.png")
    width, height = views.cameras.size[0].tolist()
    return [
        Row(
            job.root.name,
            f"{width}x{height}",
            name,
            statistics.fmean(row[0] for row in rows),
            statistics.fmean(row[1] for row in rows),
            statistics.median(row[2] for row in rows),
        )
        for name, rows in scores.items()
    ]


def _lit(views: Views, picture: Picture, index: int) -> Picture:
    """The picture in the light of the photo."""
    everywhere = np.ones(picture.shape[:2], bool)
    return views.lit(AssetView(picture, everywhere, picture[..., 0]), index).color


def _scores(views: Views, picture: Picture, index: int) -> tuple[float, float]:
    mask = views.images.mask(index)
    pair = torch.from_numpy(np.ascontiguousarray(picture)), torch.from_numpy(views.photo(index))
    return psnr(*pair, mask), ssim(*pair, mask)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("jobs", nargs="+", type=Path, metavar="JOB")
    parser.add_argument("--long-side", type=int, default=960)
    parser.add_argument("--shrink", type=int, nargs="+", default=[2, 3])
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--pictures", type=Path)
    args = parser.parse_args()
    machine = describe()
    print(heading(machine))
    rows = [
        row
        for job in args.jobs
        for row in measure(Workspace(job), args.long_side, args.shrink, args.views, args.pictures)
    ]
    cells = [
        (
            row.job,
            row.size,
            row.picture,
            number(row.psnr_db, 2),
            number(row.ssim, 3),
            number(row.picture_s, 2),
        )
        for row in rows
    ]
    print(markdown_table(HEADER, cells))
    write_json(args.json, {"machine": machine, "rows": [asdict(row) for row in rows]})


if __name__ == "__main__":
    main()
