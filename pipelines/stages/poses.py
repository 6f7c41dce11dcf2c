"""Poses: where each image was taken, by structure from motion.

Reads the images of `frames` (videos) or `ingest` (photos). Writes cameras.json (registered images
only, gravity along -Z, cameras in [-1, 1]^3), points.ply (sparse, coloured, same frame) and
report.json (what registered, what did not and why, every attempt made).

A first attempt matches neighbours (videos) or all pairs (photos). Where less than
`retry_below_ratio` registers, all pairs are matched, then thresholds are relaxed; the attempt
with most images wins. The database of features and matches is the checkpoint.
"""

from __future__ import annotations

import hashlib
import json
import math
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.cameras_file import CamerasFile, PosedImage
from pipelines.errors import PosesError
from pipelines.options import PosesOptions
from pipelines.orientation import Normalisation, normalise, opengl_from_opencv
from pipelines.ply import write_points
from pipelines.stage import StageContext
from pipelines.stages.poses_report import Outcome, build_report
from pipelines.stages.poses_source import Source, camera_groups, read_source
from pipelines.tools.colmap import (
    MapperSettings,
    PairStatistics,
    Reconstructor,
    SparseModel,
    Watch,
    best_model,
)

MAX_EXHAUSTIVE_IMAGES = 200
"""Photos beyond this are matched by file name first."""
MAX_RETRY_IMAGES = 300
"""Beyond this, matching all pairs takes hours and is not tried."""
SMALL_SEQUENCE = 30
"""Up to here all pairs cost no more than a sequence's."""
MIN_FEATURES = 100
"""An image with fewer cannot be placed."""
MIN_ANGLE_DEG = 2.0
"""Median triangulation angle below which depth is not determined; COLMAP keeps nothing < 1.5."""
MAX_ROTATION_SHARE = 0.7
"""Share of pairs that a pure rotation explains, above which the camera did not move."""
MIN_TRACK = 3
"""Points seen by fewer images are left out of points.ply."""

_FEATURES = (0.0, 0.32)
_MATCHING = (0.32, 0.6)
_MAPPING = (0.6, 0.9)
_RETRY = ((0.9, 0.94), (0.94, 0.96))
_RELAXED = (0.96, 0.98)

Pairs = list[tuple[int, int]]


def run(options: PosesOptions, ctx: StageContext) -> dict[str, Any]:
    """Find the poses of a capture's images.

    Raises PosesError: no_features, too_few_registered or no_parallax; ToolError where COLMAP fails.
    """
    source = read_source(ctx.workspace)
    checkpoint = Checkpoint(ctx, source, options)
    with tempfile.TemporaryDirectory(prefix="poses-") as scratch:
        reconstructor = Reconstructor(
            checkpoint.database,
            source.paths,
            Path(scratch),
            num_threads=options.num_threads,
            seed=ctx.seed,
        )
        outcome = _reconstruct(reconstructor, checkpoint, source, options, ctx)
    check_usable(outcome, source, options)
    assert outcome.best is not None
    ctx.progress(0.98, "writing poses", None)
    return _write(outcome, outcome.best, source, options, ctx)


class Checkpoint:
    """The database, and how far it is: a retried attempt goes on from there.

    `state.json` holds the steps that are complete and a fingerprint of inputs and options; a
    database without it, or made from something else, is thrown away.
    """

    def __init__(self, ctx: StageContext, source: Source, options: PosesOptions) -> None:
        self._ctx = ctx
        self._state_file = ctx.checkpoint / "state.json"
        self.database = ctx.checkpoint / "colmap.db"
        inputs = [(file, path.stat().st_size) for file, path in zip(source.files, source.paths)]
        wanted = options.model_dump(
            include={"max_image_px", "num_features", "camera_model", "matcher"}
        )
        text = json.dumps([inputs, wanted])
        self._fingerprint = hashlib.sha256(text.encode()).hexdigest()
        self._steps: list[str] = []
        ctx.checkpoint.mkdir(parents=True, exist_ok=True)
        if self._state_file.is_file() and self.database.is_file():
            state = json.loads(self._state_file.read_text("utf-8"))
            if state["fingerprint"] == self._fingerprint:
                self._steps = list(state["steps"])
        if not self._steps:
            for stale in ctx.checkpoint.glob("colmap.db*"):
                stale.unlink()

    def has(self, step: str) -> bool:
        """Whether that step is complete in the database."""
        return step in self._steps

    def save(self, step: str) -> None:
        """Mark a step complete and offer the checkpoint to the runner."""
        self._steps.append(step)
        state = {"fingerprint": self._fingerprint, "steps": self._steps}
        self._state_file.write_text(json.dumps(state), "utf-8")
        self._ctx.checkpoint_saved()


