"""`python -m pipelines.sample OUT.mp4 [--scene NAME]`: film an analytic scene, keep the truth."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from pipelines.errors import PipelineError
from pipelines.sample.film import LONG_SIDE_PX, NUM_FRAMES, film_capture
from pipelines.sample.scenes.catalogue import TAKES


def main(arguments: list[str] | None = None) -> int:
    """Returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m pipelines.sample",
        description="Film an analytic scene as a phone would: a capture whose truth is known.",
    )
    parser.add_argument("out", type=Path, help="the .mp4 to write")
    parser.add_argument(
        "--scene", choices=sorted(TAKES), default="bowl", help="what is filmed; %(default)s"
    )
    parser.add_argument("--frames", type=int, default=NUM_FRAMES, help="number of frames")
    parser.add_argument(
        "--long-side", type=int, default=LONG_SIDE_PX, metavar="PX", help="of the upright picture"
    )
    parser.add_argument(
        "--truth", type=Path, metavar="JSON", help="write the true cameras (cameras.json) here"
    )
    given = parser.parse_args(arguments)
    started = time.monotonic()
    columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
    try:
        given.out.parent.mkdir(parents=True, exist_ok=True)
        with Progress(*columns) as bar:
            task = bar.add_task("filming the sample", total=given.frames)
            truth = film_capture(
                given.out,
                given.frames,
                given.long_side,
                take=TAKES[given.scene],
                on_frame=lambda done, total: bar.update(task, completed=done, total=total),
            )
        if given.truth is not None:
            given.truth.parent.mkdir(parents=True, exist_ok=True)
            truth.save(given.truth)
    except PipelineError as error:
        print(f"{error.message} {error.hint}", error.details.get("log", ""), file=sys.stderr)
        return 1
    except (OSError, ValueError) as error:
        print(f"The sample could not be filmed: {error}", file=sys.stderr)
        return 1
    print(
        f"{given.out}: {len(truth.images)} frames, {given.out.stat().st_size / 1e6:.1f} MB, "
        f"{time.monotonic() - started:.0f} s"
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
