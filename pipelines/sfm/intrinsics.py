"""Which lens model a capture gets, by evidence; and how well its focal length is known.

Mapping starts with square pixels and one radial term (SIMPLE_RADIAL). A richer lens always fits the
observations that it was fitted to better, also where it bends focal length and distortion into each
other; so lenses are judged by observations that were set aside (`pipelines.tools.colmap_lenses`).
A richer one is taken where it lowers their mean squared error

- by more than `MIN_SIGMAS` standard errors. Errors within an image belong together, so images
  count, not observations; and
- by more than `MIN_GAIN`, or by more than `BENT_GAIN` where a focal length moves by more than
  `MAX_MOVE`. Rolling shutter and moving things are soaked up by additional terms, too, and where a
  capture says little of the focal length those bend it (docs/poses.md): that takes more evidence.

One that bends by a term beyond `MOST_BENT`, and takes the focal length along, is no lens, whatever
it fits.

The simplest model within the noise of the best is the rule of Breiman, Friedman, Olshen and Stone,
"Classification and Regression Trees", 1984, 3.4.3, with the standard error of the paired
difference.

A focal length is weak where it can be changed much, all else adjusted, before the held-out error
rises by that same `BENT_GAIN`; or where lenses that do equally well disagree on it. Then EXIF's is
held, where there is one that the pictures do not contradict: lenses' makers know it within a few
percent.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from pipelines.scene.cameras_file import Intrinsics
from pipelines.scene.panoramas import MODEL as PANORAMA
from pipelines.tools.colmap_lenses import Fit, LensTrials
from pipelines.tools.colmap_results import SparseModel

Floats = npt.NDArray[np.float64]

AUTO = "auto"
FISHEYE = "OPENCV_FISHEYE"
LENSES = ("SIMPLE_RADIAL", "RADIAL", "OPENCV")
"""Tried in this order; each must earn its place over the best before it. Mapping starts with the
first, or with none of them where it held the distortion. OPENCV is the first with two focal
lengths. A fisheye is another kind of lens, and known before mapping."""
MIN_GAIN = 0.005
BENT_GAIN = 0.02
MAX_MOVE = 0.01
MIN_SIGMAS = 2.0
MIN_VIEWS = 5
"""Images of a camera below which it keeps the simplest lens."""
MIN_HELD_OUT = 60
"""Held-out observations of a camera below which nothing is said of it."""
WEAK_PERCENT = 10.0
"""Uncertainty of the focal length from which it is called weak: well filmed captures have 1 to 2,
one whose rays differ by 6 degrees 4 to 5 (docs/poses-experiments.md)."""

MOST_BENT = 1.0
"""Term of a distortion from which COLMAP takes images out of a model."""

_CAP = 5.0
"""Errors count up to so many medians: a wrong match says nothing of the lens."""
_STEP = 0.05
"""By which the focal length is changed to see what that does."""
_MAX_SPREAD = 1.0
MOST_RISE = 0.06
"""By which the held-out error may rise where a weak focal length gives way to EXIF's."""


@dataclass(frozen=True)
class Gain:
    """What one fit has over another. share: of the mean squared held-out error, positive where it
    is lower. sigmas: how many standard errors that is from nothing."""

    share: float
    sigmas: float

    def exceeds(self, share: float) -> bool:
        """Whether it is more than this share, and more than noise."""
        return self.share > share and self.sigmas > MIN_SIGMAS


@dataclass(frozen=True)
class Candidate:
    """A lens that was tried. held_out_px: root mean square. gain: over the simplest one."""

    lens: str
    focal_px: float
    held_out_px: float
    gain: Gain


