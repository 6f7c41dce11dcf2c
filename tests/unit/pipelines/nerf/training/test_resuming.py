"""When checkpoints are written, what they fit, and what may differ when a run goes on from one."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pipelines.nerf.data.images import ImageData
from pipelines.nerf.errors import NerfError
from pipelines.nerf.models.base import Model
from pipelines.nerf.options.methods.nerfacto import NerfactoConfig, TensorGridConfig
from pipelines.nerf.options.parts import allowed_names
from pipelines.nerf.options.train import OptimizerConfig, TrainConfig
from pipelines.nerf.renderer import Renderer
from pipelines.nerf.space.cameras import Cameras, SceneTransform
from pipelines.nerf.training.checkpoint import load_checkpoint
from pipelines.nerf.training.loop import TrainProgress, train
from tests.unit.pipelines.nerf.models.toy_runs import same_state
from tests.unit.pipelines.nerf.toy_scene import tiny_config, toy_cameras, toy_images, with_model

FREE = ("max_steps", "max_seconds", "checkpoint_seconds", "preview_every_steps", "device")
"""May change between the attempts of a run, as may all of `optimizer`."""
NOT_ALONE = {
    "method": "changes the whole of `model`, and is told by it",
    "model.num_proposal_samples": "tested by itself: a tuple",
    "model.proposals": "tested by itself: a tuple",
}


def leaves(config: Any, path: str = "") -> Iterator[tuple[str, dataclasses.Field[Any], Any]]:
    """(dotted name, field, value) of every option, nested ones included."""
    for item in dataclasses.fields(config):
        value, name = getattr(config, item.name), f"{path}{item.name}"
        if dataclasses.is_dataclass(value):
            yield from leaves(value, f"{name}.")
        else:
            yield name, item, value


def changed(config: Any, name: str, value: object) -> Any:
    """The dataclass with another value of the option of a dotted name."""
    first, _, rest = name.partition(".")
    new = changed(getattr(config, first), rest, value) if rest else value
    return replace(config, **{first: new})


def another(item: dataclasses.Field[Any], value: Any) -> Any:
    """A value that the option may have beside its own."""
    choices = allowed_names(item.metadata)
    if choices:
        return next(choice for choice in choices if choice != value)
    if isinstance(value, bool):
        return not value
    low, high = item.metadata["ge"], item.metadata["le"]
    if isinstance(value, int):
        return value + 1 if value < high else value - 1
    return (value + (low if value > low else high)) / 2.0


BASE = with_model(tiny_config(max_steps=1), near=0.3)
OPTIONS = {
    name: another(item, value) for name, item, value in leaves(BASE) if name not in NOT_ALONE
}
BOUND = sorted(name for name in OPTIONS if name not in FREE and not name.startswith("optimizer."))
MAY_CHANGE = sorted(OPTIONS.keys() - set(BOUND) - {"device"})


@pytest.fixture(scope="module")
def cameras() -> Cameras:
    return toy_cameras(6)


@pytest.fixture(scope="module")
def images(cameras: Cameras) -> ImageData:
    return toy_images(cameras)


@pytest.fixture(scope="module")
def begun(images: ImageData, cameras: Cameras, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The checkpoint of a run that is done with its one step."""
    path = tmp_path_factory.mktemp("begun") / "checkpoint.pt"
    train(images, cameras, range(3), BASE, seed=0, checkpoint_path=path)
    return path


def test_all_options_are_either_free_or_bound() -> None:
    assert len(BOUND) > 50
    assert len(MAY_CHANGE) == len(FREE) - 1 + len(dataclasses.fields(OptimizerConfig))


@pytest.mark.parametrize("name", BOUND)
def test_a_checkpoint_fits_no_run_with_another_option(
    images: ImageData, cameras: Cameras, begun: Path, name: str
) -> None:
    config = changed(BASE, name, OPTIONS[name])
    with pytest.raises(NerfError, match="belongs to a run with other options") as caught:
        train(images, cameras, range(3), config, seed=0, checkpoint_path=begun)
    assert caught.value.code == "bad_checkpoint"


def test_a_checkpoint_fits_no_run_with_other_rounds_images_or_seed(
    images: ImageData, cameras: Cameras, begun: Path
) -> None:
    model = BASE.model
    assert isinstance(model, NerfactoConfig)
    first, second = model.proposals
    for config, indices, seed in (
        (with_model(BASE, num_proposal_samples=(24, 17)), range(3), 0),
        (with_model(BASE, proposals=(first, replace(second, hidden_dim=9))), range(3), 0),
        (BASE, range(4), 0),
        (BASE, range(3), 1),
    ):
        with pytest.raises(NerfError, match="belongs to a run with other options"):
            train(images, cameras, indices, config, seed=seed, checkpoint_path=begun)


