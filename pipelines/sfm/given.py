"""Poses that came with a capture: do they fit the pictures, and can they be made to fit better?

First some pairs are matched, and it is measured by how much matches miss the given poses. Poses
that fit about as well as features are placed are trusted as they are: adjusting them would put in
the features' own errors. Others are refined from matches of all pictures
(`pipelines.sfm.given_refinement`), and the refined ones are taken where matches that were kept out
of it say that they are clearly better, and nothing else speaks against them.

Poses that most matches contradict, and that fit once they are read by another convention, are read
so. Nothing here fails a capture: what goes wrong leaves the given poses, and is told.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from pipelines.errors import Cancelled, PipelineError
from pipelines.scene.cameras_file import Intrinsics
from pipelines.scene.orientation import opengl_from_opencv
from pipelines.sfm.agreement import LITTLE
from pipelines.sfm.given_depth import Beside
from pipelines.sfm.given_fit import Fit, fit_of
from pipelines.sfm.given_lenses import LensTrial, objection, with_lenses
from pipelines.sfm.given_pairs import near_pairs, overlapping_pairs, sampled_pairs
from pipelines.sfm.given_readings import Reading, other_readings
from pipelines.sfm.given_refinement import NothingFits, Refined, located, refine
from pipelines.sfm.given_scale import Scale, scaled, weighed
from pipelines.sfm.pairs import Pairs
from pipelines.sfm.tracks import Floats, Observations, build_tracks
from pipelines.tools.colmap import Reconstructor
from pipelines.tools.colmap_results import VerifiedMatches
from pipelines.tools.colmap_settings import CameraGroup, FeatureSettings

Mode = Literal["auto", "trust", "refine"]
Verdict = Literal["trusted", "refined", "kept", "unverified"]

EXACT_PX = 0.5
"""Median miss up to which poses are trusted: exact ones have 0.2 to 0.35."""
EXACT_WORST_PX = 1.0
"""And that of the pair that nine in ten are better than: pairs from far apart tell of drift."""
GAIN = 0.8
"""Refined poses must miss matches that were held out by so much less, or leave the given ones."""
HELD_SHARE = 0.15
MOST_TURNED_DEG, MOST_MOVED = 10.0, 0.2
"""Median turn, and median move in reaches (see `reach`), beyond which nobody would call it a
refinement."""
MOST_SCALED = 0.02
"""By how much more the scale may leave that of the sensor's depth, as a share."""
MOST_SPREAD = 1.15
"""How many times as much points may deviate from the sensor's depth as they did before."""
FEW_FEATURES, NUM_PROBES = 500, 5
"""Features of the median of so many images below which images are doubled to find more."""
_FINE = 0.7
_DRIFTED, _AHEAD = 0.35, 2.0
"""Agreement from which poses are read by another convention: `_FINE`; or that of poses that drift,
if it is so many times that of any other reading."""
_WRONG = 0.25
"""Agreement up to which poses have nothing to do with the pictures: drift leaves more."""
_BASE_S, _PER_IMAGE_S = 300.0, 5.0
"""Seconds after which refinement gives up: many times what it takes on a machine of two cores."""
_LOCATING_S, _LOCATING_PER_IMAGE_S, _MOST_LOCATING_S = 60.0, 1.0, 1800.0
"""And the search for points under poses that are trusted: depth can do without them."""

UNREFINED = (PipelineError, ArithmeticError, MemoryError, OSError, RuntimeError, ValueError)
"""What may go wrong without harm to the job, which has given poses: the log has it in full."""


class OutOfTime(Exception):
    """The refinement took longer than it may."""


@dataclass(frozen=True)
class Posed:
    """The images of a capture with given poses: N names, lenses, poses [N, 3, 4], OpenCV axes.
    is_metric: whether they are in metres."""

    files: tuple[str, ...]
    lenses: tuple[Intrinsics, ...]
    poses: Floats
    is_metric: bool = False


