"""The .glb writer, read back by hand and by open3d."""

from __future__ import annotations

import dataclasses
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import open3d
import pytest

from pipelines.exports.formats import ktx2
from pipelines.exports.formats.glb import GlbStyle, read_mesh, write_mesh
from pipelines.exports.formats.srgb import linear_from_srgb
from pipelines.exports.mesh import TexturedMesh, TriangleMesh
from tests.gltf_validator import problems_of, report_of
from tests.texture_pictures import photo, psnr

VERTICES = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 3.0, 0.0], [0.0, 0.0, 5.0]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)
COLORS = np.array([[0.5, 0.0, 1.0], [1.0, 1.0, 1.0], [0.02, 0.02, 0.02], [0.25, 0.5, 0.75]])
NORMALS = np.array([[-1.0, -1, -1], [1, 0, 0], [0, 1, 0], [0, 0, 0]])


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "mesh.glb"
    write_mesh(path, TriangleMesh(VERTICES, FACES, COLORS, NORMALS))
    return path


def parse(path: Path) -> tuple[dict[str, Any], list[np.ndarray]]:
    """The JSON and each accessor's values, checked against the container's rules."""
    data = path.read_bytes()
    magic, version, total = struct.unpack_from("<4sII", data)
    assert (magic, version, total) == (b"glTF", 2, len(data))
    json_bytes, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    assert json_bytes % 4 == 0
    document = json.loads(data[20 : 20 + json_bytes])
    bin_bytes, kind = struct.unpack_from("<I4s", data, 20 + json_bytes)
    assert kind == b"BIN\0"
    assert bin_bytes % 4 == 0
    binary = data[28 + json_bytes :]
    assert len(binary) == bin_bytes == document["buffers"][0]["byteLength"]
    types = {5126: "<f4", 5125: "<u4", 5123: "<u2"}
    widths = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
    arrays = []
    for accessor in document["accessors"]:
        view = document["bufferViews"][accessor["bufferView"]]
        assert view["byteOffset"] % 4 == 0
        width = widths[accessor["type"]]
        values = np.frombuffer(
            binary,
            types[accessor["componentType"]],
            accessor["count"] * width,
            view["byteOffset"],
        )
        assert values.nbytes == view["byteLength"]
        arrays.append(values.reshape(-1, width))
    return document, arrays


def test_container_and_accessors_hold_the_mesh_y_up(file: Path) -> None:
    document, (position, normal, _, index) = parse(file)
    np.testing.assert_array_equal(
        position, np.stack((VERTICES[:, 0], VERTICES[:, 2], -VERTICES[:, 1]), 1)
    )
    assert document["accessors"][0]["min"] == [0.0, 0.0, -3.0]
    assert document["accessors"][0]["max"] == [2.0, 5.0, 0.0]
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, rtol=1e-6)
    np.testing.assert_array_equal(index.reshape(-1, 3), FACES)


def test_colors_are_linear_and_the_material_is_unlit_and_two_sided(file: Path) -> None:
    document, (_, _, rgba, _) = parse(file)
    np.testing.assert_allclose(rgba[:, :3] / 65535.0, linear_from_srgb(COLORS), atol=1e-5)
    assert (rgba[:, 3] == 65535).all()
    assert rgba[0, 0] / 65535.0 == pytest.approx(0.21404, abs=1e-4)
    material = document["materials"][0]
    assert material["doubleSided"] is True
    assert "KHR_materials_unlit" in material["extensions"]
    assert document["extensionsUsed"] == ["KHR_materials_unlit"]
    assert document["accessors"][2]["normalized"] is True


def test_open3d_reads_the_same_mesh(file: Path) -> None:
    mesh = open3d.io.read_triangle_mesh(file)
    assert len(mesh.triangles) == 4
    assert mesh.has_vertex_colors()
    read = np.asarray(mesh.vertices)
    order = [int(np.abs(read - wanted).sum(1).argmin()) for wanted in parse(file)[1][0]]
    np.testing.assert_allclose(
        np.asarray(mesh.vertex_colors)[order], linear_from_srgb(COLORS), atol=1e-4
    )


