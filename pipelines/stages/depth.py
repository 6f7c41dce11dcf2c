"""The depth stage: where surfaces are, from pictures and sensor, before anything is trained.

Reads `cameras.json` of `poses` or `ingest`, the images beside it, the depth that the capture
brings, and the points of structure from motion where there are any. Writes a depth map for each
image that will be trained on, agreed upon by its neighbours, and how brightly it was taken where
that drifts (`maps.json`, `maps/`), and `depth.jpg` to look at. Held-out images take no part, nor
does their depth: what they judge must not be made from them.
"""

from __future__ import annotations

import functools
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipelines.captures.daylight import is_daylight
from pipelines.captures.record import CaptureRecord
from pipelines.errors import TrainingError
from pipelines.exports.shades import depth_picture, depth_range
from pipelines.nerf.ahead import each_ahead
from pipelines.nerf.data.images import split_indices
from pipelines.nerf.data.light import Light
from pipelines.nerf.judging.off_path import evenly
from pipelines.nerf.options.stereo import StereoConfig
from pipelines.nerf.options.train import SplitConfig, config_from_dict
from pipelines.nerf.stereo.blank import find_blank
from pipelines.nerf.stereo.completing import completed
from pipelines.nerf.stereo.dark import find_dark
from pipelines.nerf.stereo.engines import Engine, TorchEngine, choose_engine
from pipelines.nerf.stereo.light import find_light
from pipelines.nerf.stereo.maps import MapShelf, Progress, find_depth_maps, surface_points
from pipelines.nerf.stereo.neighbours import choose_neighbours
from pipelines.nerf.stereo.sensor import merged_maps, sensor_maps, sensor_scale
from pipelines.nerf.stereo.shelves import Shelf
from pipelines.nerf.stereo.sky import find_sky
from pipelines.nerf.stereo.standing import stood_up
from pipelines.nerf.stereo.views import StereoView
from pipelines.nerf.stereo.void import without
from pipelines.option_models import StageOptions
from pipelines.scene.cameras_file import CamerasFile, PosedImage
from pipelines.scene.depth_maps_file import DepthMapsWriter
from pipelines.scene.depth_views import Pinhole
from pipelines.scene.natural_order import natural_key
from pipelines.scene.stereo_views import (
    cut_away,
    sensor_depth,
    stereo_view,
    undistorted_picture,
)
from pipelines.scene.trained_scene import nerf_errors_as, use_all_cores
from pipelines.stage import StageContext
from pipelines.stages.depth_checkpoint import DepthCheckpoint, inputs_of
from pipelines.stages.void_masks import BY_CUTS, known_points, up_and_points, up_of_world

_LOAD_SHARE, _STEREO_SHARE, _VOID_SHARE, _PLANES_SHARE, _WALLS_SHARE = 0.05, 0.7, 0.02, 0.1, 0.1
_LIGHT_SHARE = 0.03
_PICTURE_VIEWS = 6


def run(options: StageOptions, ctx: StageContext) -> dict[str, Any]:
    """Find the maps. Raises TrainingError where nothing is left to learn from."""
    use_all_cores()
    values = options.model_dump()
    source = values.pop("source")
    split: SplitConfig = config_from_dict(SplitConfig, values.pop("held_out"))
    config: StereoConfig = config_from_dict(StereoConfig, values)
    writer = DepthMapsWriter(ctx.out)
    if source == "off":
        writer.close()
        return {"source": source, "num_maps": 0}
    capture, images = training_images(ctx, split)
    with_sensor = source in ("auto", "sensor") and any(image.depth for image in images)
    if source == "sensor" and not with_sensor:
        raise TrainingError(
            "The capture brings no depth, and depth.source is sensor.",
            code="no_sensor_depth",
            hint="Set depth.source to auto or stereo.",
        )
    search = _Search.prepared(ctx, capture, images, config, source if with_sensor else "stereo")
    maps, told = search.all_passes()
    lights, told["light"] = _light(search, maps)
    for image, view, found, light in zip(images, search.views, maps, lights, strict=True):
        ctx.check_cancelled()
        writer.append(image.file, _pinhole(view), found, light)
    writer.close(measured=with_sensor)
    _save_picture(ctx.out / "depth.jpg", search.views, maps)
    summary = {"num_maps": len(images), "device": search.device, **told, **_described(maps)}
    (ctx.out / "report.json").write_text(json.dumps(summary, indent=1), "utf-8")
    search.checkpoint.close()
    return summary


Found = tuple[MapShelf, dict[str, Any]]
"""A pass's maps, and what is told of it."""