@dataclass(frozen=True)
class Judged:
    """What came of it.

    sampled: the given poses' fit to a sample of pairs, None where too few match. before, after: of
    given and refined poses, by matches that were held out, where refinement got so far. refined:
    its result, whether it was taken or not. lens_trial: whether lenses were adjusted, too. why: in
    words. reading: in words, how else the file may be read so that its poses fit. written: the fit
    of the poses as they are written, where they were read so. located: points where poses that are
    trusted have them, if they were asked for. seconds: of all.

    Of poses that were read otherwise `poses`, `start` and all points are in the world of the file.
    """

    mode: Mode
    verdict: Verdict
    why: str
    poses: Floats
    start: Floats
    """What was judged, and refined: the given poses as they are read."""
    sampled: Fit | None = None
    before: Fit | None = None
    after: Fit | None = None
    refined: Refined | None = None
    lens_trial: LensTrial | None = None
    depths: tuple[Beside, Beside] | None = None
    scale: Scale | None = None
    reading: str | None = None
    written: Fit | None = None
    located: Refined | None = None
    seconds: float = 0.0

    @property
    def depth_by_given_lens(self) -> bool:
        """Whether the sensor's depth is what the lens shows that came along, not the new one."""
        return self.depths is not None and self.depths[1].shown_by == "given"

    @property
    def is_reread(self) -> bool:
        """Whether the poses were read by another convention than the file's format has."""
        return self.written is not None

    @property
    def is_wrong(self) -> bool:
        """Whether what is handed on has nothing to do with the pictures."""
        return self.fit is not None and self.fit.agreement < _WRONG

    @property
    def fit(self) -> Fit | None:
        """How well the poses that are handed on fit, as far as that was measured."""
        if self.verdict == "refined":
            return self.after
        return self.before or self.sampled


