"""A mesh with a picture on it, out of the photos of the capture.

Vertex colours cannot be finer than triangles are; photos are. Each face takes its colours from one
photo, which keeps them sharp; brightness is levelled across the seams, and in the end all photos
that see a place have a say (`pipelines.exports.texture.refining`). Faces that no photo shows
keep their vertices' colours. Memory: one photo at a time and the picture itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipelines.exports.mesh import TexturedMesh, TriangleMesh
from pipelines.exports.options import TextureOptions
from pipelines.exports.texture.charts import CELL_PX, Charts, Layout, TextureFull, cut, lay_out
from pipelines.exports.texture.choice import NOBODY, Surface, choose_photos
from pipelines.exports.texture.field import pixels_on, seen_from, texture_from_field
from pipelines.exports.texture.levelling import levels
from pipelines.exports.texture.photos import Photos, colors_at, softened
from pipelines.exports.texture.refining import refine
from pipelines.exports.texture.texels import ROWS, moving, spread, texels_of
from pipelines.exports.void import void_of_photos
from pipelines.scene.cameras_file import Intrinsics, PosedImage
from pipelines.scene.trained_scene import TrainedScene
from pipelines.stage import StageContext

Floats = NDArray[np.float64]
Bytes = NDArray[np.uint8]

_CHOICE_SHARE, _CUT_SHARE, _COPY_SHARE = 0.35, 0.4, 0.5
_LEVEL_SHARE, _ADD_SHARE = 0.52, 0.55
_MOST_POLLS = 1000
"""Of what solves for the corners' levels, about."""
_LOOK_SHARE = 0.1
_SPREAD_PX = 3


def painted(
    mesh: TriangleMesh,
    images: Sequence[PosedImage],
    lenses: Sequence[Intrinsics],
    options: TextureOptions,
    ctx: StageContext,
    shares: tuple[float, float],
    scene: TrainedScene | None = None,
) -> TriangleMesh | TexturedMesh:
    """The mesh of a stage, painted with some images of the capture where its options want that.

    shares: of the stage's progress, before and after. scene: what was trained, which the options
    may want to paint with; the images are then those that it was trained on. A mesh of more faces
    than the texture has room for stays as it is, with a warning.
    """
    if options.texture == "none":
        return mesh
    begin, end = shares

    def on_progress(done: float) -> None:
        ctx.progress(begin + (end - begin) * done, "painting", None)

    photos = Photos(ctx.workspace.images_root, images, lenses, void_of_photos(ctx.workspace))
    try:
        if options.texture == "field":
            if scene is None:
                raise ValueError("before training there is no field to paint with")
            pixel = pixels_on(mesh, images, lenses, scene.trained_long_side_px)
            toward = seen_from(mesh, photos, lambda done: on_progress(_LOOK_SHARE * done))
            return texture_from_field(
                mesh,
                scene.short_rays,
                pixel,
                toward,
                options.texture_px,
                lambda done: on_progress(_LOOK_SHARE + (1.0 - _LOOK_SHARE) * done),
            )
        return texture_from_photos(
            mesh, photos, options.texture_px, on_progress, options.refine_texture
        )
    except TextureFull as error:
        ctx.logger.warning(
            "The mesh keeps the colours of its vertices: %s. Raise texture_px, or lower max_faces.",
            error,
        )
        return mesh


