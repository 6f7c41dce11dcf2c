"""Every path inside a job's folder.

JOB/
  input/capture             the uploaded bytes, as they came
  job.json                  filename, kind, seed: what the stages may know of the job
  ingest/                   capture.json, images/ (photos and app exports), cameras.json (posed),
                            points.ply (posed, where sparse points came along), panoramas/ (of
                            the whole sphere: their views are in images/)
  frames/                   frames.json, images/, panoramas/ (only for videos)
  poses/                    cameras.json, report.json, points.ply (posed captures: where there are
                            points)
  depth/                    maps.json, maps/, depth.jpg, report.json
  draft/                    draft.glb, draft.jpg
  train/                    model.zip, cameras.json, previews/
  evaluate/                 metrics.json, images/
  <export>/                 what `pipelines.exports.kinds` writes: pointcloud/, mesh/, video/, ...
  assess/                   assets.json, images/
  report/                   report.json; of a job that failed, without a manifest
  <stage>/manifest.json     written last: a folder with a manifest is complete
  .partial/<stage>/         what a running stage writes
  .checkpoint/<stage>/      what outlives a failed attempt
  .temporary/<stage>/       what a running stage's libraries put aside; gone when it ends
  .failed/<stage>/          report.json, where a stage that failed wrote one
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

MANIFEST = "manifest.json"
SPARSE_POINTS = "points.ply"


@dataclass(frozen=True)
class Workspace:
    """The paths of one job below `root`. Creates nothing by itself."""

    root: Path

    @property
    def capture_file(self) -> Path:
        """The uploaded bytes. The name says nothing of the content: sniff it."""
        return self.root / "input" / "capture"

    @property
    def job_file(self) -> Path:
        """JSON with `filename`, `kind` and `seed`."""
        return self.root / "job.json"

    def stage(self, name: str) -> Path:
        """The published folder of a stage."""
        return self.root / name

    def partial(self, name: str) -> Path:
        """Where a running stage writes."""
        return self.root / ".partial" / name

    def checkpoint(self, name: str) -> Path:
        """What outlives a failed attempt of a stage."""
        return self.root / ".checkpoint" / name

    def temporary(self, name: str) -> Path:
        """Where temporary files of a running stage go, in a worker."""
        return self.root / ".temporary" / name

    def failed(self, name: str) -> Path:
        """What a stage that failed left behind to explain it."""
        return self.root / ".failed" / name

    def is_complete(self, name: str) -> bool:
        """Whether the stage's folder was published with its manifest."""
        return (self.stage(name) / MANIFEST).is_file()

    def manifest(self, name: str) -> dict[str, Any]:
        """The manifest of a complete stage. Raises FileNotFoundError where there is none."""
        loaded: dict[str, Any] = json.loads((self.stage(name) / MANIFEST).read_text("utf-8"))
        return loaded

    @property
    def images_root(self) -> Path:
        """The folder that image paths in `cameras.json` and `frames.json` are relative to.

        `frames/` for videos, `ingest/` for photos and app exports.
        """
        return self.stage("frames" if self.is_complete("frames") else "ingest")

    @property
    def brought_poses(self) -> bool:
        """Whether the capture came with poses, be they refined since or not."""
        return (self.stage("ingest") / "cameras.json").is_file()

    @property
    def posed_cameras(self) -> Path:
        """`cameras.json` as it enters training: from `poses`, or where a job has no such stage from
        the capture itself."""
        return self.stage("poses" if self.is_complete("poses") else "ingest") / "cameras.json"

    @property
    def sparse_points(self) -> Path:
        """`points.ply`, in the world of `posed_cameras`; poses may have come without one."""
        return self.posed_cameras.with_name(SPARSE_POINTS)
