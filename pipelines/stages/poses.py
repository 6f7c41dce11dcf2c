"""Poses: where each image was taken, by structure from motion.

Reads the images of `frames` (videos) or `ingest` (photos). Writes cameras.json (registered images
only, of panoramas their views; gravity along -Z, cameras in [-1, 1]^3), points.ply (sparse,
coloured, same frame) and report.json (what registered, what did not and why, every attempt made,
how keypoints were refined, which lens and how well it is known); where no usable poses are found,
report.json alone. The parts:
`pipelines.sfm` (which images, which pairs, attempts, verdict, lenses), `pipelines.tools.colmap`,
`pipelines.scene.orientation`.
"""

from __future__ import annotations

import json
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.errors import Cancelled, PosesError, ToolError
from pipelines.exports.formats.ply import write_points
from pipelines.options import PosesOptions
from pipelines.scene.cameras_file import CamerasFile, PosedImage
from pipelines.scene.orientation import Normalisation, normalise, opengl_from_opencv
from pipelines.sfm.attempts import Ladder, num_processors
from pipelines.sfm.checkpoint import Checkpoint
from pipelines.sfm.clips import clip_warnings, clips_of
from pipelines.sfm.found_images import FoundImages, found_images
from pipelines.sfm.given import UNREFINED
from pipelines.sfm.given_report import replaced
from pipelines.sfm.intrinsics import LensVerdict, lens_warnings, settle_lenses, unsettled
from pipelines.sfm.report import (
    build_report,
    check_usable,
    mixed_lens_warnings,
    path_warnings,
    report_of_failure,
    report_of_model,
)
from pipelines.sfm.rungs import RUNGS
from pipelines.sfm.source import Source, prior_focals_px, read_source
from pipelines.sfm.subpixel import refine_model
from pipelines.stage import POSES_REPLACED, REPORT, StageContext
from pipelines.stages.given_poses import GivenPoses, judge_given
from pipelines.tools.colmap import Reconstructor
from pipelines.tools.colmap_adjustment import share_done
from pipelines.tools.colmap_results import SparseModel
from pipelines.workspace import SPARSE_POINTS

MIN_TRACK = 3
"""Points seen by fewer images are left out of points.ply: most of them are wrong."""

_LEAST_INSTEAD = 0.7
"""Of the pictures such poses must have, and matches agree with, to be taken."""

_SUMMARY = (
    "num_images",
    "num_registered",
    "registered_ratio",
    "metric",
    "mean_reprojection_error_px",
    "median_triangulation_angle_deg",
    "agreement",
    "num_points",
    "num_cameras",
    "subpixel",
    "intrinsics",
    "warnings",
    "models",
    "clips",
    "gaps_s",
)


def run(options: PosesOptions, ctx: StageContext) -> dict[str, Any]:
    """Find the poses of a capture's images. The summary is report.json without its lists of images.

    Of a capture that brought its poses see `pipelines.stages.given_poses`; where these
    have nothing to do with the pictures, they are found from the pictures, and taken if they fit.
    Raises PosesError (no_features, too_few_registered, no_parallax), CaptureError where there are
    no images, ToolError where COLMAP itself fails; none of them for a capture with poses, unless
    these are to be ignored.
    """
    mode = options.given
    if mode == "ignore" or not ctx.workspace.brought_poses:
        return _found(options, ctx)
    begun = 0.0

    def watched(fraction: float, message: str, eta_s: float | None) -> None:
        nonlocal begun
        begun = max(begun, fraction)
        ctx.on_progress(fraction, message, eta_s)

    def later(fraction: float, message: str, eta_s: float | None) -> None:
        ctx.on_progress(begun + (1.0 - begun) * fraction, message, eta_s)

    given = judge_given(options, mode, replace(ctx, on_progress=watched))
    instead = None
    if given.judged.is_wrong and mode != "trust":
        instead = _instead_of(given, options, replace(ctx, on_progress=later))
    return given.write(ctx) if instead is None else instead


def _instead_of(
    given: GivenPoses, options: PosesOptions, ctx: StageContext
) -> dict[str, Any] | None:
    """The summary of poses that were found in place of those given; None where they do not fit.

    Of a thing on a turntable before a still room, say, most matches are of the room.
    """
    ctx.logger.info("The given poses have nothing to do with the pictures: looking for others.")
    try:
        summary = _found(options, ctx)
    except Cancelled:
        raise
    except UNREFINED as error:
        ctx.logger.info("There are none: %s", error, exc_info=not isinstance(error, PosesError))
        return None
    agreement = summary["agreement"]
    if summary["registered_ratio"] < _LEAST_INSTEAD or (agreement or 0.0) < _LEAST_INSTEAD:
        ctx.logger.info("They fit no better.")
        return None
    warning = replaced(given.report["given"], agreement)
    ctx.logger.warning("%s %s", warning["message"], warning["hint"])
    told = {
        "given": {**given.report["given"], "verdict": POSES_REPLACED, "refinement": None},
        "warnings": [warning, *summary["warnings"]],
    }
    report = json.loads((ctx.out / REPORT).read_text("utf-8"))
    _write_report(ctx, {**report, **told})
    return {**summary, **told}


