"""Every option of the NeRF and its default, once: plain dataclasses, no torch, no pydantic.

`metadata` carries what people and the API need: `help`, and where it applies `unit`, `ge`, `le`,
`choices`, and `plugins`: the kind of component that other packages may add to the choices.
`pipelines.options` turns these classes into checked pydantic models. Those of
methods are in `options.methods`.
"""

from __future__ import annotations

import dataclasses
import functools
import typing
from dataclasses import dataclass, field
from typing import Any

from pipelines.nerf.errors import NerfError
from pipelines.nerf.options.catalogue import find_method
from pipelines.nerf.options.methods.nerfacto import NerfactoConfig
from pipelines.nerf.options.parts import (
    ModelConfig,
    allowed_names,
    bad_option,
    option,
)


@dataclass(frozen=True)
class SplitConfig:
    """Which images are held out: nothing that is judged by them may be made from them."""

    eval_mode: str = option(
        "fraction",
        "How held-out images are chosen: `fraction` at equal intervals, `interval` every n-th, "
        "`stretch` neighbours along the path.",
        choices=("fraction", "interval", "stretch", "none"),
    )
    eval_fraction: float = option(
        0.1, "Share held out, at equal intervals, at least 3 images.", ge=0.0, le=0.9
    )
    eval_interval: int = option(8, "With `interval`: every n-th image is held out.", ge=2, le=1000)
    eval_stretch_fraction: float = option(
        0.1, "With `stretch`: share held out, at least 3 images.", ge=0.0, le=0.9
    )
    eval_stretch_place: float = option(
        0.5, "Where the stretch lies: 0 at the path's start, 1 at its end.", ge=0.0, le=1.0
    )


@dataclass(frozen=True)
class DataConfig(SplitConfig):
    """Which pixels are trained on."""

    long_side_px: int = option(1600, "Images are reduced to this.", unit="px", ge=32, le=16384)
    coarse_steps: int = option(
        0,
        "Until this step rays show the mean of a square of pixels, which shrinks by and by; 0 for "
        "single pixels from the start.",
        unit="steps",
        ge=0,
        le=10**7,
    )
    coarse_halvings: int = option(
        2, "How often the images are halved at first: squares of 2^n pixels.", ge=1, le=5
    )
    max_memory_gib: float = option(
        32.0,
        "Most memory that the images may take, 3 bytes a pixel, 4 with masks; more is refused.",
        unit="GiB",
        ge=0.01,
        le=4096.0,
    )
    images_on_gpu: bool = option(
        True,
        "Hold the images on the GPU, where they take at most half of its free memory, and draw "
        "pixels there; on a CPU it changes nothing.",
    )
    scale_poses: bool = option(True, "Scale the scene so that cameras lie in [-1, 1]^3.")


@dataclass(frozen=True)
class DepthLossConfig:
    """Depth maps of the capture as one more thing to fit, at first by and large, then finely.

    Both weight and spread change by and by: the field ends finer than the maps are.
    """

    weight: float = option(
        0.005, "Weight of the loss at the start; 0 leaves the maps unused.", ge=0.0, le=10.0
    )
    weight_final: float = option(0.001, "Weight at the end of the run.", ge=0.0, le=10.0)
    spread: float = option(
        0.3, "How far from a map's depth light may end at first, relative.", ge=1e-3, le=10.0
    )
    spread_final: float = option(0.04, "The same once it has shrunk.", ge=1e-3, le=10.0)
    spread_share: float = option(
        0.3, "Share of the run within which the spread shrinks.", ge=0.0, le=1.0
    )


@dataclass(frozen=True)
class GuidedConfig:
    """Steps whose samples lie where depth maps say that something stands, and a few before it.

    Such a ray costs a fraction of one that has to look for its surface, so that many more are seen
    in the same time. See `along_ray.guided`. For nerfacto; a GPU's captured steps take none.
    """

    share: float = option(
        0.0,
        "Share of the steps that are so, evenly among the others; 0 for none.",
        ge=0.0,
        le=0.9,
    )
    until: float = option(
        0.6, "Share of the run within which they are; then all look for themselves.", ge=0.0, le=1.0
    )
    least_known: float = option(
        0.75,
        "Share of the maps' pixels whose depth must be known for there to be any: of fewer such a "
        "step would tell too little.",
        ge=0.0,
        le=1.0,
    )
    rays_per_step: int = option(
        4096, "Rays drawn for such a step: those count whose depth is known.", ge=1, le=2**20
    )
    num_free_samples: int = option(2, "Samples before the surface.", ge=1, le=256)
    num_near_samples: int = option(4, "Samples around the surface.", ge=1, le=256)
    spread: float = option(
        0.1,
        "How far around the map's depth these lie at first, each way, relative.",
        ge=1e-3,
        le=0.9,
    )
    spread_final: float = option(0.02, "The same at the end of these steps.", ge=1e-3, le=0.9)


