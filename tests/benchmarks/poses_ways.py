"""Ways to find a capture's poses, each measured in the process that runs it.

A child of `tests.benchmarks.poses_speed`: it finds the poses of the images of one job folder in one
way, and prints what that took as one line of JSON. It imports no torch, so that peak memory is what
structure from motion holds.
"""

from __future__ import annotations

import json
import os
import re
import resource
import shutil
import sys
import tempfile
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from pipelines.options import PosesOptions, resolve_options
from pipelines.scene.orientation import opengl_from_opencv
from pipelines.sfm.attempts import Ladder, num_processors
from pipelines.sfm.checkpoint import Checkpoint
from pipelines.sfm.intrinsics import settle_lenses
from pipelines.sfm.rungs import RUNGS
from pipelines.sfm.source import Source, read_source
from pipelines.sfm.subpixel import refine_model
from pipelines.stage import StageContext
from pipelines.tools.colmap import Reconstructor
from pipelines.tools.colmap_results import SparseModel, best_model, sparse_model
from pipelines.workspace import Workspace

PHASES = ("features", "matching", "mapping")
DEFAULTS = "defaults"
"""COLMAP's own: 3,200 px, 8,192 features, neighbours for video, all pairs for photos."""
OURS = "ours"
GLOBAL = "global"
"""Our features and pairs, mapped by global structure from motion instead of incrementally."""
OVERRIDES: dict[str, dict[str, Any]] = {
    OURS: {},
    "upsample": {"upsample": "on"},
    "coarse": {"upsample": "off"},
    "exhaustive": {"matcher": "exhaustive"},
    "sequential": {"matcher": "sequential"},
    "retrieval": {"matcher": "retrieval"},
    "subpixel": {"subpixel": True},
}
"""Ways that are the product's with other options."""
WAYS = (DEFAULTS, *OVERRIDES, GLOBAL)

_MESSAGES = {
    "features": "features",
    "choosing": "matching",
    "matching": "matching",
    "placing": "mapping",
}
"""First word of the stage's progress message -> phase."""


@dataclass
class Phases:
    """Wall and CPU seconds by phase; a phase ends where the next begins."""

    wall_s: dict[str, float] = field(default_factory=lambda: dict.fromkeys(PHASES, 0.0))
    cpu_s: dict[str, float] = field(default_factory=lambda: dict.fromkeys(PHASES, 0.0))
    _current: str = PHASES[0]
    _since: tuple[float, float] = field(default_factory=lambda: (time.monotonic(), cpu_seconds()))

    def enter(self, phase: str) -> None:
        """From now on, time counts as `phase`."""
        now = (time.monotonic(), cpu_seconds())
        self.wall_s[self._current] += now[0] - self._since[0]
        self.cpu_s[self._current] += now[1] - self._since[1]
        self._current, self._since = phase, now

    def on_progress(self, fraction: float, message: str, eta_s: float | None) -> None:
        """Notice the phase from what the stage says of its progress."""
        del fraction, eta_s
        phase = _MESSAGES.get(message.split(" ")[0], self._current)
        if phase != self._current:
            self.enter(phase)


def cpu_seconds() -> float:
    """CPU time of this process and of the children it has waited for."""
    return sum(os.times()[:4])


