"""Stage `poses` of a capture that brought its poses: they are verified, and refined where it helps.

Writes cameras.json (the bytes of `ingest`, unless poses were refined or read otherwise), points.ply
where there are points (those that came along; where poses were refined those that were found with
them; where they are trusted and came alone those that matches have under them), and report.json
(`given`: how well the poses fit, and what was done, see `pipelines.sfm.given`). World, scale and
order stay those of `ingest`; of poses that were read by another convention the world is turned to
what is up by them.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.captures.world import Move
from pipelines.exports.formats.ply import write_points
from pipelines.options import PosesOptions
from pipelines.scene.cameras_file import CamerasFile
from pipelines.scene.orientation import opengl_from_opencv
from pipelines.sfm.attempts import num_processors
from pipelines.sfm.given import Judge, Judged, Mode, Posed
from pipelines.sfm.given_colors import colors_of
from pipelines.sfm.given_depth import Beside, points_beside
from pipelines.sfm.given_refinement import Refined
from pipelines.sfm.given_report import given_report, given_warnings
from pipelines.sfm.tracks import apart_deg
from pipelines.stage import REPORT, StageContext
from pipelines.stages.given_world import SentWorld
from pipelines.tools.colmap import Reconstructor
from pipelines.tools.colmap_settings import FeatureSettings, extraction_threads
from pipelines.workspace import SPARSE_POINTS

MIN_TRACK = 3
"""Points seen by fewer images are left out of points.ply: most of them are wrong."""
MIN_APART_DEG = 0.75
"""And points seen from nearly one direction (`apart_deg`): their distance is not known. COLMAP's
1.5 degrees between two rays."""
LEAST_SHOWN = 50
"""Points of the median image below which trusted poses get none: what stereo finds by itself in
small pictures then says more of where surfaces are."""
MOST_FEATURES = 4096
"""Of an image: more say nothing more of its pose, and matching grows with their square."""


@dataclass(frozen=True)
class GivenPoses:
    """What was found of a capture's poses. report: as report.json has it."""

    judged: Judged
    posed: Posed
    cameras: CamerasFile
    world: SentWorld
    report: dict[str, Any]

    def write(self, ctx: StageContext) -> dict[str, Any]:
        """All that the stage writes. The summary is report.json."""
        ctx.progress(0.99, "writing the poses", 1.0)
        (ctx.out / SPARSE_POINTS).unlink(missing_ok=True)
        _write(self, ctx)
        for warning in self.report["warnings"]:
            ctx.logger.warning("%s %s", warning["message"], warning["hint"])
        (ctx.out / REPORT).write_text(json.dumps(self.report, indent=1), "utf-8")
        ctx.progress(1.0, f"the given poses are {self.judged.verdict}", 0.0)
        return self.report


def judge_given(options: PosesOptions, mode: Mode, ctx: StageContext) -> GivenPoses:
    """Verify and perhaps refine the poses of `ingest`.

    Raises ToolError and CaptureError never: what goes wrong leaves the poses as they came.
    """
    root = ctx.workspace.stage("ingest")
    cameras = CamerasFile.load(root / "cameras.json")
    world = SentWorld.of(cameras.notes)
    posed = Posed(
        files=tuple(image.file for image in cameras.images),
        lenses=tuple(cameras.cameras[image.camera] for image in cameras.images),
        poses=opengl_from_opencv(
            np.array([image.world_from_camera for image in cameras.images]).reshape(-1, 3, 4)
        ),
        is_metric=cameras.metric,
    )
    depths = [None if image.depth is None else root / image.depth for image in cameras.images]
    stated = [image.depth_lens for image in cameras.images]
    with tempfile.TemporaryDirectory(prefix="poses-") as scratch:
        reconstructor = Reconstructor(
            Path(scratch) / "given.db",
            [root / file for file in posed.files],
            Path(scratch),
            num_threads=options.num_threads if ctx.memory == "full" else 1,
            seed=ctx.seed,
            masks={
                index: root / image.mask
                for index, image in enumerate(cameras.images)
                if image.mask is not None
            },
        )

        def measured(found: Refined) -> Beside | None:
            return points_beside(found, posed.lenses, depths, stated)

        judge = Judge(
            posed,
            reconstructor,
            _settings(options, ctx),
            ctx.progress,
            measured,
            upsample=options.upsample,
            num_threads=options.num_threads if options.num_threads > 0 else num_processors(),
            seed=ctx.seed,
            logger=ctx.logger,
            # A sensor knows more of where surfaces are than features do.
            locate=not (root / SPARSE_POINTS).is_file() and not any(depths),
        )
        judged = judge.judge(mode, world.sent, may_reread=world.is_rigid)
    ctx.logger.info("The given poses are %s: %s", judged.verdict, judged.why)
    report = {
        "num_images": len(posed.files),
        "num_registered": len(posed.files),
        "registered_ratio": 1.0,
        "metric": cameras.metric,
        "given": given_report(judged, posed, options.max_image_px),
        "warnings": given_warnings(judged, posed),
    }
    return GivenPoses(judged, posed, cameras, world, report)