def test_a_mesh_that_gltf_cannot_hold_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bad.glb"
    with pytest.raises(ValueError, match="without faces"):
        write_mesh(path, TriangleMesh(VERTICES[:0], FACES[:0], COLORS[:0], NORMALS[:0]))
    with pytest.raises(ValueError, match="does not exist"):
        write_mesh(path, TriangleMesh(VERTICES[:3], FACES, COLORS[:3], NORMALS[:3]))
    with pytest.raises(ValueError, match="must be like"):
        write_mesh(path, TriangleMesh(VERTICES, FACES, COLORS[:3], NORMALS))
    assert not path.exists()


@pytest.fixture
def textured(tmp_path: Path) -> Path:
    picture = np.zeros((64, 64, 3), np.uint8)
    picture[:32, :32], picture[:32, 32:] = (200, 30, 30), (30, 200, 30)
    picture[32:] = (30, 30, 200)
    uv = np.array([[0.1, 0.1], [0.9, 0.1], [0.1, 0.9], [0.9, 0.9]])
    path = tmp_path / "textured.glb"
    write_mesh(path, TexturedMesh(VERTICES, FACES, NORMALS, uv, picture))
    return path


def test_a_texture_lies_in_the_file_and_comes_back(textured: Path, file: Path) -> None:
    mesh = read_mesh(textured)
    assert isinstance(mesh, TexturedMesh)
    np.testing.assert_allclose(mesh.vertices, VERTICES, atol=1e-6)
    np.testing.assert_array_equal(mesh.faces, FACES)
    np.testing.assert_allclose(mesh.uv, [[0.1, 0.1], [0.9, 0.1], [0.1, 0.9], [0.9, 0.9]], atol=1e-6)
    assert mesh.texture.shape == (64, 64, 3)
    for place, wanted in (
        ((10, 10), (200, 30, 30)),
        ((10, 50), (30, 200, 30)),
        ((50, 30), (30, 30, 200)),
    ):
        assert np.abs(mesh.texture[place].astype(int) - wanted).max() < 12
    plain = read_mesh(file)
    assert isinstance(plain, TriangleMesh)
    np.testing.assert_allclose(plain.vertices, VERTICES, atol=1e-6)
    np.testing.assert_allclose(plain.colors, COLORS, atol=1e-3)


def test_a_textured_document_is_as_the_specification_wants_it(textured: Path) -> None:
    document, (_, _, uv, _) = parse(textured)
    (primitive,) = document["meshes"][0]["primitives"]
    assert primitive["attributes"] == {"POSITION": 0, "NORMAL": 1, "TEXCOORD_0": 2}
    assert primitive["indices"] == 3
    np.testing.assert_allclose(uv[:, 1], [0.1, 0.1, 0.9, 0.9], atol=1e-6)
    material = document["materials"][0]
    assert material["pbrMetallicRoughness"]["baseColorTexture"] == {"index": 0}
    assert document["textures"] == [{"sampler": 0, "source": 0}]
    image = document["images"][0]
    assert image["mimeType"] == "image/jpeg"
    view = document["bufferViews"][image["bufferView"]]
    assert "target" not in view
    length = int.from_bytes(textured.read_bytes()[12:16], "little")
    binary = textured.read_bytes()[28 + length :]
    assert binary[view["byteOffset"] : view["byteOffset"] + 3] == b"\xff\xd8\xff"


def test_open3d_reads_a_textured_mesh(textured: Path) -> None:
    mesh = open3d.io.read_triangle_mesh(textured)
    assert len(mesh.triangles) == 4
    assert mesh.has_triangle_uvs()


def test_files_that_are_no_mesh_of_ours_are_refused(tmp_path: Path, file: Path) -> None:
    broken = tmp_path / "broken.glb"
    for content in (b"", b"glTF", b"PK" * 20, file.read_bytes()[:60]):
        broken.write_bytes(content)
        with pytest.raises(ValueError, match=r"broken\.glb is no"):
            read_mesh(broken)
    uv = np.zeros((3, 2))
    with pytest.raises(ValueError, match="uv"):
        write_mesh(
            broken, TexturedMesh(VERTICES, FACES, NORMALS, uv, np.zeros((4, 4, 3), np.uint8))
        )


@pytest.mark.parametrize("kind", ["file", "textured"])
def test_the_khronos_validator_finds_no_fault(kind: str, request: pytest.FixtureRequest) -> None:
    path: Path = request.getfixturevalue(kind)
    assert problems_of(path) == []
    info = report_of(path)["info"]
    assert (info["totalVertexCount"], info["totalTriangleCount"]) == (4, 4)
    assert info["hasTextures"] == (kind == "textured")


