"""Dense stereo against depth that is known: `python -m tests.benchmarks.stereo FOLDER`.

FOLDER holds a `transforms.json` with `depth_file_path` and `depth_unit_scale_factor`
(`rgbd-hololens-office`), or what `tests.benchmarks.geometry --posed` writes, unpacked. The known
depth is not used, every tenth image takes no part, as if it were held out. Prints what share of the
pixels with known depth has a depth, what share of these is within 5 %, their product, the median
error, processor seconds and seconds a view. With `--device cuda` a GPU is timed.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.nerf.options.stereo import StereoConfig
from pipelines.nerf.stereo.engines import choose_engine
from pipelines.nerf.stereo.maps import find_depth_maps
from pipelines.nerf.stereo.views import StereoView
from pipelines.scene.cameras_file import Intrinsics, PosedImage
from pipelines.scene.stereo_views import stereo_view
from tests.benchmarks.geometry_truth import depth_files, read_depth_png
from tests.benchmarks.tables import markdown_table, number

EVERY = 10


def read_views(folder: Path, long_side_px: int) -> dict[str, StereoView]:
    """The views of a capture by their `file_path`, without those that count as held out."""
    told = json.loads((folder / "transforms.json").read_text("utf-8"))
    terms = {key: float(told.get(key, 0.0)) for key in ("k1", "k2", "k3", "k4", "p1", "p2")}
    lens = Intrinsics(
        int(told["w"]),
        int(told["h"]),
        float(told["fl_x"]),
        float(told["fl_y"]),
        float(told["cx"]),
        float(told["cy"]),
        model="OPENCV" if any(terms.values()) else "PINHOLE",
        **terms,
    )
    views = {}
    for index, frame in enumerate(told["frames"]):
        if index % EVERY:
            pose = tuple(tuple(map(float, row)) for row in frame["transform_matrix"][:3])
            image = PosedImage(frame["file_path"], 0, pose)
            views[image.file] = stereo_view(folder, image, lens, long_side_px)
    return views


def measure(folder: Path, config: StereoConfig) -> dict[str, Any]:
    """The row of one capture."""
    views, truth = read_views(folder, config.long_side_px), depth_files(folder)
    engine = choose_engine(list(views.values()), config)
    begun, begun_cpu = time.monotonic(), time.process_time()
    maps = find_depth_maps(list(views.values()), config, engine=engine)
    cpu_s, wall_s = time.process_time() - begun_cpu, time.monotonic() - begun
    shares, rights, errors = [], [], []
    for file, found in zip(views, maps, strict=True):
        path, unit = truth[file]
        exact = read_depth_png(path, unit, found.z.shape)
        both = (exact > 0) & (found.z > 0)
        error = np.abs(found.z[both] / exact[both] - 1.0)
        shares.append(both.sum() / max((exact > 0).sum(), 1))
        rights.append((error < 0.05).sum() / max((exact > 0).sum(), 1))
        errors.append(error)
    every = np.concatenate(errors)
    return {
        "views": len(views),
        "known": float(np.mean(shares)),
        "right": float(np.mean(rights)),
        "within_5_percent": float((every < 0.05).mean()) if len(every) else None,
        "median_error": float(np.median(every)) if len(every) else None,
        "cpu_s_per_view": cpu_s / len(views),
        "wall_s_per_view": wall_s / len(views),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.stereo", description=__doc__)
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER")
    parser.add_argument("--set", action="append", default=[], metavar="option=value")
    parser.add_argument("--device", default="cpu", choices=("auto", "cpu", "cuda"))
    chosen = parser.parse_args(arguments)
    changes = {key: json.loads(value) for key, value in (item.split("=") for item in chosen.set)}
    config = replace(StereoConfig(), device=chosen.device, **changes)
    rows = []
    for folder in chosen.folders:
        row = measure(folder, config)
        rows.append(
            [
                folder.name,
                str(row["views"]),
                *(
                    number(row[key], 3)
                    for key in ("known", "within_5_percent", "right", "median_error")
                ),
                number(row["cpu_s_per_view"], 2),
                number(row["wall_s_per_view"], 2),
            ]
        )
    header = ("capture", "views", "known", "of these within 5 %", "right", "median error")
    print(markdown_table((*header, "CPU s", "s"), rows))


if __name__ == "__main__":
    main()
