"""The protocol that a report names is the one that was followed."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import pytest

from pipelines.nerf.judging.protocol import protocol
from pipelines.nerf.options.evaluate import EvaluateConfig
from pipelines.nerf.options.train import DataConfig


def _trained(camera_mode: str = "off", **data: Any) -> dict[str, Any]:
    return {"data": asdict(DataConfig(**data)), "model": {"camera_mode": camera_mode}}


FITTED = EvaluateConfig(fit_poses=True, fit_appearance=True)


@pytest.mark.parametrize(
    ("train", "config", "codes", "name", "split"),
    [
        (_trained(eval_mode="interval"), EvaluateConfig(), False, "mipnerf360", "interval 8"),
        (_trained(eval_mode="interval"), EvaluateConfig(), True, "custom", "interval 8"),
        (_trained("so3xr3", eval_mode="interval"), EvaluateConfig(), False, "custom", "interval 8"),
        (
            _trained(eval_mode="interval", eval_interval=4),
            EvaluateConfig(),
            False,
            "custom",
            "interval 4",
        ),
        (_trained("so3xr3"), FITTED, True, "nerfstudio", "fraction 0.9"),
        (_trained(), FITTED, False, "nerfstudio", "fraction 0.9"),
        (_trained(), EvaluateConfig(fit_poses=True), True, "custom", "fraction 0.9"),
        (_trained(), EvaluateConfig(), True, "custom", "fraction 0.9"),
        (_trained(eval_fraction=0.2), FITTED, True, "custom", "fraction 0.8"),
        (
            _trained("so3xr3", eval_mode="stretch"),
            EvaluateConfig(),
            True,
            "stretch",
            "stretch 0.1 at 0.5",
        ),
        (_trained(eval_mode="stretch"), FITTED, True, "custom", "stretch 0.1 at 0.5"),
        (_trained(eval_mode="none"), EvaluateConfig(), False, "custom", "none"),
    ],
)
def test_the_name_follows_from_what_was_done(
    train: dict[str, Any], config: EvaluateConfig, codes: bool, name: str, split: str
) -> None:
    found = protocol(train, config, codes)
    assert (found["name"], found["split"]) == (name, split)
    assert found["train_camera_optimizer"] == train["model"]["camera_mode"]
    assert found["train_appearance"] is codes


def test_codes_that_do_not_exist_were_not_fitted() -> None:
    found = protocol(_trained(), FITTED, codes=False)
    assert found["fit_poses"] is True
    assert found["fit_appearance"] is False
    assert "mean appearance" in found["description"]
    assert "fitted to the whole images" in found["description"]