@dataclass
class _Progress:
    """Turns counts of a step into the stage's progress, never backwards, with the time left."""

    ctx: StageContext
    fraction: float = 0.0
    goal: float = 1.0
    anchor: tuple[float, float] = field(default_factory=lambda: (time.monotonic(), 0.0))

    def aim(self, start: float, goal: float) -> None:
        """Time left is counted to `goal` from now on, at the speed since now."""
        self.fraction = max(self.fraction, start)
        self.anchor = (time.monotonic(), self.fraction)
        self.goal = goal

    def watch(self, span: tuple[float, float], total: int, message: str) -> Watch:
        """A watch that maps 0..total onto `span`."""
        start, end = span

        def report(done: int) -> None:
            share = min(done / max(total, 1), 1.0)
            self.fraction = max(self.fraction, start + (end - start) * share)
            began, first = self.anchor
            moved = self.fraction - first
            left = None
            if moved > 0.02 * (self.goal - first):
                left = (time.monotonic() - began) / moved * max(self.goal - self.fraction, 0.0)
            self.ctx.progress(self.fraction, f"{message} {min(done, total)}/{total}", left)

        return report


def sequential_pairs(num: int, overlap: int) -> Pairs:
    """Each image with its next `overlap`, and those 2, 4, 8, ... further on; (i, j) with i < j."""
    steps = set(range(1, overlap + 1)) | {2**k for k in range(num.bit_length())}
    return sorted((i, i + step) for step in steps for i in range(num - step))


def spaced_pairs(num: int) -> Pairs:
    """All pairs among about 2 sqrt(num) evenly spaced images, so that a loop closes."""
    count = min(num, max(8, round(2 * math.sqrt(num))))
    chosen = sorted({round(i * (num - 1) / max(count - 1, 1)) for i in range(count)})
    return [(i, j) for position, i in enumerate(chosen) for j in chosen[position + 1 :]]


def exhaustive_pairs(num: int) -> Pairs:
    """All pairs (i, j), i < j < num."""
    return [(i, j) for i in range(num) for j in range(i + 1, num)]


def plan_pairs(num: int, options: PosesOptions, *, is_video: bool) -> tuple[str, Pairs]:
    """The first attempt's pairs and what to call them: sequential or exhaustive."""
    limit = SMALL_SEQUENCE if is_video else MAX_EXHAUSTIVE_IMAGES
    matcher = options.matcher
    if matcher == "auto":
        matcher = "exhaustive" if num <= limit else "sequential"
    if matcher == "exhaustive":
        return matcher, exhaustive_pairs(num)
    return matcher, sorted({*sequential_pairs(num, options.sequential_overlap), *spaced_pairs(num)})


def _reconstruct(
    reconstructor: Reconstructor,
    checkpoint: Checkpoint,
    source: Source,
    options: PosesOptions,
    ctx: StageContext,
) -> Outcome:
    """The attempts in order, until enough images are registered."""
    num = len(source.files)
    progress = _Progress(ctx)
    matcher, pairs = plan_pairs(num, options, is_video=source.is_video)
    progress.aim(0.0, _MAPPING[1])
    _extract(reconstructor, checkpoint, source, options, progress)
    outcome = Outcome(statistics=reconstructor.statistics())
    check_features(outcome.statistics, options)
    _match(reconstructor, checkpoint, (matcher, pairs), progress.watch(_MATCHING, len(pairs), "matching pair"))
    settings = MapperSettings(refine_principal_point=options.refine_principal_point)
    _attempt(reconstructor, matcher, settings, outcome, progress.watch(_MAPPING, num, "placing image"), ctx)

    def is_enough() -> bool:
        placed = 0 if outcome.best is None else len(outcome.best.indices)
        return placed >= options.retry_below_ratio * num

    if not is_enough() and matcher != "exhaustive" and num <= MAX_RETRY_IMAGES:
        matcher, pairs = "exhaustive", exhaustive_pairs(num)
        progress.aim(_RETRY[0][0], _RETRY[1][1])
        _match(reconstructor, checkpoint, (matcher, pairs), progress.watch(_RETRY[0], len(pairs), "matching pair"))
        _attempt(reconstructor, matcher, settings, outcome, progress.watch(_RETRY[1], num, "placing image"), ctx)
    if not is_enough():
        settings = MapperSettings(
            refine_principal_point=options.refine_principal_point, relaxed=True
        )
        progress.aim(*_RELAXED)
        _attempt(
            reconstructor, f"{matcher}, relaxed", settings, outcome,
            progress.watch(_RELAXED, num, "placing image"), ctx,
        )
    return outcome
