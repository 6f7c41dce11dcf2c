"""One training run with pictures measured on the way.

Training time is that of the steps: neither compiling, which `warm_up` does before, nor loading, nor
the measuring itself counts.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from pipelines.nerf.options.train import TrainConfig
from pipelines.nerf.training.loop import TrainProgress, train
from tests.benchmarks.capture_data import BenchmarkCapture
from tests.benchmarks.machine import wait_for_gpu
from tests.benchmarks.scores import Score, evaluate

POLL_STEPS = 5
"""Steps between looks at the clock where marks are given in seconds."""


@dataclass(frozen=True)
class Mark:
    """The state after `step` steps and `train_s` seconds of training; scores by image name.

    cpu_s: seconds of all cores together that training took, its start included.
    """

    step: int
    train_s: float
    scores: dict[str, Score]
    cpu_s: float = 0.0

    def mean_psnr(self, names: Sequence[str] | None = None) -> float:
        """Mean over these images, or over all."""
        chosen = list(self.scores) if names is None else names
        return sum(self.scores[name].psnr for name in chosen) / len(chosen)

    def mean_ssim(self, names: Sequence[str] | None = None) -> float:
        """Mean over these images, or over all."""
        chosen = list(self.scores) if names is None else names
        return sum(self.scores[name].ssim for name in chosen) / len(chosen)


@dataclass(frozen=True)
class Run:
    """A finished run. train_s: seconds of all its steps. model: in `eval()`."""

    seed: int
    marks: list[Mark]
    steps: int
    train_s: float
    rays_per_s: float
    model: Any

    def as_dict(self) -> dict[str, Any]:
        """Plain data, without the model."""
        return asdict(replace(self, model=None))


@dataclass
class _Clock:
    """Training seconds at any moment between two steps, from the last report of the loop."""

    step: int = 0
    elapsed_s: float = 0.0
    at: float = field(default_factory=time.monotonic)

    def hear(self, progress: TrainProgress) -> None:
        self.set(progress.step, progress.elapsed_s)

    def set(self, step: int, elapsed_s: float) -> None:
        self.step, self.elapsed_s, self.at = step, elapsed_s, time.monotonic()

    def read(self, step: int) -> float:
        """Seconds up to now. A GPU's loop reports rarely: what came since is added."""
        if step == self.step:
            return self.elapsed_s
        wait_for_gpu()
        return self.elapsed_s + time.monotonic() - self.at


def run_with_marks(
    capture: BenchmarkCapture,
    config: TrainConfig,
    *,
    seed: int,
    images: Sequence[int],
    steps: Sequence[int] = (),
    seconds: Sequence[float] = (),
    render_engine: str = "auto",
) -> Run:
    """Train, and measure the pictures `images` after the given steps, or seconds of training.

    With `seconds` a mark is taken at the first look at the clock behind it, every 5 steps. The end
    of the run is always a mark. render_engine: what draws the pictures, whatever trains.
    """
    every = math.gcd(*steps) if steps else 0
    every = math.gcd(every, POLL_STEPS) if seconds else every
    config = replace(config, preview_every_steps=every or config.max_steps)
    clock, marks, waiting = _Clock(), list[Mark](), sorted(seconds)
    cpu_begin = time.process_time()  # moved on by what measuring takes

    def measure(step: int, model: Any, elapsed: float) -> None:
        nonlocal cpu_begin
        cpu = time.process_time()
        scores = evaluate(model, capture, images, render_engine)
        marks.append(Mark(step, elapsed, scores, cpu - cpu_begin))
        cpu_begin += time.process_time() - cpu
        clock.set(step, elapsed)

    def look(step: int, model: Any) -> None:
        elapsed = clock.read(step)
        is_late = bool(waiting) and elapsed >= waiting[0]
        while waiting and elapsed >= waiting[0]:
            waiting.pop(0)
        if step in steps or is_late:
            measure(step, model, elapsed)
        else:
            clock.set(step, elapsed)

    last = _Clock()

    def hear(progress: TrainProgress) -> None:
        clock.hear(progress)
        last.hear(progress)

    model = train(
        capture.images,
        capture.cameras,
        capture.train,
        config,
        seed=seed,
        on_progress=hear,
        on_preview=look,
    )
    wait_for_gpu()
    done = config.max_steps if config.max_seconds <= 0.0 else max(last.step, clock.step)
    train_s = clock.read(done)
    if not marks or marks[-1].step != done:
        measure(done, model, train_s)
    rate = done * config.rays_per_step / max(train_s, 1e-9)
    return Run(seed, marks, done, train_s, rate, model)


def warm_up(capture: BenchmarkCapture, config: TrainConfig) -> float:
    """Two steps of a run that is thrown away, so that compiling counts nowhere. Its seconds."""
    started = time.monotonic()
    brief = replace(config, max_steps=2, preview_every_steps=2)
    train(capture.images, capture.cameras, capture.train, brief, seed=0)
    wait_for_gpu()
    return time.monotonic() - started
