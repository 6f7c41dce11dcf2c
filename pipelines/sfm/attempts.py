"""The ladder of attempts at a reconstruction, with its progress and its checkpoint.

First the planned pairs; where too few images register, all pairs; then relaxed thresholds. The
attempt with most images wins. Features and matches stay in one database, the checkpoint.
"""

from __future__ import annotations

import hashlib
import json
import time
from dataclasses import dataclass, field

from pipelines.options import PosesOptions
from pipelines.sfm.pairs import Pairs, exhaustive_pairs, plan_pairs
from pipelines.sfm.report import Attempt, Outcome, check_features
from pipelines.sfm.source import Source, camera_groups
from pipelines.sfm.turning import is_turning
from pipelines.stage import StageContext
from pipelines.tools.colmap import MapperSettings, Reconstructor, Watch

MAX_RETRY_IMAGES = 300
"""Beyond this, matching all pairs takes hours and is not tried."""

Span = tuple[float, float]
_FEATURES: Span = (0.0, 0.32)
_MATCHING: Span = (0.32, 0.6)
_MAPPING: Span = (0.6, 0.9)
_RETRY_MATCHING: Span = (0.9, 0.94)
_RETRY_MAPPING: Span = (0.94, 0.96)
_RELAXED: Span = (0.96, 0.98)


class Checkpoint:
    """The database, and which steps are complete in it: a retried attempt goes on from there.

    A database without a state file, or made from other inputs or options, is thrown away.
    """

    def __init__(self, ctx: StageContext, source: Source, options: PosesOptions) -> None:
        self._ctx = ctx
        self._state_file = ctx.checkpoint / "state.json"
        self.database = ctx.checkpoint / "colmap.db"
        inputs = [
            (file, path.stat().st_size)
            for file, path in zip(source.files, source.paths, strict=True)
        ]
        wanted = options.model_dump(
            include={"max_image_px", "num_features", "camera_model", "matcher"}
            | {"sequential_overlap"}
        )
        text = json.dumps([inputs, wanted, ctx.seed], sort_keys=True)
        self._fingerprint = hashlib.sha256(text.encode()).hexdigest()
        self._steps: list[str] = []
        ctx.checkpoint.mkdir(parents=True, exist_ok=True)
        if self._state_file.is_file() and self.database.is_file():
            state = json.loads(self._state_file.read_text("utf-8"))
            if state["fingerprint"] == self._fingerprint:
                self._steps = list(state["steps"])
        if not self._steps:
            self._state_file.unlink(missing_ok=True)
            for stale in ctx.checkpoint.glob("colmap.db*"):
                stale.unlink()

    def has(self, step: str) -> bool:
        """Whether that step is complete in the database."""
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
        matcher, pairs = plan_pairs(
            num, options.matcher, options.sequential_overlap, is_video=self._source.is_video
        )
        self._progress.aim(0.0, _MAPPING[1])
        self._extract()
        check_features(self._reconstructor.statistics(), options)
        self._match(matcher, pairs, _MATCHING)
        if is_turning(self._reconstructor.statistics()):
            return Outcome((), self._reconstructor.statistics())
        self._map(matcher, _MAPPING, relaxed=False)
        if not self._is_enough() and matcher != "exhaustive" and num <= MAX_RETRY_IMAGES:
            matcher = "exhaustive"
            self._progress.aim(_RETRY_MATCHING[0], _RETRY_MAPPING[1])
            self._match(matcher, exhaustive_pairs(num), _RETRY_MATCHING)
            self._map(matcher, _RETRY_MAPPING, relaxed=False)
        if not self._is_enough():
            self._progress.aim(*_RELAXED)
            self._map(matcher, _RELAXED, relaxed=True)
        return Outcome(tuple(self._attempts), self._reconstructor.statistics())

    def _is_enough(self) -> bool:
        most = max(attempt.num_registered for attempt in self._attempts)
        return most >= self._options.retry_below_ratio * len(self._source.files)

    def _extract(self) -> None:
        if self._checkpoint.has("features"):
            self._ctx.logger.info("features are in the checkpoint")
            return
        self._reconstructor.extract(
            camera_groups(self._source, self._options.camera_model),
            self._options.max_image_px,
            self._options.num_features,
            self._progress.watch(_FEATURES, len(self._source.files), "features of image"),
        )
        self._checkpoint.save("features")

    def _match(self, matcher: str, pairs: Pairs, span: Span) -> None:
        if self._checkpoint.has(matcher):
            self._ctx.logger.info("%s matches are in the checkpoint", matcher)
            return
        self._reconstructor.match(pairs, self._progress.watch(span, len(pairs), "matching pair"))
        self._checkpoint.save(matcher)

    def _map(self, matcher: str, span: Span, *, relaxed: bool) -> None:
        began = time.monotonic()
        settings = MapperSettings(
            refine_principal_point=self._options.refine_principal_point, relaxed=relaxed
        )
        num = len(self._source.files)
        models = self._reconstructor.map(settings, self._progress.watch(span, num, "placing image"))
        attempt = Attempt(matcher, relaxed, tuple(models), time.monotonic() - began)
        self._attempts.append(attempt)
        self._ctx.logger.info(
            "%s matching%s: %d of %d images registered, models of %s",
            matcher,
            ", relaxed" if relaxed else "",
            attempt.num_registered,
            num,
            [len(model.indices) for model in models],
        )
