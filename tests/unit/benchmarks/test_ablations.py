"""The paper's ablations change what they name and nothing else; the table that is made of them."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import pytest

from pipelines.nerf.errors import NerfError
from pipelines.nerf.options.ablations import ABLATIONS, ablated
from pipelines.nerf.options.methods.nerfacto import NerfactoConfig
from pipelines.nerf.options.parts import ModelConfig
from pipelines.nerf.options.train import TrainConfig, validate
from tests.benchmarks.ablations import Outcome, mean_score, size_config, table
from tests.benchmarks.scores import Score

DEFAULT = NerfactoConfig()
EXPECTED: dict[str, dict[str, object]] = {
    "nerfacto": {},
    "without pose": {"camera_mode": "off"},
    "without appearance": {"appearance_dim": 0},
    "without pose and appearance": {"camera_mode": "off", "appearance_dim": 0},
    "one proposal network": {
        "num_proposal_samples": (256,),
        "proposals": (DEFAULT.proposals[0],),
    },
    "l2 contraction": {"contraction": "l2"},
    "shared proposal network": {
        "share_proposal_network": True,
        "proposals": (DEFAULT.proposals[0],),
    },
    "random background": {"background": "random"},
    "no contraction": {"contraction": "none"},
    "synthetic on real": {
        "contraction": "none",
        "appearance_dim": 0,
        "far": math.dist((-1, -1, -1), (1, 1, 1)),
    },
}


def differences(config: ModelConfig) -> dict[str, object]:
    return {
        item.name: getattr(config, item.name)
        for item in fields(DEFAULT)
        if getattr(config, item.name) != getattr(DEFAULT, item.name)
    }


def test_the_ablations_are_those_of_the_paper() -> None:
    assert list(ABLATIONS) == list(EXPECTED)


@pytest.mark.parametrize("name", list(EXPECTED))
def test_an_ablation_differs_in_the_named_options_alone_and_is_valid(name: str) -> None:
    config = ablated(TrainConfig(), name)
    validate(config)
    found, expected = differences(config.model), EXPECTED[name]
    assert found.keys() == expected.keys()
    for option, value in expected.items():
        assert found[option] == (pytest.approx(value) if option == "far" else value), option
    assert replace(config, model=DEFAULT) == TrainConfig()


@pytest.mark.parametrize("name", list(EXPECTED))
def test_an_ablation_of_a_small_run_stays_small_and_is_valid(name: str) -> None:
    small = size_config("small", 50)
    config = ablated(small, name)
    validate(config)
    assert isinstance(small.model, NerfactoConfig)
    assert isinstance(config.model, NerfactoConfig)
    assert config.model.grid == small.model.grid
    rounds = len(config.model.num_proposal_samples)
    assert config.model.num_proposal_samples == small.model.num_proposal_samples[:rounds]
    assert small.model.appearance_dim > 0
    assert small.model.camera_mode != "off"


def test_unknown_ablation_and_other_methods_are_refused() -> None:
    with pytest.raises(NerfError, match="without pose"):
        ablated(TrainConfig(), "without everything")
    other = replace(TrainConfig(), method="other", model=ModelConfig())
    with pytest.raises(NerfError, match="nerfacto"):
        ablated(other, "without pose")


def outcome(variant: str, capture: str, scores: dict[str, Score]) -> Outcome:
    return Outcome(variant, capture, 1.0, scores, {}, {})


def test_table_has_means_by_capture_and_over_captures() -> None:
    outcomes = [
        outcome("nerfacto", "a", {"1": Score(20.0, 0.5), "2": Score(22.0, 0.7)}),
        outcome("nerfacto", "b", {"1": Score(24.0, 0.8, 0.25)}),
    ]
    row = table(outcomes, ["a", "b"]).splitlines()[2]
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    # An unknown LPIPS is never averaged over.
    assert cells == ["nerfacto", "21.00 / 0.600 / -", "24.00 / 0.800 / 0.250", "22.50 / 0.700 / -"]


def test_mean_score_of_two_halves() -> None:
    found = mean_score([Score(10.0, 0.25, 0.5), Score(20.0, 0.75, 1.0)])
    assert found == Score(15.0, 0.5, 0.75)
