"""The video: a flight along a path of the catalogue, as colours, depth, normals or accumulation.

Colours are drawn from the trained scene and the job's mesh together, where that has the photos on
it (`pipelines.exports.mixing`): finer than the scene alone, and in less time. H.264 for any
browser, HEVC, AV1, or a zip of PNG files; through a perspective lens, a fisheye, or all round.
`preview.jpg` is a telling moment of the flight at up to twice the video's size.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field, field_validator

from pipelines.exports.export import Export
from pipelines.exports.flight_options import FlightOptions
from pipelines.exports.paths.options import MAX_SIDE_PX
from pipelines.stage import Artifact, StageContext

if TYPE_CHECKING:
    from pipelines.exports.shots import MixedStudio
    from pipelines.scene.cameras_file import Intrinsics
    from pipelines.scene.trained_scene import TrainedScene

Output = Literal["rgb", "depth", "normals", "accumulation"]

_PREVIEW_ENLARGEMENT = 2
_PREVIEW_QUALITY = 93


class VideoOptions(FlightOptions):
    """The video along a camera path."""

    outputs: tuple[Output, ...] = Field(
        ("rgb",),
        min_length=1,
        max_length=4,
        description="What is shown: rgb, depth, normals, accumulation.",
    )
    layout: Literal["separate", "side_by_side"] = Field(
        "separate",
        description="separate writes video.mp4 with rgb and video-<output>.mp4 with each other "
        "one; side_by_side all of them into video.mp4.",
    )

    mesh_detail: bool = Field(
        True,
        description="Draws the colours from the trained scene and the job's textured mesh, as far "
        "as they agree: sharper, clearer where few photos leave fog, and faster. A job without "
        "such a mesh has the scene alone, rendered at the size of the pictures that it was trained "
        "on and enlarged. Off is the scene alone, rendered at the video's size.",
    )
    field_px: int | None = Field(
        None,
        ge=16,
        le=MAX_SIDE_PX,
        description="With the mesh: long side at which the trained scene is rendered, no larger "
        "than the video's; null for that of the pictures that it was trained on. Through a fisheye "
        "or all round it has as many pixels for each degree as a picture of the capture so large.",
    )

    @field_validator("outputs")
    @classmethod
    def _each_once(cls, outputs: tuple[Output, ...]) -> tuple[Output, ...]:
        return tuple(dict.fromkeys(outputs))

    def num_side_by_side(self) -> int:
        """How many outputs one picture holds."""
        return len(self.outputs) if self.layout == "side_by_side" else 1


def run(scene: TrainedScene, options: VideoOptions, ctx: StageContext) -> dict[str, Any]:
    """Render the flight. Raises ToolError where ffmpeg fails, ExportError as the path does."""
    # Imported where it runs: the API reads this file too.
    from PIL import Image

    from pipelines.exports.filming import Film, make_film
    from pipelines.exports.paths.flight import (
        filmed_path,
        held_upright,
        preview_index,
        typical_lens,
    )
    from pipelines.exports.shots import Lens
    from pipelines.scene.depth_views import Pinhole

    lenses = [scene.lens_of(image) for image in scene.cameras.images]
    images, own = held_upright(scene.cameras.images, typical_lens(lenses))
    flight = filmed_path(options, images, ctx.workspace.stage("mesh"))
    lens = Lens(options, own, flight)
    together = options.layout == "side_by_side"
    names: tuple[str, ...] = ("rgb",) if together else options.outputs
    film = Film(
        options,
        options.outputs,
        files={name: "video.mp4" if name == "rgb" else f"video-{name}.mp4" for name in names},
        pictures="video-frames.zip",
        together=together,
    )
    studio = _studio(scene, own, options, ctx)
    drawn = {} if studio is None else {"rgb": studio.picture}
    make_film(scene, film, flight, lens, ctx, drawn)
    ctx.progress(len(flight) / (len(flight) + 4), "preview picture")
    moment = preview_index(flight.poses, images)
    shown = (
        lens.plain(moment)
        if options.camera_type() == "perspective"
        else Pinhole.of(own, max(lens.size))
    )
    long_side = min(_PREVIEW_ENLARGEMENT * max(lens.size), max(own.width, own.height, *lens.size))
    shown, pose = Pinhole.of(shown.intrinsics(), long_side), flight.poses[moment]
    if studio is None:
        picture = scene.picture(shown, pose)
    else:
        picture = studio.rendered_at(scene.trained_long_side_px).picture(shown, pose)
    Image.fromarray(picture).save(ctx.out / "preview.jpg", quality=_PREVIEW_QUALITY)
    with_mesh = studio is not None and studio.has_mesh
    return {**film.told(flight, lens, ctx.out), "mesh_detail": with_mesh}


def _studio(
    scene: TrainedScene, own: Intrinsics, options: VideoOptions, ctx: StageContext
) -> MixedStudio | None:
    """What draws scene and mesh together; None where only the scene is asked for, or no colours."""
    from pipelines.exports.formats.glb import read_mesh
    from pipelines.exports.judged import mesh_of
    from pipelines.exports.mesh import TexturedMesh
    from pipelines.exports.shots import MeshStudio, MixedStudio

    if not options.mesh_detail or "rgb" not in options.outputs:
        return None
    trained_px, path = scene.trained_long_side_px, mesh_of(ctx.workspace.stage("mesh"))
    ctx.progress(0.0, "reading the mesh")
    mesh = read_mesh(path) if path.is_file() else None
    if not isinstance(mesh, TexturedMesh):
        return MixedStudio(scene, None, trained_px, own)
    return MixedStudio(scene, MeshStudio(mesh), options.field_px or trained_px, own)


_PLAYER = "any browser or player"

EXPORT = Export(
    kind="video",
    version=10,
    reads=("mesh",),
    run=run,
    options=VideoOptions,
    artifacts=(
        Artifact("video.mp4", "video.mp4", "video/mp4", _PLAYER),
        Artifact("video-depth.mp4", "video-depth.mp4", "video/mp4", _PLAYER, on_request=True),
        Artifact("video-normals.mp4", "video-normals.mp4", "video/mp4", _PLAYER, on_request=True),
        Artifact(
            "video-accumulation.mp4",
            "video-accumulation.mp4",
            "video/mp4",
            _PLAYER,
            on_request=True,
        ),
        Artifact(
            "video-frames.zip",
            "video-frames.zip",
            "application/zip",
            "unpacked: video editors",
            on_request=True,
        ),
        Artifact("preview.jpg", "preview.jpg", "image/jpeg", "any picture viewer"),
    ),
)