@dataclass
class _Search:
    """The passes over a capture's views, each complete in the checkpoint before the next begins.

    source: "stereo", or with a sensor "auto" or "sensor". patches: of the pictures, where they were
    looked for. colors: the pictures, where they were asked for.
    """

    ctx: StageContext
    capture: CamerasFile
    images: list[PosedImage]
    views: list[StereoView]
    config: StereoConfig
    source: str
    engine: Engine
    checkpoint: DepthCheckpoint
    patches: Shelf
    colors: Shelf
    started: float

    @classmethod
    def prepared(
        cls,
        ctx: StageContext,
        capture: CamerasFile,
        images: list[PosedImage],
        config: StereoConfig,
        source: str,
    ) -> _Search:
        """Load the images, and what an attempt before has found."""
        started = time.monotonic()

        def load(image: PosedImage) -> StereoView:
            lens, root = capture.cameras[image.camera], ctx.workspace.images_root
            return stereo_view(root, image, lens, config.long_side_px)

        views: list[StereoView] = []
        for view in each_ahead(load, images):
            views.append(view)
            ctx.progress(_LOAD_SHARE * len(views) / len(images), "loading images")
        with nerf_errors_as(TrainingError):
            engine = choose_engine(views, config)
        files = [image.file for image in images]
        depends = [inputs_of(ctx), files, asdict(config), source, _device(engine)]
        checkpoint = DepthCheckpoint(ctx, len(views), depends)
        patches, colors = (
            checkpoint.shelves.scratch(name, len(views)) for name in ("patches", "colors")
        )
        given = ctx, capture, images, views, config, source
        return cls(*given, engine, checkpoint, patches, colors, started)

    @property
    def device(self) -> str:
        """Who computes, as it is told."""
        return _device(self.engine)

    @functools.cached_property
    def up(self) -> NDArray[np.float64]:
        """[3], unit."""
        return up_of_world(self.capture)

    def all_passes(self) -> Found:
        """Maps of all images, and what is told of them."""
        passes: list[tuple[str, Callable[[], Found]]] = [("matched", self._matched)]
        if self.config.find_blank or self.config.find_sky or self.config.find_dark:
            passes.append(("void", self._without_void))
        if self.config.complete_planes:
            passes.append(("planes", self._completed))
        if self.config.standing_walls:
            passes.append(("walls", self._stood_up))
        for name, work in passes:
            if name not in self.checkpoint.passes:
                self.checkpoint.complete(name, *work())
            if name == "void":
                self._see_nothing_there()
        return self.checkpoint.maps(), self.checkpoint.told

    def color_picture(self, index: int) -> NDArray[np.uint8]:
        """A view's picture in colour, [H, W, 3], sRGB."""
        if not self.colors.has(index):
            image, view = self.images[index], self.views[index]
            lens, root = self.capture.cameras[image.camera], self.ctx.workspace.images_root
            self.colors[index] = undistorted_picture(root, image, lens, _pinhole(view))
        picture: NDArray[np.uint8] = self.colors[index]
        return picture

    def _progress(self, begun: float, share: float) -> Progress:
        """Of a part of the stage. What is found so far is offered, before a cancel ends it."""

        def report(fraction: float, message: str) -> None:
            self.checkpoint.offer()
            done = begun + share * fraction
            spent = time.monotonic() - self.started
            stereo = begun < _LOAD_SHARE + _STEREO_SHARE
            eta_s = spent * (1.0 - done) / done if done > 0.1 and stereo else None
            self.ctx.progress(done, message, eta_s)

        return report

    def _matched(self) -> Found:
        on_progress = self._progress(_LOAD_SHARE, _STEREO_SHARE)
        points, shelves = known_points(self.ctx.workspace), self.checkpoint.shelves
        if self.source == "stereo":
            with_points = self.views, self.config, points, on_progress
            return find_depth_maps(*with_points, self.engine, shelves), {"source": "stereo"}
        sensed = self._sensed()
        told: dict[str, Any] = {
            "source": "sensor",
            "num_sensor_maps": sum(z is not None for z in sensed),
        }
        if self.source == "sensor":
            return sensor_maps(self.views, sensed, self.config, self.engine, shelves), told
        points = surface_points(self.views, sensed) if points is None else points
        with_points = self.views, self.config, points, on_progress
        stereo = find_depth_maps(*with_points, self.engine, shelves)
        scale = sensor_scale(stereo, sensed)
        if scale.factor != 1.0:
            self.ctx.logger.warning(
                "The sensor's depths are multiplied by %.4g to fit the camera poses", scale.factor
            )
            sensed = [None if z is None else z * np.float32(scale.factor) for z in sensed]
        told |= {
            "source": "stereo and sensor",
            "sensor_scale": round(scale.factor, 6),
            "sensor_scale_spread": None if scale.spread is None else round(scale.spread, 5),
        }
        measured = sensor_maps(self.views, sensed, self.config, self.engine, shelves)
        return merged_maps(stereo, measured, shelves), told

    def _sensed(self) -> list[NDArray[np.float32] | None]:
        """What the capture's sensor saw, as the views have it; None for an image without depth."""
        root, found = self.ctx.workspace.images_root, []
        for image, view in zip(self.images, self.views, strict=True):
            self.ctx.check_cancelled()
            lens = self.capture.cameras[image.camera]
            found.append(sensor_depth(root, image, lens, _pinhole(view)))
        return found

    def _cut_away(self) -> list[NDArray[np.bool_]] | None:
        """Where nothing stands in each view, of pictures that were cut out by masks; else None."""
        root = self.ctx.workspace.images_root
        found = [
            cut_away(root, image, self.capture.cameras[image.camera], _pinhole(view))
            for image, view in zip(self.images, self.views, strict=True)
        ]
        cut = [mask for mask in found if mask is not None]
        return cut if len(cut) == len(found) else None

    def _without_void(self) -> Found:
        maps, views = self.checkpoint.maps(), self.views
        on_progress = self._progress(_LOAD_SHARE + _STEREO_SHARE, _VOID_SHARE)

        def quarter(begun: int, message: str) -> Callable[[float], None]:
            return lambda share: on_progress((begun + share) / 4.0, message)

        sensed = None if self.source == "stereo" else self._sensed()
        told: dict[str, Any] = {}
        masks = [np.zeros(view.picture.shape, np.bool_) for view in views]
        cut = self._cut_away() if self.config.find_blank else None
        if cut is not None:
            share = float(np.mean([mask.mean() for mask in cut]))
            told["blank"] = {**_rounded(share, len(cut)), "by": BY_CUTS}
            masks = cut
        elif self.config.find_blank:
            seen = views, self.color_picture, maps.z, sensed
            blank = find_blank(*seen, quarter(0, "looking for a blank ground"))
            told["blank"] = _rounded(blank.share, blank.num_views)
            if blank.color is not None:
                told["blank"]["color"] = list(blank.color)
                told["blank"]["is_paper"] = blank.is_paper
                masks = blank.masks
        is_cut_out = told.get("blank", {}).get("share", 0.0) > 0.0
        if self.config.find_sky and not is_cut_out:
            known = up_and_points(self.ctx.workspace, self.capture)
            given = views, self.color_picture, maps.z, *known, sensed, self.patches
            daylight = is_daylight(CaptureRecord.load(self.ctx.workspace.stage("ingest")))
            sky = find_sky(*given, quarter(1, "looking for the sky"), daylight=daylight)
            told["sky"] = {
                **_rounded(sky.share, sky.num_views),
                "far": round(sky.far, 3),
                "by_day": sky.by_day,
                "daylight": daylight,
                "blown_out": round(sky.blown_out, 3),
            }
            masks = sky.masks
        # By day what is black is an unlit side of something.
        is_day = bool(told.get("sky", {}).get("share"))
        if self.config.find_dark and not is_day and not is_cut_out:
            lit = views, self.color_picture, maps.z, sensed, self.patches
            dark = find_dark(*lit, quarter(2, "looking into the dark"))
            told["dark"] = _rounded(dark.share, dark.num_views)
            masks = [one | other for one, other in zip(masks, dark.masks, strict=True)]
        if any(mask.any() for mask in masks):
            on_share, shelves = quarter(3, "comparing what is nothing"), self.checkpoint.shelves
            maps = without(masks, views, maps, self.config, on_share, self.engine, shelves)
            self.ctx.logger.info(
                "nothing stands where pictures show no more than their ground: %s", told
            )
        return maps, told

    def _see_nothing_there(self) -> None:
        """What comes later looks at pictures that have nothing where nothing stands."""
        found = [seen.is_void for seen in self.checkpoint.maps()]
        if not any(mask.any() for mask in found):
            return
        for index, mask in enumerate(found):
            picture = np.where(mask, np.float32(-1.0), self.views[index].picture)
            self.views[index] = replace(self.views[index], picture=picture)
        self.patches = self.checkpoint.shelves.scratch("patches", len(self.views))

    def _completed(self) -> Found:
        maps = self.checkpoint.maps()
        told = {"matched_share": round(_known_share(maps), 4)}
        on_progress = self._progress(_LOAD_SHARE + _STEREO_SHARE + _VOID_SHARE, _PLANES_SHARE)
        given = self.views, maps, self.config, on_progress, self.engine
        return completed(*given, self.checkpoint.shelves, self.patches, up=self.up), told

    def _stood_up(self) -> Found:
        maps = self.checkpoint.maps()
        told = {"before_walls_share": round(_known_share(maps), 4)}
        begun = _LOAD_SHARE + _STEREO_SHARE + _VOID_SHARE + _PLANES_SHARE
        on_progress = self._progress(begun, _WALLS_SHARE)
        given = self.views, maps, self.config, on_progress, self.engine
        return stood_up(*given, self.checkpoint.shelves, self.patches, up=self.up), told


