"""What a job knows of its capture, picture by picture, however far it got.

Read from what the stages left: `frames.json` (times, speed, exposure), `capture.json`, the report
of `poses` (features, matches, groups; also that of one that failed), `cameras.json` and the sparse
points. Every part may be missing.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import numpy.typing as npt

from pipelines.captures.archive_rules import shown
from pipelines.captures.record import CAPTURE_JSON, CaptureRecord
from pipelines.exports.formats.ply import read_ply
from pipelines.filming.looks import Look, look_at
from pipelines.scene.cameras_file import CamerasFile
from pipelines.stage import REPORT
from pipelines.workspace import Workspace

Floats = npt.NDArray[np.float64]

MIN_FEATURES = 100
"""A picture with fewer features cannot be placed (as in `pipelines.sfm.report`)."""
MIN_MATCHES = 30
"""Matches with its best partner below which a picture is rarely placed."""


@dataclass(frozen=True)
class Shot:
    """One picture. Times in seconds of the film. None is: not known, or not looked for.

    name: what its sender called it, empty for a frame. clip: number of its clip, in a film.
    views: of a panorama the pictures cut from it, which are what has poses.
    is_placed: whether it has a pose. group: which model holds it where it hangs together with
    others, 0 for the one that was taken. num_features, best_inliers: as matching counted them.
    speed: long sides of the picture per second. gain_ev: exposure in stops since the clip's first
    frame.
    """

    file: str
    name: str = ""
    time_s: float | None = None
    look: Look | None = None
    is_placed: bool | None = None
    group: int | None = None
    num_features: int | None = None
    best_inliers: int | None = None
    speed: float | None = None
    gain_ev: float | None = None
    clip: int = 0
    views: tuple[str, ...] = ()


@dataclass(frozen=True)
class Clip:
    """One of several clips. name: what its sender called it. offset_s: where its own times begin in
    those of the capture, length_s long. is_apart: whether hardly any of its frames is placed with
    those of other clips, None where nobody looked. most_shared: details that one of its frames
    shares with a frame of another clip.
    """

    name: str
    offset_s: float
    length_s: float
    is_apart: bool | None = None
    most_shared: int | None = None


DOUBTS = ("path_torn", "poses_contradicted", "sides_alike", "lenses_unsettled")
"""Codes of warnings that a whole model of poses is doubted by, or that it has one side only."""


@dataclass(frozen=True)
class Take:
    """A capture as far as it is known.

    shots: in order of the capture. is_film: whether neighbours are neighbours in time.
    duration_s: of the film. poses: [N, 3, 4] world_from_camera, OpenGL axes, of the pictures
    `posed` (indices into shots). points: [P, 3], colors: [P, 3] uint8. angle_deg: the median angle
    between the directions that the same point is seen from. is_metric: whether a unit is a metre;
    None where nobody said. given: of poses that came along, how well they fit the pictures
    (`pipelines.sfm.given_report`), with `warnings`. doubts: warnings that poses which were found
    are wrong as a whole, or not the whole (`DOUBTS`). error: what ended the job, `{stage, code,
    message, hint, details}`. clips: of a film in several, by their numbers; none of one in one.
    """

    kind: str = ""
    filename: str = ""
    shots: tuple[Shot, ...] = ()
    is_film: bool = False
    duration_s: float | None = None
    poses: Floats = field(default_factory=lambda: np.zeros((0, 3, 4)))
    posed: tuple[int, ...] = ()
    points: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    colors: npt.NDArray[np.uint8] = field(default_factory=lambda: np.zeros((0, 3), np.uint8))
    angle_deg: float | None = None
    is_metric: bool | None = None
    given: Mapping[str, Any] | None = None
    doubts: tuple[Mapping[str, Any], ...] = ()
    error: Mapping[str, Any] | None = None
    clips: tuple[Clip, ...] = ()

    def clip_of(self, index: int) -> Clip | None:
        """The clip that a picture is of, where there are several."""
        number = self.shots[index].clip
        return self.clips[number] if number < len(self.clips) else None

    @property
    def was_sought(self) -> bool:
        """Whether poses were looked for, with whatever result."""
        return any(shot.is_placed is not None for shot in self.shots)

    @property
    def num_placed(self) -> int:
        """Pictures with a pose."""
        return sum(shot.is_placed is True for shot in self.shots)


def read_take(
    workspace: Workspace,
    error: Mapping[str, Any] | None = None,
    on_picture: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[Take, list[Path]]:
    """What is known of a job's capture, its pictures looked at, and where the pictures lie.

    error: of the stage that failed, as `Take.error`. on_picture: called with the number of
    pictures looked at, and of all.
    """
    take = _listed(workspace)
    take = replace(take, error=error)
    take = _with_poses(take, workspace)
    paths = [workspace.images_root / shot.file for shot in take.shots]
    shots = []
    for index, (shot, path) in enumerate(zip(take.shots, paths, strict=True)):
        on_picture(index, len(paths))
        shots.append(replace(shot, look=_looked(path)))
    return replace(take, shots=tuple(shots)), paths


def _looked(path: Path) -> Look | None:
    try:
        return look_at(path)[0]
    except OSError:  # a picture that is gone says nothing; the stages judge that
        return None


def _listed(workspace: Workspace) -> Take:
    """The capture's pictures, in order, from what ingest and frames wrote."""
    if not (workspace.stage("ingest") / CAPTURE_JSON).is_file():
        job = _json(workspace.job_file) or {}
        return Take(kind=str(job.get("kind", "")), filename=str(job.get("filename", "")))
    record = CaptureRecord.load(workspace.stage("ingest"))
    take = Take(
        kind=record.kind,
        filename=record.filename,
        is_film=record.video is not None,
        duration_s=float(record.video["duration_s"]) if record.video else None,
    )
    if record.video is None:
        shots = [
            Shot(
                str(image["file"]),
                PurePosixPath(str(image.get("source", ""))).name,
                views=tuple(image.get("views", ())),
            )
            for image in record.images
        ]
        return replace(take, shots=tuple(shots))
    film = _json(workspace.stage("frames") / "frames.json") or {}
    rows, clips = film.get("frames", []), film.get("clips", [])
    return replace(
        take,
        clips=tuple(
            Clip(shown(str(clip["name"])), float(clip["offset_s"]), float(clip["duration_s"]))
            for clip in (clips if len(clips) > 1 else [])
        ),
        shots=tuple(
            Shot(
                str(row["file"]),
                time_s=row.get("timestamp_s"),
                speed=row.get("speed"),
                gain_ev=row.get("gain_ev"),
                clip=int(row.get("clip", 0)),
                views=tuple(row.get("views", ())),
            )
            for row in rows
        ),
    )


