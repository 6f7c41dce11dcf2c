"""Options that do not go together are refused with what is allowed."""

from __future__ import annotations

import json
from dataclasses import asdict, replace

import pytest

from pipelines.nerf.config import (
    HashGridConfig,
    NerfactoConfig,
    TrainConfig,
    config_from_dict,
    validate,
)
from pipelines.nerf.errors import NerfError

DEFAULT = TrainConfig()


def test_the_defaults_are_valid_and_survive_json() -> None:
    validate(DEFAULT)
    assert config_from_dict(TrainConfig, json.loads(json.dumps(asdict(DEFAULT)))) == DEFAULT


def test_one_shared_network_may_serve_all_rounds() -> None:
    one = DEFAULT.model.proposals[:1]
    validate(
        replace(DEFAULT, model=replace(DEFAULT.model, proposals=one, share_proposal_network=True))
    )


@pytest.mark.parametrize(
    ("model", "named"),
    [
        ({"proposals": DEFAULT.model.proposals[:1]}, "at least the 2 rounds"),
        ({"near": 5.0, "far": 5.0}, r"less than far \(5.0\)"),
        ({"contraction": "sphere"}, "linf, l2, none"),
        ({"num_proposal_samples": (256, 0)}, "1 to 4096"),
        ({"grid": HashGridConfig(min_res=64, max_res=32)}, r"at least min_res \(64\)"),
        ({"hidden_dim": 0}, "1 to 1024"),
    ],
)
def test_wrong_options_are_refused_by_name(model: dict[str, object], named: str) -> None:
    config = replace(DEFAULT, model=replace(DEFAULT.model, **model))  # type: ignore[arg-type]
    with pytest.raises(NerfError, match=named) as caught:
        validate(config)
    assert caught.value.code == "bad_config"


def test_unknown_options_are_refused() -> None:
    with pytest.raises(NerfError, match="no option colour"):
        config_from_dict(NerfactoConfig, {"colour": 1})