@dataclass(frozen=True)
class LensVerdict:
    """What was chosen for one camera, and why.

    focal_px: of the model that is kept. focal_spread: how far the focal length is open, as a share
    of it to either side; None where too little is known to say. is_exif: whether it was weak, and
    is EXIF's now.
    """

    num_images: int
    lens: str
    why: str
    focal_px: float
    focal_spread: float | None
    candidates: tuple[Candidate, ...]
    is_exif: bool = False

    @property
    def is_weak(self) -> bool:
        """Whether the focal length is not determined well."""
        return self.focal_spread is not None and 100.0 * self.focal_spread > WEAK_PERCENT

    def as_dict(self) -> dict[str, Any]:
        """As report.json has it."""
        spread = None if self.focal_spread is None else round(100.0 * self.focal_spread, 2)
        return {
            "num_images": self.num_images,
            "model": self.lens,
            "why": self.why,
            "focal_px": round(self.focal_px, 2),
            "focal_spread_percent": spread,
            "focal_from": "exif" if self.is_exif else "pictures",
            "candidates": [
                {
                    "model": candidate.lens,
                    "focal_px": round(candidate.focal_px, 2),
                    "held_out_px": round(candidate.held_out_px, 4),
                    "gain_percent": round(100.0 * candidate.gain.share, 2),
                    "gain_sigmas": round(candidate.gain.sigmas, 1),
                }
                for candidate in self.candidates
            ],
        }


def mapping_lens(wanted: str) -> str:
    """The lens that mapping starts with, for `poses.camera_model`."""
    return LENSES[0] if wanted == AUTO else wanted


def unsettled(model: SparseModel) -> tuple[LensVerdict, ...]:
    """What is said of the lenses of a model with panoramas, which are left as they were mapped."""
    counts = [model.camera_of.count(camera) for camera in range(len(model.cameras))]
    return tuple(
        LensVerdict(
            num_images=counts[camera],
            lens=model.cameras[camera].model,
            why="a panorama has no lens to fit"
            if model.cameras[camera].model == PANORAMA
            else "left as it was mapped, beside panoramas",
            focal_px=(model.cameras[camera].fl_x + model.cameras[camera].fl_y) / 2,
            focal_spread=None,
            candidates=(),
        )
        for camera in sorted(range(len(counts)), key=lambda camera: -counts[camera])
    )


def settle_lenses(
    model: SparseModel,
    trials: LensTrials,
    wanted: str,
    priors_px: Mapping[int, float] | None = None,
) -> tuple[SparseModel, tuple[LensVerdict, ...]]:
    """The model with the lenses that the evidence is for, and what is known of each camera.

    wanted: `poses.camera_model`; other than auto, the lens stays as it was mapped and only its
    focal length is looked at. priors_px: what EXIF says of the focal lengths of cameras, by their
    place in the model. The intrinsics are those of the camera with most images first.
    """
    fits = [trials.fit(trials.cameras)]
    if wanted == AUTO:
        for lens in LENSES:
            changed = {
                i: lens
                for i, views in trials.num_views.items()
                if views >= MIN_VIEWS and trials.cameras[i] not in (FISHEYE, lens)
            }
            if changed:
                fits.append(trials.fit(trials.cameras | changed))
    best = _best_fit(fits, trials)
    lenses = best.lenses
    if lenses != trials.cameras:
        model = replace(trials.adopt(lenses), agreement=model.agreement)
    moved = [
        trials.fit(
            lenses,
            start=best,
            focals_px={camera: focal * (1.0 + step) for camera, focal in best.focal_px.items()},
        )
        for step in (-_STEP, _STEP)
    ]
    ids = sorted(trials.cameras)
    written = dict(zip(ids, model.cameras, strict=True))
    found = {
        camera: _verdict_of(camera, written[camera], fits, best, moved, trials, wanted)
        for camera in sorted(ids, key=lambda i: -trials.num_views[i])
    }
    priors = {ids[place]: focal for place, focal in (priors_px or {}).items()}
    weak = {i: priors[i] for i, verdict in found.items() if verdict.is_weak and i in priors}
    held = _held_by_exif(best, trials, weak)
    if held:
        model = replace(trials.adopt(lenses, {**best.focal_px, **held}), agreement=model.agreement)
        for camera, focal in held.items():
            found[camera] = replace(found[camera], focal_px=focal, is_exif=True)
    return model, tuple(found.values())