def _with_poses(take: Take, workspace: Workspace) -> Take:
    """With what is known of where each picture was taken."""
    failed = _json(workspace.failed("poses") / REPORT)
    report = failed if failed is not None else _json(workspace.stage("poses") / REPORT)
    if report is not None and "images" in report:
        take = _matched(take, report["images"])
        take = _joined(take, report.get("clips", []))
        take = replace(
            take,
            angle_deg=report.get("median_triangulation_angle_deg"),
            is_metric=report.get("metric"),
        )
    if report is not None:
        told = report.get("warnings", [])
        take = replace(take, doubts=tuple(one for one in told if one["code"] in DOUBTS))
    if report is not None and "given" in report:
        of_given = [one for one in told if one["code"].startswith("given_")]
        take = replace(take, given={**report["given"], "warnings": of_given})
    if failed is not None:
        return _partly_placed(take, failed.get("placed"))
    if not workspace.posed_cameras.is_file():
        return take
    cameras = CamerasFile.load(workspace.posed_cameras)
    take = _placed(
        take,
        [image.file for image in cameras.images],
        np.array([image.world_from_camera for image in cameras.images]).reshape(-1, 3, 4),
    )
    take = replace(take, is_metric=cameras.metric)
    if workspace.sparse_points.is_file():
        sparse = read_ply(workspace.sparse_points)
        colors = np.full((len(sparse.points), 3), 128, np.uint8)
        take = replace(
            take,
            points=sparse.points.astype(np.float64),
            colors=colors if sparse.colors is None else sparse.colors,
        )
    return take


def _matched(take: Take, rows: list[dict[str, Any]]) -> Take:
    """With what matching found of each picture; those it was not asked for stay unknown."""
    found = {row["file"]: row for row in rows}
    shots = [
        replace(
            shot,
            is_placed=found[shot.file]["group"] == 0,
            group=found[shot.file]["group"],
            num_features=found[shot.file]["num_features"],
            best_inliers=found[shot.file]["best_inliers"],
        )
        if shot.file in found
        else shot
        for shot in take.shots
    ]
    return replace(take, shots=tuple(shots))


def _joined(take: Take, rows: list[dict[str, Any]]) -> Take:
    """With what became of each clip that gave frames; the rows are in their order."""
    used = sorted({shot.clip for shot in take.shots})
    if not take.clips or len(rows) != len(used):
        return take
    clips = list(take.clips)
    for number, row in zip(used, rows, strict=True):
        known = {key: row[key] for key in ("is_apart", "most_shared")}
        clips[number] = replace(clips[number], **known)
    return replace(take, clips=tuple(clips))


def _partly_placed(take: Take, placed: dict[str, Any] | None) -> Take:
    """With the poses that a stage found before it gave up, for a look at them."""
    if not placed:
        return take
    take = _placed(take, placed["files"], np.array(placed["poses"]).reshape(-1, 3, 4))
    return replace(
        take,
        points=np.array(placed["points"], np.float64).reshape(-1, 3),
        colors=np.array(placed["colors"], np.uint8).reshape(-1, 3),
    )


def _placed(take: Take, files: list[str], poses: Floats) -> Take:
    """With those poses: the pictures that have one are placed, the others are not."""
    rows = {file: row for row, file in enumerate(files)}
    row_of = [
        next((rows[name] for name in (shot.file, *shot.views) if name in rows), None)
        for shot in take.shots
    ]
    shots = tuple(
        replace(shot, is_placed=row is not None)
        for shot, row in zip(take.shots, row_of, strict=True)
    )
    posed = tuple(index for index, row in enumerate(row_of) if row is not None)
    kept = [row for row in row_of if row is not None]
    return replace(take, shots=shots, poses=poses[kept], posed=posed)


def _json(path: Path) -> dict[str, Any] | None:
    """A JSON object, or None where there is no such file."""
    if not path.is_file():
        return None
    loaded: dict[str, Any] = json.loads(path.read_text("utf-8"))
    return loaded
