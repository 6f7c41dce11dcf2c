"""Every option of the NeRF and its default, once: plain dataclasses, no torch, no pydantic.

`metadata` carries what people and the API need: `help`, and where it applies `unit`, `ge`, `le`,
`choices`. `pipelines.options` turns these classes into checked pydantic models. Defaults are the
paper's Nerfacto as its authors ship it (nerfstudio 1.1.5); a comment gives the reason for each
departure.
"""

from __future__ import annotations

import dataclasses
import typing
from dataclasses import dataclass, field
from typing import Any

from pipelines.nerf.errors import NerfError


def option(default: Any, help: str, **bounds: Any) -> Any:
    """A dataclass field with its meaning; `bounds`: unit, ge, le, choices."""
    return field(default=default, metadata={"help": help, **bounds})


@dataclass(frozen=True)
class HashGridConfig:
    """A multi-resolution hash grid (Instant-NGP, arXiv:2201.05989)."""

    num_levels: int = option(16, "Number of resolution levels.", ge=1, le=32)
    min_res: int = option(16, "Cells per side of the coarsest level.", ge=2, le=1024)
    max_res: int = option(2048, "Cells per side of the finest level.", ge=2, le=65536)
    log2_table_size: int = option(19, "log2 of the entries per level.", ge=8, le=24)
    features_per_level: int = option(2, "Features per entry.", ge=1, le=8)


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
class NerfactoConfig:
    """The model (paper, section 5; defaults of nerfstudio 1.1.5)."""

    near: float = option(0.05, "Nearest sample.", unit="scene units", ge=0.0, le=10.0)
    far: float = option(1000.0, "Farthest sample.", unit="scene units", ge=1.0, le=1e6)
    num_proposal_samples: tuple[int, ...] = option(
        (256, 96), "Samples per ray of each proposal round.", ge=1, le=4096
    )
    num_nerf_samples: int = option(48, "Samples per ray of the field.", ge=1, le=4096)
    proposals: tuple[ProposalConfig, ...] = field(
        default_factory=_default_proposals, metadata={"help": "The proposal networks."}
    )
    share_proposal_network: bool = option(False, "Use the first network in every round.")
    grid: HashGridConfig = field(
        default_factory=HashGridConfig, metadata={"help": "The field's hash grid."}
    )
    hidden_dim: int = option(64, "Width of the density MLP.", ge=1, le=1024)
    hidden_dim_color: int = option(64, "Width of the colour MLP.", ge=1, le=1024)
    geo_feature_dim: int = option(15, "Features from density to colour.", ge=1, le=256)
    appearance_dim: int = option(32, "Size of the per-image code; 0 for none.", ge=0, le=256)
    contraction: str = option(
        "linf", "How unbounded space is bounded.", choices=("linf", "l2", "none")
    )
    background: str = option(
        "last_sample",
        "Colour behind the last sample.",
        choices=("last_sample", "black", "white", "random"),
    )
    average_init_density: float = option(0.01, "Scale of density at the start.", ge=1e-6, le=1e3)
    single_jitter: bool = option(True, "One random offset per ray instead of one per sample.")
    camera_mode: str = option("so3xr3", "Camera optimisation.", choices=("off", "so3xr3", "se3"))
    camera_translation_penalty: float = option(1e-2, "Weight on moved cameras.", ge=0.0, le=1e3)
    camera_rotation_penalty: float = option(1e-3, "Weight on turned cameras.", ge=0.0, le=1e3)
    interlevel_weight: float = option(1.0, "Weight of the interlevel loss.", ge=0.0, le=1e3)
    distortion_weight: float = option(0.002, "Weight of the distortion loss.", ge=0.0, le=1e3)
    anneal_steps: int = option(1000, "Steps over which proposal weights sharpen.", ge=0, le=10**6)
    anneal_slope: float = option(10.0, "Slope of that sharpening.", ge=0.0, le=1e3)
    proposal_warmup_steps: int = option(
        5000, "Steps over which proposal updates become rarer.", ge=1, le=10**7
    )
    proposal_update_every: int = option(5, "Steps between proposal updates then.", ge=1, le=1000)


@dataclass(frozen=True)
class DataConfig:
    """Which pixels are trained on."""

    long_side_px: int = option(1600, "Images are reduced to this.", unit="px", ge=32, le=16384)
    eval_mode: str = option(
        "fraction", "How held-out images are chosen.", choices=("fraction", "interval", "none")
    )
    eval_fraction: float = option(
        0.1, "Share held out, at equal intervals, at least 5 images.", ge=0.0, le=0.9
    )
    eval_interval: int = option(8, "With `interval`: every n-th image is held out.", ge=2, le=1000)
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


@dataclass(frozen=True)
class TrainConfig:
    """A whole training run."""

    method: str = option("nerfacto", "The model.", choices=("nerfacto",))
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
    model: NerfactoConfig = field(
        default_factory=NerfactoConfig, metadata={"help": "The model's options."}
    )
    data: DataConfig = field(default_factory=DataConfig, metadata={"help": "The data's options."})
    optimizer: OptimizerConfig = field(
        default_factory=OptimizerConfig, metadata={"help": "The optimiser's options."}
    )


def validate(config: TrainConfig) -> None:
    """Check every value against its bounds, and the values against each other.

    Raises NerfError `bad_config` that names the option, its value and what is allowed.
    """
    _check_fields(config, "train")
    model = config.model
    rounds, networks = len(model.num_proposal_samples), len(model.proposals)
    if rounds < 1 or networks < 1:
        raise _bad("train.model.proposals", networks, "at least one network and one round")
    if networks < rounds and not model.share_proposal_network:
        allowed = f"at least the {rounds} rounds of num_proposal_samples, or share_proposal_network"
        raise _bad("train.model.proposals", f"{networks} networks", allowed)
    if model.near >= model.far:
        raise _bad("train.model.near", model.near, f"less than far ({model.far})")
    grids = {"train.model.grid": model.grid}
    grids |= {f"train.model.proposals.{i}.grid": p.grid for i, p in enumerate(model.proposals)}
    for path, grid in grids.items():
        if grid.max_res < grid.min_res:
            raise _bad(f"{path}.max_res", grid.max_res, f"at least min_res ({grid.min_res})")


def _bad(path: str, value: object, allowed: str) -> NerfError:
    return NerfError(
        "bad_config",
        f"The option {path} is {value!r}; allowed: {allowed}.",
        f"Set {path} to an allowed value.",
    )


def _check_fields(config: Any, path: str) -> None:
    """Bounds and choices of one dataclass and of those inside it."""
    for item in dataclasses.fields(config):
        value, name = getattr(config, item.name), f"{path}.{item.name}"
        if dataclasses.is_dataclass(value):
            _check_fields(value, name)
            continue
        choices = item.metadata.get("choices")
        if choices and value not in choices:
            raise _bad(name, value, ", ".join(choices))
        low, high = item.metadata.get("ge"), item.metadata.get("le")
        for part in value if isinstance(value, tuple) else (value,):
            if dataclasses.is_dataclass(part):
                _check_fields(part, name)
            elif low is not None and not low <= part <= high:
                raise _bad(name, value, f"{low} to {high}")


def config_from_dict(cls: Any, values: dict[str, Any]) -> Any:
    """The inverse of `dataclasses.asdict` for the classes here, also after a trip through JSON.

    Raises NerfError `bad_config` for an unknown option.
    """
    hints = typing.get_type_hints(cls)
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