def test_a_checkpoint_fits_no_run_with_other_poses_lenses_or_sizes(
    images: ImageData, cameras: Cameras, begun: Path
) -> None:
    """The options stay what they were: the poses were found anew, in another frame."""
    for name, change in (
        ("scene_from_camera", 1e-4),
        ("focal", 0.01),
        ("principal", 0.01),
        ("distortion", 1e-4),
    ):
        values = getattr(cameras, name).clone()
        values[1].view(-1)[-1] += change
        others = replace(cameras, **{name: values})
        with pytest.raises(NerfError, match="belongs to a run with other options"):
            train(images, others, range(3), BASE, seed=0, checkpoint_path=begun)
    last = cameras.scene_from_camera.clone()
    last[-1, :, 3] += 1.0  # nothing is learned from this one
    held_out = replace(cameras, scene_from_camera=last)
    train(images, held_out, range(3), BASE, seed=0, checkpoint_path=begun)
    smaller = cameras.resized(int(cameras.size.max()) // 2)
    with pytest.raises(NerfError, match="belongs to a run with other options"):
        train(
            ImageData.empty(smaller.size.tolist(), masked=False),
            smaller,
            range(3),
            BASE,
            seed=0,
            checkpoint_path=begun,
        )


@pytest.mark.parametrize("name", MAY_CHANGE)
def test_a_run_goes_on_with_another_limit_habit_or_rate(
    images: ImageData, cameras: Cameras, begun: Path, name: str, tmp_path: Path
) -> None:
    path = tmp_path / "checkpoint.pt"
    path.write_bytes(begun.read_bytes())
    config = changed(replace(BASE, max_steps=2), name, OPTIONS[name])
    steps: list[int] = []
    train(
        images,
        cameras,
        range(3),
        config,
        seed=0,
        checkpoint_path=path,
        on_progress=lambda progress: steps.append(progress.step),
    )
    assert steps == [2]


@pytest.mark.parametrize("rates", [{"eps": 0.5}, {"beta2": 0.9}, {"lr": 1e-4, "lr_final": 1e-4}])
def test_what_may_change_takes_effect(
    images: ImageData, cameras: Cameras, begun: Path, rates: dict[str, Any], tmp_path: Path
) -> None:
    results: list[Model] = []
    for optimizer in (BASE.optimizer, replace(BASE.optimizer, **rates)):
        path = tmp_path / "checkpoint.pt"
        path.write_bytes(begun.read_bytes())
        config = replace(BASE, max_steps=3, optimizer=optimizer)
        results.append(train(images, cameras, range(3), config, seed=0, checkpoint_path=path))
    assert not same_state(*results)


class _StopError(Exception):
    pass


def test_a_checkpoint_is_there_while_the_run_goes_on(
    images: ImageData, cameras: Cameras, tmp_path: Path
) -> None:
    path = tmp_path / "checkpoint.pt"
    progress: list[TrainProgress] = []
    saved: list[int] = []

    def report(latest: TrainProgress) -> None:
        if saved:
            raise _StopError
        progress.append(latest)

    config = tiny_config(max_steps=10**6, max_seconds=10.0, checkpoint_seconds=1.0)
    with pytest.raises(_StopError):
        train(
            images,
            cameras,
            range(3),
            config,
            seed=0,
            checkpoint_path=path,
            on_progress=report,
            on_checkpoint=lambda: saved.append(progress[-1].step),
        )
    assert saved == [progress[-1].step]
    assert load_checkpoint(path)["step"] == progress[-1].step
    assert 0.9 < progress[-1].elapsed_s < 5.0


def test_previews_change_nothing_of_the_run(images: ImageData, cameras: Cameras) -> None:
    # The renderer has no kernel for this model, and gives its grids a faster engine meanwhile.
    grid = TensorGridConfig(resolution=8, num_components=2)
    config = tiny_config(max_steps=6, preview_every_steps=2)
    config = with_model(config, position_encoding="vm", tensor_grid=grid)
    pictures: list[float] = []

    def look(step: int, model: Model) -> None:
        scene = SceneTransform((0.0, 0.0, 0.0), 1.0)
        pictures.append(float(Renderer(model, scene).render(cameras, 0).rgb.mean()))

    silent = train(images, cameras, range(3), config, seed=0)
    shown = train(images, cameras, range(3), config, seed=0, on_preview=look)
    assert len(pictures) == 3
    assert same_state(silent, shown)


@pytest.mark.parametrize("engine", ["plain", "fast"])
@pytest.mark.parametrize("rates", [{"eps": 1e-18}, {"beta2": 0.9}, {"beta2": 0.999999}])
def test_the_extremes_that_adam_is_allowed_stay_finite(
    images: ImageData, cameras: Cameras, engine: str, rates: dict[str, Any]
) -> None:
    config: TrainConfig = tiny_config(max_steps=12, rays_per_step=32, engine=engine)
    config = replace(config, optimizer=replace(config.optimizer, **rates))
    model = train(images, cameras, range(3), config, seed=0)
    assert all(bool(parameter.isfinite().all()) for parameter in model.parameters())
    largest = max(float(parameter.detach().abs().max()) for parameter in model.parameters())
    assert largest < 10.0
