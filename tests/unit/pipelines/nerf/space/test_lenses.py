"""The inverse of lenses: as exact as if it took its time, in few operations.

The slow twin is the fixed-point iteration of OpenCV's `undistortPoints`, in float64 until it stands
still. Lenses are those of phones, of action cameras and of fisheyes, at the size of their pictures.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from pipelines.nerf.space.cameras import Cameras, SceneTransform
from pipelines.nerf.space.lenses import MAX_STEPS

WITHIN_PX = 1e-4
TWIN_STEPS = 300


class Lens(NamedTuple):
    """One lens. terms: k1, k2, k3, k4, p1, p2."""

    model: str
    width: int
    height: int
    focal: float
    terms: tuple[float, float, float, float, float, float]


LENSES = {
    "phone": Lens("OPENCV", 4032, 3024, 3100.0, (0.08, -0.2, 0.18, 0.0, 8e-4, -5e-4)),
    "strong phone": Lens("OPENCV", 4032, 3024, 3600.0, (0.25, -1.1, 1.4, -0.3, 2e-3, -3e-3)),
    "ultra-wide phone": Lens("OPENCV", 1920, 1080, 820.0, (-0.1, 0.02, -0.002, 0.0, 1e-2, -1e-2)),
    "action camera": Lens("OPENCV", 1920, 1080, 1300.0, (-0.27, 0.09, -0.012, 0.0, 4e-4, -2e-4)),
    "pincushion": Lens("OPENCV", 640, 480, 290.0, (0.3, 0.1, 0.0, 0.0, 4e-3, 4e-3)),
    "fisheye": Lens("OPENCV_FISHEYE", 2704, 2028, 980.0, (0.03, -0.01, 4e-3, -1e-3, 0.0, 0.0)),
    "strong fisheye": Lens("OPENCV_FISHEYE", 1440, 1440, 750.0, (-0.08, 0.02, -5e-3, 4e-4, 0, 0)),
}


def camera(lens: Lens) -> Cameras:
    """One camera at the origin, its axes those of the world, the principal point off the middle."""
    return Cameras.from_arrays(
        world_from_camera=np.hstack([np.eye(3), np.zeros((3, 1))])[None],
        scene=SceneTransform((0.0, 0.0, 0.0), 1.0),
        widths=[lens.width],
        heights=[lens.height],
        focal=[[lens.focal, 1.01 * lens.focal]],
        principal=[[0.49 * lens.width, 0.52 * lens.height]],
        models=[lens.model],
        distortion=[lens.terms],
    )


def in_double(one: Cameras) -> Cameras:
    """The camera in float64, so that what is left of a gap is the method's."""
    names = ("scene_from_camera", "focal", "principal", "distortion")
    return replace(one, **{name: getattr(one, name).double() for name in names})


def pixels_of(lens: Lens, num: int = 40) -> Tensor:
    """[num^2, 2] float64 all over the picture, its corners included."""
    x = torch.linspace(0.0, lens.width, num, dtype=torch.float64)
    y = torch.linspace(0.0, lens.height, num, dtype=torch.float64)
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1).reshape(-1, 2)


def slow_directions(one: Cameras, pixels: Tensor) -> Tensor:
    """Unit directions by fixed points: what is shown, less the shift at the last guess."""
    plane = (pixels - one.principal) / one.focal
    k1, k2, k3, k4, p1, p2 = one.distortion[0].tolist()

    def gain(r2: Tensor) -> Tensor:
        return 1.0 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4

    if one.model.item() == 1:
        x, y = plane.unbind(-1)
        for _ in range(TWIN_STEPS):
            r2 = x * x + y * y
            shift_x = 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
            shift_y = 2.0 * p2 * x * y + p1 * (r2 + 2.0 * y * y)
            x, y = (plane[:, 0] - shift_x) / gain(r2), (plane[:, 1] - shift_y) / gain(r2)
        local = torch.stack([x, -y, -torch.ones_like(x)], dim=-1)
    else:
        bent = plane.norm(dim=-1)
        theta = bent
        for _ in range(TWIN_STEPS):
            theta = bent / gain(theta**2)
        way = plane / bent.clamp_min(1e-300)[:, None]
        x, y = (way * theta.sin()[:, None]).unbind(-1)
        local = torch.stack([x, -y, -theta.cos()], dim=-1)
    return torch.nn.functional.normalize(local, dim=-1)


@pytest.mark.parametrize("name", LENSES)
def test_the_inverse_ends_where_a_slow_iteration_ends_all_over_the_picture(name: str) -> None:
    lens = LENSES[name]
    one = in_double(camera(lens))
    pixels = pixels_of(lens)
    rows = torch.zeros(len(pixels), dtype=torch.int64)
    expected = slow_directions(one, pixels)
    again, _ = one.project(expected, rows)
    assert float((again - pixels).abs().max()) < 1e-6  # the twin has come to its end
    found = one.generate_rays(rows, pixels).directions
    # An angle of 1 / focal is a pixel in the middle of the picture.
    assert float((found - expected).norm(dim=-1).max()) * lens.focal < WITHIN_PX
    shown, _ = one.project(found, rows)
    assert float((shown - pixels).abs().max()) < WITHIN_PX


@pytest.mark.parametrize("name", LENSES)
def test_in_float32_a_lens_adds_little_to_what_rounding_does_to_any_pixel(name: str) -> None:
    lens = LENSES[name]
    one = camera(lens)
    pixels = pixels_of(lens).float()
    rows = torch.zeros(len(pixels), dtype=torch.int64)
    expected = slow_directions(in_double(one), pixels.double())
    found = one.generate_rays(rows, pixels).directions.double()
    # A coordinate of 2,000 px and a direction of about 1 have units of 1.2e-7 of themselves.
    assert float((found - expected).norm(dim=-1).max()) < 8e-7


def test_steps_are_those_that_the_worst_lens_needs() -> None:
    needed = {name: camera(lens).inverse_steps for name, lens in LENSES.items()}
    assert needed["phone"] <= 3
    assert needed["pincushion"] > needed["phone"]
    assert max(needed.values()) < MAX_STEPS / 2
    plain = Lens("OPENCV", 640, 480, 500.0, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
    assert camera(plain).inverse_steps == 0
    # One that folds over long before its corners: the part that it shows at all decides.
    folding = camera(Lens("OPENCV", 640, 480, 300.0, (-0.5, 0.0, 0.0, 0.0, 0.0, 0.0)))
    assert 0 < folding.inverse_steps <= MAX_STEPS
    assert bool(folding.image_rays(0).directions.isfinite().all())


class Count(TorchDispatchMode):
    """Operations that a device has to start: all but views."""

    def __init__(self) -> None:
        super().__init__()
        self.operations = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.operations += not func.is_view
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize(
    ("name", "most"),
    [("phone", 120), ("strong phone", 120), ("action camera", 160), ("strong fisheye", 100)],
)
def test_rays_through_a_lens_take_few_operations(name: str, most: int) -> None:
    one = camera(LENSES[name])
    pixels = pixels_of(LENSES[name], 8).float()
    with Count() as count:
        one.generate_rays(torch.zeros(64, dtype=torch.int64), pixels)
    assert count.operations <= most
