"""The options of every stage: what `GET /v1/options` and `--set` speak of.

Each default lives once: here, for the exports in `pipelines.exports.kinds`, or for the NeRF in
`pipelines.nerf.options`, whose dataclasses `pipelines.option_models` turns into pydantic models.
Unknown keys and values out of range are refused. No torch is imported.
"""

from __future__ import annotations

import dataclasses
import functools
import types
from collections.abc import Collection
from typing import Any, Literal

from pydantic import Field, ValidationError

from pipelines.captures.minimum import MIN_IMAGES, MIN_POSED_IMAGES
from pipelines.exports.catalogue import EXPORTS
from pipelines.exports.options import ExtentOptions, TextureOptions
from pipelines.nerf.errors import NerfError
from pipelines.nerf.options.catalogue import find_method, methods
from pipelines.nerf.options.evaluate import EvaluateConfig
from pipelines.nerf.options.methods.nerfacto import NERFACTO
from pipelines.nerf.options.stereo import StereoConfig
from pipelines.nerf.options.train import SplitConfig, TrainConfig, config_from_dict, validate
from pipelines.option_models import ContradictionError, StageOptions, merge, model_of
from pipelines.presets import PRESETS
from pipelines.registry import STAGE_NAMES, skipped_stages


class IngestOptions(StageOptions):
    """Limits on what is accepted."""

    max_duration_s: float = Field(1800.0, gt=0, le=86400, description="Longest video, in seconds.")
    max_images: int = Field(
        5000, ge=MIN_IMAGES, le=100_000, description="Most images in an archive."
    )
    max_posed_images: int = Field(
        600,
        ge=MIN_POSED_IMAGES,
        le=100_000,
        description="Images used of a phone app's export, evenly picked.",
    )
    max_pixels: int = Field(
        200_000_000, ge=10_000, le=10**9, description="Most pixels in one image."
    )
    max_unpacked_bytes: int = Field(
        20 * 2**30, ge=2**20, le=2**40, description="Most bytes an archive may unpack to."
    )
    projection: Literal["auto", "flat", "equirectangular"] = Field(
        "auto",
        description="What videos and photos without poses show: a plain view, or the whole sphere "
        "as an equirectangular panorama. auto believes what the files say of themselves.",
    )
    panorama_views: int = Field(
        4,
        ge=4,
        le=6,
        description="Views of 90 degrees that are cut from a panorama of the whole sphere: 4 "
        "around the horizon, 5 with the one upwards, 6 with the one downwards, where mostly the "
        "camera's bearer is.",
    )
    masks: Literal["auto", "cut_out", "ignore", "off"] = Field(
        "auto",
        description="What is meant by masks that lie beside photos under their names, white where "
        "the photo counts: cut_out leaves the thing that is white and nothing around it, ignore "
        "passes over what is black, off passes over the masks. auto takes them for cut-outs where "
        "there is black all around. Masks that a capture's poses name always hide what is black.",
    )


class FramesOptions(StageOptions):
    """Which frames of a video are used."""

    num_frames: int = Field(
        300,
        ge=8,
        le=5000,
        description="Frames wanted, at even times; up to twice as many where `max_step` asks for "
        "it.",
    )
    max_step: float = Field(
        0.1,
        ge=0.0,
        le=1.0,
        description="Where the picture moves further than this share of its long side from one "
        "frame to the next, frames are taken at shorter times. 0 for even times.",
    )
    long_side_px: int = Field(
        1920, ge=64, le=8192, description="Frames are reduced to this long side, in pixels."
    )
    candidates_per_frame: int = Field(
        6, ge=1, le=60, description="Frames looked at per window; the sharpest is taken."
    )
    jpeg_quality: int = Field(95, ge=50, le=100, description="JPEG quality of the frames kept.")
    find_burned_in: bool = Field(
        True, description="Cut off bars, ignore dates and logos, and cut out what alone turns."
    )


