"""A flight around the mesh as it was delivered, alone or beside what the trained scene shows.

The mesh is read back from `mesh.glb` and cast from each frame's camera, texture and all: what is
seen is what people download. Made where a job has options for it, be they none.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field, field_validator

from pipelines.errors import ExportError
from pipelines.exports.export import Export
from pipelines.exports.flight_options import FlightOptions
from pipelines.stage import Artifact, StageContext

if TYPE_CHECKING:
    from pipelines.scene.trained_scene import TrainedScene

Output = Literal["mesh", "rgb", "depth", "normals", "accumulation"]


class MeshVideoOptions(FlightOptions):
    """The video of the delivered mesh along a camera path."""

    outputs: tuple[Output, ...] = Field(
        ("mesh",),
        min_length=1,
        max_length=5,
        description="What is shown, side by side from left to right: mesh, and of the trained "
        "scene rgb, depth, normals, accumulation.",
    )

    @field_validator("outputs")
    @classmethod
    def _each_once_and_the_mesh(cls, outputs: tuple[Output, ...]) -> tuple[Output, ...]:
        if "mesh" not in outputs:
            raise ValueError("must have mesh among them; video is for the others")
        return tuple(dict.fromkeys(outputs))

    def num_side_by_side(self) -> int:
        """How many outputs one picture holds."""
        return len(self.outputs)


def run(scene: TrainedScene, options: MeshVideoOptions, ctx: StageContext) -> dict[str, Any]:
    """Film the mesh.

    Raises ExportError `no_mesh` where the job has none, and as the path does; ToolError.
    """
    # Imported where it runs: the API reads this file too.
    from pipelines.exports.filming import Film, make_film
    from pipelines.exports.formats.glb import read_mesh
    from pipelines.exports.judged import mesh_of
    from pipelines.exports.paths.flight import filmed_path, held_upright, typical_lens
    from pipelines.exports.shots import Lens, MeshStudio

    path = mesh_of(ctx.workspace.stage("mesh"))
    if not path.is_file():
        raise ExportError(
            "The job has no mesh to film.",
            code="no_mesh",
            hint="Make the mesh first; the kind video films the trained scene itself.",
        )
    ctx.progress(0.0, "reading the mesh")
    studio = MeshStudio(read_mesh(path))
    lenses = [scene.lens_of(image) for image in scene.cameras.images]
    images, own = held_upright(scene.cameras.images, typical_lens(lenses))
    flight = filmed_path(options, images, path.parent)
    lens = Lens(options, own, flight)
    film = Film(
        options,
        options.outputs,
        files={"mesh": "mesh-video.mp4"},
        pictures="mesh-video-frames.zip",
        together=len(options.outputs) > 1,
    )
    make_film(scene, film, flight, lens, ctx, {"mesh": studio.picture})
    return film.told(flight, lens, ctx.out)


EXPORT = Export(
    kind="meshvideo",
    version=6,
    reads=("mesh",),
    run=run,
    options=MeshVideoOptions,
    on_request=True,
    artifacts=(
        Artifact(
            "mesh-video.mp4",
            "mesh-video.mp4",
            "video/mp4",
            "any browser or player",
            on_request=True,
        ),
        Artifact(
            "mesh-video-frames.zip",
            "mesh-video-frames.zip",
            "application/zip",
            "unpacked: video editors",
            on_request=True,
        ),
    ),
)