def _held_by_exif(best: Fit, trials: LensTrials, priors: Mapping[int, float]) -> dict[int, float]:
    """Those of EXIF's focal lengths, by camera id, that the held-out observations can live with."""
    if not priors:
        return {}
    tried = trials.fit(best.lenses, start=best, focals_px={**best.focal_px, **priors})
    return {
        camera: focal
        for camera, focal in priors.items()
        if _gain(best, tried, trials, camera).share >= -MOST_RISE
    }


def _best_fit(fits: Sequence[Fit], trials: LensTrials) -> Fit:
    """A fit in which each camera has the lens that it earned.

    Cameras see the same points, so one that gets the right lens lowers the errors of all. Where
    there are several, each must show a gain with the others' lenses as chosen, too.
    """
    lenses = {camera: _chosen_fit(fits, trials, camera).lenses[camera] for camera in trials.cameras}
    best = next((fit for fit in fits if fit.lenses == lenses), None) or trials.fit(lenses)
    earned = dict(lenses)
    for camera, simplest in trials.cameras.items():
        if len(lenses) > 1 and lenses[camera] != simplest:
            without = trials.fit({**lenses, camera: simplest})
            if not _earns(without, best, trials, camera):
                earned[camera] = simplest
    return best if earned == lenses else trials.fit(earned)


def _chosen_fit(fits: Sequence[Fit], trials: LensTrials, camera: int) -> Fit:
    """The simplest fit that no richer one has more over than noise, for one camera."""
    here = trials.camera_of == camera
    best = fits[0]
    for fit in fits[1:]:
        if here.sum() >= MIN_HELD_OUT and _earns(best, fit, trials, camera):
            best = fit
    return best


def _earns(before: Fit, after: Fit, trials: LensTrials, camera: int) -> bool:
    """Whether the evidence is for `after`, the richer one."""
    was = before.focal_px[camera]
    moved = max(abs(focal / was - 1.0) for focal in after.focal_xy_px[camera])
    if moved > MAX_MOVE and after.most_bent[camera] > MOST_BENT:
        return False
    wanted = MIN_GAIN if moved <= MAX_MOVE else BENT_GAIN
    return _gain(before, after, trials, camera).exceeds(wanted)


def _gain(before: Fit, after: Fit, trials: LensTrials, camera: int) -> Gain:
    here = trials.camera_of == camera
    return gain(before.errors_px[here], after.errors_px[here], trials.image_of[here])


def gain(before: Floats, after: Floats, image_of: npt.NDArray[np.int64]) -> Gain:
    """What `after` has over `before`: paired errors [H] in pixels, of observations in `image_of`.

    The standard error takes images as units: sqrt(sum_i n_i^2 (d_i - d)^2) / sum_i n_i, where d_i
    is the mean difference in image i, n_i its observations, d the mean of all.
    """
    first, second = _squares(before, before), _squares(after, before)
    if len(first) == 0:
        return Gain(0.0, 0.0)
    difference = first - second
    mean = float(difference.mean())
    _, groups = np.unique(image_of, return_inverse=True)
    sums = np.bincount(groups, weights=difference - mean)
    error = math.sqrt(float((sums**2).sum())) / len(difference)
    sigmas = mean / error if error > 0 else math.copysign(math.inf, mean) if mean else 0.0
    return Gain(mean / max(float(first.mean()), 1e-12), sigmas)


def _squares(errors: Floats, reference: Floats) -> Floats:
    """Squared errors, up to the cap that the reference sets."""
    finite = reference[np.isfinite(reference)]
    cap = _CAP * float(np.median(finite)) if len(finite) else 1.0
    squares: Floats = np.minimum(errors, max(cap, 1e-6)) ** 2
    return squares