class PosesOptions(StageOptions):
    """Structure from motion, and poses that came with the capture."""

    given: Literal["auto", "trust", "refine", "ignore"] = Field(
        "auto",
        description="Poses that came with the capture are compared with matches of a sample of "
        "pictures. auto refines those that fit less well than exact ones do, and takes the result "
        "where matches that were set aside confirm it; refine tries it in any case and takes what "
        "is no worse; both read poses that most matches contradict by another convention, if they "
        "fit so, and find others from the pictures for poses that fit in no way; trust leaves them "
        "as they came; ignore finds poses from the pictures alone.",
    )
    max_image_px: int = Field(
        1600, ge=240, le=8192, description="Features are found at this long side, in pixels."
    )
    num_features: int = Field(8192, ge=256, le=65536, description="Most features per image.")
    upsample: Literal["auto", "on", "off"] = Field(
        "auto",
        description="Double images before looking for features: finds more of them, for three "
        "times the work. auto does so where images show few.",
    )
    matcher: Literal["auto", "sequential", "exhaustive", "retrieval"] = Field(
        "auto",
        description="Which pairs are matched at first. auto is all pairs of few images, "
        "neighbours in time of a video's frames, and neighbours in looks of many photos.",
    )
    sequential_overlap: int = Field(
        10, ge=1, le=100, description="Neighbours matched on each side in a sequence."
    )
    retrieval_neighbours: int = Field(
        20, ge=1, le=200, description="Photos most alike that each photo is matched with."
    )
    camera_model: Literal[
        "auto", "SIMPLE_RADIAL", "RADIAL", "PINHOLE", "OPENCV", "OPENCV_FISHEYE"
    ] = Field(
        "auto",
        description="Lens model that is fitted. auto starts with SIMPLE_RADIAL (square pixels, one "
        "radial term) and goes to RADIAL or OPENCV where that lowers the error of observations "
        "that were set aside; OPENCV_FISHEYE where the matches of a film fit no plain lens, while "
        "photos of a fisheye must be called so here.",
    )
    min_registered_ratio: float = Field(
        0.3, ge=0, le=1, description="Below this share of registered images the job fails."
    )
    min_registered: int = Field(
        MIN_IMAGES,
        ge=3,
        le=1000,
        description="Below this number of registered images the job fails.",
    )
    min_baseline_deg: float = Field(
        2.0,
        ge=0,
        le=90,
        description="Below this angle between the directions that the same point is seen from (the "
        "median) depth is not determined, and the job fails. Unit: degrees.",
    )
    retry_below_ratio: float = Field(
        0.8,
        ge=0,
        le=1,
        description="Below this share of registered images, poses are sought again, thoroughly: "
        "larger pictures and more pairs, then all pairs with lower thresholds.",
    )
    few_photos: int = Field(
        40,
        ge=0,
        le=1000,
        description="Of so many photos and fewer each counts: poses are sought again where one is "
        "missing.",
    )
    refine_principal_point: bool = Field(
        False, description="Fit the principal point too; needs many views."
    )
    subpixel: bool = Field(
        False,
        description="After mapping, look for each feature's patch in the other pictures that show "
        "it, to a fraction of a pixel, and adjust poses, points and lens to that.",
    )
    orientation: Literal["auto", "none"] = Field(
        "auto", description="Turn the world so that gravity points along -Z."
    )
    num_threads: int = Field(-1, ge=-1, le=1024, description="Threads; -1 for all.")
    memory_mb: int = Field(
        4000,
        ge=100,
        le=1_000_000,
        description="Memory for finding features: where large images would take more, fewer are "
        "worked on at a time. Unit: 10^6 bytes.",
    )


class CheckOptions(StageOptions):
    """The capture report: how it was filmed."""

    good_ratio: float = Field(
        0.9,
        ge=0,
        le=1,
        description="Below this share of pictures with a pose a capture is not called good.",
    )
    usable_ratio: float = Field(
        0.6,
        ge=0,
        le=1,
        description="Below this share it is called poor.",
    )
    num_pictures: int = Field(
        36,
        ge=0,
        le=200,
        description="Pictures shown on the page, evenly picked; besides one of each stretch that "
        "was lost.",
    )


class DepthOptions(model_of(StereoConfig)):  # type: ignore[misc]
    """Depth maps before training."""

    source: Literal["auto", "stereo", "sensor", "off"] = Field(
        "auto",
        description="stereo compares each picture with its neighbours; sensor takes the depth that "
        "the capture brings; auto is both where it brings some, else stereo; off leaves training "
        "without depth maps.",
    )
    held_out: model_of(SplitConfig) = Field(  # type: ignore[valid-type]
        default_factory=lambda: dataclasses.asdict(SplitConfig()),
        description="Which images take no part: always as in train.data, which is the place to "
        "change it.",
    )


