"""Files of a model: checkpoints that training goes on from, and `model.zip` to render from.

Nothing here runs code on load: checkpoints are read with `weights_only=True`, models are
safetensors and JSON. Every file is written beside its place and then renamed over it, so a reader
never sees half of one.
"""

from __future__ import annotations

import json
import os
import zipfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, BinaryIO

import torch
from safetensors import SafetensorError
from safetensors.torch import load, save

from pipelines.nerf.errors import NerfError
from pipelines.nerf.models.base import Model
from pipelines.nerf.networks.encodings import HashGrid
from pipelines.nerf.options.catalogue import find_method
from pipelines.nerf.options.train import config_from_dict
from pipelines.nerf.space.cameras import SceneTransform

CHECKPOINT_VERSION = 2
MODEL_VERSION = 2
READABLE_MODEL_VERSIONS = (1, 2)
"""Version 1 had one method, Nerfacto, and did not name it."""
WEIGHTS_NAME, DESCRIPTION_NAME = "model.safetensors", "model.json"


def _write_atomically(path: Path, write: Callable[[BinaryIO], None]) -> None:
    """Fill a file beside `path` and rename it over `path`; on any failure leave nothing."""
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with partial.open("wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write a training state: tensors, numbers, strings, and lists and dicts of them."""
    payload = {"version": CHECKPOINT_VERSION, **state}
    _write_atomically(path, lambda file: torch.save(payload, file))


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Read what `save_checkpoint` wrote, on the CPU.

    Raises NerfError `bad_checkpoint` where the file is damaged or of another version, and
    FileNotFoundError where there is none.
    """
    try:
        state: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise
    except Exception as error:  # torch.load has no common base of what a damaged file raises
        raise NerfError(
            "bad_checkpoint",
            f"The checkpoint {path.name} cannot be read.",
            "Remove it to train from the start.",
        ) from error
    if state.get("version") != CHECKPOINT_VERSION:
        raise NerfError(
            "bad_checkpoint",
            f"The checkpoint has version {state.get('version')}, not {CHECKPOINT_VERSION}.",
            "Remove it to train from the start.",
        )
    return state


@dataclass(frozen=True)
class LoadedModel:
    """What `model.zip` holds.

    model: in `eval()`, on the CPU. scene: between its scene space and the world.
    extras: JSON that the writer added, such as the cameras.
    """

    model: Model
    scene: SceneTransform
    extras: dict[str, Any]


def save_model(path: Path, model: Model, scene: SceneTransform, extras: dict[str, Any]) -> None:
    """Write everything that is needed to render again without the capture.

    extras: JSON-able; given back by `load_model` as it is. The entries are stored, not deflated:
    float weights do not shrink. With `train.model.half_tables` the tables of hash grids are written
    as float16, rounded to 11 bits; `load_model` gives float32 in any case.
    """
    description = {
        "version": MODEL_VERSION,
        "method": model.method,
        "config": asdict(model.config),
        "num_train_images": model.num_train_images,
        "scene": asdict(scene),
        "extras": extras,
    }
    text = json.dumps(description, indent=1, allow_nan=False)
    weights = {name: tensor.detach().cpu().contiguous() for name, tensor in _named(model).items()}
    if model.config.half_tables:
        weights |= {name: _halved(weights[name]) for name in _table_names(model)}

    def write(file: BinaryIO) -> None:
        with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
            archive.writestr(DESCRIPTION_NAME, text)
            archive.writestr(WEIGHTS_NAME, save(weights))

    _write_atomically(path, write)


def load_model(path: Path) -> LoadedModel:
    """Read what `save_model` wrote.

    Raises NerfError `bad_model_file` where the file is damaged, incomplete or of another version,
    `bad_config` where its method is not installed, and FileNotFoundError where there is none.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            description = json.loads(archive.read(DESCRIPTION_NAME))
            weights = load(archive.read(WEIGHTS_NAME))
        if description["version"] not in READABLE_MODEL_VERSIONS:
            raise _bad_model(path, f"has version {description['version']}, not {MODEL_VERSION}")
        method = find_method(description.get("method", "nerfacto"))
        config = config_from_dict(method.config, description["config"])
        with torch.random.fork_rng(devices=[]):
            model: Model = method.build(config, int(description["num_train_images"]))
        model.load_state_dict(weights, strict=True)
        raw = description["scene"]
        x, y, z = (float(value) for value in raw["center"])
        scene = SceneTransform(center=(x, y, z), scale=float(raw["scale"]))
        extras: dict[str, Any] = description["extras"]
    except (zipfile.BadZipFile, SafetensorError, KeyError, ValueError, RuntimeError) as error:
        raise _bad_model(path, f"is damaged or incomplete ({type(error).__name__})") from error
    model.requires_grad_(False)
    return LoadedModel(model=model.eval(), scene=scene, extras=extras)


def _named(model: Model) -> dict[str, torch.Tensor]:
    return dict(model.state_dict())


def _table_names(model: Model) -> list[str]:
    """The names of the hash grids' tables among the weights."""
    grids = (name for name, part in model.named_modules() if isinstance(part, HashGrid))
    return [f"{name}.table" for name in grids]


def _halved(table: torch.Tensor) -> torch.Tensor:
    """A table as float16, or as it is where a value would not fit."""
    fits = bool((table.abs() <= torch.finfo(torch.float16).max).all())
    return table.half() if fits else table


def _bad_model(path: Path, problem: str) -> NerfError:
    return NerfError(
        "bad_model_file", f"The model {path.name} {problem}.", "Train again, or fetch it again."
    )
