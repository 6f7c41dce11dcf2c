"""A mesh with a picture on it, out of the photos of the capture.

Vertex colours cannot be finer than triangles are; photos are. Each face takes its colours from one
photo, which keeps them sharp; brightness is levelled across the seams, and in the end all photos
that see a place have a say (`pipelines.exports.texture.refining`). Faces that no photo shows
keep their vertices' colours, on charts of their own. What of the picture lies on no face goes on
with the colours of the faces beside it, as viewers mix it in from afar. Memory: one photo at a time
and the picture itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipelines.exports.mesh import TexturedMesh, TriangleMesh
from pipelines.exports.options import TextureOptions
from pipelines.exports.texture.alone import Gradients, gradient_density
from pipelines.exports.texture.charts import MARGIN_PX, Charts, Layout, cut, lay_out
from pipelines.exports.texture.choice import NOBODY, Surface, choose_photos
from pipelines.exports.texture.field import pixels_on, seen_from, texture_from_field
from pipelines.exports.texture.levelling import levels
from pipelines.exports.texture.packing import TextureFull
from pipelines.exports.texture.photos import Photos, colors_at, softened
from pipelines.exports.texture.refining import refine
from pipelines.exports.texture.texels import ROWS, fill, moving, spread, texels_of
from pipelines.exports.texture.unwrap import laid_flat
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
_REFINE_SHARE = 0.98
_LOOK_SHARE = 0.1


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

    def poll() -> None:
        on_progress(_CHOICE_SHARE)

    def places(index: int, which: NDArray[np.int32]) -> Floats:
        poll()
        return photos.pixels(index, vertices[which])[0]

    def flat(faces: NDArray[np.int32]) -> tuple[NDArray[np.int32], Floats]:
        found = laid_flat(vertices, faces, gradient_density(vertices, faces, photos), poll)
        return found.face_chart, found.place

    charts = cut(mesh.faces, choice, places, flat)
    layout = lay_out(charts, photos.size, largest_side, poll)
    on_progress(_CUT_SHARE)
    picture, laid, colors = _copied(
        charts,
        layout,
        photos,
        lambda done: on_progress(_CUT_SHARE + (_COPY_SHARE - _CUT_SHARE) * done),
    )
    added = levels(charts, colors, moving(on_progress, _COPY_SHARE, _LEVEL_SHARE, _MOST_POLLS))
    calls = -(-layout.size[1] // ROWS) + 4 * MARGIN_PX * (1 + refined)
    told = moving(on_progress, _LEVEL_SHARE, _ADD_SHARE, calls)
    covered, known = _level(picture, charts, layout, added, told)
    known &= laid
    if refined:
        # What a patch shows around its faces may lie behind them: at a pixel that mixes both, the
        # face would make up for it.
        known = covered
        spread(picture, known, MARGIN_PX, told)
    gradients = Gradients(charts, layout)
    known[gradients.rows, gradients.columns] = True
    own: NDArray[np.floating[Any]] = mesh.colors
    gradients.paint(picture, own[charts.vertex])
    fill(picture, known)
    if refined:
        own = refine(
            *(picture, own, surface, charts, layout, photos),
            lambda done: on_progress(_ADD_SHARE + (_REFINE_SHARE - _ADD_SHARE) * done),
        )
        gradients.paint(picture, own[charts.vertex])
        fill(picture, known)
    on_progress(1.0)
    return TexturedMesh(
        vertices=mesh.vertices[charts.vertex],
        faces=charts.faces,
        normals=mesh.normals[charts.vertex],
        uv=layout.uv / layout.size,
        texture=picture,
    )


def _copied(
    charts: Charts, layout: Layout, photos: Photos, on_progress: Callable[[float], None]
) -> tuple[Bytes, NDArray[np.bool_], Floats]:
    """The patches in their places [H, W, 3], where any is [H, W], and each corner's colour in its
    photo, [U, 3]."""
    width, height = layout.size
    picture = np.zeros((height, width, 3), np.uint8)
    laid = np.zeros((height, width), np.bool_)
    colors = np.full((len(charts.vertex), 3), np.nan)
    by_photo = charts.photo[layout.charts]
    used = np.unique(by_photo)
    for done, index in enumerate(used, start=1):
        photo = photos.load(int(index))
        whole = np.asarray(photo)
        for row in np.flatnonzero(by_photo == index):
            left, top, right, bottom = layout.source[row].tolist()
            size = tuple(layout.scaled[row].tolist())
            if size == (right - left, bottom - top):
                patch = whole[top:bottom, left:right]
            else:
                patch = np.asarray(
                    photo.resize(size, Image.Resampling.BOX, (left, top, right, bottom))
                )
            laid[layout.packing.lay(int(layout.charts[row]), patch, picture)] = True
        mine = charts.photo[charts.chart] == index
        colors[mine] = colors_at(softened(photo), charts.place[mine])
        on_progress(done / len(used))
    return picture, laid, colors


def _level(
    picture: Bytes, charts: Charts, layout: Layout, added: Floats, on_rows: Callable[[], None]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Add what each corner needs, and between corners and beside faces what lies there, in place.

    Returns which texels [H, W] are on faces that a photo shows, or all of a patch with none; and
    these with their margins.
    """
    shown = charts.photo[charts.face_chart] != NOBODY
    covered = np.zeros(picture.shape[:2], np.bool_)
    if not shown.any():
        return covered, covered.copy()
    faces, chart = charts.faces[shown], charts.face_chart[shown]
    missed = np.ones(len(charts.photo), np.bool_)
    steps = np.zeros(picture.shape, np.int16)
    for texels in texels_of(layout.uv, faces, layout.size):
        values = np.einsum("nc,ncd->nd", texels.weights, added[faces[texels.face]])
        values = np.rint(255.0 * values)
        steps[texels.rows][texels.covered] = np.clip(values, -255, 255).astype(np.int16)
        covered[texels.rows] = texels.covered
        missed[chart[texels.face]] = False
        on_rows()
    for one in layout.charts[missed[layout.charts]].tolist():
        covered[layout.packing.texels(one)] = True
    grown = covered.copy()
    spread(steps, grown, MARGIN_PX, on_rows)
    np.clip(picture + steps, 0, 255, out=steps)
    picture[:] = steps.astype(np.uint8)
    return covered, grown