class Judge:
    """Judges and refines the given poses of one capture.

    settings: of features. progress: receives the share that is done and a message; what it raises
    ends all. logger: receives what breaks off. beside: refined or given points beside measured
    depth, see `pipelines.sfm.given_depth`. locate: whether points are wanted also of poses that
    stay as they are.
    """

    def __init__(
        self,
        posed: Posed,
        reconstructor: Reconstructor,
        settings: FeatureSettings,
        progress: Callable[[float, str], None],
        beside: Callable[[Refined], Beside | None],
        *,
        upsample: Literal["auto", "on", "off"],
        num_threads: int,
        seed: int,
        logger: logging.Logger,
        locate: bool = False,
    ) -> None:
        self._posed = posed
        self._reconstructor = reconstructor
        self._settings = settings
        self._progress = progress
        self._beside = beside
        self._upsample = upsample
        self._num_threads = num_threads
        self._seed = seed
        self._logger = logger
        self._locate = locate
        self._looked: set[int] = set()

    def judge(
        self, mode: Mode, sent: Callable[[Floats], Floats], *, may_reread: bool = True
    ) -> Judged:
        """The poses to hand on. sent: undoes what ingest did to the world of poses [N, 3, 4],
        OpenGL axes, to see whether another reading of the file fits. may_reread: whether that
        reading may be taken.

        Raises what `progress` raises.
        """
        began = time.monotonic()
        judged = Judged(mode, "unverified", "", self._posed.poses, self._posed.poses)
        try:
            judged = self._verified(judged, sent, may_reread=may_reread and mode != "trust")
            if self._is_to_refine(judged):
                deadline = began + _BASE_S + _PER_IMAGE_S * len(self._posed.files)
                judged = self._refined(judged, deadline)
            elif self._locate and judged.verdict == "trusted":
                judged = replace(judged, located=self._located())
        except Cancelled:
            raise
        except OutOfTime:
            judged = replace(judged, why="refining them would have taken too long")
        except NothingFits:
            judged = replace(judged, why=f"{judged.why}, and nothing that is seen fits them")
        except UNREFINED as error:
            self._logger.warning("Looking at the given poses broke off.", exc_info=True)
            judged = replace(judged, why=f"looking at them broke off: {_words(error)}")
        return replace(judged, seconds=time.monotonic() - began)

    def _is_to_refine(self, judged: Judged) -> bool:
        if judged.mode == "trust" or judged.sampled is None:
            return False
        if judged.reading is not None and not judged.is_reread:
            return False
        return judged.mode == "refine" or judged.verdict != "trusted"

    def _verified(
        self, judged: Judged, sent: Callable[[Floats], Floats], *, may_reread: bool
    ) -> Judged:
        posed, long_side_px = self._posed, self._settings.max_image_px
        pairs = sampled_pairs(posed.poses)
        self._settle_features()
        self._match(pairs, (0.0, 0.3), "comparing pictures", lambda: None)
        matches = self._reconstructor.verified_of(pairs)
        fit = fit_of(posed.poses, posed.lenses, matches, long_side_px)
        if fit is None:
            return replace(judged, why="too few of the pictures match each other to tell")
        judged = rated(judged, fit)
        if fit.agreement >= LITTLE:
            return judged
        read: list[tuple[Fit, Reading]] = []
        for reading in other_readings(sent(opengl_from_opencv(posed.poses))):
            found = fit_of(reading.poses, posed.lenses, matches, long_side_px)
            if found is not None:
                read.append((found, reading))
        read.sort(key=lambda one: one[0].agreement)
        if not read:
            return judged
        (found, best), others = read[-1], [fit, *(each for each, _ in read[:-1])]
        least = _AHEAD * max(each.agreement for each in others)
        if found.agreement < min(_FINE, max(least, _DRIFTED)):
            return judged
        judged = replace(judged, reading=best.words)
        if not (may_reread and best.is_whole):
            return judged
        self._posed = replace(posed, poses=best.poses)
        return rated(replace(judged, poses=best.poses, start=best.poses, written=fit), found)

    def _settle_features(self) -> None:
        """Double images where a few of them show too little."""
        num = len(self._posed.files)
        if self._upsample == "auto":
            self._progress(0.0, "looking at a few pictures")
            probes = sorted({round(i * (num - 1) / (NUM_PROBES - 1)) for i in range(NUM_PROBES)})
            counts = self._reconstructor.count_features(probes, self._settings)
            few = float(np.median(counts)) < FEW_FEATURES
            self._settings = replace(self._settings, upsample=few)

    def _refined(self, judged: Judged, deadline: float) -> Judged:
        posed, long_side_px = self._posed, self._settings.max_image_px
        assert judged.sampled is not None

        poll = _alarm(deadline)

        def report(share: float, message: str) -> None:
            poll()
            self._progress(0.8 + 0.19 * share, message)

        self._match(overlapping_pairs(posed.poses), (0.3, 0.8), "matching pictures", poll)
        found = self._reconstructor.correspondences()
        seen, held = build_tracks(found, HELD_SHARE, self._seed)
        before = fit_of(posed.poses, posed.lenses, held, long_side_px)
        if before is None:
            return replace(judged, why=f"{judged.why}; too few matches to refine them by")
        shown = (0.0, "adjusting the poses")

        def say(share: float, message: str) -> None:
            nonlocal shown
            shown = share, message
            report(share, message)

        refined = refine(
            posed.poses,
            posed.lenses,
            seen,
            error_px=max(judged.sampled.worst_px, before.worst_px),
            long_side_px=long_side_px,
            run=self._reconstructor.runner(lambda _: report(*shown)),
            num_threads=self._num_threads,
            seed=self._seed,
            report=say,
        )
        after = fit_of(refined.poses, refined.lenses, held, long_side_px)
        judged = self._measured(replace(judged, before=before, after=after, refined=refined))
        shown = 0.8, "adjusting the lens"
        judged = self._with_lenses(judged, seen, held, lambda: report(*shown))
        against = self._objection(judged)
        if against is not None:
            return replace(judged, verdict="kept", why=f"{judged.why}; {against}")
        assert judged.after is not None
        assert judged.refined is not None
        return replace(
            judged,
            verdict="refined",
            poses=judged.refined.poses,
            why=f"matches that were set aside miss the given poses by {before.error_px:.2f} px, "
            f"the refined ones by {judged.after.error_px:.2f}",
        )

    def _located(self) -> Refined | None:
        """What pictures show, where the given poses have it; None where that breaks off."""
        posed = self._posed
        usual = _LOCATING_S + _LOCATING_PER_IMAGE_S * len(posed.files)
        poll = _alarm(time.monotonic() + min(usual, _MOST_LOCATING_S))
        try:
            self._match(near_pairs(posed.poses), (0.3, 0.98), "looking for points", poll)
            seen, _ = build_tracks(self._reconstructor.correspondences(), 0.0, self._seed)
            return located(posed.poses, posed.lenses, seen, self._settings.max_image_px)
        except Cancelled:
            raise
        except (OutOfTime, *UNREFINED):
            self._logger.warning("Looking for points broke off: there are none.", exc_info=True)
            return None

    def _with_lenses(
        self, judged: Judged, seen: Observations, held: VerifiedMatches, poll: Callable[[], None]
    ) -> Judged:
        """With lenses adjusted, too, where that is possible and nothing speaks against it."""
        refined, long_side_px = judged.refined, self._settings.max_image_px
        if judged.sampled is None or judged.before is None or judged.after is None:
            return judged
        assert refined is not None
        try:
            found = with_lenses(
                self._posed.poses,
                refined,
                seen,
                error_px=max(judged.sampled.worst_px, judged.before.worst_px),
                long_side_px=long_side_px,
                run=self._reconstructor.runner(lambda _: poll()),
                num_threads=self._num_threads,
                report=lambda *_: poll(),
            )
        except Cancelled:
            raise
        except (OutOfTime, *UNREFINED):
            self._logger.warning("Adjusting the given lens broke off: it stays.", exc_info=True)
            return judged
        if found is None:
            return judged
        after = fit_of(found.poses, found.lenses, held, long_side_px)
        tried = self._measured(replace(judged, after=after, refined=found))
        was, now = (None if each.depths is None else each.depths[1] for each in (judged, tried))
        against = objection(judged.after, after, (was, now), found)
        trial = LensTrial(self._posed.lenses[0], found.lenses[0], against, after, now)
        return replace(tried if against is None else judged, lens_trial=trial)

    def _measured(self, judged: Judged) -> Judged:
        """Refined poses at the scale that path and sensor say, and points beside the sensor's."""
        refined = judged.refined
        assert refined is not None
        now = self._beside(refined)
        if self._posed.is_metric:
            scale = weighed(self._posed.poses, refined, now)
            middle = self._posed.poses[:, :, 3].mean(axis=0)
            judged = replace(judged, scale=scale, refined=scaled(refined, scale.factor, middle))
            now = now and replace(now, ratio=now.ratio * scale.factor)
        if judged.depths is not None:  # by another lens: the given poses' points are the same
            was: Beside | None = judged.depths[0]
        else:
            was = None if refined.before is None else self._beside(refined.before)
        return replace(judged, depths=None if was is None or now is None else (was, now))

    def _objection(self, judged: Judged) -> str | None:
        """What speaks against the refined poses, or None."""
        before, after, refined = judged.before, judged.after, judged.refined
        assert before is not None
        assert refined is not None
        if after is None or not refined.is_seen.any():
            return "too few pictures hang together to refine them"
        wanted = GAIN if judged.mode == "auto" else 1.0
        if after.error_px > wanted * before.error_px or after.agreement < before.agreement:
            return (
                f"refined ones miss matches that were set aside by {after.error_px:.2f} px, the "
                f"given ones by {before.error_px:.2f}"
            )
        turned, moved = movement(self._posed.poses, refined.poses)
        far = float(np.median(moved)) / reach(self._posed.poses, refined)
        if np.median(turned) > MOST_TURNED_DEG or far > MOST_MOVED:
            return (
                f"refined ones are {np.median(turned):.1f} degrees and {far:.0%} of the scene away"
            )
        if judged.depths is not None:
            was, now = judged.depths
            if abs(np.log(now.ratio)) > abs(np.log(was.ratio)) + MOST_SCALED:
                ratios = f"{now.ratio:.3f} times the measured depth, not {was.ratio:.3f}"
                return f"refined ones are {ratios}"
            if now.spread > MOST_SPREAD * was.spread:
                return (
                    f"refined ones agree less with the measured depth, within {now.spread:.1%} "
                    f"instead of {was.spread:.1%}"
                )
        return None

    def _match(
        self, pairs: Pairs, span: tuple[float, float], message: str, poll: Callable[[], None]
    ) -> None:
        """Features of the images of these pairs, as far as they have none, and their matches."""
        start, end = span
        middle = start + 0.6 * (end - start)
        wanted = sorted({index for pair in pairs for index in pair} - self._looked)

        def watch(first: float, last: float, total: int) -> Callable[[int], None]:
            def report(done: int) -> None:
                poll()
                share = first + (last - first) * min(done, total) / max(total, 1)
                self._progress(share, f"{message}, {min(done, total)} of {total}")

            return report

        if wanted:
            self._reconstructor.extract(
                feature_groups(wanted, self._posed.lenses),
                self._settings,
                watch(start, middle, len(wanted)),
            )
            self._looked |= set(wanted)
        self._reconstructor.match(pairs, watch(middle, end, len(pairs)))


