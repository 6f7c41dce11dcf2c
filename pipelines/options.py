"""The options of every stage, and the presets: what `GET /v1/options` and `--set` speak of.

Each default lives once: here, or for the NeRF in `pipelines.nerf.config`, whose dataclasses are
turned into pydantic models by `_model_of`. Unknown keys and values out of range are refused. No
torch is imported.
"""

from __future__ import annotations

import dataclasses
import types
import typing
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model

from pipelines.nerf.config import (
    NERFACTO,
    TrainConfig,
    allowed_names,
    config_from_dict,
    default_train_config,
    find_method,
    methods,
    validate,
)
from pipelines.nerf.errors import NerfError
from pipelines.nerf.evaluation_config import EvaluateConfig
from pipelines.nerf.plugins import Method
from pipelines.nerf.render_config import RenderConfig
from pipelines.registry import STAGE_NAMES


class StageOptions(BaseModel):
    """Common ground: unknown keys are refused, values are checked, instances are frozen."""

    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True)


class IngestOptions(StageOptions):
    """Limits on what is accepted."""

    max_duration_s: float = Field(1800.0, gt=0, le=86400, description="Longest video, in seconds.")
    max_images: int = Field(5000, ge=3, le=100_000, description="Most images in an archive.")
    max_posed_images: int = Field(
        600,
        ge=3,
        le=100_000,
        description="Images used of a Polycam or Record3D export, evenly picked.",
    )
    max_pixels: int = Field(
        200_000_000, ge=10_000, le=10**9, description="Most pixels in one image."
    )
    max_unpacked_bytes: int = Field(
        20 * 2**30, ge=2**20, le=2**40, description="Most bytes an archive may unpack to."
    )


class FramesOptions(StageOptions):
    """Which frames of a video are used."""

    num_frames: int = Field(300, ge=8, le=5000, description="Frames wanted, at even times.")
    long_side_px: int = Field(
        1920, ge=64, le=8192, description="Frames are reduced to this long side, in pixels."
    )
    candidates_per_frame: int = Field(
        6, ge=1, le=60, description="Frames looked at per window; the sharpest is taken."
    )
    jpeg_quality: int = Field(95, ge=50, le=100, description="JPEG quality of the frames kept.")