def texture_from_photos(
    mesh: TriangleMesh,
    photos: Photos,
    largest_side: int,
    on_progress: Callable[[float], None] = lambda done: None,
    refined: bool = True,
) -> TexturedMesh:
    """Paint a mesh of the world. largest_side: of the texture, px, a power of two.

    refined: whether all photos that see a place have a say in its colour, or one of them alone.
    on_progress: told the share that is done; may raise. Raises TextureFull.
    """
    vertices = photos.frame.scene_from_world(mesh.vertices)
    surface = Surface(vertices, mesh.faces, mesh.normals)
    choice = choose_photos(surface, photos, lambda done: on_progress(_CHOICE_SHARE * done))

    def places(index: int, which: NDArray[np.int32]) -> Floats:
        on_progress(_CHOICE_SHARE)
        return photos.pixels(index, vertices[which])[0]

    charts = cut(mesh.faces, choice, places)
    layout = lay_out(charts, photos.size, largest_side)
    on_progress(_CUT_SHARE)
    # Smaller copies of the texture mix in what lies beside a patch: nothing there is dark.
    ground = np.rint(255.0 * np.clip(mesh.colors.mean(axis=0), 0.0, 1.0)).astype(np.uint8)
    picture, colors = _copied(
        charts,
        layout,
        photos,
        ground,
        lambda done: on_progress(_CUT_SHARE + (_COPY_SHARE - _CUT_SHARE) * done),
    )
    added = levels(charts, colors, moving(on_progress, _COPY_SHARE, _LEVEL_SHARE, _MOST_POLLS))
    own: NDArray[np.floating[Any]] = mesh.colors
    calls = layout.side // ROWS + 4 * _SPREAD_PX
    told = moving(on_progress, _LEVEL_SHARE, _ADD_SHARE, calls)
    covered = _level(picture, charts, layout, added, told)
    if refined:
        own = refine(
            *(picture, covered, own, surface, charts, layout, photos),
            lambda done: on_progress(_ADD_SHARE + (1.0 - _ADD_SHARE) * done),
        )
    _fill_cells(picture, charts, layout, own[charts.vertex])
    on_progress(1.0)
    return TexturedMesh(
        vertices=mesh.vertices[charts.vertex],
        faces=charts.faces,
        normals=mesh.normals[charts.vertex],
        uv=layout.uv / layout.side,
        texture=picture,
    )


def _copied(
    charts: Charts,
    layout: Layout,
    photos: Photos,
    ground: Bytes,
    on_progress: Callable[[float], None],
) -> tuple[Bytes, Floats]:
    """The patches in their places, and each corner's colour in its photo, [U, 3].

    ground: [3], what is where no patch is.
    """
    picture = np.broadcast_to(ground, (layout.side, layout.side, 3)).copy()
    colors = np.full((len(charts.vertex), 3), np.nan)
    by_photo = charts.photo[layout.charts]
    used = np.unique(by_photo)
    for done, index in enumerate(used, start=1):
        photo = photos.load(int(index))
        whole = np.asarray(photo)
        for row in np.flatnonzero(by_photo == index):
            left, top, right, bottom = layout.source[row].tolist()
            x, y, x_end, y_end = layout.target[row].tolist()
            size = (x_end - x, y_end - y)
            if size == (right - left, bottom - top):
                patch = whole[top:bottom, left:right]
            else:
                patch = np.asarray(
                    photo.resize(size, Image.Resampling.BOX, (left, top, right, bottom))
                )
            picture[y:y_end, x:x_end] = patch
        mine = charts.photo[charts.chart] == index
        colors[mine] = colors_at(softened(photo), charts.place[mine])
        on_progress(done / len(used))
    return picture, colors


def _level(
    picture: Bytes, charts: Charts, layout: Layout, added: Floats, on_rows: Callable[[], None]
) -> NDArray[np.bool_]:
    """Add what each corner needs, and between corners what lies between, in place.

    Returns which texels are on faces that a photo shows, [side, side].
    """
    shown = charts.photo[charts.face_chart] != NOBODY
    covered = np.zeros(picture.shape[:2], np.bool_)
    if not shown.any():
        return covered
    faces = charts.faces[shown]
    steps = np.zeros(picture.shape, np.int16)
    for texels in texels_of(layout.uv, faces, layout.side):
        values = np.einsum("nc,ncd->nd", texels.weights, added[faces[texels.face]])
        values = np.rint(255.0 * values)
        steps[texels.rows][texels.covered] = np.clip(values, -255, 255).astype(np.int16)
        covered[texels.rows] = texels.covered
        on_rows()
    spread(steps, covered.copy(), _SPREAD_PX, on_rows)
    np.clip(picture + steps, 0, 255, out=steps)
    picture[:] = steps.astype(np.uint8)
    return covered


def _fill_cells(
    picture: Bytes, charts: Charts, layout: Layout, colors: NDArray[np.floating[Any]]
) -> None:
    """Gradients between the corners' own colours [U, 3], for faces that no photo shows."""
    alone = np.flatnonzero(charts.photo[charts.face_chart] == NOBODY)
    if len(alone) == 0:
        return
    corners = charts.faces[alone]
    start = np.floor(layout.uv[corners[:, 0]]).astype(int)
    first, right, below = (colors[corners[:, k]] for k in range(3))
    reach = CELL_PX - 1
    for dy in range(CELL_PX):
        for dx in range(CELL_PX):
            value = first + (right - first) * (dx / reach) + (below - first) * (dy / reach)
            texels = np.rint(255.0 * np.clip(value, 0.0, 1.0)).astype(np.uint8)
            picture[start[:, 1] + dy, start[:, 0] + dx] = texels
