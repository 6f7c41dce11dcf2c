"""The benchmark of methods: its options are valid, and known bounds choose the bounded settings."""

from __future__ import annotations

import pytest
import torch

from pipelines.nerf.options.train import default_train_config, validate
from pipelines.nerf.space.cameras import SceneTransform
from tests.benchmarks.capture_data import BenchmarkCapture
from tests.benchmarks.methods import BOUNDED, SMALL, fitted, report, settings
from tests.benchmarks.runs import Mark, Run
from tests.benchmarks.scores import Score
from tests.benchmarks.settings import overridden
from tests.unit.pipelines.nerf.toy_scene import toy_cameras, toy_images


def _capture(bounds: tuple[float, float] | None) -> BenchmarkCapture:
    cameras = toy_cameras(3)
    return BenchmarkCapture(
        name="toy",
        images=toy_images(cameras),
        cameras=cameras,
        scene=SceneTransform((0.0, 0.0, 0.0), 1.0),
        names=["a", "b", "c"],
        train=[0, 1],
        test=[2],
        bounds=bounds,
        background="white" if bounds else None,
    )


@pytest.mark.parametrize("method", sorted(BOUNDED))
def test_the_options_of_every_method_are_valid(method: str) -> None:
    config = settings(method, 300, 128, 64, decay=True)
    assert (config.max_steps, config.rays_per_step, config.data.long_side_px) == (300, 128, 64)
    assert config.optimizer.decay_steps == 300
    for bounds in (None, (1.0, 4.0)):
        known = fitted(config, _capture(bounds))
        validate(overridden(known, SMALL.get(method, [])))


def test_bounds_bring_the_settings_of_bounded_scenes() -> None:
    config = default_train_config("instant-ngp")
    assert fitted(config, _capture(None)) == config
    model = fitted(config, _capture((1.5, 4.5))).model
    assert (model.near, model.far, model.background) == (1.5, 4.5, "white")
    for name, value in BOUNDED["instant-ngp"].items():
        assert getattr(model, name) == value


def test_a_curve_has_a_row_for_each_mark() -> None:
    marks = [Mark(10 * n, float(n), {"c": Score(20.0 + n, 0.5)}) for n in (1, 2)]
    lines = report(Run(0, marks, 20, 2.0, 1e3, torch.nn.Identity())).splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]
    assert cells == [["10", "1.0", "21.00", "0.500"], ["20", "2.0", "22.00", "0.500"]]