@dataclass(frozen=True)
class FlatLossConfig:
    """Plain surfaces have no bumps: lines of evenly coloured pixels as one more thing to fit.

    Where depth maps know nothing nothing tells their depth: they may bend, but not unevenly. See
    `along_ray.losses.bend_loss`.
    """

    when: str = option(
        "unknown",
        "unknown: where depth maps leave out 0.36 or more of what is plain in the pictures; "
        "the library alone takes it for never.",
        choices=("unknown", "always", "never"),
        former={"around": "unknown"},
    )
    weight: float = option(
        0.2,
        "Weight of how unevenly such lines bend; 0 leaves it out.",
        ge=0.0,
        le=10.0,
    )
    curve: float = option(
        0.1, "Weight, beside that, of how much they bend at all.", ge=0.0, le=10.0
    )
    share: float = option(0.2, "Share of the rays that lie on lines, four on each.", ge=0.0, le=1.0)
    reach: float = option(
        0.1, "Longest half of a line, as a part of the picture's long side.", ge=0.001, le=0.5
    )
    contrast: float = option(
        0.015, "Step of colour, in [0, 1], from which a line is plain no longer.", ge=1e-3, le=1.0
    )
    limit: float = option(
        0.02,
        "Bend, relative to the depth, up to which it counts by its square; by many times that it "
        "counts no more: an edge is no bend.",
        ge=1e-4,
        le=1.0,
    )


@dataclass(frozen=True)
class OptimizerConfig:
    """Adam and the decay of its rates; rates as nerfstudio 1.1.5."""

    lr: float = option(1e-2, "Rate of fields and proposals at the start.", ge=1e-7, le=1.0)
    lr_final: float = option(1e-4, "Rate at the end of the decay.", ge=1e-9, le=1.0)
    decay_steps: int = option(
        200_000,
        "Length of the decay; 0 for `max_steps`. A run that ends earlier, by `max_seconds`, ends "
        "at a higher rate.",
        unit="steps",
        ge=0,
        le=10**8,
    )
    decay: str = option(
        "exponential",
        "How the rate of fields and proposals falls: by one factor, or by one amount, a step.",
        choices=("exponential", "linear"),
    )
    camera_lr: float = option(1e-3, "Rate of the cameras at the start.", ge=1e-8, le=1.0)
    camera_lr_final: float = option(1e-4, "Rate of the cameras at the end.", ge=1e-9, le=1.0)
    camera_decay_steps: int = option(
        5000, "Length of their decay; 0 for `max_steps`.", unit="steps", ge=0, le=10**8
    )
    table_decay: float = option(
        0.0,
        "Times an entry of a hash grid's table, added to its gradient: what few rays tell anything "
        "falls back to nothing. Entries that never had a gradient stay.",
        ge=0.0,
        le=1.0,
    )
    # Squares of smaller gradients vanish in float32: less would divide what is left of the gradient
    # by nothing at all.
    eps: float = option(1e-15, "Adam's epsilon.", ge=1e-18, le=1.0)
    # The mean gradient keeps 0.9 a step. Below 0.81 the root of the mean square fades faster, and
    # entries that get a gradient now and then take longer and longer steps in between.
    beta2: float = option(
        0.999, "What is left of Adam's mean squared gradient at a step.", ge=0.9, le=0.999999
    )


