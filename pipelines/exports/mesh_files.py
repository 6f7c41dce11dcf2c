"""What a mesh looks like and the files it is delivered in: painted, levels of detail, the subject.

Shapes come from `pipelines.exports.mesh_shape`, in the world of cameras.json.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipelines.exports.formats import glb, obj, ply, stl, usdz
from pipelines.exports.formats.glb import GlbStyle
from pipelines.exports.judged import JUDGED_MESH
from pipelines.exports.levels import levels_of, texture_px_of
from pipelines.exports.mesh import TexturedMesh, TriangleMesh
from pipelines.exports.mesh_options import Format, MeshOptions
from pipelines.exports.mesh_shape import REDUCE_SHARE, Part
from pipelines.exports.placement import Placement
from pipelines.exports.subject import Thing
from pipelines.exports.subject_files import save_subject
from pipelines.exports.texture.bake import painted
from pipelines.exports.texture.told import skin_told
from pipelines.scene.gaze import gaze_of
from pipelines.scene.trained_scene import TrainedScene
from pipelines.stage import StageContext

_FILES: dict[Format, str] = {
    "glb": "mesh.glb",
    "ply": "mesh.ply",
    "obj": "mesh.obj.zip",
    "stl": "mesh.stl",
    "usdz": "mesh.usdz",
}
_TEXTURED = frozenset({"glb", "obj", "usdz"})
"""Formats that carry a texture."""
_TEXTURE_SHARE, _SUBJECT_SHARE = 0.96, 0.98
_PAINTED = 0.9
"""Of a coarser level, when only its file is left."""


@dataclass(frozen=True)
class Painter:
    """What paints the mesh and its coarser levels as the options want it."""

    scene: TrainedScene
    options: MeshOptions
    ctx: StageContext

    @property
    def is_delivered(self) -> bool:
        """Whether one of the files carries a texture."""
        return not _TEXTURED.isdisjoint(self.options.formats)

    def __call__(self, shape: TriangleMesh, level: int) -> TriangleMesh | TexturedMesh:
        """The shape painted. level: 0 for the mesh itself, whose texture is the largest."""
        shown = self.scene.training_images()
        return painted(
            shape,
            shown,
            [self.scene.lens_of(image) for image in shown],
            self.options.model_copy(
                update={"texture_px": texture_px_of(level, self.options.texture_px)}
            ),
            self.ctx,
            (self._share(level + 0.1), self._share(level + (_PAINTED if level else 1.0))),
            self.scene,
        )

    def tell_reducing(self, level: int, done: float) -> None:
        """Say that the shape of a level is being made; may raise."""
        self.ctx.progress(self._share(level + 0.1 * done), "reducing for a coarser level")

    def tell_writing(self, level: int, done: float) -> None:
        """Say that the file of a level is being written; may raise."""
        self.ctx.progress(self._share(level + _PAINTED + (1.0 - _PAINTED) * done), "writing")

    def _share(self, levels: float) -> float:
        """Of the export's progress, when so many levels are painted."""
        return REDUCE_SHARE + (_TEXTURE_SHARE - REDUCE_SHARE) * levels / (1 + self.options.lods)


def write_levels(mesh: TriangleMesh, paint: Painter, place: Placement) -> list[dict[str, Any]]:
    """Write the levels of detail; what is told of each."""
    options, told = paint.options, list[dict[str, Any]]()
    shapes = levels_of(mesh, options.lods, lambda done: paint.tell_reducing(len(told) + 1, done))
    for level, shape in enumerate(shapes, start=1):
        coarse, path = paint(shape, level), paint.ctx.out / f"mesh-lod{level}.glb"
        glb.write_mesh(
            path,
            place.mesh(coarse),
            place.frame(),
            _style(options),
            functools.partial(paint.tell_writing, level),
        )
        told.append({"file": path.name, **skin_told(coarse)})
    return told


def write_mesh(
    mesh: TriangleMesh,
    skin: TriangleMesh | TexturedMesh,
    options: MeshOptions,
    place: Placement,
    ctx: StageContext,
) -> None:
    """The files, `mesh` with its vertices' colours and `skin` as it is painted, if it is."""
    told = ctx.told_part("writing", _TEXTURE_SHARE, _SUBJECT_SHARE)
    in_millimetres = options.stl_unit == "millimetre" and place.metric
    frames = {name: place.frame(options.up_in(name)) for name in _FILES}
    mesh, skin = place.mesh(mesh), place.mesh(skin)
    # A GLB is written in any case: what is delivered is judged by it.
    wanted: tuple[Format, ...] = (*options.formats, "glb")
    names = list(dict.fromkeys(wanted))

    def told_of(name: Format) -> Callable[[float], None]:
        begin = names.index(name)
        return lambda done: told((begin + done) / len(names))

    writers: dict[Format, Callable[[Path], None]] = {
        "glb": lambda path: glb.write_mesh(
            path, skin, frames["glb"], _style(options), told_of("glb")
        ),
        "ply": lambda path: ply.write_mesh(path, mesh, frames["ply"]),
        "obj": lambda path: obj.write_mesh(path, skin, frames["obj"], told_of("obj")),
        "stl": lambda path: stl.write_mesh(path, mesh, frames["stl"], in_millimetres),
        "usdz": lambda path: usdz.write_mesh(path, skin, frames["usdz"]),
    }
    for name in names:
        told_of(name)(0.0)
        file = _FILES[name] if name in options.formats else JUDGED_MESH
        writers[name](ctx.out / file)


def write_subject(
    part: Part,
    thing: Thing,
    skin: TriangleMesh | TexturedMesh,
    options: MeshOptions,
    scene: TrainedScene,
    ctx: StageContext,
) -> dict[str, Any]:
    """Write the thing that was walked round beside the mesh; what is told of it."""
    told = ctx.told_part("cutting out the subject", _SUBJECT_SHARE, 1.0)
    told(0.0)
    shown = scene.training_images()
    return save_subject(
        ctx.out,
        part.mesh,
        skin,
        thing,
        gaze_of(shown, [scene.lens_of(image) for image in shown]),
        scene.cameras.metric,
        _style(options),
        told,
    )


def _style(options: MeshOptions) -> GlbStyle:
    """How GLB files are written."""
    return GlbStyle(
        options.glb_unlit, options.glb_quantized, options.glb_compressed, options.glb_texture
    )
