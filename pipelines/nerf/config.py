"""Every option of the NeRF and its default, once: plain dataclasses, no torch, no pydantic.

`metadata` carries what people and the API need: `help`, and where it applies `unit`, `ge`, `le`,
`choices`, and `plugins`: the kind of component that other packages may add to the choices.
`pipelines.options` turns these classes into checked pydantic models. Defaults are the paper's
Nerfacto as its authors ship it (nerfstudio 1.1.5); a comment gives the reason for each departure.
"""

from __future__ import annotations

import dataclasses
import typing
from dataclasses import dataclass, field
from typing import Any

from pipelines.nerf.config_methods import INSTANT_NGP, NERF, InstantNgpConfig, NerfConfig
from pipelines.nerf.config_parts import (
    HashGridConfig,
    ModelConfig,
    allowed_names,
    bad_option,
    check_grid,
    check_spacing,
    contraction_option,
    option,
    spacing_option,
)
from pipelines.nerf.errors import NerfError
from pipelines.nerf.plugins import Method, plugin_methods

__all__ = [
    "BUILT_IN_METHODS",
    "NERFACTO",
    "DataConfig",
    "HashGridConfig",
    "InstantNgpConfig",
    "ModelConfig",
    "NerfConfig",
    "NerfactoConfig",
    "OptimizerConfig",
    "ProposalConfig",
    "TensorGridConfig",
    "TrainConfig",
    "allowed_names",
    "bad_option",
    "check_grid",
    "config_from_dict",
    "default_train_config",
    "find_method",
    "methods",
    "option",
    "validate",
]


@dataclass(frozen=True)
class ProposalConfig:
    """One proposal network: a small hash grid and a small MLP that give density."""

    grid: HashGridConfig = field(
        default_factory=lambda: HashGridConfig(
            num_levels=5, min_res=16, max_res=128, log2_table_size=17
        ),
        metadata={"help": "The network's hash grid."},
    )
    hidden_dim: int = option(16, "Width of the one hidden layer.", ge=1, le=256)


def _default_proposals() -> tuple[ProposalConfig, ...]:
    return (
        ProposalConfig(),
        ProposalConfig(
            grid=HashGridConfig(num_levels=5, min_res=16, max_res=256, log2_table_size=17)
        ),
    )


@dataclass(frozen=True)
class TensorGridConfig:
    """Position encodings other than the hash grid: CP, VM and the dense voxel grid."""

    resolution: int = option(128, "Vertices per side.", ge=2, le=2048)
    num_components: int = option(16, "Components (CP, per mode of VM) or features.", ge=1, le=512)


@dataclass(frozen=True)
class NerfactoConfig(ModelConfig):
    """The paper's default method (section 5; defaults of nerfstudio 1.1.5)."""

    num_proposal_samples: tuple[int, ...] = option(
        (256, 96), "Samples per ray of each proposal round.", ge=1, le=4096
    )
    num_nerf_samples: int = option(48, "Samples per ray of the field.", ge=1, le=4096)
    proposals: tuple[ProposalConfig, ...] = field(
        default_factory=_default_proposals, metadata={"help": "The proposal networks."}
    )
    share_proposal_network: bool = option(False, "Use the first network in every round.")
    spacing: str = spacing_option()
    position_encoding: str = option(
        "hash",
        "What the field sees of a place.",
        choices=("hash", "vm", "cp", "voxel", "fourier"),
        plugins="position_encoding",
    )
    grid: HashGridConfig = field(
        default_factory=HashGridConfig, metadata={"help": "The field's hash grid."}
    )
    tensor_grid: TensorGridConfig = field(
        default_factory=TensorGridConfig,
        metadata={"help": "The field's grid where position_encoding is vm, cp or voxel."},
    )
    direction_encoding: str = option(
        "spherical_harmonics",
        "What the field sees of a direction.",
        choices=("spherical_harmonics", "fourier"),
        plugins="direction_encoding",
    )
    hidden_dim: int = option(64, "Width of the density MLP.", ge=1, le=1024)
    hidden_dim_color: int = option(64, "Width of the colour MLP.", ge=1, le=1024)
    geo_feature_dim: int = option(15, "Features from density to colour.", ge=1, le=256)
    appearance_dim: int = option(32, "Size of the per-image code; 0 for none.", ge=0, le=256)
    # The reference has none: there, no ray of training ever saw the mean code that renders use.
    appearance_dropout: float = option(
        0.25, "Share of training rays that see the mean code, as renders do.", ge=0.0, le=1.0
    )
    contraction: str = contraction_option()
    average_init_density: float = option(0.01, "Scale of density at the start.", ge=1e-6, le=1e3)
    single_jitter: bool = option(True, "One random offset per ray instead of one per sample.")
    interlevel_weight: float = option(1.0, "Weight of the interlevel loss.", ge=0.0, le=1e3)
    distortion_weight: float = option(0.002, "Weight of the distortion loss.", ge=0.0, le=1e3)
    predict_normals: bool = option(
        False, "Learn normals too; training takes several times as long."
    )
    orientation_weight: float = option(1e-4, "Weight of the orientation loss.", ge=0.0, le=1e3)
    predicted_normal_weight: float = option(
        1e-3, "Weight of the predicted normals' loss.", ge=0.0, le=1e3
    )
    anneal_steps: int = option(1000, "Steps over which proposal weights sharpen.", ge=0, le=10**6)
    anneal_slope: float = option(10.0, "Slope of that sharpening.", ge=0.0, le=1e3)
    proposal_warmup_steps: int = option(
        5000, "Steps over which proposal updates become rarer.", ge=1, le=10**7
    )
    proposal_update_every: int = option(5, "Steps between proposal updates then.", ge=1, le=1000)

    def check(self, path: str) -> None:
        """As `ModelConfig.check`."""
        super().check(path)
        rounds, networks = len(self.num_proposal_samples), len(self.proposals)
        if rounds < 1 or networks < 1:
            raise bad_option(f"{path}.proposals", networks, "at least one network and one round")
        if networks < rounds and not self.share_proposal_network:
            allowed = (
                f"at least the {rounds} rounds of num_proposal_samples, or share_proposal_network"
            )
            raise bad_option(f"{path}.proposals", f"{networks} networks", allowed)
        check_grid(f"{path}.grid", self.grid)
        for index, proposal in enumerate(self.proposals):
            check_grid(f"{path}.proposals.{index}.grid", proposal.grid)
        check_spacing(path, self.spacing, self.near)


