"""The ladder of attempts at a reconstruction, with its progress and its checkpoint.

First the quick way (docs/poses.md has what was measured): features as coarse as the capture
allows, the planned pairs, few trials, few adjustments. Where too few images register, COLMAP's own
thorough way with all pairs, in a database of its own; then relaxed thresholds. The attempt with
most images wins. The two databases, with features and matches, are the checkpoint.
"""

from __future__ import annotations

import hashlib
import json
import os
import statistics
import time
from dataclasses import dataclass, field, replace

from pipelines.options import PosesOptions
from pipelines.sfm.pairs import Pairs, choose_matcher, planned_pairs
from pipelines.sfm.report import Attempt, Outcome, check_features
from pipelines.sfm.retrieval import FEATURES_PER_IMAGE, image_vectors, retrieval_pairs
from pipelines.sfm.source import Source, camera_groups
from pipelines.sfm.turning import is_turning
from pipelines.stage import StageContext
from pipelines.tools.colmap import (
    FeatureSettings,
    MapperSettings,
    Reconstructor,
    Watch,
    extraction_threads,
)

MAX_RETRY_IMAGES = 300
"""Beyond this, matching all pairs takes hours and is not tried."""

NUM_PROBES = 5
"""Images, spread over the capture, whose features are counted before the rest."""
ENOUGH_FEATURES = 500
"""Median of the probes from which images are not doubled before features are found."""

_FORMAT = 2
"""Of the checkpoint: raised where the same options give other databases."""

Span = tuple[float, float]
_FEATURES: Span = (0.0, 0.25)
_MATCHING: Span = (0.25, 0.5)
_MAPPING: Span = (0.5, 0.9)
_RETRY_FEATURES: Span = (0.9, 0.92)
_RETRY_MATCHING: Span = (0.92, 0.95)
_RETRY_MAPPING: Span = (0.95, 0.97)
_RELAXED: Span = (0.97, 0.98)


class Checkpoint:
    """The databases, and which steps are complete in them: a retried attempt goes on from there.

    `database` is that of the quick way, `thorough_database` that of the thorough one. Databases
    without a state file, or made from other inputs or options, are thrown away.
    """

    def __init__(self, ctx: StageContext, source: Source, options: PosesOptions) -> None:
        self._ctx = ctx
        self._state_file = ctx.checkpoint / "state.json"
        self.database = ctx.checkpoint / "colmap.db"
        self.thorough_database = ctx.checkpoint / "thorough.db"
        inputs = [
            (file, path.stat().st_size)
            for file, path in zip(source.files, source.paths, strict=True)
        ]
        wanted = options.model_dump(
            include={"max_image_px", "num_features", "upsample", "camera_model", "matcher"}
            | {"sequential_overlap", "retrieval_neighbours"}
        )
        text = json.dumps([_FORMAT, inputs, wanted, ctx.seed], sort_keys=True)
        self._fingerprint = hashlib.sha256(text.encode()).hexdigest()
        self._steps: list[str] = []
        ctx.checkpoint.mkdir(parents=True, exist_ok=True)
        if self._state_file.is_file() and self.database.is_file():
            state = json.loads(self._state_file.read_text("utf-8"))
            if state["fingerprint"] == self._fingerprint:
                self._steps = list(state["steps"])
        if not self._steps:
            self._state_file.unlink(missing_ok=True)
            for stale in (*ctx.checkpoint.glob("colmap.db*"), *ctx.checkpoint.glob("thorough.db*")):
                stale.unlink()

    def has(self, step: str) -> bool:
        """Whether that step is complete in its database."""
        return step in self._steps

    def save(self, step: str) -> None:
        """Mark a step complete and offer the checkpoint to the runner."""
        self._steps.append(step)
        state = {"fingerprint": self._fingerprint, "steps": self._steps}
        partial = self._state_file.with_suffix(".partial")
        partial.write_text(json.dumps(state), "utf-8")
        partial.replace(self._state_file)
        self._ctx.checkpoint_saved()


@dataclass
class ProgressScale:
    """Turns counts within a step into the stage's progress, never backwards, with time left."""

    ctx: StageContext
    fraction: float = 0.0
    goal: float = 1.0
    anchor: tuple[float, float] = field(default_factory=lambda: (time.monotonic(), 0.0))
    expected_end: float | None = None

    def aim(self, start: float, goal: float) -> None:
        """From now on, time left is counted to `goal`, at the speed since now."""
        self.fraction = max(self.fraction, start)
        self.anchor = (time.monotonic(), self.fraction)
        self.goal = goal
        self.expected_end = None

    def watch(self, span: Span, total: int, message: str) -> Watch:
        """A watch that maps 0..total onto `span`."""
        start, end = span

        def report(done: int) -> None:
            done = min(done, total)
            fraction = start + (end - start) * done / max(total, 1)
            began, first = self.anchor
            now = time.monotonic()
            if fraction > self.fraction:
                self.fraction = fraction
                pace = (now - began) / (fraction - first)
                self.expected_end = now + pace * max(self.goal - fraction, 0.0)
            left = None if self.expected_end is None else max(self.expected_end - now, 0.0)
            self.ctx.progress(self.fraction, f"{message} {done} of {total}", left)

        return report


