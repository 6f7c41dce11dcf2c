"""`make chaos [SEED=7]`: shake the whole service and judge what is left."""

from __future__ import annotations

import argparse
import secrets
import shutil
import sys
import tempfile
from pathlib import Path

from tests.chaos.run import shake


def main() -> int:
    """0 where all held."""
    parser = argparse.ArgumentParser(prog="python -m tests.chaos", description=__doc__)
    parser.add_argument("--seed", type=int, default=secrets.randbelow(10_000))
    parser.add_argument("--jobs", type=int, default=200)
    parser.add_argument("--minutes", type=float, default=8.0)
    parser.add_argument("--keep", action="store_true", help="keep the logs of a good run, too")
    asked = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="chaos-"))
    outcome = shake(
        folder, asked.seed, asked.jobs, asked.minutes, lambda line: print(line, flush=True)
    )
    print("\n".join(outcome.lines()))
    if outcome.is_good and not asked.keep:
        shutil.rmtree(folder, ignore_errors=True)
    else:
        print(
            f"logs are in {folder / 'logs'}; again: --seed {asked.seed} --jobs {asked.jobs} "
            f"--minutes {asked.minutes}"
        )
    return 0 if outcome.is_good else 1


if __name__ == "__main__":
    sys.exit(main())
