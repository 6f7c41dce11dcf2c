"""Bundles of rays keep what belongs to them; samples are points or volumes."""

from __future__ import annotations

import math

import pytest
import torch

from pipelines.nerf.errors import NerfError
from pipelines.nerf.space.frustums import frustum_gaussians
from pipelines.nerf.space.rays import Rays, RaySamples


def _rays() -> Rays:
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(5, 3, generator=generator, dtype=torch.float64)
    return Rays(
        origins=torch.randn(5, 3, generator=generator, dtype=torch.float64),
        directions=torch.nn.functional.normalize(directions, dim=-1),
        camera_indices=torch.arange(5),
        pixel_area=torch.linspace(1e-6, 5e-6, 5, dtype=torch.float64),
        times=torch.linspace(0.0, 1.0, 5, dtype=torch.float64),
    )


def _samples() -> RaySamples:
    edges = torch.tensor([[0.0, 0.5, 0.8, 1.0]], dtype=torch.float64).expand(5, -1)
    return RaySamples(s_edges=edges, t_edges=2.0 + 3.0 * edges)


@pytest.mark.parametrize(
    "rows", [slice(1, 4), torch.tensor([3, 0]), torch.tensor([True, False, True, False, False])]
)
def test_selected_rays_keep_everything_in_its_row(rows: torch.Tensor | slice) -> None:
    rays = _rays()
    some = rays.select(rows)
    wanted = torch.arange(5)[rows]
    assert len(some) == len(wanted)
    for name, values in vars(rays).items():
        assert torch.equal(getattr(some, name), values[wanted])


def test_detached_and_moved_rays_keep_area_and_time() -> None:
    rays = _rays()
    rays.origins.requires_grad_()
    for other in (rays.detach(), rays.to("cpu")):
        for name, values in vars(rays).items():
            assert torch.equal(getattr(other, name), values)
    assert not rays.detach().origins.requires_grad


def test_rays_of_a_still_scene_have_no_time_and_no_area() -> None:
    bare = Rays(torch.zeros(2, 3), torch.ones(2, 3), torch.zeros(2, dtype=torch.int64))
    for other in (bare, bare.detach(), bare.to("cpu"), bare.select(slice(1))):
        assert other.times is None
        assert other.pixel_area is None


def test_positions_are_the_midpoints_along_the_ray() -> None:
    rays = Rays(torch.tensor([[1.0, 0, 0]]), torch.tensor([[0.0, 1, 0]]), torch.tensor([0]))
    samples = RaySamples(torch.tensor([[0.0, 0.5, 1.0]]), torch.tensor([[1.0, 2.0, 4.0]]))
    expected = torch.tensor([[[1.0, 1.5, 0.0], [1.0, 3.0, 0.0]]])
    assert torch.allclose(samples.positions(rays), expected)


def test_gaussians_are_those_of_the_pixels_cones() -> None:
    rays, samples = _rays(), _samples()
    found = samples.gaussians(rays)
    assert found.mean.shape == (5, 3, 3)
    assert found.covariance.shape == (5, 3, 3, 3)
    for ray in range(5):
        radius = math.sqrt(1e-6 * (ray + 1) / math.pi)
        expected = frustum_gaussians(
            rays.origins[ray : ray + 1],
            rays.directions[ray : ray + 1],
            samples.t_edges[ray : ray + 1],
            torch.tensor([radius], dtype=torch.float64),
        )
        assert torch.allclose(found.mean[ray], expected.mean[0], rtol=1e-12)
        assert torch.allclose(found.covariance[ray], expected.covariance[0], rtol=1e-9)


def test_a_gaussians_mean_lies_behind_the_midpoint_but_inside_its_interval() -> None:
    rays, samples = _rays(), _samples()
    offset = samples.gaussians(rays).mean - rays.origins[:, None]
    t = (offset * rays.directions[:, None]).sum(-1)
    assert bool(((t > samples.t_mid) & (t < samples.t_edges[:, 1:])).all())


def test_rays_without_pixel_area_have_no_gaussians() -> None:
    bare = Rays(torch.zeros(5, 3), torch.ones(5, 3), torch.zeros(5, dtype=torch.int64))
    with pytest.raises(NerfError, match="with_pixel_area=True") as caught:
        _samples().gaussians(bare)
    assert caught.value.code == "bad_rays"