def peak_bytes() -> int:
    """The most memory this process had resident, in bytes."""
    status = Path("/proc/self/status")
    if status.is_file():
        found = re.search(r"^VmHWM:\s+(\d+) kB", status.read_text(), re.MULTILINE)
        if found:
            return int(found[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def limited(source: Source, limit: int | None) -> Source:
    """`limit` images of the capture, evenly spread; all where it has no more."""
    num = len(source.files)
    if limit is None or limit >= num:
        return source
    chosen = sorted({round(i * (num - 1) / max(limit - 1, 1)) for i in range(limit)})
    return replace(
        source,
        files=tuple(source.files[i] for i in chosen),
        timestamps_s=tuple(source.timestamps_s[i] for i in chosen),
    )


def our_way(
    source: Source, options: PosesOptions, work: Path, workspace: Workspace, phases: Phases
) -> tuple[SparseModel | None, Reconstructor]:
    """The product's ladder of attempts and its lens, as the poses stage finds them; the lens counts
    as mapping."""
    ctx = StageContext("poses", workspace, work, work, on_progress=phases.on_progress)
    checkpoint = Checkpoint(ctx, source, options)
    reconstructor = Reconstructor(
        checkpoint.database(RUNGS[0].matches.database),
        source.paths,
        work,
        num_threads=options.num_threads,
    )
    model = Ladder(reconstructor, checkpoint, source, options, ctx).climb().chosen.best
    if model is not None:
        model, _ = refine_model(
            reconstructor,
            model,
            source,
            options,
            lambda share: phases.on_progress(0.97 + 0.01 * share, "placing", None),
            options.num_threads if options.num_threads > 0 else num_processors(),
        )
        trials = reconstructor.lens_trials(
            model,
            lambda _: phases.on_progress(0.98, "placing", None),
            refine_principal_point=options.refine_principal_point,
        )
        model, _ = settle_lenses(model, trials, options.camera_model)
    return model, reconstructor


def default_way(source: Source, work: Path, threads: int, phases: Phases) -> SparseModel | None:
    """COLMAP with what it does where nobody says otherwise, on the CPU."""
    links = Reconstructor(work / "colmap.db", source.paths, work)
    extraction = pycolmap.FeatureExtractionOptions()
    matching = pycolmap.FeatureMatchingOptions()
    mapping = pycolmap.IncrementalPipelineOptions()
    extraction.max_image_size = 3200
    extraction.num_threads = matching.num_threads = mapping.num_threads = threads
    mode = pycolmap.CameraMode.SINGLE if source.is_video else pycolmap.CameraMode.AUTO
    pycolmap.extract_features(
        links.database, links.links, camera_mode=mode, extraction_options=extraction
    )
    phases.enter("matching")
    match = pycolmap.match_sequential if source.is_video else pycolmap.match_exhaustive
    match(links.database, matching_options=matching)
    phases.enter("mapping")
    output = work / "models"
    output.mkdir()
    found = pycolmap.incremental_mapping(links.database, links.links, output, options=mapping)
    return best_model([sparse_model(model) for model in found.values()])


def global_way(reconstructor: Reconstructor, threads: int, phases: Phases) -> SparseModel | None:
    """Global mapping of the matches that are in the database."""
    database, output = reconstructor.scratch / "global.db", reconstructor.scratch / "global"
    shutil.copyfile(reconstructor.database, database)
    output.mkdir()
    options = pycolmap.GlobalPipelineOptions()
    options.num_threads = options.mapper.num_threads = threads
    options.random_seed = options.mapper.random_seed = 0
    phases.enter("mapping")
    # What the ladder's own mapping took is another way's.
    phases.wall_s["mapping"] = phases.cpu_s["mapping"] = 0.0
    pycolmap.calibrate_view_graph(database)
    found = pycolmap.global_mapping(database, reconstructor.links, output, options=options)
    return best_model([sparse_model(m) for m in found.values() if m.num_reg_images() > 1])


def measure(job: Path, way: str, preset: str, threads: int, limit: int | None) -> dict[str, Any]:
    """Find the poses of a job folder in one way. Returns plain data; poses are OpenGL's."""
    workspace = Workspace(job)
    source = limited(read_source(workspace), limit)
    values = {**resolve_options(preset, {})["poses"], "num_threads": threads}
    options = PosesOptions(**{**values, **OVERRIDES.get(way, {})})
    phases = Phases()
    with tempfile.TemporaryDirectory(prefix="poses-speed-") as folder:
        work = Path(folder)
        if way == DEFAULTS:
            model = default_way(source, work, threads, phases)
        else:
            model, reconstructor = our_way(source, options, work, workspace, phases)
        if way == GLOBAL:
            model = global_way(reconstructor, threads, phases)
        phases.enter("mapping")
    return {
        "num_images": len(source.files),
        "wall_s": sum(phases.wall_s.values()),
        "cpu_s": sum(phases.cpu_s.values()),
        "peak_bytes": peak_bytes(),
        "phases_wall_s": phases.wall_s,
        "phases_cpu_s": phases.cpu_s,
        **described(model, source),
    }


def described(model: SparseModel | None, source: Source) -> dict[str, Any]:
    """What a model holds, as plain data; of none, zeros."""
    if model is None:
        return {"num_registered": 0, "error_px": None, "track_length": None, "poses": []}
    poses = opengl_from_opencv(model.world_from_camera)
    return {
        "num_registered": len(model.indices),
        "error_px": model.error_px,
        "track_length": float(np.mean(model.track_lengths)),
        "poses": [
            {
                "file": source.files[index],
                "timestamp_s": source.timestamps_s[index],
                "world_from_camera": pose.tolist(),
            }
            for index, pose in zip(model.indices, poses, strict=True)
        ],
    }


def main() -> None:
    """JOB WAY PRESET THREADS LIMIT, all given by the parent; LIMIT 0 for none."""
    job, way, preset, threads, limit = sys.argv[1:]
    print(json.dumps(measure(Path(job), way, preset, int(threads), int(limit) or None)))


if __name__ == "__main__":
    main()
