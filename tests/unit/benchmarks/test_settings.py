"""`--set` on nested frozen options, and where the presets come from."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from pipelines.nerf.errors import NerfError
from pipelines.nerf.options.methods.nerfacto import NerfactoConfig, ProposalConfig
from pipelines.nerf.options.parts import HashGridConfig
from pipelines.nerf.options.train import TrainConfig
from pipelines.presets import PRESETS
from tests.benchmarks.settings import overridden, preset_config, sampling_model


def nerfacto(config: TrainConfig) -> NerfactoConfig:
    assert isinstance(config.model, NerfactoConfig)
    return config.model


def test_assignments_change_what_they_name_and_nothing_else() -> None:
    config = overridden(
        TrainConfig(), ["max_steps=7", "train.model.near=1", "model.background=white"]
    )
    expected = replace(
        TrainConfig(), max_steps=7, model=replace(TrainConfig().model, near=1.0, background="white")
    )
    assert config == expected
    assert isinstance(config.model.near, float)


def test_assignments_reach_into_tuples_of_options() -> None:
    model = nerfacto(
        overridden(
            TrainConfig(),
            ["model.num_proposal_samples=[8,4]", "model.proposals.1.grid.max_res=64"],
        )
    )
    default = NerfactoConfig()
    assert model.num_proposal_samples == (8, 4)
    assert model.proposals[0] == default.proposals[0]
    assert model.proposals[1] == replace(
        default.proposals[1], grid=replace(default.proposals[1].grid, max_res=64)
    )


def test_a_list_of_objects_becomes_a_tuple_of_options() -> None:
    text = 'model.proposals=[{"hidden_dim": 8}, {"grid": {"num_levels": 3}}]'
    model = nerfacto(overridden(TrainConfig(), [text]))
    assert model.proposals == (
        ProposalConfig(hidden_dim=8),
        ProposalConfig(grid=HashGridConfig(num_levels=3)),
    )


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("model.nearest=1", "model.nearest"),
        ("max_steps=many", "many"),
        ("max_steps", "option=value"),
        ("max_steps=0", "max_steps"),
        ("model.contraction=cube", "linf"),
        ("model.proposals.7.hidden_dim=2", "proposals.7"),
        ("model.proposals=[]", "network"),
    ],
)
def test_wrong_assignments_are_refused_by_name(text: str, named: str) -> None:
    with pytest.raises(NerfError, match=named) as caught:
        overridden(TrainConfig(), [text])
    assert caught.value.code == "bad_config"


def test_preview_is_the_default_with_the_presets_own_differences() -> None:
    def check(values: dict[str, Any], config: Any) -> None:
        for name, value in values.items():
            if isinstance(value, dict):
                check(value, getattr(config, name))
            else:
                assert getattr(config, name) == value, name

    config = preset_config("preview")
    check(PRESETS["preview"].overrides["train"], config)
    assert preset_config("paper") == TrainConfig()
    check(PRESETS["standard"].overrides["train"], preset_config("standard"))
    with pytest.raises(NerfError, match="no preset"):
        preset_config("huge")


def test_preview_sampling_keeps_the_papers_poses_and_codes() -> None:
    model, preview = sampling_model("preview"), nerfacto(preset_config("preview"))
    assert model.num_proposal_samples == preview.num_proposal_samples
    assert model.num_nerf_samples == preview.num_nerf_samples
    assert model.grid == preview.grid
    default = NerfactoConfig()
    assert (model.camera_mode, model.appearance_dim) == (
        default.camera_mode,
        default.appearance_dim,
    )
    assert sampling_model("paper") == default