class Ladder:
    """The attempts on one capture. `climb` runs them."""

    def __init__(
        self,
        reconstructor: Reconstructor,
        checkpoint: Checkpoint,
        source: Source,
        options: PosesOptions,
        ctx: StageContext,
    ) -> None:
        self._reconstructor = reconstructor
        self._checkpoint = checkpoint
        self._source = source
        self._options = options
        self._ctx = ctx
        self._progress = ProgressScale(ctx)
        self._attempts: list[Attempt] = []

    def climb(self) -> Outcome:
        """Run attempts until enough images are registered, or none is left; none at all where the
        camera only turned, since no model of it means anything.

        Raises PosesError (no_features) before matching where images hold nothing to match.
        """
        num, options = len(self._source.files), self._options
        matcher = choose_matcher(num, options.matcher, is_video=self._source.is_video)
        self._progress.aim(0.0, _MAPPING[1])
        self._extract(_FEATURES, thorough=False)
        check_features(self._reconstructor.statistics(), options)
        self._match(matcher, _MATCHING, thorough=False)
        if is_turning(self._reconstructor.statistics()):
            return Outcome((), self._reconstructor.statistics())
        self._map(matcher, _MAPPING, MapperSettings(refine_principal_point=self._principal))
        if not self._is_enough():
            self._climb_thoroughly("exhaustive" if num <= MAX_RETRY_IMAGES else matcher)
        return Outcome(tuple(self._attempts), self._reconstructor.statistics())

    def _climb_thoroughly(self, matcher: str) -> None:
        """COLMAP's own thoroughness, and where that does not do either, lower thresholds."""
        self._reconstructor = self._reconstructor.on(self._checkpoint.thorough_database)
        self._progress.aim(_RETRY_FEATURES[0], _RETRY_MAPPING[1])
        self._extract(_RETRY_FEATURES, thorough=True)
        self._match(matcher, _RETRY_MATCHING, thorough=True)
        settings = MapperSettings(refine_principal_point=self._principal, thorough=True)
        self._map(matcher, _RETRY_MAPPING, settings)
        if not self._is_enough():
            self._progress.aim(*_RELAXED)
            self._map(matcher, _RELAXED, replace(settings, relaxed=True))

    @property
    def _principal(self) -> bool:
        return self._options.refine_principal_point

    def _is_enough(self) -> bool:
        most = max(attempt.num_registered for attempt in self._attempts)
        return most >= self._options.retry_below_ratio * len(self._source.files)

    def _settings(self, *, upsample: bool) -> FeatureSettings:
        options = self._options
        wanted = FeatureSettings(
            options.max_image_px, options.num_features, upsample, options.num_threads
        )
        threads = extraction_threads(wanted, options.memory_mb, _num_processors())
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

    def _extract(self, span: Span, *, thorough: bool) -> None:
        step = _step("features", thorough=thorough)
        if self._checkpoint.has(step):
            self._ctx.logger.info("%s are in the checkpoint", step)
            return
        self._reconstructor.extract(
            camera_groups(self._source, self._options.camera_model),
            self._settings(upsample=thorough or self._must_upsample()),
            self._progress.watch(span, len(self._source.files), "features of image"),
        )
        self._checkpoint.save(step)

    def _pairs(self, matcher: str) -> Pairs:
        num, options = len(self._source.files), self._options
        if matcher == "retrieval":
            vectors = image_vectors(
                self._reconstructor.features(FEATURES_PER_IMAGE), self._ctx.seed
            )
            return retrieval_pairs(vectors, options.retrieval_neighbours)
        return planned_pairs(num, matcher, options.sequential_overlap)

    def _match(self, matcher: str, span: Span, *, thorough: bool) -> None:
        step = _step(matcher, thorough=thorough)
        if self._checkpoint.has(step):
            self._ctx.logger.info("%s matches are in the checkpoint", step)
            return
        pairs = self._pairs(matcher)
        watch = self._progress.watch(span, len(pairs), "matching pair")
        self._reconstructor.match(pairs, watch, thorough=thorough)
        self._checkpoint.save(step)

    def _map(self, matcher: str, span: Span, settings: MapperSettings) -> None:
        began = time.monotonic()
        num = len(self._source.files)
        models = self._reconstructor.map(settings, self._progress.watch(span, num, "placing image"))
        attempt = Attempt(
            matcher,
            settings.thorough,
            settings.relaxed,
            tuple(models),
            time.monotonic() - began,
        )
        self._attempts.append(attempt)
        self._ctx.logger.info(
            "%s matching%s%s: %d of %d images registered, models of %s",
            matcher,
            ", thorough" if settings.thorough else "",
            ", relaxed" if settings.relaxed else "",
            attempt.num_registered,
            num,
            [len(model.indices) for model in models],
        )


def _step(name: str, *, thorough: bool) -> str:
    """What a step is called in the checkpoint."""
    return f"thorough {name}" if thorough else name


def _num_processors() -> int:
    """Processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
