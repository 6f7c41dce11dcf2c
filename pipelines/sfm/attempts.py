"""Climbing the ladder of attempts at a reconstruction.

`pipelines.sfm.rungs` says which attempts there are: first the quick way (docs/poses-experiments.md
has what was measured), then more thorough ones where too few images register. The attempt with most
images wins.
"""

from __future__ import annotations

import itertools
import os
import statistics
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from pipelines.options import PosesOptions
from pipelines.scene.panoramas import MODEL as PANORAMA
from pipelines.sfm.agreement import (
    MOST_MATCHES,
    MOST_PAIRS,
    agreement_of_model,
    contradicted_images,
)
from pipelines.sfm.checkpoint import Checkpoint
from pipelines.sfm.held_lens import held_where_it_ran_away
from pipelines.sfm.intrinsics import AUTO, FISHEYE, mapping_lens
from pipelines.sfm.key_frames import (
    clips_of_keys,
    first_keys,
    following,
    is_worth_it,
    key_pairs,
    missing_keys,
    placing_pairs,
)
from pipelines.sfm.lens_groups import Lenses, Settled, own_lenses, told_apart
from pipelines.sfm.mending import Mapping, Sides, mended
from pipelines.sfm.pairs import Pairs, choose_matcher, pairs_through_others, planned_pairs
from pipelines.sfm.progress import ProgressScale, Span
from pipelines.sfm.report import Attempt, Outcome, check_features
from pipelines.sfm.retrieval import (
    FEATURES_PER_IMAGE,
    Floats,
    image_vectors,
    pairs_across,
    retrieval_pairs,
)
from pipelines.sfm.rungs import (
    FEW_ENOUGH_FOR_ALL,
    MAX_ALL_PAIRS,
    RUNGS,
    Matches,
    Rung,
    Standing,
)
from pipelines.sfm.source import Source, camera_groups, unknown_lenses
from pipelines.sfm.turning import focal_of_turning, is_turning
from pipelines.sfm.wide_lenses import probing_pairs, recognised
from pipelines.sfm.zooms import lens_changes
from pipelines.stage import StageContext
from pipelines.tools.colmap import Reconstructor
from pipelines.tools.colmap_lenses import LensTrials
from pipelines.tools.colmap_placing import num_tidying_steps
from pipelines.tools.colmap_results import (
    PairStatistics,
    SparseModel,
    VerifiedMatches,
    best_model,
    without_images,
)
from pipelines.tools.colmap_settings import FeatureSettings, MapperSettings, extraction_threads

NUM_PROBES = 5
"""Images, spread over the capture, whose features are counted before the rest."""
ENOUGH_FEATURES = 500
"""Median of the probes from which images are not doubled before features are found."""

PANORAMA_FACTOR = 2
"""Panoramas are looked at so many times as large as other images, for so many more features."""


_FIRST, _LAST = 0.9, 0.97
"""Where in the stage's progress the first rung ends, and the last."""
_FOUND, _MATCHED = 0.28, 0.56
"""Where in a rung's part of it the features are found, and the pairs matched."""
_CHOSEN, _MAPPED, _TIDIED, _PLACED = 0.05, 0.4, 0.8, 0.96
"""Where between those two key frames are chosen, where in the rest they are mapped, where between
that and the fourth all images are placed, and where in the rest the model is complete."""

_LED_TO = 0.35
"""What pairs that others lead to take of the matching's part."""

TRANSITIVE = "transitive"
"""The matcher that has pairs lead to others."""
KEY_FRAMES = "key frames"
"""The matcher of a film that is mapped by some of its frames."""
_ENOUGH_KEYS = 0.5
"""Share of the key frames that a model must hold for the other frames to be placed on it."""


