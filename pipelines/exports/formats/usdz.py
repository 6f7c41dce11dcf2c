"""A triangle mesh as USDZ, as phones show it in a room: one mesh, one material, +Y up.

A USDZ is a zip whose files lie uncompressed, each beginning at a multiple of 64 bytes; the first is
the scene, binary USD as AR viewers demand. A texture is a JPEG beside it; without one the vertices'
colours are `displayColor`, which is linear. USD has no unlit material: the picture is the diffuse
colour of a rough one. Texture coordinates have their origin at the picture's bottom left.

Source: Pixar, "Usdz File Format Specification" 1.3; UsdPreviewSurface specification 2.6.
"""

from __future__ import annotations

import tempfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.exports.formats.archive import entry
from pipelines.exports.formats.glb import jpeg
from pipelines.exports.formats.srgb import linear_from_srgb
from pipelines.exports.frame import Frame, is_far
from pipelines.exports.mesh import TexturedMesh, TriangleMesh, unit_normals

_SCENE, _TEXTURE = "mesh.usdc", "textures/mesh.jpg"
_MATERIAL = "/scene/captured"
_ALIGNMENT = 64
_LOCAL_HEADER_BYTES = 30
_PADDING_ID = 0x1986
"""Of the extra field that fills up to the next multiple; readers skip it."""


def write_mesh(path: Path, mesh: TriangleMesh | TexturedMesh, frame: Frame = Frame()) -> None:
    """Write a mesh. frame: where it lies; the file has +Y up."""
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".usd-") as folder:
        scene = Path(folder) / _SCENE
        _write_scene(scene, mesh, frame.y_up())
        files = {_SCENE: scene.read_bytes()}
    if isinstance(mesh, TexturedMesh):
        files[_TEXTURE] = jpeg(mesh.texture)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for name, data in files.items():
            assert archive.fp is not None
            info = entry(name, compressed=False)
            begin = archive.fp.tell() + _LOCAL_HEADER_BYTES + len(name.encode("ascii"))
            fill = -(begin + 4) % _ALIGNMENT
            info.extra = (
                _PADDING_ID.to_bytes(2, "little") + fill.to_bytes(2, "little") + bytes(fill)
            )
            archive.writestr(info, data)


def _write_scene(path: Path, mesh: TriangleMesh | TexturedMesh, frame: Frame) -> None:
    """The binary USD file."""
    # Large, and few jobs want it.
    from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, Vt

    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.GetRootLayer().comment = "nerfworks: " + "; ".join(frame.lines())
    root = UsdGeom.Xform.Define(stage, "/scene")
    stage.SetDefaultPrim(root.GetPrim())
    made = UsdGeom.Mesh.Define(stage, "/scene/mesh")
    places = frame.of_world(mesh.vertices)
    if is_far(places):
        middle = np.round(places.mean(axis=0))
        places = places - middle
        root.AddTranslateOp().Set(Gf.Vec3d(*middle.tolist()))
    positions = places.astype(np.float32)
    made.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(positions))
    made.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
    made.CreateFaceVertexIndicesAttr(
        Vt.IntArray.FromNumpy(np.ascontiguousarray(mesh.faces, np.int32).reshape(-1))
    )
    normals = frame.of_world(unit_normals(mesh.normals)).astype(np.float32)
    made.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(normals)))
    made.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    made.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    made.CreateDoubleSidedAttr(True)
    corners = np.stack([positions.min(axis=0), positions.max(axis=0)])
    made.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(corners))
    material = UsdShade.Material.Define(stage, _MATERIAL)
    surface = UsdShade.Shader.Define(stage, f"{_MATERIAL}/surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(1.0)
    surface.CreateInput("metallic", Sdf.ValueTypeNames.Float).Set(0.0)
    color = surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
    color.ConnectToSource(
        _textured(made, mesh) if isinstance(mesh, TexturedMesh) else _colored(made, mesh)
    )
    material.CreateSurfaceOutput().ConnectToSource(
        surface.CreateOutput("surface", Sdf.ValueTypeNames.Token)
    )
    UsdShade.MaterialBindingAPI.Apply(made.GetPrim()).Bind(material)
    stage.GetRootLayer().Save()


def _primvar(made: Any, name: str, values: Any, kind: str) -> Any:
    """An array with a value per vertex, and the output of a shader that reads it."""
    from pxr import Sdf, UsdGeom, UsdShade

    types = Sdf.ValueTypeNames
    stored = types.Color3fArray if kind == "float3" else types.TexCoord2fArray
    variables = UsdGeom.PrimvarsAPI(made)
    variables.CreatePrimvar(name, stored, UsdGeom.Tokens.vertex).Set(values)
    stage = made.GetPrim().GetStage()
    reader = UsdShade.Shader.Define(stage, f"{_MATERIAL}/{name}")
    reader.CreateIdAttr(f"UsdPrimvarReader_{kind}")
    reader.CreateInput("varname", types.String).Set(name)
    return reader.CreateOutput("result", types.Float3 if kind == "float3" else types.Float2)


def _colored(made: Any, mesh: TriangleMesh) -> Any:
    """The output that gives the vertices' colours."""
    from pxr import Vt

    linear = linear_from_srgb(np.clip(mesh.colors, 0.0, 1.0)).astype(np.float32)
    return _primvar(made, "displayColor", Vt.Vec3fArray.FromNumpy(linear), "float3")


def _textured(made: Any, mesh: TexturedMesh) -> Any:
    """The output that gives the picture's colours."""
    from pxr import Sdf, UsdShade, Vt

    up = np.stack([mesh.uv[:, 0], 1.0 - mesh.uv[:, 1]], axis=1).astype(np.float32)
    place = _primvar(made, "st", Vt.Vec2fArray.FromNumpy(up), "float2")
    types = Sdf.ValueTypeNames
    picture = UsdShade.Shader.Define(made.GetPrim().GetStage(), f"{_MATERIAL}/picture")
    picture.CreateIdAttr("UsdUVTexture")
    picture.CreateInput("file", types.Asset).Set(Sdf.AssetPath(_TEXTURE))
    picture.CreateInput("sourceColorSpace", types.Token).Set("sRGB")
    for side in ("wrapS", "wrapT"):
        picture.CreateInput(side, types.Token).Set("clamp")
    picture.CreateInput("st", types.Float2).ConnectToSource(place)
    return picture.CreateOutput("rgb", types.Float3)