def test_the_khronos_validator_finds_planted_faults(tmp_path: Path) -> None:
    long = TriangleMesh(VERTICES, FACES, COLORS, np.tile([0.0, 0.0, 1.0], (4, 1)))
    path = tmp_path / "mesh.glb"
    write_mesh(path, long)
    data = bytearray(path.read_bytes())
    begin = 28 + int.from_bytes(data[12:16], "little")
    data[begin + 48 : begin + 60] = np.array([0.0, 2.0, 0.0], "<f4").tobytes()  # a normal
    data[begin + 128 + 12] = 9  # an index
    path.write_bytes(data)
    found = " ".join(problems_of(path))
    assert "ACCESSOR_VECTOR3_NON_UNIT" in found
    assert "ACCESSOR_INDEX_OOB" in found


@pytest.mark.parametrize("kind", ["file", "textured"])
def test_quantized_files_show_the_same_in_half_the_bytes_a_vertex(
    kind: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    plain = read_mesh(request.getfixturevalue(kind))
    path = tmp_path / "quantized.glb"
    far = dataclasses.replace(plain, vertices=plain.vertices + np.array([4000.0, -900.0, 20.0]))
    write_mesh(path, far, style=GlbStyle(quantized=True))
    assert problems_of(path) == []
    found = read_mesh(path)
    assert type(found) is type(plain)
    assert np.abs(found.vertices - far.vertices).max() <= 5.0 / 65535.0
    np.testing.assert_array_equal(found.faces, plain.faces)
    unit = plain.normals / np.linalg.norm(plain.normals, axis=1, keepdims=True)
    assert (found.normals * unit).sum(axis=1).min() > 0.999
    if isinstance(found, TexturedMesh) and isinstance(plain, TexturedMesh):
        assert np.abs(found.uv - plain.uv).max() <= 1.0 / 65535.0
    data = path.read_bytes()
    document = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    assert document["extensionsRequired"] == ["KHR_mesh_quantization"]
    widths = [view.get("byteStride") for view in document["bufferViews"]]
    assert widths[:2] == [8, 4]


@pytest.mark.parametrize("kind", ["file", "textured"])
def test_compressed_files_hold_what_quantized_ones_do_in_fewer_bytes(
    kind: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    plain = read_mesh(request.getfixturevalue(kind))
    rows = np.repeat(np.arange(len(plain.vertices)), 40)  # long enough for there to be a gain
    long = dataclasses.replace(
        plain,
        vertices=plain.vertices[rows] + np.linspace(0.0, 1.0, len(rows))[:, None],
        normals=plain.normals[rows],
        faces=np.arange(len(rows) // 3 * 3, dtype=np.int32).reshape(-1, 3),
        **{key: getattr(plain, key)[rows] for key in ("uv", "colors") if hasattr(plain, key)},
    )
    quantized, compressed = tmp_path / "quantized.glb", tmp_path / "compressed.glb"
    write_mesh(quantized, long, style=GlbStyle(quantized=True))
    write_mesh(compressed, long, style=GlbStyle(compressed=True))
    assert problems_of(compressed) == []
    wanted, found = read_mesh(quantized), read_mesh(compressed)
    assert type(found) is type(wanted)
    for key in (
        "vertices",
        "faces",
        "normals",
        *(("uv",) if hasattr(plain, "uv") else ("colors",)),
    ):
        np.testing.assert_array_equal(getattr(found, key), getattr(wanted, key))
    assert compressed.stat().st_size < quantized.stat().st_size
    data = compressed.read_bytes()
    document = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    assert document["extensionsRequired"] == ["KHR_mesh_quantization", "EXT_meshopt_compression"]
    first, second = document["buffers"]
    assert "uri" not in first
    assert second["extensions"]["EXT_meshopt_compression"] == {"fallback": True}
    for view in document["bufferViews"][:4]:
        stored = view["extensions"]["EXT_meshopt_compression"]
        assert view["buffer"] == 1
        assert stored["count"] * stored["byteStride"] == view["byteLength"]
        assert stored["byteOffset"] % 4 == 0


@pytest.mark.parametrize("kind", ["file", "textured"])
def test_a_lit_file_leaves_light_to_the_viewer(
    kind: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    path = tmp_path / "lit.glb"
    write_mesh(path, read_mesh(request.getfixturevalue(kind)), style=GlbStyle(unlit=False))
    assert problems_of(path) == []
    assert b"KHR_materials_unlit" not in path.read_bytes()
    assert b"roughnessFactor" in path.read_bytes()


@pytest.mark.parametrize("compressed", [False, True])
def test_a_texture_may_be_a_ktx2(textured: Path, compressed: bool, tmp_path: Path) -> None:
    plain = read_mesh(textured)
    assert isinstance(plain, TexturedMesh)
    path = tmp_path / "ktx2.glb"
    write_mesh(path, plain, style=GlbStyle(compressed=compressed, texture="ktx2"))
    found = read_mesh(path)
    assert isinstance(found, TexturedMesh)
    assert psnr(found.texture, plain.texture) > 45.0
    np.testing.assert_allclose(found.vertices, plain.vertices, atol=1e-4)
    data = path.read_bytes()
    length = int.from_bytes(data[12:16], "little")
    document = json.loads(data[20 : 20 + length])
    shape = ["KHR_mesh_quantization", "EXT_meshopt_compression"] * compressed
    assert document["extensionsRequired"] == [*shape, "KHR_texture_basisu"]
    assert document["extensionsUsed"] == ["KHR_materials_unlit", *shape, "KHR_texture_basisu"]
    assert document["textures"] == [
        {"sampler": 0, "extensions": {"KHR_texture_basisu": {"source": 0}}}
    ]
    (image,) = document["images"]
    assert image["mimeType"] == "image/ktx2"
    view = document["bufferViews"][image["bufferView"]]
    begin = 28 + length + view["byteOffset"]
    np.testing.assert_array_equal(
        ktx2.decode(data[begin : begin + view["byteLength"]]), found.texture
    )


def test_what_the_told_share_raises_ends_a_ktx2_at_once_and_leaves_no_file(
    textured: Path, tmp_path: Path
) -> None:
    plain, path, told = read_mesh(textured), tmp_path / "cancelled.glb", list[float]()
    assert isinstance(plain, TexturedMesh)

    def cancel(done: float) -> None:
        told.append(done)
        raise InterruptedError

    large = dataclasses.replace(plain, texture=photo(512))
    with pytest.raises(InterruptedError):
        write_mesh(path, large, style=GlbStyle(texture="ktx2"), on_progress=cancel)
    assert len(told) == 1
    assert told[0] < 0.2
    assert not list(tmp_path.glob("cancelled*"))


def test_the_khronos_validator_knows_no_ktx2_and_finds_nothing_else(
    textured: Path, tmp_path: Path
) -> None:
    path = tmp_path / "ktx2.glb"
    write_mesh(path, read_mesh(textured), style=GlbStyle(texture="ktx2"))
    told = {
        (message["code"], message.get("pointer"), message["severity"])
        for message in report_of(path)["issues"]["messages"]
    }
    # 1 for a warning, 2 for a note: without the extension, only JPEG and PNG may be.
    assert told == {
        ("UNSUPPORTED_EXTENSION", "/extensionsUsed/1", 2),
        ("VALUE_NOT_IN_LIST", "/images/0/mimeType", 1),
        ("IMAGE_UNRECOGNIZED_FORMAT", "/images/0", 1),
        ("UNUSED_OBJECT", "/images/0", 2),
    }


def test_a_ktx2_texture_is_left_out_where_there_is_none_and_refused_where_it_cannot_be(
    file: Path, textured: Path, tmp_path: Path
) -> None:
    path = tmp_path / "ktx2.glb"
    style = GlbStyle(texture="ktx2")
    write_mesh(path, read_mesh(file), style=style)
    assert b"KHR_texture_basisu" not in path.read_bytes()
    assert problems_of(path) == []
    plain, odd = read_mesh(textured), tmp_path / "odd.glb"
    assert isinstance(plain, TexturedMesh)
    with pytest.raises(ValueError, match="62x64 pixels cannot be: sides are multiples of 4"):
        write_mesh(odd, dataclasses.replace(plain, texture=plain.texture[:, :62]), style=style)
    assert not odd.exists()
    write_mesh(path, plain, style=style)
    broken = path.read_bytes()
    odd.write_bytes(broken.replace(b"KTX 20", b"KTX 21"))
    with pytest.raises(ValueError, match=r"odd\.glb is no mesh of ours: no KTX2 texture"):
        read_mesh(odd)
