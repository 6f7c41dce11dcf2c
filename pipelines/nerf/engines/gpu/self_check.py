"""Whether the GPU engine does on this machine what the plain one does: asked before it is trusted.

A compiled engine can be wrong in ways that no test elsewhere sees: no C compiler for Triton's
launcher, a driver too old for what was compiled, an operation that a release of PyTorch no longer
captures. So each hash grid of a throwaway model with the run's own options is compared with its
plain twin, values and gradients. Then two such models train a few steps on made-up pictures, from
the same start and the same random numbers, one with each engine. Their first losses and gradients
must agree to half precision, and the engine must still agree after its steps became CUDA graphs,
which must go on drawing new random numbers. That is done in each of `SETTINGS`: together they have
all lenses, masks, and both places where pixels may lie. It takes seconds, most of them Triton's,
whose kernels the run then finds compiled.
"""

from __future__ import annotations

import copy
import logging
import math
import subprocess
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from pipelines.nerf.data.images import ImageData
from pipelines.nerf.data.pixels import PixelSampler, block_side
from pipelines.nerf.data.plain_lines import PlainLines
from pipelines.nerf.engines.gpu.step import EAGER_STEPS, TrainingStep, capturable_adam, loss_scaler
from pipelines.nerf.errors import NerfError
from pipelines.nerf.models.base import Model
from pipelines.nerf.models.nerfacto import Nerfacto
from pipelines.nerf.networks.decay import set_table_decay
from pipelines.nerf.networks.encodings import HashGrid, hash_encode
from pipelines.nerf.options.catalogue import find_method
from pipelines.nerf.options.methods.nerfacto import NerfactoConfig
from pipelines.nerf.options.parts import HashGridConfig
from pipelines.nerf.options.train import TrainConfig
from pipelines.nerf.space.cameras import Cameras, SceneTransform, panorama_intrinsics
from pipelines.nerf.space.lenses import CAMERA_MODELS
from pipelines.nerf.space.rays import Rays

LOG = logging.getLogger(__name__)

NUM_IMAGES, IMAGE_SIDE, FOCAL = len(CAMERA_MODELS), 32, 28.0
LENS_TERMS = (-0.1, 0.03, 0.0, 0.0, 1e-3, -2e-3)
NUM_RAYS = 256
FIRST_STEP = 9
"""The last in which the proposals learn in any case; from then on they do in every second, so that
both kinds of steps occur."""
NUM_STEPS = 2 * (EAGER_STEPS + 3)
LEARNING_RATE = 1e-3
LOSS_TOLERANCE = 0.02
GRADIENT_TOLERANCE, GRADIENT_FLOOR = 0.1, 1e-3
"""Of the norm of a parameter's gradient: factors rounded to 11 bits, sums of some thousands. A
gradient smaller than this share of all together, as the proposals' often are at the start, is
rounding itself and held against that share."""
SMALLEST = 1e-30
GRID_POINTS = 20_000
VALUES, HALF_VALUES, SLOPES = 1e-3, 5e-3, 3e-2
"""Allowed gaps of a grid: of float32, where the place inside a cell of 2,048 keeps 13 bits; of
float16; of gradients to points, which jump where rounding puts a point into the next cell."""
COLOR_TOLERANCE = 0.01
"""Of colours in [0, 1], in the mean: some units of eight bits; float16 tables bring about less."""
FEW, COLOR_TOLERANCE_OF_FEW = 0.98, 0.05
"""The quantile of single colours, and what that may be off by: a few wrong tiles or rays vanish in
a mean."""
PICTURE_RAYS = 1024
STEADY = 0.003
"""How far half precision may move the colours of a ray that is to tell something. What no picture
showed hangs on rounding: a sample finds a surface there or misses it, the more so the longer the
model was trained. Roundings to bfloat16 moved 2 % of all colours of a model of 11,500 steps by
0.072 or more, and all of them by 0.011 in the mean; of the rays that one of them had not moved,
another moved 2 % of the colours by 0.015, and all by 0.002."""
STEADY_SHARE = 1 / 16
"""Of the rays; from fewer nothing follows."""
END_TOLERANCE = 0.2
"""Of the last losses: Adam turns the rounding of small gradients into whole steps."""


class Setting(NamedTuple):
    """What a run is like. all_lenses: one camera of each lens, else pinholes. fed: pixels lie on
    the CPU and follow each step."""

    name: str
    all_lenses: bool
    masked: bool
    fed: bool


SETTINGS = (
    Setting("masked pictures of all lenses, held on the device", True, True, False),
    Setting("whole pictures of pinholes, fed from the CPU", False, False, True),
)