@dataclass(frozen=True)
class DataConfig:
    """Which pixels are trained on."""

    long_side_px: int = option(1600, "Images are reduced to this.", unit="px", ge=32, le=16384)
    eval_mode: str = option(
        "fraction",
        "How held-out images are chosen: `fraction` at equal intervals, `interval` every n-th, "
        "`stretch` neighbours along the path.",
        choices=("fraction", "interval", "stretch", "none"),
    )
    eval_fraction: float = option(
        0.1, "Share held out, at equal intervals, at least 5 images.", ge=0.0, le=0.9
    )
    eval_interval: int = option(8, "With `interval`: every n-th image is held out.", ge=2, le=1000)
    eval_stretch_fraction: float = option(
        0.1, "With `stretch`: share held out, at least 5 images.", ge=0.0, le=0.9
    )
    eval_stretch_place: float = option(
        0.5, "Where the stretch lies: 0 at the path's start, 1 at its end.", ge=0.0, le=1.0
    )
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
class OptimizerConfig:
    """Adam and its exponential decay; rates as nerfstudio 1.1.5."""

    lr: float = option(1e-2, "Rate of fields and proposals at the start.", ge=1e-7, le=1.0)
    lr_final: float = option(1e-4, "Rate at the end of the decay.", ge=1e-9, le=1.0)
    decay_steps: int = option(200_000, "Length of the decay.", unit="steps", ge=1, le=10**8)
    camera_lr: float = option(1e-3, "Rate of the cameras at the start.", ge=1e-8, le=1.0)
    camera_lr_final: float = option(1e-4, "Rate of the cameras at the end.", ge=1e-9, le=1.0)
    camera_decay_steps: int = option(5000, "Length of their decay.", unit="steps", ge=1, le=10**8)
    eps: float = option(1e-15, "Adam's epsilon.", ge=0.0, le=1.0)
    beta2: float = option(
        0.999, "What is left of Adam's mean squared gradient at a step.", ge=0.0, le=0.999999
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
    optimizer: OptimizerConfig = field(
        default_factory=OptimizerConfig, metadata={"help": "The optimiser's options."}
    )


NERFACTO = Method(
    name="nerfacto",
    summary="The paper's default method: fast, unbounded, for real captures.",
    config=NerfactoConfig,
    model="pipelines.nerf.models.nerfacto:Nerfacto",
)
BUILT_IN_METHODS = (NERFACTO, INSTANT_NGP, NERF)


def methods() -> dict[str, Method]:
    """Every method by name, the built-in ones first. Raises NerfError `bad_plugin`."""
    built_in = {method.name: method for method in BUILT_IN_METHODS}
    return built_in | plugin_methods(built_in)


def find_method(name: str) -> Method:
    """The method of a name. Raises NerfError `bad_config` with the names there are."""
    known = methods()
    if name not in known:
        raise bad_option("train.method", name, ", ".join(known))
    return known[name]


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


def config_from_dict(cls: Any, values: dict[str, Any]) -> Any:
    """The inverse of `dataclasses.asdict` for the classes here, also after a trip through JSON.

    Raises NerfError `bad_config` for an unknown option.
    """
    hints = typing.get_type_hints(cls)
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
