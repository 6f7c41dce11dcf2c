"""Files of models: what comes back, and what is refused."""

from __future__ import annotations

import json
import pickle
import zipfile
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from pipelines.nerf.errors import NerfError
from pipelines.nerf.models.nerfacto import Nerfacto
from pipelines.nerf.options.methods.nerfacto import NerfactoConfig
from pipelines.nerf.space.cameras import SceneTransform
from pipelines.nerf.training.checkpoint import (
    load_checkpoint,
    load_model,
    save_checkpoint,
    save_model,
)
from tests.unit.pipelines.nerf.toy_scene import tiny_config, tiny_model, toy_cameras

SCENE = SceneTransform((4_500_000.25, -2.0, 0.5), 0.125)


def test_a_loaded_model_renders_the_same(tmp_path: Path) -> None:
    model = Nerfacto(tiny_model(), 5).eval()
    path = tmp_path / "model.zip"
    save_model(path, model, SCENE, {"cameras": [{"file": "a.jpg"}], "metric": True})
    loaded = load_model(path)
    rays = toy_cameras(2).image_rays(0)
    with torch.no_grad():
        assert torch.equal(model(rays)["rgb"], loaded.model(rays)["rgb"])
    assert loaded.scene == SCENE
    assert loaded.extras == {"cameras": [{"file": "a.jpg"}], "metric": True}
    assert loaded.model.config == model.config
    assert not loaded.model.training
    assert list(tmp_path.iterdir()) == [path]


def test_damaged_and_foreign_models_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "model.zip"
    save_model(path, Nerfacto(tiny_model(), 5), SCENE, {})
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(NerfError, match="damaged"):
        load_model(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("model.json", json.dumps({"version": 99}))
        archive.writestr("model.safetensors", b"")
    with pytest.raises(NerfError, match=r"damaged|version 99"):
        load_model(path)


def test_a_model_of_another_shape_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "model.zip"
    save_model(path, Nerfacto(tiny_model(), 5), SCENE, {})
    with zipfile.ZipFile(path) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    description = json.loads(entries["model.json"])
    description["config"]["hidden_dim"] = 48
    entries["model.json"] = json.dumps(description).encode()
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
    with pytest.raises(NerfError, match="damaged"):
        load_model(path)


def test_a_checkpoint_comes_back_and_a_failed_write_leaves_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.pt"
    save_checkpoint(path, {"step": 7, "table": torch.arange(4)})
    with pytest.raises((pickle.PicklingError, AttributeError, TypeError)):
        save_checkpoint(path, {"step": 8, "bad": lambda: None})
    loaded = load_checkpoint(path)
    assert loaded["step"] == 7
    assert torch.equal(loaded["table"], torch.arange(4))
    assert list(tmp_path.iterdir()) == [path]


class _Trap:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return (print, ("code ran on load",))


def test_a_checkpoint_that_carries_code_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "checkpoint.pt"
    torch.save({"version": 1, "step": _Trap()}, path)
    with pytest.raises(NerfError, match="cannot be read"):
        load_checkpoint(path)
    assert capsys.readouterr().out == ""


def test_a_truncated_checkpoint_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "checkpoint.pt"
    save_checkpoint(path, {"step": 7, "table": torch.arange(4000)})
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(NerfError, match="cannot be read"):
        load_checkpoint(path)


def test_half_precision_tables_are_half_the_size_and_rounded_once(tmp_path: Path) -> None:
    config = tiny_config().model
    assert isinstance(config, NerfactoConfig)
    model = Nerfacto(replace(config, half_tables=True), 5).eval()
    tables = [name for name in model.state_dict() if name.endswith("grid.table")]
    field, first, second = tables
    with torch.no_grad():
        model.state_dict()[field].normal_()
        model.state_dict()[first][0, 0] = 1e6  # no float16
    path, whole = tmp_path / "model.zip", tmp_path / "whole.zip"
    save_model(path, model, SCENE, {})
    weights, found = model.state_dict(), load_model(path).model.state_dict()
    # 11 bits, or 2^-24 apart near 0: the nearest float16 is at most half a unit away.
    for name in (field, second):
        assert found[name].dtype == torch.float32
        bound = (2.0**-11 * weights[name].abs()).clamp_min(2.0**-25)
        assert bool(((found[name] - weights[name]).abs() <= bound).all())
        assert not torch.equal(found[name], weights[name])
    for name in set(weights) - {field, second}:
        assert torch.equal(found[name], weights[name]), name
    save_model(whole, Nerfacto(config, 5), SCENE, {})
    spared = 2 * (weights[field].numel() + weights[second].numel())
    assert whole.stat().st_size - path.stat().st_size == pytest.approx(spared, abs=100)
