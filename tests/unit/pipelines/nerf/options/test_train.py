"""Options that do not go together are refused with what is allowed."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from typing import Any, cast

import pytest

from pipelines.nerf.errors import NerfError
from pipelines.nerf.options.methods.nerfacto import (
    MAX_GRID_VALUES,
    NerfactoConfig,
    TensorGridConfig,
)
from pipelines.nerf.options.parts import HashGridConfig
from pipelines.nerf.options.train import OptimizerConfig, TrainConfig, config_from_dict, validate

DEFAULT = TrainConfig()
MODEL = cast(NerfactoConfig, DEFAULT.model)


def test_the_defaults_are_valid_and_survive_json() -> None:
    validate(DEFAULT)
    assert config_from_dict(TrainConfig, json.loads(json.dumps(asdict(DEFAULT)))) == DEFAULT


def test_one_shared_network_may_serve_all_rounds() -> None:
    one = MODEL.proposals[:1]
    validate(replace(DEFAULT, model=replace(MODEL, proposals=one, share_proposal_network=True)))


@pytest.mark.parametrize(
    ("model", "named"),
    [
        ({"proposals": MODEL.proposals[:1]}, "at least the 2 rounds"),
        ({"near": 5.0, "far": 5.0}, r"less than far \(5.0\)"),
        ({"contraction": "sphere"}, "linf, l2, none"),
        ({"num_proposal_samples": (256, 0)}, "1 to 4096"),
        ({"grid": HashGridConfig(min_res=64, max_res=32)}, r"at least min_res \(64\)"),
        ({"hidden_dim": 0}, "1 to 1024"),
        (
            {"position_encoding": "voxel", "tensor_grid": TensorGridConfig(2048, 16)},
            "at most 406 with voxel and 16 components, which take 16 GiB",
        ),
        (
            {"position_encoding": "vm", "tensor_grid": TensorGridConfig(2048, 512)},
            "at most 835 with vm and 512 components",
        ),
    ],
)
def test_wrong_options_are_refused_by_name(model: dict[str, object], named: str) -> None:
    config = replace(DEFAULT, model=replace(MODEL, **model))  # type: ignore[arg-type]
    with pytest.raises(NerfError, match=named) as caught:
        validate(config)
    assert caught.value.code == "bad_config"


@pytest.mark.parametrize(
    ("encoding", "resolution", "components", "largest"),
    [
        ("voxel", 406, 16, (406**3 * 16, 407**3 * 16)),
        ("vm", 835, 512, (3 * 512 * (835**2 + 835), 3 * 512 * (836**2 + 836))),
    ],
)
def test_the_finest_grids_allowed_are_those_that_fit(
    encoding: str, resolution: int, components: int, largest: tuple[int, int]
) -> None:
    fits, too_many = largest
    assert fits <= MAX_GRID_VALUES < too_many
    grid = TensorGridConfig(resolution, components)
    model = replace(MODEL, position_encoding=encoding, tensor_grid=grid)
    validate(replace(DEFAULT, model=model))


@pytest.mark.parametrize("encoding", ["hash", "cp", "fourier"])
def test_encodings_without_dense_grids_may_be_as_fine_as_they_like(encoding: str) -> None:
    grid = TensorGridConfig(2048, 512)
    model = replace(MODEL, position_encoding=encoding, tensor_grid=grid)
    validate(replace(DEFAULT, model=model))


@pytest.mark.parametrize(
    ("rates", "named"),
    [
        ({"eps": 0.0}, "train.optimizer.eps is 0.0; allowed: 1e-18 to 1.0"),
        ({"beta2": 0.0}, "train.optimizer.beta2 is 0.0; allowed: 0.9 to 0.999999"),
        ({"beta2": 0.8}, "0.9 to 0.999999"),
    ],
)
def test_an_adam_that_would_divide_by_nothing_is_refused(rates: dict[str, Any], named: str) -> None:
    with pytest.raises(NerfError, match=named):
        validate(replace(DEFAULT, optimizer=OptimizerConfig(**rates)))


def test_unknown_options_are_refused() -> None:
    with pytest.raises(NerfError, match="no option colour"):
        config_from_dict(NerfactoConfig, {"colour": 1})
