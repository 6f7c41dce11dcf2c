"""What came of a reconstruction: is it usable, why were images left out, and what report.json says.

report.json is written by a stage that fails too: see `report_of_failure`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pipelines.errors import PipelineError, PosesError
from pipelines.options import PosesOptions
from pipelines.scene.orientation import normalise, opengl_from_opencv
from pipelines.sfm.agreement import LITTLE, MUCH
from pipelines.sfm.intrinsics import LensVerdict, lens_warnings
from pipelines.sfm.lens_groups import Settled
from pipelines.sfm.rungs import RUNGS, Rung
from pipelines.sfm.source import Source
from pipelines.sfm.turning import is_turning
from pipelines.tools.colmap_results import PairStatistics, SparseModel, best_model

MIN_FEATURES = 100
"""An image with fewer features cannot be placed."""
MIN_INLIERS = 30
"""Verified matches with its best partner below which an image is rarely placed (COLMAP's
abs_pose_min_num_inliers)."""
_MAX_POINTS_SHOWN = 1500
_MOVE_HINT = (
    "Move sideways around the subject while filming: turning on the spot, or holding still, "
    "shows nothing of depth."
)

_ADVICE = {
    "other_model": "Parts of the capture do not hang together: film on without a break between "
    "them, or go back over a place that both show.",
    "too_few_features": "Some images show too little: more light, less blur, textured things.",
    "too_few_matches": "Neighbouring images share too little: move more slowly, with more overlap.",
    "pose_rejected": "Images match that do not fit together: avoid moving things, mirrors and "
    "surfaces that repeat themselves.",
}
"""What helps against each reason for which an image is left out."""


@dataclass(frozen=True)
class Attempt:
    """One run of the mapper. matcher: which pairs. models: all it found, in COLMAP's order. torn:
    images of a film between which the best model's path is torn. left_out: pairs of images that
    matched, and were not used as they lay one side over another (`pipelines.sfm.tears`, `folds`).
    is_one_side: whether these alone joined what is now apart. lenses: whether it is known which
    images share a lens (`pipelines.sfm.lens_groups`)."""

    rung: Rung
    matcher: str
    models: tuple[SparseModel, ...]
    seconds: float
    torn: tuple[tuple[int, int], ...] = ()
    left_out: frozenset[tuple[int, int]] = frozenset()
    is_one_side: bool = False
    lenses: Settled = "known"

    @property
    def best(self) -> SparseModel | None:
        """The model that holds most images, as far as matches do not contradict it."""
        return best_model(self.models)

    @property
    def weight(self) -> float:
        """What the best model counts against those of other attempts: half where it is torn."""
        return 0.0 if self.best is None else self.best.weight * (0.5 if self.torn else 1.0)

    @property
    def is_contradicted(self) -> bool:
        """Whether most of what pictures show speaks against the best model, or what they show
        next to each other in time does."""
        found = None if self.best is None else self.best.agreement
        return bool(self.torn) or (found is not None and found < LITTLE)

    @property
    def num_registered(self) -> int:
        """Images in the best model."""
        return 0 if self.best is None else len(self.best.indices)


@dataclass(frozen=True)
class Outcome:
    """All attempts on a capture (none where the camera only turned), and what matching found."""

    attempts: tuple[Attempt, ...]
    statistics: PairStatistics

    @property
    def chosen(self) -> Attempt:
        """The attempt that placed most images of those that are believed as much as the best, or
        nearly, the earliest among equals; empty without any."""
        nothing = Attempt(RUNGS[0], matcher="", models=(), seconds=0.0)
        most = max((attempt.weight for attempt in self.attempts), default=0.0)
        believed = [one for one in self.attempts if one.weight >= 0.98 * most]
        return max(believed, key=lambda attempt: attempt.num_registered, default=nothing)


def num_needed(num_images: int, options: PosesOptions) -> int:
    """How many images must register for the job to go on."""
    return max(options.min_registered, math.ceil(options.min_registered_ratio * num_images))


def check_features(statistics: PairStatistics, options: PosesOptions) -> None:
    """Raise PosesError (no_features) where too few images hold anything to match."""
    num = len(statistics.num_features)
    usable = int((statistics.num_features >= MIN_FEATURES).sum())
    if usable < min(num_needed(num, options), num):
        raise PosesError(
            f"{usable} of {num} images show enough detail to find camera poses.",
            code="no_features",
            hint="Film in good light, hold still enough for sharp frames, and have textured "
            "things in view; blank walls and dark or blurred frames cannot be placed.",
            details={"num_images": num, "num_usable": usable},
        )


def check_usable(outcome: Outcome, source: Source, options: PosesOptions) -> SparseModel:
    """The model to go on with.

    Raises PosesError: no_parallax where the camera turned or stood still, else too_few_registered.
    """
    num = len(source.files)
    model = outcome.chosen.best
    placed = 0 if model is None else len(model.indices)
    needed = num_needed(num, options)
    details: dict[str, Any] = {"num_images": num, "num_registered": placed, "num_needed": needed}
    if is_turning(outcome.statistics):
        raise PosesError(
            "The camera turned or stood still instead of moving: pictures differ only as they do "
            "from one place.",
            code="no_parallax",
            hint=_MOVE_HINT,
            details=details,
        )
    if model is not None and placed >= needed:
        if model.angle_deg >= options.min_baseline_deg:
            return model
        raise PosesError(
            f"The camera hardly moved: the same point is seen from directions only "
            f"{model.angle_deg:.1f} degrees apart.",
            code="no_parallax",
            hint=_MOVE_HINT,
            details=details | {"angle_deg": model.angle_deg},
        )
    reasons = Counter(entry["code"] for entry in unregistered_images(outcome, source))
    raise PosesError(
        f"{placed} of {num} {_noun(source)} registered, at least {needed} are needed.",
        code="too_few_registered",
        details=details | {"reasons": dict(reasons)},
    )


def unregistered_images(outcome: Outcome, source: Source) -> list[dict[str, Any]]:
    """For each image left out: file, timestamp_s, code and reason."""
    model = outcome.chosen.best
    placed = set() if model is None else set(model.indices)
    others: dict[int, int] = {}
    for other in outcome.chosen.models:
        if other is not model:
            for index in other.indices:
                others[index] = max(others.get(index, 0), len(other.indices))
    entries = []
    for index, (file, seconds) in enumerate(zip(source.files, source.timestamps_s, strict=True)):
        if index not in placed:
            code, reason = _reason(index, others, outcome.statistics)
            entries.append({"file": file, "timestamp_s": seconds, "code": code, "reason": reason})
    return entries


def images_seen(outcome: Outcome, source: Source) -> list[dict[str, Any]]:
    """For each image: file, num_features, best_inliers (verified matches with its best partner),
    and group: which of the chosen attempt's models holds it, 0 for the chosen one, None for none.
    """
    models = sorted(outcome.chosen.models, key=lambda found: found is not outcome.chosen.best)
    group: dict[int, int] = {}
    for number, model in enumerate(models):
        for index in model.indices:
            group.setdefault(index, number)
    found = outcome.statistics
    return [
        {
            "file": file,
            "num_features": int(found.num_features[index]),
            "best_inliers": int(found.best_inliers[index]),
            "group": group.get(index),
        }
        for index, file in enumerate(source.files)
    ]


def _reason(index: int, others: dict[int, int], statistics: PairStatistics) -> tuple[str, str]:
    """Why an image is not in the chosen model: a stable code and words."""
    num_features = int(statistics.num_features[index])
    inliers = int(statistics.best_inliers[index])
    if index in others:
        return "other_model", f"in another, smaller model of {others[index]} images"
    if num_features < MIN_FEATURES:
        return "too_few_features", f"too few features ({num_features})"
    if inliers < MIN_INLIERS:
        return "too_few_matches", f"too few matches with its neighbours (at most {inliers})"
    return "pose_rejected", "matched its neighbours, but no pose fitted what is known of the scene"


def gaps(outcome: Outcome, source: Source) -> list[tuple[float, float]]:
    """Stretches of a video without poses: (first, last) seconds of unregistered frames."""
    model = outcome.chosen.best
    placed = set() if model is None else set(model.indices)
    found: list[tuple[float, float]] = []
    previous = -2
    for index, seconds in enumerate(source.timestamps_s):
        if seconds is None or index in placed:
            continue
        if index == previous + 1 and found:
            found[-1] = (found[-1][0], seconds)
        else:
            found.append((seconds, seconds))
        previous = index
    return found


def build_report(outcome: Outcome, source: Source) -> dict[str, Any]:
    """What report.json holds of every climb, also of one that ended without usable poses."""
    num = len(source.files)
    chosen, statistics = outcome.chosen, outcome.statistics
    return {
        "num_images": num,
        "num_registered": chosen.num_registered,
        "registered_ratio": chosen.num_registered / num,
        "metric": False,
        "models": [
            {
                "num_images": len(found.indices),
                "num_points": len(found.points),
                "agreement": None if found.agreement is None else round(found.agreement, 4),
                "chosen": found is chosen.best,
            }
            for found in chosen.models
        ],
        "attempts": [
            {
                "rung": attempt.rung.name,
                "matcher": attempt.matcher,
                "thorough": attempt.rung.mapper.thorough,
                "relaxed": attempt.rung.is_relaxed,
                "num_registered": attempt.num_registered,
                "model_sizes": [len(found.indices) for found in attempt.models],
                "seconds": round(attempt.seconds, 2),
                "torn": [[source.files[i] for i in pair] for pair in attempt.torn],
                "pairs_left_out": len(attempt.left_out),
                "lenses": attempt.lenses,
                "chosen": attempt is chosen,
            }
            for attempt in outcome.attempts
        ],
        "matching": {
            "num_pairs": statistics.num_pairs,
            "num_verified": statistics.num_verified,
            "num_one_homography": len(statistics.homographies),
            "mean_features": float(statistics.num_features.mean()),
        },
        "unregistered": unregistered_images(outcome, source),
        "gaps_s": gaps(outcome, source),
        "images": images_seen(outcome, source),
    }


def report_of_model(
    model: SparseModel, lenses: Sequence[LensVerdict], world: dict[str, Any]
) -> dict[str, Any]:
    """What report.json holds besides where the poses are usable.

    lenses: those of the camera with most images first. world: how the frame was chosen.
    """
    return {
        "mean_reprojection_error_px": model.error_px,
        "median_triangulation_angle_deg": model.angle_deg,
        "agreement": None if model.agreement is None else round(model.agreement, 4),
        "num_points": len(model.points),
        "num_cameras": len(model.cameras),
        "intrinsics": {
            **lenses[0].as_dict(),
            "other_cameras": [found.as_dict() for found in lenses[1:]],
        },
        "warnings": [*lens_warnings(lenses), *doubts_of(model)],
        "world": world,
    }


def doubts_of(model: SparseModel) -> list[dict[str, Any]]:
    """What is to be told of a model that matches contradict."""
    if model.agreement is None or model.agreement >= LITTLE:
        return []
    return [
        {
            "code": "poses_contradicted",
            "message": f"The poses agree with only {model.agreement:.0%} of what neighbouring "
            "pictures show: parts of the scene may be bent or doubled.",
            "hint": "Avoid mirrors and things that look the same from several sides, or film more "
            "of what stands around them.",
            "details": {"agreement": round(model.agreement, 4)},
        }
    ]


def mixed_lens_warnings(outcome: Outcome) -> list[dict[str, Any]]:
    """What is to be told of photos that seem to have several lenses, which were not told apart; or
    that may have, as matches speak against their poses."""
    chosen = outcome.chosen
    agreed = None if chosen.best is None else chosen.best.agreement
    is_low = chosen.lenses == "unsuspected" and agreed is not None and agreed < MUCH
    if chosen.lenses != "doubtful" and not is_low:
        return []
    few = "" if agreed is None else f", and only {agreed:.0%} of what they show agrees with them"
    seem = "seem to be" if chosen.lenses == "doubtful" else "may be"
    return [
        {
            "code": "lenses_unsettled",
            "message": "Nothing in the photos, or in some of them, says through which lens they "
            f"were taken; they {seem} of several, or zoomed, and could not be told apart{few}: "
            "poses may be wrong.",
            "hint": "Send the originals with their EXIF, not copies from a messenger, or take all "
            "photos through one lens without zooming or cropping.",
            "details": {"agreement": None if agreed is None else round(agreed, 4)},
        }
    ]


def path_warnings(outcome: Outcome, source: Source) -> list[dict[str, Any]]:
    """What is to be told of a film whose path is torn all the same, and of one of several sides."""
    chosen = outcome.chosen
    if chosen.is_one_side:
        num = len(source.files)
        return [
            {
                "code": "sides_alike",
                "message": f"The subject looks the same from several sides, and no picture joins "
                f"them: {chosen.num_registered} of {num} pictures are used, those of one side.",
                "hint": "Go from one side to the other slowly, with sharp pictures that overlap, "
                "and put something with a pattern beside the subject, like a newspaper under it.",
                "details": {"pairs_left_out": len(chosen.left_out)},
            }
        ]
    torn = chosen.torn
    if not torn:
        return []
    files = [[source.files[i], source.files[j]] for i, j in torn]
    seconds = [source.timestamps_s[i] for i, _ in torn]
    places = [
        file if second is None else f"{second:.1f} s"
        for (file, _), second in zip(files, seconds, strict=True)
    ]
    return [
        {
            "code": "path_torn",
            "message": f"The camera's path jumps after {', '.join(places)}, though what frames "
            "before and behind show says that it did not: one side of the subject may lie over "
            "another that looks the same.",
            "hint": "Put something with a pattern beside the subject, like a newspaper under it, "
            "and film slowly where its sides meet.",
            "details": {"between": files},
        }
    ]


def report_of_failure(
    outcome: Outcome, source: Source, options: PosesOptions, error: PipelineError
) -> dict[str, Any]:
    """report.json of a stage that ends with an error: what there is, why, and what to do."""
    report = build_report(outcome, source)
    reasons = Counter(entry["code"] for entry in report["unregistered"])
    failure = {key: error.as_dict()[key] for key in ("code", "message", "hint", "details")}
    model = outcome.chosen.best
    return {
        **report,
        "median_triangulation_angle_deg": None if model is None else model.angle_deg,
        "placed": None if model is None else _placed(model, source),
        "num_needed": num_needed(len(source.files), options),
        "error": failure,
        "reasons": dict(reasons),
        "advice": [error.hint, *(_ADVICE[code] for code, _ in reasons.most_common())],
    }


def _placed(model: SparseModel, source: Source) -> dict[str, Any]:
    """The poses of a model that is not good enough, and some of its points, to be looked at.

    files; poses: [N][3][4], OpenGL axes, as the world of `cameras.json` would be; points, colors.
    """
    poses = opengl_from_opencv(model.world_from_camera)
    world = normalise(poses).similarity
    few = slice(None, None, max(1, len(model.points) // _MAX_POINTS_SHOWN))
    return {
        "files": [source.files[index] for index in model.indices],
        "poses": world.apply_to_cameras(poses).round(5).tolist(),
        "points": world.apply_to_points(model.points[few]).round(4).tolist(),
        "colors": model.colors[few].tolist(),
    }


def _noun(source: Source) -> str:
    return "frames" if source.is_video else "images"
