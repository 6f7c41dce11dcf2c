"""The paper's ablations of Nerfacto as named changes of the options (section 6.2, table 2).

Each takes a run's options and returns them with one thing changed. What the options were before is
kept: on a run of smaller networks "one proposal network" is the first of those.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from pipelines.nerf.errors import NerfError
from pipelines.nerf.options.methods.nerfacto import NerfactoConfig
from pipelines.nerf.options.train import TrainConfig

BOUNDED_FAR = 2.0 * math.sqrt(3.0)
"""The diagonal of the cube [-1, 1]^3: no ray that starts in it stays in it for longer."""

Ablation = Callable[[TrainConfig], TrainConfig]


def _changed(
    config: TrainConfig, change: Callable[[NerfactoConfig], dict[str, Any]]
) -> TrainConfig:
    """The options with some of Nerfacto's replaced by what `change` gives for them."""
    model = config.model
    if not isinstance(model, NerfactoConfig):
        raise NerfError(
            "bad_config",
            f"The paper's ablations are changes of nerfacto, and train.method is {config.method}.",
            "Set train.method to nerfacto.",
        )
    return replace(config, model=replace(model, **change(model)))


def _unchanged(config: TrainConfig) -> TrainConfig:
    return _changed(config, lambda model: {})


def _without_pose(config: TrainConfig) -> TrainConfig:
    return _changed(config, lambda model: {"camera_mode": "off"})


def _without_appearance(config: TrainConfig) -> TrainConfig:
    return _changed(config, lambda model: {"appearance_dim": 0})


def _without_pose_and_appearance(config: TrainConfig) -> TrainConfig:
    return _without_appearance(_without_pose(config))


def _one_proposal_network(config: TrainConfig) -> TrainConfig:
    """The first network, one round of its samples (the paper's appendix, table 4)."""
    return _changed(
        config,
        lambda model: {
            "num_proposal_samples": model.num_proposal_samples[:1],
            "proposals": model.proposals[:1],
        },
    )


def _l2_contraction(config: TrainConfig) -> TrainConfig:
    return _changed(config, lambda model: {"contraction": "l2"})


def _shared_proposal_network(config: TrainConfig) -> TrainConfig:
    return _changed(
        config, lambda model: {"share_proposal_network": True, "proposals": model.proposals[:1]}
    )


def _random_background(config: TrainConfig) -> TrainConfig:
    return _changed(config, lambda model: {"background": "random"})


def _no_contraction(config: TrainConfig) -> TrainConfig:
    return _changed(config, lambda model: {"contraction": "none"})


def _synthetic_on_real(config: TrainConfig) -> TrainConfig:
    """ "A bounded scene, no appearance embeddings, and no scene contraction" (appendix, table 4).

    Bounded is read as: samples end where the last ray leaves the cube of the scene.
    """
    return _changed(
        config,
        lambda model: {
            "far": min(model.far, BOUNDED_FAR),
            "appearance_dim": 0,
            "contraction": "none",
        },
    )


ABLATIONS: Mapping[str, Ablation] = MappingProxyType(
    {
        "nerfacto": _unchanged,
        "without pose": _without_pose,
        "without appearance": _without_appearance,
        "without pose and appearance": _without_pose_and_appearance,
        "one proposal network": _one_proposal_network,
        "l2 contraction": _l2_contraction,
        "shared proposal network": _shared_proposal_network,
        "random background": _random_background,
        "no contraction": _no_contraction,
        "synthetic on real": _synthetic_on_real,
    }
)
"""The rows of the paper's table 2, in its order."""


def ablated(config: TrainConfig, name: str) -> TrainConfig:
    """The options with a named ablation.

    Raises NerfError `bad_config` for a name that is not in `ABLATIONS`, or a method other than
    Nerfacto.
    """
    if name not in ABLATIONS:
        raise NerfError(
            "bad_config",
            f"There is no ablation {name!r}: {', '.join(ABLATIONS)}.",
            "Use one of these names.",
        )
    return ABLATIONS[name](config)
