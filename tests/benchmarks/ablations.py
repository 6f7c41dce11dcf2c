"""The paper's table of ablations on given captures: PSNR / SSIM / LPIPS of each and the average.

    python -m tests.benchmarks.ablations CAPTURE... --steps 2000 [--preset-size small|paper]
        [--only "nerfacto,without pose"] [--test-time] [--set option=value] [--json out/abl.json]
        [--lpips-weights FILE --lpips-sha256 HEX --lpips-backbone alex]

`small` has the samples and grids of the preview preset with the paper's poses and codes, so that a
CPU can do it; `paper` the paper's whole settings. 10 % of the images are held out at equal
intervals. Without `--test-time` they are rendered with the given cameras and the mean code. With
it, after the paper's procedure: every variant's held-out poses are fitted, then, where it has
codes, each image's code on one half; the table is then of whole images, and a second one of the
halves that were not seen. LPIPS is "-" (null) where no weights are given.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from pipelines.nerf.judging.lpips import BACKBONES, lpips_if_configured
from pipelines.nerf.options.ablations import ABLATIONS, ablated
from pipelines.nerf.options.train import TrainConfig
from pipelines.nerf.training.loop import train
from tests.benchmarks.capture_data import BenchmarkCapture, load_capture
from tests.benchmarks.machine import describe, heading
from tests.benchmarks.scores import PictureDistance, Score, render_images, score
from tests.benchmarks.settings import overridden, preset_config, sampling_model
from tests.benchmarks.tables import markdown_table, mean, number, write_json


@dataclass(frozen=True)
class Outcome:
    """One variant on one capture. whole: scores by image; unseen: of the halves not fitted to."""

    variant: str
    capture: str
    train_s: float
    whole: dict[str, Score]
    unseen: dict[str, Score]
    halves: dict[str, str]


def size_config(size: str, steps: int) -> TrainConfig:
    """The options before any ablation: "paper", or "small" for a CPU."""
    if size == "paper":
        return replace(TrainConfig(), max_steps=steps)
    preview = preset_config("preview")
    return replace(
        preview,
        max_steps=steps,
        model=sampling_model("preview"),
        optimizer=replace(preview.optimizer, decay_steps=steps),
    )


def measure_plainly(
    model: Any, capture: BenchmarkCapture, lpips: PictureDistance | None
) -> dict[str, Score]:
    """Scores by image with the given cameras and the mean code."""
    pictures = render_images(model, capture, capture.test)
    return {
        capture.names[index]: score(picture, capture.images.image(index), lpips)
        for index, picture in pictures.items()
    }


def measure_fitted(
    model: Any, capture: BenchmarkCapture, lpips: PictureDistance | None, seed: int
) -> tuple[dict[str, Score], dict[str, Score], dict[str, str]]:
    """(scores of whole images, of the halves not seen, the halves that were), all by image."""
    from pipelines.nerf.judging.test_time import (
        LEFT,
        RIGHT,
        fit_appearance,
        fit_poses,
        half_columns,
        other_half,
    )
    from pipelines.nerf.options.evaluate import TestTimeConfig

    options = TestTimeConfig()
    posed = fit_poses(
        model, capture.cameras, capture.images, capture.test, options, seed=seed
    ).applied_to(capture.cameras)
    codes, halves = {}, {}
    if model.mean_appearance() is not None:
        fitted = fit_appearance(model, posed, capture.images, capture.test, options, seed=seed)
        codes = dict(zip(fitted.indices, fitted.codes, strict=True))
        halves = dict(zip(fitted.indices, fitted.halves, strict=True))
    pictures = render_images(model, capture, capture.test, cameras=posed, codes=codes)
    whole, unseen = {}, {}
    for index, picture in pictures.items():
        name, truth = capture.names[index], capture.images.image(index)
        whole[name] = score(picture, truth, lpips)
        # Without codes nothing was fitted to either half: the mean of both stands for the one.
        sides = [other_half(halves[index])] if index in halves else [LEFT, RIGHT]
        columns = [half_columns(picture.shape[1], side) for side in sides]
        parts = [score(picture[:, part], truth[:, part], lpips) for part in columns]
        unseen[name] = mean_score(parts)
    return whole, unseen, {capture.names[index]: half for index, half in halves.items()}


def run_variant(
    capture: BenchmarkCapture,
    config: TrainConfig,
    variant: str,
    lpips: PictureDistance | None,
    *,
    seed: int,
    test_time: bool,
) -> Outcome:
    """Train one variant on one capture and measure it."""
    config = capture.suited(config)
    chosen = ablated(config, variant)
    if capture.bounds is not None:  # a synthetic scene knows its bounds better than the ablation
        chosen = replace(
            chosen, model=replace(chosen.model, near=config.model.near, far=config.model.far)
        )
    started = time.monotonic()
    model = train(capture.images, capture.cameras, capture.train, chosen, seed=seed)
    train_s = time.monotonic() - started
    if test_time:
        whole, unseen, halves = measure_fitted(model, capture, lpips, seed)
    else:
        whole, unseen, halves = measure_plainly(model, capture, lpips), {}, {}
    return Outcome(variant, capture.name, train_s, whole, unseen, halves)


def mean_score(scores: Sequence[Score]) -> Score:
    """The mean of several pictures' scores, as one."""
    return Score(
        psnr=sum(item.psnr for item in scores) / len(scores),
        ssim=sum(item.ssim for item in scores) / len(scores),
        lpips=mean([item.lpips for item in scores]),
    )