def _rounded(share: float, num_views: int) -> dict[str, Any]:
    return {"share": round(share, 4), "num_views": num_views}


def _device(engine: Engine) -> str:
    return engine.device.type if isinstance(engine, TorchEngine) else "cpu"


def _light(search: _Search, maps: MapShelf) -> tuple[list[Light | None], dict[str, Any] | None]:
    """The light of each picture, None of each where they stay as they are; and what was found."""
    ctx, views, config = search.ctx, search.views, search.config
    nothing: list[Light | None] = [None] * len(views)
    if config.level_light == "off":
        return nothing, None

    def on_progress(share: float) -> None:
        done = 1.0 - _LIGHT_SHARE * (1.0 - share)
        ctx.progress(done, "comparing the pictures' light")

    points = surface_points(views, maps.z)
    if len(points) == 0:
        return nothing, None
    for index, _ in enumerate(each_ahead(search.color_picture, range(len(views)))):
        on_progress(0.5 * (index + 1) / len(views))
    neighbours = choose_neighbours(views, points, config.num_neighbours, config.best_angle_deg)
    light = find_light(
        views, maps.z, search.colors, neighbours, lambda share: on_progress(0.5 + 0.5 * share)
    )
    level = config.level_light == "on" or light.is_drifting
    told = {
        "levelled": level,
        "drift": round(light.drift, 4),
        "contradiction": round(light.contradiction, 4),
        "largest_ratio": round(float((light.gains.max(axis=0) / light.gains.min(axis=0)).max()), 3),
        "bend": light.bend,
        "num_pairs": light.num_pairs,
        "num_held": light.num_held,
    }
    if level:
        ctx.logger.info("the pictures are brought to one light: %s", told)
    return [light.of(index) for index in range(len(views))] if level else nothing, told