class DraftOptions(ExtentOptions, TextureOptions):
    """The mesh from depth maps alone, before training."""

    texture: Literal["photos", "none"] = Field(
        "photos",
        description="photos puts a picture on the mesh, made of the photos; none leaves it its "
        "vertices' colours.",
    )
    refine_texture: bool = Field(
        False,
        description="As mesh.refine_texture; off, as a draft is for a first look.",
    )
    resolution: int = Field(
        160, ge=32, le=2048, description="Voxels along the longest side of the subject."
    )
    num_views: int = Field(
        64, ge=0, le=5000, description="Depth maps fused, evenly picked; 0 for all."
    )
    max_faces: int = Field(
        100_000, ge=100, le=20_000_000, description="Simplified to this, as mesh.max_faces."
    )
    required: bool = Field(
        False,
        description="Fail the job with empty_mesh where the depth maps show no surface; without it "
        "the job goes on, its mesh comes from training.",
    )


class AssessOptions(StageOptions):
    """The delivered mesh and cloud against the photos, and whether the surfaces hold together."""

    num_views: int = Field(
        8, ge=0, le=5000, description="Held-out photos compared, evenly picked; 0 for all."
    )
    long_side_px: int = Field(
        320, ge=32, le=4096, description="Long side at which they are compared, in pixels."
    )
    num_pictures: int = Field(
        4, ge=0, le=5000, description="Of these, how many are kept as pictures."
    )
    min_coverage: float = Field(
        0.5,
        ge=0,
        le=1,
        description="Below this share of the photos' pixels covered by the mesh, the report warns "
        "of poor geometry.",
    )
    max_depth_inconsistency: float = Field(
        0.05,
        ge=0,
        le=1,
        description="Above this share of surface points that other views see through, it does, "
        "too.",
    )
    min_psnr: float = Field(
        18.0,
        ge=0,
        le=100,
        description="Below this PSNR of the model against held-out photos, the report warns of a "
        "poor model. Unit: dB.",
    )
    require_geometry: bool = Field(
        False,
        description="Fail the job with geometry_poor in place of its warning.",
    )


class ReportOptions(StageOptions):
    """The report has no options."""


def method_names() -> tuple[str, ...]:
    """What `train.method` may be, plugins' methods included."""
    return tuple(methods())


def train_options(method: str) -> type[StageOptions]:
    """`TrainConfig` with the options of a method, checked. Raises OptionsError for no method."""
    try:
        return model_of(TrainConfig, find_method(method))
    except NerfError as error:
        raise OptionsError([("train.method", error.message)]) from error


TrainOptions: type[StageOptions] = train_options(NERFACTO.name)
"""`TrainConfig` with the options of the default method, checked."""

EvaluateOptions: type[StageOptions] = model_of(EvaluateConfig)
"""`EvaluateConfig`, checked."""


def train_config(options: StageOptions) -> TrainConfig:
    """What `pipelines.nerf` understands, from checked options."""
    config: TrainConfig = config_from_dict(TrainConfig, options.model_dump())
    return config


def evaluate_config(options: StageOptions) -> EvaluateConfig:
    """What the evaluation understands, from checked options."""
    config: EvaluateConfig = config_from_dict(EvaluateConfig, options.model_dump())
    return config


STAGE_OPTIONS: types.MappingProxyType[str, type[StageOptions]] = types.MappingProxyType(
    {
        "ingest": IngestOptions,
        "frames": FramesOptions,
        "poses": PosesOptions,
        "check": CheckOptions,
        "depth": DepthOptions,
        "draft": DraftOptions,
        "train": TrainOptions,
        "evaluate": EvaluateOptions,
        **{export.kind: export.options for export in EXPORTS},
        "assess": AssessOptions,
        "report": ReportOptions,
    }
)


ON_REQUEST = frozenset(export.kind for export in EXPORTS if export.on_request)
"""Exports that a job makes only where it has options for them, be they the defaults."""


def stages_skipped(preset: str, kind: str, asked: Collection[str] = ()) -> frozenset[str]:
    """The stages that a job skips: for its preset, its kind of capture, and unless asked for.

    asked: stages that the job has options for. Raises KeyError for an unknown preset or kind.
    """
    return PRESETS[preset].without | (ON_REQUEST - set(asked)) | skipped_stages(kind)


class OptionsError(ValueError):
    """Options that do not exist or are out of range. `errors`: (dotted path, what is wrong)."""

    def __init__(self, errors: list[tuple[str, str]]) -> None:
        super().__init__("; ".join(f"{path}: {problem}" for path, problem in errors))
        self.errors = errors


def laid_over(
    stage: str, model: type[StageOptions], base: dict[str, Any], given: dict[str, Any]
) -> dict[str, Any]:
    """`given` laid over a base, as the model understands both. Raises OptionsError."""
    try:
        return merge(*model.understood(base, given))
    except ContradictionError as error:
        raise OptionsError([(f"{stage}.{error.name}", str(error))]) from error