def means(scores: Sequence[Score]) -> tuple[float | None, float | None, float | None]:
    """Mean (PSNR, SSIM, LPIPS); None where unknown."""
    return (
        mean([item.psnr for item in scores]),
        mean([item.ssim for item in scores]),
        mean([item.lpips for item in scores]),
    )


def table(outcomes: Sequence[Outcome], captures: Sequence[str], *, unseen: bool = False) -> str:
    """The paper's table: a row for each variant, a column for each capture, and the average.

    unseen: of the halves that were not fitted to.
    """
    rows = []
    for variant in dict.fromkeys(item.variant for item in outcomes):
        triples = []
        for name in captures:
            found = [o for o in outcomes if o.variant == variant and o.capture == name]
            scores = [found[0].unseen if unseen else found[0].whole] if found else [{}]
            triples.append(means(list(scores[0].values())))
        average = tuple(mean(list(column)) for column in zip(*triples, strict=True))
        rows.append([variant, *(_triple(values) for values in (*triples, average))])
    return markdown_table(["PSNR / SSIM / LPIPS", *captures, "average"], rows)


def _triple(values: Sequence[float | None]) -> str:
    return " / ".join(number(value, 2 if i == 0 else 3) for i, value in enumerate(values))


def parse() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("captures", type=Path, nargs="+", metavar="CAPTURE")
    parser.add_argument("--steps", type=int, required=True)
    parser.add_argument("--preset-size", choices=("small", "paper"), default="small")
    parser.add_argument("--only", help=f"with commas between: {', '.join(ABLATIONS)}")
    parser.add_argument("--test-time", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", action="append", default=[], metavar="OPTION=VALUE")
    parser.add_argument("--lpips-weights", default="")
    parser.add_argument("--lpips-sha256", default="")
    parser.add_argument("--lpips-backbone", choices=tuple(BACKBONES), default="alex")
    parser.add_argument(
        "--lpips-cache", type=Path, default=Path("~/.cache/nerfworks/weights").expanduser()
    )
    parser.add_argument("--threads", type=int)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    variants = arguments.only.split(",") if arguments.only else list(ABLATIONS)
    arguments.only = [variant.strip() for variant in variants]
    unknown = [variant for variant in arguments.only if variant not in ABLATIONS]
    if unknown:
        parser.error(f"no such ablation: {', '.join(unknown)}; there are {', '.join(ABLATIONS)}")
    return arguments


def main() -> None:
    """Train all, measure and print."""
    arguments = parse()
    machine = describe(arguments.threads)
    print(heading(machine))
    lpips, why_not = lpips_if_configured(
        arguments.lpips_backbone,
        arguments.lpips_weights,
        arguments.lpips_sha256,
        arguments.lpips_cache,
    )
    config = overridden(size_config(arguments.preset_size, arguments.steps), arguments.set)
    outcomes: list[Outcome] = []
    names = []
    for folder in arguments.captures:
        capture = load_capture(folder, config.data)
        names.append(capture.name)
        print(capture.describe(), flush=True)
        for variant in arguments.only:
            outcome = run_variant(
                capture,
                config,
                variant,
                lpips,
                seed=arguments.seed,
                test_time=arguments.test_time,
            )
            outcomes.append(outcome)
            shown = _triple(means(list(outcome.whole.values())))
            print(f"{capture.name}, {variant}: {shown}, {outcome.train_s:.0f} s", flush=True)
    print("\n" + table(outcomes, names))
    if any(outcome.unseen for outcome in outcomes):
        print("\nHalves that were not fitted to\n\n" + table(outcomes, names, unseen=True))
    if why_not is not None:
        print(f"\n{why_not}")
    values: dict[str, Any] = {
        "benchmark": "ablations",
        "machine": machine,
        "steps": config.max_steps,
        "preset_size": arguments.preset_size,
        "test_time": arguments.test_time,
        "seed": arguments.seed,
        "config": asdict(config),
        "lpips_unavailable": why_not,
        "outcomes": [asdict(outcome) for outcome in outcomes],
    }
    write_json(arguments.json, values)


if __name__ == "__main__":
    main()