def training_images(ctx: StageContext, split: SplitConfig) -> tuple[CamerasFile, list[PosedImage]]:
    """The capture, and the images of it that training will learn from, in its order."""
    capture = CamerasFile.load(ctx.workspace.posed_cameras)
    ordered = sorted(capture.images, key=lambda image: natural_key(image.file))
    with nerf_errors_as(TrainingError):
        trained, _ = split_indices(len(ordered), split)
    return capture, [ordered[index] for index in trained]


def _pinhole(view: StereoView) -> Pinhole:
    height, width = view.picture.shape
    return Pinhole(width, height, *view.lens)


def _known_share(maps: MapShelf) -> float:
    return float(np.mean([(found.z > 0).mean() for found in maps]))


def _described(maps: MapShelf) -> dict[str, Any]:
    """How much of the pictures has a depth, and how many neighbours agree with it."""
    shares = [float((found.z > 0).mean()) for found in maps]
    votes = [float(found.votes[found.z > 0].mean()) for found in maps if (found.z > 0).any()]
    return {
        "known_share": round(_known_share(maps), 4),
        "least_known_share": round(float(np.min(shares)), 4),
        "mean_votes": round(float(np.mean(votes)), 2) if votes else None,
    }


def _save_picture(path: Path, views: list[StereoView], maps: MapShelf) -> None:
    """Some of the pictures, their maps below: near is bright, far is dark, grey is unknown.

    What is nothing is black in both.
    """
    picked = evenly(len(views), _PICTURE_VIEWS)
    height = max(views[index].picture.shape[0] for index in picked)
    columns = []
    for index in picked:
        grey = np.clip(views[index].picture, 0.0, 1.0)[..., None] * np.ones(3) * 255.0
        z = maps[index].z
        shades = depth_picture(z, depth_range(z))
        shades[maps[index].is_void] = 0
        both = (np.rint(grey).astype(np.uint8), shades)
        padded = [np.pad(item, ((0, height - len(item)), (0, 4), (0, 0))) for item in both]
        columns.append(np.concatenate(padded))
    Image.fromarray(np.concatenate(columns, axis=1)).save(path, quality=88)