class Gap(NamedTuple):
    """A relative difference, and how large it may be."""

    found: float
    allowed: float


@lru_cache(maxsize=16)
def engine_problem(config: TrainConfig, device: torch.device) -> str | None:
    """Why the GPU engine must not be used for these options on this device; None where it may.

    Never raises: whatever goes wrong is an answer. The process's own random numbers are left alone.
    """
    try:
        with torch.random.fork_rng(devices=[]):
            problem = _wrong_grid(config, device) or _disagreement_anywhere(config, device)
    except engine_errors() as error:
        problem = f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"
    if problem is not None:
        LOG.warning("The GPU engine is not used on %s: %s", device, problem)
    return problem


def picture_problem(model: Nerfacto) -> str | None:
    """Why `engines.gpu.render` must not draw this model where it lies; None where it may.

    Compares the colours of rays that rounding alone does not move with the model's own. As
    `engine_problem`, but asked anew for every model.
    """
    try:
        problem = _wrong_picture(model)
    except engine_errors() as error:
        problem = f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"
    if problem is not None:
        LOG.warning("The GPU renderer is not used: %s", problem)
    return problem


@torch.no_grad()
def _wrong_picture(model: Nerfacto) -> str | None:
    # Imported here: only who draws pictures needs it.
    from pipelines.nerf.engines.gpu.render import TileDrawer

    device = next(model.parameters()).device
    pixel = torch.arange(PICTURE_RAYS, device=device)
    places = torch.stack([pixel % IMAGE_SIDE, pixel // IMAGE_SIDE], dim=-1) * 3.0 % IMAGE_SIDE
    rays = _cameras().to(device).generate_rays(pixel % NUM_IMAGES, places + 0.5)
    was_training = model.training
    model.eval()
    try:
        expected = model(rays)["rgb"].float()
        rounded = _rounded_picture(model, rays)
        found = TileDrawer(model, early_stop=0.0, weight_threshold=0.0).draw(rays)["rgb"].float()
    finally:
        model.train(was_training)
    steady = (rounded - expected).abs().amax(dim=-1) <= STEADY
    if int(steady.sum()) < STEADY_SHARE * PICTURE_RAYS:
        return f"the colours of {int((~steady).sum())} of {PICTURE_RAYS} rays hang on rounding"
    gaps = (found - expected)[steady].abs()
    mean, of_few = float(gaps.mean()), float(gaps.flatten().quantile(FEW))
    if not mean <= COLOR_TOLERANCE:
        return f"its colours are off by {mean:.3f} in the mean"
    if not of_few <= COLOR_TOLERANCE_OF_FEW:
        return f"{100 * (1 - FEW):.0f} % of its colours are off by {of_few:.3f} or more"
    return None


def _rounded_picture(model: Nerfacto, rays: Rays) -> Tensor:
    """Colours [R, 3] of the model itself with weights and layers in float16."""
    rounded = copy.deepcopy(model)
    for parameter in rounded.parameters():
        parameter.copy_(parameter.half())
    with torch.autocast(rays.origins.device.type, torch.float16):
        colors: Tensor = rounded(rays)["rgb"]
    return colors.float()


def engine_errors() -> tuple[type[Exception], ...]:
    """What may be raised where the engine cannot run: by PyTorch, by Triton, by the C compiler."""
    of_torch = (RuntimeError, AssertionError)  # the latter from a PyTorch without CUDA
    known = (*of_torch, NerfError, OSError, ValueError, ImportError, subprocess.SubprocessError)
    try:
        from triton.errors import TritonError
    except ImportError:  # no wheel for this platform
        return known
    return (*known, TritonError)


def relative_gap(found: Tensor, expected: Tensor) -> float:
    """|found - expected| / |expected| by Euclidean norms; 0 where both vanish."""
    found, expected = found.detach().double(), expected.detach().double()
    size = float(expected.norm())
    gap = float((found - expected).norm())
    return gap / size if size > 0.0 else (0.0 if gap == 0.0 else math.inf)


def grid_gaps(config: HashGridConfig, num: int, device: torch.device) -> dict[str, Gap]:
    """Triton's hash grid against the plain one at `num` random points, by what is compared.

    In float32, within an autocast to float16, and read from a half-precision copy.
    """
    # Imported here: Triton has no wheel for every platform.
    from pipelines.nerf.engines.gpu.parts.hash_grid import hash_encode_triton

    random = torch.Generator().manual_seed(7)
    grid = HashGrid(config).to(device)
    levels = (grid.resolutions, grid.dense, grid.offsets)
    table = torch.randn(grid.table.shape, generator=random).to(device).requires_grad_()
    points = torch.rand(num, 3, generator=random).to(device).requires_grad_()
    incoming = torch.randn(num, grid.num_outputs, generator=random).to(device)
    wanted = (points, table)
    plain = hash_encode(points, table, *levels)
    expected = torch.autograd.grad(plain, wanted, incoming)
    found = hash_encode_triton(points, table, *levels)
    slopes = torch.autograd.grad(found, wanted, incoming)
    with torch.autocast(device.type, torch.float16):
        half = hash_encode_triton(points, table, *levels)
    half_slopes = torch.autograd.grad(half, wanted, incoming.half())
    copy = table.detach().half()
    coarse = hash_encode_triton(points, table, *levels, lookup=copy)
    plain_coarse = hash_encode(points, copy.float(), *levels)
    return {
        "features": Gap(relative_gap(found, plain), VALUES),
        "gradient of the points": Gap(relative_gap(slopes[0], expected[0]), SLOPES),
        "gradient of the table": Gap(relative_gap(slopes[1], expected[1]), VALUES),
        "features in float16": Gap(relative_gap(half, plain), HALF_VALUES),
        "gradient of the points from float16": Gap(
            relative_gap(half_slopes[0], expected[0]), SLOPES
        ),
        "gradient of the table from float16": Gap(
            relative_gap(half_slopes[1], expected[1]), HALF_VALUES
        ),
        "features of a float16 table": Gap(relative_gap(coarse, plain_coarse), VALUES),
    }


def _wrong_grid(config: TrainConfig, device: torch.device) -> str | None:
    """The first comparison of a grid of the model that fails; on a GPU alone."""
    model = find_method(config.method).build(config.model, 1)
    grids = {m.config for m in model.modules() if isinstance(m, HashGrid)}
    for grid in grids if device.type == "cuda" else ():
        for what, (gap, allowed) in grid_gaps(grid, GRID_POINTS, device).items():
            if not gap <= allowed:
                return f"{what} of a hash grid of {grid.num_levels} levels: off by {gap:.1e}"
    return None


def _small(config: TrainConfig) -> TrainConfig:
    """The options for a few steps that show all kinds of them."""
    model = config.model
    if isinstance(model, NerfactoConfig):
        model = replace(model, proposal_warmup_steps=1, proposal_update_every=2)
    return replace(config, rays_per_step=NUM_RAYS, model=model)


def _disagreement_anywhere(config: TrainConfig, device: torch.device) -> str | None:
    """What differs between the engines in the first of the settings where anything does."""
    for setting in SETTINGS:
        if problem := _disagreement(_small(config), device, setting):
            return f"{problem} ({setting.name})"
    return None


def _disagreement(config: TrainConfig, device: torch.device, setting: Setting) -> str | None:
    plain, fast = (_start(config, device, setting, engine) for engine in ("plain", "fast"))
    plain_losses, fast_losses = _losses(plain, FIRST_STEP), _losses(fast, FIRST_STEP)
    if problem := _gap_of_losses(fast_losses, plain_losses, LOSS_TOLERANCE, "first step"):
        return problem
    if problem := _gap_of_gradients(fast.model, plain.model):
        return problem
    for number in range(FIRST_STEP + 1, FIRST_STEP + NUM_STEPS):
        before = fast.random_states()
        plain_losses, fast_losses = _losses(plain, number), _losses(fast, number)
        if any(a == b for a, b in zip(before, fast.random_states(), strict=True)):
            return f"step {number - FIRST_STEP + 1} drew no new random numbers"
    return _gap_of_losses(fast_losses, plain_losses, END_TOLERANCE, "last step")


def _gap_of_gradients(fast: Model, plain: Model) -> str | None:
    """What differs, in words."""
    expected = {name: parameter.grad for name, parameter in plain.named_parameters()}
    norms = [float(gradient.norm()) for gradient in expected.values() if gradient is not None]
    floor = max(GRADIENT_FLOOR * math.hypot(*norms), SMALLEST)
    for name, parameter in fast.named_parameters():
        ours, theirs = parameter.grad, expected[name]
        if (ours is None) != (theirs is None):
            return f"only one engine has a gradient of {name}"
        if ours is not None and theirs is not None:
            gap = float((ours - theirs).norm()) / max(float(theirs.norm()), floor)
            if not gap <= GRADIENT_TOLERANCE:
                return f"the gradient of {name} is off by {100 * gap:.0f} %"
    return None


def _gap_of_losses(
    found: dict[str, float], expected: dict[str, float], tolerance: float, when: str
) -> str | None:
    """What differs, in words. Of the terms only the sum and that of the colours count."""
    for label, ours, theirs in (
        ("colour loss", found["rgb"], expected["rgb"]),
        ("loss", sum(found.values()), sum(expected.values())),
    ):
        if not abs(ours - theirs) <= tolerance * abs(theirs):
            return f"the {label} of the {when} is {ours:.4g}, with the plain engine {theirs:.4g}"
    return None


class _Run(NamedTuple):
    """A model that is trained by one engine."""

    model: Model
    step: TrainingStep
    pixel_random: torch.Generator
    model_random: torch.Generator

    def random_states(self) -> tuple[bytes, bytes]:
        """Where its random numbers are."""
        pixel, model = self.pixel_random.get_state(), self.model_random.get_state()
        return pixel.numpy().tobytes(), model.numpy().tobytes()


def _losses(run: _Run, number: int) -> dict[str, float]:
    run.step.run(number, dict.fromkeys(run.step.optimizers, LEARNING_RATE))
    return run.step.losses().values


def _start(config: TrainConfig, device: torch.device, setting: Setting, engine: str) -> _Run:
    """A new model, always the same, and its step; graphs for the fast engine alone."""
    torch.manual_seed(0)
    build = find_method(config.method).build
    model: Model = build(config.model, NUM_IMAGES).to(device).train()
    cameras = _cameras(all_lenses=setting.all_lenses).to(device)
    model.cameras_delta.keep_frame(cameras.scene_from_camera)
    model.set_engine(engine)
    eps = config.optimizer.eps
    optimizers = {
        "networks": capturable_adam(model.network_parameters(), LEARNING_RATE, eps, device)
    }
    set_table_decay(optimizers["networks"], model, config.optimizer.table_decay)
    if config.model.camera_mode != "off":
        corrections = model.cameras_delta.parameters()
        optimizers["cameras"] = capturable_adam(corrections, LEARNING_RATE, eps, device)
    pixels_on = torch.device("cpu") if setting.fed else device
    pictures = _pictures(masked=setting.masked)
    sampler = PixelSampler(pictures, range(NUM_IMAGES), pixels_on, PlainLines.of(config))
    sampler.block = block_side(0, config.data)
    pixel_random = torch.Generator(pixels_on).manual_seed(1)
    model_random = torch.Generator(device).manual_seed(2)
    step = TrainingStep(
        model,
        optimizers,
        loss_scaler(device, NUM_RAYS),
        sampler,
        cameras,
        NUM_RAYS,
        pixel_random=pixel_random,
        model_random=model_random,
        capture=None if engine == "fast" else False,
        feed=setting.fed,
    )
    return _Run(model, step, pixel_random, model_random)


def _pictures(*, masked: bool = False) -> ImageData:
    """Noise, the same each time: what is learned does not matter. masked: without a fifth of it."""
    random = np.random.default_rng(0)
    shape = (IMAGE_SIDE, IMAGE_SIDE, 3)
    pictures = [random.integers(0, 256, shape, np.uint8) for _ in range(NUM_IMAGES)]
    masks = [random.random(shape[:2]) > 0.2 for _ in range(NUM_IMAGES)]
    return ImageData.from_arrays(pictures, masks if masked else None)


def _cameras(*, all_lenses: bool = False) -> Cameras:
    """A ring of radius 0.8 around the origin, looking at its centre, +Z up.

    all_lenses: one of each, else pinholes.
    """
    poses = np.zeros((NUM_IMAGES, 3, 4))
    for index in range(NUM_IMAGES):
        angle = 2.0 * math.pi * index / NUM_IMAGES
        back = np.array([math.cos(angle), math.sin(angle), 0.0])
        right = np.array([-back[1], back[0], 0.0])
        poses[index] = np.stack([right, [0.0, 0.0, 1.0], back, 0.8 * back], axis=-1)
    models = CAMERA_MODELS if all_lenses else ("PINHOLE",) * NUM_IMAGES
    middle = (IMAGE_SIDE / 2, IMAGE_SIDE / 2)
    panorama = panorama_intrinsics(IMAGE_SIDE, IMAGE_SIDE)
    lenses = [panorama if m == "EQUIRECTANGULAR" else ((FOCAL, FOCAL), middle) for m in models]
    return Cameras.from_arrays(
        world_from_camera=poses,
        scene=SceneTransform((0.0, 0.0, 0.0), 1.0),
        widths=[IMAGE_SIDE] * NUM_IMAGES,
        heights=[IMAGE_SIDE] * NUM_IMAGES,
        focal=[focal for focal, _ in lenses],
        principal=[principal for _, principal in lenses],
        models=models,
        distortion=[LENS_TERMS] * NUM_IMAGES,
    )
