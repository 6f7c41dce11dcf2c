"""What a mesh loses by fewer triangles, and what a picture on it is worth, on finished jobs.

    python -m tests.benchmarks.delivered JOB... [--scene NAME] [--frames 120] [--long-side 960]
        [--triangles 100000] [--texture-px 4096] [--json out/delivered.json]

JOB is the folder of a finished job, which is only read. Its `mesh.ply` is reduced and painted as
the export `mesh` does it, written as GLB, read back and cast at all held-out cameras as the stage
`assess` does, each half of a photo in the light that the other tells, at the size at which
`evaluate` judged the model: PSNR on covered pixels, beside the model's own on whole pictures.
Vertex colours are those of the trained field. With `--scene`, the analytic scene that all the jobs
were filmed from (`--frames`, `--long-side`, as of `geometry`), the F-score at 1 and 2 % of its size
too, and the mean error of the colours (0 to 1) of what lies within 1 % of the true surface, against
the scene's own there: of all of it, and of where the true surface was in some camera's sight.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from pipelines.exports.formats.glb import read_mesh, write_mesh
from pipelines.exports.formats.ply import read_ply
from pipelines.exports.mesh import TexturedMesh, TriangleMesh
from pipelines.exports.reduction import reduced
from pipelines.exports.texture.bake import texture_from_photos
from pipelines.exports.texture.field import pixels_on, seen_from, texture_from_field
from pipelines.exports.texture.photos import Photos
from pipelines.judging.asset_scores import mean_scores, score_view
from pipelines.judging.asset_views import MeshCaster, Texture
from pipelines.options import AssessOptions
from pipelines.sample.film import LONG_SIDE_PX, NUM_FRAMES, phone_camera, walk
from pipelines.sample.judge import judge_poses, judge_surface
from pipelines.sample.scene import Scene, in_sight, raycast, surface_distance
from pipelines.sample.scenes.catalogue import TAKES
from pipelines.scene.cameras_file import CamerasFile
from pipelines.scene.orientation import Similarity
from pipelines.scene.trained_scene import TrainedScene
from pipelines.stages.assess import load_views
from pipelines.workspace import Workspace
from tests.benchmarks.machine import describe, heading
from tests.benchmarks.tables import markdown_table, number, write_json

HEADER = (
    "job",
    "mesh",
    "triangles",
    "MB",
    "F 1 %",
    "F 2 %",
    "colour error",
    "in sight",
    "covered",
    "mesh dB",
    "model dB",
    "s",
)
_SAMPLES = 2
_COLORED_POINTS = 40_000
_NEAR_SURFACE = 0.01


@dataclass
class Row:
    """f_1, f_2: F-score at 1 and 2 %; color_error: in [0, 1], and that of what was in sight; None
    where no truth is known. wall_s: to make it."""

    job: str
    mesh: str
    num_faces: int
    num_bytes: int
    f_1: float | None
    f_2: float | None
    color_error: float | None
    color_error_in_sight: float | None
    coverage: float | None
    mesh_db: float | None
    model_db: float
    wall_s: float


def delivered(job: Workspace) -> TriangleMesh:
    """The job's own mesh."""
    found = read_ply(job.stage("mesh") / "mesh.ply")
    if found.colors is None or found.normals is None:
        raise ValueError(f"{job.root} has no mesh.ply with colours and normals")
    return TriangleMesh(
        found.points.astype(np.float64),
        found.faces,
        found.colors.astype(np.float64) / 255.0,
        found.normals.astype(np.float64),
    )


