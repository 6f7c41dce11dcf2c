"""Training options of the benchmarks: a preset, changed by `--set model.x=value`.

Only the presets themselves come from `pipelines.options`, which wants pydantic; the paper's
settings, the defaults of `pipelines.nerf.options.train`, need no more than `pipelines.nerf`.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from typing import Any

from pipelines.nerf.errors import NerfError
from pipelines.nerf.options.methods.nerfacto import NerfactoConfig
from pipelines.nerf.options.train import (
    TrainConfig,
    config_from_dict,
    default_train_config,
    validate,
)

SAMPLINGS = ("paper", "preview")


def preset_config(name: str) -> TrainConfig:
    """The training options of a preset. `paper`, which is none, is the
    defaults and needs no pydantic.

    Raises NerfError `bad_config` where there is no such preset or no pydantic.
    """
    if name == "paper":
        return TrainConfig()
    try:
        from pipelines.presets import PRESETS
    except ModuleNotFoundError as error:
        raise NerfError(
            "bad_config",
            f"The preset {name} cannot be read: {error}.",
            "Install pydantic, or use paper and --set.",
        ) from error
    if name not in PRESETS:
        raise NerfError("bad_config", f"There is no preset {name}: {', '.join(PRESETS)}.")
    config: TrainConfig = _of_same_kind(TrainConfig(), PRESETS[name].overrides["train"], name)
    validate(config)
    return config


def method_config(method: str, preset: str) -> TrainConfig:
    """The options of a method: of Nerfacto those of the preset, of another its own defaults."""
    return preset_config(preset) if method == "nerfacto" else default_train_config(method)


def sampling_model(name: str) -> NerfactoConfig:
    """The paper's model with the samples and grids of "paper" or of the preset "preview".

    Poses and codes are those of the paper in both.
    """
    model = NerfactoConfig()
    if name == "paper":
        return model
    small = preset_config(name).model
    if not isinstance(small, NerfactoConfig):
        raise NerfError("bad_config", f"The preset {name} does not train Nerfacto.")
    return dataclasses.replace(
        model,
        num_proposal_samples=small.num_proposal_samples,
        num_nerf_samples=small.num_nerf_samples,
        proposals=small.proposals,
        grid=small.grid,
        anneal_steps=small.anneal_steps,
    )


def overridden(config: TrainConfig, assignments: Sequence[str]) -> TrainConfig:
    """The options with `["model.near=0.1", "max_steps=50", "model.proposals.0.hidden_dim=32"]`.

    Values are JSON where they parse as JSON, else text. Raises NerfError `bad_config` for a text
    without "=", an option that does not exist, a value of another type or out of range.
    """
    for text in assignments:
        path, equals, raw = text.partition("=")
        if not equals:
            raise NerfError("bad_config", f"{text!r} is not option=value.")
        try:
            value: Any = json.loads(raw)
        except json.JSONDecodeError:
            value = raw
        config = _replaced(config, path.strip().removeprefix("train.").split("."), value, path)
    validate(config)
    return config


def _replaced(current: Any, keys: list[str], value: Any, path: str) -> Any:
    """`current` with the value at the end of `keys` changed; nothing is changed in place."""
    if not keys:
        return _of_same_kind(current, value, path)
    key, rest = keys[0], keys[1:]
    if isinstance(current, tuple) and key.isdigit() and int(key) < len(current):
        items = list(current)
        items[int(key)] = _replaced(items[int(key)], rest, value, path)
        return tuple(items)
    names = [item.name for item in dataclasses.fields(current)] if _is_config(current) else []
    if key not in names:
        raise NerfError("bad_config", f"There is no option {path}: {', '.join(names) or 'none'}.")
    return dataclasses.replace(
        current, **{key: _replaced(getattr(current, key), rest, value, path)}
    )


def _of_same_kind(current: Any, value: Any, path: str) -> Any:
    """A value as the kind of the one that it replaces."""
    if _is_config(current) and isinstance(value, dict):
        for key, item in value.items():
            current = _replaced(current, [key], item, f"{path}.{key}")
        return current
    if isinstance(current, tuple) and isinstance(value, list | tuple) and current:
        kind = type(current[0])
        if dataclasses.is_dataclass(kind):
            return tuple(config_from_dict(kind, item) for item in value)
        return tuple(_of_same_kind(current[0], item, path) for item in value)
    if isinstance(current, float) and type(value) is int:
        return float(value)
    if type(value) is not type(current):
        raise NerfError(
            "bad_config",
            f"The option {path} is {value!r}, a {type(value).__name__}; "
            f"it takes a {type(current).__name__} such as {current!r}.",
        )
    return value


def _is_config(value: Any) -> bool:
    return dataclasses.is_dataclass(value) and not isinstance(value, type)
