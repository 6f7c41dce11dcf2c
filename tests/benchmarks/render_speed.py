"""Rays per second of the CPU renderer with the networks of a preset, on an untrained model.

    python -m tests.benchmarks.render_speed [--preset preview] [--threads 2] [--rays 40000]

Prints the time of the first call (compiling, or loading what was compiled before) and the best of
three. An untrained scene is fog, so early stops save nothing here: a trained one is faster.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import torch

from pipelines.nerf.kernels.render_rays import pack_model, render_rays
from pipelines.nerf.models.nerfacto import Nerfacto
from pipelines.options import resolve_options, stage_options, train_config


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--preset", default="preview")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rays", type=int, default=40_000)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    torch.manual_seed(0)
    config = train_config(stage_options("train", resolve_options(arguments.preset, {})["train"]))
    packed = pack_model(Nerfacto(config.model, 10).eval(), early_stop=1e-3, weight_threshold=1e-3)
    side = int(arguments.rays**0.5)
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, side), np.linspace(-0.5, 0.5, side))
    directions = np.stack([x, y, -np.ones_like(x)], axis=-1).reshape(-1, 3).astype(np.float32)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    origins = np.full_like(directions, 0.3)
    started = time.perf_counter()
    render_rays(packed, origins[:64], directions[:64])
    print(f"first call {time.perf_counter() - started:.1f} s")
    times = []
    for _ in range(3):
        started = time.perf_counter()
        render_rays(packed, origins, directions)
        times.append(time.perf_counter() - started)
    print(
        f"{arguments.preset}: {len(origins) / min(times):,.0f} rays/s, {arguments.threads} threads"
    )


if __name__ == "__main__":
    main()