def _found(options: PosesOptions, ctx: StageContext) -> dict[str, Any]:
    """Poses by structure from motion."""
    source = read_source(ctx.workspace)
    checkpoint = Checkpoint(ctx, source, options)
    with tempfile.TemporaryDirectory(prefix="poses-") as scratch:
        reconstructor = Reconstructor(
            checkpoint.database(RUNGS[0].matches.database),
            source.paths,
            Path(scratch),
            num_threads=_num_threads(options, ctx),
            seed=ctx.seed,
            masks=source.mask_paths,
        )
        ladder = Ladder(reconstructor, checkpoint, source, options, ctx)
        try:
            outcome = ladder.climb()
            model = check_usable(outcome, source, options)
        except (PosesError, ToolError) as error:
            report = report_of_failure(ladder.outcome, source, options, error)
            _write_report(ctx, {**report, "clips": clips_of(ladder.outcome, source)})
            raise
        model, refinement = _refine(reconstructor, model, source, options, ctx)
        if source.has_panoramas:
            lenses = unsettled(model)
        else:
            model, lenses = _settle_lenses(reconstructor, model, source, options, ctx)
    ctx.progress(0.99, "writing the poses", 1.0)
    found = found_images(model, source)
    poses = opengl_from_opencv(found.world_from_camera)
    world = normalise(
        poses,
        orient=options.orientation == "auto",
        measured=found.up,
        points=model.points[model.track_lengths >= MIN_TRACK],
    )
    notes: dict[str, Any] = {"up_from": world.up_from, "centered_on": world.centered_on}
    if world.straightened_deg:
        notes["straightened_deg"] = round(world.straightened_deg, 2)
    write_cameras(ctx.out / "cameras.json", found, world, notes)
    write_sparse_points(ctx.out / SPARSE_POINTS, model, world)
    report = {
        **build_report(outcome, source),
        **report_of_model(model, lenses, notes),
        "clips": clips_of(outcome, source),
    }
    report["subpixel"] = refinement
    found_wrong = [
        *path_warnings(outcome, source),
        *mixed_lens_warnings(outcome),
        *clip_warnings(report["clips"]),
    ]
    report["warnings"] = [*report["warnings"], *found_wrong]
    for warning in found_wrong:
        ctx.logger.warning("%s", warning["message"])
    _write_report(ctx, report)
    ctx.progress(1.0, f"{len(model.indices)} of {len(source.files)} images registered", 0.0)
    return {key: report[key] for key in _SUMMARY}


def _num_threads(options: PosesOptions, ctx: StageContext) -> int:
    """Threads of matching and mapping: half of what there is, where memory ran out before."""
    if ctx.memory == "full":
        return options.num_threads
    wanted = options.num_threads if options.num_threads > 0 else num_processors()
    return max(wanted // 2, 1)


def _refine(
    reconstructor: Reconstructor,
    model: SparseModel,
    source: Source,
    options: PosesOptions,
    ctx: StageContext,
) -> tuple[SparseModel, dict[str, float | int] | None]:
    """The model with its keypoints refined, and what report.json says of that."""
    num_threads = _num_threads(options, ctx)
    refined, found = refine_model(
        reconstructor,
        model,
        source,
        options,
        lambda share: ctx.progress(0.97 + 0.01 * share, "adjusting all poses"),
        num_threads if num_threads > 0 else num_processors(),
    )
    if found is None:
        return refined, None
    ctx.logger.info(
        "%d of %d observations moved by %.2f px (median), %d dropped; error %.2f px, was %.2f",
        found.num_moved,
        found.num_observations,
        found.median_move_px,
        found.num_dropped,
        found.error_after_px,
        found.error_before_px,
    )
    return refined, found.as_dict()


def _settle_lenses(
    reconstructor: Reconstructor,
    model: SparseModel,
    source: Source,
    options: PosesOptions,
    ctx: StageContext,
) -> tuple[SparseModel, tuple[LensVerdict, ...]]:
    """The model with the lenses that fit it best, and what is known of each camera."""
    trials = reconstructor.lens_trials(
        model,
        lambda rounds: ctx.progress(0.98 + 0.01 * share_done(rounds), "fitting the lens"),
        refine_principal_point=options.refine_principal_point,
    )
    settled, lenses = settle_lenses(
        model, trials, options.camera_model, prior_focals_px(model, source)
    )
    for found in lenses:
        ctx.logger.info(
            "%d images: %s, focal length %.1f px%s (%s)",
            found.num_images,
            found.lens,
            found.focal_px,
            " by EXIF" if found.is_exif else "",
            found.why,
        )
    for warning in lens_warnings(lenses):
        ctx.logger.warning("%s %s", warning["message"], warning["hint"])
    return settled, lenses


def _write_report(ctx: StageContext, report: dict[str, Any]) -> None:
    (ctx.out / REPORT).write_text(json.dumps(report, indent=1), "utf-8")


def write_cameras(
    path: Path, found: FoundImages, world: Normalisation, notes: dict[str, Any]
) -> None:
    """cameras.json of the registered images, in capture order, in the normalised world."""
    poses = world.similarity.apply_to_cameras(opengl_from_opencv(found.world_from_camera))
    images = tuple(
        PosedImage(
            file=file,
            camera=camera,
            world_from_camera=tuple(tuple(float(value) for value in row) for row in pose),
            timestamp_s=time_s,
            mask=mask,
            cut=cut,
        )
        for file, camera, time_s, mask, cut, pose in zip(
            found.files,
            found.camera_of,
            found.timestamps_s,
            found.masks,
            found.cuts,
            poses,
            strict=True,
        )
    )
    CamerasFile(
        cameras=found.cameras, images=images, metric=False, source="colmap", notes=notes
    ).save(path)


def write_sparse_points(path: Path, model: SparseModel, world: Normalisation) -> None:
    """points.ply: the points that at least three images see, in the normalised world."""
    kept = model.track_lengths >= MIN_TRACK
    points = world.similarity.apply_to_points(model.points[kept])
    write_points(path, points.astype(np.float32), model.colors[kept])