def _alarm(deadline: float) -> Callable[[], None]:
    """What raises OutOfTime from that moment of `time.monotonic` on."""

    def poll() -> None:
        if time.monotonic() > deadline:
            raise OutOfTime

    return poll


def feature_groups(indices: Sequence[int], lenses: Sequence[Intrinsics]) -> list[CameraGroup]:
    """The images in groups that COLMAP may take for one camera's.

    Pairs of plain lenses are verified by a fundamental matrix, whatever the intrinsics, which may
    be wrong; pairs of fisheyes cannot be.
    """
    alike: dict[tuple[str, int, int, float | None], list[int]] = {}
    for index in indices:
        lens = lenses[index]
        wide = lens.model == "OPENCV_FISHEYE"
        key = (
            "OPENCV_FISHEYE" if wide else "SIMPLE_PINHOLE",
            lens.width,
            lens.height,
            lens.fl_x if wide else None,
        )
        alike.setdefault(key, []).append(index)
    return [CameraGroup(tuple(found), key[0], key[3]) for key, found in alike.items()]


def movement(given: Floats, refined: Floats) -> tuple[Floats, Floats]:
    """By how many degrees each pose was turned, and how far it was moved, [N] each."""
    cosines = (np.einsum("nij,nij->n", given[:, :, :3], refined[:, :, :3]) - 1.0) / 2.0
    turned: Floats = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
    moved: Floats = np.linalg.norm(refined[:, :, 3] - given[:, :, 3], axis=1)
    return turned, moved


def reach(given: Floats, refined: Refined) -> float:
    """How large the scene is: the cameras' extent, or how far points are away, the larger one."""
    extent = float(np.linalg.norm(np.ptp(given[:, :, 3], axis=0)))
    points = refined.points[refined.track_lengths >= 2]
    if not len(points):
        return max(extent, 1e-12)
    middle = np.median(refined.poses[:, :, 3], axis=0)
    return max(extent, float(np.median(np.linalg.norm(points - middle, axis=1))), 1e-12)


def rated(judged: Judged, fit: Fit) -> Judged:
    """With poses that fit the sample so: trusted, or kept until they are refined."""
    why = f"matches miss them by {fit.error_px:.2f} px"
    if fit.error_px <= EXACT_PX and fit.worst_px <= EXACT_WORST_PX and fit.agreement >= _FINE:
        why = f"{why}, as those of exact poses do"
        return replace(judged, verdict="trusted", why=why, sampled=fit)
    return replace(judged, verdict="kept", why=why, sampled=fit)


def _words(error: BaseException) -> str:
    text = error.message if isinstance(error, PipelineError) else str(error)
    return (text or type(error).__name__).splitlines()[0][:200]