@dataclass(frozen=True)
class TrainConfig:
    """A whole training run."""

    method: str = option("nerfacto", "The method; its options are those of `model`.")
    max_steps: int = option(30_000, "Optimiser steps.", unit="steps", ge=1, le=10**7)
    max_seconds: float = option(
        0.0, "Stop after this much training time; 0 for no limit.", unit="s", ge=0.0, le=10**7
    )
    rays_per_step: int = option(4096, "Rays in a batch.", ge=1, le=2**20)
    checkpoint_seconds: float = option(
        60.0, "Time between checkpoints.", unit="s", ge=1.0, le=86400.0
    )
    preview_every_steps: int = option(
        0, "Steps between preview pictures; 0 for a tenth of the run.", ge=0, le=10**7
    )
    device: str = option("auto", "Where to train.", choices=("auto", "cpu", "cuda"))
    engine: str = option(
        "auto",
        "`fast` uses compiled kernels, `plain` the PyTorch definitions.",
        choices=("auto", "plain", "fast"),
    )
    model: ModelConfig = field(
        default_factory=NerfactoConfig, metadata={"help": "The model's options."}
    )
    data: DataConfig = field(default_factory=DataConfig, metadata={"help": "The data's options."})
    depth: DepthLossConfig = field(
        default_factory=DepthLossConfig, metadata={"help": "What depth maps are used for."}
    )
    guided: GuidedConfig = field(
        default_factory=GuidedConfig, metadata={"help": "Steps that know where to look."}
    )
    flat: FlatLossConfig = field(
        default_factory=FlatLossConfig, metadata={"help": "How plain surfaces are kept from bumps."}
    )
    optimizer: OptimizerConfig = field(
        default_factory=OptimizerConfig, metadata={"help": "The optimiser's options."}
    )


def default_train_config(method: str) -> TrainConfig:
    """A run of a method with its own defaults."""
    chosen = find_method(method)
    config: TrainConfig = _with_values(
        TrainConfig(method=method, model=chosen.config()), chosen.train
    )
    return config


def _with_values(config: Any, values: typing.Mapping[str, Any]) -> Any:
    """A dataclass with nested plain values laid over it."""
    changes = {
        name: _with_values(getattr(config, name), value)
        if isinstance(value, typing.Mapping)
        else value
        for name, value in values.items()
    }
    return dataclasses.replace(config, **changes)


def validate(config: TrainConfig) -> None:
    """Check every value against its bounds, and the values against each other.

    Raises NerfError `bad_config` that names the option, its value and what is allowed.
    """
    wanted = find_method(config.method).config
    if not isinstance(config.model, wanted):
        raise bad_option("train.model", type(config.model).__name__, wanted.__name__)
    _check_fields(config, "train")
    config.model.check("train.model")


def _check_fields(config: Any, path: str) -> None:
    """Bounds and names of one dataclass and of those inside it."""
    for item in dataclasses.fields(config):
        value, name = getattr(config, item.name), f"{path}.{item.name}"
        if dataclasses.is_dataclass(value):
            _check_fields(value, name)
            continue
        choices = allowed_names(item.metadata)
        if choices and value not in choices:
            raise bad_option(name, value, ", ".join(choices))
        low, high = item.metadata.get("ge"), item.metadata.get("le")
        for part in value if isinstance(value, tuple) else (value,):
            if dataclasses.is_dataclass(part):
                _check_fields(part, name)
            elif low is not None and not low <= part <= high:
                raise bad_option(name, value, f"{low} to {high}")


@functools.cache
def _hints(cls: Any) -> dict[str, Any]:
    return typing.get_type_hints(cls)


def config_from_dict(cls: Any, values: dict[str, Any]) -> Any:
    """The inverse of `dataclasses.asdict` for the classes here, also after a trip through JSON.

    Raises NerfError `bad_config` for an unknown option.
    """
    hints = dict(_hints(cls))
    if cls is TrainConfig:
        hints["model"] = find_method(values.get("method", "nerfacto")).config
    made: dict[str, Any] = {}
    for name, value in values.items():
        if name not in hints:
            allowed = ", ".join(sorted(hints))
            raise NerfError("bad_config", f"{cls.__name__} has no option {name}: {allowed}.")
        annotation = hints[name]
        if dataclasses.is_dataclass(annotation):
            value = config_from_dict(annotation, value)
        elif typing.get_origin(annotation) is tuple:
            item = typing.get_args(annotation)[0]
            is_nested = dataclasses.is_dataclass(item)
            value = tuple(config_from_dict(item, part) if is_nested else part for part in value)
        made[name] = value
    return cls(**made)