class Ladder:
    """The attempts on one capture. `climb` runs them; `outcome` is what came of them so far."""

    def __init__(
        self,
        reconstructor: Reconstructor,
        checkpoint: Checkpoint,
        source: Source,
        options: PosesOptions,
        ctx: StageContext,
        rungs: Sequence[Rung] = RUNGS,
    ) -> None:
        self._rungs = rungs
        self._reconstructor = reconstructor
        self._checkpoint = checkpoint
        self._source = source
        self._options = options
        self._ctx = ctx
        self._progress = ProgressScale(ctx)
        self._attempts: list[Attempt] = []
        self._statistics = PairStatistics.nothing(len(source.files))
        self._sides: Sides = ()
        self._lenses: Lenses = ()

    @property
    def outcome(self) -> Outcome:
        """All attempts so far, and what the last matching found."""
        return Outcome(tuple(self._attempts), self._statistics)

    def climb(self) -> Outcome:
        """Run attempts until enough images are registered, or none is left; none at all where the
        camera only turned, since no model of it means anything.

        Raises PosesError (no_features) before matching where images hold nothing to match.
        """
        rungs = [rung for rung in self._rungs if rung.when(self._standing())]
        for rung, (start, end) in zip(rungs, _spans(len(rungs)), strict=True):
            if not rung.when(self._standing()):
                continue
            self._reconstructor = self._reconstructor.on(
                self._checkpoint.database(rung.matches.database)
            )
            self._progress.aim(start, end)
            found, matched = (start + share * (end - start) for share in (_FOUND, _MATCHED))
            matcher = self._matcher(rung.matches)
            self._extract(rung.matches, (start, found))
            self._statistics = self._reconstructor.statistics()
            if not self._attempts:
                check_features(self._statistics, self._options)
            self._recognise_fisheyes(rung.matches, matcher)
            keys: list[int] = []
            if rung.matches.key_frames:
                chosen = found + _CHOSEN * (matched - found)
                keys, found = self._key_frames((found, chosen)), chosen
                if not keys:
                    continue
            self._match(rung.matches, matcher, keys, (found, matched))
            self._statistics = self._reconstructor.statistics()
            if not self._attempts and is_turning(self._statistics):
                break
            self._start_focals()
            self._part_lenses(rung.matches)
            self._map(rung, matcher, keys, (matched, end))
        return self.outcome

    def _standing(self) -> Standing:
        best, options = self.outcome.chosen, self._options
        num = len(self._source.files)
        is_few = not self._source.is_video and num <= options.few_photos
        return Standing(
            num,
            best.num_registered,
            1.0 if is_few else options.retry_below_ratio,
            is_contradicted=best.is_contradicted,
            is_film=self._source.is_video and options.matcher in ("auto", "sequential"),
        )

    def _matcher(self, wanted: Matches) -> str:
        """How this rung's pairs are chosen: key frames, sequential, exhaustive, retrieval or
        transitive."""
        num = len(self._source.files)
        if wanted.key_frames:
            return KEY_FRAMES
        if wanted.reach == "led" and num > FEW_ENOUGH_FOR_ALL:
            return TRANSITIVE
        if wanted.reach != "planned" and num <= MAX_ALL_PAIRS:
            return "exhaustive"
        return choose_matcher(num, self._options.matcher, is_video=self._source.is_video)

    def _settings(self, *, upsample: bool) -> FeatureSettings:
        options = self._options
        # A panorama shows a third of itself where another picture shows all.
        more = PANORAMA_FACTOR if self._source.has_panoramas else 1
        wanted = FeatureSettings(
            more * options.max_image_px, more * options.num_features, upsample, options.num_threads
        )
        memory_mb = int(options.memory_mb * self._ctx.memory_share)
        threads = extraction_threads(wanted, memory_mb, num_processors())
        return replace(wanted, num_threads=threads)

    def _must_upsample(self) -> bool:
        """Whether images must be doubled to show enough features, from a few of them."""
        if self._options.upsample != "auto":
            return self._options.upsample == "on"
        num = len(self._source.files)
        probes = sorted({round(i * (num - 1) / (NUM_PROBES - 1)) for i in range(NUM_PROBES)})
        self._ctx.progress(0.0, "looking at a few images")
        counts = self._reconstructor.count_features(probes, self._settings(upsample=False))
        self._ctx.logger.info("features of images %s without doubling: %s", probes, counts)
        return statistics.median(counts) < ENOUGH_FEATURES

    def _extract(self, wanted: Matches, span: Span) -> None:
        step = f"{wanted.database} features"
        if self._checkpoint.has(step):
            self._ctx.logger.info("%s are in the checkpoint", step)
            return
        self._reconstructor.extract(
            camera_groups(self._source, mapping_lens(self._options.camera_model)),
            self._settings(upsample=wanted.doubled or self._must_upsample()),
            self._progress.watch(span, len(self._source.files), "features of image"),
        )
        self._checkpoint.save(step)

    def _pairs(self, matcher: str) -> Pairs:
        num, options = len(self._source.files), self._options
        if matcher == "retrieval":
            return retrieval_pairs(self._vectors(), options.retrieval_neighbours)
        clips = self._source.stretches
        if matcher == TRANSITIVE:
            planned = choose_matcher(num, options.matcher, is_video=self._source.is_video)
            alike = retrieval_pairs(self._vectors(), options.retrieval_neighbours)
            return sorted({*alike, *([] if planned == "retrieval" else self._pairs(planned))})
        pairs = planned_pairs(num, matcher, options.sequential_overlap, clips)
        if matcher == "sequential" and len(clips) > 1:
            # Nothing but looks tells where two clips show the same.
            found = pairs_across(self._vectors(), clips, options.retrieval_neighbours)
            pairs = sorted({*pairs, *found})
        return pairs

    def _key_frames(self, span: Span) -> list[int]:
        """The frames of a long film that are mapped; none where that would be most of them."""
        num, clips = len(self._source.files), self._source.stretches
        keys = first_keys(clips)
        while is_worth_it(keys, num):
            followers = following(keys, clips)
            watch = self._progress.watch(span, len(followers), "choosing key frames by pair")
            self._reconstructor.match(followers, watch)
            missing = missing_keys(followers, self._reconstructor.statistics())
            if not missing:
                self._ctx.logger.info("%d of %d frames are key frames", len(keys), num)
                return keys
            keys = sorted({*keys, *missing})
        self._ctx.logger.info("neighbouring frames differ too much to map a part of them")
        return []

    def _pairs_by_keys(self, keys: list[int]) -> Pairs:
        options, clips = self._options, self._source.stretches
        pairs = {*key_pairs(keys, clips, options.sequential_overlap), *placing_pairs(keys, clips)}
        if len(clips) > 1:
            alike = pairs_across(
                self._vectors()[keys], clips_of_keys(keys, clips), options.retrieval_neighbours
            )
            pairs |= {(keys[i], keys[j]) for i, j in alike}
        return sorted(pairs)

    def _vectors(self) -> Floats:
        """What each image looks like."""
        return image_vectors(self._reconstructor.features(FEATURES_PER_IMAGE), self._ctx.seed)

    def _recognise_fisheyes(self, wanted: Matches, matcher: str) -> None:
        """Give the fisheyes among the cameras their lens, and a focal length to start from.

        A film without any, which is quickly told, saves nothing for it.
        """
        asked_for = self._options.camera_model == FISHEYE
        step = f"{wanted.database} lenses"
        of_film = self._source.is_video and self._options.camera_model == AUTO
        is_known = any(map(self._checkpoint.has, (step, f"{wanted.database} {matcher}")))
        if not (asked_for or of_film) or is_known:
            return
        num_found = 0
        for group in camera_groups(self._source, mapping_lens(self._options.camera_model)):
            pairs = probing_pairs(group.indices)
            if group.lens == PANORAMA or group.focal_px is not None or not pairs:
                continue
            self._ctx.progress(self._progress.fraction, "looking at the lens")
            self._reconstructor.match(
                pairs, lambda _: self._ctx.check_cancelled(), thorough=wanted.thorough
            )
            found = recognised(self._reconstructor.matched(pairs), asked_for=asked_for)
            if found is not None:
                num_found += 1
                self._ctx.logger.info(
                    "images %d to %d: a fisheye of about %.0f degrees, which %d matches fit (a "
                    "plain lens: %d)",
                    group.indices[0],
                    group.indices[-1],
                    found.angle_deg,
                    found.num_fitting,
                    found.num_plain,
                )
                self._reconstructor.set_lens(group.indices, FISHEYE, found.focal_px)
        if num_found:
            self._checkpoint.save(step)

    def _match(self, wanted: Matches, matcher: str, keys: list[int], span: Span) -> None:
        step = f"{wanted.database} {matcher}"
        if self._checkpoint.has(step):
            self._ctx.logger.info("%s matches are in the checkpoint", step)
            return
        pairs = self._pairs_by_keys(keys) if keys else self._pairs(matcher)
        is_led = matcher == TRANSITIVE
        start, end = span
        planned = end - (_LED_TO * (end - start) if is_led else 0.0)
        watch = self._progress.watch((start, planned), len(pairs), "matching pair")
        self._reconstructor.match(pairs, watch, thorough=wanted.thorough)
        if is_led:
            further = pairs_through_others(self._reconstructor.statistics().verified, pairs)
            self._ctx.logger.info("%d pairs lead to %d more", len(pairs), len(further))
            watch = self._progress.watch((planned, end), len(further), "matching further pair")
            self._reconstructor.match(further, watch, thorough=wanted.thorough)
        self._checkpoint.save(step)

    def _part_lenses(self, wanted: Matches) -> None:
        """Give the frames of a film another camera from where their lens changes."""
        step = f"{wanted.database} zooms"
        if not self._source.is_video or self._source.has_panoramas or self._checkpoint.has(step):
            return
        clips = self._source.stretches
        pairs = [pair for clip in clips for pair in itertools.pairwise(clip)]
        changes = lens_changes(self._reconstructor.verified_of(pairs), clips)
        for images, scale in changes:
            self._reconstructor.give_own_camera(images, scale)
            self._ctx.logger.info(
                "%s and %d more: a lens %.2f times as long",
                self._source.files[images[0]],
                len(images) - 1,
                scale,
            )
        if changes:
            self._checkpoint.save(step)

    def _start_focals(self) -> None:
        """Give mapping a focal length to start from, where matches tell one and nothing else does.

        From COLMAP's own start, 1.2 long sides, a room that is filmed from its middle falls to
        pieces: each turn is taken for a smaller one.
        """
        found = focal_of_turning(self._statistics)
        if found is None:
            return
        all_images = range(len(self._source.files))
        num_cameras = self._reconstructor.start_focal(all_images, found)
        self._ctx.logger.info(
            "homographies of %d pairs: a focal length of %.2f long sides, for %d cameras",
            len(self._statistics.homographies),
            found,
            num_cameras,
        )

    def _map(self, rung: Rung, matcher: str, keys: list[int], span: Span) -> None:
        began = time.monotonic()
        num = len(self._source.files)
        settings = replace(rung.mapper, refine_principal_point=self._options.refine_principal_point)
        placed = span[0] + _PLACED * (span[1] - span[0])
        mapped = span[0] + _MAPPED * (span[1] - span[0]) if keys else placed
        counted = (len(keys), "placing key frame") if keys else (num, "placing image")
        watch = self._progress.watch((span[0], mapped), *counted)

        def mapped_by(lenses: Lenses, settings: MapperSettings = settings) -> Mapping:
            return mended(
                self._reconstructor.with_cameras(lenses) if lenses else self._reconstructor,
                lambda reconstructor: reconstructor.map(settings, watch, keys),
                self._clips(keys),
                is_film=self._source.is_video,
                logger=self._ctx.logger,
                sides=self._sides,
            )

        mapping = mapped_by(self._lenses)
        if self._is_lens_ours:
            mapping, settings = held_where_it_ran_away(
                mapping,
                settings,
                partial(mapped_by, self._lenses),
                lambda: self._reconstructor.verified(MOST_PAIRS, MOST_MATCHES),
                self._ctx.logger,
            )
            mapped_by = partial(mapped_by, settings=settings)
        settled: Settled = "known"
        alike = unknown_lenses(self._source, self._options.camera_model)
        if alike:
            mapping, self._lenses, settled = told_apart(
                mapping,
                mapped_by,
                alike,
                self._reconstructor.verified(MOST_PAIRS, MOST_MATCHES),
                lambda made, model: own_lenses(self._trials(made, model), alike),
                self._statistics.best_inliers.tolist(),
                self._ctx.logger,
                self._lenses,
            )
        self._sides = mapping.sides or self._sides
        models = mapping.models
        most = best_model(models)
        if keys and most is not None and len(most.indices) >= _ENOUGH_KEYS * len(keys):
            all_placed = mapped + _TIDIED * (placed - mapped)
            placing = self._progress.watch((mapped, all_placed), num, "placing image")
            steps = num_tidying_steps(num)
            tidied = self._progress.watch((all_placed, placed), steps, "tidying the model, step")
            models = [
                mapping.reconstructor.place(model, settings, placing, tidied)
                if model is most
                else model
                for model in models
            ]
        compared = self._progress.watch((placed, span[1]), 3, "comparing poses with matches, part")
        compared(1)
        seen = self._reconstructor.verified(MOST_PAIRS, MOST_MATCHES)
        compared(2)
        seen = {pair: places for pair, places in seen.items() if pair not in mapping.left_out}
        models = [self._believed(model, seen) for model in models]
        models = [replace(model, agreement=agreement_of_model(model, seen)) for model in models]
        compared(3)
        attempt = Attempt(
            rung,
            matcher,
            tuple(models),
            time.monotonic() - began,
            mapping.torn,
            mapping.left_out,
            is_one_side=bool(mapping.sides),
            lenses=settled,
        )
        self._attempts.append(attempt)
        self._ctx.logger.info(
            "%s attempt, %s matching: %d of %d images registered, models of %s that agree with %s "
            "of the matches",
            rung.name,
            matcher,
            attempt.num_registered,
            num,
            [len(model.indices) for model in models],
            [None if model.agreement is None else round(model.agreement, 3) for model in models],
        )

    @property
    def _is_lens_ours(self) -> bool:
        """Whether the lens is ours to choose, and one that bends."""
        return self._options.camera_model == AUTO and not self._source.has_panoramas

    def _trials(self, mapping: Mapping, model: SparseModel) -> LensTrials:
        return mapping.reconstructor.lens_trials(
            model,
            lambda _: self._ctx.check_cancelled(),
            refine_principal_point=False,
            every_image=True,
        )

    def _clips(self, keys: list[int]) -> Sequence[Sequence[int]]:
        """The images that are mapped, in order of time, by clip."""
        clips = self._source.stretches
        if not keys:
            return clips
        return [keys[own.start : own.stop] for own in clips_of_keys(keys, clips)]

    def _believed(self, model: SparseModel, seen: VerifiedMatches) -> SparseModel:
        """A model without the images that stand where their own matches say that they do not."""
        wrong = contradicted_images(model, seen)
        if not wrong:
            return model
        self._ctx.logger.info(
            "left out as their matches contradict their poses: %s",
            ", ".join(self._source.files[index] for index in wrong),
        )
        return without_images(model, wrong)


def _spans(num: int) -> list[Span]:
    """Each rung's part of the stage's progress: most for the first, mostly the only one."""
    edges = [_FIRST + (_LAST - _FIRST) * i / max(num - 1, 1) for i in range(num)]
    return list(zip([0.0, *edges], edges, strict=False))


def num_processors() -> int:
    """Processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