@functools.cache
def _defaults(model: type[StageOptions]) -> dict[str, Any]:
    """All options of a stage as they are where nobody says more. For reading alone: it is kept."""
    return model().model_dump(mode="json")


def resolve_options(
    preset: str, overrides: dict[str, Any], *, is_request: bool = True
) -> dict[str, dict[str, Any]]:
    """Complete, checked, JSON-able options of all stages.

    preset: a key of `PRESETS`. overrides: nested `{stage: {option: value}}`; a request, unless they
    were laid over others already (`laid_over`).
    Raises OptionsError naming each wrong option and each stage that has options here and is left
    out by the preset, and KeyError for an unknown preset.
    """
    wanted = dict(PRESETS[preset].overrides)
    errors: list[tuple[str, str]] = [
        (name, f"no such stage; there are {', '.join(STAGE_NAMES)}")
        for name in overrides
        if name not in STAGE_OPTIONS
    ]
    resolved: dict[str, dict[str, Any]] = {}
    for name, model in STAGE_OPTIONS.items():
        given = overrides.get(name, {})
        if not isinstance(given, dict):
            errors.append((name, "expected an object of options"))
            continue
        if given and name in PRESETS[preset].without:
            errors.append((name, f"the preset {preset} has no such stage"))
            continue
        try:
            if name == "train":
                model, base, wanted["train"] = _train_ground(given, wanted.get("train", {}))
            else:
                base = _defaults(model)
            base = merge(base, wanted.get(name, {}))
            laid = laid_over(name, model, base, given) if is_request else merge(base, given)
            checked = model.model_validate(laid)
            if name == "train":
                validate(train_config(checked))
        except OptionsError as error:
            errors += error.errors
            continue
        except NerfError as error:
            errors.append(("train", error.message))
            continue
        except ValidationError as error:
            for item in error.errors():
                path = ".".join(str(part) for part in (name, *item["loc"]))
                errors.append((path, item["msg"]))
            continue
        resolved[name] = checked.model_dump(mode="json")
    if errors:
        raise OptionsError(errors)
    _hold_out_the_same(resolved, overrides)
    return resolved


def revise_options(
    preset: str, present: dict[str, dict[str, Any]], changes: dict[str, Any]
) -> dict[str, dict[str, Any]]:
    """Complete options of a job that is run again: those that it has, with some changed.

    present: as `resolve_options` gave them once. changes: nested `{stage: {option: value}}`; with
    another `train.method` training begins with the preset's options. Raises as `resolve_options`.
    """
    kept = {
        name: STAGE_OPTIONS.get(name, StageOptions).completed(values)
        for name, values in present.items()
        if name not in PRESETS[preset].without
    }
    kept.get("depth", {}).pop("held_out", None)  # follows train.data
    present_method = kept.get("train", {}).get("method")
    training = changes.get("train")
    if isinstance(training, dict) and training.get("method", present_method) != present_method:
        kept.pop("train", None)
    for name, given in changes.items():
        if isinstance(given, dict) and name in STAGE_OPTIONS:
            given = laid_over(name, STAGE_OPTIONS[name], kept.get(name, {}), given)
        kept[name] = given
    return resolve_options(preset, kept, is_request=False)


def _hold_out_the_same(resolved: dict[str, dict[str, Any]], overrides: dict[str, Any]) -> None:
    """What `train` holds out takes no part in `depth` either.

    Raises OptionsError where somebody asks for another thing than that.
    """
    data, depth = resolved["train"]["data"], resolved["depth"]
    same = {name: data[name] for name in depth["held_out"]}
    if "held_out" in overrides.get("depth", {}) and depth["held_out"] != same:
        raise OptionsError([("depth.held_out", "must be as in train.data: set it there alone")])
    depth["held_out"] = same


def _train_ground(
    given: dict[str, Any], wanted: dict[str, Any]
) -> tuple[type[StageOptions], dict[str, Any], dict[str, Any]]:
    """For the method that is asked for: its options, their defaults, and what the preset changes.

    Presets are made for Nerfacto; of their training options another method takes those that are
    not about the model and its optimiser.
    """
    method = str(given.get("method", NERFACTO.name))
    model = train_options(method)
    base = _defaults(model)
    if method != NERFACTO.name:
        wanted = {key: value for key, value in wanted.items() if key not in ("model", "optimizer")}
    return model, base, wanted


def stage_options(stage: str, values: dict[str, Any]) -> StageOptions:
    """The checked options of one stage from plain values."""
    method = str(values.get("method", NERFACTO.name))
    model = train_options(method) if stage == "train" else STAGE_OPTIONS[stage]
    return model.model_validate(model.completed(values))