def _settings(options: PosesOptions, ctx: StageContext) -> FeatureSettings:
    wanted = FeatureSettings(
        options.max_image_px,
        min(options.num_features, MOST_FEATURES),
        upsample=options.upsample == "on",
        num_threads=options.num_threads,
    )
    memory_mb = int(options.memory_mb * ctx.memory_share)
    # Of a doubled image, in case that few features turn out to be there.
    threads = extraction_threads(replace(wanted, upsample=True), memory_mb, num_processors())
    return replace(wanted, num_threads=threads)


def _write(found: GivenPoses, ctx: StageContext) -> None:
    """cameras.json and points.ply of the poses to hand on."""
    root, judged, cameras = ctx.workspace.stage("ingest"), found.judged, found.cameras
    refined = judged.refined if judged.verdict == "refined" else None
    move = None
    if refined is None and not judged.is_reread:
        for name in ("cameras.json", SPARSE_POINTS):
            if (root / name).is_file():
                shutil.copyfile(root / name, ctx.out / name)
    else:
        poses = opengl_from_opencv(judged.poses)
        notes = {**cameras.notes}
        if judged.is_reread:
            move = found.world.settle(poses)
            poses, notes = move.poses(poses), {**move.notes, "read": judged.reading}
        lenses = list(cameras.cameras)
        if refined is not None:
            notes["poses"] = "refined"
            for image, lens in zip(cameras.images, refined.lenses, strict=True):
                lenses[image.camera] = lens
        images = tuple(
            replace(
                image,
                world_from_camera=tuple(tuple(map(float, row)) for row in pose),
                depth_lens=given
                if image.depth and judged.depth_by_given_lens
                else image.depth_lens,
            )
            for image, given, pose in zip(cameras.images, found.posed.lenses, poses, strict=True)
        )
        changed = replace(cameras, cameras=tuple(lenses), images=images, notes=notes)
        changed.save(ctx.out / "cameras.json")
    if refined is not None:
        _write_points(refined, found, move, ctx)
    elif judged.located is not None:
        try:
            _write_points(judged.located, found, move, ctx, least_shown=LEAST_SHOWN)
        except (MemoryError, OSError):
            ctx.logger.warning("The points that were found are left out.", exc_info=True)
            (ctx.out / SPARSE_POINTS).unlink(missing_ok=True)


def _write_points(
    found: Refined,
    of: GivenPoses,
    move: Move | None,
    ctx: StageContext,
    *,
    least_shown: int = 0,
) -> None:
    """points.ply of what is seen by enough images, from far enough apart; of none where the median
    image shows fewer than `least_shown`. move: of the world that points were found in."""
    posed, root = of.posed, ctx.workspace.stage("ingest")
    apart = apart_deg(found.seen, found.points, found.poses)
    is_kept = (found.track_lengths >= MIN_TRACK) & (apart >= MIN_APART_DEG)
    shown = np.bincount(found.seen.image[is_kept[found.seen.track]], minlength=len(posed.files))
    kept = np.flatnonzero(is_kept)
    if len(kept) and np.median(shown) >= least_shown:
        pictures = [root / file for file in posed.files]
        colors = colors_of(found, pictures, kept, ctx.check_cancelled)
        points = found.points[kept] if move is None else move.points(found.points[kept])
        write_points(ctx.out / SPARSE_POINTS, points.astype(np.float32), colors)
