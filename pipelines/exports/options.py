"""Options that exports have in common. Light: the API reads them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from pipelines.exports.frame import FrameName
from pipelines.exports.wishes import with_its_shape, without_what_is_overridden
from pipelines.nerf.options.render import RenderConfig
from pipelines.nerf.options.train import config_from_dict
from pipelines.option_models import StageOptions, model_of

if TYPE_CHECKING:
    RenderOptions = StageOptions
else:
    RenderOptions = model_of(RenderConfig)


class RenderingOptions(StageOptions):
    """Common to the exports that render."""

    render: RenderOptions = Field(
        default_factory=lambda: RenderOptions(), description="What rendering leaves out."
    )


class FrameOptions(StageOptions):
    """Where an export lies."""

    frame: FrameName = Field(
        "gravity",
        description="gravity is the world of cameras.json: up is up, in metres where it is metric; "
        "source that of the capture's own poses, where it brought some; normalised has the origin "
        "where the cameras look and the largest coordinate of a camera at 1.",
    )


class ExtentOptions(StageOptions):
    """What part of the scene is exported."""

    extent: Literal["auto", "subject", "scene"] = Field(
        "auto",
        description="scene is all that lies within far_distance, more coarsely beyond "
        "max_distance. subject is the thing that was walked round with what it stands on; else "
        "what stands where the cameras look, or, with a warning, what lies within max_distance. "
        "auto is scene.",
    )
    max_distance: float = Field(
        2.0,
        gt=0,
        le=1000,
        description="Up to where surfaces are as fine as asked for, from the cameras' focus, in "
        "units of the cameras' mean distance to it.",
    )
    far_distance: float = Field(
        18.0,
        gt=0,
        le=10_000,
        description="Farthest surface of the scene that is kept, in the same unit.",
    )


class TextureOptions(StageOptions):
    """What a mesh is coloured with."""

    texture: Literal["photos", "field", "none"] = Field(
        "photos",
        description="photos puts a picture on the mesh, made of the training photos; field one of "
        "what short rays through its surface show of the trained scene, which has neither seams "
        "nor anything that moved, and less detail; none leaves it its vertices' colours.",
    )
    texture_px: Literal[512, 1024, 2048, 4096, 8192] = Field(
        4096,
        description="Largest side of that picture; it is no larger than the photos need, or the "
        "field, which knows no more than the pixels that it was trained on.",
    )
    refine_texture: bool = Field(
        True,
        description="Moves the colours of texture=photos towards what all photos that see a place "
        "show of it, but for the finest detail. Off, each face has one photo's, sharp and a "
        "little off in the others.",
    )


_World = Annotated[float, Field(ge=-1e8, le=1e8)]
_Side = Annotated[float, Field(gt=0, le=1e6)]
_Degrees = Annotated[float, Field(ge=-360, le=360)]


class CropShapeOptions(StageOptions):
    """A part of the scene, in the frame of the export."""

    shape: Literal["none", "box", "sphere", "auto"] = Field(
        "none",
        description="What is kept. auto is the box of the thing that was walked round, with what "
        "it stands on; where there is no such thing all is kept, with a warning. The report says "
        "which box it was.",
    )
    center: tuple[_World, _World, _World] = Field(
        (0.0, 0.0, 0.0), description="Its middle, x, y and z. Unit: the frame's."
    )
    size: tuple[_Side, _Side, _Side] = Field(
        (1.0, 1.0, 1.0), description="Sides of the box, along its own axes. Unit: the frame's."
    )
    rotation_deg: tuple[_Degrees, _Degrees, _Degrees] = Field(
        (0.0, 0.0, 0.0),
        description="Turns of the box about the frame's x axis, then y, then z, counter-clockwise. "
        "Unit: degrees.",
    )
    radius: float = Field(1.0, gt=0, le=1e6, description="Of the sphere. Unit: the frame's.")


class CropOptions(RenderingOptions, ExtentOptions, FrameOptions):
    """Common to mesh and point cloud."""

    crop: CropShapeOptions = Field(
        default_factory=lambda: CropShapeOptions(),
        description="What is kept of the extent; outside of it there is nothing.",
    )

    use_depth_maps: Literal["auto", "on", "off"] = Field(
        "auto",
        description="Let the depth maps of the stage depth vote on surfaces beside the trained "
        "field. auto does so where a sensor measured some of them, or they are fewer than 40.",
    )

    @classmethod
    def understood(
        cls, base: dict[str, Any], given: dict[str, Any]
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """As in StageOptions: numbers of a crop tell its shape; the crop or the extent that is
        asked for is what counts."""
        base, given = super().understood(base, given)
        if isinstance(given.get("crop"), dict):
            given = {**given, "crop": with_its_shape(base.get("crop", {}), given["crop"])}
        return without_what_is_overridden(base, given, cls.model_fields["extent"].default), given


def reach_of(options: ExtentOptions) -> float:
    """How far the farthest surface that is kept may be, in the cameras' mean distances."""
    if options.extent == "subject":
        return options.max_distance
    return max(options.max_distance, options.far_distance)


def render_config(options: RenderingOptions) -> RenderConfig:
    """What the renderer understands, from checked options."""
    config: RenderConfig = config_from_dict(RenderConfig, options.render.model_dump())
    return config
