"""USDZ files, opened by Pixar's library."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from pxr import Sdf, Usd, UsdGeom, UsdShade, UsdValidation

from pipelines.exports.formats import usdz
from pipelines.exports.formats.srgb import linear_from_srgb
from pipelines.exports.frame import Frame
from pipelines.exports.mesh import TexturedMesh, TriangleMesh
from tests.unit.pipelines.exports.formats import solids


@pytest.fixture(params=[solids.textured, solids.coloured], ids=["textured", "coloured"])
def mesh(request: pytest.FixtureRequest) -> TriangleMesh | TexturedMesh:
    return request.param()


@pytest.fixture
def file(tmp_path: Path, mesh: TriangleMesh | TexturedMesh) -> Path:
    path = tmp_path / "mesh.usdz"
    usdz.write_mesh(path, mesh, Frame(metric=True))
    assert [entry.name for entry in tmp_path.iterdir()] == ["mesh.usdz"]
    return path


def shown(stage: Any) -> Any:
    """Its one mesh."""
    (found,) = (prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh))
    return UsdGeom.Mesh(found)


def test_the_scene_holds_the_mesh_y_up_in_metres(file: Path) -> None:
    stage = Usd.Stage.Open(str(file))
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert "1 unit is 1 metre" in stage.GetRootLayer().comment
    made = shown(stage)
    np.testing.assert_allclose(made.GetPointsAttr().Get(), solids.y_up(solids.VERTICES))
    np.testing.assert_array_equal(
        np.asarray(made.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3), solids.FACES
    )
    box = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default"]).ComputeWorldBound(made.GetPrim())
    np.testing.assert_allclose(box.GetRange().GetMin(), [0.5, 0.0, -3.0])
    np.testing.assert_allclose(box.GetRange().GetMax(), [2.0, 5.0, 0.0])


def test_the_color_is_the_pictures_or_the_vertices(
    file: Path, mesh: TriangleMesh | TexturedMesh
) -> None:
    stage = Usd.Stage.Open(str(file))
    material, _ = UsdShade.MaterialBindingAPI(shown(stage).GetPrim()).ComputeBoundMaterial()
    source, _, _ = material.ComputeSurfaceSource()
    (color,) = source.GetInput("diffuseColor").GetConnectedSources()[0]
    shader = UsdShade.Shader(color.source)
    values = UsdGeom.PrimvarsAPI(shown(stage))
    if isinstance(mesh, TriangleMesh):
        assert shader.GetIdAttr().Get() == "UsdPrimvarReader_float3"
        assert shader.GetInput("varname").Get() == "displayColor"
        np.testing.assert_allclose(
            values.GetPrimvar("displayColor").Get(), linear_from_srgb(solids.COLORS), atol=1e-6
        )
        return
    assert shader.GetIdAttr().Get() == "UsdUVTexture"
    asset = shader.GetInput("file").Get()
    assert asset.resolvedPath == f"{file}[textures/mesh.jpg]"
    with zipfile.ZipFile(file) as archive, archive.open("textures/mesh.jpg") as held:
        picture = np.asarray(Image.open(held)).astype(int)
    reader = UsdShade.Shader(shader.GetInput("st").GetConnectedSources()[0][0].source)
    places = np.asarray(values.GetPrimvar(reader.GetInput("varname").Get()).Get())
    for (s, t), wanted in zip(places, solids.QUARTERS.values(), strict=True):
        found = picture[int((1.0 - t) * 64), int(s * 64)]
        assert np.abs(found - wanted).max() < 12


def test_the_package_is_as_phones_demand_it(file: Path) -> None:
    with zipfile.ZipFile(file) as archive, file.open("rb") as raw:
        assert archive.testzip() is None
        assert archive.namelist()[0] == "mesh.usdc"
        for info in archive.infolist():
            assert info.compress_type == zipfile.ZIP_STORED
            raw.seek(info.header_offset + 26)
            name, extra = (int.from_bytes(raw.read(2), "little") for _ in range(2))
            assert (info.header_offset + 30 + name + extra) % 64 == 0
    registry = UsdValidation.ValidationRegistry()
    validators = registry.GetOrLoadAllValidators()
    assert {"UsdzPackageValidator", "ShaderSdrCompliance"} <= {
        one.GetMetadata().name.split(":")[1] for one in validators
    }
    found = UsdValidation.ValidationContext(validators).Validate(Usd.Stage.Open(str(file)))
    assert [error.GetErrorAsString() for error in found] == []
    assert Sdf.Layer.FindOrOpen(f"{file}[mesh.usdc]").GetFileFormat().formatId in ("usdc", "usd")


def test_the_same_mesh_gives_the_same_bytes(
    tmp_path: Path, mesh: TriangleMesh | TexturedMesh
) -> None:
    for name in ("a.usdz", "b.usdz"):
        usdz.write_mesh(tmp_path / name, mesh)
    assert (tmp_path / "a.usdz").read_bytes() == (tmp_path / "b.usdz").read_bytes()