class PosesOptions(StageOptions):
    """Structure from motion."""

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
    camera_model: Literal["PINHOLE", "OPENCV", "OPENCV_FISHEYE", "SIMPLE_RADIAL"] = Field(
        "OPENCV", description="Lens model that is fitted."
    )
    min_registered_ratio: float = Field(
        0.3, ge=0, le=1, description="Below this share of registered images the job fails."
    )
    min_registered: int = Field(
        8, ge=3, le=1000, description="Below this number of registered images the job fails."
    )
    retry_below_ratio: float = Field(
        0.8,
        ge=0,
        le=1,
        description="Below this share of registered images, poses are sought again, thoroughly: "
        "all pairs, then lower thresholds.",
    )
    refine_principal_point: bool = Field(
        False, description="Fit the principal point too; needs many views."
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


class RenderingOptions(StageOptions):
    """Common to the stages that render."""

    render: RenderOptions = Field(
        default_factory=lambda: RenderOptions(), description="What rendering leaves out."
    )


class CropOptions(RenderingOptions):
    """What part of the scene is exported, common to mesh and point cloud."""

    max_distance: float = Field(
        2.0,
        gt=0,
        le=1000,
        description="Farthest surface kept from the cameras' focus, in units of the cameras' "
        "mean distance to it.",
    )


class PointcloudOptions(CropOptions):
    """The point cloud."""

    num_points: int = Field(1_000_000, ge=1000, le=50_000_000, description="Points wanted.")
    remove_outliers: bool = Field(True, description="Drop points far from their neighbours.")


class MeshOptions(CropOptions):
    """The mesh, by fusing rendered depth (TSDF)."""

    resolution: int = Field(
        256, ge=32, le=2048, description="Voxels along the longest side of the fused volume."
    )
    num_views: int = Field(
        0, ge=0, le=5000, description="Training views fused, evenly picked; 0 for all."
    )
    render_long_side_px: int = Field(
        640, ge=64, le=4096, description="Long side of the rendered depth, in pixels."
    )
    max_faces: int = Field(
        200_000, ge=100, le=20_000_000, description="The mesh is simplified to this."
    )


class VideoOptions(RenderingOptions):
    """The video along the captured path."""

    num_frames: int = Field(240, ge=8, le=20_000, description="Frames rendered.")
    fps: float = Field(24.0, ge=1, le=120, description="Frames per second.")
    long_side_px: int = Field(
        1280, ge=64, le=8192, description="Long side of the video, in pixels."
    )
    crf: int = Field(18, ge=0, le=40, description="x264 quality; lower is better and larger.")


class ReportOptions(StageOptions):
    """The report has no options."""


def _field_of(
    annotation: Any, field: dataclasses.Field[Any], default: Any = None
) -> tuple[Any, Any]:
    """A dataclass field as pydantic wants it: (annotation, FieldInfo).

    default: plain, in place of the field's own.
    """
    meta = dict(field.metadata)
    description = meta.get("help", "")
    if "unit" in meta:
        description = f"{description} Unit: {meta['unit']}."
    bounds = {key: meta[key] for key in ("ge", "le") if key in meta}
    if "choices" in meta:
        annotation = Literal[allowed_names(meta)]
        bounds = {}
    elif typing.get_origin(annotation) is tuple:
        (item, *_) = typing.get_args(annotation)
        item_model = _model_of(item) if dataclasses.is_dataclass(item) else item
        inner: Any = Annotated[item_model, Field(**bounds)] if bounds else item_model
        annotation = Annotated[tuple[inner, ...], Field(min_length=1, max_length=8)]
        bounds = {}
    elif dataclasses.is_dataclass(annotation):
        annotation = _model_of(annotation)
    if default is None and field.default_factory is not dataclasses.MISSING:
        default = _plain(field.default_factory())
    if default is not None:
        return annotation, Field(default_factory=lambda: default, description=description, **bounds)
    return annotation, Field(default=field.default, description=description, **bounds)


def _plain(value: Any) -> Any:
    """A dataclass, or a tuple of them, as plain data."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    if isinstance(value, tuple):
        return tuple(_plain(item) for item in value)
    return value


_MODELS: dict[tuple[type, str], type[StageOptions]] = {}


def _model_of(cls: Any, method: Method | None = None) -> type[StageOptions]:
    """The pydantic model with the fields, defaults and bounds of a dataclass.

    method: for `TrainConfig`, whose own options its `model` holds.
    """
    key = (cls, "" if method is None else method.name)
    if key not in _MODELS:
        name = cls.__name__.replace("Config", "Options")
        hints = typing.get_type_hints(cls)
        fields: dict[str, Any] = {
            field.name: _field_of(hints[field.name], field) for field in dataclasses.fields(cls)
        }
        if method is not None:
            name += "".join(part.title() for part in method.name.split("-"))
            fields |= _fields_of_method(method)
        _MODELS[key] = create_model(name, __base__=StageOptions, __doc__=cls.__doc__, **fields)
    return _MODELS[key]


def _fields_of_method(method: Method) -> dict[str, Any]:
    """The fields of `TrainConfig` in which one method differs from another."""
    defaults = default_train_config(method.name)
    fields: dict[str, Any] = {
        "method": (Literal[method.name], Field(method.name, description=method.summary)),
        "model": (
            _model_of(method.config),
            Field(
                default_factory=lambda: _plain(defaults.model), description="The model's options."
            ),
        ),
    }
    for name in method.train:
        item = next(field for field in dataclasses.fields(TrainConfig) if field.name == name)
        value = _plain(getattr(defaults, name))
        fields[name] = _field_of(typing.get_type_hints(TrainConfig)[name], item, value)
    return fields


def method_names() -> tuple[str, ...]:
    """What `train.method` may be, plugins' methods included."""
    return tuple(methods())


def train_options(method: str) -> type[StageOptions]:
    """`TrainConfig` with the options of a method, checked. Raises OptionsError for no method."""
    try:
        return _model_of(TrainConfig, find_method(method))
    except NerfError as error:
        raise OptionsError([("train.method", error.message)]) from error


TrainOptions: type[StageOptions] = train_options(NERFACTO.name)
"""`TrainConfig` with the options of the default method, checked."""

if TYPE_CHECKING:
    RenderOptions = StageOptions
else:
    RenderOptions = _model_of(RenderConfig)

EvaluateOptions: type[StageOptions] = _model_of(EvaluateConfig)
"""`EvaluateConfig`, checked."""


def train_config(options: StageOptions) -> TrainConfig:
    """What `pipelines.nerf` understands, from checked options."""
    config: TrainConfig = config_from_dict(TrainConfig, options.model_dump())
    return config


def evaluate_config(options: StageOptions) -> EvaluateConfig:
    """What the evaluation understands, from checked options."""
    config: EvaluateConfig = config_from_dict(EvaluateConfig, options.model_dump())
    return config


def render_config(options: RenderingOptions) -> RenderConfig:
    """What the renderer understands, from checked options."""
    config: RenderConfig = config_from_dict(RenderConfig, options.render.model_dump())
    return config


STAGE_OPTIONS: types.MappingProxyType[str, type[StageOptions]] = types.MappingProxyType(
    {
        "ingest": IngestOptions,
        "frames": FramesOptions,
        "poses": PosesOptions,
        "train": TrainOptions,
        "evaluate": EvaluateOptions,
        "pointcloud": PointcloudOptions,
        "mesh": MeshOptions,
        "video": VideoOptions,
        "report": ReportOptions,
    }
)


@dataclasses.dataclass(frozen=True)
class Preset:
    """A complete set of options: what differs from the defaults, by stage."""

    name: str
    summary: str
    overrides: dict[str, Any]


PRESETS: types.MappingProxyType[str, Preset] = types.MappingProxyType(
    {
        preset.name: preset
        for preset in (
            Preset(
                "preview",
                "A look within minutes, also without a GPU: small pictures, small networks.",
                {
                    "frames": {"num_frames": 72, "long_side_px": 960},
                    "poses": {"max_image_px": 960, "num_features": 4096},
                    "train": {
                        "max_steps": 1500,
                        "rays_per_step": 1024,
                        "model": {
                            "num_proposal_samples": (64, 32),
                            "num_nerf_samples": 24,
                            "grid": {"log2_table_size": 17, "max_res": 1024},
                            "anneal_steps": 300,
                            # In short runs codes and corrected poses together cost 2 to 4 dB on
                            # held-out views (photos-fox, 300 and 600 steps, one seed). The paper's
                            # table 2 agrees on the codes; on the poses it sees no such loss.
                            "appearance_dim": 0,
                            "camera_mode": "off",
                        },
                        "data": {"long_side_px": 480},
                        # docs/speed.md, "The preview's rate", has the measurements.
                        "optimizer": {"lr": 0.015, "decay_steps": 1500, "lr_final": 1e-3},
                    },
                    "pointcloud": {"num_points": 200_000},
                    "mesh": {"num_views": 48, "render_long_side_px": 240},
                    "video": {"num_frames": 96, "long_side_px": 480},
                },
            ),
            Preset("standard", "The paper's Nerfacto: 30,000 steps, for a GPU.", {}),
            Preset(
                "high",
                "The paper's long run: 70,000 steps and finer assets.",
                {
                    "train": {"max_steps": 70_000},
                    "pointcloud": {"num_points": 3_000_000},
                    "mesh": {"resolution": 512, "max_faces": 1_000_000},
                    "video": {"long_side_px": 1920},
                },
            ),
        )
    }
)


class OptionsError(ValueError):
    """Options that do not exist or are out of range. `errors`: (dotted path, what is wrong)."""

    def __init__(self, errors: list[tuple[str, str]]) -> None:
        super().__init__("; ".join(f"{path}: {problem}" for path, problem in errors))
        self.errors = errors


def merge(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """`base` with the nested keys of `over` laid on top; neither is changed."""
    merged = dict(base)
    for key, value in over.items():
        if isinstance(value, dict) and isinstance(merged.get(key), dict):
            merged[key] = merge(merged[key], value)
        else:
            merged[key] = value
    return merged


def resolve_options(preset: str, overrides: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Complete, checked, JSON-able options of all stages.

    preset: a key of `PRESETS`. overrides: nested `{stage: {option: value}}`.
    Raises OptionsError naming each wrong option, and KeyError for an unknown preset.
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
        try:
            if name == "train":
                model, base, wanted["train"] = _train_ground(given, wanted.get("train", {}))
            else:
                base = model().model_dump(mode="json")
            checked = model.model_validate(merge(merge(base, wanted.get(name, {})), given))
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
    return resolved


def _train_ground(
    given: dict[str, Any], wanted: dict[str, Any]
) -> tuple[type[StageOptions], dict[str, Any], dict[str, Any]]:
    """For the method that is asked for: its options, their defaults, and what the preset changes.

    Presets are made for Nerfacto; of their training options another method takes those that are
    not about the model and its optimiser.
    """
    method = str(given.get("method", NERFACTO.name))
    model = train_options(method)
    base = model().model_dump(mode="json")
    if method != NERFACTO.name:
        wanted = {key: value for key, value in wanted.items() if key not in ("model", "optimizer")}
    return model, base, wanted


def stage_options(stage: str, values: dict[str, Any]) -> StageOptions:
    """The checked options of one stage from plain values."""
    if stage == "train":
        return train_options(str(values.get("method", NERFACTO.name))).model_validate(values)
    return STAGE_OPTIONS[stage].model_validate(values)


def parse_assignments(assignments: list[str]) -> dict[str, Any]:
    """`["train.max_steps=500"]` as nested options. Values are JSON where they parse as JSON.

    Raises OptionsError for a text without "=" or without a stage.
    """
    import json

    nested: dict[str, Any] = {}
    for text in assignments:
        path, equals, raw = text.partition("=")
        keys = path.strip().split(".")
        if not equals or len(keys) < 2 or not all(keys):
            raise OptionsError([(text, "expected stage.option=value")])
        try:
            value: Any = json.loads(raw)
        except json.JSONDecodeError:
            value = raw
        level = nested
        for key in keys[:-1]:
            level = level.setdefault(key, {})
        level[keys[-1]] = value
    return nested
