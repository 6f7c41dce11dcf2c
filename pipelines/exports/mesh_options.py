"""What a mesh can be asked for. Light: the API reads it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from pydantic import Field, field_validator

from pipelines.exports.frame import Axis
from pipelines.exports.options import CropOptions, TextureOptions

Format = Literal["glb", "ply", "obj", "stl", "usdz"]

LEAST_TRIANGLES = 64
"""Of a whole mesh: with fewer next to nothing is left of what was filmed."""


class MeshOptions(CropOptions, TextureOptions):
    """The mesh, by fusing rendered depth."""

    formats: tuple[Format, ...] = Field(
        ("glb", "ply"),
        min_length=1,
        max_length=5,
        description="Files that are delivered: glb, ply, obj (a zip with its material and "
        "picture), stl, usdz.",
    )
    up_axis: Literal["auto", "z", "y"] = Field(
        "auto",
        description="Which axis is up in ply, obj and stl. auto is what programs take each format "
        "for: y in obj, z in ply and stl; of frame=source all three keep the capture's own axes. "
        "In glb and usdz it is always y.",
    )

    stl_unit: Literal["millimetre", "frame"] = Field(
        "millimetre",
        description="What a unit of stl is, which cannot say it: millimetre is what slicers take "
        "it for, and what stl has where a unit of the frame is a metre; where that length is "
        "unknown, and with frame, stl has the frame's own unit as all other files do.",
    )

    extent: Literal["auto", "subject", "scene"] = Field(
        "auto",
        description="scene is all that lies within far_distance, more coarsely beyond "
        "max_distance. auto is scene, and where somebody walked round a thing also subject.glb: "
        "that thing with what it stands on. subject is that thing alone as the mesh itself; else "
        "what stands where the cameras look, or, with a warning, what lies within max_distance. "
        "A crop overrides it.",
    )

    method: Literal["auto", "tsdf", "poisson", "marching_cubes"] = Field(
        "auto",
        description="How depth becomes a surface: tsdf fuses it in a field of voxels; poisson lays "
        "a smooth surface through the points that views agree on, closes small holes, and takes "
        "longer; where its solver fails, tsdf is what is done. auto is poisson where the cameras "
        "look at one place, and tsdf where they look about, as in a room. "
        "marching_cubes takes the trained density itself at density_level, near what the views "
        "see.",
    )
    density_level: float = Field(
        0.25,
        ge=0.01,
        le=0.99,
        description="Where the surface of method=marching_cubes is: of the light that goes through "
        "a voxel's length there, this share is taken away. Higher is more exact, with more holes.",
    )
    resolution: int = Field(
        256,
        ge=32,
        le=2048,
        description="Voxels along the longest side of what lies within max_distance; fewer where "
        "memory has no room for so many, which the report tells, and where they would be smaller "
        "than a pixel of the rendered depth at max_distance.",
    )
    fine_distance: float = Field(
        1.0,
        ge=0.0,
        le=100.0,
        description="Within so many camera distances of what the cameras look at, voxels are half "
        "as large, if half of what they see is there, and unless a rendered pixel is larger; 0 for "
        "the same everywhere.",
    )
    num_views: int = Field(
        0, ge=0, le=5000, description="Training views fused, evenly picked; 0 for all."
    )
    render_long_side_px: int = Field(
        320, ge=64, le=4096, description="Long side of the rendered depth, in pixels."
    )
    refine: Literal["photos", "none"] = Field(
        "photos",
        description="photos moves the fused surface onto what the training photos agree on, a "
        "fraction of a voxel, leaves out what no two of them show, and moves outlines onto the "
        "photos' edges; none leaves it as fused.",
    )
    flatten: bool = Field(
        True,
        description="Floors, walls and table tops become plane where they are so but for bumps of "
        "a voxel or two, and as far as the photos do not say otherwise; what else is plain becomes "
        "smooth. Part of refine=photos.",
    )
    close_holes: float = Field(
        0.1,
        ge=0.0,
        le=10.0,
        description="Holes with a diameter of so many camera distances, or less, are closed, "
        "beyond max_distance of more as voxels are larger; not those that cameras look through, "
        "nor the border of what was filmed. 0 for none.",
    )
    watertight: bool = Field(
        False,
        description="Closes the mesh all over, so that each edge has two faces, as slicers of 3D "
        "printers want it: the border gets a wall to a flat base. With extent=subject and stl "
        "among the formats that is a thing to print, on its piece of table. It is done last: with "
        "triangles there are a few more.",
    )
    max_faces: int = Field(
        200_000,
        ge=100,
        le=20_000_000,
        description="What lies within fine_distance is simplified to this, what lies within "
        "max_distance too, and what lies beyond to a quarter of it a shell.",
    )
    triangles: int = Field(
        0,
        ge=0,
        le=20_000_000,
        description="Triangles of the whole mesh as it is delivered, 64 or more, 100000 for phones "
        "and the web; 0 for all that max_faces leaves. Open borders stay.",
    )
    lods: int = Field(
        0,
        ge=0,
        le=3,
        description="Levels of detail, glb whatever the formats: mesh-lod1.glb has a quarter of "
        "the mesh's triangles, mesh-lod2.glb a sixteenth, mesh-lod3.glb a sixty-fourth, each with "
        "a texture of half the side.",
    )

    glb_unlit: bool = Field(
        True,
        description="glb shows the captured colours as they are, light and all; off, the viewer's "
        "lamps light them once more.",
    )
    glb_quantized: bool = Field(
        False,
        description="glb with places in 65535 steps of the longest side and half the bytes a "
        "vertex (KHR_mesh_quantization), for three.js and the like; other programs may not know "
        "it.",
    )
    glb_compressed: bool = Field(
        False,
        description="glb quantized, and what is left in about half the bytes once more, without "
        "loss (EXT_meshopt_compression). The viewer needs the decoder for it: three.js and Babylon "
        "have one, to be switched on.",
    )

    glb_texture: Literal["jpeg", "ktx2"] = Field(
        "jpeg",
        description="As what glb has its picture. ktx2 (KHR_texture_basisu) takes a quarter of the "
        "graphics card's memory, or less, and brings its smaller copies along; the file is larger. "
        "three.js and Babylon read it, with a transcoder to be switched on; other programs may not "
        "know it.",
    )

    @classmethod
    def completed(cls, stored: Mapping[str, Any]) -> dict[str, Any]:
        """Before `stl_unit` all files had the frame's own unit, and a mesh could be asked for with
        fewer triangles than it takes now."""
        known = {"stl_unit": "frame", **stored} if "up_axis" in stored else dict(stored)
        if 0 < known.get("triangles", 0) < LEAST_TRIANGLES:
            known["triangles"] = LEAST_TRIANGLES
        return known

    def up_in(self, format: Format) -> Axis:
        """Which axis is up in the files of a format, where that is not the format's own matter."""
        if self.up_axis != "auto":
            return self.up_axis
        return "y" if format == "obj" and self.frame != "source" else "z"

    @field_validator("formats")
    @classmethod
    def _each_once(cls, formats: tuple[Format, ...]) -> tuple[Format, ...]:
        return tuple(dict.fromkeys(formats))

    @field_validator("triangles")
    @classmethod
    def _leaves_a_mesh(cls, triangles: int) -> int:
        if 0 < triangles < LEAST_TRIANGLES:
            raise ValueError(
                f"a mesh of {triangles} triangles shows nothing: ask for {LEAST_TRIANGLES} or "
                "more, or for 0, which is all there are"
            )
        return triangles