def focal_spread(still: Floats, moved: Sequence[Floats], image_of: npt.NDArray[np.int64]) -> float:
    """How far the focal length can be changed before the held-out error rises by BENT_GAIN.

    still: held-out errors [H] at the best focal length. moved: at ones that are smaller and larger
    by _STEP. The rise is taken as a parabola. Returns a share of the focal length, at most 1.
    """
    rises = [-gain(still, errors, image_of).share for errors in moved]
    rise = sum(rises) / len(rises)
    return min(_STEP * math.sqrt(BENT_GAIN / rise), _MAX_SPREAD) if rise > 0 else _MAX_SPREAD


def _verdict_of(
    camera: int,
    written: Intrinsics,
    fits: Sequence[Fit],
    best: Fit,
    moved: Sequence[Fit],
    trials: LensTrials,
    wanted: str,
) -> LensVerdict:
    here = trials.camera_of == camera
    candidates, seen = [], set()
    for fit in fits:
        if fit.lenses[camera] not in seen:
            seen.add(fit.lenses[camera])
            candidates.append(
                Candidate(
                    fit.lenses[camera],
                    fit.focal_px[camera],
                    math.sqrt(float(_squares(fit.errors_px[here], fits[0].errors_px[here]).mean()))
                    if here.any()
                    else 0.0,
                    _gain(fits[0], fit, trials, camera),
                )
            )
    focal, spread = best.focal_px[camera], None
    if here.sum() >= MIN_HELD_OUT:
        image_of = trials.image_of[here]
        spread = focal_spread(
            best.errors_px[here], [fit.errors_px[here] for fit in moved], image_of
        )
        rivals = [
            fit.focal_px[camera]
            for fit in fits
            if not _gain(fit, best, trials, camera).exceeds(BENT_GAIN)
        ]
        spread = max([spread, *(abs(rival - focal) / focal for rival in rivals)])
        spread = min(spread, _MAX_SPREAD)
    return LensVerdict(
        num_images=trials.num_views[camera],
        lens=best.lenses[camera],
        why=_why(wanted, candidates, best.lenses[camera], int(here.sum())),
        focal_px=(written.fl_x + written.fl_y) / 2,
        focal_spread=spread,
        candidates=tuple(candidates),
    )


def _why(wanted: str, candidates: Sequence[Candidate], lens: str, num_held_out: int) -> str:
    """Why this lens, in words."""
    if wanted != AUTO:
        return "asked for"
    if lens == FISHEYE:
        return "matches fit a fisheye, and no plain lens"
    if num_held_out < MIN_HELD_OUT:
        return "too few points are seen by four images to compare lenses"
    if len(candidates) == 1:
        return f"fewer than {MIN_VIEWS} images: more terms would fit noise"
    if lens == candidates[0].lens:
        return "nothing richer lowers the held-out error enough"
    taken = next(candidate for candidate in candidates if candidate.lens == lens)
    return (
        f"it lowers the held-out error by {taken.gain.share:.1%} "
        f"({taken.gain.sigmas:.1f} standard errors)"
    )


def lens_warnings(lenses: Sequence[LensVerdict]) -> list[dict[str, Any]]:
    """What a person should know of these lenses: {code, message, hint, details}."""
    return [
        {
            "code": "focal_length_weak",
            "message": f"The focal length of {found.num_images} images is known to within "
            f"{100.0 * (found.focal_spread or 0.0):.0f} % only ({found.focal_px:.0f} px, "
            f"{found.lens}): shapes may be stretched in depth.",
            "hint": "Walk further around the subject, and come nearer and go further away while "
            "filming.",
            "details": {
                "focal_px": round(found.focal_px, 2),
                "focal_spread_percent": round(100.0 * (found.focal_spread or 0.0), 2),
            },
        }
        for found in lenses
        if found.is_weak and not found.is_exif
    ]
