"""Files that people open in a browser, shown there. Needs Chromium, and npm once for three.js."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipelines.exports.formats.glb import GlbStyle, Texture, write_mesh
from pipelines.exports.formats.mp4 import VideoWriter
from pipelines.exports.mesh import TexturedMesh, TriangleMesh
from tests.benchmarks.browser import NoBrowserError, find_browser, show, three_folder
from tests.texture_pictures import photo, psnr

RED, GREEN = np.array([220, 40, 30]), np.array([30, 180, 60])


@pytest.fixture(autouse=True)
def _needs_a_browser() -> None:
    try:
        find_browser()
    except NoBrowserError as error:
        pytest.skip(f"what browsers show is NOT tested: {error}")


def _square(textured: bool) -> TriangleMesh | TexturedMesh:
    """Stands upright, its face to -Y, which is glTF's +Z: red below, green above."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]], np.float64)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    normals = np.tile([0.0, -1.0, 0.0], (4, 1))
    if textured:
        uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float64)
        picture = np.repeat([GREEN, RED], 32, axis=0)[:, None].repeat(64, axis=1)
        return TexturedMesh(vertices, faces, normals, uv, picture.astype(np.uint8))
    colors = np.stack([RED, RED, GREEN, GREEN]) / 255.0
    return TriangleMesh(vertices, faces, colors, normals)


@pytest.mark.slow
@pytest.mark.parametrize("textured", [False, True], ids=["vertex-colours", "texture"])
@pytest.mark.parametrize(
    "style",
    [
        GlbStyle(),
        GlbStyle(quantized=True),
        GlbStyle(compressed=True),
        GlbStyle(texture="ktx2"),
        GlbStyle(compressed=True, texture="ktx2"),
    ],
    ids=["plain", "quantized", "compressed", "ktx2", "compressed-ktx2"],
)
def test_three_js_shows_a_mesh_upright_in_its_colours(
    tmp_path: Path, textured: bool, style: GlbStyle
) -> None:
    try:
        three_folder()
    except NoBrowserError as error:
        pytest.skip(f"what browsers show is NOT tested: {error}")
    path = tmp_path / "mesh.glb"
    write_mesh(path, _square(textured), style=style)
    shown = show(path, tmp_path, turns=1)
    assert shown.problem == ""
    assert shown.facts["triangles"] == 2
    if textured:
        assert shown.facts["texture"]["compressed"] == (style.texture == "ktx2")
        assert shown.facts["texture"]["levels"] == (7 if style.texture == "ktx2" else 0)
    assert shown.picture is not None
    with Image.open(shown.picture) as opened:
        picture = np.asarray(opened.convert("RGB")).astype(int)
    below, above = picture[190, 160], picture[125, 160]
    if textured:
        np.testing.assert_allclose(below, RED, atol=24)
        np.testing.assert_allclose(above, GREEN, atol=24)
    else:
        # The colours go over into each other, by light and not by sRGB.
        assert below[0] > 1.5 * below[1]
        assert above[1] > above[0]


@pytest.mark.slow
def test_three_js_shows_a_ktx2_texture_as_it_does_a_jpeg(tmp_path: Path) -> None:
    try:
        three_folder()
    except NoBrowserError as error:
        pytest.skip(f"what browsers show is NOT tested: {error}")
    square = _square(textured=True)
    assert isinstance(square, TexturedMesh)
    pictures = []
    textures: tuple[Texture, ...] = ("jpeg", "ktx2")
    for texture in textures:
        path = tmp_path / f"{texture}.glb"
        mesh = dataclasses.replace(square, texture=photo(256))
        write_mesh(path, mesh, style=GlbStyle(texture=texture))
        shown = show(path, tmp_path, turns=1)
        assert shown.problem == ""
        if texture == "ktx2":
            # As ASTC, BC7 and the like, a byte a pixel, with all smaller copies.
            assert shown.facts["texture"]["compressed"]
            assert shown.facts["texture"]["bytes"] == 16 * sum(
                max(1, 64 >> level) ** 2 for level in range(9)
            )
            assert shown.facts["texture"]["srgb"] == "srgb"
        assert shown.picture is not None
        with Image.open(shown.picture) as opened:
            pictures.append(np.asarray(opened.convert("RGB")))
    assert pictures[0].std() > 20.0, "there is something to compare"
    assert psnr(pictures[1], pictures[0]) > 36.0


@pytest.mark.slow
@pytest.mark.parametrize(("codec", "sphere"), [("h264", False), ("h264", True), ("av1", False)])
def test_a_video_plays(tmp_path: Path, codec: str, sphere: bool) -> None:
    path = tmp_path / "video.mp4"
    with VideoWriter(path, 160, 80, 24.0, 18, codec, equirectangular=sphere) as writer:
        for index in range(48):
            frame = np.full((80, 160, 3), 40, np.uint8)
            frame[:, 3 * index : 3 * index + 10] = (250, 200, 40)
            writer.write(frame)
    shown = show(path, tmp_path)
    assert shown.problem == ""
    assert (shown.facts["width"], shown.facts["height"]) == (160, 80)
    assert shown.facts["duration_s"] == pytest.approx(2.0, abs=0.1)
    assert shown.facts["played_s"] > 0.1