def kinds_of(
    job: Workspace, mesh: TriangleMesh, triangles: int, texture_px: int
) -> Iterator[tuple[str, TriangleMesh | TexturedMesh]]:
    """The mesh as it is, with fewer triangles, and painted from either source, each with a name."""
    cameras = CamerasFile.load(job.stage("train") / "cameras.json")
    shown = [image for image in cameras.images if image.split == "train"]
    lenses = [cameras.cameras[image.camera] for image in shown]
    photos = Photos(job.images_root, shown, lenses)
    scene = TrainedScene.load(job.stage("train") / "model.zip")

    def from_field(shape: TriangleMesh) -> TexturedMesh:
        pixel = pixels_on(shape, shown, lenses, scene.trained_long_side_px)
        toward = seen_from(shape, photos)
        return texture_from_field(shape, scene.short_rays, pixel, toward, texture_px)

    yield "full, vertex colours", mesh
    yield "full, photos", texture_from_photos(mesh, photos, texture_px)
    yield "full, field", from_field(mesh)
    few = reduced(mesh, triangles)
    yield f"{triangles:,}, vertex colours", few
    yield f"{triangles:,}, photos", texture_from_photos(few, photos, texture_px)
    yield f"{triangles:,}, field", from_field(few)
    tenth = reduced(mesh, len(mesh.faces) // 10)
    yield "a tenth, vertex colours", tenth
    yield "a tenth, photos", texture_from_photos(tenth, photos, texture_px)
    yield "a tenth, field", from_field(tenth)


def colors_off(
    mesh: TriangleMesh | TexturedMesh,
    alignment: Similarity,
    scene: Scene,
    truth: CamerasFile,
    seed: int = 0,
) -> tuple[float, float]:
    """The mean error of a mesh's colours, evenly by area, where it lies near the true surface; and
    the same of where the true cameras saw that.

    The scene's colour is what is met on the way inwards from just outside.
    """
    vertices = alignment.apply_to_points(mesh.vertices)
    inside = scene.subject.contains(vertices)
    faces = mesh.faces[inside[mesh.faces].all(axis=1)]
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(across, axis=1)
    random = np.random.default_rng(seed)
    which = random.choice(len(faces), _COLORED_POINTS, p=area / area.sum())
    weights = random.dirichlet(np.ones(3), len(which))
    points = np.einsum("nc,ncd->nd", weights, corners[which])
    out = across[which] / area[which, None]
    values = mesh.uv if isinstance(mesh, TexturedMesh) else mesh.colors
    found = np.einsum("nc,ncd->nd", weights, values[faces[which]])
    if isinstance(mesh, TexturedMesh):
        found = Texture(mesh.uv, mesh.texture).colors(found, np.ones(len(found)))
    near = _NEAR_SURFACE * scene.subject.size
    starts = points + 1.5 * near * out
    kept = (surface_distance(points, scene) <= near) & scene.room.contains(starts)
    hits = raycast(starts[kept], -out[kept], scene)
    met = hits.t <= 3.0 * near
    off = np.abs(found[kept] - np.clip(hits.color, 0.0, 1.0))[met]
    true_points = starts[kept][met] - hits.t[met, None] * out[kept][met]
    seen = in_sight(true_points, truth, scene)
    return float(off.mean()), float(off[seen].mean())


def rows_of(job: Workspace, name: str, given: argparse.Namespace) -> Iterator[Row]:
    """A row for each kind of mesh of a job."""
    metrics = json.loads((job.stage("report") / "report.json").read_text("utf-8"))["metrics"]
    side = max(metrics["width"], metrics["height"])
    views = load_views(job, AssessOptions(num_views=0, long_side_px=side))
    cameras = CamerasFile.load(job.stage("train") / "cameras.json")
    made = kinds_of(job, delivered(job), given.triangles, given.texture_px)
    known: dict[int, tuple[float, float]] = {}
    if given.scene:
        take = TAKES[given.scene]
        truth = walk(given.frames, phone_camera(given.long_side), take=take)
        alignment = judge_poses(cameras, truth).alignment
    while True:
        begun = time.monotonic()
        kind = next(made, None)
        if kind is None:
            return
        label, mesh = kind
        wall_s = time.monotonic() - begun
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "mesh.glb"
            write_mesh(path, mesh)
            num_bytes, mesh = path.stat().st_size, read_mesh(path)
        vertices = views.frame.scene_from_world(mesh.vertices)
        caster = (
            MeshCaster(vertices, mesh.faces, Texture(mesh.uv, mesh.texture))
            if isinstance(mesh, TexturedMesh)
            else MeshCaster(vertices, mesh.faces, mesh.colors)
        )
        scores = mean_scores(
            [
                score_view(
                    views.lit(caster.view(views.cameras, index, _SAMPLES), index),
                    views.photo(index),
                    views.valid(index),
                )
                for index in range(len(views.posed))
            ]
        )
        if given.scene and len(mesh.faces) not in known:
            surface = judge_surface(mesh.vertices, mesh.faces, alignment, truth, take.scene)
            known[len(mesh.faces)] = (surface.f_score[0.01], surface.f_score[0.02])
        color_error = in_sight_error = None
        if given.scene:
            color_error, in_sight_error = colors_off(mesh, alignment, take.scene, truth)
        f_1, f_2 = known.get(len(mesh.faces), (None, None))
        coverage, mesh_db = scores["coverage"], scores["psnr"]
        yield Row(
            name,
            label,
            len(mesh.faces),
            num_bytes,
            f_1,
            f_2,
            color_error,
            in_sight_error,
            coverage,
            mesh_db,
            metrics["psnr"],
            wall_s,
        )


def cells_of(row: Row) -> list[str]:
    """A line of the table."""
    return [
        row.job,
        row.mesh,
        f"{row.num_faces:,}",
        number(row.num_bytes / 1e6, 1),
        number(row.f_1, 4),
        number(row.f_2, 4),
        number(row.color_error, 4),
        number(row.color_error_in_sight, 4),
        number(row.coverage, 3),
        number(row.mesh_db),
        number(row.model_db),
        number(row.wall_s, 0),
    ]


def main() -> None:
    """Measure all jobs and print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("jobs", nargs="+", type=Path, metavar="JOB")
    parser.add_argument("--scene", choices=sorted(TAKES))
    parser.add_argument("--frames", type=int, default=NUM_FRAMES)
    parser.add_argument("--long-side", type=int, default=LONG_SIDE_PX)
    parser.add_argument("--triangles", type=int, default=100_000)
    parser.add_argument("--texture-px", type=int, default=4096)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    machine = describe()
    print(heading(machine))
    rows = []
    for folder in given.jobs:
        for row in rows_of(Workspace(folder.resolve()), folder.resolve().parent.name, given):
            rows.append(row)
            print(json.dumps(asdict(row)), flush=True)
    print("\n" + markdown_table(HEADER, [cells_of(row) for row in rows]))
    write_json(given.json, {"machine": machine, "rows": [asdict(row) for row in rows]})


if __name__ == "__main__":
    main()
