"""Images placed on a model of others: what is left of incremental mapping where it has its points.

Mapping adjusts its model over and over while it grows, which costs the more the more images it has.
An image between two that are placed already needs none of that: its pose follows from the points
that it shows, which then get its observations. To adjust all together once is left to who asks.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

FEWEST, MOST, IN_ALL = 100, 400, 120_000
"""Observations of each placed image that stay, by how many images there are: they tell its pose as
well as the points are known, and the last adjustments' time and memory go by their number, time by
its square where many images see the same."""


def place_others(
    database: Path,
    folder: Path,
    options: Any,
    *,
    links: Path,
    placed: Callable[[int], None],
    tidied: Callable[[int], None],
) -> Any:
    """The model in `folder` with all images of the database that can be placed on it, as they were.

    options: `pycolmap.IncrementalPipelineOptions`. links: folder of the images. placed: called
    after each image with the number that the model holds now. tidied: called afterwards with the
    steps that are done, less than `num_tidying_steps`. What these raise ends the call.
    Returns a `pycolmap.Reconstruction`.
    """
    wanted = pycolmap.DatabaseCacheOptions()
    wanted.min_num_matches = options.min_num_matches
    with pycolmap.Database.open(database) as opened:
        cache = pycolmap.DatabaseCache.create(opened, wanted)
    model = pycolmap.Reconstruction(folder)
    mapped = frozenset(model.reg_image_ids())
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(model)
    try:
        _register(mapper, model, options, placed)
    finally:
        mapper.end_reconstruction(False)
    num = len(model.images)
    _thin(model, mapped, options.random_seed, tidied)
    tidied(num)
    limits = options.get_mapper()
    pycolmap.ObservationManager(model).filter_all_points3D(
        limits.filter_max_reproj_error, limits.filter_min_tri_angle
    )
    tidied(num + 1)
    _color(model, links, lambda done: tidied(num + 1 + done))
    tidied(2 * num + 1)
    model.update_point_3d_errors()
    tidied(2 * num + 2)
    return model


def num_tidying_steps(num_images: int) -> int:
    """Steps after the last image is placed, of which the last two are left to who asked for it: to
    write the model, and to read it."""
    return 2 * num_images + 4


def _thin(model: Any, mapped: frozenset[int], seed: int, tidied: Callable[[int], None]) -> None:
    """Leave some observations of each image that was not mapped."""
    random = np.random.default_rng(seed)
    image_ids = sorted(set(model.reg_image_ids()) - mapped)
    left = min(max(IN_ALL // max(len(image_ids), 1), FEWEST), MOST)
    for done, image_id in enumerate(image_ids):
        seen = model.image(image_id).get_observation_point2D_idxs()
        for index in random.permutation(seen)[left:].tolist():
            model.delete_observation(image_id, index)
        tidied(done)


def _register(mapper: Any, model: Any, options: Any, placed: Callable[[int], None]) -> None:
    """Place image by image, again as long as points that others brought let one more be placed."""
    mapping, triangulation = options.get_mapper(), options.get_triangulation()
    left = sorted(i for i, image in model.images.items() if not image.has_pose)
    while left:
        refused = []
        for image_id in left:
            if mapper.register_next_image(mapping, image_id):
                mapper.triangulate_image(triangulation, image_id)
            else:
                refused.append(image_id)
            placed(model.num_reg_images())
        if len(refused) == len(left):
            break
        left = refused


def _color(model: Any, links: Path, tidied: Callable[[int], None]) -> None:
    """Give points that are new since mapping, which are black, the colour that an image shows."""
    black = {i for i, point in model.points3D.items() if not point.color.any()}
    for done, image_id in enumerate(sorted(model.reg_image_ids())):
        if not black:
            break
        seen = {point.point3D_id for point in model.image(image_id).get_observation_points2D()}
        if black & seen:
            model.extract_colors_for_image(image_id, links)
            black -= seen
        tidied(done)
